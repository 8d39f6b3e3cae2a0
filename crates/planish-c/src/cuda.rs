//! Smoothing of frames in CUDA device memory.

use std::ffi::{c_char, c_void};

use crate::error::{Done, guarded, planish_code};
use crate::frame::planish_camera;

/// A smoother for depth images of one camera in CUDA device memory.
pub struct planish_cuda {
    _opaque: [u8; 0],
}

#[cfg(feature = "cuda")]
mod with_cuda {
    use std::sync::{Mutex, TryLockError};

    use planish::CudaSmoother;

    use super::{Done, c_char, c_void, planish_camera, planish_cuda};
    use crate::error::{PLANISH_ARGUMENT, PLANISH_BUSY, PLANISH_INTERNAL, PLANISH_NULL, failure};
    use crate::frame::{PLANISH_DEPTH_F32, PLANISH_DEPTH_U16, camera_of};
    use crate::handles::Handles;
    use crate::session::{settings_from, writable};

    static ALL: Handles<Mutex<CudaSmoother>> = Handles::new("CUDA smoother");

    pub(super) unsafe fn new(
        settings: *const c_char,
        camera: *const planish_camera,
        kind: u32,
        cuda: *mut *mut planish_cuda,
    ) -> Done<()> {
        // SAFETY: the caller upholds this function's contract.
        let (cuda, settings, camera) =
            unsafe { (writable("cuda", cuda)?, settings_from(settings)?, camera_of(camera)?) };
        let is_metres = match kind {
            PLANISH_DEPTH_U16 => false,
            PLANISH_DEPTH_F32 => true,
            other => {
                let text =
                    format!("unsupported kind {other} for CUDA; expected PLANISH_DEPTH_U16 or PLANISH_DEPTH_F32");
                return failure(PLANISH_ARGUMENT, text);
            }
        };
        *cuda = ALL.add(Mutex::new(CudaSmoother::open(&settings, &camera, is_metres)?));
        Ok(())
    }

    pub(super) fn with<T>(cuda: *const planish_cuda, body: impl FnOnce(&mut CudaSmoother) -> Done<T>) -> Done<T> {
        let held = ALL.get(cuda)?;
        let mut smoother = match held.try_lock() {
            Ok(smoother) => smoother,
            Err(TryLockError::WouldBlock) => {
                return failure(PLANISH_BUSY, "another thread is using the smoother; open one smoother per thread");
            }
            Err(TryLockError::Poisoned(_)) => {
                return failure(
                    PLANISH_INTERNAL,
                    "the smoother had an internal error before; free it and open another",
                );
            }
        };
        body(&mut smoother)
    }

    pub(super) unsafe fn smooth(
        cuda: *mut planish_cuda,
        (depth, row_stride): (*const c_void, usize),
        result: *mut f32,
        stream: *mut c_void,
    ) -> Done<()> {
        if depth.is_null() || result.is_null() {
            return failure(PLANISH_NULL, "the depth or the result is null");
        }
        with(cuda, |smoother| {
            // SAFETY: the caller upholds this function's contract.
            unsafe { smoother.smooth(depth.addr() as u64, row_stride, result.addr() as u64, stream.addr()) }?;
            Ok(())
        })
    }

    pub(super) unsafe fn submit(
        cuda: *mut planish_cuda,
        (depth, row_stride): (*const c_void, usize),
        stream: *mut c_void,
    ) -> Done<()> {
        if depth.is_null() {
            return failure(PLANISH_NULL, "the depth is null");
        }
        with(cuda, |smoother| {
            // SAFETY: the caller upholds this function's contract.
            unsafe { smoother.submit(depth.addr() as u64, row_stride, stream.addr()) }?;
            Ok(())
        })
    }

    pub(super) unsafe fn receive(
        cuda: *mut planish_cuda,
        result: *mut f32,
        stream: *mut c_void,
        received: *mut bool,
    ) -> Done<()> {
        if result.is_null() {
            return failure(PLANISH_NULL, "the result is null");
        }
        // SAFETY: the caller upholds this function's contract.
        let place = unsafe { writable("received", received)? };
        with(cuda, |smoother| {
            // SAFETY: the caller upholds this function's contract.
            *place = unsafe { smoother.receive(result.addr() as u64, stream.addr())? };
            Ok(())
        })
    }

    pub(super) unsafe fn channels(cuda: *const planish_cuda, channels: *mut usize) -> Done<()> {
        // SAFETY: the caller upholds this function's contract.
        let place = unsafe { writable("channels", channels)? };
        with(cuda, |smoother| {
            *place = smoother.channels();
            Ok(())
        })
    }

    pub(super) fn free(cuda: *mut planish_cuda) -> Done<()> {
        if cuda.is_null() { Ok(()) } else { ALL.remove(cuda) }
    }
}

#[cfg(not(feature = "cuda"))]
mod with_cuda {
    use super::{Done, c_char, c_void, planish_camera, planish_cuda};
    use crate::error::{PLANISH_ENGINE, failure};

    fn absent() -> Done<()> {
        failure(PLANISH_ENGINE, "this build does not support CUDA; enable planish-c's feature `cuda`")
    }

    pub(super) unsafe fn new(
        _: *const c_char,
        _: *const planish_camera,
        _: u32,
        _: *mut *mut planish_cuda,
    ) -> Done<()> {
        absent()
    }

    pub(super) unsafe fn smooth(
        _: *mut planish_cuda,
        _: (*const c_void, usize),
        _: *mut f32,
        _: *mut c_void,
    ) -> Done<()> {
        absent()
    }

    pub(super) unsafe fn submit(_: *mut planish_cuda, _: (*const c_void, usize), _: *mut c_void) -> Done<()> {
        absent()
    }

    pub(super) unsafe fn receive(_: *mut planish_cuda, _: *mut f32, _: *mut c_void, _: *mut bool) -> Done<()> {
        absent()
    }

    pub(super) unsafe fn channels(_: *const planish_cuda, _: *mut usize) -> Done<()> {
        absent()
    }

    pub(super) fn free(_: *mut planish_cuda) -> Done<()> {
        absent()
    }
}

/// Creates a smoother for depth images of one camera in CUDA device memory. `kind` is PLANISH_DEPTH_U16 (depth in the
/// camera's units) or PLANISH_DEPTH_F32 (depth in metres). `settings` has the form described at planish_session_new;
/// its outputs may be points, normals, curvature and depth_m. With engine=gpu, adapter is the index or a part of the
/// name of a CUDA device; the default is the current device. Requires NVRTC, CUDA's compiler, which is loaded at run
/// time.
///
/// # Safety
/// `settings` must be null or point to a zero-terminated string. `camera` must be null, or point to a camera whose own
/// pointers are null or valid as its members state. `cuda` must be null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_cuda_new(
    settings: *const c_char,
    camera: *const planish_camera,
    kind: u32,
    cuda: *mut *mut planish_cuda,
) -> planish_code {
    // SAFETY: the caller upholds this function's contract.
    guarded(|| unsafe { with_cuda::new(settings, camera, kind, cuda) })
}

/// Starts smoothing an image on a stream (a cudaStream_t; null means the default stream) and returns without waiting.
/// The rows of the image begin `row_stride` bytes apart. `depth` and `result` are addresses in device memory, which
/// must stay valid until the stream has finished this work. `result` receives one plane of floats per channel of the
/// outputs: x, y and z of points, then of normals, then curvature, depth_m.
///
/// # Safety
/// `depth` and `result` must be null, or point to device memory that is large enough and stays valid until the stream
/// has finished this work. `stream` must be null or a valid stream.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_cuda_smooth(
    cuda: *mut planish_cuda,
    depth: *const c_void,
    row_stride: usize,
    result: *mut f32,
    stream: *mut c_void,
) -> planish_code {
    // SAFETY: the caller upholds this function's contract.
    guarded(|| unsafe { with_cuda::smooth(cuda, (depth, row_stride), result, stream) })
}

/// Submits an image in the same form as for planish_cuda_smooth; planish_cuda_receive returns the results in the order
/// of submission. At most 16 images can be in flight. Images that are submitted before the first call to
/// planish_cuda_receive are smoothed together, which takes less time per image.
///
/// # Safety
/// Same as planish_cuda_smooth.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_cuda_submit(
    cuda: *mut planish_cuda,
    depth: *const c_void,
    row_stride: usize,
    stream: *mut c_void,
) -> planish_code {
    // SAFETY: the caller upholds this function's contract.
    guarded(|| unsafe { with_cuda::submit(cuda, (depth, row_stride), stream) })
}

/// Smooths the submitted images and copies the oldest result to `result`. `received` becomes false if no image is in
/// flight.
///
/// # Safety
/// Same as planish_cuda_smooth; `received` must be null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_cuda_receive(
    cuda: *mut planish_cuda,
    result: *mut f32,
    stream: *mut c_void,
    received: *mut bool,
) -> planish_code {
    // SAFETY: the caller upholds this function's contract.
    guarded(|| unsafe { with_cuda::receive(cuda, result, stream, received) })
}

/// Writes the number of channels of a result to `channels`.
///
/// # Safety
/// `channels` must be null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_cuda_channels(cuda: *const planish_cuda, channels: *mut usize) -> planish_code {
    // SAFETY: the caller upholds this function's contract.
    guarded(|| unsafe { with_cuda::channels(cuda, channels) })
}

/// Waits for the stream, then frees the smoother. Null is allowed.
#[unsafe(no_mangle)]
pub extern "C" fn planish_cuda_free(cuda: *mut planish_cuda) -> planish_code {
    guarded(|| with_cuda::free(cuda))
}
