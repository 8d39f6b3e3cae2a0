//! The part of librealsense2's C API used here (rs.h and its headers, since version 2.39).

use std::ffi::{CStr, c_char, c_int, c_uint, c_void};
use std::sync::Mutex;
use std::thread;
use std::time::{Duration, Instant};

use crate::source::driver::{self, c_functions};
use planish_core::DeviceError;

/// A pointer to any object of the library, whose types are opaque.
pub(super) type Object = *mut c_void;

// rs2_stream
pub(super) const STREAM_DEPTH: c_int = 1;
pub(super) const STREAM_COLOR: c_int = 2;
// rs2_format
pub(super) const FORMAT_Z16: c_int = 1;
pub(super) const FORMAT_RGB8: c_int = 5;
// rs2_extension
const EXTENSION_COMPOSITE_FRAME: c_int = 10;
// rs2_camera_info
const INFO_NAME: c_int = 0;
const INFO_SERIAL_NUMBER: c_int = 1;
// rs2_playback_status
const PLAYBACK_STOPPED: c_int = 3;
// rs2_exception_type
const EXCEPTION_CAMERA_DISCONNECTED: c_int = 1;

/// Polling interval.
const POLL_EVERY: Duration = Duration::from_millis(1);

/// `rs2_intrinsics`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Intrinsics {
    pub(super) width: c_int,
    pub(super) height: c_int,
    pub(super) ppx: f32,
    pub(super) ppy: f32,
    pub(super) fx: f32,
    pub(super) fy: f32,
    pub(super) model: c_int,
    pub(super) coefficients: [f32; 5],
}

const _: () = assert!(size_of::<Intrinsics>() == 48);

/// Output argument for an error.
type Error = *mut Object;

c_functions! {
    /// The functions of librealsense2.
    pub(super) struct Functions("rs2_") {
        get_api_version(Error) -> c_int;
        get_librealsense_exception_type(Object) -> c_int;
        get_error_message(Object) -> *const c_char;
        free_error(Object);
        create_context(c_int, Error) -> Object;
        delete_context(Object);
        query_devices(Object, Error) -> Object;
        delete_device_list(Object);
        get_device_count(Object, Error) -> c_int;
        create_device(Object, c_int, Error) -> Object;
        delete_device(Object);
        supports_device_info(Object, c_int, Error) -> c_int;
        get_device_info(Object, c_int, Error) -> *const c_char;
        playback_device_set_real_time(Object, c_int, Error);
        playback_device_get_current_status(Object, Error) -> c_int;
        create_config(Error) -> Object;
        delete_config(Object);
        config_enable_device(Object, *const c_char, Error);
        config_enable_device_from_file_repeat_option(Object, *const c_char, c_int, Error);
        config_enable_stream(Object, c_int, c_int, c_int, c_int, c_int, c_int, Error);
        config_resolve(Object, Object, Error) -> Object;
        create_pipeline(Object, Error) -> Object;
        delete_pipeline(Object);
        pipeline_start_with_config(Object, Object, Error) -> Object;
        pipeline_stop(Object, Error);
        pipeline_poll_for_frames(Object, *mut Object, Error) -> c_int;
        delete_pipeline_profile(Object);
        pipeline_profile_get_device(Object, Error) -> Object;
        create_align(c_int, Error) -> Object;
        delete_processing_block(Object);
        start_processing_queue(Object, Object, Error);
        /// Takes ownership of the frame.
        process_frame(Object, Object, Error);
        create_frame_queue(c_int, Error) -> Object;
        delete_frame_queue(Object);
        wait_for_frame(Object, c_uint, Error) -> Object;
        is_frame_extendable_to(Object, c_int, Error) -> c_int;
        embedded_frames_count(Object, Error) -> c_int;
        extract_frame(Object, c_int, Error) -> Object;
        release_frame(Object);
        frame_add_ref(Object, Error);
        get_frame_stream_profile(Object, Error) -> Object;
        get_stream_profile_data(Object, *mut c_int, *mut c_int, *mut c_int, *mut c_int, *mut c_int, Error);
        get_video_stream_intrinsics(Object, *mut Intrinsics, Error);
        get_frame_number(Object, Error) -> u64;
        get_frame_timestamp(Object, Error) -> f64;
        get_frame_width(Object, Error) -> c_int;
        get_frame_height(Object, Error) -> c_int;
        get_frame_stride_in_bytes(Object, Error) -> c_int;
        get_frame_data_size(Object, Error) -> c_int;
        get_frame_data(Object, Error) -> *const c_void;
        depth_frame_get_units(Object, Error) -> f32;
    }
}

/// An object of the library, deleted when dropped.
pub(super) struct Owned {
    object: Object,
    delete: unsafe extern "C" fn(Object),
}

// SAFETY: librealsense's objects may be used and deleted on any thread, and each has one owner.
unsafe impl Send for Owned {}

impl Owned {
    /// Returns the object for calls, which must not keep it beyond the lifetime of this owner.
    pub(super) fn get(&self) -> Object {
        self.object
    }

    /// Returns the object for a call that takes ownership of it.
    fn into_object(self) -> Object {
        std::mem::ManuallyDrop::new(self).object
    }
}

impl Drop for Owned {
    fn drop(&mut self) {
        // SAFETY: `delete` is the library's function for deleting objects of this type, and this is the only owner.
        unsafe { (self.delete)(self.object) }
    }
}

/// Name and serial number of a device.
pub(super) struct DeviceName {
    pub(super) name: String,
    pub(super) serial: String,
}

impl Functions {
    /// Loads librealsense, once per process: its threads keep running, so it is never unloaded.
    pub(super) fn load() -> Result<&'static Self, DeviceError> {
        static LOADED: Mutex<Option<&'static Functions>> = Mutex::new(None);
        let help = "install librealsense2, or set PLANISH_LIBREALSENSE to its file (the Python package pyrealsense2 \
                    includes it)";
        // Debian and Ubuntu have the minor version in the file name; the name without it is only in the development
        // packages.
        let numbered = (39..100).rev().map(|minor| format!("librealsense2.so.2.{minor}"));
        let usual = std::iter::once("librealsense2.so".to_owned()).chain(numbered);
        driver::load_once(&LOADED, || {
            let library = driver::load("PLANISH_LIBREALSENSE", usual, help)?;
            // SAFETY: the signatures match rs.h, which is the same in all 2.x versions.
            unsafe { Self::find(library) }.map_err(|error| DeviceError::Driver {
                what: format!("not librealsense2 2.39 or later: {error}"),
                help,
            })
        })
    }

    /// Makes a call, and converts a reported error.
    pub(super) fn call<T>(&self, what: &str, call: impl FnOnce(&Self, Error) -> T) -> Result<T, DeviceError> {
        let mut error: Object = std::ptr::null_mut();
        let result = call(self, &raw mut error);
        if error.is_null() {
            return Ok(result);
        }
        // SAFETY: the library set the error, and it is freed after its text was copied.
        let (is_gone, message) = unsafe {
            let is_gone = (self.get_librealsense_exception_type)(error) == EXCEPTION_CAMERA_DISCONNECTED;
            let message = text((self.get_error_message)(error));
            (self.free_error)(error);
            (is_gone, message)
        };
        let what = format!("{what} (librealsense: {message})");
        Err(if is_gone { DeviceError::Gone { what } } else { DeviceError::Failed { what } })
    }

    /// Makes a call that creates an object.
    pub(super) fn create(
        &self,
        what: &str,
        delete: unsafe extern "C" fn(Object),
        call: impl FnOnce(&Self, Error) -> Object,
    ) -> Result<Owned, DeviceError> {
        match self.call(what, call)? {
            object if object.is_null() => {
                Err(DeviceError::Failed { what: format!("{what}: librealsense returned nothing") })
            }
            object => Ok(Owned { object, delete }),
        }
    }

    pub(super) fn create_context(&self) -> Result<Owned, DeviceError> {
        // SAFETY: these calls have no preconditions. The library checks the version for which its caller was built;
        // its own version always passes.
        unsafe {
            let version = self.call("cannot read the version of librealsense", |f, e| (f.get_api_version)(e))?;
            self.create("cannot start librealsense", self.delete_context, |f, e| (f.create_context)(version, e))
        }
    }

    pub(super) fn create_pipeline(&self, context: &Owned) -> Result<Owned, DeviceError> {
        // SAFETY: the context outlives the call, and the pipeline keeps references to its parts.
        let call = |f: &Self, e| unsafe { (f.create_pipeline)(context.get(), e) };
        self.create("cannot create a pipeline", self.delete_pipeline, call)
    }

    /// Takes ownership of a context and a pipeline.
    #[cfg(feature = "internal")]
    pub(super) fn own(&self, context: Object, pipeline: Object) -> [Owned; 2] {
        [(context, self.delete_context), (pipeline, self.delete_pipeline)]
            .map(|(object, delete)| Owned { object, delete })
    }

    /// Returns the devices of a context, by name and serial number.
    pub(super) fn devices(&self, context: &Owned) -> Result<Vec<DeviceName>, DeviceError> {
        let what = "devices cannot be listed";
        // SAFETY: the objects are the library's own and outlive the calls.
        unsafe {
            let list = self.create(what, self.delete_device_list, |f, e| (f.query_devices)(context.get(), e))?;
            let count = self.call(what, |f, e| (f.get_device_count)(list.get(), e))?;
            // A device that is just being plugged in may fail; the others are still listed.
            let device = |i| self.create(what, self.delete_device, |f, e| (f.create_device)(list.get(), i, e)).ok();
            Ok((0..count).filter_map(device).map(|device| self.name_of(&device)).collect())
        }
    }

    pub(super) fn name_of(&self, device: &Owned) -> DeviceName {
        let info = |which| {
            // SAFETY: the device outlives the calls, and the text is copied.
            unsafe {
                let has = self.call("", |f, e| (f.supports_device_info)(device.get(), which, e)).unwrap_or(0) != 0;
                let value = || self.call("", |f, e| (f.get_device_info)(device.get(), which, e)).ok();
                has.then(value).flatten().map(|value| text(value)).unwrap_or_default()
            }
        };
        DeviceName { name: info(INFO_NAME), serial: info(INFO_SERIAL_NUMBER) }
    }

    /// Returns true if a recording is being played; false before its start and after its end.
    pub(super) fn is_playing(&self, device: &Owned) -> bool {
        // SAFETY: the device outlives the call.
        let call = |f: &Self, e| unsafe { (f.playback_device_get_current_status)(device.get(), e) };
        self.call("", call).is_ok_and(|status| status != PLAYBACK_STOPPED)
    }

    /// Returns the next frames that belong together; `None` after `timeout`. Polls instead of using the library's own
    /// wait: if the device is gone, that wait restarts the pipeline on any other device, and takes 15 s if there is
    /// none.
    pub(super) fn wait(&self, pipeline: &Owned, timeout: Duration) -> Result<Option<Owned>, DeviceError> {
        let deadline = Instant::now() + timeout;
        loop {
            let mut frames: Object = std::ptr::null_mut();
            // SAFETY: the pipeline outlives the call.
            let call = |f: &Self, e| unsafe { (f.pipeline_poll_for_frames)(pipeline.get(), &raw mut frames, e) };
            if self.call("the camera failed", call)? != 0 && !frames.is_null() {
                return Ok(Some(Owned { object: frames, delete: self.release_frame }));
            }
            if Instant::now() >= deadline {
                return Ok(None);
            }
            thread::sleep(POLL_EVERY);
        }
    }

    /// Runs a processing block on frames, and returns its output from the queue.
    pub(super) fn process(&self, block: &Owned, queue: &Owned, frames: Owned) -> Result<Owned, DeviceError> {
        let what = "frames cannot be aligned";
        let frames = frames.into_object();
        // SAFETY: the block takes ownership of the frames. It works on this thread, so its result is in the queue at
        // once.
        unsafe {
            self.call(what, |f, e| (f.process_frame)(block.get(), frames, e))?;
            self.create(what, self.release_frame, |f, e| (f.wait_for_frame)(queue.get(), 1000, e))
        }
    }

    /// Returns the frame of a stream among frames that belong together; `None` if it is missing.
    pub(super) fn frame_of(&self, frames: &Owned, stream: c_int) -> Result<Option<Owned>, DeviceError> {
        let what = "frames cannot be read";
        // SAFETY: the frames outlive the calls; each extracted or additional reference is released by its owner.
        unsafe {
            let is_set =
                self.call(what, |f, e| (f.is_frame_extendable_to)(frames.get(), EXTENSION_COMPOSITE_FRAME, e))? != 0;
            if !is_set {
                self.call(what, |f, e| (f.frame_add_ref)(frames.get(), e))?;
                let frame = Owned { object: frames.get(), delete: self.release_frame };
                return Ok((self.stream_of(&frame)? == stream).then_some(frame));
            }
            for i in 0..self.call(what, |f, e| (f.embedded_frames_count)(frames.get(), e))? {
                let frame = self.create(what, self.release_frame, |f, e| (f.extract_frame)(frames.get(), i, e))?;
                if self.stream_of(&frame)? == stream {
                    return Ok(Some(frame));
                }
            }
            Ok(None)
        }
    }

    fn stream_of(&self, frame: &Owned) -> Result<c_int, DeviceError> {
        let [mut stream, mut format, mut index, mut id, mut rate] = [0; 5];
        // SAFETY: the frame outlives the calls, and its profile lives as long.
        unsafe {
            let profile = self.call("a frame has no profile", |f, e| (f.get_frame_stream_profile)(frame.get(), e))?;
            self.call("a profile cannot be read", |f, e| {
                (f.get_stream_profile_data)(profile, &mut stream, &mut format, &mut index, &mut id, &mut rate, e);
            })?;
        }
        Ok(stream)
    }

    pub(super) fn intrinsics_of(&self, frame: &Owned) -> Result<Intrinsics, DeviceError> {
        let mut intrinsics = Intrinsics::default();
        // SAFETY: as in `stream_of`.
        unsafe {
            let profile = self.call("a frame has no profile", |f, e| (f.get_frame_stream_profile)(frame.get(), e))?;
            let what = "the camera has no intrinsics";
            self.call(what, |f, e| (f.get_video_stream_intrinsics)(profile, &raw mut intrinsics, e))?;
        }
        Ok(intrinsics)
    }

    /// Returns width, height and the rows of a frame's image without their padding.
    pub(super) fn image_of(
        &self,
        frame: &Owned,
        bytes_a_pixel: usize,
        is_recorded: bool,
    ) -> Result<(usize, usize, Vec<u8>), DeviceError> {
        let what = "a frame has no image";
        let size = |value: c_int| usize::try_from(value).unwrap_or(0);
        // SAFETY: the frame outlives the calls and the copy of its data, whose size it states.
        unsafe {
            let width = size(self.call(what, |f, e| (f.get_frame_width)(frame.get(), e))?);
            let height = size(self.call(what, |f, e| (f.get_frame_height)(frame.get(), e))?);
            let stride = size(self.call(what, |f, e| (f.get_frame_stride_in_bytes)(frame.get(), e))?);
            // 0 for a frame of a software device, whose data belongs to the creator of the device.
            let bytes = match size(self.call(what, |f, e| (f.get_frame_data_size)(frame.get(), e))?) {
                0 if !is_recorded => stride * height,
                bytes => bytes,
            };
            let data = self.call(what, |f, e| (f.get_frame_data)(frame.get(), e))?.cast::<u8>();
            let row = width * bytes_a_pixel;
            if data.is_null() || height == 0 || row == 0 || row > stride || bytes < stride * (height - 1) + row {
                let what = format!("a frame of {width}x{height} pixels, {stride} bytes per row, has {bytes} bytes");
                return Err(DeviceError::Failed { what });
            }
            let data = std::slice::from_raw_parts(data, bytes);
            let mut image = Vec::with_capacity(row * height);
            for line in data.chunks(stride).take(height) {
                image.extend_from_slice(&line[..row]);
            }
            Ok((width, height, image))
        }
    }
}

/// # Safety
/// `text` must be null or point to a string that ends with a zero byte.
unsafe fn text(text: *const c_char) -> String {
    if text.is_null() {
        return String::new();
    }
    // SAFETY: as above.
    unsafe { CStr::from_ptr(text) }.to_string_lossy().trim().to_owned()
}
