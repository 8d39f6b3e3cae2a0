//! Compares sessions that smooth over time, estimate standard errors or fill holes with one that does not, all else
//! equal.

use std::sync::Arc;
use std::time::Instant;

use anyhow::Result;
use planish::{Error, SensorPose, Session, Settings, Smoothed, SmootherOptions, Transfer};

use super::report::OverTimeRow;
use super::{Bench, Take, WARM_UP};

/// Number of frames in flight.
const SLOTS: usize = 6;

/// The compared configurations.
#[derive(Clone, Copy, PartialEq)]
enum Way {
    Off,
    Steady,
    /// Smoothing over time, with the poses of a moving camera.
    Poses,
    /// No smoothing over time, with standard errors.
    Sigma,
    /// No smoothing over time, with standard errors and filled holes.
    Filled,
}

impl Way {
    const ALL: [Self; 5] = [Self::Off, Self::Steady, Self::Poses, Self::Sigma, Self::Filled];

    fn name(self) -> &'static str {
        match self {
            Self::Off => "off",
            Self::Steady => "steady",
            Self::Poses => "steady, with poses",
            Self::Sigma => "off, with sigma",
            Self::Filled => "off, with sigma and fill = 8",
        }
    }
}

impl Bench<'_> {
    /// Measures kernel times and frames per second at the default setting, for each configuration.
    pub(super) fn over_time(&self) -> Result<Vec<OverTimeRow>> {
        let mut rows = Vec::new();
        for transfer in [Transfer::Staged, Transfer::Direct] {
            for way in Way::ALL {
                let mut session = self.session(way, Take::PointsInPlace, |options| {
                    options.gpu.transfer = transfer;
                    options.gpu.timestamps = true;
                })?;
                let mut number = 0;
                let kernel_us = self.spread(|| {
                    self.submit(&mut session, way, None, &mut number)?;
                    let timings = session.receive()?.and_then(|view| view.timings());
                    Ok(timings.map_or(f64::NAN, |timings| 1e6 * timings.kernel.as_secs_f64()))
                })?;
                let rate = |take| self.rate(way, take, transfer);
                rows.push(OverTimeRow {
                    way: way.name(),
                    transfer: format!("{transfer:?}").to_lowercase(),
                    kernel_us,
                    points_in_place: rate(Take::PointsInPlace)?,
                    points_copied: rate(Take::PointsCopied)?,
                    depth_in_place: rate(Take::DepthInPlace)?,
                });
            }
        }
        Ok(rows)
    }

    fn session(&self, way: Way, take: Take, change: impl FnOnce(&mut SmootherOptions)) -> Result<Session> {
        let mut settings: Settings = "engine=gpu sensor=kinect1".parse().map_err(Error::from)?;
        if matches!(way, Way::Steady | Way::Poses) {
            settings.set("temporal", "steady").map_err(Error::from)?;
        }
        if way == Way::Filled {
            settings.set("fill", "8").map_err(Error::from)?;
        }
        let wants_sigma = matches!(way, Way::Sigma | Way::Filled);
        settings.adapter = self.args.adapter.clone();
        let gpu = planish::GpuOptions::default().with_bounds_checks(false).with_slots(SLOTS);
        let mut options = SmootherOptions::default()
            .with_outputs(take.outputs().with_sigma(wants_sigma).with_status(way == Way::Filled))
            .with_gpu(gpu);
        change(&mut options);
        Ok(Session::new(settings)?.with_kept_window(true).with_options(options))
    }

    /// Submits the frame. With [`Way::Poses`], the camera pose differs from that of the previous frame.
    fn submit(&self, session: &mut Session, way: Way, buffer: Option<Smoothed>, number: &mut u32) -> Result<()> {
        *number += 1;
        if way == Way::Poses {
            let to_and_fro_m = 1e-3 * f64::from(*number % 2);
            session.set_camera_pose(Some(SensorPose::from_viewpoint([to_and_fro_m, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0])))?;
        }
        match buffer {
            Some(buffer) => session.submit(Arc::clone(&self.depth), buffer),
            None => session.submit_in_place(&*self.depth),
        }?;
        Ok(())
    }

    /// Returns frames per second with one frame in flight per slot.
    fn rate(&self, way: Way, take: Take, transfer: Transfer) -> Result<f64> {
        let mut session = self.session(way, take, |options| options.gpu.transfer = transfer)?;
        let (mut number, mut spare) = (0, Vec::new());
        let mut one = |session: &mut Session| -> Result<()> {
            if session.in_flight() == SLOTS
                && let Some(view) = session.receive()?
            {
                Take::touch(&view);
                if take == Take::PointsCopied {
                    spare.push(view.into_smoothed());
                }
            }
            let buffer = (take == Take::PointsCopied).then(|| spare.pop().unwrap_or_default());
            self.submit(session, way, buffer, &mut number)
        };
        let start = Instant::now();
        while start.elapsed() < WARM_UP {
            one(&mut session)?;
        }
        let timed = 20 * self.args.runs;
        let start = Instant::now();
        (0..timed).try_for_each(|_| one(&mut session))?;
        let frames_per_second = f64::from(timed) / start.elapsed().as_secs_f64();
        while session.receive()?.is_some() {}
        Ok(frames_per_second)
    }
}
