//! Conversion of NumPy arrays to the library's borrowed views and buffers.

use std::mem::size_of;

use numpy::{
    BorrowError, Element, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyReadwriteArrayDyn, PyUntypedArrayMethods,
};
use planish::{
    Camera, DepthView, Frame, IntoFrame, Outputs, PointLayout, PointsView, Scalar, SensorPose, SmoothedMut, Status,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::errors::frame;

/// An input array, with one of the element types that frames have.
pub enum Input<'py> {
    DepthU16(PyReadonlyArrayDyn<'py, u16>),
    DepthF32(PyReadonlyArrayDyn<'py, f32>),
    PointsF32(PyReadonlyArrayDyn<'py, f32>),
    PointsF64(PyReadonlyArrayDyn<'py, f64>),
}

impl<'py> Input<'py> {
    /// Borrows depth `[H, W]` or points `[.., 3]`; the Python side has checked shape and strides.
    pub fn new(array: &Bound<'py, PyAny>, is_depth: bool) -> PyResult<Self> {
        if let Ok(array) = array.cast::<PyArrayDyn<f32>>() {
            let array = array.try_readonly().map_err(borrowed)?;
            return Ok(if is_depth { Self::DepthF32(array) } else { Self::PointsF32(array) });
        }
        if let (Ok(array), true) = (array.cast::<PyArrayDyn<u16>>(), is_depth) {
            return Ok(Self::DepthU16(array.try_readonly().map_err(borrowed)?));
        }
        if let (Ok(array), false) = (array.cast::<PyArrayDyn<f64>>(), is_depth) {
            return Ok(Self::PointsF64(array.try_readonly().map_err(borrowed)?));
        }
        Err(PyTypeError::new_err("expected an array of uint16, float32 or float64"))
    }

    /// Returns the array as a frame.
    pub fn frame<'a>(
        &'a self,
        camera: Option<&'a Camera>,
        pose: Option<[f64; 7]>,
        origin_m: Option<[f64; 3]>,
    ) -> PyResult<Frame<'a>> {
        let missing = || PyValueError::new_err("a depth image needs its camera");
        match self {
            Self::DepthU16(array) => {
                let (raw, row_stride) = rows(array)?;
                let view = DepthView::with_row_stride(raw, row_stride, camera.ok_or_else(missing)?);
                view.and_then(IntoFrame::into_frame).map_err(frame)
            }
            Self::DepthF32(array) => {
                let (depth_m, row_stride) = rows(array)?;
                let view = DepthView::from_metres_with_row_stride(depth_m, row_stride, camera.ok_or_else(missing)?);
                view.and_then(IntoFrame::into_frame).map_err(frame)
            }
            Self::PointsF32(array) => points(array, Scalar::F32, camera, pose, origin_m),
            Self::PointsF64(array) => points(array, Scalar::F64, camera, pose, origin_m),
        }
    }
}

/// Converts an error of NumPy's borrow checks, which reject arrays that share memory.
fn borrowed(error: BorrowError) -> PyErr {
    match error {
        BorrowError::NotWriteable => PyValueError::new_err("out: an array is read-only"),
        _ => PyValueError::new_err(
            "an array would be read and written at the same time; out must not overlap the input or be in use \
             elsewhere",
        ),
    }
}

/// Returns the strides in bytes; a negative stride is an error.
fn strides<T: Element>(array: &PyReadonlyArrayDyn<'_, T>) -> PyResult<Vec<usize>> {
    let positive =
        |&stride: &isize| usize::try_from(stride).map_err(|_| PyValueError::new_err("strides must not be negative"));
    array.strides().iter().map(positive).collect()
}

/// Returns the rows of an image, and their stride in values.
fn rows<'a, T: Element>(array: &'a PyReadonlyArrayDyn<'_, T>) -> PyResult<(&'a [T], usize)> {
    let (&[height, width], &[row_bytes, value_bytes]) = (array.shape(), &strides(array)?[..]) else {
        return Err(PyValueError::new_err("a depth image must have two dimensions, [H, W]"));
    };
    let size = size_of::<T>();
    // The stride of a single row is meaningless.
    let row_bytes = if height == 1 { width * size } else { row_bytes };
    if height == 0 || width == 0 || value_bytes != size || row_bytes % size != 0 || row_bytes < width * size {
        return Err(PyValueError::new_err(
            "the values in each row of a depth image must be contiguous, and rows must not overlap",
        ));
    }
    let row_stride = row_bytes / size;
    // SAFETY: all values from the first one to the last one of the last row are in the array's allocation, since no
    // stride is negative; values between rows belong to it too. NumPy keeps the allocation alive, and borrowed for
    // reading, as long as `array` exists.
    let values = unsafe { std::slice::from_raw_parts(array.data().cast_const(), (height - 1) * row_stride + width) };
    Ok((values, row_stride))
}

fn points<'a, T: Element>(
    array: &'a PyReadonlyArrayDyn<'_, T>,
    scalar: Scalar,
    camera: Option<&'a Camera>,
    pose: Option<[f64; 7]>,
    origin_m: Option<[f64; 3]>,
) -> PyResult<Frame<'a>> {
    let strides = strides(array)?;
    let (height, width, row_stride, point_stride, value_stride) = match (array.shape(), &strides[..]) {
        (&[height, width, 3], &[row, point, value]) => (height, width, row, point, value),
        (&[count, 3], &[point, value]) => (1, count, 0, point, value),
        _ => return Err(PyValueError::new_err("points must have the shape [H, W, 3] or [N, 3]")),
    };
    // The stride of a single point is meaningless.
    let point_stride = if width == 1 { point_stride.max(2 * value_stride + size_of::<T>()) } else { point_stride };
    let len = match (height, width) {
        (0, _) | (_, 0) => 0,
        _ => (height - 1) * row_stride + (width - 1) * point_stride + 2 * value_stride + size_of::<T>(),
    };
    // SAFETY: all bytes from the first value to the last are in the array's allocation, since no stride is negative.
    // The allocation stays alive, and borrowed for reading, as long as `array` exists. Any bytes are valid as u8.
    let bytes = unsafe { std::slice::from_raw_parts(array.data().cast::<u8>().cast_const(), len) };
    let offsets = [0, value_stride, 2 * value_stride];
    let layout = PointLayout { scalar, offsets, point_stride, row_stride };
    let mut view = PointsView::from_bytes(bytes, layout, (width, height)).map_err(frame)?;
    if array.ndim() == 3 {
        view = view.with_grid(width, height).map_err(frame)?;
    }
    if let Some(viewpoint) = pose {
        view = view.with_pose(SensorPose::from_viewpoint(viewpoint)).map_err(frame)?;
    }
    if let Some(origin_m) = origin_m {
        view = view.with_origin(origin_m).map_err(frame)?;
    }
    if let (Some(camera), true) = (camera, array.ndim() == 3) {
        view = view.with_camera(camera).map_err(frame)?;
    }
    view.into_frame().map_err(frame)
}

/// The caller's output arrays.
#[derive(Default)]
pub struct Buffers<'py> {
    points: Option<PyReadwriteArrayDyn<'py, f32>>,
    normals: Option<PyReadwriteArrayDyn<'py, f32>>,
    curvature: Option<PyReadwriteArrayDyn<'py, f32>>,
    depth_m: Option<PyReadwriteArrayDyn<'py, f32>>,
    frames: Option<PyReadwriteArrayDyn<'py, f32>>,
    sigma: Option<PyReadwriteArrayDyn<'py, f32>>,
    depth: Option<PyReadwriteArrayDyn<'py, u16>>,
    neighbours: Option<PyReadwriteArrayDyn<'py, u32>>,
    status: Option<PyReadwriteArrayDyn<'py, u8>>,
}

/// Output arrays as slices.
#[derive(Default)]
pub struct Slices<'a> {
    pub points: Option<&'a mut [[f32; 3]]>,
    pub normals: Option<&'a mut [[f32; 3]]>,
    pub curvature: Option<&'a mut [f32]>,
    pub depth_m: Option<&'a mut [f32]>,
    pub frames: Option<&'a mut [f32]>,
    pub sigma: Option<&'a mut [f32]>,
    pub depth: Option<&'a mut [u16]>,
    pub neighbours: Option<&'a mut [u32]>,
    /// Codes of [`Status`].
    pub status: Option<&'a mut [u8]>,
}

fn writable<'py, T: Element>(name: &str, array: &Bound<'py, PyAny>) -> PyResult<PyReadwriteArrayDyn<'py, T>> {
    let array = array.cast::<PyArrayDyn<T>>().map_err(|_| {
        PyTypeError::new_err(format!("out[{name:?}]: expected an array of {}", T::get_dtype(array.py())))
    })?;
    array.try_readwrite().map_err(borrowed)
}

fn slice<'a, T: Element>(
    name: &str,
    array: &'a mut Option<PyReadwriteArrayDyn<'_, T>>,
) -> PyResult<Option<&'a mut [T]>> {
    let contiguous = |_| PyValueError::new_err(format!("out[{name:?}]: the array must be C-contiguous"));
    array.as_mut().map(|array| array.as_slice_mut().map_err(contiguous)).transpose()
}

impl<'py> Buffers<'py> {
    pub fn new(out: &Bound<'py, PyDict>) -> PyResult<Self> {
        let mut buffers = Self::default();
        for (name, array) in out.iter() {
            let name: String = name.extract()?;
            match name.as_str() {
                "points" => buffers.points = Some(writable(&name, &array)?),
                "normals" => buffers.normals = Some(writable(&name, &array)?),
                "curvature" => buffers.curvature = Some(writable(&name, &array)?),
                "depth_m" => buffers.depth_m = Some(writable(&name, &array)?),
                "frames" => buffers.frames = Some(writable(&name, &array)?),
                "sigma" => buffers.sigma = Some(writable(&name, &array)?),
                "depth" => buffers.depth = Some(writable(&name, &array)?),
                "neighbours" => buffers.neighbours = Some(writable(&name, &array)?),
                "status" => buffers.status = Some(writable(&name, &array)?),
                _ => return Err(PyValueError::new_err(format!("out: unknown output {name:?}"))),
            }
        }
        Ok(buffers)
    }

    /// Returns the outputs that have an array.
    pub fn outputs(&self) -> Outputs {
        Outputs::POINTS
            .with_points(self.points.is_some())
            .with_normals(self.normals.is_some())
            .with_curvature(self.curvature.is_some())
            .with_depth_m(self.depth_m.is_some())
            .with_frames(self.frames.is_some())
            .with_sigma(self.sigma.is_some())
            .with_depth(self.depth.is_some())
            .with_neighbours(self.neighbours.is_some())
            .with_status(self.status.is_some())
    }

    pub fn slices(&mut self) -> PyResult<Slices<'_>> {
        let vectors = |name: &str, values: Option<&mut [f32]>| -> PyResult<()> {
            match values {
                Some(values) if values.len() % 3 != 0 => {
                    Err(PyValueError::new_err(format!("out[{name:?}]: the last dimension must be 3")))
                }
                _ => Ok(()),
            }
        };
        vectors("points", slice("points", &mut self.points)?)?;
        vectors("normals", slice("normals", &mut self.normals)?)?;
        Ok(Slices {
            points: slice("points", &mut self.points)?.map(|values| values.as_chunks_mut().0),
            normals: slice("normals", &mut self.normals)?.map(|values| values.as_chunks_mut().0),
            curvature: slice("curvature", &mut self.curvature)?,
            depth_m: slice("depth_m", &mut self.depth_m)?,
            frames: slice("frames", &mut self.frames)?,
            sigma: slice("sigma", &mut self.sigma)?,
            depth: slice("depth", &mut self.depth)?,
            neighbours: slice("neighbours", &mut self.neighbours)?,
            status: slice("status", &mut self.status)?,
        })
    }
}

impl<'a> Slices<'a> {
    /// Returns the slices as the library's output buffers. The status is written to `status`;
    /// [`store_status`](Self::store_status) then copies it to the array.
    pub fn smoothed_mut<'b>(&'b mut self, status: &'b mut Vec<Status>) -> SmoothedMut<'b> {
        let mut out = SmoothedMut::new();
        if let Some(codes) = &self.status {
            status.resize(codes.len(), Status::Hole);
            out = out.with_status(status);
        }
        out.points = self.points.as_deref_mut().map(Into::into);
        out.normals = self.normals.as_deref_mut().map(Into::into);
        out.curvature = self.curvature.as_deref_mut();
        out.depth_m = self.depth_m.as_deref_mut();
        out.frames = self.frames.as_deref_mut();
        out.sigma = self.sigma.as_deref_mut();
        out.depth = self.depth.as_deref_mut();
        out.neighbours = self.neighbours.as_deref_mut();
        out
    }

    /// Writes the status codes of the pixels.
    pub fn store_status(&mut self, status: impl Iterator<Item = Status>) {
        if let Some(codes) = &mut self.status {
            codes.iter_mut().zip(status).for_each(|(code, status)| *code = status as u8);
        }
    }
}
