//! Position and viewing direction of the sensor in the cloud's frame, for the kernels (docs/method.md, section 11).
//!
//! Points are not transformed, so offsets between them are exact; transforming them to the sensor's frame would round
//! them once more. A *ray* leads from the sensor to a point, in the cloud's frame. For a cloud in the sensor's frame,
//! these operations do not change any bit.

use fearless_simd::Simd;

use super::vector::{Vec3, splat};
use crate::frame::FrameGeometry;

#[derive(Clone, Copy)]
pub(super) struct Sensor {
    position: [f32; 3],
    /// Unit vector of the viewing direction.
    axis: [f32; 3],
}

impl Sensor {
    pub(super) fn new(geometry: &FrameGeometry) -> Self {
        let [position, axis] = [geometry.sensor_position(), geometry.sensor_axis()].map(|v| v.as_vec3().to_array());
        Self { position, axis }
    }

    /// Returns the ray to each point.
    #[inline(always)]
    pub(super) fn ray<S: Simd>(&self, simd: S, p: Vec3<S>) -> Vec3<S> {
        p.sub(in_every_lane(simd, self.position))
    }

    /// Returns the length of each ray along the sensor's axis.
    #[inline(always)]
    pub(super) fn depth<S: Simd>(&self, simd: S, ray: Vec3<S>) -> S::f32s {
        ray.dot(in_every_lane(simd, self.axis))
    }
}

#[inline(always)]
fn in_every_lane<S: Simd>(simd: S, [x, y, z]: [f32; 3]) -> Vec3<S> {
    Vec3::new(splat(simd, x), splat(simd, y), splat(simd, z))
}
