//! CUDA's driver library, loaded at run time: importing memory and semaphores of Vulkan, and copies on a stream.

use std::ffi::{CStr, c_char, c_int, c_uint, c_void};
use std::os::fd::{AsRawFd, IntoRawFd, OwnedFd};
use std::ptr;

use libloading::Library;

const LIBRARY: &str = "libcuda.so.1";

/// An address in device memory.
pub(super) type DevicePointer = u64;
/// A handle of the driver's.
type Handle = *mut c_void;

const OPAQUE_FD: c_uint = 1;
const TIMELINE_SEMAPHORE_FD: c_uint = 9;
const DEDICATED: c_uint = 1;
const DEVICE_MEMORY: c_uint = 2;

/// The first 24 bytes of CUDA_EXTERNAL_MEMORY_HANDLE_DESC and CUDA_EXTERNAL_SEMAPHORE_HANDLE_DESC: the kind of handle,
/// then a union of 16 bytes at a multiple of 8.
#[repr(C, align(8))]
struct HandleDescription {
    kind: c_uint,
    _gap: c_uint,
    fd: c_int,
    _rest_of_union: [c_uint; 3],
}

#[repr(C)]
struct MemoryDescription {
    handle: HandleDescription,
    size: u64,
    flags: c_uint,
    reserved: [c_uint; 16],
}

#[repr(C)]
struct BufferDescription {
    offset: u64,
    size: u64,
    flags: c_uint,
    reserved: [c_uint; 16],
}

#[repr(C)]
struct SemaphoreDescription {
    handle: HandleDescription,
    flags: c_uint,
    reserved: [c_uint; 16],
}

/// CUDA_EXTERNAL_SEMAPHORE_SIGNAL_PARAMS and ..._WAIT_PARAMS: of both the value comes first, and the rest is 0.
#[repr(C)]
struct SemaphoreParams {
    value: u64,
    rest: [u64; 17],
}

/// CUDA_MEMCPY2D.
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

const _: () = assert!(size_of::<MemoryDescription>() == 104 && size_of::<SemaphoreDescription>() == 96);
const _: () = assert!(size_of::<SemaphoreParams>() == 144 && size_of::<Copy2d>() == 128);

macro_rules! functions {
    ($($name:ident = $symbol:literal ( $($argument:ty),* );)*) => {
        /// The functions of the library that are used.
        struct Functions {
            $($name: unsafe extern "C" fn($($argument),*) -> c_int,)*
            _library: Library,
        }

        impl Functions {
            fn load() -> Result<Self, String> {
                // SAFETY: loading the driver's library has no other effects.
                let library = unsafe { Library::new(LIBRARY) }.map_err(|error| format!("no CUDA driver: {error}"))?;
                // SAFETY: the signatures match cuda.h.
                unsafe {
                    Ok(Self {
                        $($name: *library
                            .get(concat!($symbol, "\0").as_bytes())
                            .map_err(|_| format!("{LIBRARY} is too old: it lacks {}", $symbol))?,)*
                        _library: library,
                    })
                }
            }
        }
    };
}

functions! {
    init = "cuInit"(c_uint);
    device_count = "cuDeviceGetCount"(*mut c_int);
    device_get = "cuDeviceGet"(*mut c_int, c_int);
    device_uuid = "cuDeviceGetUuid"(*mut [u8; 16], c_int);
    context_current = "cuCtxGetCurrent"(*mut Handle);
    context_push = "cuCtxPushCurrent_v2"(Handle);
    context_pop = "cuCtxPopCurrent_v2"(*mut Handle);
    primary_context = "cuDevicePrimaryCtxRetain"(*mut Handle, c_int);
    import_memory = "cuImportExternalMemory"(*mut Handle, *const MemoryDescription);
    mapped_buffer = "cuExternalMemoryGetMappedBuffer"(*mut DevicePointer, Handle, *const BufferDescription);
    destroy_memory = "cuDestroyExternalMemory"(Handle);
    import_semaphore = "cuImportExternalSemaphore"(*mut Handle, *const SemaphoreDescription);
    destroy_semaphore = "cuDestroyExternalSemaphore"(Handle);
    signal = "cuSignalExternalSemaphoresAsync"(*const Handle, *const SemaphoreParams, c_uint, Handle);
    wait = "cuWaitExternalSemaphoresAsync"(*const Handle, *const SemaphoreParams, c_uint, Handle);
    copy_2d = "cuMemcpy2DAsync_v2"(*const Copy2d, Handle);
    copy = "cuMemcpyDtoDAsync_v2"(DevicePointer, DevicePointer, usize, Handle);
    free = "cuMemFree_v2"(DevicePointer);
    synchronize = "cuStreamSynchronize"(Handle);
    error_name = "cuGetErrorName"(c_int, *mut *const c_char);
}

/// The driver, and a device's primary context, which PyTorch, CuPy and JAX use too.
pub(super) struct Cuda {
    functions: Functions,
    context: Handle,
}

// SAFETY: the driver's functions may be called from any thread; the context is set around each call.
unsafe impl Send for Cuda {}
// SAFETY: the same.
unsafe impl Sync for Cuda {}

/// Memory of Vulkan as CUDA sees it.
pub(super) struct ImportedMemory {
    memory: usize,
    pub(super) address: DevicePointer,
}

/// A timeline semaphore of Vulkan as CUDA sees it.
pub(super) struct ImportedSemaphore(usize);

impl Cuda {
    /// Loads the driver, and opens the device with this UUID.
    pub(super) fn open(uuid: [u8; 16]) -> Result<Self, String> {
        let functions = Functions::load()?;
        let mut cuda = Self { functions, context: ptr::null_mut() };
        // SAFETY: the arguments are as cuda.h asks for.
        unsafe {
            cuda.check("cuInit", (cuda.functions.init)(0))?;
            let mut count = 0;
            cuda.check("cuDeviceGetCount", (cuda.functions.device_count)(&mut count))?;
            for i in 0..count {
                let (mut device, mut found) = (0, [0; 16]);
                cuda.check("cuDeviceGet", (cuda.functions.device_get)(&mut device, i))?;
                cuda.check("cuDeviceGetUuid", (cuda.functions.device_uuid)(&mut found, device))?;
                if found == uuid {
                    let mut context = ptr::null_mut();
                    let code = (cuda.functions.primary_context)(&mut context, device);
                    cuda.check("cuDevicePrimaryCtxRetain", code)?;
                    cuda.context = context;
                    return Ok(cuda);
                }
            }
            Err(format!("none of {count} CUDA devices is the GPU that Vulkan opened"))
        }
    }

    fn check(&self, what: &str, code: c_int) -> Result<(), String> {
        if code == 0 {
            return Ok(());
        }
        let mut name = ptr::null();
        // SAFETY: the name is a text of the driver's, or null.
        let name = unsafe {
            (self.functions.error_name)(code, &mut name);
            if name.is_null() { "an unknown error".into() } else { CStr::from_ptr(name).to_string_lossy() }
        };
        Err(format!("{what}: {name} ({code})"))
    }

    /// Runs a body in the device's context, whatever the thread's is.
    fn within<T>(&self, body: impl FnOnce() -> Result<T, String>) -> Result<T, String> {
        let mut current = ptr::null_mut();
        // SAFETY: the context is retained for as long as this lives.
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

    /// Imports memory by a file descriptor, which the driver owns afterwards.
    pub(super) fn import_memory(&self, fd: OwnedFd, allocated: u64, bytes: u64) -> Result<ImportedMemory, String> {
        self.within(|| {
            let description = MemoryDescription {
                handle: HandleDescription { kind: OPAQUE_FD, _gap: 0, fd: fd.as_raw_fd(), _rest_of_union: [0; 3] },
                size: allocated,
                flags: DEDICATED,
                reserved: [0; 16],
            };
            let buffer = BufferDescription { offset: 0, size: bytes, flags: 0, reserved: [0; 16] };
            let (mut memory, mut address) = (ptr::null_mut(), 0);
            // SAFETY: the descriptions are complete.
            unsafe {
                let code = (self.functions.import_memory)(&mut memory, &description);
                self.check("cuImportExternalMemory", code)?;
                // The driver owns it now.
                let _ = fd.into_raw_fd();
                let code = (self.functions.mapped_buffer)(&mut address, memory, &buffer);
                self.check("cuExternalMemoryGetMappedBuffer", code)?;
            }
            Ok(ImportedMemory { memory: memory as usize, address })
        })
    }

    /// Imports a timeline semaphore by a file descriptor, which the driver owns afterwards.
    pub(super) fn import_semaphore(&self, fd: OwnedFd) -> Result<ImportedSemaphore, String> {
        self.within(|| {
            let description = SemaphoreDescription {
                handle: HandleDescription {
                    kind: TIMELINE_SEMAPHORE_FD,
                    _gap: 0,
                    fd: fd.as_raw_fd(),
                    _rest_of_union: [0; 3],
                },
                flags: 0,
                reserved: [0; 16],
            };
            let mut semaphore = ptr::null_mut();
            // SAFETY: the description is complete.
            let code = unsafe { (self.functions.import_semaphore)(&mut semaphore, &description) };
            self.check("cuImportExternalSemaphore", code)?;
            // The driver owns it now.
            let _ = fd.into_raw_fd();
            Ok(ImportedSemaphore(semaphore as usize))
        })
    }

    /// Has the semaphore signalled where the stream is now.
    pub(super) fn signal(&self, semaphore: &ImportedSemaphore, value: u64, stream: usize) -> Result<(), String> {
        let (handle, params) = (semaphore.0 as Handle, SemaphoreParams { value, rest: [0; 17] });
        // SAFETY: the semaphore is alive.
        self.within(|| unsafe {
            self.check(
                "cuSignalExternalSemaphoresAsync",
                (self.functions.signal)(&handle, &params, 1, stream as Handle),
            )
        })
    }

    /// Has the stream wait for a value of the semaphore.
    pub(super) fn wait(&self, semaphore: &ImportedSemaphore, value: u64, stream: usize) -> Result<(), String> {
        let (handle, params) = (semaphore.0 as Handle, SemaphoreParams { value, rest: [0; 17] });
        // SAFETY: the semaphore is alive.
        self.within(|| unsafe {
            self.check("cuWaitExternalSemaphoresAsync", (self.functions.wait)(&handle, &params, 1, stream as Handle))
        })
    }

    /// Copies rows of device memory to contiguous rows.
    ///
    /// # Safety
    /// Both are valid until the stream has run the copy.
    pub(super) unsafe fn copy_rows(
        &self,
        (to, from): (DevicePointer, DevicePointer),
        from_stride: usize,
        (row_bytes, rows): (usize, usize),
        stream: usize,
    ) -> Result<(), String> {
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
        self.within(|| {
            // SAFETY: as the caller promises.
            unsafe {
                if from_stride == row_bytes {
                    let code = (self.functions.copy)(to, from, row_bytes * rows, stream as Handle);
                    return self.check("cuMemcpyDtoDAsync", code);
                }
                self.check("cuMemcpy2DAsync", (self.functions.copy_2d)(&copy, stream as Handle))
            }
        })
    }

    /// Waits until a stream has run everything.
    pub(super) fn synchronize(&self, stream: usize) -> Result<(), String> {
        // SAFETY: the stream is the caller's.
        self.within(|| unsafe { self.check("cuStreamSynchronize", (self.functions.synchronize)(stream as Handle)) })
    }

    /// Gives imported memory back.
    pub(super) fn free_memory(&self, memory: &ImportedMemory) {
        // Nothing can be done about an error here.
        // SAFETY: it was imported, and is not used any more.
        let _ = self.within(|| unsafe {
            (self.functions.free)(memory.address);
            (self.functions.destroy_memory)(memory.memory as Handle);
            Ok(())
        });
    }

    /// Gives an imported semaphore back.
    pub(super) fn free_semaphore(&self, semaphore: &ImportedSemaphore) {
        // SAFETY: it was imported, and is not used any more.
        let _ = self.within(|| unsafe {
            (self.functions.destroy_semaphore)(semaphore.0 as Handle);
            Ok(())
        });
    }
}
