//! The caller's buffers for results.

use std::ptr::NonNull;
use std::slice;

use planish::{Outputs, SmoothedMut, Status, StridedMut};

use crate::buffers::{Extent, check_apart, sized};
use crate::error::{Done, PLANISH_ARGUMENT, failure};

/// The smoothed points.
pub const PLANISH_POINTS: u32 = 1;
/// Unit normals towards the sensor.
pub const PLANISH_NORMALS: u32 = 2;
/// Surface variation, 0 to 1/3.
pub const PLANISH_CURVATURE: u32 = 4;
/// The status of each pixel.
pub const PLANISH_STATUS: u32 = 8;
/// The number of neighbours of each pixel.
pub const PLANISH_NEIGHBOURS: u32 = 16;
/// Depth in the camera's units.
pub const PLANISH_DEPTH: u32 = 32;
/// Depth in metres.
pub const PLANISH_DEPTH_M: u32 = 64;
/// Effective number of video frames averaged into each pixel.
pub const PLANISH_FRAMES: u32 = 128;
/// Standard error of each point along its ray, in metres.
pub const PLANISH_SIGMA: u32 = 256;

/// A hole in the input, which stays a hole.
pub const PLANISH_STATUS_HOLE: u8 = 0;
/// Too few neighbours on a grid: the output is a hole.
pub const PLANISH_STATUS_TOO_FEW: u8 = 1;
/// The neighbours are on a line: the point is unchanged.
pub const PLANISH_STATUS_DEGENERATE: u8 = 2;
/// The point is on the fitted plane.
pub const PLANISH_STATUS_PLANE: u8 = 3;
/// The point is on the fitted polynomial of degree 2.
pub const PLANISH_STATUS_POLYNOMIAL2: u8 = 4;
/// The point is on the fitted polynomial of degree 3.
pub const PLANISH_STATUS_POLYNOMIAL3: u8 = 5;
/// Too few neighbours in a cloud without a grid: the point is unchanged.
pub const PLANISH_STATUS_ISOLATED: u8 = 6;
/// The point is kept from the previous frame.
pub const PLANISH_STATUS_CARRIED: u8 = 7;
/// A filled hole: nothing was measured here.
pub const PLANISH_STATUS_FILLED: u8 = 8;

/// The caller's buffers, each null if its result is not wanted. Holes are NaN in float buffers and 0 in integer
/// buffers.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct planish_output {
    /// sizeof(planish_output).
    pub size: usize,
    /// Number of items in every buffer. Must equal the number of pixels or points of the result
    /// (planish_output_shape).
    pub count: usize,
    /// x, y and z of the smoothed points in metres.
    pub points: *mut f32,
    /// Bytes from one point to the next, a multiple of 4; 0 if there are no gaps. Bytes between points are left
    /// unchanged, unless `gaps_from` is set.
    pub points_stride: usize,
    /// Unit normals towards the sensor.
    pub normals: *mut f32,
    /// Bytes from one normal to the next, with the same rules as points_stride. Points and normals may be members of
    /// the same structs.
    pub normals_stride: usize,
    /// Surface variation l0/(l0+l1+l2), 0 to 1/3.
    pub curvature: *mut f32,
    /// One of PLANISH_STATUS_... for each pixel.
    pub status: *mut u8,
    /// Number of neighbours.
    pub neighbours: *mut u32,
    /// Depth in the camera's units; needs a camera.
    pub depth: *mut u16,
    /// Depth in metres; needs a camera.
    pub depth_m: *mut f32,
    /// Effective number of video frames averaged into each pixel; needs the setting temporal.
    pub frames: *mut f32,
    /// Standard error of each point along its ray, in metres; needs a grid.
    pub sigma: *mut f32,
    /// The first point of an array of structs whose stride is also points_stride, such as the input. The bytes from
    /// the end of each point to the next point are copied to the result. Both arrays must have `count` times
    /// `points_stride` bytes, and no other output may be in the gaps. Null leaves the gaps unchanged.
    pub gaps_from: *const f32,
}

/// The caller's validated buffers.
pub(crate) struct Wanted {
    output: planish_output,
    /// The extents of the memory that is written.
    extents: Vec<Extent>,
    /// The extents of the memory that is read.
    read: Vec<Extent>,
}

/// Returns the outputs that a mask selects.
pub(crate) fn outputs_of(mask: u32) -> Done<Outputs> {
    const ALL: u32 = 2 * PLANISH_SIGMA - 1;
    if mask == 0 || mask & !ALL != 0 {
        let text =
            format!("invalid outputs {mask:#x}; expected PLANISH_POINTS or a combination of the outputs in planish.h");
        return failure(PLANISH_ARGUMENT, text);
    }
    let has = |bit: u32| mask & bit != 0;
    Ok(Outputs::default()
        .with_points(has(PLANISH_POINTS))
        .with_normals(has(PLANISH_NORMALS))
        .with_curvature(has(PLANISH_CURVATURE))
        .with_status(has(PLANISH_STATUS))
        .with_neighbours(has(PLANISH_NEIGHBOURS))
        .with_depth(has(PLANISH_DEPTH))
        .with_depth_m(has(PLANISH_DEPTH_M))
        .with_frames(has(PLANISH_FRAMES))
        .with_sigma(has(PLANISH_SIGMA)))
}

impl Wanted {
    /// Checks the caller's buffers.
    ///
    /// # Safety
    /// The pointer must be null, or point to an output whose own pointers are null or have room for `count` items.
    pub(crate) unsafe fn new(pointer: *const planish_output) -> Done<Self> {
        // SAFETY: the caller upholds this function's contract.
        let mut output = unsafe { sized("the output", pointer, size_of::<planish_output>())? };
        let count = output.count;
        let (mut extents, mut read) = (Vec::new(), Vec::new());
        for (what, pointer, stride) in [
            ("the buffer for points", output.points, &mut output.points_stride),
            ("the buffer for normals", output.normals, &mut output.normals_stride),
        ] {
            *stride = if *stride == 0 { 12 } else { *stride };
            if !pointer.is_null() {
                extents.push(Extent::new(what, pointer, align_of::<f32>(), (12, *stride, count))?);
            }
        }
        if !output.gaps_from.is_null() {
            let (stride, align) = (output.points_stride, align_of::<f32>());
            if output.points.is_null() {
                return failure(PLANISH_ARGUMENT, "gaps_from is set, but the output has no buffer for points");
            }
            if stride < 12 {
                return failure(
                    PLANISH_ARGUMENT,
                    format!("gaps_from needs a points_stride of at least 12, not {stride}"),
                );
            }
            // The gaps are read and written too.
            extents[0] = Extent::new("the buffer for points", output.points, align, (stride, stride, count))?;
            read.push(Extent::new("gaps_from", output.gaps_from, align, (stride, stride, count))?);
        }
        let mut add = |what, pointer: *const u8, bytes: usize| -> Done<()> {
            if !pointer.is_null() {
                extents.push(Extent::new(what, pointer, bytes, (bytes, bytes, count))?);
            }
            Ok(())
        };
        add("the buffer for curvature", output.curvature.cast(), 4)?;
        add("the buffer for status", output.status, 1)?;
        add("the buffer for neighbours", output.neighbours.cast(), 4)?;
        add("the buffer for depth", output.depth.cast(), 2)?;
        add("the buffer for depth_m", output.depth_m.cast(), 4)?;
        add("the buffer for frames", output.frames.cast(), 4)?;
        add("the buffer for sigma", output.sigma.cast(), 4)?;
        // The pointers of an empty cloud may be null.
        if extents.is_empty() && count > 0 {
            return failure(PLANISH_ARGUMENT, "the output has no buffer; give one for points or another result");
        }
        Ok(Self { output, extents, read })
    }

    /// Returns an error if buffers overlap each other, the input or the array from which gaps are copied.
    pub(crate) fn check_apart(&self, input: &[Extent]) -> Done<()> {
        check_apart(input, &self.extents)?;
        check_apart(&self.read, &self.extents)
    }

    /// Returns an error if an output has a buffer but was not requested when the frame was submitted.
    pub(crate) fn check_outputs(&self, submitted: Outputs) -> Done<()> {
        let submitted = submitted.names();
        match self.outputs().names().into_iter().find(|name| self.output.count > 0 && !submitted.contains(name)) {
            None => Ok(()),
            Some(name) => {
                let text = format!(
                    "{name} was not requested when the frame was submitted; its outputs are {}",
                    submitted.join(", ")
                );
                failure(PLANISH_ARGUMENT, text)
            }
        }
    }

    /// Returns the outputs that have a buffer, or the points if no output has one (an empty cloud).
    pub(crate) fn outputs(&self) -> Outputs {
        let out = &self.output;
        Outputs::default()
            .with_points(!out.points.is_null() || self.extents.is_empty())
            .with_normals(!out.normals.is_null())
            .with_curvature(!out.curvature.is_null())
            .with_status(!out.status.is_null())
            .with_neighbours(!out.neighbours.is_null())
            .with_depth(!out.depth.is_null())
            .with_depth_m(!out.depth_m.is_null())
            .with_frames(!out.frames.is_null())
            .with_sigma(!out.sigma.is_null())
    }

    /// Returns an error if the number of items in the buffers is not `expected`.
    pub(crate) fn check_count(&self, expected: usize, reason: &str) -> Done<()> {
        if self.output.count == expected {
            return Ok(());
        }
        let text =
            format!("the output has room for {} items, but the result has {expected}{reason}", self.output.count);
        failure(PLANISH_ARGUMENT, text)
    }

    /// Borrows the buffers.
    ///
    /// # Safety
    /// Same as [`Wanted::new`], for the lifetime of the result. During that time, nothing else may access the
    /// buffers.
    pub(crate) unsafe fn buffers(&mut self) -> SmoothedMut<'_> {
        let planish_output { count, .. } = self.output;
        /// # Safety
        /// The pointer must be null or have room for `count` values, for the lifetime of the result.
        unsafe fn slice<'a, T>(pointer: *mut T, count: usize) -> Option<&'a mut [T]> {
            // SAFETY: the caller upholds this function's contract.
            (!pointer.is_null()).then(|| unsafe { slice::from_raw_parts_mut(pointer, count) })
        }
        let vectors = |pointer: *mut f32, stride: usize| {
            // SAFETY: the extents were checked, and the caller guarantees that memory of these extents is valid.
            NonNull::new(pointer).map(|first| unsafe { StridedMut::from_raw(first, stride / 4, count) })
        };
        let out = &self.output;
        let mut buffers = SmoothedMut::new();
        let points = vectors(out.points, out.points_stride);
        let points = match NonNull::new(out.gaps_from.cast_mut()) {
            // SAFETY: the same, with the gaps.
            Some(gaps) => points.map(|points| unsafe { points.with_gaps_from(gaps) }),
            None => points,
        };
        buffers.points = points.map(Into::into);
        buffers.normals = vectors(out.normals, out.normals_stride).map(Into::into);
        // SAFETY: the same. Zeros are valid as every type here.
        unsafe {
            if !out.status.is_null() {
                out.status.write_bytes(0, count);
            }
            buffers.curvature = slice(out.curvature, count);
            buffers.status = slice(out.status.cast::<Status>(), count);
            buffers.neighbours = slice(out.neighbours, count);
            buffers.depth = slice(out.depth, count);
            buffers.depth_m = slice(out.depth_m, count);
            buffers.frames = slice(out.frames, count);
            buffers.sigma = slice(out.sigma, count);
        }
        buffers
    }
}
