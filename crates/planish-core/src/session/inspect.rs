//! Access to the state of a session for callers.

use super::Session;
use super::event::{CloudChoice, SessionEvent};
use super::open::Open;
use super::watch::ProgressWatch;
use crate::cpu::CloudEstimate;
use crate::engines::{ChoiceReason, Engine};
use crate::error::Error;
use crate::fleet::FleetDevice;
use crate::frame::{IntoFrame, Lattice, RangeRule};
use crate::params::Params;
use crate::sensor::SensorModel;
use crate::timings::FrameTimings;

impl Session {
    /// Returns the events since the last call in order, and removes them.
    pub fn take_events(&mut self) -> Vec<SessionEvent> {
        if let Some(open) = &mut self.open {
            self.events.extend(open.losses(&mut self.devices));
        }
        std::mem::take(&mut self.events)
    }

    /// Returns the last estimated sensor; `None` if the session has not estimated any.
    pub fn estimated_sensor(&self) -> Option<SensorModel> {
        self.estimated
    }

    /// Returns the parameters for a frame, and the sensor whose noise model the steps before smoothing use. The sensor
    /// is `None` if no such step is set.
    ///
    /// # Errors
    /// Same as [`Settings::resolve`](crate::Settings::resolve).
    pub fn params_for<'a>(&mut self, frame: impl IntoFrame<'a>) -> Result<(Params, Option<SensorModel>), Error> {
        let frame = frame.into_frame()?;
        let (events, is_prepared, choice) = (self.events.len(), self.is_prepared, self.cloud_choice);
        let resolved = self.on_its_grid(frame, Self::resolve);
        // Events about the cloud are dropped, since it is not smoothed yet.
        let of_cloud = |event: &SessionEvent| {
            matches!(
                event,
                SessionEvent::SensorRecognized { .. }
                    | SessionEvent::NeighboursChosen(_)
                    | SessionEvent::GridRebuilt { .. }
            )
        };
        let later = self.events.split_off(events);
        self.events.extend(later.into_iter().filter(|event| !of_cloud(event)));
        (self.is_prepared, self.cloud_choice) = (is_prepared, choice);
        resolved
    }

    /// Returns the last estimate for an unorganized cloud, with its noise and number of neighbours.
    pub fn cloud_estimate(&self) -> Option<CloudEstimate> {
        self.cloud_estimate
    }

    /// Returns the parameters that were chosen for the last unorganized cloud; `None` if the settings give them, a
    /// sensor was recognized, or the last frame was of another kind.
    pub fn cloud_choice(&self) -> Option<CloudChoice> {
        self.cloud_choice
    }

    /// Returns the width and height of the grid that was rebuilt for the last cloud; `None` if the cloud stayed
    /// unorganized, or if a frame on a grid followed.
    pub fn rebuilt_grid(&self) -> Option<(usize, usize)> {
        self.lattice.as_ref().map(Lattice::shape)
    }

    /// Returns the devices that share the frames, excluding failed devices.
    pub fn devices(&self) -> &[FleetDevice] {
        &self.devices
    }

    /// Returns the rule by which ranges were measured in the last frame, with the pitch of its pixels
    /// (docs/method.md, section 11); `None` before the first frame.
    pub fn range_rule(&self) -> Option<RangeRule> {
        self.rule
    }

    /// Returns the open engine; `None` before the first frame.
    pub fn engine(&self) -> Option<Engine> {
        self.open.as_ref().map(Open::engine)
    }

    /// Returns the name of the open GPU; `None` for other engines and for a fleet.
    pub fn gpu_name(&self) -> Option<&str> {
        self.open.as_ref()?.one()?.gpu_name()
    }

    /// Returns why `Auto` chose its engine; `None` if the settings name the engine.
    pub fn chosen_because(&self) -> Option<&ChoiceReason> {
        self.open.as_ref()?.one()?.chosen_because()
    }

    /// Returns the timings of the last frame, if timestamps were requested.
    pub fn timings(&self) -> Option<FrameTimings> {
        self.open.as_ref()?.one()?.timings()
    }

    /// Returns a handle through which other threads can observe the progress of the frame being smoothed.
    pub fn watch(&self) -> ProgressWatch {
        self.watch.clone()
    }
}

impl std::fmt::Debug for Session {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { chosen, options, devices, open, .. } = self;
        f.debug_struct("Session")
            .field("chosen", chosen)
            .field("options", options)
            .field("devices", devices)
            .field("open", open)
            .field("in_flight", &self.in_flight())
            .finish()
    }
}
