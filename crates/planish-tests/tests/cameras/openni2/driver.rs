//! An OpenNI2 driver that the tests compile: a software camera that behaves like a PrimeSense sensor
//! (OniDriverAPI.h).
//!
//! The device `planish-test` mirrors its images unless configured otherwise, maps depth to colour on request, and
//! starts at 320x240. If the file named by the environment variable PLANISH_TEST_UNPLUG contains a number of frames
//! when the depth stream starts, the device is unplugged after that many frames and plugged in again 0.3 s later.

#![allow(non_snake_case, clippy::missing_safety_doc)]

use std::ffi::{CStr, c_char, c_int, c_void};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicI32, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

const ERROR: c_int = 1;
const COLOR: c_int = 2;
const DEPTH: c_int = 3;
const DEPTH_1_MM: c_int = 100;
const RGB888: c_int = 200;

#[repr(C)]
#[derive(Clone, Copy, PartialEq)]
struct VideoMode {
    format: c_int,
    width: c_int,
    height: c_int,
    fps: c_int,
}

#[repr(C)]
struct SensorInfo {
    sensor: c_int,
    count: c_int,
    modes: *const VideoMode,
}

#[repr(C)]
struct DeviceInfo {
    uri: [c_char; 256],
    vendor: [c_char; 256],
    name: [c_char; 256],
    usb: [u16; 2],
}

#[repr(C)]
struct Frame {
    bytes: c_int,
    data: *mut c_void,
    sensor: c_int,
    timestamp: u64,
    index: c_int,
    width: c_int,
    height: c_int,
    mode: VideoMode,
    cropped: c_int,
    origin: [c_int; 2],
    stride: c_int,
}

#[repr(C)]
struct Services {
    services: *mut c_void,
    required_size: unsafe extern "C" fn(*mut c_void) -> c_int,
    acquire: unsafe extern "C" fn(*mut c_void) -> *mut Frame,
    add_ref: unsafe extern "C" fn(*mut c_void, *mut Frame),
    release: unsafe extern "C" fn(*mut c_void, *mut Frame),
}

type DeviceCallback = unsafe extern "C" fn(*const DeviceInfo, *mut c_void);
type PropertyCallback = unsafe extern "C" fn(*mut c_void, c_int, *const c_void, c_int, *mut c_void);
type FrameCallback = unsafe extern "C" fn(*mut Stream, *mut Frame, *mut c_void);

const fn modes(format: c_int) -> [VideoMode; 2] {
    [VideoMode { format, width: 320, height: 240, fps: 30 }, VideoMode { format, width: 640, height: 480, fps: 30 }]
}

static DEPTH_MODES: [VideoMode; 2] = modes(DEPTH_1_MM);
static COLOR_MODES: [VideoMode; 2] = modes(RGB888);
static REGISTRATION: AtomicI32 = AtomicI32::new(0);
static INFO: Mutex<Option<(&'static DeviceInfo, [DeviceCallback; 2], Pointer)>> = Mutex::new(None);

#[derive(Clone, Copy)]
struct Pointer(*mut c_void);
unsafe impl Send for Pointer {}
unsafe impl Sync for Pointer {}

struct Stream {
    sensor: c_int,
    mode: VideoMode,
    mirroring: c_int,
    services: *mut Services,
    on_frame: Option<(FrameCallback, Pointer)>,
    on_property: Option<(PropertyCallback, Pointer)>,
    running: AtomicBool,
    thread: Option<JoinHandle<()>>,
}

fn text(text: &str) -> [c_char; 256] {
    let mut field = [0; 256];
    text.bytes().enumerate().for_each(|(i, byte)| field[i] = byte as c_char);
    field
}

fn run(stream: Pointer) {
    let stream = stream;
    let at = stream.0.cast::<Stream>();
    // SAFETY: the stream lives until its thread is joined, and its mode does not change while the thread runs.
    let stream = unsafe { &*at };
    let VideoMode { width, height, .. } = stream.mode;
    let file = std::env::var_os("PLANISH_TEST_UNPLUG");
    let unplug = file.and_then(|file| std::fs::read_to_string(file).ok()).and_then(|frames| frames.parse::<c_int>().ok());
    let start = Instant::now();
    for index in 1.. {
        if !stream.running.load(Ordering::Relaxed) {
            return;
        }
        if stream.sensor == DEPTH && unplug.is_some_and(|frames| index > frames) {
            let known = *INFO.lock().unwrap();
            if let Some((info, callbacks, cookie)) = known {
                let [connected, disconnected] = callbacks;
                unsafe {
                    disconnected(info, cookie.0);
                    thread::sleep(Duration::from_millis(300));
                    connected(info, cookie.0);
                }
            }
            return;
        }
        unsafe {
            let services = &*stream.services;
            let frame = (services.acquire)(services.services);
            if let Some(frame) = frame.as_mut() {
                let bytes_a_pixel = if stream.sensor == DEPTH { 2 } else { 3 };
                let mut data = Vec::new();
                for v in 0..height {
                    for u in 0..width {
                        let u = if stream.mirroring != 0 { width - 1 - u } else { u };
                        match stream.sensor {
                            DEPTH => data.extend(((1000 + u + 2 * v + index) as u16).to_le_bytes()),
                            _ => data.extend([u as u8, v as u8, index as u8]),
                        }
                    }
                }
                frame.data.cast::<u8>().copy_from_nonoverlapping(data.as_ptr(), data.len());
                frame.bytes = data.len() as c_int;
                frame.sensor = stream.sensor;
                frame.timestamp = index as u64 * 33_333;
                frame.index = index;
                (frame.width, frame.height, frame.mode) = (width, height, stream.mode);
                (frame.cropped, frame.origin) = (0, [0; 2]);
                frame.stride = width * bytes_a_pixel;
                if let Some((callback, cookie)) = stream.on_frame {
                    callback(at, frame, cookie.0);
                }
                (services.release)(services.services, frame);
            }
        }
        let due = start + Duration::from_micros(33_333 * index as u64);
        thread::sleep(due.saturating_duration_since(Instant::now()));
    }
}

/// Returns the bytes of a property's value.
unsafe fn bytes_of<T>(value: &T) -> Vec<u8> {
    unsafe { std::slice::from_raw_parts((&raw const *value).cast(), size_of::<T>()).to_vec() }
}

impl Stream {
    fn property(&self, id: c_int) -> Option<Vec<u8>> {
        let is_color = self.sensor == COLOR;
        unsafe {
            match id {
                // Cropping
                0 => Some(bytes_of(&[0, 0, 0, self.mode.width, self.mode.height])),
                // Fields of view in radians; the colour camera's are wider.
                1 => Some(bytes_of(&if is_color { 1.1f32 } else { 1.0 })),
                2 => Some(bytes_of(&if is_color { 0.85f32 } else { 0.75 })),
                3 => Some(bytes_of(&self.mode)),
                4 => Some(bytes_of(&10_000)),
                5 => Some(bytes_of(&0)),
                6 => Some(bytes_of(&(self.mode.width * if is_color { 3 } else { 2 }))),
                7 => Some(bytes_of(&self.mirroring)),
                _ => None,
            }
        }
    }
}

unsafe fn give(value: Option<Vec<u8>>, data: *mut c_void, size: *mut c_int) -> c_int {
    match value {
        Some(value) if unsafe { *size } as usize >= value.len() => unsafe {
            data.cast::<u8>().copy_from_nonoverlapping(value.as_ptr(), value.len());
            *size = value.len() as c_int;
            0
        },
        _ => ERROR,
    }
}

#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverCreate(_: *mut c_void) {}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverDestroy() {}

#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverInitialize(
    connected: DeviceCallback,
    disconnected: DeviceCallback,
    _: *mut c_void,
    cookie: *mut c_void,
) -> c_int {
    let info = DeviceInfo { uri: text("planish-test"), vendor: text("planish"), name: text("test camera"), usb: [0; 2] };
    let info: &'static DeviceInfo = Box::leak(Box::new(info));
    *INFO.lock().unwrap() = Some((info, [connected, disconnected], Pointer(cookie)));
    unsafe { connected(info, cookie) };
    0
}

#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverTryDevice(_: *const c_char) -> c_int {
    ERROR
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverDeviceOpen(uri: *const c_char, _: *const c_char) -> *mut c_void {
    let is_ours = unsafe { CStr::from_ptr(uri) } == c"planish-test";
    if is_ours { &raw const REGISTRATION as *mut c_void } else { std::ptr::null_mut() }
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverDeviceClose(_: *mut c_void) {}

#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverDeviceGetSensorInfoList(_: *mut c_void, list: *mut *mut SensorInfo, count: *mut c_int) -> c_int {
    let sensors = [
        SensorInfo { sensor: DEPTH, count: 2, modes: DEPTH_MODES.as_ptr() },
        SensorInfo { sensor: COLOR, count: 2, modes: COLOR_MODES.as_ptr() },
    ];
    unsafe {
        *list = Box::leak(Box::new(sensors)).as_mut_ptr();
        *count = 2;
    }
    0
}

#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverDeviceCreateStream(_: *mut c_void, sensor: c_int) -> *mut Stream {
    Box::into_raw(Box::new(Stream {
        sensor,
        mode: if sensor == DEPTH { DEPTH_MODES[0] } else { COLOR_MODES[0] },
        mirroring: 1,
        services: std::ptr::null_mut(),
        on_frame: None,
        on_property: None,
        running: AtomicBool::new(false),
        thread: None,
    }))
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverDeviceDestroyStream(_: *mut c_void, stream: *mut Stream) {
    unsafe {
        oniDriverStreamStop(stream);
        drop(Box::from_raw(stream));
    }
}

#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverDeviceSetProperty(_: *mut c_void, id: c_int, data: *const c_void, _: c_int) -> c_int {
    if id != 5 {
        return ERROR;
    }
    REGISTRATION.store(unsafe { *data.cast() }, Ordering::Relaxed);
    0
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverDeviceGetProperty(_: *mut c_void, id: c_int, data: *mut c_void, size: *mut c_int) -> c_int {
    let value = (id == 5).then(|| unsafe { bytes_of(&REGISTRATION.load(Ordering::Relaxed)) });
    unsafe { give(value, data, size) }
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverDeviceIsPropertySupported(_: *mut c_void, id: c_int) -> c_int {
    c_int::from(id == 5)
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverDeviceSetPropertyChangedCallback(_: *mut c_void, _: *mut c_void, _: *mut c_void) {}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverDeviceNotifyAllProperties(_: *mut c_void) {}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverDeviceInvoke(_: *mut c_void, _: c_int, _: *mut c_void, _: c_int) -> c_int {
    ERROR
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverDeviceIsCommandSupported(_: *mut c_void, _: c_int) -> c_int {
    0
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverDeviceTryManualTrigger(_: *mut c_void) -> c_int {
    0
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverDeviceIsImageRegistrationModeSupported(_: *mut c_void, _: c_int) -> c_int {
    1
}

#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverStreamSetServices(stream: *mut Stream, services: *mut Services) {
    unsafe { (*stream).services = services };
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverStreamSetProperty(stream: *mut Stream, id: c_int, data: *const c_void, _: c_int) -> c_int {
    let stream = unsafe { &mut *stream };
    match id {
        3 => stream.mode = unsafe { *data.cast() },
        7 => stream.mirroring = unsafe { *data.cast() },
        _ => return ERROR,
    }
    0
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverStreamGetProperty(stream: *mut Stream, id: c_int, data: *mut c_void, size: *mut c_int) -> c_int {
    unsafe { give((*stream).property(id), data, size) }
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverStreamIsPropertySupported(stream: *mut Stream, id: c_int) -> c_int {
    c_int::from(unsafe { &*stream }.property(id).is_some())
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverStreamSetPropertyChangedCallback(stream: *mut Stream, callback: PropertyCallback, cookie: *mut c_void) {
    unsafe { (*stream).on_property = Some((callback, Pointer(cookie))) };
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverStreamNotifyAllProperties(stream: *mut Stream) {
    let this = unsafe { &*stream };
    for id in 0..8 {
        if let (Some((callback, cookie)), Some(value)) = (this.on_property, this.property(id)) {
            unsafe { callback(stream.cast(), id, value.as_ptr().cast(), value.len() as c_int, cookie.0) };
        }
    }
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverStreamInvoke(_: *mut Stream, _: c_int, _: *mut c_void, _: c_int) -> c_int {
    ERROR
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverStreamIsCommandSupported(_: *mut Stream, _: c_int) -> c_int {
    0
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverStreamStart(stream: *mut Stream) -> c_int {
    let pointer = Pointer(stream.cast());
    let stream = unsafe { &mut *stream };
    stream.running.store(true, Ordering::Relaxed);
    stream.thread = Some(thread::spawn(move || run(pointer)));
    0
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverStreamStop(stream: *mut Stream) {
    unsafe { &*stream }.running.store(false, Ordering::Relaxed);
    let thread = unsafe { (*stream).thread.take() };
    let _ = thread.map(JoinHandle::join);
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverStreamGetRequiredFrameSize(stream: *mut Stream) -> c_int {
    unsafe {
        let services = &*(*stream).services;
        (services.required_size)(services.services)
    }
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverStreamSetNewFrameCallback(stream: *mut Stream, callback: FrameCallback, cookie: *mut c_void) {
    unsafe { (*stream).on_frame = Some((callback, Pointer(cookie))) };
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverStreamConvertDepthToColorCoordinates(
    _: *mut Stream,
    _: *mut Stream,
    _: c_int,
    _: c_int,
    _: u16,
    _: *mut c_int,
    _: *mut c_int,
) -> c_int {
    ERROR
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverEnableFrameSync(_: *mut *mut Stream, _: c_int) -> *mut c_void {
    std::ptr::null_mut()
}
#[unsafe(no_mangle)]
unsafe extern "C" fn oniDriverDisableFrameSync(_: *mut c_void) {}
