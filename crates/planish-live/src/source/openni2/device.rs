//! Open objects of OpenNI2: a device, its streams, a frame, and the watch that reports a disconnected device. Each is
//! closed when dropped.

use std::ffi::{CString, c_int, c_void};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::api::{self, DeviceCallbacks, DeviceInfo, Frame, Functions, Handle, Holder, VideoMode};
use planish_core::DeviceError;

/// Time between stopping a stream and destroying it.
const AFTER_STOP: Duration = Duration::from_millis(50);

/// An open device.
pub(super) struct Device {
    library: &'static Functions,
    pub(super) handle: Handle,
}

// SAFETY: OpenNI2's handles may be used and closed on any thread, and each of these has one owner.
unsafe impl Send for Device {}
// SAFETY: as above.
unsafe impl Send for Stream {}
// SAFETY: as above.
unsafe impl Send for Watch {}

impl Device {
    pub(super) fn open(library: &'static Functions, uri: &str) -> Result<Self, DeviceError> {
        let mut handle = std::ptr::null_mut();
        let text = CString::new(uri)
            .map_err(|_| DeviceError::Failed { what: format!("{uri:?}: the URI contains a zero byte") })?;
        let name = if uri.is_empty() { std::ptr::null() } else { text.as_ptr() };
        // SAFETY: the text outlives the call; a null name selects any device.
        let status = unsafe { (library.DeviceOpen)(name, &raw mut handle) };
        let Err(error) = library.check("the device cannot be opened", status) else {
            return Ok(Self { library, handle });
        };
        if is_recording(uri) {
            return Err(error);
        }
        let there = library.devices();
        if there.iter().any(|(known, _)| uri.is_empty() || known == uri) {
            let help = "check your permissions (udev rules of OpenNI2's package), and that no other program uses it";
            return Err(DeviceError::Driver { what: error.to_string(), help });
        }
        let help = "check its cable; Orbbec cameras need Orbbec's build of OpenNI2";
        let there: Vec<String> = there.iter().map(|(uri, name)| format!("{uri} ({name})")).collect();
        let found = if there.is_empty() { "none found".to_owned() } else { format!("found {}", there.join(", ")) };
        let which = if uri.is_empty() { String::new() } else { format!(" {uri}") };
        Err(DeviceError::NotFound { what: format!("no OpenNI2 camera{which}: {found}"), help })
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        // SAFETY: the device has no open streams, and this is its only owner.
        unsafe { (self.library.DeviceClose)(self.handle) };
    }
}

/// An open stream of a device.
pub(super) struct Stream {
    library: &'static Functions,
    pub(super) handle: Handle,
}

impl Stream {
    pub(super) fn create(
        library: &'static Functions,
        device: Handle,
        sensor: c_int,
        what: &str,
    ) -> Result<Self, DeviceError> {
        let mut handle = std::ptr::null_mut();
        // SAFETY: the device is open.
        library.check(what, unsafe { (library.DeviceCreateStream)(device, sensor, &raw mut handle) })?;
        Ok(Self { library, handle })
    }

    pub(super) fn start(&self) -> Result<(), DeviceError> {
        // SAFETY: the stream is open.
        self.library.check("the camera does not start", unsafe { (self.library.StreamStart)(self.handle) })
    }

    /// Sets a mode, unless the stream already has it: some devices have only one mode and refuse to set it.
    pub(super) fn set_mode(&self, mode: VideoMode) -> Result<(), DeviceError> {
        let of_stream = Holder::Stream(self.handle);
        if self.library.get(of_stream, api::VIDEO_MODE) == Some(mode) {
            return Ok(());
        }
        self.library.set(of_stream, api::VIDEO_MODE, mode)
    }

    pub(super) fn is_mirrored(&self) -> bool {
        self.library.get::<c_int>(Holder::Stream(self.handle), api::MIRRORING).is_some_and(|is| is != 0)
    }

    /// Returns the newest frame, which must be available.
    pub(super) fn read(&self) -> Result<OwnedFrame, DeviceError> {
        let mut frame = std::ptr::null_mut();
        // SAFETY: the stream is open.
        let status = unsafe { (self.library.StreamReadFrame)(self.handle, &raw mut frame) };
        self.library.check("a frame cannot be read", status)?;
        match frame.is_null() {
            true => Err(DeviceError::Failed { what: "a frame cannot be read: OpenNI2 returned none".into() }),
            false => Ok(OwnedFrame { library: self.library, frame }),
        }
    }
}

impl Drop for Stream {
    fn drop(&mut self) {
        // SAFETY: the stream is open, and this is its only owner.
        unsafe {
            (self.library.StreamStop)(self.handle);
            // The dummy device's thread ends some time after the stop, and uses its stream until then.
            std::thread::sleep(AFTER_STOP);
            (self.library.StreamDestroy)(self.handle);
        }
    }
}

/// A frame that the library keeps until it is released.
pub(super) struct OwnedFrame {
    library: &'static Functions,
    frame: *mut Frame,
}

impl std::ops::Deref for OwnedFrame {
    type Target = Frame;

    fn deref(&self) -> &Frame {
        // SAFETY: not null, and not released before this is dropped.
        unsafe { &*self.frame }
    }
}

impl Drop for OwnedFrame {
    fn drop(&mut self) {
        // SAFETY: this is the only owner.
        unsafe { (self.library.FrameRelease)(self.frame) }
    }
}

/// A watch that detects that a device is gone, or that a recording is over.
pub(super) struct Watch {
    library: &'static Functions,
    registration: Handle,
    /// Data of the library's callbacks: a box that this struct owns as a raw pointer.
    watched: *mut Watched,
}

struct Watched {
    uri: String,
    is_over: AtomicBool,
}

impl Watch {
    pub(super) fn start(library: &'static Functions, uri: String) -> Result<Self, DeviceError> {
        let watched = Box::into_raw(Box::new(Watched { uri, is_over: AtomicBool::new(false) }));
        let mut callbacks =
            DeviceCallbacks { connected: None, disconnected: Some(on_disconnected), state_changed: Some(on_state) };
        let mut registration = std::ptr::null_mut();
        // Frees the box when dropped, even if the registration fails.
        let mut watch = Self { library, registration: std::ptr::null_mut(), watched };
        // SAFETY: the watched data live until the callbacks are unregistered.
        let status =
            unsafe { (library.RegisterDeviceCallbacks)(&raw mut callbacks, watched.cast(), &raw mut registration) };
        library.check("cannot register for the device's events", status)?;
        watch.registration = registration;
        Ok(watch)
    }

    pub(super) fn is_over(&self) -> bool {
        // SAFETY: the data live as long as `self`.
        unsafe { &*self.watched }.is_over.load(Ordering::Relaxed)
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        // SAFETY: no callback runs after it is unregistered, and this is the box's only owner.
        unsafe {
            if !self.registration.is_null() {
                (self.library.UnregisterDeviceCallbacks)(self.registration);
            }
            drop(Box::from_raw(self.watched));
        }
    }
}

/// # Safety
/// `device` must be null or valid, and `watched` must be null or the data registered by a [`Watch`].
unsafe extern "C" fn on_disconnected(device: *const DeviceInfo, watched: *mut c_void) {
    // SAFETY: as above.
    unsafe { end(device, watched) }
}

/// # Safety
/// Same as `on_disconnected`.
unsafe extern "C" fn on_state(device: *const DeviceInfo, state: c_int, watched: *mut c_void) {
    if state == api::STATE_EOF {
        // SAFETY: as above.
        unsafe { end(device, watched) }
    }
}

/// # Safety
/// Same as `on_disconnected`.
unsafe fn end(device: *const DeviceInfo, watched: *mut c_void) {
    // SAFETY: as above.
    if let (Some(device), Some(watched)) = unsafe { (device.as_ref(), watched.cast::<Watched>().as_ref()) }
        && device.uri() == watched.uri
    {
        watched.is_over.store(true, Ordering::Relaxed);
    }
}

/// Returns true if a URI names a recording.
pub(super) fn is_recording(uri: &str) -> bool {
    let path = Path::new(uri);
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("oni")) || path.is_file()
}
