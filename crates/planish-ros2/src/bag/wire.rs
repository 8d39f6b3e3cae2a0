//! Decoding and encoding of messages, by the encoding that their channel states.

use super::foxglove::{self, Codec, Encoding, png_of};
use super::schemas::{CAMERA_INFO_TYPE, CLOUD_TYPE, COMPRESSED_TYPE, IMAGE_TYPE, MESSAGE_ENCODING};
use super::survey::MessageKind;
use crate::ros::{CameraInfo, DepthMessage, PointCloud2, from_cdr, to_cdr};
use planish_core::FormatError;
use planish_io::ReadOptions;

/// Encoding of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Wire {
    /// CDR, as written by ROS 2.
    Ros,
    /// Foxglove's messages.
    Foxglove(Encoding),
    /// Foxglove's messages, with the image as a PNG.
    FoxglovePng(Encoding),
}

/// Returns the kind and the encoding of the messages of a channel; `None` if they are not supported.
pub(super) fn kind_of(type_name: &str, message_encoding: &str) -> Option<(MessageKind, Wire)> {
    if let Some(foxglove) = foxglove::Type::named(type_name) {
        let encoding = Encoding::named(message_encoding)?;
        return Some(match foxglove {
            foxglove::Type::RawImage => (MessageKind::Image, Wire::Foxglove(encoding)),
            foxglove::Type::CompressedImage => (MessageKind::Image, Wire::FoxglovePng(encoding)),
            foxglove::Type::PointCloud => (MessageKind::PointCloud2, Wire::Foxglove(encoding)),
            foxglove::Type::CameraCalibration => (MessageKind::CameraInfo, Wire::Foxglove(encoding)),
        });
    }
    let kind = match type_name {
        IMAGE_TYPE => MessageKind::Image,
        COMPRESSED_TYPE => MessageKind::CompressedImage,
        CLOUD_TYPE => MessageKind::PointCloud2,
        CAMERA_INFO_TYPE => MessageKind::CameraInfo,
        _ => return None,
    };
    (message_encoding == MESSAGE_ENCODING).then_some((kind, Wire::Ros))
}

/// Returns true if [`kind_of`] supports the type in any encoding.
pub(super) fn is_known_type(type_name: &str) -> bool {
    kind_of(type_name, MESSAGE_ENCODING).is_some()
}

impl Wire {
    /// Returns the functions for Foxglove's messages; `None` for ROS.
    fn codec(self) -> Option<&'static dyn Codec> {
        match self {
            Self::Ros => None,
            Self::Foxglove(encoding) | Self::FoxglovePng(encoding) => Some(encoding.codec()),
        }
    }

    /// Reads a depth image from a message of the given kind.
    pub(super) fn depth(
        self,
        kind: MessageKind,
        data: &[u8],
        options: &ReadOptions,
    ) -> Result<DepthMessage, FormatError> {
        match (self, kind) {
            (Self::Ros, MessageKind::CompressedImage) => from_cdr(data).map(DepthMessage::Compressed),
            (Self::Ros, _) => from_cdr(data).map(DepthMessage::Image),
            (Self::Foxglove(encoding), _) => encoding.codec().image(data).map(DepthMessage::Image),
            (Self::FoxglovePng(encoding), _) => {
                encoding.codec().compressed_image(data)?.image(options).map(DepthMessage::Image)
            }
        }
    }

    /// Reads a cloud.
    pub(super) fn cloud(self, data: &[u8]) -> Result<PointCloud2, FormatError> {
        self.codec().map_or_else(|| from_cdr(data), |codec| codec.cloud(data))
    }

    /// Reads a camera.
    pub(super) fn camera(self, data: &[u8]) -> Result<CameraInfo, FormatError> {
        self.codec().map_or_else(|| from_cdr(data), |codec| codec.camera(data))
    }

    /// Encodes a smoothed depth image to replace the original message.
    pub(super) fn with_depth(
        self,
        original: &[u8],
        smoothed: &DepthMessage,
        options: &ReadOptions,
    ) -> Result<Vec<u8>, FormatError> {
        match (self, smoothed) {
            (Self::Foxglove(encoding), DepthMessage::Image(image)) => encoding.codec().with_image(original, image),
            (Self::FoxglovePng(encoding), DepthMessage::Image(image)) => {
                encoding.codec().with_png(original, &png_of(image, options)?)
            }
            (_, DepthMessage::Image(image)) => to_cdr(image),
            (_, DepthMessage::Compressed(image)) => to_cdr(image),
        }
    }

    /// Encodes a smoothed cloud to replace the original message.
    pub(super) fn with_cloud(self, original: &[u8], smoothed: &PointCloud2) -> Result<Vec<u8>, FormatError> {
        self.codec().map_or_else(|| to_cdr(smoothed), |codec| codec.with_cloud(original, smoothed))
    }
}
