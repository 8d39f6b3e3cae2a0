//! Converts errors of the las crate to format errors.

use planish_core::FormatError;

use crate::brief;

pub(super) fn damaged(error: las::Error) -> FormatError {
    let is_cut = |error: &std::io::Error| error.kind() == std::io::ErrorKind::UnexpectedEof;
    if matches!(&error, las::Error::Io(error) if is_cut(error))
        || error.to_string().contains("failed to fill whole buffer")
    {
        return FormatError::Malformed("damaged LAS: the file is truncated, or its header states wrong sizes".into());
    }
    FormatError::Malformed(format!("damaged LAS: {}", brief(&error.to_string())))
}

pub(super) fn unreadable() -> FormatError {
    FormatError::Malformed("damaged LAZ: its points cannot be decompressed".into())
}

pub(super) fn cannot(error: las::Error) -> FormatError {
    FormatError::Unsupported(format!("cannot encode this cloud as LAS: {}", brief(&error.to_string())))
}
