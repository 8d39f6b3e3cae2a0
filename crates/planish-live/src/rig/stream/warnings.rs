//! Warnings of a running rig: failing cameras and disappointing results.

use super::{Inbox, Received, RigEvent, Running, SinkThread};
use crate::{source::OwnedFrame, stream::ALL_SINKS_FAILED};
use planish_core::{FrameError, IntoFrame, Smoothed};

/// Minimum time in seconds between the ends of two cameras' frames that causes a warning.
const TOLD_EARLIER_S: f64 = 0.5;

/// Maximum number of reported reasons why a camera's frames are refused; further ones are only counted.
const MOST_REFUSALS_TOLD: usize = 5;

impl Running<'_> {
    /// Returns true and emits a warning if all sinks have failed.
    pub(super) fn sinks_are_gone(&self, tell: &mut impl FnMut(RigEvent<'_>)) -> bool {
        let are_gone = SinkThread::all_failed(&self.sinks);
        if are_gone {
            tell(RigEvent::Warning(ALL_SINKS_FAILED.to_owned()));
        }
        are_gone
    }

    pub(super) fn refuse(&mut self, camera: usize, error: &FrameError, tell: &mut impl FnMut(RigEvent<'_>)) {
        self.refused[camera] += 1;
        let why = error.to_string();
        let told = &mut self.told_refusals[camera];
        // Each reason is reported once.
        if told.len() < MOST_REFUSALS_TOLD && !told.contains(&why) {
            tell(RigEvent::Warning(format!("camera {}: {why}", self.rig.cameras[camera].name)));
            told.push(why);
        }
    }

    /// Warns once per camera if a frame lost more than 1 % of its points.
    pub(super) fn tell_lost_points(
        &mut self,
        camera: usize,
        frame: &OwnedFrame,
        smoothed: &Smoothed,
        tell: &mut impl FnMut(RigEvent<'_>),
    ) {
        let Some(frame) = frame.into_frame().ok().filter(|_| !self.told_lost_points[camera]) else { return };
        if let Some(warning) = smoothed.lost_points_warning(frame) {
            self.told_lost_points[camera] = true;
            tell(RigEvent::Warning(format!("camera {}: {warning}", self.rig.cameras[camera].name)));
        }
    }

    /// Warns about cameras whose frames never matched another camera's.
    pub(super) fn tell_alone(&self, inbox: &Inbox, tell: &mut impl FnMut(RigEvent<'_>)) {
        let gave = self.smoothed.iter().filter(|smoothed| **smoothed > 0).count();
        if gave < 2 || inbox.has_told_unmatched() {
            return;
        }
        let all = self.rig.cameras.iter().zip(self.smoothed.iter().zip(&self.together));
        for (camera, _) in all.filter(|(_, (smoothed, together))| **smoothed > 1 && **together == 0) {
            tell(RigEvent::Warning(format!(
                "camera {}: none of its frames matched another camera's, since timestamps differ by more than the \
                 tolerance; set time_offset_s or tolerance_ms, or \"clock\": \"arrival\" for a live camera",
                camera.name
            )));
        }
    }

    /// Warns about recordings that ended before others.
    pub(super) fn tell_short(&self, inbox: &Inbox, tell: &mut impl FnMut(RigEvent<'_>)) {
        if self.is_live {
            return;
        }
        let (counts, _) = inbox.counts();
        let Some(latest_s) = counts.iter().filter_map(|(_, received)| received.last_s).reduce(f64::max) else { return };
        let has_ended = |received: &Received| received.has_ended && !received.has_failed;
        for (camera, (_, received)) in self.rig.cameras.iter().zip(&counts).filter(|(_, (_, of))| has_ended(of)) {
            let earlier_s = received.last_s.map_or(0.0, |last_s| latest_s - last_s);
            if earlier_s > TOLD_EARLIER_S {
                let name = &camera.name;
                tell(RigEvent::Warning(format!(
                    "camera {name}: its frames end {earlier_s:.1} s before another camera's"
                )));
            }
        }
    }
}
