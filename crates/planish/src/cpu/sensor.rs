//! What the kernels need to know of the sensor's place in the cloud's frame (docs/method.md, section 11).
//!
//! Points stay as they were measured, so that offsets between them are exact; a point turned into the sensor's frame would be
//! rounded once more. A *ray* leads from the sensor to a point, in the cloud's frame.

use fearless_simd::Simd;

use super::eigen::tangents;
use super::vector::{Vec3, splat};
use crate::frame::FrameGeometry;

/// `None` where the cloud's frame is the sensor's.
pub(super) struct Sensor(Option<Placed>);

struct Placed {
    position: [f32; 3],
    /// The sensor's x, y and z axis: the columns of cloud_from_sensor.
    axes: [[f32; 3]; 3],
}

impl Sensor {
    pub(super) fn new(geometry: &FrameGeometry) -> Self {
        Self(geometry.cloud_from_sensor.map(|transform| Placed {
            position: transform.translation.as_vec3().to_array(),
            axes: transform.rotation.as_mat3().to_cols_array_2d(),
        }))
    }

    /// The ray to each point.
    #[inline(always)]
    pub(super) fn ray<S: Simd>(&self, simd: S, p: Vec3<S>) -> Vec3<S> {
        match &self.0 {
            None => p,
            Some(placed) => p.sub(in_every_lane(simd, placed.position)),
        }
    }

    /// How far each ray reaches along the sensor's axis.
    #[inline(always)]
    pub(super) fn depth<S: Simd>(&self, simd: S, ray: Vec3<S>) -> S::f32s {
        match &self.0 {
            None => ray.z,
            Some(placed) => ray.dot(in_every_lane(simd, placed.axes[2])),
        }
    }

    /// The tangents of the plane across n that [`tangents`] finds in the sensor's frame: which monomials are dropped
    /// (section 6) must not depend on the cloud's.
    #[inline(always)]
    pub(super) fn tangents<S: Simd>(&self, simd: S, n: Vec3<S>) -> [Vec3<S>; 2] {
        let Some(placed) = &self.0 else {
            let (u, v) = tangents(simd, n);
            return [u, v];
        };
        let [x, y, z] = placed.axes;
        let (x, y, z) = (in_every_lane(simd, x), in_every_lane(simd, y), in_every_lane(simd, z));
        let (u, v) = tangents(simd, Vec3::new(n.dot(x), n.dot(y), n.dot(z)));
        [along(x, y, z, u), along(x, y, z, v)]
    }
}

/// A vector given along three axes.
#[inline(always)]
fn along<S: Simd>(x: Vec3<S>, y: Vec3<S>, z: Vec3<S>, v: Vec3<S>) -> Vec3<S> {
    x.scale(v.x).add_scaled(v.y, y).add_scaled(v.z, z)
}

#[inline(always)]
fn in_every_lane<S: Simd>(simd: S, [x, y, z]: [f32; 3]) -> Vec3<S> {
    Vec3::new(splat(simd, x), splat(simd, y), splat(simd, z))
}
