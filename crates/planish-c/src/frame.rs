//! The caller's frames and cameras.

use std::ffi::{c_char, c_void};
use std::slice;

use planish::{
    Camera, DepthView, Distortion, Frame, IntoFrame, PointLayout, PointsView, Scalar, SensorPose, validate_shape,
};

use crate::buffers::{Extent, sized, text};
use crate::error::{Done, PLANISH_ARGUMENT, PLANISH_NULL, failure};

/// Depth in the camera's units; 0 and 65535 are holes.
pub const PLANISH_DEPTH_U16: u32 = 1;
/// Depth in metres; values that are not finite or not positive are holes.
pub const PLANISH_DEPTH_F32: u32 = 2;
/// Interleaved points as float in metres; points that are not finite are holes.
pub const PLANISH_POINTS_F32: u32 = 3;
/// Interleaved points as double in metres; points that are not finite are holes.
pub const PLANISH_POINTS_F64: u32 = 4;
/// Points as three arrays of float, x, y and z, in metres; points that are not finite are holes.
pub const PLANISH_PLANES_F32: u32 = 5;
/// Points as three arrays of double, x, y and z, in metres; points that are not finite are holes.
pub const PLANISH_PLANES_F64: u32 = 6;

/// A pinhole camera.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct planish_camera {
    /// sizeof(planish_camera).
    pub size: usize,
    /// Width of the images in pixels.
    pub width: usize,
    /// Height of the images in pixels.
    pub height: usize,
    /// Horizontal focal length in pixels.
    pub fx: f64,
    /// Vertical focal length in pixels.
    pub fy: f64,
    /// Horizontal position of the principal point in pixels from the centre of the first pixel.
    pub cx: f64,
    /// Vertical position of the principal point in pixels from the centre of the first pixel.
    pub cy: f64,
    /// Depth units per metre; 0 means 1000 (millimetres).
    pub depth_units_per_metre: f64,
    /// The name of the distortion model in ROS, OpenCV or Kalibr, such as "plumb_bob" or "equidistant"; null means
    /// OpenCV's model.
    pub distortion_model: *const c_char,
    /// The distortion coefficients; null if there are none.
    pub distortion: *const f64,
    /// The number of distortion coefficients.
    pub distortion_count: usize,
}

/// A depth image, or points. It is borrowed until the call returns.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct planish_frame {
    /// sizeof(planish_frame).
    pub size: usize,
    /// The kind of data: PLANISH_DEPTH_U16, PLANISH_DEPTH_F32, PLANISH_POINTS_F32, PLANISH_POINTS_F64,
    /// PLANISH_PLANES_F32 or PLANISH_PLANES_F64.
    pub kind: u32,
    /// Number of columns, or of points without a grid.
    pub width: usize,
    /// Number of rows; 1 for points without a grid.
    pub height: usize,
    /// The first depth value, or the first interleaved point.
    pub data: *const c_void,
    /// Bytes from one row to the next; 0 if there are no gaps between rows.
    pub row_stride: usize,
    /// Bytes from one interleaved point to the next; 0 if there are no gaps between points.
    pub point_stride: usize,
    /// Bytes from the beginning of an interleaved point to its x, y and z; all 0 if they come first.
    pub offsets: [usize; 3],
    /// For PLANISH_PLANES_F32 and PLANISH_PLANES_F64: the arrays of x, y and z, without gaps.
    pub planes: [*const c_void; 3],
    /// The camera, required for depth images. For points on a grid, it is required only for depth outputs.
    pub camera: *const planish_camera,
    /// The sensor pose in the coordinate frame of the points: x, y, z in metres, then a quaternion w, x, y, z. Null
    /// if unknown; ignored for depth images.
    pub pose: *const f64,
    /// An origin near the points: x, y, z in metres. Results are relative to it. Null means (0, 0, 0). Georeferenced
    /// points need an origin.
    pub origin_m: *const f64,
    /// Colours of a depth image: red, green and blue of each pixel, without gaps. Null if there are none.
    pub rgb: *const u8,
}

/// The caller's validated frame, with its camera and the extents of its memory.
pub(crate) struct Given {
    frame: planish_frame,
    camera: Option<Camera>,
    pub(crate) extents: Vec<Extent>,
}

/// Reads an array of doubles; returns `None` if the pointer is null.
///
/// # Safety
/// The pointer must be null or point to `N` values.
pub(crate) unsafe fn doubles<const N: usize>(what: &'static str, pointer: *const f64) -> Done<Option<[f64; N]>> {
    if pointer.is_null() {
        return Ok(None);
    }
    Extent::new(what, pointer, align_of::<f64>(), (8 * N, 8 * N, 1))?;
    // SAFETY: the caller upholds this function's contract.
    Ok(Some(unsafe { pointer.cast::<[f64; N]>().read() }))
}

/// Converts the caller's camera.
///
/// # Safety
/// The pointer must be null, or point to a camera whose own pointers are null or valid as its members state.
pub(crate) unsafe fn camera_of(pointer: *const planish_camera) -> Done<Camera> {
    // SAFETY: the caller upholds this function's contract.
    let given = unsafe { sized("the camera", pointer, size_of::<planish_camera>())? };
    let mut camera = Camera::new((given.width, given.height), [given.fx, given.fy], [given.cx, given.cy]);
    if given.depth_units_per_metre != 0.0 {
        camera = camera.with_depth_units_per_metre(given.depth_units_per_metre);
    }
    if !given.distortion.is_null() || !given.distortion_model.is_null() || given.distortion_count > 0 {
        const MOST: usize = 64;
        if given.distortion_count > MOST {
            let text = format!("{} distortion coefficients are not supported; expected 4 to 8", given.distortion_count);
            return failure(PLANISH_ARGUMENT, text);
        }
        let coefficients: &[f64] = match given.distortion_count {
            0 => &[],
            count => {
                Extent::new("distortion", given.distortion, align_of::<f64>(), (8 * count, 8, 1))?;
                // SAFETY: the caller upholds this function's contract.
                unsafe { slice::from_raw_parts(given.distortion, count) }
            }
        };
        let model = match given.distortion_model.is_null() {
            true => "",
            // SAFETY: the caller upholds this function's contract.
            false => unsafe { text("distortion_model", given.distortion_model)? },
        };
        let distortion = Distortion::of_model(model, coefficients);
        camera = camera.with_distortion(distortion.or_else(|error| failure(PLANISH_ARGUMENT, error.to_string()))?);
    }
    camera.validate()?;
    Ok(camera)
}

impl Given {
    /// Checks the caller's frame.
    ///
    /// # Safety
    /// The pointer must be null, or point to a frame whose own pointers are null or valid as its members state.
    pub(crate) unsafe fn new(pointer: *const planish_frame) -> Done<Self> {
        // SAFETY: the caller upholds this function's contract.
        let mut frame = unsafe { sized("the frame", pointer, size_of::<planish_frame>())? };
        let camera = match frame.camera.is_null() {
            true => None,
            // SAFETY: the caller upholds this function's contract.
            false => Some(unsafe { camera_of(frame.camera)? }),
        };
        let (width, height) = (frame.width, frame.height);
        let scalar = match frame.kind {
            PLANISH_DEPTH_U16 => 2,
            PLANISH_DEPTH_F32 | PLANISH_POINTS_F32 | PLANISH_PLANES_F32 => 4,
            PLANISH_POINTS_F64 | PLANISH_PLANES_F64 => 8,
            other => {
                return failure(
                    PLANISH_ARGUMENT,
                    format!("unknown frame kind {other}; expected PLANISH_DEPTH_U16 or another kind in planish.h"),
                );
            }
        };
        let is_depth = matches!(frame.kind, PLANISH_DEPTH_U16 | PLANISH_DEPTH_F32);
        // An unorganized cloud may be empty.
        if is_depth || height != 1 || width != 0 {
            validate_shape(width, height)?;
        }
        let mut extents = Vec::new();
        match frame.kind {
            // The pointers of an empty cloud may be null.
            PLANISH_PLANES_F32 | PLANISH_PLANES_F64 if width == 0 => {}
            PLANISH_PLANES_F32 | PLANISH_PLANES_F64 => {
                for (what, plane) in ["the x plane", "the y plane", "the z plane"].into_iter().zip(frame.planes) {
                    extents.push(Extent::new(what, plane, scalar, (scalar * width * height, 0, 1))?);
                }
            }
            _ => {
                let (item, align) = if is_depth { (scalar, scalar) } else { (point_bytes(&mut frame, scalar)?, 1) };
                let point_stride = if is_depth { scalar } else { frame.point_stride };
                let Some(row) = (width.max(1) - 1).checked_mul(point_stride).and_then(|row| row.checked_add(item))
                else {
                    return failure(PLANISH_ARGUMENT, format!("a point stride of {point_stride} bytes is too large"));
                };
                if frame.row_stride == 0 {
                    let Some(tight) = width.checked_mul(point_stride) else {
                        return failure(
                            PLANISH_ARGUMENT,
                            format!("a point stride of {point_stride} bytes is too large"),
                        );
                    };
                    frame.row_stride = tight;
                }
                // The pointer of an empty cloud may be null.
                if width * height > 0 {
                    extents.push(Extent::new("the frame's data", frame.data, align, (row, frame.row_stride, height))?);
                }
            }
        }
        if is_depth {
            let Some(camera) = camera else {
                return failure(PLANISH_NULL, "a depth image needs a camera, but the frame's camera is null");
            };
            camera.check_shape((width, height))?;
        }
        if !frame.rgb.is_null() {
            extents.push(Extent::new("rgb", frame.rgb, 1, (3 * width * height, 0, 1))?);
        }
        Ok(Self { frame, camera, extents })
    }

    pub(crate) fn width(&self) -> usize {
        self.frame.width
    }

    pub(crate) fn height(&self) -> usize {
        self.frame.height
    }

    /// Borrows the frame.
    ///
    /// # Safety
    /// Same as [`Given::new`], for the lifetime of the result.
    pub(crate) unsafe fn frame(&self) -> Done<Frame<'_>> {
        let planish_frame { kind, width, height, data, row_stride, planes, .. } = self.frame;
        let bytes = self.extents.first().and_then(Extent::bytes).unwrap_or(0);
        if let (PLANISH_DEPTH_U16 | PLANISH_DEPTH_F32, Some(camera)) = (kind, &self.camera) {
            // SAFETY: the extents were checked, and the caller guarantees that memory of these extents is valid.
            let view = unsafe {
                if kind == PLANISH_DEPTH_U16 {
                    DepthView::with_row_stride(slice::from_raw_parts(data.cast(), bytes / 2), row_stride / 2, camera)?
                } else {
                    let depth_m = slice::from_raw_parts(data.cast(), bytes / 4);
                    DepthView::from_metres_with_row_stride(depth_m, row_stride / 4, camera)?
                }
            };
            let view = match self.frame.rgb.is_null() {
                true => view,
                // SAFETY: the same.
                false => view.with_rgb(unsafe { slice::from_raw_parts(self.frame.rgb, 3 * width * height) })?,
            };
            return Ok(view.into_frame()?);
        }
        let count = width * height;
        let mut view = match kind {
            _ if count == 0 => PointsView::from_rows(&[])?,
            // SAFETY: the same.
            PLANISH_PLANES_F32 => unsafe {
                let [x, y, z] = planes.map(|plane| slice::from_raw_parts(plane.cast::<f32>(), count));
                PointsView::from_planes(x, y, z)?
            },
            // SAFETY: the same.
            PLANISH_PLANES_F64 => unsafe {
                let [x, y, z] = planes.map(|plane| slice::from_raw_parts(plane.cast::<f64>(), count));
                PointsView::from_planes_f64(x, y, z)?
            },
            _ => {
                let scalar = if kind == PLANISH_POINTS_F64 { Scalar::F64 } else { Scalar::F32 };
                let planish_frame { offsets, point_stride, .. } = self.frame;
                let layout = PointLayout { scalar, offsets, point_stride, row_stride };
                // SAFETY: the same.
                let bytes = unsafe { slice::from_raw_parts(data.cast::<u8>(), bytes) };
                PointsView::from_bytes(bytes, layout, (width, height))?
            }
        };
        if height > 1 {
            view = view.with_grid(width, height)?;
            if let Some(camera) = &self.camera {
                view = view.with_camera(camera)?;
            }
        }
        // SAFETY: the caller upholds this function's contract.
        let (pose, origin_m) =
            unsafe { (doubles("pose", self.frame.pose)?, doubles("origin_m", self.frame.origin_m)?) };
        if let Some(pose) = pose {
            view = view.with_pose(SensorPose::from_viewpoint(pose))?;
        }
        match origin_m {
            Some(origin_m) if origin_m.iter().any(|value| !value.is_finite()) => {
                return failure(PLANISH_ARGUMENT, format!("origin_m is {origin_m:?}, which is not finite"));
            }
            Some(origin_m) => view = view.with_origin(origin_m)?,
            None if matches!(kind, PLANISH_POINTS_F64 | PLANISH_PLANES_F64) => check_near(&view)?,
            None => {}
        }
        Ok(view.into_frame()?)
    }
}

/// Returns an error if double coordinates would lose precision as float.
fn check_near(view: &PointsView<'_>) -> Done<()> {
    /// Largest coordinate accepted without an origin, in metres. Adjacent floats of this size are half a millimetre
    /// apart.
    const FAR_M: f64 = 4096.0;
    const SAMPLE: usize = 4096;
    let step = view.len().div_ceil(SAMPLE).max(1);
    let sizes = (0..view.len()).step_by(step).flat_map(|i| view.get(i)).filter(|value| value.is_finite());
    let largest = sizes.map(f64::abs).fold(0.0, f64::max);
    if largest <= FAR_M {
        return Ok(());
    }
    let text =
        format!("coordinates of {largest} m lose precision as float; set origin_m to a position near the points");
    failure(PLANISH_ARGUMENT, text)
}

/// Fills in the default layout of interleaved points. Returns the number of bytes from the beginning of a point to
/// the end of its coordinates.
fn point_bytes(frame: &mut planish_frame, scalar: usize) -> Done<usize> {
    if frame.offsets == [0; 3] {
        frame.offsets = [0, scalar, 2 * scalar];
    }
    let end = frame.offsets.iter().map(|offset| offset.saturating_add(scalar)).max().unwrap_or(0);
    if frame.point_stride == 0 {
        frame.point_stride = end;
    }
    if frame.point_stride < end {
        let text = format!(
            "a point stride of {} bytes is too small; a point's coordinates end at byte {end}",
            frame.point_stride
        );
        return failure(PLANISH_ARGUMENT, text);
    }
    Ok(end)
}
