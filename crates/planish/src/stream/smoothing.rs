//! What smooths a stream's frames: a smoother, or a fleet.

use std::sync::Arc;

use crate::engines::{Engine, SmootherOptions};
use crate::error::Error;
use crate::fleet::{Fleet, FleetDevice};
use crate::params::SmoothParams;
use crate::smoothed::Smoothed;
use crate::smoother::Smoother;
use crate::source::SourceFrame;
use crate::view::SmoothedView;

pub(super) enum Smoothing {
    One(Box<Smoother>),
    /// With the number of its devices whose loss was told.
    Fleet(Fleet, usize),
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
            devices => Self::Fleet(Fleet::open(params, options, devices, shape)?, 0),
        })
    }

    pub(super) fn engine(&self) -> Engine {
        match self {
            Self::One(smoother) => smoother.engine(),
            Self::Fleet(fleet, _) => fleet.engine(),
        }
    }

    /// How many frames in flight are worth their latency.
    pub(super) fn max_in_flight(&self) -> usize {
        match self {
            Self::One(smoother) if smoother.capabilities().pipelined => smoother.max_in_flight(),
            // Other engines return the result at once.
            Self::One(_) => 1,
            Self::Fleet(fleet, _) => fleet.max_in_flight(),
        }
    }

    pub(super) fn submit(&mut self, frame: &Arc<SourceFrame>) -> Result<(), Error> {
        match self {
            Self::One(smoother) => smoother.submit(&**frame, Smoothed::default()),
            Self::Fleet(fleet, _) => fleet.submit(Arc::clone(frame), Smoothed::default()),
        }
    }

    pub(super) fn receive(&mut self) -> Result<Option<SmoothedView>, Error> {
        match self {
            Self::One(smoother) => smoother.receive(),
            Self::Fleet(fleet, _) => fleet.receive(),
        }
    }

    /// What is to be said of devices that were lost since this was called last, while others go on.
    pub(super) fn losses(&mut self) -> Vec<String> {
        let Self::Fleet(fleet, told) = self else { return Vec::new() };
        let members = fleet.members();
        let lost: Vec<String> = members.iter().filter_map(|member| Some(member.lost.as_ref()?.to_string())).collect();
        if lost.len() == *told {
            return Vec::new();
        }
        *told = lost.len();
        let left = members.len() - lost.len();
        let go_on = |lost: String| match left {
            1 => format!("{lost}; one device goes on"),
            _ => format!("{lost}; {left} devices go on"),
        };
        if left == 0 { Vec::new() } else { lost.into_iter().next_back().map(go_on).into_iter().collect() }
    }
}
