//! A live Kinect v1 through libfreenect, loaded at run time and never linked.
//!
//! The library is `libfreenect.so.0.5`, or the path in the environment variable PLANISH_LIBFREENECT. If the driver
//! supports it, depth is registered to the colour camera, in millimetres. Otherwise it is raw 11-bit disparity,
//! converted by [`disparity_depth_m`](super::disparity_depth_m), and each point gets the colour of the pixel that it
//! projects to. One thread owns the device and turns the driver's events into frames; only the newest is kept.
//!
//! libfreenect's playback library has the same file name. It exits the process if there is no recording, and aborts
//! if it lacks the requested mode. It is recognized by its missing functions, and opened with 11-bit depth and RGB,
//! which it supports.

use std::ffi::{c_int, c_void};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TryRecvError, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Instant;

use super::driver::{self, c_functions};
use super::freenect::frame_of_disparities;
use super::silence::longest_silence;
use super::{OwnedFrame, Source, malformed, with_shape};
use planish_core::{Camera, DepthFrame, DeviceError, Error};

/// Number of pixels per frame: both cameras run at their medium resolution.
const PIXELS: usize = 640 * 480;

// From libfreenect.h, version 0.5.
const RESOLUTION_MEDIUM: c_int = 1;
const VIDEO_RGB: c_int = 0;
const DEPTH_11BIT: c_int = 0;
const DEPTH_REGISTERED: c_int = 4;
const DEVICE_CAMERA: c_int = 2;
const LOG_ERROR: c_int = 1;
/// Error code of libusb if a signal interrupted the wait.
const LIBUSB_INTERRUPTED: c_int = -10;

/// `freenect_frame_mode`.
#[repr(C)]
#[derive(Clone, Copy)]
struct FrameMode {
    reserved: u32,
    resolution: c_int,
    format: i32,
    bytes: i32,
    width: i16,
    height: i16,
    data_bits_per_pixel: i8,
    padding_bits_per_pixel: i8,
    framerate: i8,
    is_valid: i8,
}

const _: () = assert!(size_of::<FrameMode>() == 24);

/// `struct timeval`.
#[repr(C)]
struct TimeVal {
    seconds: std::ffi::c_long,
    microseconds: std::ffi::c_long,
}

type Context = *mut c_void;
type Device = *mut c_void;
type FrameCallback = unsafe extern "C" fn(Device, *mut c_void, u32);

c_functions! {
    /// The functions of libfreenect.
    struct Functions("freenect_") {
        init(*mut Context, *mut c_void) -> c_int;
        shutdown(Context) -> c_int;
        set_log_level(Context, c_int);
        select_subdevices(Context, c_int);
        num_devices(Context) -> c_int;
        open_device(Context, *mut Device, c_int) -> c_int;
        close_device(Device) -> c_int;
        set_user(Device, *mut c_void);
        get_user(Device) -> *mut c_void;
        find_video_mode(c_int, c_int) -> FrameMode;
        find_depth_mode(c_int, c_int) -> FrameMode;
        set_video_mode(Device, FrameMode) -> c_int;
        set_depth_mode(Device, FrameMode) -> c_int;
        set_video_callback(Device, FrameCallback);
        set_depth_callback(Device, FrameCallback);
        start_video(Device) -> c_int;
        start_depth(Device) -> c_int;
        stop_video(Device) -> c_int;
        stop_depth(Device) -> c_int;
        process_events_timeout(Context, *mut TimeVal) -> c_int;
    }
}

struct Freenect {
    functions: Functions,
    /// Whether this is the playback library.
    is_playback: bool,
}

impl std::ops::Deref for Freenect {
    type Target = Functions;

    fn deref(&self) -> &Functions {
        &self.functions
    }
}

impl Freenect {
    fn load() -> Result<Self, DeviceError> {
        let help = "install libfreenect (Debian: libfreenect0.5), or set PLANISH_LIBFREENECT to its file";
        let library = driver::load("PLANISH_LIBFREENECT", ["libfreenect.so.0.5".to_owned()], help)?;
        // SAFETY: the symbol is only looked up, and the signatures match libfreenect.h 0.5.
        unsafe {
            let is_playback = library.get::<*const c_void>(b"freenect_copy_registration\0").is_err();
            let functions = Functions::find(library)
                .map_err(|error| DeviceError::Driver { what: format!("not libfreenect 0.5: {error}"), help })?;
            Ok(Self { functions, is_playback })
        }
    }
}

/// The state of the callbacks, which run on the thread that owns the device. The device's user pointer points to this
/// state.
struct Events {
    /// Whether depth is registered, in millimetres; otherwise it consists of raw 11-bit disparities.
    registered: bool,
    /// The caller's camera; `None` uses a typical Kinect's.
    camera: Option<Camera>,
    rgb: Option<Vec<u8>>,
    /// The device's last timestamp, in ticks; its counter wraps after 71 s.
    last_ticks: u32,
    /// The device's last timestamp in ticks, without wrapping.
    ticks: u64,
    newest: Newest,
}

/// The newest frame, and a signal for its arrival.
struct Newest {
    frame: Arc<Mutex<Option<DepthFrame>>>,
    arrived: SyncSender<()>,
    /// Frames that were replaced before they were taken.
    dropped: Arc<AtomicU64>,
}

impl Newest {
    fn put(&self, frame: DepthFrame) {
        let before = self.frame.lock().unwrap_or_else(PoisonError::into_inner).replace(frame);
        self.dropped.fetch_add(u64::from(before.is_some()), Ordering::Relaxed);
        // One signal is enough for any number of frames.
        if let Err(TrySendError::Disconnected(())) = self.arrived.try_send(()) {}
    }
}

/// A running Kinect v1.
pub struct KinectSource {
    newest: Arc<Mutex<Option<DepthFrame>>>,
    dropped: Arc<AtomicU64>,
    arrived: Receiver<()>,
    /// The result of the thread, once it has ended.
    ended: Arc<Mutex<Option<Result<(), DeviceError>>>>,
    stop: Option<SyncSender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl KinectSource {
    /// Opens a Kinect by its index, 0 for the first, with the given intrinsics or those of a typical Kinect.
    pub fn open(index: u32, camera: Option<Camera>) -> Result<Self, Error> {
        let freenect = Freenect::load()?;
        if freenect.is_playback {
            let folder = std::env::var_os("FAKENECT_PATH").unwrap_or_default();
            let file = Path::new(&folder).join("INDEX.txt");
            if !file.is_file() {
                // Without a recording, the playback library would exit the process.
                let problem =
                    "no recording for the playback library; set FAKENECT_PATH to the folder that contains INDEX.txt";
                return Err(malformed(&file, problem).into());
            }
        }
        let (arrived_in, arrived) = sync_channel(1);
        let (stop, stopped) = sync_channel(0);
        let (opened_in, opened) = sync_channel(1);
        let newest: Arc<Mutex<Option<DepthFrame>>> = Arc::default();
        let ended: Arc<Mutex<Option<Result<(), DeviceError>>>> = Arc::default();
        let dropped: Arc<AtomicU64> = Arc::default();
        let slot = Newest { frame: Arc::clone(&newest), arrived: arrived_in, dropped: Arc::clone(&dropped) };
        let end = Arc::clone(&ended);
        let work = move || {
            let result = run(&freenect, index, camera, slot, &opened_in, &stopped);
            *end.lock().unwrap_or_else(PoisonError::into_inner) = Some(result);
        };
        let failed = |error: std::io::Error| DeviceError::Failed {
            what: format!("cannot start a thread for the Kinect: {error}"),
        };
        let thread = thread::Builder::new().name("planish-kinect".into()).spawn(work).map_err(failed)?;
        let source = Self { newest, dropped, arrived, ended, stop: Some(stop), thread: Some(thread) };
        // The thread sends a signal once it runs; if it fails before that, the channel closes.
        match opened.recv() {
            Ok(()) => Ok(source),
            Err(_) => {
                Err(source.reason().unwrap_or(DeviceError::Failed { what: "the Kinect did not start".into() }).into())
            }
        }
    }

    /// Waits for the thread, and returns the error that ended it, if any.
    fn reason(mut self) -> Option<DeviceError> {
        self.stop = None;
        let _ = self.thread.take().map(JoinHandle::join);
        self.ended.lock().unwrap_or_else(PoisonError::into_inner).take()?.err()
    }

    fn take(&self) -> Option<OwnedFrame> {
        self.newest.lock().unwrap_or_else(PoisonError::into_inner).take().map(OwnedFrame::Depth)
    }
}

impl Source for KinectSource {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        let deadline = Instant::now() + longest_silence();
        loop {
            if let Some(frame) = self.take() {
                return Ok(Some(frame));
            }
            match self.arrived.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok(()) => {}
                Err(RecvTimeoutError::Timeout) => {
                    let what = format!("the Kinect delivered no depth for {} s", longest_silence().as_secs());
                    return Err(DeviceError::Gone { what }.into());
                }
                Err(RecvTimeoutError::Disconnected) => {
                    // The thread has ended; it may have left a last frame.
                    if let Some(frame) = self.take() {
                        return Ok(Some(frame));
                    }
                    let _ = self.thread.take().map(JoinHandle::join);
                    let ended = self.ended.lock().unwrap_or_else(PoisonError::into_inner).take();
                    return ended.unwrap_or(Ok(())).map(|()| None).map_err(Error::from);
                }
            }
        }
    }

    fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    fn is_live(&self) -> bool {
        true
    }
}

impl Drop for KinectSource {
    fn drop(&mut self) {
        self.stop = None;
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// Runs the thread: opens the device, handles its events until stopped or disconnected, and closes it.
fn run(
    freenect: &Freenect,
    index: u32,
    camera: Option<Camera>,
    newest: Newest,
    opened: &SyncSender<()>,
    stopped: &Receiver<()>,
) -> Result<(), DeviceError> {
    let failed =
        |what: &str, code: c_int| DeviceError::Failed { what: format!("{what} (libfreenect returned {code})") };
    let mut context: Context = std::ptr::null_mut();
    // SAFETY: only functions of libfreenect are called, with pointers that it returned or that outlive their use, and
    // only on this thread.
    unsafe {
        match (freenect.init)(&mut context, std::ptr::null_mut()) {
            code if code < 0 => return Err(failed("cannot start libfreenect", code)),
            _ => {}
        }
        (freenect.set_log_level)(context, LOG_ERROR);
        (freenect.select_subdevices)(context, DEVICE_CAMERA);
        let count = (freenect.num_devices)(context);
        let number = c_int::try_from(index).unwrap_or(c_int::MAX);
        let result = if count <= number {
            Err(DeviceError::NotFound {
                what: format!("Kinect number {index} not found; connected Kinects: {}", count.max(0)),
                help: "check its cable, its power supply and your permissions (Debian: the group plugdev)",
            })
        } else {
            let mut device: Device = std::ptr::null_mut();
            match (freenect.open_device)(context, &mut device, number) {
                code if code < 0 => Err(failed("the Kinect cannot be opened; another program may be using it", code)),
                _ => {
                    let result = run_device(freenect, context, device, camera, newest, opened, stopped);
                    (freenect.close_device)(device);
                    result
                }
            }
        };
        (freenect.shutdown)(context);
        result
    }
}

/// # Safety
/// The context and the device must be open, and this must run on their thread.
unsafe fn run_device(
    freenect: &Freenect,
    context: Context,
    device: Device,
    camera: Option<Camera>,
    newest: Newest,
    opened: &SyncSender<()>,
    stopped: &Receiver<()>,
) -> Result<(), DeviceError> {
    // SAFETY: as for `run`. `events` outlives the streams that use it: they are stopped, and the pointer to it is
    // reset, even after a failure.
    unsafe {
        let registered =
            !freenect.is_playback && (freenect.find_depth_mode)(RESOLUTION_MEDIUM, DEPTH_REGISTERED).is_valid != 0;
        let mut events = Events { registered, camera, rgb: None, last_ticks: 0, ticks: 0, newest };
        GET_USER.set(freenect.get_user);
        (freenect.set_user)(device, (&raw mut events).cast());
        let result = start_streams(freenect, device, registered).and_then(|()| {
            // Sending fails if the source was already dropped.
            let _ = opened.send(());
            handle_events(freenect, context, stopped)
        });
        // Stopping a stream that was not started is a harmless error.
        (freenect.stop_depth)(device);
        (freenect.stop_video)(device);
        (freenect.set_user)(device, std::ptr::null_mut());
        result
    }
}

/// # Safety
/// The device must be open, its user pointer must be set, and this must run on its thread.
unsafe fn start_streams(freenect: &Freenect, device: Device, registered: bool) -> Result<(), DeviceError> {
    let check = |what: &str, code: c_int| match code {
        0.. => Ok(()),
        _ => Err(DeviceError::Failed { what: format!("{what} (libfreenect returned {code})") }),
    };
    // SAFETY: as for `run`.
    unsafe {
        let format = if registered { DEPTH_REGISTERED } else { DEPTH_11BIT };
        let mode = (freenect.find_depth_mode)(RESOLUTION_MEDIUM, format);
        check("cannot set the mode of the depth camera", (freenect.set_depth_mode)(device, mode))?;
        (freenect.set_depth_callback)(device, on_depth);
        let mode = (freenect.find_video_mode)(RESOLUTION_MEDIUM, VIDEO_RGB);
        check("cannot set the mode of the colour camera", (freenect.set_video_mode)(device, mode))?;
        (freenect.set_video_callback)(device, on_video);
        check("the colour camera does not start", (freenect.start_video)(device))?;
        check("the depth camera does not start", (freenect.start_depth)(device))
    }
}

/// Handles events until the channel `stopped` closes, a recording ends, or the device is gone.
///
/// # Safety
/// The context must be open, and this must run on its thread.
unsafe fn handle_events(freenect: &Freenect, context: Context, stopped: &Receiver<()>) -> Result<(), DeviceError> {
    while stopped.try_recv() != Err(TryRecvError::Disconnected) {
        let mut timeout = TimeVal { seconds: 0, microseconds: 100_000 };
        // SAFETY: as for `run`.
        match unsafe { (freenect.process_events_timeout)(context, &mut timeout) } {
            0.. => {}
            LIBUSB_INTERRUPTED => {}
            // The recording has ended.
            _ if freenect.is_playback => break,
            code => {
                return Err(DeviceError::Gone {
                    what: format!("the Kinect was disconnected (libfreenect returned {code})"),
                });
            }
        }
    }
    Ok(())
}

thread_local! {
    /// `freenect_get_user`, for the callbacks on the device's thread.
    static GET_USER: std::cell::Cell<unsafe extern "C" fn(Device) -> *mut c_void> = const { std::cell::Cell::new(no_user) };
}

unsafe extern "C" fn no_user(_: Device) -> *mut c_void {
    std::ptr::null_mut()
}

/// # Safety
/// Must be called on the thread of a device whose user pointer is null or points to an [`Events`].
unsafe fn events_of<'a>(device: Device) -> Option<&'a mut Events> {
    // SAFETY: set in `run_device`, where the events live until the streams are stopped.
    unsafe { (GET_USER.get())(device).cast::<Events>().as_mut() }
}

unsafe extern "C" fn on_depth(device: Device, depth: *mut c_void, ticks: u32) {
    // SAFETY: libfreenect passes 2 bytes per pixel, not always at an even address: they are read as bytes.
    let (events, bytes) = unsafe {
        let Some(events) = events_of(device) else { return };
        (events, std::slice::from_raw_parts(depth.cast::<u8>(), 2 * PIXELS))
    };
    events.ticks += u64::from(ticks.wrapping_sub(events.last_ticks));
    events.last_ticks = ticks;
    // The device's clock ticks 60 million times a second.
    let timestamp_s = Some(events.ticks as f64 / 60e6);
    let frame = if events.registered {
        let raw = bytes.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]])).collect();
        let mut frame = DepthFrame::unchecked(registered_camera(events.camera), raw);
        (frame.rgb, frame.timestamp_s) = (events.rgb.clone(), timestamp_s);
        frame
    } else {
        frame_of_disparities(bytes, events.rgb.as_deref(), events.camera, timestamp_s)
    };
    events.newest.put(frame);
}

/// Returns the camera for depth registered to the colour camera: the given camera or a typical Kinect's, in
/// millimetres.
fn registered_camera(camera: Option<Camera>) -> Camera {
    let camera = with_shape(camera.unwrap_or(Camera::kinect_v1()), (640, 480));
    camera.with_depth_units_per_metre(1000.0)
}

unsafe extern "C" fn on_video(device: Device, video: *mut c_void, _: u32) {
    // SAFETY: libfreenect passes 3 bytes per pixel.
    unsafe {
        let Some(events) = events_of(device) else { return };
        events.rgb = Some(std::slice::from_raw_parts(video.cast::<u8>(), 3 * PIXELS).to_vec());
    }
}
