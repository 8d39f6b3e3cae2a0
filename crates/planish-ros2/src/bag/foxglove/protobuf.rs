//! Messages in Protocol Buffers. Fields are read by their numbers in Foxglove's published schemas.

use super::{Codec, CompressedImage, MOST_FIELDS, field_of, in_one_row, type_of};
use crate::ros::{CameraInfo, Header, Image, PointCloud2, PointField, Time};
use planish_core::FormatError;

pub(super) struct Protobuf;

/// The value of a field.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Value<'a> {
    Varint(u64),
    Eight([u8; 8]),
    Bytes(&'a [u8]),
    Four([u8; 4]),
}

/// A field: its number, its value, and its bytes in the message.
type Field<'a> = (u64, Value<'a>, &'a [u8]);

/// The fields of a message, in order.
struct Fields<'a>(&'a [u8]);

impl<'a> Iterator for Fields<'a> {
    type Item = Result<Field<'a>, FormatError>;

    fn next(&mut self) -> Option<Self::Item> {
        let message = self.0;
        if message.is_empty() {
            return None;
        }
        let field = (|| {
            let key = varint(&mut self.0)?;
            let value = match key & 7 {
                0 => Value::Varint(varint(&mut self.0)?),
                1 => Value::Eight(take(&mut self.0, 8)?.try_into().ok()?),
                2 => {
                    let length = usize::try_from(varint(&mut self.0)?).ok()?;
                    Value::Bytes(take(&mut self.0, length)?)
                }
                5 => Value::Four(take(&mut self.0, 4)?.try_into().ok()?),
                _ => return None,
            };
            Some((key >> 3, value, &message[..message.len() - self.0.len()]))
        })();
        if field.is_none() {
            self.0 = &[];
        }
        Some(field.ok_or_else(|| FormatError::Malformed("damaged Foxglove message".into())))
    }
}

fn take<'a>(bytes: &mut &'a [u8], count: usize) -> Option<&'a [u8]> {
    let (taken, rest) = bytes.split_at_checked(count)?;
    *bytes = rest;
    Some(taken)
}

fn varint(bytes: &mut &[u8]) -> Option<u64> {
    let mut value = 0u64;
    for shift in (0..64).step_by(7) {
        let [byte] = *take(bytes, 1)? else { return None };
        value |= u64::from(byte & 0x7f) << shift;
        if byte < 0x80 {
            return Some(value);
        }
    }
    None
}

fn push_varint(message: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        message.push(value as u8 | 0x80);
        value >>= 7;
    }
    message.push(value as u8);
}

fn push_bytes(message: &mut Vec<u8>, number: u64, bytes: &[u8]) {
    push_varint(message, number << 3 | 2);
    push_varint(message, bytes.len() as u64);
    message.extend(bytes);
}

fn push_four(message: &mut Vec<u8>, number: u64, value: u32) {
    push_varint(message, number << 3 | 5);
    message.extend(value.to_le_bytes());
}

impl Value<'_> {
    fn u32(self) -> u32 {
        match self {
            Value::Four(bytes) => u32::from_le_bytes(bytes),
            Value::Varint(value) => u32::try_from(value).unwrap_or(u32::MAX),
            _ => 0,
        }
    }

    fn text(self) -> String {
        match self {
            Value::Bytes(bytes) => String::from_utf8_lossy(bytes).into_owned(),
            _ => String::new(),
        }
    }

    /// Appends the numbers of a repeated field: all numbers of a packed field, or one of an unpacked field.
    fn push_to(self, numbers: &mut Vec<f64>) {
        match self {
            Value::Eight(bytes) => numbers.push(f64::from_le_bytes(bytes)),
            Value::Bytes(bytes) => {
                numbers.extend(bytes.as_chunks::<8>().0.iter().map(|eight| f64::from_le_bytes(*eight)))
            }
            _ => {}
        }
    }

    fn time(self) -> Result<Time, FormatError> {
        let Value::Bytes(bytes) = self else { return Ok(Time::default()) };
        let mut time = Time::default();
        for field in Fields(bytes) {
            match field? {
                // Negative numbers are sign-extended to 64 bits.
                (1, Value::Varint(seconds), _) => time.sec = i32::try_from(seconds as i64).unwrap_or_default(),
                (2, Value::Varint(nanoseconds), _) => time.nanosec = u32::try_from(nanoseconds).unwrap_or_default(),
                _ => {}
            }
        }
        Ok(time)
    }

    fn bytes(self) -> Vec<u8> {
        if let Value::Bytes(bytes) = self { bytes.to_vec() } else { Vec::new() }
    }
}

fn point_field(bytes: &[u8]) -> Result<PointField, FormatError> {
    let (mut name, mut offset, mut kind) = (String::new(), 0, 0);
    for field in Fields(bytes) {
        match field? {
            (1, value, _) => name = value.text(),
            (2, value, _) => offset = value.u32(),
            (3, Value::Varint(number), _) => kind = number,
            _ => {}
        }
    }
    Ok(field_of(name, offset, kind))
}

/// Copies a message without the given fields.
fn without(message: &[u8], numbers: &[u64]) -> Result<Vec<u8>, FormatError> {
    let mut kept = Vec::with_capacity(message.len());
    for field in Fields(message) {
        let (number, _, bytes) = field?;
        if !numbers.contains(&number) {
            kept.extend_from_slice(bytes);
        }
    }
    Ok(kept)
}

impl Codec for Protobuf {
    fn image(&self, message: &[u8]) -> Result<Image, FormatError> {
        let mut image = Image::default();
        for field in Fields(message) {
            match field? {
                (1, value, _) => image.header.stamp = value.time()?,
                (2, value, _) => image.width = value.u32(),
                (3, value, _) => image.height = value.u32(),
                (4, value, _) => image.encoding = value.text(),
                (5, value, _) => image.step = value.u32(),
                (6, value, _) => image.data = value.bytes(),
                (7, value, _) => image.header.frame_id = value.text(),
                _ => {}
            }
        }
        Ok(image)
    }

    fn compressed_image(&self, message: &[u8]) -> Result<CompressedImage, FormatError> {
        let mut image = CompressedImage { header: Header::default(), format: String::new(), data: Vec::new() };
        for field in Fields(message) {
            match field? {
                (1, value, _) => image.header.stamp = value.time()?,
                (2, value, _) => image.data = value.bytes(),
                (3, value, _) => image.format = value.text(),
                (4, value, _) => image.header.frame_id = value.text(),
                _ => {}
            }
        }
        Ok(image)
    }

    fn cloud(&self, message: &[u8]) -> Result<PointCloud2, FormatError> {
        let mut cloud = PointCloud2::default();
        for field in Fields(message) {
            match field? {
                (1, value, _) => cloud.header.stamp = value.time()?,
                (2, value, _) => cloud.header.frame_id = value.text(),
                (4, value, _) => cloud.point_step = value.u32(),
                (5, Value::Bytes(bytes), _) => {
                    if cloud.fields.len() == MOST_FIELDS {
                        return Err(FormatError::Malformed(format!("the points have more than {MOST_FIELDS} fields")));
                    }
                    cloud.fields.push(point_field(bytes)?);
                }
                (6, value, _) => cloud.data = value.bytes(),
                _ => {}
            }
        }
        in_one_row(cloud)
    }

    fn camera(&self, message: &[u8]) -> Result<CameraInfo, FormatError> {
        let mut info = CameraInfo::default();
        let [mut k, mut r, mut p] = [const { Vec::new() }; 3];
        for field in Fields(message) {
            match field? {
                (1, value, _) => info.header.stamp = value.time()?,
                (2, value, _) => info.width = value.u32(),
                (3, value, _) => info.height = value.u32(),
                (4, value, _) => info.distortion_model = value.text(),
                (5, value, _) => value.push_to(&mut info.d),
                (6, value, _) => value.push_to(&mut k),
                (7, value, _) => value.push_to(&mut r),
                (8, value, _) => value.push_to(&mut p),
                (9, value, _) => info.header.frame_id = value.text(),
                _ => {}
            }
        }
        info.k = k.try_into().unwrap_or_default();
        info.r = r.try_into().unwrap_or_default();
        info.p = p.try_into().unwrap_or_default();
        Ok(info)
    }

    fn with_image(&self, original: &[u8], image: &Image) -> Result<Vec<u8>, FormatError> {
        let mut message = without(original, &[5, 6])?;
        push_four(&mut message, 5, image.step);
        push_bytes(&mut message, 6, &image.data);
        Ok(message)
    }

    fn with_png(&self, original: &[u8], png: &[u8]) -> Result<Vec<u8>, FormatError> {
        let mut message = without(original, &[2])?;
        push_bytes(&mut message, 2, png);
        Ok(message)
    }

    fn with_cloud(&self, original: &[u8], cloud: &PointCloud2) -> Result<Vec<u8>, FormatError> {
        let mut message = without(original, &[4, 5, 6])?;
        push_four(&mut message, 4, cloud.point_step);
        for described in &cloud.fields {
            let mut field = Vec::new();
            push_bytes(&mut field, 1, described.name.as_bytes());
            push_four(&mut field, 2, described.offset);
            push_varint(&mut field, 3 << 3);
            push_varint(&mut field, type_of(described)?.into());
            push_bytes(&mut message, 5, &field);
        }
        push_bytes(&mut message, 6, &cloud.data);
        Ok(message)
    }
}
