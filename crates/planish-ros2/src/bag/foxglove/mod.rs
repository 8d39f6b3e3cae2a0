//! Foxglove's messages for images, clouds and cameras, converted to the corresponding ROS messages.
//!
//! They come in three encodings: Protocol Buffers, JSON, and CDR as ROS 2's package `foxglove_msgs`. A smoothed message
//! is a copy of the original with its data replaced, so that unknown fields are kept.

mod cdr;
mod json;
mod protobuf;

use super::super::ros::{CameraInfo, DepthMessage, DepthPixels, Header, Image, PointCloud2, PointField};
use planish_core::FormatError;
use planish_io::ReadOptions;
use planish_io::internal::{decode_depth_png, encode_depth_png, quoted};

/// Maximum number of fields of a cloud's points.
const MOST_FIELDS: usize = 1000;

/// Foxglove's numbers of the scalar types, in the order of ROS: i8, u8, i16, u16, i32, u32, f32, f64.
const TYPES: [u8; 8] = [2, 1, 4, 3, 6, 5, 7, 8];

/// The type of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Type {
    RawImage,
    CompressedImage,
    PointCloud,
    CameraCalibration,
}

impl Type {
    /// Returns the type that a schema's name states; `None` for other types.
    pub(super) fn named(schema: &str) -> Option<Self> {
        let name = schema.strip_prefix("foxglove.").or_else(|| schema.strip_prefix("foxglove_msgs/msg/"))?;
        Some(match name {
            "RawImage" => Self::RawImage,
            "CompressedImage" => Self::CompressedImage,
            "PointCloud" => Self::PointCloud,
            "CameraCalibration" => Self::CameraCalibration,
            _ => return None,
        })
    }
}

/// How the fields of a message are encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Encoding {
    Protobuf,
    Json,
    Cdr,
}

impl Encoding {
    /// Returns the encoding that a channel states; `None` for other encodings.
    pub(super) fn named(message_encoding: &str) -> Option<Self> {
        Some(match message_encoding {
            "protobuf" => Self::Protobuf,
            "json" => Self::Json,
            "cdr" => Self::Cdr,
            _ => return None,
        })
    }

    /// Returns the functions that read and write messages in this encoding.
    pub(super) fn codec(self) -> &'static dyn Codec {
        match self {
            Self::Protobuf => &protobuf::Protobuf,
            Self::Json => &json::Json,
            Self::Cdr => &cdr::Cdr,
        }
    }
}

/// Reads messages, and writes copies of them with their data replaced.
pub(super) trait Codec {
    /// Reads a `RawImage`.
    fn image(&self, message: &[u8]) -> Result<Image, FormatError>;

    /// Reads a `CompressedImage`.
    fn compressed_image(&self, message: &[u8]) -> Result<CompressedImage, FormatError>;

    /// Reads a `PointCloud`; the result is unorganized.
    fn cloud(&self, message: &[u8]) -> Result<PointCloud2, FormatError>;

    /// Reads a `CameraCalibration`. A missing matrix becomes all zeros.
    fn camera(&self, message: &[u8]) -> Result<CameraInfo, FormatError>;

    /// Returns a copy of a `RawImage` with the depth of `image`.
    fn with_image(&self, original: &[u8], image: &Image) -> Result<Vec<u8>, FormatError>;

    /// Returns a copy of a `CompressedImage` with this PNG.
    fn with_png(&self, original: &[u8], png: &[u8]) -> Result<Vec<u8>, FormatError>;

    /// Returns a copy of a `PointCloud` with the points of `cloud`.
    fn with_cloud(&self, original: &[u8], cloud: &PointCloud2) -> Result<Vec<u8>, FormatError>;
}

/// A `CompressedImage`: stamp and frame, format, and the encoded image.
pub(super) struct CompressedImage {
    pub(super) header: Header,
    pub(super) format: String,
    data: Vec<u8>,
}

impl CompressedImage {
    /// Returns true if the image is a 16-bit greyscale PNG.
    pub(super) fn is_depth(&self) -> bool {
        const HEADER: &[u8] = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR";
        self.data.starts_with(HEADER) && self.data.get(24..26) == Some(&[16, 0])
    }

    /// Decompresses the image.
    pub(super) fn image(self, options: &ReadOptions) -> Result<Image, FormatError> {
        if !self.is_depth() {
            return Err(FormatError::Unsupported(format!(
                "unsupported compressed image format {}; depth must be a 16-bit greyscale PNG",
                quoted(&self.format)
            )));
        }
        let depth = decode_depth_png(&self.data, options)?;
        Ok(Image::of_depth(self.header, &DepthPixels::Millimetres(depth)))
    }
}

/// Returns the depth of an image as a PNG.
pub(super) fn png_of(image: &Image, options: &ReadOptions) -> Result<Vec<u8>, FormatError> {
    match DepthMessage::Image(image.clone()).pixels(options)? {
        DepthPixels::Millimetres(depth) => encode_depth_png(&depth),
        DepthPixels::Metres { .. } => {
            Err(FormatError::Unsupported("depth in metres cannot be written as a PNG".into()))
        }
    }
}

/// Completes a cloud whose stamp, fields, stride and points were read: arranges all points in one row.
fn in_one_row(mut cloud: PointCloud2) -> Result<PointCloud2, FormatError> {
    if cloud.point_step == 0 {
        return Err(FormatError::Malformed("the point stride of the cloud is 0".into()));
    }
    cloud.height = 1;
    cloud.width = u32::try_from(cloud.data.len() / cloud.point_step as usize).unwrap_or(u32::MAX);
    cloud.row_step = cloud.width.saturating_mul(cloud.point_step);
    cloud.data.truncate(cloud.row_step as usize);
    Ok(cloud)
}

/// Returns the field with a name, an offset, and Foxglove's number of its type. An unknown type becomes 0.
fn field_of(name: String, offset: u32, kind: u64) -> PointField {
    let datatype = TYPES.iter().position(|known| u64::from(*known) == kind).map_or(0, |at| at as u8 + 1);
    PointField { name, offset, datatype, count: 1 }
}

/// Returns Foxglove's number of a field's type.
///
/// # Errors
/// If the field has several values per point.
fn type_of(PointField { name, datatype, count, .. }: &PointField) -> Result<u8, FormatError> {
    let kind = TYPES.get(usize::from(*datatype).wrapping_sub(1)).filter(|_| *count == 1);
    kind.copied().ok_or_else(|| {
        FormatError::Unsupported(format!(
            "the field {} with {count} values per point cannot be written to a Foxglove message",
            quoted(name)
        ))
    })
}
