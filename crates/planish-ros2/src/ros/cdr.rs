//! Serialization of messages: CDR after a four-byte header with the byte order (OMG DDSI-RTPS 2.3, section 10.2).

use byteorder::{BigEndian, LittleEndian};
use serde::Serialize;
use serde::de::DeserializeOwned;

use planish_core::FormatError;
use planish_io::internal::brief;

/// Identifier of plain big-endian CDR, version 1.
const BIG_ENDIAN: [u8; 2] = [0, 0];
/// Identifier of plain little-endian CDR, version 1.
const LITTLE_ENDIAN: [u8; 2] = [0, 1];

/// Reads a message from its bytes.
///
/// # Errors
/// If the bytes have another encoding, or are damaged or truncated.
pub fn from_cdr<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, FormatError> {
    let malformed = |error: cdr_encoding::Error| FormatError::Malformed(brief(&format!("damaged message: {error}")));
    match bytes {
        [a, b, _, _, body @ ..] if [*a, *b] == LITTLE_ENDIAN => {
            Ok(cdr_encoding::from_bytes::<T, LittleEndian>(body).map_err(malformed)?.0)
        }
        [a, b, _, _, body @ ..] if [*a, *b] == BIG_ENDIAN => {
            Ok(cdr_encoding::from_bytes::<T, BigEndian>(body).map_err(malformed)?.0)
        }
        [a, b, _, _, ..] => Err(FormatError::Unsupported(format!(
            "unsupported message encoding {a:02x} {b:02x}; only plain CDR (00 00 or 00 01), as written by ROS 2, is \
             supported"
        ))),
        _ => Err(FormatError::Malformed(format!("the message has only {} bytes, but its header needs 4", bytes.len()))),
    }
}

/// Writes a message, little-endian.
pub fn to_cdr<T: Serialize>(message: &T) -> Result<Vec<u8>, FormatError> {
    let mut bytes = vec![0, 1, 0, 0];
    // Alignment is relative to the end of the header.
    cdr_encoding::to_writer::<T, LittleEndian, _>(&mut bytes, message)
        .map_err(|error| FormatError::Unsupported(format!("cannot encode this message as CDR: {error}")))?;
    Ok(bytes)
}
