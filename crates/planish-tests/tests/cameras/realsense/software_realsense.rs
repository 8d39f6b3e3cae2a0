//! A RealSense in software, made with librealsense's software device (rs_internal.h), and its recordings.

use std::ffi::{CStr, CString, c_char, c_int, c_void};
use std::path::Path;
use std::sync::OnceLock;

use libloading::Library;

type Object = *mut c_void;
type Error = *mut Object;

#[repr(C)]
#[derive(Clone, Copy)]
pub struct Intrinsics {
    pub width: c_int,
    pub height: c_int,
    pub ppx: f32,
    pub ppy: f32,
    pub fx: f32,
    pub fy: f32,
    pub model: c_int,
    pub coefficients: [f32; 5],
}

#[repr(C)]
struct VideoStream {
    stream: c_int,
    index: c_int,
    id: c_int,
    width: c_int,
    height: c_int,
    fps: c_int,
    bytes_a_pixel: c_int,
    format: c_int,
    intrinsics: Intrinsics,
}

#[repr(C)]
struct VideoFrame {
    pixels: *mut c_void,
    deleter: Option<unsafe extern "C" fn(*mut c_void)>,
    stride: c_int,
    bytes_a_pixel: c_int,
    timestamp_ms: f64,
    domain: c_int,
    number: c_int,
    profile: Object,
    depth_units: f32,
}

#[repr(C)]
struct Extrinsics {
    rotation: [f32; 9],
    translation: [f32; 3],
}

const DEPTH: c_int = 1;
const COLOR: c_int = 2;
const Z16: c_int = 1;
const RGB8: c_int = 5;
const OPTION_DEPTH_UNITS: c_int = 28;
const MATCHER_DEPTH_AND_COLOUR: c_int = 2;

unsafe extern "C" {
    fn malloc(bytes: usize) -> *mut c_void;
    fn free(pointer: *mut c_void);
}

/// The librealsense library, with the functions that the tests use.
pub struct RealSense(Library);

impl RealSense {
    /// Loads the library named by PLANISH_LIBREALSENSE. The library of the Python package also needs
    /// PLANISH_LIBPYTHON.
    pub fn load() -> Result<&'static Self, String> {
        static LOADED: OnceLock<Result<RealSense, String>> = OnceLock::new();
        LOADED.get_or_init(Self::open).as_ref().map_err(Clone::clone)
    }

    fn open() -> Result<Self, String> {
        let file = std::env::var_os("PLANISH_LIBREALSENSE").ok_or("PLANISH_LIBREALSENSE names no library")?;
        // SAFETY: loading these libraries has no side effects that matter here.
        unsafe {
            if let Some(python) = std::env::var_os("PLANISH_LIBPYTHON") {
                use libloading::os::unix::{Library, RTLD_GLOBAL, RTLD_NOW};
                let python = Library::open(Some(python), RTLD_NOW | RTLD_GLOBAL).map_err(|error| error.to_string())?;
                std::mem::forget(python);
            }
            Library::new(file).map(Self).map_err(|error| error.to_string())
        }
    }

    fn error(&self, function: &str, error: Object) {
        if error.is_null() {
            return;
        }
        // SAFETY: librealsense set this error.
        let message = unsafe {
            let message =
                self.0.get::<unsafe extern "C" fn(Object) -> *const c_char>(b"rs2_get_error_message").unwrap();
            CStr::from_ptr(message(error)).to_string_lossy().into_owned()
        };
        panic!("{function}: {message}");
    }
}

/// Calls a librealsense function by name, with typed arguments.
macro_rules! rs2 {
    ($library:expr, $name:literal, $($argument:expr => $type:ty),*; $result:ty) => {{
        let mut error: Object = std::ptr::null_mut();
        // SAFETY: the signature matches the function in the headers of version 2.
        let result = unsafe {
            let function = $library.0.get::<unsafe extern "C" fn($($type,)* Error) -> $result>(concat!("rs2_", $name).as_bytes());
            function.unwrap()($($argument,)* &raw mut error)
        };
        $library.error($name, error);
        result
    }};
}

/// A device with a depth sensor and optionally a colour sensor.
pub struct SoftwareCamera {
    library: &'static RealSense,
    device: Object,
    depth: Sensor,
    color: Option<Sensor>,
    metres_per_unit: f32,
}

struct Sensor {
    sensor: Object,
    profile: Object,
    width: usize,
    bytes_a_pixel: usize,
}

// SAFETY: librealsense's objects may be used on any thread.
unsafe impl Send for SoftwareCamera {}

/// Returns the intrinsics of a rectified image; callers may set another distortion model and coefficients of
/// librealsense.
pub fn intrinsics((width, height): (c_int, c_int), focal: f32) -> Intrinsics {
    let (ppx, ppy) = (width as f32 / 2.0 + 3.5, height as f32 / 2.0 - 2.25);
    Intrinsics { width, height, ppx, ppy, fx: focal, fy: focal + 1.0, model: 4, coefficients: [0.0; 5] }
}

impl SoftwareCamera {
    pub fn new(
        library: &'static RealSense,
        serial: &str,
        depth: Intrinsics,
        color: Option<Intrinsics>,
        metres_per_unit: f32,
    ) -> Self {
        let device = rs2!(library, "create_software_device",; Object);
        for (info, value) in [(0, "Software D435"), (1, serial)] {
            let value = CString::new(value).unwrap();
            rs2!(library, "software_device_register_info", device => Object, info => c_int, value.as_ptr() => *const c_char; ());
        }
        let depth = Sensor::add(library, device, "Stereo Module", (DEPTH, 0, Z16, 2), depth);
        rs2!(library, "software_sensor_add_read_only_option", depth.sensor => Object, OPTION_DEPTH_UNITS => c_int, metres_per_unit => f32; ());
        let color = color.map(|color| {
            let color = Sensor::add(library, device, "RGB Camera", (COLOR, 1, RGB8, 3), color);
            let between = Extrinsics { rotation: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], translation: [0.015, 0.0, 0.0] };
            rs2!(library, "register_extrinsics", depth.profile => Object, color.profile => Object, between => Extrinsics; ());
            color
        });
        rs2!(library, "software_device_create_matcher", device => Object, MATCHER_DEPTH_AND_COLOUR => c_int; ());
        Self { library, device, depth, color, metres_per_unit }
    }

    /// Creates a context and a pipeline with this device, for a source to own. The pipeline is given the device
    /// because a context of librealsense 2.56 to 2.59 loses devices that are added to it.
    pub fn pipeline(&self) -> [Object; 2] {
        let version = rs2!(self.library, "get_api_version",; c_int);
        let context = rs2!(self.library, "create_context", version => c_int; Object);
        let pipeline = rs2!(self.library, "create_pipeline", context => Object; Object);
        rs2!(self.library, "pipeline_set_device", pipeline => Object, self.device => Object; ());
        [context, pipeline]
    }

    pub fn has_color(&self) -> bool {
        self.color.is_some()
    }

    /// Delivers a depth image and, if the camera has colour, a colour image that is 1 ms later.
    pub fn deliver(&self, number: usize, timestamp_ms: f64, depth: &[u16], rgb: Option<&[u8]>) {
        let bytes: Vec<u8> = depth.iter().flat_map(|depth| depth.to_le_bytes()).collect();
        self.depth.deliver(self.library, number, timestamp_ms, &bytes, self.metres_per_unit);
        if let (Some(color), Some(rgb)) = (&self.color, rgb) {
            color.deliver(self.library, number, timestamp_ms + 1.0, rgb, 0.0);
        }
    }

    /// Records the frames that arrive while `deliver` runs.
    pub fn record(&self, file: &Path, deliver: impl FnOnce()) {
        let library = self.library;
        let file = CString::new(file.to_str().unwrap()).unwrap();
        let recorder =
            rs2!(library, "create_record_device", self.device => Object, file.as_ptr() => *const c_char; Object);
        let sensors = rs2!(library, "query_sensors", recorder => Object; Object);
        let queue = rs2!(library, "create_frame_queue", 1 => c_int; Object);
        let started: Vec<Object> = (0..rs2!(library, "get_sensors_count", sensors => Object; c_int))
            .map(|i| {
                let sensor = rs2!(library, "create_sensor", sensors => Object, i => c_int; Object);
                let profiles = rs2!(library, "get_stream_profiles", sensor => Object; Object);
                let profile = rs2!(library, "get_stream_profile", profiles => Object, 0 => c_int; Object);
                rs2!(library, "open", sensor => Object, profile => Object; ());
                rs2!(library, "start_queue", sensor => Object, queue => Object; ());
                sensor
            })
            .collect();
        deliver();
        for sensor in started {
            rs2!(library, "stop", sensor => Object; ());
            rs2!(library, "close", sensor => Object; ());
        }
        // SAFETY: the recorder is not used again; its recording is complete only when the device is deleted.
        unsafe { library.0.get::<unsafe extern "C" fn(Object)>(b"rs2_delete_device").unwrap()(recorder) };
    }
}

impl Sensor {
    fn add(
        library: &RealSense,
        device: Object,
        name: &str,
        (stream, id, format, bytes_a_pixel): (c_int, c_int, c_int, c_int),
        intrinsics: Intrinsics,
    ) -> Self {
        let name = CString::new(name).unwrap();
        let sensor =
            rs2!(library, "software_device_add_sensor", device => Object, name.as_ptr() => *const c_char; Object);
        let Intrinsics { width, height, .. } = intrinsics;
        let video = VideoStream { stream, index: 0, id, width, height, fps: 30, bytes_a_pixel, format, intrinsics };
        let profile = rs2!(library, "software_sensor_add_video_stream", sensor => Object, video => VideoStream; Object);
        Self { sensor, profile, width: width as usize, bytes_a_pixel: bytes_a_pixel as usize }
    }

    fn deliver(&self, library: &RealSense, number: usize, timestamp_ms: f64, bytes: &[u8], depth_units: f32) {
        // SAFETY: the allocation has the size of `bytes`; librealsense frees it through the deleter.
        let pixels = unsafe {
            let pixels = malloc(bytes.len()).cast::<u8>();
            assert!(!pixels.is_null(), "out of memory");
            pixels.copy_from_nonoverlapping(bytes.as_ptr(), bytes.len());
            pixels.cast()
        };
        let frame = VideoFrame {
            pixels,
            deleter: Some(free),
            stride: (self.width * self.bytes_a_pixel) as c_int,
            bytes_a_pixel: self.bytes_a_pixel as c_int,
            timestamp_ms,
            domain: 0,
            number: number as c_int,
            profile: self.profile,
            depth_units,
        };
        rs2!(library, "software_sensor_on_video_frame", self.sensor => Object, frame => VideoFrame; ());
    }
}
