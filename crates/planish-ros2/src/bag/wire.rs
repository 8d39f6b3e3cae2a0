//! Decoding and encoding of messages, by the encoding that their channel states.

use super::foxglove;
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
    /// Protocol Buffers, in Foxglove's schemas.
    Foxglove,
    /// Protocol Buffers, in Foxglove's schemas, with the image as a PNG.
    FoxglovePng,
}

/// Returns the kind and the encoding of the messages of a channel; `None` if they are not supported.
pub(super) fn kind_of(type_name: &str, message_encoding: &str) -> Option<(MessageKind, Wire)> {
    Some(match (message_encoding, type_name) {
        (MESSAGE_ENCODING, IMAGE_TYPE) => (MessageKind::Image, Wire::Ros),
        (MESSAGE_ENCODING, COMPRESSED_TYPE) => (MessageKind::CompressedImage, Wire::Ros),
        (MESSAGE_ENCODING, CLOUD_TYPE) => (MessageKind::PointCloud2, Wire::Ros),
        (MESSAGE_ENCODING, CAMERA_INFO_TYPE) => (MessageKind::CameraInfo, Wire::Ros),
        (foxglove::MESSAGE_ENCODING, foxglove::IMAGE_TYPE) => (MessageKind::Image, Wire::Foxglove),
        (foxglove::MESSAGE_ENCODING, foxglove::COMPRESSED_TYPE) => (MessageKind::Image, Wire::FoxglovePng),
        (foxglove::MESSAGE_ENCODING, foxglove::CLOUD_TYPE) => (MessageKind::PointCloud2, Wire::Foxglove),
        (foxglove::MESSAGE_ENCODING, foxglove::CAMERA_TYPE) => (MessageKind::CameraInfo, Wire::Foxglove),
        _ => return None,
    })
}

/// Returns true if [`kind_of`] supports the type in any encoding.
pub(super) fn is_known_type(type_name: &str) -> bool {
    [MESSAGE_ENCODING, foxglove::MESSAGE_ENCODING].iter().any(|encoding| kind_of(type_name, encoding).is_some())
}

impl Wire {
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
            (Self::Foxglove, _) => foxglove::image(data).map(DepthMessage::Image),
            (Self::FoxglovePng, _) => foxglove::compressed_image(data)?.image(options).map(DepthMessage::Image),
        }
    }

    /// Reads a cloud.
    pub(super) fn cloud(self, data: &[u8]) -> Result<PointCloud2, FormatError> {
        if self == Self::Ros { from_cdr(data) } else { foxglove::cloud(data) }
    }

    /// Reads a camera.
    pub(super) fn camera(self, data: &[u8]) -> Result<CameraInfo, FormatError> {
        if self == Self::Ros { from_cdr(data) } else { foxglove::camera(data) }
    }

    /// Encodes a smoothed depth image to replace the original message.
    pub(super) fn with_depth(
        self,
        original: &[u8],
        smoothed: &DepthMessage,
        options: &ReadOptions,
    ) -> Result<Vec<u8>, FormatError> {
        match (self, smoothed) {
            (Self::Foxglove, DepthMessage::Image(image)) => foxglove::with_image(original, image),
            (Self::FoxglovePng, DepthMessage::Image(image)) => {
                foxglove::with_compressed_image(original, image, options)
            }
            (_, DepthMessage::Image(image)) => to_cdr(image),
            (_, DepthMessage::Compressed(image)) => to_cdr(image),
        }
    }

    /// Encodes a smoothed cloud to replace the original message.
    pub(super) fn with_cloud(self, original: &[u8], smoothed: &PointCloud2) -> Result<Vec<u8>, FormatError> {
        if self == Self::Ros { to_cdr(smoothed) } else { foxglove::with_cloud(original, smoothed) }
    }
}
