//! Smoothing of a session's frames, either in one call or by submitting frames and receiving results.

use planish::{DepthFrame, Frame, IntoFrame, OrganizedCloud, Outputs, PointCloud, Session, Smoothed, Xyz};

use crate::error::{Done, PLANISH_SETTING, failure, guarded, planish_code};
use crate::frame::{Given, planish_frame};
use crate::output::{Wanted, outputs_of, planish_output};
use crate::result::{handle_of, planish_result};
use crate::session::{SESSIONS, State, planish_session, writable};

/// Explanation appended to an error about a buffer size if the result is smaller than the frame.
const DECIMATED: &str = "; the setting decimate makes the result smaller (see planish_output_shape)";

impl State {
    /// Calls `body` with the caller's frame, or with a processed copy if the settings contain steps before smoothing.
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
        // SAFETY: the callers of this module's C functions guarantee that the pointers are valid, and check_apart has
        // verified that the buffers do not overlap.
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

/// Copies the caller's depth image.
fn owned_depth(view: &planish::DepthView<'_>) -> Done<DepthFrame> {
    let ((width, height), camera) = (view.shape(), *view.camera());
    let raw = (0..width * height).map(|i| camera.raw_depth(view.depth_m(i % width, i / width))).collect();
    let frame = DepthFrame::new(camera, raw)?;
    Ok(match view.rgb() {
        Some(rgb) => frame.with_rgb(rgb.to_vec()),
        None => frame,
    })
}

/// Copies the caller's points, or computes them from its depth.
fn owned_cloud(frame: Frame<'_>) -> Done<OrganizedCloud> {
    match frame {
        Frame::Depth(view) => Ok(view.deproject()?),
        Frame::Points(view) => {
            let Some((width, height)) = view.grid() else {
                let allowed = "min_range_m, max_range_m, remove_floating and decimate apply only to frames on a grid";
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

/// Writes the width and height of the result for a frame of the given width and height. They are smaller than the
/// frame's only with the setting decimate.
///
/// # Safety
/// `output_width` and `output_height` must be null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_output_shape(
    session: *const planish_session,
    width: usize,
    height: usize,
    output_width: *mut usize,
    output_height: *mut usize,
) -> planish_code {
    guarded(|| {
        // SAFETY: the caller upholds this function's contract.
        let places = unsafe { [writable("output_width", output_width)?, writable("output_height", output_height)?] };
        let shape = SESSIONS.get(session)?.lock()?.output_shape(width, height);
        places.into_iter().zip(shape).for_each(|(place, size)| *place = size);
        Ok(())
    })
}

/// Smooths a frame into the caller's buffers.
///
/// # Safety
/// `frame` and `output` must be null, or point to structs whose pointers are null or valid as their members state.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_smooth(
    session: *mut planish_session,
    frame: *const planish_frame,
    output: *const planish_output,
) -> planish_code {
    guarded(|| {
        let held = SESSIONS.get(session)?;
        let mut state = held.lock()?;
        // SAFETY: the caller upholds this function's contract.
        let (given, mut wanted) = unsafe { (Given::new(frame)?, Wanted::new(output)?) };
        let [width, height] = state.output_shape(given.width(), given.height());
        let is_decimated = (width, height) != (given.width(), given.height());
        wanted.check_count(width * height, if is_decimated { DECIMATED } else { "" })?;
        wanted.check_apart(&given.extents)?;
        state.smooth_into(&given, &mut wanted)
    })
}

/// Smooths a frame into a result that the library owns. `outputs` is a sum of PLANISH_POINTS, PLANISH_NORMALS and so
/// on.
///
/// # Safety
/// `frame` must be null, or point to a struct whose pointers are null or valid as its members state. `result` must be
/// null or writable.
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
        // SAFETY: the caller upholds this function's contract.
        let (result, given) = unsafe { (writable("the pointer to the result", result)?, Given::new(frame)?) };
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

/// Submits a frame. planish_receive returns the results in the order of submission. The frame is either copied or
/// smoothed during this call. A GPU works on several frames at a time. `outputs` is as in planish_smooth_new.
///
/// # Safety
/// `frame` must be null, or point to a struct whose pointers are null or valid as its members state.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_submit(
    session: *mut planish_session,
    frame: *const planish_frame,
    outputs: u32,
) -> planish_code {
    guarded(|| {
        let held = SESSIONS.get(session)?;
        let mut state = held.lock()?;
        // SAFETY: the caller upholds this function's contract.
        let given = unsafe { Given::new(frame)? };
        let outputs = outputs_of(outputs)?;
        if state.settings.fill.is_some() || outputs.sigma {
            let text = "the setting fill and the output sigma need planish_smooth, since frames in flight are not kept";
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

/// Waits for the oldest frame in flight and writes its result. `received` becomes false if no frame is in flight.
///
/// # Safety
/// `output` must be null, or point to a struct whose pointers are null or valid as its members state. `received` must
/// be null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_receive(
    session: *mut planish_session,
    output: *const planish_output,
    received: *mut bool,
) -> planish_code {
    guarded(|| {
        let held = SESSIONS.get(session)?;
        let mut state = held.lock()?;
        // SAFETY: the caller upholds this function's contract.
        let (mut wanted, received) = unsafe { (Wanted::new(output)?, writable("received", received)?) };
        wanted.check_apart(&[])?;
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

/// Writes the number of frames in flight to `in_flight` and the maximum number to `most`.
///
/// # Safety
/// `in_flight` and `most` must be null or writable.
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
                // SAFETY: the caller upholds this function's contract.
                *unsafe { writable("the pointer to a number", place)? } = value;
            }
        }
        Ok(())
    })
}
