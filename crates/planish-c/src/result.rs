//! Results that the library owns.

use std::ptr;

use planish::Smoothed;

use crate::buffers::Extent;
use crate::error::{Done, guarded, planish_code};
use crate::handles::Handles;

/// A result that the library owns.
pub struct planish_result {
    _opaque: [u8; 0],
}

/// The arrays of a result. Each has width * height values, or is null if it was not requested.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct planish_view {
    /// Number of columns, or of points without a grid.
    pub width: usize,
    /// Number of rows; 1 for points without a grid.
    pub height: usize,
    /// x, y and z of the smoothed points in metres.
    pub points: [*const f32; 3],
    /// x, y and z of the unit normals towards the sensor.
    pub normals: [*const f32; 3],
    /// Surface variation.
    pub curvature: *const f32,
    /// One of PLANISH_STATUS_... for each pixel.
    pub status: *const u8,
    /// Number of neighbours.
    pub neighbours: *const u32,
    /// Depth in the camera's units.
    pub depth: *const u16,
    /// Depth in metres.
    pub depth_m: *const f32,
    /// Effective number of video frames averaged into each pixel.
    pub frames: *const f32,
    /// Standard error along the ray, in metres.
    pub sigma: *const f32,
}

static RESULTS: Handles<Smoothed> = Handles::new("result");

/// Stores a result and returns its new handle.
pub(crate) fn handle_of(smoothed: Smoothed) -> *mut planish_result {
    RESULTS.add(smoothed)
}

fn view_of(smoothed: &Smoothed) -> planish_view {
    fn of<T>(values: Option<&Vec<T>>) -> *const T {
        values.map_or(ptr::null(), |values| values.as_ptr())
    }
    let planes = |vectors: &planish::Xyz| vectors.as_slices().map(<[f32]>::as_ptr);
    planish_view {
        width: smoothed.width,
        height: smoothed.height,
        points: if smoothed.points.is_empty() { [ptr::null(); 3] } else { planes(&smoothed.points) },
        normals: smoothed.normals.as_ref().map_or([ptr::null(); 3], planes),
        curvature: of(smoothed.curvature.as_ref()),
        status: of(smoothed.status.as_ref()).cast(),
        neighbours: of(smoothed.neighbours.as_ref()),
        depth: of(smoothed.depth.as_ref()),
        depth_m: of(smoothed.depth_m.as_ref()),
        frames: of(smoothed.frames.as_ref()),
        sigma: of(smoothed.sigma.as_ref()),
    }
}

/// Writes the arrays of a result to `view`. They are valid until the result is freed.
///
/// # Safety
/// `view` must be null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_result_get(result: *const planish_result, view: *mut planish_view) -> planish_code {
    guarded(|| {
        let smoothed = RESULTS.get(result)?;
        let bytes = size_of::<planish_view>();
        Extent::new("the view", view, align_of::<planish_view>(), (bytes, bytes, 1))?;
        // SAFETY: the caller upholds this function's contract.
        unsafe { view.write(view_of(&smoothed)) };
        Ok(())
    })
}

/// Frees a result. Null is allowed.
#[unsafe(no_mangle)]
pub extern "C" fn planish_result_free(result: *mut planish_result) -> planish_code {
    guarded(|| -> Done<()> {
        if result.is_null() { Ok(()) } else { RESULTS.remove(result) }
    })
}
