//! CUDA's driver library, loaded at run time: device memory, kernels, and copies on a stream.

use std::ffi::{CStr, CString, c_char, c_int, c_uint, c_void};
use std::ptr;
use std::sync::Arc;

use libloading::Library;

use super::functions::functions;
use crate::devices::find;
use crate::error::EngineError;

#[cfg(not(windows))]
const LIBRARY: &str = "libcuda.so.1";
#[cfg(windows)]
const LIBRARY: &str = "nvcuda.dll";

/// An address in device memory.
pub(super) type DevicePointer = u64;
/// A driver handle.
type Handle = *mut c_void;

const DEVICE_MEMORY: c_uint = 2;
const CAPABILITY_MAJOR: c_int = 75;
const CAPABILITY_MINOR: c_int = 76;
const DEVICE_ORDINAL: c_int = 9;
const OUT_OF_MEMORY: c_int = 2;
/// Flag of an event without timestamps.
const NO_TIMING: c_uint = 2;
/// The legacy default stream, on which the driver clears memory and uploads data.
const DEFAULT_STREAM: usize = 0;

/// Parameters of a copy: `CUDA_MEMCPY2D` in cuda.h.
#[repr(C)]
struct Copy2d {
    src_x: usize,
    src_y: usize,
    src_type: c_uint,
    src_host: *const c_void,
    src_device: DevicePointer,
    src_array: Handle,
    src_pitch: usize,
    dst_x: usize,
    dst_y: usize,
    dst_type: c_uint,
    dst_host: *mut c_void,
    dst_device: DevicePointer,
    dst_array: Handle,
    dst_pitch: usize,
    width_bytes: usize,
    height: usize,
}

const _: () = assert!(size_of::<Copy2d>() == 128);

functions! {
    init = "cuInit"(c_uint);
    driver_version = "cuDriverGetVersion"(*mut c_int);
    device_count = "cuDeviceGetCount"(*mut c_int);
    device_get = "cuDeviceGet"(*mut c_int, c_int);
    device_name = "cuDeviceGetName"(*mut c_char, c_int, c_int);
    device_attribute = "cuDeviceGetAttribute"(*mut c_int, c_int, c_int);
    context_current = "cuCtxGetCurrent"(*mut Handle);
    context_device = "cuCtxGetDevice"(*mut c_int);
    context_push = "cuCtxPushCurrent_v2"(Handle);
    context_pop = "cuCtxPopCurrent_v2"(*mut Handle);
    primary_context = "cuDevicePrimaryCtxRetain"(*mut Handle, c_int);
    release_context = "cuDevicePrimaryCtxRelease_v2"(c_int);
    load_module = "cuModuleLoadData"(*mut Handle, *const c_void);
    unload_module = "cuModuleUnload"(Handle);
    create_event = "cuEventCreate"(*mut Handle, c_uint);
    record_event = "cuEventRecord"(Handle, Handle);
    wait_for_event = "cuStreamWaitEvent"(Handle, Handle, c_uint);
    synchronize_event = "cuEventSynchronize"(Handle);
    destroy_event = "cuEventDestroy_v2"(Handle);
    get_function = "cuModuleGetFunction"(*mut Handle, Handle, *const c_char);
    launch = "cuLaunchKernel"(
        Handle, c_uint, c_uint, c_uint, c_uint, c_uint, c_uint, c_uint, Handle, *mut *mut c_void, *mut *mut c_void
    );
    allocate = "cuMemAlloc_v2"(*mut DevicePointer, usize);
    free = "cuMemFree_v2"(DevicePointer);
    upload = "cuMemcpyHtoD_v2"(DevicePointer, *const c_void, usize);
    clear = "cuMemsetD8_v2"(DevicePointer, u8, usize);
    copy_2d = "cuMemcpy2DAsync_v2"(*const Copy2d, Handle);
    copy = "cuMemcpyDtoDAsync_v2"(DevicePointer, DevicePointer, usize, Handle);
    synchronize = "cuStreamSynchronize"(Handle);
    pointer_attribute = "cuPointerGetAttribute"(*mut c_int, c_int, DevicePointer);
    error_name = "cuGetErrorName"(c_int, *mut *const c_char);
}

/// The driver, and a device's primary context, which PyTorch, CuPy and JAX also use.
pub(super) struct Cuda {
    functions: Functions,
    context: Handle,
    /// The device's number in CUDA.
    pub(super) device: c_int,
    pub(super) name: String,
    /// Ten times the compute capability: 90 for 9.0.
    pub(super) capability: i32,
    /// The driver's major version.
    pub(super) driver_major: i32,
}

// SAFETY: the driver's functions may be called from any thread; the context is set around each call.
unsafe impl Send for Cuda {}
// SAFETY: same as `Send`.
unsafe impl Sync for Cuda {}

/// Device memory. Dropping it frees the memory after the device has finished all work that uses it.
pub(super) struct Memory {
    cuda: Arc<Cuda>,
    pub(super) address: DevicePointer,
}

/// A compiled kernel with its entry point. It must not be dropped while a stream runs it.
pub(super) struct Kernel {
    cuda: Arc<Cuda>,
    module: usize,
    function: usize,
}

/// A point in the work of a stream. The stream may be destroyed before the event.
pub(super) struct Event {
    cuda: Arc<Cuda>,
    event: usize,
}

/// The numbers of blocks and threads of a launch.
#[derive(Debug, Clone, Copy)]
pub(super) struct Grid {
    /// Number of blocks along x, y and z.
    pub(super) blocks: [u32; 3],
    /// Number of threads per block along x and y.
    pub(super) threads: [u32; 2],
}

impl Cuda {
    /// Loads the driver, and opens a device by its index or a part of its name. `None` opens the device of the
    /// calling thread's context, or the first device if the thread has no context.
    pub(super) fn open(wanted: Option<&str>) -> Result<Self, String> {
        // SAFETY: loading the driver's library has no other effects.
        let library = unsafe { Library::new(LIBRARY) }.map_err(|_| format!("no CUDA driver was found ({LIBRARY})"))?;
        let functions = Functions::load(library, LIBRARY)?;
        let mut cuda = Self {
            functions,
            context: ptr::null_mut(),
            device: 0,
            name: String::new(),
            capability: 0,
            driver_major: 0,
        };
        // SAFETY: the arguments have the types and lifetimes that cuda.h requires.
        unsafe {
            cuda.check("cuInit", (cuda.functions.init)(0))?;
            let mut version = 0;
            cuda.check("cuDriverGetVersion", (cuda.functions.driver_version)(&mut version))?;
            cuda.driver_major = version / 1000;
            cuda.device = cuda.choose(wanted)?;
            cuda.name = cuda.name_of(cuda.device)?;
            let [mut major, mut minor] = [0; 2];
            for (value, attribute) in [(&mut major, CAPABILITY_MAJOR), (&mut minor, CAPABILITY_MINOR)] {
                let code = (cuda.functions.device_attribute)(value, attribute, cuda.device);
                cuda.check("cuDeviceGetAttribute", code)?;
            }
            cuda.capability = 10 * major + minor;
            let mut context = ptr::null_mut();
            let code = (cuda.functions.primary_context)(&mut context, cuda.device);
            cuda.check("cuDevicePrimaryCtxRetain", code)?;
            cuda.context = context;
        }
        Ok(cuda)
    }

    fn choose(&self, wanted: Option<&str>) -> Result<c_int, String> {
        let mut count = 0;
        // SAFETY: the argument has the type and lifetime that cuda.h requires.
        self.check("cuDeviceGetCount", unsafe { (self.functions.device_count)(&mut count) })?;
        let device = |index: c_int| {
            let mut device = 0;
            // SAFETY: the index is below the count.
            self.check("cuDeviceGet", unsafe { (self.functions.device_get)(&mut device, index) })?;
            Ok::<_, String>(device)
        };
        let names = (0..count).map(|index| self.name_of(device(index)?)).collect::<Result<Vec<_>, _>>()?;
        let Some(wanted) = wanted else {
            let mut current = 0;
            // SAFETY: an error means that the thread has no context.
            let is_current = unsafe { (self.functions.context_device)(&mut current) } == 0;
            return if is_current {
                Ok(current)
            } else if count > 0 {
                device(0)
            } else {
                Err("no CUDA device was found".into())
            };
        };
        match find(&names, wanted) {
            Some(index) => device(index as c_int),
            None => Err(format!("no CUDA device has the index or name '{wanted}'; available are {}", names.join(", "))),
        }
    }

    fn name_of(&self, device: c_int) -> Result<String, String> {
        let mut name: [c_char; 256] = [0; 256];
        // SAFETY: the buffer has the given length; the driver ends the text with a zero.
        unsafe {
            let code = (self.functions.device_name)(name.as_mut_ptr(), name.len() as c_int, device);
            self.check("cuDeviceGetName", code)?;
            Ok(CStr::from_ptr(name.as_ptr()).to_string_lossy().into_owned())
        }
    }

    fn check(&self, what: &str, code: c_int) -> Result<(), String> {
        if code == 0 {
            return Ok(());
        }
        let mut name = ptr::null();
        // SAFETY: the name is null or a static string of the driver, which ends in a zero.
        let name = unsafe {
            (self.functions.error_name)(code, &mut name);
            if name.is_null() { "an unknown error".into() } else { CStr::from_ptr(name).to_string_lossy() }
        };
        Err(format!("{what}: {name} ({code})"))
    }

    /// Runs `body` in the device's context, and then restores the thread's context.
    pub(super) fn within<T>(&self, body: impl FnOnce() -> Result<T, String>) -> Result<T, String> {
        let mut current = ptr::null_mut();
        // SAFETY: the context is retained for as long as `self` lives.
        unsafe {
            self.check("cuCtxGetCurrent", (self.functions.context_current)(&mut current))?;
            if current == self.context {
                return body();
            }
            self.check("cuCtxPushCurrent", (self.functions.context_push)(self.context))?;
            let result = body();
            let mut popped = ptr::null_mut();
            self.check("cuCtxPopCurrent", (self.functions.context_pop)(&mut popped))?;
            result
        }
    }

    /// Loads machine code or PTX with one entry point.
    pub(super) fn load(self: &Arc<Self>, code: &[u8], entry_point: &str) -> Result<Kernel, String> {
        let name = CString::new(entry_point).map_err(|error| error.to_string())?;
        let mut kernel = Kernel { cuda: Arc::clone(self), module: 0, function: 0 };
        let (mut module, mut function) = (ptr::null_mut(), ptr::null_mut());
        // SAFETY: the code is complete (NVRTC ends PTX with a zero), and the name ends with a zero.
        self.within(|| unsafe {
            self.check("cuModuleLoadData", (self.functions.load_module)(&mut module, code.as_ptr().cast()))?;
            kernel.module = module as usize;
            let code = (self.functions.get_function)(&mut function, module, name.as_ptr());
            self.check("cuModuleGetFunction", code)
        })?;
        kernel.function = function as usize;
        Ok(kernel)
    }

    /// Launches a kernel on a stream.
    ///
    /// # Safety
    /// Each argument must point to a value of its kernel parameter's type. Addresses among these values must be valid
    /// until the stream has run the kernel.
    pub(super) unsafe fn launch(
        &self,
        kernel: &Kernel,
        grid: Grid,
        arguments: &mut [*mut c_void],
        stream: usize,
    ) -> Result<(), String> {
        let Grid { blocks: [x, y, z], threads: [across, down] } = grid;
        let (function, stream) = (kernel.function as Handle, stream as Handle);
        // SAFETY: the caller guarantees that the arguments and the stream are valid.
        let code = unsafe {
            let arguments = arguments.as_mut_ptr();
            (self.functions.launch)(function, x, y, z, across, down, 1, 0, stream, arguments, ptr::null_mut())
        };
        self.check("cuLaunchKernel", code)
    }

    /// Allocates device memory, filled with zeros if `is_zero`.
    pub(super) fn allocate(self: &Arc<Self>, bytes: usize, is_zero: bool) -> Result<Memory, EngineError> {
        let mut address = 0;
        let mut is_full = false;
        // SAFETY: the driver writes the address.
        let allocated = self.within(|| unsafe {
            let code = (self.functions.allocate)(&mut address, bytes);
            is_full = code == OUT_OF_MEMORY;
            self.check(&format!("cuMemAlloc of {bytes} bytes"), code)
        });
        match allocated {
            Ok(()) => {}
            Err(reason) if is_full => {
                return Err(EngineError::OutOfMemory { device: self.name.clone(), bytes: bytes as u64, reason });
            }
            Err(reason) => return Err(self.failed(reason)),
        }
        let memory = Memory { cuda: Arc::clone(self), address };
        if is_zero {
            // SAFETY: the memory has this length.
            let cleared =
                self.within(|| unsafe { self.check("cuMemsetD8", (self.functions.clear)(address, 0, bytes)) });
            cleared.map_err(|reason| self.failed(reason))?;
        }
        Ok(memory)
    }

    /// Copies parts of host memory to device addresses, and waits for the copies.
    ///
    /// # Safety
    /// Each address must be in device memory with room for its part.
    pub(super) unsafe fn upload(
        &self,
        parts: impl Iterator<Item = (DevicePointer, impl AsRef<[u8]>)>,
    ) -> Result<(), String> {
        self.within(|| {
            for (to, from) in parts {
                let from = from.as_ref();
                // SAFETY: the caller guarantees that the address is valid.
                let code = unsafe { (self.functions.upload)(to, from.as_ptr().cast(), from.len()) };
                self.check("cuMemcpyHtoD", code)?;
            }
            // The copies above may return before the data have arrived.
            // SAFETY: the default stream exists.
            let code = unsafe { (self.functions.synchronize)(DEFAULT_STREAM as Handle) };
            self.check("cuStreamSynchronize", code)
        })
    }

    /// Creates an event. Until it is recorded, waiting for it returns immediately.
    pub(super) fn event(self: &Arc<Self>) -> Result<Event, String> {
        let mut event = ptr::null_mut();
        // SAFETY: the driver writes the handle.
        self.within(|| unsafe { self.check("cuEventCreate", (self.functions.create_event)(&mut event, NO_TIMING)) })?;
        Ok(Event { cuda: Arc::clone(self), event: event as usize })
    }

    /// Copies rows of device memory to contiguous rows.
    ///
    /// # Safety
    /// Both addresses must be valid for the copied rows until the stream has run the copy.
    pub(super) unsafe fn copy_rows(
        &self,
        (to, from): (DevicePointer, DevicePointer),
        from_stride: usize,
        (row_bytes, rows): (usize, usize),
        stream: usize,
    ) -> Result<(), String> {
        // SAFETY: the caller guarantees that the addresses and the stream are valid.
        unsafe {
            if from_stride == row_bytes {
                let code = (self.functions.copy)(to, from, row_bytes * rows, stream as Handle);
                return self.check("cuMemcpyDtoDAsync", code);
            }
            let copy = Copy2d {
                src_x: 0,
                src_y: 0,
                src_type: DEVICE_MEMORY,
                src_host: ptr::null(),
                src_device: from,
                src_array: ptr::null_mut(),
                src_pitch: from_stride,
                dst_x: 0,
                dst_y: 0,
                dst_type: DEVICE_MEMORY,
                dst_host: ptr::null_mut(),
                dst_device: to,
                dst_array: ptr::null_mut(),
                dst_pitch: row_bytes,
                width_bytes: row_bytes,
                height: rows,
            };
            self.check("cuMemcpy2DAsync", (self.functions.copy_2d)(&copy, stream as Handle))
        }
    }

    /// Returns true if an address is in memory of this device.
    pub(super) fn has(&self, address: DevicePointer) -> bool {
        let mut ordinal = -1;
        // SAFETY: the driver recognizes its own addresses, and returns an error for others.
        let found = self.within(|| unsafe {
            let code = (self.functions.pointer_attribute)(&mut ordinal, DEVICE_ORDINAL, address);
            self.check("cuPointerGetAttribute", code)
        });
        found.is_ok() && ordinal == self.device
    }

    /// Returns an error that names this device.
    pub(super) fn failed(&self, reason: String) -> EngineError {
        EngineError::Device { device: self.name.clone(), reason }
    }
}

impl Event {
    /// Moves the event to the end of the work already added to the stream.
    pub(super) fn record(&self, stream: usize) -> Result<(), String> {
        let Self { cuda, event } = self;
        // SAFETY: the event is alive, and so is the stream that the caller passed.
        cuda.within(|| unsafe {
            cuda.check("cuEventRecord", (cuda.functions.record_event)(*event as Handle, stream as Handle))
        })
    }

    /// Makes a stream wait for the event.
    pub(super) fn wait_on(&self, stream: usize) -> Result<(), String> {
        let Self { cuda, event } = self;
        // SAFETY: the event is alive, and so is the stream that the caller passed.
        cuda.within(|| unsafe {
            cuda.check("cuStreamWaitEvent", (cuda.functions.wait_for_event)(stream as Handle, *event as Handle, 0))
        })
    }

    /// Blocks the calling thread until the event occurs.
    pub(super) fn synchronize(&self) -> Result<(), String> {
        let Self { cuda, event } = self;
        // SAFETY: the event is alive.
        cuda.within(|| unsafe {
            cuda.check("cuEventSynchronize", (cuda.functions.synchronize_event)(*event as Handle))
        })
    }
}

// Errors in these destructors cannot be reported, so they are ignored.

impl Drop for Memory {
    fn drop(&mut self) {
        let Self { cuda, address } = self;
        let _ = cuda.within(|| {
            // SAFETY: the driver allocated the memory, which is freed only here.
            let code = unsafe { (cuda.functions.free)(*address) };
            cuda.check("cuMemFree", code)
        });
    }
}

impl Drop for Kernel {
    fn drop(&mut self) {
        let Self { cuda, module, .. } = self;
        let _ = cuda.within(|| {
            // SAFETY: the driver loaded the module, which is unloaded only here.
            let code = unsafe { (cuda.functions.unload_module)(*module as Handle) };
            cuda.check("cuModuleUnload", code)
        });
    }
}

impl Drop for Event {
    fn drop(&mut self) {
        let Self { cuda, event } = self;
        let _ = cuda.within(|| {
            // SAFETY: the driver created the event, which is destroyed only here.
            let code = unsafe { (cuda.functions.destroy_event)(*event as Handle) };
            cuda.check("cuEventDestroy", code)
        });
    }
}

impl Drop for Cuda {
    fn drop(&mut self) {
        if !self.context.is_null() {
            // SAFETY: `self` retained the context once.
            unsafe { (self.functions.release_context)(self.device) };
        }
    }
}
