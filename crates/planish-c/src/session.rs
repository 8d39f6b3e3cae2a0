//! Sessions: an engine kept open for frames of any shape.

use std::collections::VecDeque;
use std::ffi::c_char;
use std::sync::{Mutex, MutexGuard, TryLockError};

use planish::{Outputs, SensorPose, Session, SettingValue, Settings};

use crate::buffers::{text, write_text};
use crate::error::{
    Done, PLANISH_ARGUMENT, PLANISH_BUSY, PLANISH_INTERNAL, PLANISH_SETTING, failure, guarded, planish_code,
};
use crate::handles::Handles;

/// An engine that stays open for frames of any shape, and its settings.
pub struct planish_session {
    _opaque: [u8; 0],
}

pub(crate) struct State {
    pub(crate) session: Session,
    pub(crate) settings: Settings,
    events: VecDeque<String>,
    /// For each frame in flight: the number of items in its result, and its requested outputs.
    pub(crate) flights: VecDeque<(usize, Outputs)>,
}

/// A session, and its watch, which is usable while another thread uses the session.
pub(crate) struct Held {
    state: Mutex<State>,
    watch: planish::ProgressWatch,
}

pub(crate) static SESSIONS: Handles<Held> = Handles::new("session");

impl Held {
    pub(crate) fn lock(&self) -> Done<MutexGuard<'_, State>> {
        match self.state.try_lock() {
            Ok(state) => Ok(state),
            Err(TryLockError::WouldBlock) => {
                failure(PLANISH_BUSY, "another thread is using the session; make one session per thread")
            }
            Err(TryLockError::Poisoned(_)) => {
                failure(PLANISH_INTERNAL, "the session had an internal error before; free it and make another")
            }
        }
    }
}

impl State {
    pub(crate) fn take_events(&mut self) {
        /// Maximum number of unread events; the oldest are dropped.
        const MOST: usize = 100;
        self.events.extend(self.session.take_events().iter().map(ToString::to_string));
        while self.events.len() > MOST {
            self.events.pop_front();
        }
    }

    /// Returns an error if frames are in flight.
    pub(crate) fn check_idle(&self) -> Done<()> {
        match self.session.in_flight() {
            0 => Ok(()),
            in_flight => failure(PLANISH_ARGUMENT, format!("{in_flight} frames are in flight; receive them first")),
        }
    }
}

/// Parses settings from JSON or from `name=value` words.
fn settings_of(text: &str) -> Done<Settings> {
    if text.trim_start().starts_with('{') {
        return serde_json::from_str(text).or_else(|error| failure(PLANISH_SETTING, format!("settings: {error}")));
    }
    Ok(text.parse::<Settings>()?)
}

/// Reads the caller's settings; null means the default.
///
/// # Safety
/// The pointer must be null or point to a zero-terminated string.
pub(crate) unsafe fn settings_from(pointer: *const c_char) -> Done<Settings> {
    match pointer.is_null() {
        true => Ok(Settings::default()),
        // SAFETY: the caller upholds this function's contract.
        false => settings_of(unsafe { text("settings", pointer)? }),
    }
}

/// Creates a session. `settings` are words such as "preset=strong engine=cpu", a JSON object such as {"preset":
/// "strong"}, or null for the default.
///
/// # Safety
/// `settings` must be null or point to a zero-terminated string; `session` must be null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_session_new(
    settings: *const c_char,
    session: *mut *mut planish_session,
) -> planish_code {
    guarded(|| {
        // SAFETY: the caller upholds this function's contract.
        let session = unsafe { writable("session", session)? };
        // SAFETY: the same.
        let settings = unsafe { settings_from(settings)? };
        let inner = Session::new(with_own_threads(&settings))?;
        let watch = inner.watch();
        let (events, flights) = (VecDeque::new(), VecDeque::new());
        let state = Mutex::new(State { session: inner, settings, events, flights });
        *session = SESSIONS.add(Held { state, watch });
        Ok(())
    })
}

/// Returns the settings with an explicit number of threads, since shared threads do not survive a fork.
fn with_own_threads(settings: &Settings) -> Settings {
    let mut settings = settings.clone();
    settings.threads = settings.threads.or_else(|| std::thread::available_parallelism().ok().map(usize::from));
    settings
}

/// Checks and borrows a location to write to.
///
/// # Safety
/// The pointer must be null, or writable for the lifetime of the result.
pub(crate) unsafe fn writable<'a, T>(what: &'static str, pointer: *mut T) -> Done<&'a mut T> {
    crate::buffers::Extent::new(what, pointer, align_of::<T>(), (size_of::<T>(), size_of::<T>(), 1))?;
    // SAFETY: the pointer is aligned and not null; the caller guarantees the rest.
    Ok(unsafe { &mut *pointer })
}

/// Frees a session. Null is allowed. A call that is running on another thread continues; call planish_session_stop
/// first to end it.
#[unsafe(no_mangle)]
pub extern "C" fn planish_session_free(session: *mut planish_session) -> planish_code {
    guarded(|| if session.is_null() { Ok(()) } else { SESSIONS.remove(session) })
}

fn set(session: *mut planish_session, name: &str, value: SettingValue) -> Done<()> {
    let held = SESSIONS.get(session)?;
    let mut state = held.lock()?;
    state.check_idle()?;
    let mut settings = state.settings.clone();
    settings.set(name, value)?;
    settings.validate()?;
    state.session.set_settings(with_own_threads(&settings))?;
    state.settings = settings;
    Ok(())
}

/// Sets a setting from text, such as "sensor" to "d435". An empty value restores the default.
///
/// # Safety
/// `name` and `value` must be null or point to zero-terminated strings.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_session_set(
    session: *mut planish_session,
    name: *const c_char,
    value: *const c_char,
) -> planish_code {
    guarded(|| {
        // SAFETY: the caller upholds this function's contract.
        let (name, value) = unsafe { (text("name", name)?, text("value", value)?) };
        let value = if value.is_empty() { SettingValue::None } else { SettingValue::from(value) };
        set(session, name, value)
    })
}

/// Sets a numeric setting, such as "radius_m".
///
/// # Safety
/// `name` must be null or point to a zero-terminated string.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_session_set_number(
    session: *mut planish_session,
    name: *const c_char,
    value: f64,
) -> planish_code {
    // SAFETY: the caller upholds this function's contract.
    guarded(|| set(session, unsafe { text("name", name)? }, SettingValue::from(value)))
}

/// Sets a boolean setting, such as "remove_isolated".
///
/// # Safety
/// `name` must be null or point to a zero-terminated string.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_session_set_bool(
    session: *mut planish_session,
    name: *const c_char,
    value: bool,
) -> planish_code {
    // SAFETY: the caller upholds this function's contract.
    guarded(|| set(session, unsafe { text("name", name)? }, SettingValue::from(value)))
}

/// Writes the settings as JSON with a terminating zero, truncated to `capacity` bytes. `length` receives the length
/// of the whole text in bytes, without the zero.
///
/// # Safety
/// `buffer` must be null or have room for `capacity` bytes; `length` must be null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_session_settings(
    session: *const planish_session,
    buffer: *mut c_char,
    capacity: usize,
    length: *mut usize,
) -> planish_code {
    guarded(|| {
        let held = SESSIONS.get(session)?;
        let json = serde_json::to_string(&held.lock()?.settings);
        let json = json.or_else(|error| failure(PLANISH_INTERNAL, error.to_string()))?;
        // SAFETY: the caller upholds this function's contract.
        unsafe { write_text(&json, buffer, capacity, length) };
        Ok(())
    })
}

/// Writes the name of the open engine, such as "cpu" or "gpu: NVIDIA H100"; it is empty before the first frame.
/// `capacity` and `length` are as in planish_session_settings.
///
/// # Safety
/// Same as planish_session_settings.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_session_engine(
    session: *const planish_session,
    buffer: *mut c_char,
    capacity: usize,
    length: *mut usize,
) -> planish_code {
    guarded(|| {
        let held = SESSIONS.get(session)?;
        let state = held.lock()?;
        let name = state.session.engine().map_or("", planish::Engine::name);
        let name = match state.session.gpu_name() {
            Some(gpu) => format!("{name}: {gpu}"),
            None => name.to_owned(),
        };
        // SAFETY: the caller upholds this function's contract.
        unsafe { write_text(&name, buffer, capacity, length) };
        Ok(())
    })
}

/// Writes the next event and removes it from the queue. An event is a sentence about something that the session
/// decided or detected by itself, such as a lost GPU or a camera that does not fit. `length` becomes 0 if there is no
/// event. An event that is longer than the buffer is truncated and stays in the queue.
///
/// # Safety
/// Same as planish_session_settings.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_next_event(
    session: *mut planish_session,
    buffer: *mut c_char,
    capacity: usize,
    length: *mut usize,
) -> planish_code {
    guarded(|| {
        let held = SESSIONS.get(session)?;
        let mut state = held.lock()?;
        let text = state.events.front().cloned().unwrap_or_default();
        // SAFETY: the caller upholds this function's contract.
        unsafe { write_text(&text, buffer, capacity, length) };
        if !buffer.is_null() && text.len() < capacity {
            state.events.pop_front();
        }
        Ok(())
    })
}

/// Stops another thread's smoothing of an unorganized cloud with this session; its call returns PLANISH_STOPPED.
/// Calls with frames on a grid are too short to be stopped.
#[unsafe(no_mangle)]
pub extern "C" fn planish_session_stop(session: *const planish_session) -> planish_code {
    guarded(|| {
        SESSIONS.get(session)?.watch.stop();
        Ok(())
    })
}

/// Starts a new video: earlier frames have no effect on the next one.
#[unsafe(no_mangle)]
pub extern "C" fn planish_session_restart_video(session: *mut planish_session) -> planish_code {
    guarded(|| {
        SESSIONS.get(session)?.lock()?.session.restart_video();
        Ok(())
    })
}

/// Sets the pose of the camera in the world for the next frame of a video: x, y, z in metres, then a quaternion w, x,
/// y, z. Null means that the pose is unknown.
///
/// # Safety
/// `pose` must be null or point to 7 values.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_session_set_camera_pose(
    session: *mut planish_session,
    pose: *const f64,
) -> planish_code {
    guarded(|| {
        // SAFETY: the caller upholds this function's contract.
        let pose = unsafe { crate::frame::doubles::<7>("pose", pose)? }.map(SensorPose::from_viewpoint);
        Ok(SESSIONS.get(session)?.lock()?.session.set_camera_pose(pose)?)
    })
}
