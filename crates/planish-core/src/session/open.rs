//! The open smoother or fleet of a session.

use std::sync::Arc;

use super::event::SessionEvent;
use super::pending::AnyFrame;
use crate::engines::{Engine, SmootherOptions};
use crate::error::Error;
use crate::fleet::{Fleet, FleetDevice};
use crate::params::EngineParams;
use crate::progress::Progress;
use crate::smoothed::Smoothed;
use crate::smoother::Smoother;
use crate::smoothing_engine::{DeviceSteps, Video};
use crate::threads::ONE_THREAD;
use crate::view::SmoothedView;

/// Maximum number of frames from a live source that are in flight on one device. With more frames, the newest would
/// be delayed by older ones.
pub const LIVE_IN_FLIGHT: usize = 3;

/// The kind of frame that an engine was opened for; other kinds need another engine.
#[derive(Debug)]
pub(super) struct OpenFor {
    pub(super) grid: Option<(usize, usize)>,
    pub(super) params: EngineParams,
    pub(super) options: SmootherOptions,
    pub(super) uses_fleet: bool,
    /// The video that the engine should smooth over time if it can.
    pub(super) video: Option<Video>,
    /// The steps after smoothing that the engine should compute if it can.
    pub(super) steps: Option<DeviceSteps>,
}

#[derive(Debug)]
pub(super) struct Open {
    open_for: OpenFor,
    smoothing: Smoothing,
    /// Whether the engine smooths over time.
    is_over_time: bool,
    /// Whether the engine computes the steps after smoothing.
    takes_steps: bool,
}

#[derive(Debug)]
enum Smoothing {
    One(Box<Smoother>),
    Fleet {
        fleet: Box<Fleet>,
        /// The devices of the fleet.
        devices: Vec<FleetDevice>,
        /// The lost devices that were already reported.
        reported: Vec<FleetDevice>,
    },
}

impl Open {
    /// Opens a fleet if devices are given, otherwise a smoother.
    pub(super) fn new(open_for: OpenFor, devices: &[FleetDevice]) -> Result<Self, Error> {
        let OpenFor { grid, params, options, video, steps, .. } = &open_for;
        let (mut is_over_time, mut takes_steps) = (false, false);
        let smoothing = if ONE_THREAD || devices.is_empty() {
            let mut smoother = Box::new(Smoother::open_decided(*params, options, *grid)?);
            if let Some(video) = video {
                is_over_time = smoother.smooth_over_time(video)?;
            }
            if let Some(steps) = steps {
                takes_steps = smoother.take_steps(steps)?;
            }
            Smoothing::One(smoother)
        } else {
            let fleet = Box::new(Fleet::open_decided(*params, options, devices, *grid, steps.as_ref())?);
            takes_steps = fleet.takes_steps();
            Smoothing::Fleet { fleet, devices: devices.to_vec(), reported: Vec::new() }
        };
        Ok(Self { open_for, smoothing, is_over_time, takes_steps })
    }

    /// Returns true if the engine need not be opened again for these frames.
    pub(super) fn fits(&self, wanted: &OpenFor) -> bool {
        let OpenFor { grid, params, options, uses_fleet, video, steps } = &self.open_for;
        // Steps that the engine does not support do not matter.
        let ignores_steps = !self.takes_steps && steps.is_some() && wanted.steps.is_some();
        *grid == wanted.grid
            && *params == wanted.params
            && *options == wanted.options
            && *uses_fleet == wanted.uses_fleet
            && *video == wanted.video
            && (*steps == wanted.steps || ignores_steps)
    }

    pub(super) fn open_for(&self) -> &OpenFor {
        &self.open_for
    }

    pub(super) fn is_over_time(&self) -> bool {
        self.is_over_time
    }

    /// Returns the steps after smoothing that the engine computes; `None` if the session must compute them.
    pub(super) fn steps(&self) -> Option<DeviceSteps> {
        self.open_for.steps.filter(|_| self.takes_steps)
    }

    pub(super) fn one(&self) -> Option<&Smoother> {
        match &self.smoothing {
            Smoothing::One(smoother) => Some(smoother),
            Smoothing::Fleet { .. } => None,
        }
    }

    pub(super) fn smoother(&mut self) -> Option<&mut Smoother> {
        match &mut self.smoothing {
            Smoothing::One(smoother) => Some(smoother),
            Smoothing::Fleet { .. } => None,
        }
    }

    pub(super) fn progress(&self) -> Option<Arc<Progress>> {
        self.one()?.progress()
    }

    pub(super) fn engine(&self) -> Engine {
        match &self.smoothing {
            Smoothing::One(smoother) => smoother.engine(),
            Smoothing::Fleet { fleet, .. } => fleet.engine(),
        }
    }

    /// Returns the maximum number of frames in flight; more frames would only add latency. For a live source, the
    /// maximum does not exceed the number of frames computed at once.
    pub(super) fn max_in_flight(&self, is_live: bool) -> usize {
        match &self.smoothing {
            Smoothing::One(smoother) if smoother.capabilities().pipelined && is_live => {
                smoother.max_in_flight().min(LIVE_IN_FLIGHT)
            }
            Smoothing::One(smoother) if smoother.capabilities().pipelined => smoother.max_in_flight(),
            // Other engines return the result at once.
            Smoothing::One(_) => 1,
            Smoothing::Fleet { fleet, .. } if is_live => {
                let members = fleet.members();
                let working = members.iter().filter(|member| member.lost.is_none());
                let slots = self.open_for.options.gpu.slots.min(LIVE_IN_FLIGHT);
                let at_once = working.map(|member| if member.engine.capabilities().pipelined { slots } else { 1 });
                at_once.sum::<usize>().max(1)
            }
            Smoothing::Fleet { fleet, .. } => fleet.max_in_flight(),
        }
    }

    /// Submits a frame to a fleet.
    pub(super) fn submit_shared(&mut self, frame: &AnyFrame, buffer: Option<Smoothed>) -> Result<(), Error> {
        match &mut self.smoothing {
            Smoothing::One(_) => Ok(()),
            Smoothing::Fleet { fleet, .. } => fleet.deal(Arc::clone(frame), buffer),
        }
    }

    pub(super) fn is_fleet(&self) -> bool {
        matches!(self.smoothing, Smoothing::Fleet { .. })
    }

    pub(super) fn receive(&mut self) -> Result<Option<SmoothedView>, Error> {
        match &mut self.smoothing {
            Smoothing::One(smoother) => smoother.receive(),
            Smoothing::Fleet { fleet, .. } => fleet.receive(),
        }
    }

    /// Returns an event for each device lost since the last call, and removes these devices from `left_over`; returns
    /// no events if all devices are lost.
    pub(super) fn losses(&mut self, left_over: &mut Vec<FleetDevice>) -> Vec<SessionEvent> {
        let Smoothing::Fleet { fleet, devices, reported } = &mut self.smoothing else { return Vec::new() };
        let members = fleet.members();
        let left = members.iter().filter(|member| member.lost.is_none()).count();
        if left == 0 {
            return Vec::new();
        }
        let mut losses = Vec::new();
        for (device, member) in devices.iter().zip(members) {
            let Some(error) = member.lost.filter(|_| !reported.contains(device)) else { continue };
            reported.push(device.clone());
            left_over.retain(|other| other != device);
            losses.push(SessionEvent::DeviceLost { device: device.clone(), error, left });
        }
        losses
    }
}

/// Returns the process ID. In WebAssembly, where the standard library's function panics, returns a constant.
pub(super) fn process_id() -> u32 {
    if cfg!(target_family = "wasm") { 0 } else { std::process::id() }
}
