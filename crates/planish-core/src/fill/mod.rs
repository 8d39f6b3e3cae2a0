//! Fills the holes of a frame with the surface around them (docs/method.md, section 18).

pub(crate) mod constants;
mod distances;
mod image;
mod labels;
mod pixel;
mod solid;

use rayon::prelude::*;

use crate::camera::{Camera, Rays};
use crate::error::ParamError;
use crate::frame::{Frame, FrameGeometry, RangeRule};
use crate::pose::RigidTransform;
use crate::sensor::SensorModel;
use crate::smoothed::Smoothed;
use crate::status::Status;
use crate::threads::Threads;
use distances::Distances;
use image::Image;
use labels::Labels;
use pixel::{Holes, Patch};
use solid::{keep_whole_holes, make_solid};

/// Maximum width of a hole that can be filled, in pixels.
pub(crate) const MOST_PX: u32 = 64;

/// Returns an error if the maximum width of a hole is out of range.
pub(crate) fn check_width(width_px: Option<u32>) -> Result<(), ParamError> {
    match width_px {
        Some(width_px) if !(1..=MOST_PX).contains(&width_px) => {
            Err(ParamError { field: "fill", value: width_px.to_string(), allowed: "1 to 64 pixels" })
        }
        _ => Ok(()),
    }
}

/// Settings and input for filling the holes of one frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Fill<'a> {
    /// Maximum width of holes to fill, in pixels.
    pub(crate) width_px: u32,
    pub(crate) geometry: FrameGeometry,
    pub(crate) sensor: SensorModel,
    /// The measured frame. If its camera is unknown, the camera is estimated from the points.
    pub(crate) frame: Frame<'a>,
}

/// Buffers that are reused from frame to frame.
#[derive(Default)]
pub(crate) struct FillBuffers {
    /// 1/z of each point in camera coordinates; 0 for holes.
    inverse: Vec<f32>,
    /// 1/z of measurements that smoothing has turned into holes; 0 for other pixels.
    lost: Vec<f32>,
    distances: Distances,
    labels: Labels,
    rays: Rays,
    rows: Vec<Vec<Patch>>,
}

impl Fill<'_> {
    /// Fills the holes in all outputs of a result that includes points and status. Returns false, without changes, if
    /// the points do not match the pixels of a camera.
    pub(crate) fn apply(&self, smoothed: &mut Smoothed, buffers: &mut FillBuffers, threads: &Threads) -> bool {
        threads.install(|| match self.find(smoothed, buffers) {
            Some(camera) => {
                self.write(&camera, smoothed, buffers);
                true
            }
            // A frame without points does not determine a camera and cannot be filled, which is not a failure.
            None => smoothed.points.z().iter().all(|z| z.is_nan()),
        })
    }

    /// Finds the pixels to fill, and returns the camera; `None` if the camera is unknown.
    fn find(&self, smoothed: &Smoothed, buffers: &mut FillBuffers) -> Option<Camera> {
        let shape @ (width, height) = (smoothed.width, smoothed.height);
        let FillBuffers { inverse, lost, distances, labels, rays, rows } = buffers;
        let status = smoothed.status.as_ref()?;
        if !matches!(self.geometry.rule, RangeRule::Depth { .. }) {
            return None;
        }
        let transform = self.geometry.cloud_from_sensor;
        let in_sensor = |i: usize, transform: &RigidTransform| {
            transform.to_sensor(glam::Vec3::from_array(smoothed.points.get(i)).as_dvec3()).as_vec3()
        };
        let of_points = || match &transform {
            None => Camera::of_points(shape, &smoothed.points),
            Some(transform) => {
                let points = (0..width * height).map(|i| in_sensor(i, transform).to_array()).collect();
                Camera::of_points(shape, &points)
            }
        };
        let camera = self.frame.camera().copied().or_else(of_points)?;
        rays.set(&camera);
        inverse.resize(width * height, 0.0);
        inverse.par_chunks_mut(width).enumerate().for_each(|(v, inverse)| {
            for (u, inverse) in inverse.iter_mut().enumerate() {
                let i = v * width + u;
                let z_m = transform.as_ref().map_or(smoothed.points.z()[i], |transform| in_sensor(i, transform).z);
                *inverse = if status[i].has_point() && z_m > 0.0 { z_m.recip() } else { 0.0 };
            }
        });
        let shift = self.sensor.baseline_m().map(|baseline_m| baseline_m * camera.fx);
        lost.resize(width * height, 0.0);
        lost.par_chunks_mut(width).enumerate().for_each(|(v, lost)| {
            for (u, lost) in lost.iter_mut().enumerate() {
                let is_lost = status[v * width + u] == Status::TooFew;
                *lost = if is_lost { self.measured_inverse((u, v), width) } else { 0.0 };
            }
        });
        let extent = inverse.par_chunks(width).map(extent_of).reduce(|| NO_EXTENT, join_extents);
        let image = Image { inverse, shape, sensor: self.sensor };
        rayon::join(|| labels.find(&image), || distances.find(inverse, shape));
        let mut holes = Holes {
            image,
            distances,
            most_px: self.width_px as usize,
            shadow: None,
            colours: self.frame.colours(),
            sigma_m: smoothed.sigma.as_deref(),
            extent,
            lost,
        };
        holes.shadow = shift.and_then(|shift| holes.find_shadow(shift));
        let of_row = |v: usize| labels.columns(v).filter_map(|u| holes.fill((u, v), labels)).collect();
        *rows = (0..height).into_par_iter().map(of_row).collect();
        keep_whole_holes(rows, labels);
        make_solid(&holes, rows);
        Some(camera)
    }

    /// Returns 1/z of a pixel as it was measured; 0 for a hole.
    fn measured_inverse(&self, (u, v): (usize, usize), width: usize) -> f32 {
        let z_m = match self.frame {
            Frame::Depth(depth) => depth.depth_m(u, v),
            Frame::Points(points) => points.point_in_sensor(v * width + u, &self.geometry).z as f32,
        };
        if z_m > 0.0 { z_m.recip() } else { 0.0 }
    }

    /// Writes the filled pixels into every output.
    fn write(&self, camera: &Camera, smoothed: &mut Smoothed, buffers: &FillBuffers) {
        let width = smoothed.width;
        for (v, patch) in buffers.rows.iter().enumerate().flat_map(|(v, row)| row.iter().map(move |patch| (v, patch))) {
            let (u, i) = (patch.u, v * width + patch.u);
            let [ray_x, ray_y] = buffers.rays.at(u, v).map(f64::from);
            let z_m = patch.inverse.recip();
            let point = z_m * glam::DVec3::new(ray_x, ray_y, 1.0);
            // Over the pixels of a plane, 1/z is linear; its slopes determine the plane's equation.
            let [x, y] = [patch.slopes[0] * camera.fx, patch.slopes[1] * camera.fy];
            let normal = -glam::DVec3::new(x, y, patch.inverse - x * ray_x - y * ray_y).normalize_or_zero();
            let transform = self.geometry.cloud_from_sensor;
            // Skip depths outside the range of raw depth.
            if smoothed.depth.is_some() && camera.raw_depth(z_m as f32) == 0 {
                continue;
            }
            let moved = transform.map_or(point, |transform| transform.to_cloud(point));
            let turned = transform.map_or(normal, |transform| transform.rotation * normal);
            smoothed.points.set(i, moved.as_vec3().to_array());
            if let Some(status) = &mut smoothed.status {
                status[i] = Status::Filled;
            }
            if let Some(depth) = &mut smoothed.depth {
                depth[i] = camera.raw_depth(z_m as f32);
            }
            if let Some(depth_m) = &mut smoothed.depth_m {
                depth_m[i] = z_m as f32;
            }
            if let Some(normals) = &mut smoothed.normals {
                normals.set(i, turned.as_vec3().to_array());
            }
            if let Some(curvature) = &mut smoothed.curvature {
                let known = patch.rims().map(|rim| curvature[rim]).filter(|value| value.is_finite());
                let (sum, count) = known.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0f32));
                curvature[i] = sum / count;
            }
            if let Some(neighbours) = &mut smoothed.neighbours {
                neighbours[i] = patch.samples;
            }
            if let Some(sigma) = &mut smoothed.sigma {
                sigma[i] = patch.sigma_m as f32;
            }
        }
    }
}

/// The smallest and the largest 1/z of an empty set of points.
const NO_EXTENT: [f32; 2] = [f32::INFINITY, 0.0];

/// Returns the smallest and the largest 1/z of a row.
fn extent_of(row: &[f32]) -> [f32; 2] {
    // Eight separate extents let the loop vectorize.
    let (mut least, mut most) = ([f32::INFINITY; 8], [0.0f32; 8]);
    for part in row.chunks(8) {
        for (k, inverse) in part.iter().enumerate() {
            least[k] = if *inverse > 0.0 { least[k].min(*inverse) } else { least[k] };
            most[k] = most[k].max(*inverse);
        }
    }
    (0..8).map(|k| [least[k], most[k]]).fold(NO_EXTENT, join_extents)
}

fn join_extents(a: [f32; 2], b: [f32; 2]) -> [f32; 2] {
    [a[0].min(b[0]), a[1].max(b[1])]
}
