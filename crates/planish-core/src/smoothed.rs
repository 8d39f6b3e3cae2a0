//! The result of smoothing: one entry for each pixel or point of the input, in the same order.

use crate::camera::{Camera, Rays};
use crate::cloud::{AttributeValues, PointCloud};
use crate::constants::GRAZING_COSINE;
use crate::doubts::doubt_about_lens;
use crate::error::FrameError;
use crate::frame::{DepthImage, Frame};
use crate::outputs::{Outputs, SmoothedMut};
use crate::status::Status;
use crate::threads::ONE_THREAD;
use crate::xyz::Xyz;

/// Smoothed points and the requested outputs. Reuse one value for all frames to avoid reallocating its buffers.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Smoothed {
    /// Width in pixels; the number of points for an unorganized cloud.
    pub width: usize,
    /// Height in pixels; 1 for an unorganized cloud.
    pub height: usize,
    /// The points in metres, NaN for holes; empty if they were not requested.
    pub points: Xyz,
    /// Raw depth values of the smoothed surface, 0 for holes.
    pub depth: Option<Vec<u16>>,
    /// Depth of the smoothed surface in metres, NaN for holes.
    pub depth_m: Option<Vec<f32>>,
    /// Unit normals that point towards the sensor; NaN for pixels without a plane.
    pub normals: Option<Xyz>,
    /// Surface variation l0/(l0+l1+l2), 0 to 1/3; NaN for pixels without a plane.
    pub curvature: Option<Vec<f32>>,
    /// The status of each pixel.
    pub status: Option<Vec<Status>>,
    /// Number of neighbours, including the point's own sample if it is within the radius; 0 for holes of the input.
    /// Pixels that share a surface also share its number of neighbours.
    pub neighbours: Option<Vec<u32>>,
    /// Effective number of frames of a video averaged into each pixel, 1 to 16; 0 for holes.
    pub frames: Option<Vec<f32>>,
    /// Standard error of each position along its ray in metres; NaN for holes.
    pub sigma: Option<Vec<f32>>,
}

/// Share of lost points above which a frame causes a warning.
const LOST_SHARE_TOLD: f64 = 0.01;

impl Smoothed {
    /// Returns a warning if the frame lost more than 1 % of its points.
    pub fn lost_points_warning(&self, frame: Frame<'_>) -> Option<String> {
        let (lost, valid) = (self.lost_points(frame), frame.valid_points());
        (lost as f64 > LOST_SHARE_TOLD * valid as f64).then(|| {
            if let Some(doubt) = frame.camera().filter(|_| !ONE_THREAD).and_then(doubt_about_lens) {
                return doubt.to_string();
            }
            if !ONE_THREAD && let Some(text) = self.beyond_depth(frame, lost) {
                return text;
            }
            format!(
                "{lost} of {valid} valid points of a frame became holes: they have fewer than 3 neighbours within the \
                 radius; use a larger radius, or give the sensor's pose if it is missing"
            )
        })
    }

    /// Returns a warning if most lost points of a cloud are outside the range of the output `depth`.
    fn beyond_depth(&self, frame: Frame<'_>, lost: usize) -> Option<String> {
        let (Frame::Points(points), Some(camera), true) = (frame, frame.camera(), self.depth.is_some()) else {
            return None;
        };
        let is_beyond = |z: f32| z.is_finite() && camera.raw_depth(z) == 0;
        let beyond = (0..points.len()).filter(|&i| is_beyond(points.get(i)[2] as f32)).count();
        let units = camera.depth_units_per_metre;
        let text = || {
            format!(
                "{beyond} points of a frame became holes: their depth is not within 1 to 65534 units of 1/{units} m"
            )
        };
        (2 * beyond >= lost).then(text)
    }

    /// Resizes all buffers, allocating only if the shape or the outputs changed.
    pub fn prepare(&mut self, width: usize, height: usize, outputs: Outputs) {
        let len = width * height;
        (self.width, self.height) = (width, height);
        self.points.resize(if outputs.points { len } else { 0 }, 0.0);
        keep(&mut self.depth, outputs.depth, |values| values.resize(len, 0));
        keep(&mut self.depth_m, outputs.depth_m, |values| values.resize(len, 0.0));
        keep(&mut self.normals, outputs.normals, |normals| normals.resize(len, 0.0));
        keep(&mut self.curvature, outputs.curvature, |values| values.resize(len, 0.0));
        keep(&mut self.status, outputs.status, |values| values.resize(len, Status::Hole));
        keep(&mut self.neighbours, outputs.neighbours, |values| values.resize(len, 0));
        keep(&mut self.frames, outputs.frames, |values| values.resize(len, 0.0));
        if !ONE_THREAD {
            keep(&mut self.sigma, outputs.sigma, |values| values.resize(len, 0.0));
        }
    }

    /// Returns the allocated size of the buffers in bytes.
    pub fn bytes(&self) -> usize {
        self.points.bytes()
            + self.normals.as_ref().map_or(0, Xyz::bytes)
            + 4 * self.curvature.as_ref().map_or(0, Vec::capacity)
            + self.status.as_ref().map_or(0, Vec::capacity)
            + 4 * self.neighbours.as_ref().map_or(0, Vec::capacity)
            + 2 * self.depth.as_ref().map_or(0, Vec::capacity)
            + 4 * self.depth_m.as_ref().map_or(0, Vec::capacity)
            + 4 * self.frames.as_ref().map_or(0, Vec::capacity)
            + 4 * self.sigma.as_ref().map_or(0, Vec::capacity)
    }

    /// Borrows the buffers for writing.
    pub(crate) fn as_mut(&mut self) -> SmoothedMut<'_> {
        SmoothedMut {
            points: (!self.points.is_empty()).then(|| (&mut self.points).into()),
            normals: self.normals.as_mut().map(Into::into),
            curvature: self.curvature.as_deref_mut(),
            status: self.status.as_deref_mut(),
            neighbours: self.neighbours.as_deref_mut(),
            depth: self.depth.as_deref_mut(),
            depth_m: self.depth_m.as_deref_mut(),
            frames: self.frames.as_deref_mut(),
            sigma: self.sigma.as_deref_mut(),
        }
    }

    /// Returns the number of valid points of the frame that became holes; 0 if the result has no status, points or
    /// depth that could show holes.
    pub fn lost_points(&self, frame: Frame<'_>) -> usize {
        if let Some(counts) = self.status_counts() {
            return counts[Status::TooFew as usize];
        }
        let finite = |values: &[f32]| values.iter().filter(|value| value.is_finite()).count();
        let left = match (&self.depth, &self.depth_m) {
            // A hole has no finite coordinate, so z suffices.
            _ if !self.points.is_empty() => finite(self.points.z()),
            (_, Some(depth_m)) => finite(depth_m),
            (Some(depth), None) => depth.iter().filter(|raw| **raw != 0).count(),
            (None, None) => return 0,
        };
        frame.valid_points().saturating_sub(left)
    }

    /// Returns the number of points that the output `depth` cannot store, and a note on them; `None` if there are none,
    /// or without status or depth. Such points are nearer than 1 or farther than 65534 of the camera's depth units.
    pub fn out_of_depth(&self, camera: &Camera) -> Option<(usize, String)> {
        let (status, depth) = (self.status.as_ref()?, self.depth.as_ref()?);
        let lost = status.iter().zip(depth).filter(|(status, raw)| status.has_point() && **raw == 0).count();
        let units = camera.depth_units_per_metre;
        let text = || format!("{lost} pixels became holes: their depth is not within 1 to 65534 units of 1/{units} m");
        (lost > 0).then(|| (lost, text()))
    }

    /// Returns the number of pixels with each status, in the order of [`Status::ALL`]; `None` if status was not
    /// requested.
    pub fn status_counts(&self) -> Option<[usize; Status::ALL.len()]> {
        let mut counts = [0; Status::ALL.len()];
        for &status in self.status.as_ref()? {
            counts[status as usize] += 1;
        }
        Some(counts)
    }

    /// Returns true if at least one hole was filled; false if the status was not requested.
    pub fn has_filled(&self) -> bool {
        self.status.as_ref().is_some_and(|status| status.contains(&Status::Filled))
    }

    /// Returns a mask with the origin of each pixel's value, encoded by
    /// [`Origin::mask_value`](crate::Origin::mask_value); `None` if the status was not requested.
    pub fn origin_mask(&self) -> Option<Vec<u8>> {
        Some(self.status.as_ref()?.iter().map(|status| status.origin().mask_value()).collect())
    }

    /// Returns the smoothed surface as a depth image, as the camera would have measured it (docs/method.md, section 7).
    ///
    /// Request normals from the smoother: without them, the depth of each pixel is the z of its point, which is
    /// inaccurate on slanted surfaces. The result must be in the camera's frame. For a cloud with another pose,
    /// request depth from the smoother instead.
    pub fn to_depth(&self, camera: &Camera) -> Result<DepthImage, FrameError> {
        let raw = self.to_depth_m(camera)?.into_iter().map(|depth_m| camera.raw_depth(depth_m)).collect();
        Ok(DepthImage { width: self.width, height: self.height, raw })
    }

    /// Same as [`Smoothed::to_depth`], but in metres, with NaN for holes.
    ///
    /// With [`Project::Normal`](crate::Project::Normal), a smoothed point leaves the ray of its pixel. The depth is
    /// measured where this ray meets the tangent plane of the point. If the ray grazes the plane, or the normal is
    /// missing, the depth is the point's z.
    pub fn to_depth_m(&self, camera: &Camera) -> Result<Vec<f32>, FrameError> {
        camera.check_shape((self.width, self.height))?;
        self.points.check_len("the smoothed points", self.width * self.height)?;
        let mut rays = Rays::default();
        rays.set(camera);
        let depth_m = |i: usize| {
            let point = self.points.get(i);
            match &self.normals {
                Some(normals) => depth_along_ray_m(rays.at(i % self.width, i / self.width), point, normals.get(i)),
                None => point[2],
            }
        };
        Ok((0..self.points.len()).map(depth_m).collect())
    }
}

impl Smoothed {
    /// Returns the available outputs among `fields`, with the names of their fields in clouds.
    pub fn fields(&self, fields: Outputs) -> Vec<(&'static str, AttributeValues)> {
        let normals = self.normals.as_ref().map(Xyz::as_slices);
        named_fields(
            fields,
            normals,
            self.curvature.as_deref(),
            self.status.as_deref(),
            self.neighbours.as_deref(),
            [self.frames.as_deref(), self.sigma.as_deref()],
        )
    }
}

/// Returns the available outputs among `fields`, with the names of their fields in clouds.
pub fn named_fields(
    fields: Outputs,
    normals: Option<[&[f32]; 3]>,
    curvature: Option<&[f32]>,
    status: Option<&[Status]>,
    neighbours: Option<&[u32]>,
    [frames, sigma]: [Option<&[f32]>; 2],
) -> Vec<(&'static str, AttributeValues)> {
    let mut found: Vec<(&'static str, AttributeValues)> = Vec::new();
    if let Some(normals) = normals.filter(|_| fields.normals) {
        found.extend(["normal_x", "normal_y", "normal_z"].into_iter().zip(normals.map(|axis| axis.to_vec().into())));
    }
    if let Some(curvature) = curvature.filter(|_| fields.curvature) {
        found.push(("curvature", curvature.to_vec().into()));
    }
    if let Some(status) = status.filter(|_| fields.status) {
        found.push(("status", status.iter().map(|&s| s as u8).collect::<Vec<u8>>().into()));
    }
    if let Some(neighbours) = neighbours.filter(|_| fields.neighbours) {
        found.push(("neighbours", neighbours.to_vec().into()));
    }
    if let Some(frames) = frames.filter(|_| fields.frames && !ONE_THREAD) {
        found.push(("frames", frames.to_vec().into()));
    }
    if let Some(sigma) = sigma.filter(|_| fields.sigma && !ONE_THREAD) {
        found.push(("sigma", sigma.to_vec().into()));
    }
    found
}

/// Returns the depth at which a ray meets the tangent plane of a point; at grazing incidence, or without a normal, the
/// point's depth.
#[inline(always)]
pub(crate) fn depth_along_ray_m([ray_x, ray_y]: [f32; 2], [x, y, z]: [f32; 3], [nx, ny, nz]: [f32; 3]) -> f32 {
    let along = ray_x * nx + ray_y * ny + nz;
    let ray_length = (ray_x * ray_x + ray_y * ray_y + 1.0).sqrt();
    // Also false for a NaN normal.
    if along.abs() > GRAZING_COSINE * ray_length { (x * nx + y * ny + z * nz) / along } else { z }
}

/// Fields that become stale when points move: PCL's names for normals and curvature.
const OF_SURFACE: [&str; 4] = ["normal_x", "normal_y", "normal_z", "curvature"];

impl Outputs {
    /// Adds normals and curvature if the cloud has such fields, whose values become stale when its points move.
    pub fn renewing(self, cloud: &PointCloud) -> Self {
        let has = |name: &str| cloud.attribute(name).is_some();
        let [x, y, z, curvature] = OF_SURFACE.map(has);
        self.with_normals(self.normals || (x && y && z)).with_curvature(self.curvature || curvature)
    }
}

impl PointCloud {
    /// Replaces the positions by the result and adds the available outputs among `fields`: `normal_x`, `normal_y`,
    /// `normal_z`, `curvature` (PCL's names), `status`, `neighbours`, `frames` and `sigma`. All other fields are kept,
    /// except normals and curvature. Values computed for the measured points are wrong for the moved points, so they
    /// are removed unless replaced ([`Outputs::renewing`]). Status is always added if holes were filled. In a file of
    /// several scans, normals face the scanner of each point.
    pub fn apply(&mut self, smoothed: &Smoothed, fields: Outputs) -> Result<(), FrameError> {
        smoothed.points.check_len("the smoothed points", self.len())?;
        let fields = fields.with_status(fields.status || (!ONE_THREAD && smoothed.has_filled()));
        self.positions.clone_from(&smoothed.points);
        let renewed = smoothed.fields(fields);
        // The browser's page always computes normals.
        if !ONE_THREAD {
            let is_stale = |name: &str| OF_SURFACE.contains(&name) && renewed.iter().all(|(other, _)| *other != name);
            self.attributes.retain(|attribute| !is_stale(&attribute.name));
        }
        for (name, values) in renewed {
            self.set_attribute(name, values);
        }
        if smoothed.normals.is_some() && fields.normals {
            self.face_scanners();
        }
        Ok(())
    }
}

fn keep<T: Default>(output: &mut Option<T>, wanted: bool, resize: impl FnOnce(&mut T)) {
    if wanted {
        resize(output.get_or_insert_default());
    } else {
        *output = None;
    }
}
