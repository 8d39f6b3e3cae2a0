//! What smooths a stream's frames: a smoother, or a fleet.

use std::sync::Arc;

use crate::source::OwnedFrame;
use planish_core::{
    Engine, Error, Fleet, FleetDevice, SmoothParams, Smoothed, SmoothedView, Smoother, SmootherOptions,
};

/// Frames of a live source in flight on a device, at most: more would wait for those before, and the newest would come late.
pub(crate) const LIVE_IN_FLIGHT: usize = 3;

pub(super) enum Smoothing {
    One(Box<Smoother>),
    Fleet {
        fleet: Fleet,
        /// Its devices, and those of them whose loss was told.
        devices: Vec<FleetDevice>,
        told: Vec<FleetDevice>,
        slots: usize,
    },
}

impl Smoothing {
    /// A fleet, where devices are named.
    pub(super) fn open(
        params: SmoothParams,
        options: &SmootherOptions,
        devices: &[FleetDevice],
        shape: (usize, usize),
    ) -> Result<Self, Error> {
        Ok(match devices {
            [] => Self::One(Box::new(Smoother::open_with(params, options, shape)?)),
            devices => Self::Fleet {
                fleet: Fleet::open(params, options, devices, shape)?,
                devices: devices.to_vec(),
                told: Vec::new(),
                slots: options.gpu.slots,
            },
        })
    }

    pub(super) fn engine(&self) -> Engine {
        match self {
            Self::One(smoother) => smoother.engine(),
            Self::Fleet { fleet, .. } => fleet.engine(),
        }
    }

    /// How many frames in flight are worth their latency; of a live source no more than are computed at once.
    pub(super) fn max_in_flight(&self, is_live: bool) -> usize {
        match self {
            Self::One(smoother) if smoother.capabilities().pipelined && is_live => {
                smoother.max_in_flight().min(LIVE_IN_FLIGHT)
            }
            Self::One(smoother) if smoother.capabilities().pipelined => smoother.max_in_flight(),
            // Other engines return the result at once.
            Self::One(_) => 1,
            Self::Fleet { fleet, slots, .. } if is_live => {
                let members = fleet.members();
                let working = members.iter().filter(|member| member.lost.is_none());
                let slots = (*slots).min(LIVE_IN_FLIGHT);
                let at_once = working.map(|member| if member.engine.capabilities().pipelined { slots } else { 1 });
                at_once.sum::<usize>().max(1)
            }
            Self::Fleet { fleet, .. } => fleet.max_in_flight(),
        }
    }

    pub(super) fn submit(&mut self, frame: &Arc<OwnedFrame>) -> Result<(), Error> {
        match self {
            Self::One(smoother) => smoother.submit(&**frame, Smoothed::default()),
            Self::Fleet { fleet, .. } => fleet.submit(Arc::clone(frame), Smoothed::default()),
        }
    }

    pub(super) fn receive(&mut self) -> Result<Option<SmoothedView>, Error> {
        match self {
            Self::One(smoother) => smoother.receive(),
            Self::Fleet { fleet, .. } => fleet.receive(),
        }
    }

    /// Devices that were lost since this was called last, while others go on, and what is to be said of each.
    pub(super) fn losses(&mut self) -> Vec<(FleetDevice, String)> {
        let Self::Fleet { fleet, devices, told, .. } = self else { return Vec::new() };
        let members = fleet.members();
        let left = members.iter().filter(|member| member.lost.is_none()).count();
        if left == 0 {
            return Vec::new();
        }
        let mut losses = Vec::new();
        for (device, member) in devices.iter().zip(members) {
            let Some(lost) = member.lost.filter(|_| !told.contains(device)) else { continue };
            let go_on = if left == 1 { "one device goes on".to_owned() } else { format!("{left} devices go on") };
            told.push(device.clone());
            losses.push((device.clone(), format!("{lost}; {go_on}")));
        }
        losses
    }
}
