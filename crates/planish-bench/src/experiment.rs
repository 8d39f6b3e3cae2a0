//! The parts that all experiments share: frames, comparison with the reference, and timing.

use std::cell::RefCell;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use indicatif::{ProgressBar, ProgressStyle};
use planish::agreement::{Agreement, radii_m};
use planish::{
    Engine, EngineError, Error, FrameParams, FrameTimings, IntoFrame, OrganizedCloud, Smoothed, Smoother,
    SmootherOptions, Xyz,
};

use super::engines::{self, Clock, Load, Subject, Way};
use super::frames::Input;
use super::timing::Timing;
use crate::Options;

/// Input and transfer of a measurement.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Frames {
    /// One frame; a GPU's result is read in place.
    One,
    /// One frame; the result is copied to host memory, also from a GPU.
    OneCopiedOut,
    /// This many copies of the frame, as points, stacked vertically into one.
    Tall(usize),
    /// This many frames per call; results are copied out.
    Batch(usize),
}

/// Duration of a measurement.
#[derive(Clone, Copy)]
pub enum Patience {
    /// For single figures: at least 100 frames and 3 s, but at most 20 s unless three frames take longer.
    Long,
    /// For one of many figures: at least 20 frames and 1 s, but at most 3 s.
    Short,
}

/// A measurement, and the memory used during it.
pub struct Timed {
    pub time: Timing,
    /// Times of the engine's stages in each measurement, if the engine reports them.
    pub stages: Vec<FrameTimings>,
    pub buffer_bytes: u64,
    /// Resident memory of the process in MiB, if the system reports it.
    pub process_mib: Option<f64>,
}

/// Context of the experiments.
pub struct Bench<'a> {
    pub options: &'a Options,
    pub inputs: Vec<Input>,
    /// Set by Ctrl-C to end the experiment; finished measurements are kept.
    pub stop: &'a AtomicBool,
    /// The reference's last result, with the index of its frame and its parameters.
    reference: RefCell<Option<(usize, FrameParams, Smoothed)>>,
    /// Skipped measurements and the reasons.
    skipped: RefCell<Vec<String>>,
}

/// The error of a measurement that Ctrl-C interrupted.
#[derive(Debug, thiserror::Error)]
#[error("interrupted")]
struct Interrupted;

impl<'a> Bench<'a> {
    pub fn new(options: &'a Options, inputs: Vec<Input>, stop: &'a AtomicBool) -> Self {
        let (reference, skipped) = (RefCell::default(), RefCell::default());
        Self { options, inputs, stop, reference, skipped }
    }

    pub fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Creates a progress bar; hidden if standard error is not a terminal.
    pub fn bar(&self, name: &'static str, steps: usize) -> Result<ProgressBar> {
        let style = ProgressStyle::with_template("{msg} {bar:30} {pos} of {len}, {eta} left")?;
        Ok(ProgressBar::new(steps as u64).with_style(style).with_message(name))
    }

    /// Returns the engines to measure. With `all_levels`, the CPU engine is included at every SIMD level, with one
    /// thread and with all threads.
    pub fn subjects(&self, all_levels: bool) -> Result<Vec<Subject>> {
        engines::subjects(&self.options.engines, all_levels)
    }

    /// Returns the engines to measure except the reference, which is a thousand times slower.
    pub fn fast_subjects(&self) -> Result<Vec<Subject>> {
        let mut subjects = self.subjects(false)?;
        subjects.retain(|subject| subject.options.engine != Engine::Reference);
        Ok(subjects)
    }

    /// Returns the measurement, or `None` if it was interrupted or skipped. It is skipped, and reported at the end,
    /// if the engine is unavailable or has no room for the frames. Any other failure, such as a wrong result, is an
    /// error.
    pub fn attempt<T>(&self, what: &str, measured: Result<T>) -> Result<Option<T>> {
        let error = match measured {
            Ok(measured) => return Ok(Some(measured)),
            Err(error) => error,
        };
        if error.is::<Interrupted>() {
            return Ok(None);
        }
        match error.downcast_ref::<Error>() {
            Some(Error::Engine(engine))
                if engine.is_too_large() || matches!(engine, EngineError::Unavailable { .. }) =>
            {
                self.skipped.borrow_mut().push(format!("{what}: {error}"));
                Ok(None)
            }
            _ => Err(error),
        }
    }

    /// Returns the measurements skipped since the last call.
    pub fn take_skipped(&self) -> Vec<String> {
        self.skipped.take()
    }

    /// Calls `one` repeatedly after a warm-up; each call returns a measurement in milliseconds.
    pub fn measure(&self, patience: Patience, mut one: impl FnMut() -> Result<f64>) -> Result<Timing> {
        // An idle GPU needs a third of a second to reach its full clock.
        let (fewest, runs, least_ms, most_ms, warm_up_ms) = match patience {
            _ if self.options.quick => (1, 20, 0, 400, 100),
            Patience::Long => (3, 100, 3_000, 20_000, 300),
            Patience::Short => (1, 20, 1_000, 3_000, 300),
        };
        let [least, most, warm_up] = [least_ms, most_ms, warm_up_ms].map(Duration::from_millis);
        let (mut values, mut start) = (Vec::new(), Instant::now());
        values.push(one()?);
        // A run that takes longer than the warm-up needs no other warm-up.
        if start.elapsed() < warm_up {
            while start.elapsed() < warm_up && !self.stopped() {
                one()?;
            }
            values.clear();
            start = Instant::now();
        }
        loop {
            if self.stopped() {
                return Err(Interrupted.into());
            }
            let (elapsed, count) = (start.elapsed(), values.len());
            if (elapsed >= most && count >= fewest) || (elapsed >= least && count >= runs) {
                return Ok(Timing::of(values));
            }
            values.push(one()?);
        }
    }

    /// Measures the time per frame of consecutive frames that pass through an engine in the given way, over `block`
    /// frames per measurement.
    pub fn time_way(
        &self,
        subject: &Subject,
        params: FrameParams,
        input: &Input,
        way: Way,
        block: usize,
    ) -> Result<Timing> {
        let mut load = Load::open(subject, params, way, vec![input.frame()?])?;
        load.show(|points| self.hold(subject, params, input, points, 1))?;
        self.measure(Patience::Long, || {
            let start = Instant::now();
            for _ in 0..block {
                load.once()?;
            }
            Ok(ms(start.elapsed()) / block as f64)
        })
    }

    /// Times an engine on the given frames with the given clock, and stores the times of the engine's stages if it
    /// reports them.
    pub fn time_frames(
        &self,
        subject: &Subject,
        clock: Clock,
        params: FrameParams,
        input: &Input,
        frames: Frames,
    ) -> Result<Timed> {
        let tall;
        let (copies, way, frames) = match frames {
            // The CPU engines write directly into the given buffers.
            Frames::One if !subject.is_gpu() => (1, Way::CopiedOut, vec![input.frame()?]),
            Frames::One => (1, Way::InPlace, vec![input.frame()?]),
            Frames::OneCopiedOut => (1, Way::CopiedOut, vec![input.frame()?]),
            Frames::Tall(copies) => {
                tall = one_under_the_other(&input.cloud, copies)?;
                (
                    copies,
                    if subject.is_gpu() { Way::InPlace } else { Way::CopiedOut },
                    vec![(&tall).into_frame().map_err(Error::from)?],
                )
            }
            Frames::Batch(frames) => (1, Way::Batch, vec![input.frame()?; frames]),
        };
        let stamped = if clock == Clock::Device { subject.with_time_stamps() } else { subject.clone() };
        let mut load = Load::open(&stamped, params, way, frames)?;
        load.show(|points| self.hold(subject, params, input, points, copies))?;
        let mut stages = Vec::new();
        let time = self.measure(Patience::Short, || {
            let start = Instant::now();
            let told = load.once()?;
            let waited = ms(start.elapsed());
            stages.extend(told);
            match (clock, told) {
                (Clock::Host, _) => Ok(waited),
                (Clock::Device, Some(told)) => Ok(ms(told.kernel)),
                (Clock::Device, None) => bail!("{}: the device returned no timestamps", subject.name),
            }
        })?;
        // Drop the times of the warm-up.
        let stages = stages.split_off(stages.len().saturating_sub(time.runs));
        Ok(Timed { time, stages, buffer_bytes: load.buffer_bytes(), process_mib: resident_mib() })
    }

    /// Smooths a frame with an engine into `points`, and compares the result with the reference.
    pub fn smooth(&self, subject: &Subject, params: FrameParams, input: &Input, points: &mut Xyz) -> Result<()> {
        Load::open(subject, params, Way::CopiedOut, vec![input.frame()?])?.show(|found| {
            self.hold(subject, params, input, found, 1)?;
            *points = Xyz::from_arrays(found.map(<[f32]>::to_vec)).map_err(Error::from)?;
            Ok(())
        })
    }

    /// Compares points with the reference; a difference is an error. If `copies` frames are stacked, rows near a seam
    /// have neighbours in the adjacent copy and are skipped.
    fn hold(
        &self,
        subject: &Subject,
        params: FrameParams,
        input: &Input,
        points: [&[f32]; 3],
        copies: usize,
    ) -> Result<()> {
        let (width, height) = input.shape();
        let mut known = self.reference.borrow_mut();
        let expected = match known.take() {
            Some((of, with, expected)) if of == input.index && with == params => expected,
            _ => {
                let options = SmootherOptions::default().with_engine(Engine::Reference);
                let mut expected = Smoothed::default();
                Smoother::open_with(params, &options, input.shape())?.smooth(input.frame()?, &mut expected)?;
                expected
            }
        };
        let mut agreement = Agreement::with_params(params);
        let reach = params.window.nominal().reach_px();
        let radii_m = radii_m(&input.cloud, params);
        for copy in 0..copies {
            let of_copy = points.map(|plane| plane.get(copy * width * height..).unwrap_or_default());
            let first = if copy == 0 { 0 } else { reach.min(height) };
            let end = if copy + 1 == copies { height } else { height.saturating_sub(reach).max(first) };
            agreement.add_points(of_copy, &expected, first * width..end * width, |i| radii_m[i]);
        }
        *known = Some((input.index, params, expected));
        let misses = agreement.misses();
        if !misses.is_empty() {
            bail!(
                "the result is wrong, so it is not timed: {}, {}: {}",
                subject.name,
                input.describe(),
                misses.join("; ")
            );
        }
        Ok(())
    }
}

/// Returns `copies` copies of a cloud, stacked vertically into one.
fn one_under_the_other(cloud: &OrganizedCloud, copies: usize) -> Result<OrganizedCloud> {
    let positions = cloud.positions().as_slices().map(|axis| axis.repeat(copies));
    let positions = Xyz::from_arrays(positions).map_err(Error::from)?;
    let tall = OrganizedCloud::from_positions(cloud.width(), copies * cloud.height(), positions);
    Ok(tall.map_err(Error::from)?)
}

/// Returns the resident memory of the process in MiB; `None` if the system does not report it.
fn resident_mib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmRSS:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? / 1024.0)
}

pub fn ms(time: Duration) -> f64 {
    1e3 * time.as_secs_f64()
}

#[cfg(test)]
mod tests {
    use planish::Camera;

    use super::*;
    use crate::frames::simulated_by;

    fn quick() -> Options {
        Options { quick: true, ..Options::default() }
    }

    fn small_inputs() -> Vec<Input> {
        simulated_by(Camera::new((160, 120), [131.25; 2], [79.5, 59.5])).unwrap()
    }

    #[test]
    fn a_wrong_result_is_an_error_and_is_not_timed() {
        let (options, stop) = (quick(), AtomicBool::new(false));
        let bench = Bench::new(&options, small_inputs(), &stop);
        let (input, params) = (&bench.inputs[1], FrameParams::paper().with_window(1));
        let subject = engines::subjects(&[Engine::Cpu], false).unwrap().remove(0);
        let mut right = Smoothed::default();
        Smoother::open_with(params, &subject.options, input.shape())
            .unwrap()
            .smooth(input.frame().unwrap(), &mut right)
            .unwrap();
        let hold = |points: &Xyz, params, copies| bench.hold(&subject, params, input, points.as_slices(), copies);
        hold(&right.points, params, 1).unwrap();
        let mut wrong = right.points.clone();
        wrong.as_mut_slices()[1].iter_mut().for_each(|y| *y += 1e-4);
        let error = hold(&wrong, params, 1).unwrap_err().to_string();
        assert!(
            error.contains("the result is wrong, so it is not timed: cpu") && error.contains("simulated table"),
            "{error}"
        );
        // Each setting is compared with a reference of the same setting.
        assert!(hold(&right.points, params.with_window(2), 1).is_err());
        // Two copies, the second of them wrong away from the seam.
        let twice = |second: &Xyz| -> Xyz { right.points.iter().chain(second.iter()).collect() };
        hold(&twice(&right.points), params, 2).unwrap();
        assert!(hold(&twice(&wrong), params, 2).is_err());
        assert!(hold(&right.points, params, 2).is_err(), "the second copy is missing");
    }

    #[test]
    fn what_does_not_fit_is_left_out_and_said_and_ctrl_c_ends_quietly() {
        let (options, stop) = (quick(), AtomicBool::new(false));
        let bench = Bench::new(&options, small_inputs(), &stop);
        let limit = EngineError::Limit { device: "small".into(), what: "bytes in a buffer", allowed: 1, needed: 2 };
        let result = bench.attempt("32 copies", Err::<(), _>(Error::from(limit).into())).unwrap();
        assert!(result.is_none());
        let skipped = bench.take_skipped();
        assert!(
            skipped.len() == 1 && skipped[0].starts_with("32 copies: ") && skipped[0].contains("small"),
            "{skipped:?}"
        );
        assert!(bench.attempt("wrong", Err::<(), _>(anyhow::anyhow!("a wrong result"))).is_err());
        stop.store(true, Ordering::Relaxed);
        let measured = bench.measure(Patience::Short, || Ok(1.0));
        assert!(bench.attempt("cut short", measured).unwrap().is_none() && bench.take_skipped().is_empty());
    }
}
