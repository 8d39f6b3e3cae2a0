//! The Python class that wraps a smoother for frames in CUDA memory.

use std::sync::Mutex;

use planish::{CudaSmoother, Error};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::camera::PyCamera;
use crate::dlpack::PyCudaArray;
use crate::errors::to_py;
use crate::settings::from_dict;

#[pyclass(frozen, name = "CudaEngine", module = "planish._planish")]
pub struct PyCudaSmoother(Mutex<CudaSmoother>);

impl PyCudaSmoother {
    fn with<T: Send>(
        &self,
        py: Python<'_>,
        body: impl FnOnce(&mut CudaSmoother) -> Result<T, Error> + Send,
    ) -> PyResult<T> {
        let in_use = |_| {
            PyRuntimeError::new_err("this CudaSmoother is in use by another thread; open one CudaSmoother per thread")
        };
        let mut smoother = self.0.try_lock().map_err(in_use)?;
        let smoother = &mut *smoother;
        py.detach(|| body(smoother)).map_err(to_py)
    }
}

#[pymethods]
impl PyCudaSmoother {
    #[new]
    fn new(
        py: Python<'_>,
        settings: &Bound<'_, PyDict>,
        camera: PyRef<'_, PyCamera>,
        is_metres: bool,
    ) -> PyResult<Self> {
        let (settings, camera) = (from_dict(settings)?, camera.0);
        // Compilation takes about a second, during which other Python threads can run.
        let smoother = py.detach(|| CudaSmoother::open(&settings, &camera, is_metres)).map_err(to_py)?;
        Ok(Self(Mutex::new(smoother)))
    }

    /// Smooths the image at the address `depth` and writes the result to the address `result`. Frames must not be in
    /// flight.
    fn smooth(&self, py: Python<'_>, depth: u64, row_stride: usize, result: u64, stream: usize) -> PyResult<()> {
        // SAFETY: same as in `submit`.
        self.with(py, |smoother| unsafe { smoother.smooth(depth, row_stride, result, stream) })
    }

    /// Submits the image at the address `depth`.
    fn submit(&self, py: Python<'_>, depth: u64, row_stride: usize, stream: usize) -> PyResult<()> {
        // SAFETY: the Python class checks the arrays and keeps them until its next call. Its documentation states how
        // long the caller must keep them.
        self.with(py, |smoother| unsafe { smoother.submit(depth, row_stride, stream) })
    }

    /// Copies the oldest result to the address `result`; returns false if no frame is in flight.
    fn receive(&self, py: Python<'_>, result: u64, stream: usize) -> PyResult<bool> {
        // SAFETY: same as in `submit`.
        self.with(py, |smoother| unsafe { smoother.receive(result, stream) })
    }

    /// Discards the frames in flight.
    fn forget(&self, py: Python<'_>) -> PyResult<()> {
        self.with(py, |smoother| {
            smoother.forget();
            Ok(())
        })
    }

    /// Allocates memory for the result of an image with this height and width.
    fn new_result(&self, py: Python<'_>, height: usize, width: usize) -> PyResult<PyCudaArray> {
        self.with(py, |smoother| Ok(PyCudaArray::new(smoother.new_result()?, [smoother.channels(), height, width])))
    }

    /// Returns the number of channels of a result, the number of frames in flight, and their maximum number.
    fn counts(&self, py: Python<'_>) -> PyResult<(usize, usize, usize)> {
        self.with(py, |smoother| Ok((smoother.channels(), smoother.in_flight(), smoother.max_in_flight())))
    }

    fn gpu_name(&self, py: Python<'_>) -> PyResult<String> {
        self.with(py, |smoother| Ok(smoother.gpu_name().to_owned()))
    }
}
