//! What a running rig says: of cameras that go wrong, and of results that are not what was hoped for.

use super::{Inbox, Received, RigEvent, RigStream, SinkThread};
use crate::error::FrameError;
use crate::frame::IntoFrame;
use crate::smoothed::Smoothed;
use crate::source::SourceFrame;

/// A camera whose frames end this much before another's is said to, in seconds.
const TOLD_EARLIER_S: f64 = 0.5;

/// So many frames of a camera that cannot be smoothed are reported one by one; more are only counted.
const MOST_REFUSALS_TOLD: u64 = 5;

impl RigStream<'_> {
    /// Whether there were sinks, and all have failed: nobody would get the results.
    pub(super) fn sinks_are_gone(&self, tell: &mut impl FnMut(RigEvent<'_>)) -> bool {
        let are_gone = !self.sinks.is_empty() && self.sinks.iter().all(SinkThread::has_failed);
        if are_gone {
            tell(RigEvent::Warning("every sink has failed: the stream ends".to_owned()));
        }
        are_gone
    }

    pub(super) fn refuse(&mut self, camera: usize, error: &FrameError, tell: &mut impl FnMut(RigEvent<'_>)) {
        self.refused[camera] += 1;
        let why = error.to_string();
        // Once where every frame has the same.
        if self.last_refusals[camera].as_ref() != Some(&why) && self.refused[camera] <= MOST_REFUSALS_TOLD {
            tell(RigEvent::Warning(format!("camera {}: {why}", self.rig.cameras[camera].name)));
            self.last_refusals[camera] = Some(why);
        }
    }

    /// Warns once for each camera if a frame lost more than a hundredth of its points.
    pub(super) fn tell_lost_points(
        &mut self,
        camera: usize,
        frame: &SourceFrame,
        smoothed: &Smoothed,
        tell: &mut impl FnMut(RigEvent<'_>),
    ) {
        let Some(frame) = frame.into_frame().ok().filter(|_| !self.told_lost_points[camera]) else { return };
        if let Some(warning) = smoothed.lost_points_warning(frame) {
            self.told_lost_points[camera] = true;
            tell(RigEvent::Warning(format!("camera {}: {warning}", self.rig.cameras[camera].name)));
        }
    }

    /// Says which cameras gave frames that never came together with another's.
    pub(super) fn tell_alone(&self, inbox: &Inbox, tell: &mut impl FnMut(RigEvent<'_>)) {
        let gave = self.smoothed.iter().filter(|smoothed| **smoothed > 0).count();
        if gave < 2 || inbox.has_told_unmatched() {
            return;
        }
        let all = self.rig.cameras.iter().zip(self.smoothed.iter().zip(&self.together));
        for (camera, _) in all.filter(|(_, (smoothed, together))| **smoothed > 1 && **together == 0) {
            tell(RigEvent::Warning(format!(
                "camera {}: none of its frames came together with another camera's: its time stamps are not within the tolerance of theirs \
                 (time_offset_s, tolerance_ms; of a live camera \"clock\": \"arrival\")",
                camera.name
            )));
        }
    }

    /// Says which recordings ended before others.
    pub(super) fn tell_short(&self, inbox: &Inbox, tell: &mut impl FnMut(RigEvent<'_>)) {
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
