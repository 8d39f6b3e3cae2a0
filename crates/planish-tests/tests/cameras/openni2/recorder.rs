//! Recordings by OpenNI2's own recorder (OniCAPI.h).

use std::ffi::{CString, c_char, c_int, c_void};
use std::path::Path;
use std::time::Duration;

use libloading::Library;

type Handle = *mut c_void;

const COLOR: c_int = 2;
const DEPTH: c_int = 3;

/// The OpenNI2 library, with the functions that the tests use.
pub struct OpenNi2(Library);

/// Calls an OpenNI2 function by name, with typed arguments.
macro_rules! oni {
    ($library:expr, $name:literal, $($argument:expr => $type:ty),*; $result:ty) => {
        // SAFETY: the signature matches the function in OniCAPI.h.
        unsafe {
            let function = $library.0.get::<unsafe extern "C" fn($($type),*) -> $result>(concat!("oni", $name).as_bytes());
            function.unwrap()($($argument),*)
        }
    };
}

impl OpenNi2 {
    pub fn load(library: &Path) -> Self {
        // SAFETY: loading the library has no side effects that matter here.
        Self(unsafe { Library::new(library) }.unwrap())
    }

    /// Records a device's depth and colour for the given time, in the modes in which they start.
    pub fn record(&self, uri: &str, file: &Path, time: Duration) {
        let ok = |status: c_int| assert_eq!(status, 0, "OpenNI2 fails");
        let (mut device, mut recorder): (Handle, Handle) = (std::ptr::null_mut(), std::ptr::null_mut());
        ok(oni!(self, "Initialize", 2002 => c_int; c_int));
        let uri = CString::new(uri).unwrap();
        ok(oni!(self, "DeviceOpen", uri.as_ptr() => *const c_char, &raw mut device => *mut Handle; c_int));
        let file = CString::new(file.to_str().unwrap()).unwrap();
        ok(oni!(self, "CreateRecorder", file.as_ptr() => *const c_char, &raw mut recorder => *mut Handle; c_int));
        let streams = [DEPTH, COLOR].map(|sensor| {
            let mut stream: Handle = std::ptr::null_mut();
            ok(oni!(self, "DeviceCreateStream", device => Handle, sensor => c_int, &raw mut stream => *mut Handle; c_int));
            ok(oni!(self, "RecorderAttachStream", recorder => Handle, stream => Handle, 0 => c_int; c_int));
            stream
        });
        ok(oni!(self, "RecorderStart", recorder => Handle; c_int));
        for stream in streams {
            ok(oni!(self, "StreamStart", stream => Handle; c_int));
        }
        std::thread::sleep(time);
        oni!(self, "RecorderStop", recorder => Handle; ());
        ok(oni!(self, "RecorderDestroy", &raw mut recorder => *mut Handle; c_int));
        for stream in streams {
            oni!(self, "StreamStop", stream => Handle; ());
            oni!(self, "StreamDestroy", stream => Handle; ());
        }
        ok(oni!(self, "DeviceClose", device => Handle; c_int));
    }
}
