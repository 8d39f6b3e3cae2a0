//! Outputs of a smoother, and the caller's buffers for them.

use crate::error::{FrameError, ParamError};
use crate::frame::PointsView;
use crate::smoothed::Smoothed;
use crate::status::Status;
use crate::strided::StridedMut;
use crate::threads::ONE_THREAD;
use crate::xyz::Xyz;

/// The outputs to compute. Each output costs time and memory, and on a GPU also a transfer to the host.
///
/// ```
/// use planish::Outputs;
///
/// let outputs = Outputs::POINTS.with_normals(true);
/// assert!(outputs.points && outputs.normals && !outputs.depth);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub struct Outputs {
    /// The smoothed points.
    pub points: bool,
    /// Raw depth values of the smoothed surface (docs/method.md, section 7); requires a known camera.
    pub depth: bool,
    /// Depth of the smoothed surface in metres, as precise as the points.
    pub depth_m: bool,
    /// Unit normals that point towards the sensor.
    pub normals: bool,
    /// Surface variation l0/(l0+l1+l2), as PCL defines it.
    pub curvature: bool,
    /// The status of each pixel.
    pub status: bool,
    /// The number of neighbours of each pixel.
    pub neighbours: bool,
    /// Effective number of frames of a video averaged into each pixel. Available only from a
    /// [`Session`](crate::Session) that smooths over time ([`Settings::temporal`](crate::Settings::temporal)).
    pub frames: bool,
    /// Standard error of each smoothed position along its ray, in metres. Available only for frames on a grid, from a
    /// [`Session`](crate::Session) (docs/method.md, section 17).
    pub sigma: bool,
}

impl Outputs {
    /// No output.
    pub(crate) const NONE: Self = Self {
        points: false,
        depth: false,
        depth_m: false,
        normals: false,
        curvature: false,
        status: false,
        neighbours: false,
        frames: false,
        sigma: false,
    };
    /// Points only.
    pub const POINTS: Self = Self { points: true, ..Self::NONE };
    /// Depth only.
    pub const DEPTH: Self = Self { depth: true, ..Self::NONE };
    /// All outputs except `depth` and `depth_m`, which need a camera, `frames`, which needs a video, and `sigma`, which
    /// needs a session.
    pub const ALL: Self =
        Self { points: true, normals: true, curvature: true, status: true, neighbours: true, ..Self::NONE };

    /// Sets whether points are computed.
    pub const fn with_points(self, points: bool) -> Self {
        Self { points, ..self }
    }

    /// Sets whether raw depth is computed.
    pub const fn with_depth(self, depth: bool) -> Self {
        Self { depth, ..self }
    }

    /// Sets whether depth in metres is computed.
    pub const fn with_depth_m(self, depth_m: bool) -> Self {
        Self { depth_m, ..self }
    }

    /// Returns true if an output requires a known camera.
    pub fn needs_camera(self) -> bool {
        self.depth || self.depth_m
    }

    /// Sets whether normals are computed.
    pub const fn with_normals(self, normals: bool) -> Self {
        Self { normals, ..self }
    }

    /// Sets whether curvature is computed.
    pub const fn with_curvature(self, curvature: bool) -> Self {
        Self { curvature, ..self }
    }

    /// Sets whether the status is computed.
    pub const fn with_status(self, status: bool) -> Self {
        Self { status, ..self }
    }

    /// Sets whether neighbours are counted.
    pub const fn with_neighbours(self, neighbours: bool) -> Self {
        Self { neighbours, ..self }
    }

    /// Sets whether the number of frames averaged per pixel is returned.
    pub const fn with_frames(self, frames: bool) -> Self {
        Self { frames, ..self }
    }

    /// Sets whether the standard error of each position is computed.
    pub const fn with_sigma(self, sigma: bool) -> Self {
        Self { sigma, ..self }
    }

    /// Adds the output with this name; `None` for an unknown name.
    pub(crate) fn with_named(self, name: &str) -> Option<Self> {
        Some(match name {
            "points" => self.with_points(true),
            "depth" => self.with_depth(true),
            "depth_m" => self.with_depth_m(true),
            "normals" => self.with_normals(true),
            "curvature" => self.with_curvature(true),
            "status" => self.with_status(true),
            "neighbours" => self.with_neighbours(true),
            "frames" if !ONE_THREAD => self.with_frames(true),
            // WebAssembly builds omit sigma.
            "sigma" if !ONE_THREAD => self.with_sigma(true),
            _ => return None,
        })
    }

    /// Returns the names of these outputs.
    pub fn names(self) -> Vec<&'static str> {
        let Self { points, depth, depth_m, normals, curvature, status, neighbours, frames, sigma } = self;
        let all = [
            ("points", points),
            ("depth", depth),
            ("depth_m", depth_m),
            ("normals", normals),
            ("curvature", curvature),
            ("status", status),
            ("neighbours", neighbours),
            ("frames", frames),
        ];
        let sigma = (!ONE_THREAD).then_some(("sigma", sigma));
        all.into_iter().chain(sigma).filter(|(_, is_wanted)| *is_wanted).map(|(name, _)| name).collect()
    }

    pub(crate) fn validate(&self) -> Result<(), ParamError> {
        if *self == Self::NONE {
            return Err(ParamError { field: "outputs", value: "none".into(), allowed: "one or more" });
        }
        Ok(())
    }
}

impl Default for Outputs {
    /// Points only.
    fn default() -> Self {
        Self::POINTS
    }
}

/// The caller's buffer for vectors, one per pixel.
#[derive(Debug)]
#[non_exhaustive]
pub enum VectorsMut<'a> {
    /// Separate slices of x, y and z.
    Planes([&'a mut [f32]; 3]),
    /// Interleaved x, y and z.
    Rows(&'a mut [[f32; 3]]),
    /// Interleaved x, y, z and a fourth value that is left unchanged.
    Rows4(&'a mut [[f32; 4]]),
    /// Vectors within larger structs.
    Strided(StridedMut<'a>),
}

impl<'a> VectorsMut<'a> {
    pub(crate) fn reborrow(&mut self) -> VectorsMut<'_> {
        match self {
            Self::Planes([x, y, z]) => VectorsMut::Planes([x, y, z]),
            Self::Rows(rows) => VectorsMut::Rows(rows),
            Self::Rows4(rows) => VectorsMut::Rows4(rows),
            Self::Strided(vectors) => VectorsMut::Strided(vectors.reborrow()),
        }
    }

    /// Splits into the first `at` vectors and the rest.
    pub(crate) fn split_at(self, at: usize) -> (Self, Self) {
        match self {
            Self::Planes([x, y, z]) => {
                let ((x, x_rest), (y, y_rest), (z, z_rest)) =
                    (x.split_at_mut(at), y.split_at_mut(at), z.split_at_mut(at));
                (Self::Planes([x, y, z]), Self::Planes([x_rest, y_rest, z_rest]))
            }
            Self::Rows(rows) => {
                let (rows, rest) = rows.split_at_mut(at);
                (Self::Rows(rows), Self::Rows(rest))
            }
            Self::Rows4(rows) => {
                let (rows, rest) = rows.split_at_mut(at);
                (Self::Rows4(rows), Self::Rows4(rest))
            }
            Self::Strided(vectors) => {
                let (vectors, rest) = vectors.split_at(at);
                (Self::Strided(vectors), Self::Strided(rest))
            }
        }
    }

    /// Sets vector `i`.
    #[inline(always)]
    pub(crate) fn set(&mut self, i: usize, value: [f32; 3]) {
        match self {
            Self::Planes([x, y, z]) => [x[i], y[i], z[i]] = value,
            Self::Rows(rows) => rows[i] = value,
            Self::Rows4(rows) => rows[i][..3].copy_from_slice(&value),
            Self::Strided(vectors) => vectors.set(i, value),
        }
    }

    fn copy_from(&mut self, from: &Xyz) {
        match self {
            Self::Planes(to) => to.iter_mut().zip(from.as_slices()).for_each(|(to, from)| to.copy_from_slice(from)),
            Self::Rows(rows) => rows.iter_mut().zip(from.iter()).for_each(|(row, value)| *row = value),
            Self::Rows4(rows) => {
                rows.iter_mut().zip(from.iter()).for_each(|(row, value)| row[..3].copy_from_slice(&value))
            }
            Self::Strided(vectors) => from.iter().enumerate().for_each(|(i, value)| vectors.set(i, value)),
        }
    }

    fn is_hole(&self, i: usize) -> bool {
        match self {
            Self::Planes([x, _, _]) => x[i].is_nan(),
            Self::Rows(rows) => rows[i][0].is_nan(),
            Self::Rows4(rows) => rows[i][0].is_nan(),
            Self::Strided(vectors) => vectors.get(i)[0].is_nan(),
        }
    }

    fn check_len(&self, what: &str, expected: usize) -> Result<(), FrameError> {
        let lengths = match self {
            Self::Planes([x, y, z]) => [x.len(), y.len(), z.len()],
            Self::Rows(rows) => [rows.len(); 3],
            Self::Rows4(rows) => [rows.len(); 3],
            Self::Strided(vectors) => [vectors.len(); 3],
        };
        check_len(what, lengths.into_iter().find(|&len| len != expected).unwrap_or(expected), expected)
    }
}

impl<'a> From<&'a mut Xyz> for VectorsMut<'a> {
    fn from(vectors: &'a mut Xyz) -> Self {
        Self::Planes(vectors.as_mut_slices())
    }
}

impl<'a> From<[&'a mut [f32]; 3]> for VectorsMut<'a> {
    fn from(planes: [&'a mut [f32]; 3]) -> Self {
        Self::Planes(planes)
    }
}

impl<'a> From<&'a mut [[f32; 3]]> for VectorsMut<'a> {
    fn from(rows: &'a mut [[f32; 3]]) -> Self {
        Self::Rows(rows)
    }
}

impl<'a> From<&'a mut Vec<[f32; 3]>> for VectorsMut<'a> {
    fn from(rows: &'a mut Vec<[f32; 3]>) -> Self {
        Self::Rows(rows)
    }
}

impl<'a> From<&'a mut [[f32; 4]]> for VectorsMut<'a> {
    fn from(rows: &'a mut [[f32; 4]]) -> Self {
        Self::Rows4(rows)
    }
}

impl<'a> From<StridedMut<'a>> for VectorsMut<'a> {
    fn from(vectors: StridedMut<'a>) -> Self {
        Self::Strided(vectors)
    }
}

impl<'a> From<&'a mut Vec<[f32; 4]>> for VectorsMut<'a> {
    fn from(rows: &'a mut Vec<[f32; 4]>) -> Self {
        Self::Rows4(rows)
    }
}

/// The caller's buffers for a result, written once, in the order of the input. Each buffer has one entry per pixel or
/// point, and must be for an output that the smoother was opened for.
///
/// [`Smoothed`](crate::Smoothed) has the same values and owns its buffers.
#[derive(Debug, Default)]
#[non_exhaustive]
pub struct SmoothedMut<'a> {
    /// The points in metres, NaN for holes.
    pub points: Option<VectorsMut<'a>>,
    /// Unit normals that point towards the sensor; NaN for pixels without a plane.
    pub normals: Option<VectorsMut<'a>>,
    /// Surface variation l0/(l0+l1+l2), 0 to 1/3; NaN for pixels without a plane.
    pub curvature: Option<&'a mut [f32]>,
    /// The status of each pixel.
    pub status: Option<&'a mut [Status]>,
    /// Number of neighbours, including the point's own sample if it is within the radius; 0 for holes of the input.
    /// Pixels that share a surface also share its number of neighbours.
    pub neighbours: Option<&'a mut [u32]>,
    /// Raw depth values of the smoothed surface, 0 for holes.
    pub depth: Option<&'a mut [u16]>,
    /// Depth of the smoothed surface in metres, NaN for holes.
    pub depth_m: Option<&'a mut [f32]>,
    /// Effective number of frames of a video averaged into each pixel, 1 to 16; 0 for holes.
    pub frames: Option<&'a mut [f32]>,
    /// Standard error of each position along its ray in metres; NaN for holes.
    pub sigma: Option<&'a mut [f32]>,
}

impl<'a> SmoothedMut<'a> {
    /// Restores points that have too few neighbours from `view` and marks them as isolated, instead of leaving holes.
    pub(crate) fn keep_isolated(&mut self, view: &PointsView<'_>) {
        if let Some(points) = &mut self.points {
            for i in (0..view.len()).filter(|&i| view.point(i).is_finite()) {
                if points.is_hole(i) {
                    points.set(i, view.get(i).map(|value| value as f32));
                }
            }
        }
        for status in self.status.iter_mut().flat_map(|status| status.iter_mut()) {
            if *status == Status::TooFew {
                *status = Status::Isolated;
            }
        }
    }

    /// Fills the first `len` entries of each buffer: entry `i` with entry `place(i)` of another result, or with a hole
    /// if `place(i)` is `None`. Skips depth and sigma, which unorganized clouds do not have.
    pub(crate) fn take_from(&mut self, len: usize, from: &Smoothed, place: impl Fn(usize) -> Option<usize>) {
        for i in 0..len {
            let place = place(i);
            if let Some(points) = &mut self.points {
                points.set(i, place.map_or([f32::NAN; 3], |place| from.points.get(place)));
            }
            if let (Some(to), Some(from)) = (&mut self.normals, &from.normals) {
                to.set(i, place.map_or([f32::NAN; 3], |place| from.get(place)));
            }
            if let (Some(to), Some(from)) = (&mut self.curvature, &from.curvature) {
                to[i] = place.map_or(f32::NAN, |place| from[place]);
            }
            if let (Some(to), Some(from)) = (&mut self.status, &from.status) {
                to[i] = place.map_or(Status::Hole, |place| from[place]);
            }
            if let (Some(to), Some(from)) = (&mut self.neighbours, &from.neighbours) {
                to[i] = place.map_or(0, |place| from[place]);
            }
            if let (Some(to), Some(from)) = (&mut self.frames, &from.frames) {
                to[i] = place.map_or(0.0, |place| from[place]);
            }
        }
    }

    /// Fills all buffers from a result of the same length.
    pub(crate) fn copy_from(&mut self, from: &Smoothed) {
        fn copy<T: Copy>(to: &mut Option<&mut [T]>, from: Option<&[T]>) {
            if let (Some(to), Some(from)) = (to, from) {
                to.copy_from_slice(from);
            }
        }
        if let Some(points) = &mut self.points {
            points.copy_from(&from.points);
        }
        if let (Some(to), Some(from)) = (&mut self.normals, &from.normals) {
            to.copy_from(from);
        }
        copy(&mut self.curvature, from.curvature.as_deref());
        copy(&mut self.status, from.status.as_deref());
        copy(&mut self.neighbours, from.neighbours.as_deref());
        copy(&mut self.depth, from.depth.as_deref());
        copy(&mut self.depth_m, from.depth_m.as_deref());
        copy(&mut self.frames, from.frames.as_deref());
        if !ONE_THREAD {
            copy(&mut self.sigma, from.sigma.as_deref());
        }
    }

    /// Creates a value without buffers.
    pub fn new() -> Self {
        Self::default()
    }

    /// Sets the buffer for points.
    pub fn with_points(self, points: impl Into<VectorsMut<'a>>) -> Self {
        Self { points: Some(points.into()), ..self }
    }

    /// Sets the buffer for normals.
    pub fn with_normals(self, normals: impl Into<VectorsMut<'a>>) -> Self {
        Self { normals: Some(normals.into()), ..self }
    }

    /// Sets the buffer for curvature.
    pub fn with_curvature(self, curvature: &'a mut [f32]) -> Self {
        Self { curvature: Some(curvature), ..self }
    }

    /// Sets the buffer for status.
    pub fn with_status(self, status: &'a mut [Status]) -> Self {
        Self { status: Some(status), ..self }
    }

    /// Sets the buffer for the number of neighbours.
    pub fn with_neighbours(self, neighbours: &'a mut [u32]) -> Self {
        Self { neighbours: Some(neighbours), ..self }
    }

    /// Sets the buffer for raw depth values.
    pub fn with_depth(self, depth: &'a mut [u16]) -> Self {
        Self { depth: Some(depth), ..self }
    }

    /// Sets the buffer for depth in metres.
    pub fn with_depth_m(self, depth_m: &'a mut [f32]) -> Self {
        Self { depth_m: Some(depth_m), ..self }
    }

    /// Sets the buffer for the number of frames averaged per pixel.
    pub fn with_frames(self, frames: &'a mut [f32]) -> Self {
        Self { frames: Some(frames), ..self }
    }

    /// Sets the buffer for the standard error of each position.
    pub fn with_sigma(self, sigma: &'a mut [f32]) -> Self {
        Self { sigma: Some(sigma), ..self }
    }

    /// Borrows the buffers for a shorter time.
    pub fn reborrow(&mut self) -> SmoothedMut<'_> {
        SmoothedMut {
            points: self.points.as_mut().map(VectorsMut::reborrow),
            normals: self.normals.as_mut().map(VectorsMut::reborrow),
            curvature: self.curvature.as_deref_mut(),
            status: self.status.as_deref_mut(),
            neighbours: self.neighbours.as_deref_mut(),
            depth: self.depth.as_deref_mut(),
            depth_m: self.depth_m.as_deref_mut(),
            frames: self.frames.as_deref_mut(),
            sigma: self.sigma.as_deref_mut(),
        }
    }

    /// Refuses buffers whose length is not `len`, and buffers for outputs that the smoother was not opened for.
    pub(crate) fn check(&self, len: usize, outputs: Outputs) -> Result<(), FrameError> {
        let opened = [
            ("points", self.points.is_some(), outputs.points),
            ("normals", self.normals.is_some(), outputs.normals),
            ("curvature", self.curvature.is_some(), outputs.curvature),
            ("status", self.status.is_some(), outputs.status),
            ("neighbours", self.neighbours.is_some(), outputs.neighbours),
            ("depth", self.depth.is_some(), outputs.depth),
            ("depth in metres", self.depth_m.is_some(), outputs.depth_m),
            ("frames", self.frames.is_some(), outputs.frames),
        ];
        // WebAssembly builds omit sigma.
        let sigma = (!ONE_THREAD).then_some(("sigma", self.sigma.is_some(), outputs.sigma));
        if let Some((output, ..)) = opened.into_iter().chain(sigma).find(|(_, given, opened)| *given && !opened) {
            return Err(FrameError::OutputNotOpened { output });
        }
        self.points.as_ref().map_or(Ok(()), |points| points.check_len("the buffer for points", len))?;
        self.normals.as_ref().map_or(Ok(()), |normals| normals.check_len("the buffer for normals", len))?;
        let lengths = [
            ("the buffer for curvature", self.curvature.as_ref().map(|buffer| buffer.len())),
            ("the buffer for status", self.status.as_ref().map(|buffer| buffer.len())),
            ("the buffer for neighbours", self.neighbours.as_ref().map(|buffer| buffer.len())),
            ("the buffer for depth", self.depth.as_ref().map(|buffer| buffer.len())),
            ("the buffer for depth in metres", self.depth_m.as_ref().map(|buffer| buffer.len())),
            ("the buffer for frames", self.frames.as_ref().map(|buffer| buffer.len())),
        ];
        let sigma = (!ONE_THREAD).then(|| ("the buffer for sigma", self.sigma.as_ref().map(|buffer| buffer.len())));
        lengths.into_iter().chain(sigma).try_for_each(|(what, found)| check_len(what, found.unwrap_or(len), len))
    }
}

fn check_len(what: &str, len: usize, expected: usize) -> Result<(), FrameError> {
    if len == expected { Ok(()) } else { Err(FrameError::LengthMismatch { what: what.into(), len, expected }) }
}
