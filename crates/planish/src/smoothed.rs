//! The result of smoothing: one entry for each pixel or point of the input, in its order.

use crate::camera::Camera;
use crate::cloud::Xyz;
use crate::error::FrameError;
use crate::frame::DepthImage;

/// What became of a pixel (docs/method.md, section 7).
#[repr(u8)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Status {
    /// No measurement came in, none goes out.
    #[default]
    Hole = 0,
    /// Fewer than 3 neighbours: the output is a hole.
    TooFew = 1,
    /// The neighbours lie on a line: the point stays as measured and has no normal.
    Degenerate = 2,
    /// The foot of the point on the plane.
    Plane = 3,
    /// On a polynomial of degree 2.
    Polynomial2 = 4,
    /// On a polynomial of degree 3.
    Polynomial3 = 5,
}

impl Status {
    /// Every status, in the order of their codes.
    pub const ALL: [Self; 6] =
        [Self::Hole, Self::TooFew, Self::Degenerate, Self::Plane, Self::Polynomial2, Self::Polynomial3];

    /// Whether the output has a finite point.
    pub fn has_point(self) -> bool {
        self >= Self::Degenerate
    }

    /// Whether the output has a normal and a curvature.
    pub fn has_normal(self) -> bool {
        self >= Self::Plane
    }

    /// The status of a point that was put on a polynomial of that degree.
    pub fn of_degree(degree: u32) -> Self {
        match degree {
            3 => Self::Polynomial3,
            2 => Self::Polynomial2,
            _ => Self::Plane,
        }
    }
}

impl PartialOrd for Status {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Status {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (*self as u8).cmp(&(*other as u8))
    }
}

/// Which results are wanted; each costs a little time and memory, and on a GPU its share of the way back.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Outputs {
    /// The smoothed points.
    pub points: bool,
    /// The smoothed surface as raw depth values (docs/method.md, section 7); the frame's camera must be known.
    pub depth: bool,
    /// Unit normals, towards the sensor.
    pub normals: bool,
    /// Surface variation l0/(l0+l1+l2), as PCL has it.
    pub curvature: bool,
    /// What became of each pixel.
    pub status: bool,
    /// How many neighbours each pixel had.
    pub neighbours: bool,
}

impl Outputs {
    /// Points and nothing else.
    pub const POINTS: Self =
        Self { points: true, depth: false, normals: false, curvature: false, status: false, neighbours: false };
    /// Depth and nothing else.
    pub const DEPTH: Self = Self { points: false, depth: true, ..Self::POINTS };
    /// Everything that every frame has: all but depth, which needs a camera.
    pub const ALL: Self = Self { normals: true, curvature: true, status: true, neighbours: true, ..Self::POINTS };
}

impl Default for Outputs {
    /// Points and nothing else.
    fn default() -> Self {
        Self::POINTS
    }
}

/// Smoothed points and what was asked for beside them. Reuse one for all frames: its buffers are kept.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Smoothed {
    /// Width in pixels; the number of points for a general cloud.
    pub width: usize,
    /// Height in pixels; 1 for a general cloud.
    pub height: usize,
    /// The points in metres, NaN for holes; empty if they were not asked for.
    pub points: Xyz,
    /// Raw depth values of the smoothed surface, 0 for holes.
    pub depth: Option<Vec<u16>>,
    /// Unit normals towards the sensor; NaN where there is none.
    pub normals: Option<Xyz>,
    /// Surface variation l0/(l0+l1+l2), 0 to 1/3; NaN where there is no plane.
    pub curvature: Option<Vec<f32>>,
    /// What became of each pixel.
    pub status: Option<Vec<Status>>,
    /// Number of neighbours, the point itself included; 0 for holes.
    pub neighbours: Option<Vec<u32>>,
}

impl Smoothed {
    /// Gives every buffer its length, allocating only if the shape or the outputs changed.
    pub(crate) fn prepare(&mut self, width: usize, height: usize, outputs: Outputs) {
        let len = width * height;
        (self.width, self.height) = (width, height);
        resize(&mut self.points, if outputs.points { len } else { 0 });
        keep(&mut self.depth, outputs.depth, |values| values.resize(len, 0));
        keep(&mut self.normals, outputs.normals, |normals| resize(normals, len));
        keep(&mut self.curvature, outputs.curvature, |values| values.resize(len, 0.0));
        keep(&mut self.status, outputs.status, |values| values.resize(len, Status::Hole));
        keep(&mut self.neighbours, outputs.neighbours, |values| values.resize(len, 0));
    }

    /// Takes the outputs that are wanted over from a result with points and normals, leaving buffers to reuse, and makes the
    /// depth from them if that is wanted.
    pub(crate) fn take_over(
        &mut self,
        from: &mut Self,
        outputs: Outputs,
        camera: Option<&Camera>,
    ) -> Result<(), FrameError> {
        self.prepare(from.width, from.height, outputs);
        if outputs.depth {
            let camera = camera.ok_or(FrameError::MissingCamera { what: "depth as an output" })?;
            let depth_m = from.to_depth_m(camera)?;
            for (raw, depth_m) in self.depth.iter_mut().flatten().zip(depth_m) {
                *raw = camera.raw_depth(depth_m);
            }
        }
        if outputs.points {
            std::mem::swap(&mut self.points, &mut from.points);
        }
        if outputs.normals {
            std::mem::swap(&mut self.normals, &mut from.normals);
        }
        std::mem::swap(&mut self.curvature, &mut from.curvature);
        std::mem::swap(&mut self.status, &mut from.status);
        std::mem::swap(&mut self.neighbours, &mut from.neighbours);
        Ok(())
    }

    /// How many pixels have each status, in the order of [`Status::ALL`]; `None` if the status was not asked for.
    pub fn status_counts(&self) -> Option<[usize; 6]> {
        let mut counts = [0; 6];
        for &status in self.status.as_ref()? {
            counts[status as usize] += 1;
        }
        Some(counts)
    }

    /// The smoothed surface as a depth image: what the camera would have measured (docs/method.md, section 7).
    ///
    /// Ask for normals: without them the depths are the points' own, which are off on slanted surfaces.
    pub fn to_depth(&self, camera: &Camera) -> Result<DepthImage, FrameError> {
        let raw = self.to_depth_m(camera)?.into_iter().map(|depth_m| camera.raw_depth(depth_m)).collect();
        Ok(DepthImage { width: self.width, height: self.height, raw })
    }

    /// [`Smoothed::to_depth`] in metres, NaN for holes.
    ///
    /// A smoothed point moves along its normal and so leaves the ray of its pixel. The depth is taken where that ray meets
    /// the tangent plane of the point; where the ray grazes the plane, or the normal is missing, it is the point's own z.
    pub fn to_depth_m(&self, camera: &Camera) -> Result<Vec<f32>, FrameError> {
        if (camera.width, camera.height) != (self.width, self.height) {
            return Err(FrameError::ShapeMismatch {
                frame_width: self.width,
                frame_height: self.height,
                width: camera.width,
                height: camera.height,
            });
        }
        self.points.check_len("the smoothed points", self.width * self.height)?;
        let (rays_x, rays_y) = (camera.rays_x(), camera.rays_y());
        let depth_m = |i: usize| {
            let [x, y, z] = self.points.get(i);
            let Some(normals) = &self.normals else { return z };
            let [nx, ny, nz] = normals.get(i);
            let (ray_x, ray_y) = (rays_x[i % self.width], rays_y[i / self.width]);
            let along = ray_x * nx + ray_y * ny + nz;
            let ray_length = (ray_x * ray_x + ray_y * ray_y + 1.0).sqrt();
            // Also false for a NaN normal.
            if along.abs() > GRAZING_COSINE * ray_length { (x * nx + y * ny + z * nz) / along } else { z }
        };
        Ok((0..self.points.len()).map(depth_m).collect())
    }
}

/// Below this cosine of the angle of incidence (over 78°) the tangent plane tells less than the point itself.
pub(crate) const GRAZING_COSINE: f32 = 0.2;

fn resize(planes: &mut Xyz, len: usize) {
    for plane in [&mut planes.x, &mut planes.y, &mut planes.z] {
        plane.resize(len, 0.0);
    }
}

fn keep<T: Default>(output: &mut Option<T>, wanted: bool, resize: impl FnOnce(&mut T)) {
    if wanted {
        resize(output.get_or_insert_default());
    } else {
        *output = None;
    }
}
