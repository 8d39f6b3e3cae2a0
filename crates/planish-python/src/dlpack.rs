//! Results in CUDA memory for libraries that read DLPack or `__cuda_array_interface__`.
//!
//! A DLPack capsule contains a `DLManagedTensor` (dlpack.h, version 0). The reader takes ownership of the tensor by
//! renaming the capsule, and calls the tensor's deleter when it no longer needs the memory.

use std::ffi::{CStr, c_int, c_void};
use std::ptr::{self, NonNull};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use planish::CudaMemory;
use pyo3::exceptions::PyBufferError;
use pyo3::ffi;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::errors::to_py;

const CUDA: c_int = 2;
const FLOAT: u8 = 2;
/// Name of a capsule whose tensor no reader has taken.
const FRESH: &CStr = c"dltensor";
/// Stream number by which a reader requests no synchronization.
const NO_ORDER: isize = -1;
/// Number of the default stream in DLPack and in CUDA's array interface.
const DEFAULT_STREAM: usize = 1;

#[repr(C)]
struct DlTensor {
    data: *mut c_void,
    device_type: c_int,
    device_id: c_int,
    dimensions: c_int,
    code: u8,
    bits: u8,
    lanes: u16,
    shape: *mut i64,
    strides: *mut i64,
    byte_offset: u64,
}

#[repr(C)]
struct DlManagedTensor {
    tensor: DlTensor,
    manager: *mut c_void,
    deleter: Option<unsafe extern "C" fn(*mut DlManagedTensor)>,
}

/// A managed tensor and the data that it owns.
struct Owner {
    managed: DlManagedTensor,
    shape: [i64; 3],
    _memory: Arc<CudaMemory>,
}

/// A float32 array [channels, height, width] in CUDA memory.
#[pyclass(frozen, name = "CudaArray", module = "planish")]
pub struct PyCudaArray {
    /// `None` only while the array is dropped.
    memory: Option<Arc<CudaMemory>>,
    shape: [i64; 3],
    /// The last stream that wrote the array.
    stream: AtomicUsize,
}

impl PyCudaArray {
    pub fn new(memory: CudaMemory, shape: [usize; 3]) -> Self {
        let shape = shape.map(|side| side as i64);
        Self { memory: Some(Arc::new(memory)), shape, stream: AtomicUsize::new(DEFAULT_STREAM) }
    }

    fn memory(&self) -> PyResult<&Arc<CudaMemory>> {
        self.memory.as_ref().ok_or_else(|| PyBufferError::new_err("the memory of this array was released"))
    }
}

impl Drop for PyCudaArray {
    fn drop(&mut self) {
        let memory = self.memory.take();
        // Freeing waits for the GPU, which may wait for a callback in Python.
        Python::try_attach(|py| py.detach(|| drop(memory)));
    }
}

#[pymethods]
impl PyCudaArray {
    /// Number of channels, height and width.
    #[getter]
    fn shape(&self) -> (i64, i64, i64) {
        self.shape.into()
    }

    /// CUDA's array interface, version 3.
    #[getter]
    fn __cuda_array_interface__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let interface = PyDict::new(py);
        interface.set_item("shape", self.shape())?;
        interface.set_item("typestr", "<f4")?;
        interface.set_item("data", (self.memory()?.address(), false))?;
        interface.set_item("strides", py.None())?;
        interface.set_item("stream", self.stream.load(Ordering::Relaxed))?;
        interface.set_item("version", 3)?;
        Ok(interface)
    }

    /// Records that the work submitted to a stream so far writes the array.
    fn written_by(&self, stream: usize) -> PyResult<()> {
        self.stream.store(stream.max(DEFAULT_STREAM), Ordering::Relaxed);
        // SAFETY: the Python class passes the stream of its current call.
        unsafe { self.memory()?.written_by(stream) }.map_err(to_py)
    }

    /// DLPack's device type, and the number of the device.
    fn __dlpack_device__(&self) -> PyResult<(c_int, c_int)> {
        Ok((CUDA, self.memory()?.device()))
    }

    /// Returns the array as a DLPack capsule, ready for reading on the reader's stream.
    #[pyo3(signature = (*, stream = None, max_version = None, dl_device = None, copy = None))]
    fn __dlpack__(
        &self,
        py: Python<'_>,
        stream: Option<isize>,
        max_version: Option<(u32, u32)>,
        dl_device: Option<(c_int, c_int)>,
        copy: Option<bool>,
    ) -> PyResult<Py<PyAny>> {
        // Readers of later versions also accept capsules of version 0.
        let _ = max_version;
        let (memory, device) = (self.memory()?, self.__dlpack_device__()?);
        if dl_device.is_some_and(|wanted| wanted != device) || copy == Some(true) {
            return Err(PyBufferError::new_err("a CudaArray can be shared only on its own device and without a copy"));
        }
        let reads_on = stream.filter(|stream| *stream != 0).unwrap_or(DEFAULT_STREAM as isize);
        if reads_on != NO_ORDER {
            // SAFETY: DLPack's readers pass the stream on which they read.
            unsafe { memory.wait_on(reads_on.cast_unsigned()) }.map_err(to_py)?;
        }
        let owner = Box::new(Owner {
            managed: DlManagedTensor {
                tensor: DlTensor {
                    data: ptr::with_exposed_provenance_mut(memory.address() as usize),
                    device_type: CUDA,
                    device_id: device.1,
                    dimensions: 3,
                    code: FLOAT,
                    bits: 32,
                    lanes: 1,
                    shape: ptr::null_mut(),
                    strides: ptr::null_mut(),
                    byte_offset: 0,
                },
                manager: ptr::null_mut(),
                deleter: Some(delete),
            },
            shape: self.shape,
            _memory: Arc::clone(memory),
        });
        let owner = NonNull::from(Box::leak(owner));
        // SAFETY: the owner lives until the deleter is called, by the reader or by `drop_fresh`.
        unsafe {
            (*owner.as_ptr()).managed.manager = owner.as_ptr().cast();
            (*owner.as_ptr()).managed.tensor.shape = (&raw mut (*owner.as_ptr()).shape).cast();
            let managed = &raw mut (*owner.as_ptr()).managed;
            let capsule = ffi::PyCapsule_New(managed.cast(), FRESH.as_ptr(), Some(drop_fresh));
            let capsule = Bound::from_owned_ptr_or_err(py, capsule);
            if capsule.is_err() {
                delete(managed);
            }
            Ok(capsule?.unbind())
        }
    }

    fn __repr__(&self) -> PyResult<String> {
        let [channels, height, width] = self.shape;
        Ok(format!("CudaArray(float32 [{channels}, {height}, {width}], device {})", self.memory()?.device()))
    }
}

/// Frees a managed tensor's data.
///
/// # Safety
/// `managed` must have been created by this module, and must not be used afterwards.
unsafe extern "C" fn delete(managed: *mut DlManagedTensor) {
    // SAFETY: the manager is the owner, which was leaked.
    drop(unsafe { Box::from_raw((*managed).manager.cast::<Owner>()) });
}

/// Frees a tensor that no reader has taken.
///
/// # Safety
/// The capsule must have been created by this module. Python calls this function when it destroys the capsule.
unsafe extern "C" fn drop_fresh(capsule: *mut ffi::PyObject) {
    // SAFETY: the capsule still owns its tensor if its name is still `FRESH`.
    unsafe {
        if ffi::PyCapsule_IsValid(capsule, FRESH.as_ptr()) == 1 {
            delete(ffi::PyCapsule_GetPointer(capsule, FRESH.as_ptr()).cast());
        }
    }
}
