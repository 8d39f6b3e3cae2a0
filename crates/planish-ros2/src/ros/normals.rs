//! Images of normals (32FC3: x, y and z of each pixel) and of the origins of pixels (mono8).

use super::{Header, Image};
use planish_core::Xyz;

impl Image {
    /// Creates a mono8 image of pixel origins.
    pub fn of_origins(header: Header, (width, height): (usize, usize), mask: Vec<u8>) -> Self {
        Self {
            header,
            height: height as u32,
            width: width as u32,
            encoding: "mono8".into(),
            is_bigendian: 0,
            step: width as u32,
            data: mask,
        }
    }

    /// Encodes the unit normals of a frame on a grid as 32FC3, in the optical frame of the camera and pointing
    /// towards it; pixels without a normal are NaN.
    pub(super) fn of_normals(header: Header, (width, height): (usize, usize), normals: &Xyz) -> Self {
        let mut data = Vec::with_capacity(12 * normals.len());
        for normal in normals.iter() {
            data.extend_from_slice(bytemuck::bytes_of(&normal));
        }
        Self {
            header,
            height: height as u32,
            width: width as u32,
            encoding: "32FC3".into(),
            is_bigendian: u8::from(cfg!(target_endian = "big")),
            step: 12 * width as u32,
            data,
        }
    }
}
