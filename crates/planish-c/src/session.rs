//! Sessions: an engine kept open for frames of any shape.

use std::collections::VecDeque;
use std::ffi::c_char;
use std::sync::{Mutex, MutexGuard, TryLockError};

use planish::{
    DepthFrame, Frame, IntoFrame, OrganizedCloud, Outputs, PointCloud, SensorPose, Session, SettingValue, Settings,
    Smoothed, Xyz,
};

use crate::buffers::{check_apart, text, write_text};
use crate::error::{
    Done, PLANISH_ARGUMENT, PLANISH_BUSY, PLANISH_INTERNAL, PLANISH_SETTING, failure, guarded, planish_code,
};
use crate::frame::{Given, planish_frame};
use crate::handles::Handles;
use crate::output::{Wanted, outputs_of, planish_output};
use crate::result::{handle_of, planish_result};

/// An engine that is kept open for frames of any shape, and its settings.
pub struct planish_session {
    _opaque: [u8; 0],
}

struct State {
    session: Session,
    settings: Settings,
    events: VecDeque<String>,
    /// The items and outputs of each frame in flight.
    flights: VecDeque<(usize, Outputs)>,
}

/// A session, and what may be done while a thread uses it.
struct Held {
    state: Mutex<State>,
    watch: planish::ProgressWatch,
}

static SESSIONS: Handles<Held> = Handles::new("session");

impl Held {
    fn lock(&self) -> Done<MutexGuard<'_, State>> {
        match self.state.try_lock() {
            Ok(state) => Ok(state),
            Err(TryLockError::WouldBlock) => failure(PLANISH_BUSY, "another thread is using the session"),
            Err(TryLockError::Poisoned(_)) => {
                failure(PLANISH_INTERNAL, "the session had an internal error before; free it and make another")
            }
        }
    }
}

impl State {
    fn take_events(&mut self) {
        /// Nobody may ever ask for them.
        const MOST: usize = 100;
        self.events.extend(self.session.take_events().iter().map(ToString::to_string));
        while self.events.len() > MOST {
            self.events.pop_front();
        }
    }

    /// Refuses what would mix with frames in flight.
    fn check_idle(&self) -> Done<()> {
        match self.session.in_flight() {
            0 => Ok(()),
            in_flight => failure(PLANISH_ARGUMENT, format!("{in_flight} frames are in flight; receive them first")),
        }
    }

    /// Runs a body with the frame that is smoothed: the caller's, or a copy with the steps before smoothing applied.
    fn with_prepared<T>(&mut self, frame: Frame<'_>, body: impl FnOnce(&mut Session, Frame<'_>) -> Done<T>) -> Done<T> {
        let steps = self.settings.preparation();
        if steps.is_empty() {
            return body(&mut self.session, frame);
        }
        let sensor = self.settings.known_sensor().unwrap_or_default();
        match frame {
            Frame::Depth(view) if !view.is_metres() => {
                let mut owned = owned_depth(&view)?;
                steps.depth(&mut owned, &sensor)?;
                body(&mut self.session, (&owned).into_frame()?)
            }
            frame => {
                let mut owned = owned_cloud(frame)?;
                steps.cloud(&mut owned, &sensor)?;
                body(&mut self.session, (&owned).into_frame()?)
            }
        }
    }

    fn smooth_into(&mut self, given: &Given, wanted: &mut Wanted) -> Done<()> {
        self.check_idle()?;
        self.session.set_outputs(wanted.outputs());
        // SAFETY: the caller of this module's functions promises that memory is as stated; check_apart was called.
        let (frame, out) = unsafe { (given.frame()?, wanted.buffers()) };
        let done = self.with_prepared(frame, |session, frame| Ok(session.smooth_into(frame, out)?));
        self.take_events();
        done
    }

    fn output_shape(&self, width: usize, height: usize) -> [usize; 2] {
        let k = if height > 1 { self.settings.decimate.unwrap_or(1).max(1) as usize } else { 1 };
        [width / k, height / k]
    }
}

/// Returns a depth image of the caller's as one that may be changed.
fn owned_depth(view: &planish::DepthView<'_>) -> Done<DepthFrame> {
    let ((width, height), camera) = (view.shape(), *view.camera());
    let raw = (0..width * height).map(|i| camera.raw_depth(view.depth_m(i % width, i / width))).collect();
    let frame = DepthFrame::new(camera, raw)?;
    Ok(match view.rgb() {
        Some(rgb) => frame.with_rgb(rgb.to_vec()),
        None => frame,
    })
}

/// Returns points of the caller's as a cloud that may be changed.
fn owned_cloud(frame: Frame<'_>) -> Done<OrganizedCloud> {
    match frame {
        Frame::Depth(view) => Ok(view.deproject()?),
        Frame::Points(view) => {
            let Some((width, height)) = view.grid() else {
                let allowed = "min_range_m, max_range_m, remove_floating and decimate are for frames on a grid only";
                return failure(PLANISH_SETTING, allowed);
            };
            let origin_m = view.origin_m();
            let positions: Xyz = (0..view.len()).map(|i| view.get(i).map(|value| value as f32)).collect();
            let mut points = PointCloud::new(positions);
            (points.origin_m, points.pose) = (origin_m, view.pose());
            let mut cloud = OrganizedCloud::new(width, height, points)?;
            cloud.camera = view.camera().copied();
            Ok(cloud)
        }
    }
}

/// Reads settings: JSON, or `name=value` words.
fn settings_of(text: &str) -> Done<Settings> {
    if text.trim_start().starts_with('{') {
        return serde_json::from_str(text).or_else(|error| failure(PLANISH_SETTING, format!("settings: {error}")));
    }
    Ok(text.parse::<Settings>()?)
}

/// Reads the caller's settings; null is the default.
///
/// # Safety
/// The pointer is null or a text that ends with a zero.
pub(crate) unsafe fn settings_from(pointer: *const c_char) -> Done<Settings> {
    match pointer.is_null() {
        true => Ok(Settings::default()),
        // SAFETY: as the caller promises.
        false => settings_of(unsafe { text("settings", pointer)? }),
    }
}

/// Makes a session. `settings` are words such as "preset=strong engine=cpu", a JSON object such as
/// {"preset": "strong"}, or null for the default.
///
/// # Safety
/// `settings` is null or a text that ends with a zero; `session` is null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_session_new(
    settings: *const c_char,
    session: *mut *mut planish_session,
) -> planish_code {
    guarded(|| {
        // SAFETY: as the caller promises.
        let session = unsafe { writable("the place for the session", session)? };
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

/// Returns the settings with a number of threads: shared ones do not survive a fork.
fn with_own_threads(settings: &Settings) -> Settings {
    let mut settings = settings.clone();
    settings.threads = settings.threads.or_else(|| std::thread::available_parallelism().ok().map(usize::from));
    settings
}

/// Returns a place for a result.
///
/// # Safety
/// The pointer is null, or writable for as long as the result lives.
pub(crate) unsafe fn writable<'a, T>(what: &'static str, pointer: *mut T) -> Done<&'a mut T> {
    crate::buffers::Extent::new(what, pointer, align_of::<T>(), (size_of::<T>(), size_of::<T>(), 1))?;
    // SAFETY: it is not null and aligned; the rest is the caller's promise.
    Ok(unsafe { &mut *pointer })
}

/// Frees a session. Null is allowed. A call in another thread continues until it is done; stop it first.
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

/// Sets a setting by its name and value as text, such as "sensor" and "d435"; an empty value is the default.
///
/// # Safety
/// The texts are null or end with a zero.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_session_set(
    session: *mut planish_session,
    name: *const c_char,
    value: *const c_char,
) -> planish_code {
    guarded(|| {
        // SAFETY: as the caller promises.
        let (name, value) = unsafe { (text("name", name)?, text("value", value)?) };
        let value = if value.is_empty() { SettingValue::None } else { SettingValue::from(value) };
        set(session, name, value)
    })
}

/// Sets a setting that is a number, such as "radius_m".
///
/// # Safety
/// The name is null or ends with a zero.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_session_set_number(
    session: *mut planish_session,
    name: *const c_char,
    value: f64,
) -> planish_code {
    // SAFETY: as the caller promises.
    guarded(|| set(session, unsafe { text("name", name)? }, SettingValue::from(value)))
}

/// Sets a setting that is true or false, such as "remove_isolated".
///
/// # Safety
/// The name is null or ends with a zero.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_session_set_bool(
    session: *mut planish_session,
    name: *const c_char,
    value: bool,
) -> planish_code {
    // SAFETY: as the caller promises.
    guarded(|| set(session, unsafe { text("name", name)? }, SettingValue::from(value)))
}

/// What the setting decimate means for the caller's buffers.
const DECIMATED: &str = "; the setting decimate makes it smaller (planish_output_shape)";

/// Writes the settings as JSON, ended by a zero and cut off after `capacity` bytes; `length` is its whole length.
///
/// # Safety
/// `buffer` is null or has room for `capacity` bytes; `length` is null or writable.
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
        // SAFETY: as the caller promises.
        unsafe { write_text(&json, buffer, capacity, length) };
        Ok(())
    })
}

/// Writes the name of the engine that is open, such as "cpu" or "gpu: NVIDIA H100"; empty before the first frame.
///
/// # Safety
/// As of planish_session_settings.
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
        // SAFETY: as the caller promises.
        unsafe { write_text(&name, buffer, capacity, length) };
        Ok(())
    })
}

/// Takes the next thing that the session decided or found without being asked, as a sentence: a GPU that was lost, a
/// camera that does not fit. Without one, `length` is 0. An event longer than the buffer is kept.
///
/// # Safety
/// As of planish_session_settings.
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
        // SAFETY: as the caller promises.
        unsafe { write_text(&text, buffer, capacity, length) };
        if !buffer.is_null() && text.len() < capacity {
            state.events.pop_front();
        }
        Ok(())
    })
}

/// Stops the cloud that another thread is smoothing with this session; its call returns PLANISH_STOPPED. Frames on a
/// grid take too little time to be stopped.
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

/// Tells where the camera of the next frame of a video is in the world: x, y, z in metres, then a quaternion w, x, y,
/// z. Null means that it is not known.
///
/// # Safety
/// `pose` is null or has 7 values.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_session_set_camera_pose(
    session: *mut planish_session,
    pose: *const f64,
) -> planish_code {
    guarded(|| {
        // SAFETY: as the caller promises.
        let pose = unsafe { crate::frame::doubles::<7>("pose", pose)? }.map(SensorPose::from_viewpoint);
        Ok(SESSIONS.get(session)?.lock()?.session.set_camera_pose(pose)?)
    })
}

/// Returns the columns and rows of the result for a frame of this size; they differ with the setting decimate.
///
/// # Safety
/// `output_width` and `output_height` are null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_output_shape(
    session: *const planish_session,
    width: usize,
    height: usize,
    output_width: *mut usize,
    output_height: *mut usize,
) -> planish_code {
    guarded(|| {
        // SAFETY: as the caller promises.
        let places = unsafe { [writable("output_width", output_width)?, writable("output_height", output_height)?] };
        let shape = SESSIONS.get(session)?.lock()?.output_shape(width, height);
        places.into_iter().zip(shape).for_each(|(place, size)| *place = size);
        Ok(())
    })
}

/// Smooths a frame into the caller's buffers.
///
/// # Safety
/// The structs are null or as described, and so is the memory that they point to.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_smooth(
    session: *mut planish_session,
    frame: *const planish_frame,
    output: *const planish_output,
) -> planish_code {
    guarded(|| {
        let held = SESSIONS.get(session)?;
        let mut state = held.lock()?;
        // SAFETY: as the caller promises.
        let (given, mut wanted) = unsafe { (Given::new(frame)?, Wanted::new(output)?) };
        let [width, height] = state.output_shape(given.width(), given.height());
        let is_decimated = (width, height) != (given.width(), given.height());
        wanted.check_count(width * height, if is_decimated { DECIMATED } else { "" })?;
        check_apart(&given.extents, &wanted.extents)?;
        state.smooth_into(&given, &mut wanted)
    })
}

/// Smooths a frame into a result that the library owns. `outputs` is a sum of PLANISH_POINTS, PLANISH_NORMALS and so
/// on.
///
/// # Safety
/// `frame` is null or as described, and so is the memory that it points to; `result` is null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_smooth_new(
    session: *mut planish_session,
    frame: *const planish_frame,
    outputs: u32,
    result: *mut *mut planish_result,
) -> planish_code {
    guarded(|| {
        let held = SESSIONS.get(session)?;
        let mut state = held.lock()?;
        // SAFETY: as the caller promises.
        let (result, given) = unsafe { (writable("the place for the result", result)?, Given::new(frame)?) };
        let outputs: Outputs = outputs_of(outputs)?;
        state.check_idle()?;
        state.session.set_outputs(outputs);
        let mut smoothed = Smoothed::default();
        // SAFETY: the same.
        let frame = unsafe { given.frame()? };
        let done = state.with_prepared(frame, |session, frame| Ok(session.smooth(frame, &mut smoothed)?));
        state.take_events();
        done?;
        *result = handle_of(smoothed);
        Ok(())
    })
}

/// Hands a frame over; its result is received later, in the same order. The frame is copied, or smoothed at once. A GPU
/// works on several frames at a time.
///
/// # Safety
/// As of planish_smooth_new.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_submit(
    session: *mut planish_session,
    frame: *const planish_frame,
    outputs: u32,
) -> planish_code {
    guarded(|| {
        let held = SESSIONS.get(session)?;
        let mut state = held.lock()?;
        // SAFETY: as the caller promises.
        let given = unsafe { Given::new(frame)? };
        let outputs = outputs_of(outputs)?;
        if state.settings.fill.is_some() || outputs.sigma {
            let text = "the setting fill and the output sigma need planish_smooth: frames in flight are not kept";
            return failure(PLANISH_SETTING, text);
        }
        state.session.set_outputs(outputs);
        // SAFETY: the same.
        let frame = unsafe { given.frame()? };
        let done = state.with_prepared(frame, |session, frame| Ok(session.submit_in_place(frame)?));
        state.take_events();
        done?;
        let [width, height] = state.output_shape(given.width(), given.height());
        state.flights.push_back((width * height, outputs));
        Ok(())
    })
}

/// Waits for the oldest frame in flight, and writes its result. `received` is false if none is in flight.
///
/// # Safety
/// `output` is null or as described, and so is the memory that it points to; `received` is null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_receive(
    session: *mut planish_session,
    output: *const planish_output,
    received: *mut bool,
) -> planish_code {
    guarded(|| {
        let held = SESSIONS.get(session)?;
        let mut state = held.lock()?;
        // SAFETY: as the caller promises.
        let (mut wanted, received) = unsafe { (Wanted::new(output)?, writable("received", received)?) };
        check_apart(&[], &wanted.extents)?;
        *received = false;
        // A frame that cannot be delivered stays in flight.
        if let Some(&(count, outputs)) = state.flights.front() {
            wanted.check_count(count, "")?;
            wanted.check_outputs(outputs)?;
        }
        let view = state.session.receive();
        while state.flights.len() > state.session.in_flight() {
            state.flights.pop_front();
        }
        state.take_events();
        if let Some(view) = view? {
            // SAFETY: the same.
            view.copy_into(unsafe { wanted.buffers() })?;
            *received = true;
        }
        Ok(())
    })
}

/// Returns how many frames are in flight, and how many may be.
///
/// # Safety
/// `in_flight` and `most` are null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_in_flight(
    session: *const planish_session,
    in_flight: *mut usize,
    most: *mut usize,
) -> planish_code {
    guarded(|| {
        let held = SESSIONS.get(session)?;
        let state = held.lock()?;
        for (place, value) in [(in_flight, state.session.in_flight()), (most, state.session.max_in_flight())] {
            if !place.is_null() {
                // SAFETY: as the caller promises.
                *unsafe { writable("the place for a number", place)? } = value;
            }
        }
        Ok(())
    })
}
