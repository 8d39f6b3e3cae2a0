//! The part of OpenNI2's C API used here (OniCAPI.h, OniCTypes.h, version 2.2).

use std::ffi::{CStr, c_char, c_int, c_void};
use std::sync::Mutex;

use crate::source::driver::{self, c_functions};
use planish_core::DeviceError;

/// A pointer to a device, a stream or a registration, whose types are opaque.
pub(super) type Handle = *mut c_void;

// OniStatus
const STATUS_OK: c_int = 0;
const STATUS_NO_DEVICE: c_int = 6;
pub(super) const STATUS_TIME_OUT: c_int = 102;
// OniSensorType
pub(super) const SENSOR_COLOR: c_int = 2;
pub(super) const SENSOR_DEPTH: c_int = 3;
// OniPixelFormat
pub(super) const DEPTH_1_MM: c_int = 100;
pub(super) const DEPTH_100_UM: c_int = 101;
pub(super) const RGB888: c_int = 200;
// OniDeviceState
pub(super) const STATE_EOF: c_int = 3;
// Properties of a device
pub(super) const IMAGE_REGISTRATION: c_int = 5;
pub(super) const PLAYBACK_SPEED: c_int = 100;
pub(super) const PLAYBACK_REPEAT: c_int = 101;
// Properties of a stream
pub(super) const HORIZONTAL_FOV: c_int = 1;
pub(super) const VERTICAL_FOV: c_int = 2;
pub(super) const VIDEO_MODE: c_int = 3;
pub(super) const MIRRORING: c_int = 7;
/// A value of `OniImageRegistrationMode`.
pub(super) const DEPTH_TO_COLOR: c_int = 1;

const VERSION: c_int = 2002;

/// `OniVideoMode`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct VideoMode {
    pub(super) format: c_int,
    pub(super) width: c_int,
    pub(super) height: c_int,
    pub(super) fps: c_int,
}

/// `OniSensorInfo`.
#[repr(C)]
pub(super) struct SensorInfo {
    sensor: c_int,
    modes_count: c_int,
    modes: *const VideoMode,
}

/// `OniDeviceInfo`.
#[repr(C)]
pub(super) struct DeviceInfo {
    uri: [c_char; 256],
    vendor: [c_char; 256],
    name: [c_char; 256],
    usb_vendor: u16,
    usb_product: u16,
}

const _: () = assert!(size_of::<DeviceInfo>() == 772);

/// `OniFrame`.
#[repr(C)]
pub(super) struct Frame {
    pub(super) bytes: c_int,
    pub(super) data: *const c_void,
    sensor: c_int,
    pub(super) timestamp_us: u64,
    pub(super) index: c_int,
    pub(super) width: c_int,
    pub(super) height: c_int,
    pub(super) mode: VideoMode,
    pub(super) is_cropped: c_int,
    pub(super) crop_x: c_int,
    pub(super) crop_y: c_int,
    pub(super) stride: c_int,
}

#[cfg(target_pointer_width = "64")]
const _: () = assert!(size_of::<Frame>() == 80);

pub(super) type DeviceCallback = unsafe extern "C" fn(*const DeviceInfo, *mut c_void);
pub(super) type StateCallback = unsafe extern "C" fn(*const DeviceInfo, c_int, *mut c_void);

/// `OniDeviceCallbacks`.
#[repr(C)]
pub(super) struct DeviceCallbacks {
    pub(super) connected: Option<DeviceCallback>,
    pub(super) disconnected: Option<DeviceCallback>,
    pub(super) state_changed: Option<StateCallback>,
}

c_functions! {
    #[expect(non_snake_case, reason = "the library's own names")]
    /// The functions of OpenNI2.
    pub(super) struct Functions("oni") {
        Initialize(c_int) -> c_int;
        GetExtendedError() -> *const c_char;
        GetDeviceList(*mut *mut DeviceInfo, *mut c_int) -> c_int;
        ReleaseDeviceList(*mut DeviceInfo) -> c_int;
        RegisterDeviceCallbacks(*mut DeviceCallbacks, *mut c_void, *mut Handle) -> c_int;
        UnregisterDeviceCallbacks(Handle);
        DeviceOpen(*const c_char, *mut Handle) -> c_int;
        DeviceClose(Handle) -> c_int;
        DeviceGetInfo(Handle, *mut DeviceInfo) -> c_int;
        DeviceGetSensorInfo(Handle, c_int) -> *const SensorInfo;
        DeviceSetProperty(Handle, c_int, *const c_void, c_int) -> c_int;
        DeviceGetProperty(Handle, c_int, *mut c_void, *mut c_int) -> c_int;
        DeviceIsImageRegistrationModeSupported(Handle, c_int) -> c_int;
        DeviceCreateStream(Handle, c_int, *mut Handle) -> c_int;
        StreamDestroy(Handle);
        StreamStart(Handle) -> c_int;
        StreamStop(Handle);
        StreamSetProperty(Handle, c_int, *const c_void, c_int) -> c_int;
        StreamGetProperty(Handle, c_int, *mut c_void, *mut c_int) -> c_int;
        WaitForAnyStream(*mut Handle, c_int, *mut c_int, c_int) -> c_int;
        StreamReadFrame(Handle, *mut *mut Frame) -> c_int;
        FrameRelease(*mut Frame);
    }
}

impl Functions {
    /// Loads and starts OpenNI2, once per process. It is never shut down: that would unload its drivers, whose threads
    /// may still run (as those of its dummy device do).
    pub(super) fn load() -> Result<&'static Self, DeviceError> {
        static LOADED: Mutex<Option<&'static Functions>> = Mutex::new(None);
        let help = "install OpenNI2 (Debian: libopenni2-0), or set PLANISH_LIBOPENNI2 to its file";
        driver::load_once(&LOADED, || {
            let usual = ["libOpenNI2.so.0", "libOpenNI2.so"].map(str::to_owned);
            let library = driver::load("PLANISH_LIBOPENNI2", usual, help)?;
            // SAFETY: the signatures match OniCAPI.h 2.2.
            let functions = unsafe { Self::find(library) }
                .map_err(|error| DeviceError::Driver { what: format!("not OpenNI2 2.2: {error}"), help })?;
            // SAFETY: the call is always valid.
            functions.check("cannot start OpenNI2", unsafe { (functions.Initialize)(VERSION) })?;
            Ok(functions)
        })
    }

    /// Returns an error unless the status is OK.
    pub(super) fn check(&self, what: &str, status: c_int) -> Result<(), DeviceError> {
        if status == STATUS_OK {
            return Ok(());
        }
        // SAFETY: the library keeps the text until the thread's next call; it is copied.
        let reason = unsafe {
            let text = (self.GetExtendedError)();
            if text.is_null() { String::new() } else { CStr::from_ptr(text).to_string_lossy().into_owned() }
        };
        let reason: Vec<&str> = reason.split_whitespace().collect();
        let reason = if reason.is_empty() { format!("status {status}") } else { reason.join(" ") };
        let what = format!("{what} (OpenNI2: {reason})");
        Err(if status == STATUS_NO_DEVICE { DeviceError::Gone { what } } else { DeviceError::Failed { what } })
    }

    /// Returns the URIs and names of the connected devices.
    pub(super) fn devices(&self) -> Vec<(String, String)> {
        let (mut list, mut count) = (std::ptr::null_mut(), 0);
        // SAFETY: the list is valid until it is released, and is only read before that.
        unsafe {
            if (self.GetDeviceList)(&raw mut list, &raw mut count) != STATUS_OK || list.is_null() {
                return Vec::new();
            }
            let devices = std::slice::from_raw_parts(list, usize::try_from(count).unwrap_or(0));
            let names = devices.iter().map(|device| (device.uri(), device.description())).collect();
            (self.ReleaseDeviceList)(list);
            names
        }
    }

    /// Returns the name and the URI of a device.
    pub(super) fn info_of(&self, device: Handle) -> Option<(String, String)> {
        let mut info = DeviceInfo { uri: [0; 256], vendor: [0; 256], name: [0; 256], usb_vendor: 0, usb_product: 0 };
        // SAFETY: the device is open.
        let status = unsafe { (self.DeviceGetInfo)(device, &raw mut info) };
        (status == STATUS_OK).then(|| (info.description(), text(&info.uri)))
    }

    /// Returns the modes of a device's sensor; empty if the device lacks that sensor.
    pub(super) fn modes_of(&self, device: Handle, sensor: c_int) -> Vec<VideoMode> {
        // SAFETY: the device is open, and its description of a sensor lives as long.
        unsafe {
            match (self.DeviceGetSensorInfo)(device, sensor).as_ref() {
                Some(info) if !info.modes.is_null() => {
                    std::slice::from_raw_parts(info.modes, usize::try_from(info.modes_count).unwrap_or(0)).to_vec()
                }
                _ => Vec::new(),
            }
        }
    }
}

impl DeviceInfo {
    fn description(&self) -> String {
        [text(&self.vendor), text(&self.name)].join(" ").trim().to_owned()
    }

    pub(super) fn uri(&self) -> String {
        text(&self.uri)
    }
}

/// A property whose value is a plain C type.
pub(super) trait Property: Copy + Default {}

impl Property for c_int {}
impl Property for f32 {}
impl Property for VideoMode {}

/// An object with properties.
#[derive(Clone, Copy)]
pub(super) enum Holder {
    Device(Handle),
    Stream(Handle),
}

impl Functions {
    pub(super) fn get<T: Property>(&self, of: Holder, property: c_int) -> Option<T> {
        let mut value = T::default();
        let mut bytes = size_of::<T>() as c_int;
        let (to, bytes) = ((&raw mut value).cast(), &raw mut bytes);
        // SAFETY: the holder is open, and the library refuses sizes that are not the property's.
        let status = unsafe {
            match of {
                Holder::Device(device) => (self.DeviceGetProperty)(device, property, to, bytes),
                Holder::Stream(stream) => (self.StreamGetProperty)(stream, property, to, bytes),
            }
        };
        (status == STATUS_OK).then_some(value)
    }

    /// Sets a property; returns an error if the device refuses it.
    pub(super) fn set<T: Property>(&self, of: Holder, property: c_int, value: T) -> Result<(), DeviceError> {
        let (from, bytes) = ((&raw const value).cast(), size_of::<T>() as c_int);
        // SAFETY: as above.
        let status = unsafe {
            match of {
                Holder::Device(device) => (self.DeviceSetProperty)(device, property, from, bytes),
                Holder::Stream(stream) => (self.StreamSetProperty)(stream, property, from, bytes),
            }
        };
        self.check("the device rejected a setting", status)
    }
}

/// Returns the text in a fixed-size field, up to its first zero byte.
fn text(field: &[c_char]) -> String {
    let bytes: Vec<u8> = field.iter().map(|&c| c as u8).take_while(|&c| c != 0).collect();
    String::from_utf8_lossy(&bytes).into_owned()
}
