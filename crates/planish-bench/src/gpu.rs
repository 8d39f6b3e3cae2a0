//! `planish bench gpu`: measures kernels with device timestamps, and frames with the host's clock.

mod over_time;
mod report;

use std::hint::black_box;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use planish::agreement::{Agreement, radii_m};
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::{
    Camera, DepthFrame, Edges, Engine, Error, Fleet, FleetDevice, FrameParams, FrameRadius, IntoFrame, OrganizedCloud,
    Outputs, Smoothed, SmoothedView, Smoother, SmootherOptions, Transfer, WindowSize,
};

use super::timing::Spread;
use report::{BatchRow, FleetRow, KernelRow, LatencyRow, Report, ThroughputRow, print_text};

const KINECT_SHAPE: (usize, usize) = (640, 480);
/// Duration of the warm-up before the first measurement. An idle GPU needs this long to reach its full clock.
const WARM_UP: Duration = Duration::from_millis(300);

/// The result that is read, and how it is read.
#[derive(Clone, Copy, PartialEq)]
enum Take {
    PointsInPlace,
    PointsCopied,
    DepthInPlace,
}

impl Take {
    const ALL: [Self; 3] = [Self::PointsInPlace, Self::PointsCopied, Self::DepthInPlace];

    fn name(self) -> &'static str {
        match self {
            Self::PointsInPlace => "depth to points, read in place",
            Self::PointsCopied => "depth to points, copied out",
            Self::DepthInPlace => "depth to depth, read in place",
        }
    }

    fn outputs(self) -> Outputs {
        if self == Self::DepthInPlace { Outputs::DEPTH } else { Outputs::POINTS }
    }

    /// Reads a value of the result, so that the time includes making the result available.
    fn touch(view: &SmoothedView) {
        black_box(view.points().map(|[x, ..]| x[x.len() / 2]));
        black_box(view.depth_rows().and_then(|mut rows| rows.nth(rows.len() / 2)));
    }
}

/// Returns the settings for which whole frames are timed, each combined with both kinds of transfer.
fn timed_settings() -> impl Iterator<Item = ((&'static str, FrameParams), Transfer)> {
    let settings = [("paper", FrameParams::paper()), ("default", FrameParams::default())];
    settings.into_iter().flat_map(|setting| [Transfer::Staged, Transfer::Direct].map(|transfer| (setting, transfer)))
}

/// Options of the GPU engine's benchmark.
#[derive(Debug, Clone)]
pub struct GpuOptions {
    /// A named frame of a 640x480 camera with a focal length of 525 pixels; by default, a simulated frame.
    pub input: Option<(String, OrganizedCloud)>,
    /// The GPU, by index or part of its name; by default the first real one.
    pub adapter: Option<String>,
    /// Devices that share frames. The first is measured alone, then all are measured together; empty to skip these
    /// figures.
    pub devices: Vec<FleetDevice>,
    /// True to measure only `devices`.
    pub only_devices: bool,
    /// Number of frames per figure.
    pub runs: u32,
    /// True to print the figures as one JSON object.
    pub json: bool,
}

struct Bench<'a> {
    args: &'a GpuOptions,
    depth: Arc<DepthFrame>,
    cloud: OrganizedCloud,
}

/// Measures the GPU engine and prints the figures.
///
/// # Errors
/// If the GPU is unavailable, or a result is wrong.
pub fn run(args: &GpuOptions) -> Result<()> {
    let (input, depth) = frame(args)?;
    // Without colours, which only the CPU uses to fill holes.
    let depth = DepthFrame::new(depth.camera, depth.raw).map_err(Error::from)?;
    let cloud = depth.deproject().map_err(Error::from)?;
    let bench = Bench { args, depth: Arc::new(depth), cloud };
    let paper = FrameParams::paper();
    let start = Instant::now();
    let mut smoother = bench.open(paper, |_| ())?;
    let open_ms = 1e3 * start.elapsed().as_secs_f64();
    let start = Instant::now();
    smoother.smooth(&*bench.depth, &mut Smoothed::default())?;
    let first_frame_ms = 1e3 * start.elapsed().as_secs_f64();

    let report = Report {
        adapter: smoother.gpu_name().unwrap_or_default().to_owned(),
        input,
        frames: args.runs,
        kernels: if args.only_devices { Vec::new() } else { bench.kernels()? },
        one_at_a_time: if args.only_devices { Vec::new() } else { bench.one_at_a_time()? },
        in_flight: if args.only_devices { Vec::new() } else { bench.in_flight()? },
        over_time: if args.only_devices { Vec::new() } else { bench.over_time()? },
        batches: if args.only_devices { Vec::new() } else { bench.batches()? },
        fleets: bench.fleets()?,
        open_ms,
        first_frame_ms,
    };
    if args.json {
        crate::outln!("{}", serde_json::to_string(&report)?);
    } else {
        print_text(&report);
    }
    Ok(())
}

/// Returns the name and the Kinect depth image of the given frame, or of a simulated frame if none is given.
fn frame(args: &GpuOptions) -> Result<(String, DepthFrame)> {
    let camera = Camera::kinect_v1();
    let Some((name, cloud)) = &args.input else {
        let (scene, pose) = Scene::room(1);
        let truth = scene.render(&camera, &pose);
        let frame = DepthSimulator::new(DepthNoise::default(), camera, 1).frame(&truth, 0).map_err(Error::from)?;
        return Ok(("a simulated room".to_owned(), frame));
    };
    let (width, height) = (cloud.width(), cloud.height());
    if (width, height) != KINECT_SHAPE {
        bail!("{name}: the frame is {width}x{height}, but the benchmark needs 640x480");
    }
    let raw = cloud.positions().z().iter().map(|&z| camera.raw_depth(z)).collect();
    Ok((name.clone(), DepthFrame::new(camera, raw).map_err(Error::from)?))
}

impl Bench<'_> {
    fn open(&self, params: FrameParams, change: impl FnOnce(&mut SmootherOptions)) -> Result<Smoother> {
        let gpu = planish::GpuOptions::default().with_adapter(self.args.adapter.clone()).with_bounds_checks(false);
        let mut options = SmootherOptions::default().with_engine(Engine::Gpu).with_gpu(gpu);
        change(&mut options);
        Ok(Smoother::open_with(params, &options, KINECT_SHAPE)?)
    }

    /// Compares a setting's results with the reference's.
    fn check(&self, params: FrameParams, reference: &Smoothed, bounds_checks: bool) -> Result<()> {
        let frames = [self.depth.into_frame().map_err(Error::from)?, (&self.cloud).into_frame().map_err(Error::from)?];
        for transfer in [Transfer::Staged, Transfer::Direct] {
            let mut smoother = self.open(params, |options| {
                options.outputs = Outputs::ALL.with_depth(true);
                options.gpu.bounds_checks = bounds_checks;
                options.gpu.transfer = transfer;
            })?;
            // The first two results come from single calls, the others from a batch.
            let mut results = vec![Smoothed::default(); 4];
            for (frame, result) in frames.into_iter().zip(&mut results) {
                smoother.smooth(frame, result)?;
            }
            smoother.smooth_batch(&frames, &mut results[2..])?;
            let radii_m = radii_m(&self.cloud, params);
            for result in &results {
                let mut agreement = Agreement::with_params(params);
                agreement.add(result, reference, |i| radii_m[i]);
                let misses = agreement.misses();
                if !misses.is_empty() {
                    bail!("the result is wrong, so it is not timed: {params:?}: {}", misses.join("; "));
                }
                let (found, expected) = (result.depth.iter().flatten(), reference.depth.iter().flatten());
                let far = found.zip(expected).filter(|(a, b)| a.abs_diff(**b) > 1).count();
                // A few depths may differ: those of pixels whose status differs from the reference's.
                if far > self.depth.raw.len() / 10_000 {
                    bail!(
                        "the result is wrong, so it is not timed: {params:?}: {far} depths differ by more than one unit"
                    );
                }
            }
        }
        Ok(())
    }

    /// Calls `one` repeatedly after a warm-up. Returns the spread of the measurements, one from each call.
    fn spread(&self, mut one: impl FnMut() -> Result<f64>) -> Result<Spread> {
        let start = Instant::now();
        while start.elapsed() < WARM_UP {
            one()?;
        }
        Ok(Spread::of((0..self.args.runs).map(|_| one()).collect::<Result<_>>()?))
    }

    fn kernels(&self) -> Result<Vec<KernelRow>> {
        let fixed = FrameRadius::Fixed { radius_m: 0.03 };
        let off = |window, stride, degree, radius| {
            FrameParams::paper().with_window(window).with_stride(stride).with_radius(radius).with_degree(degree)
        };
        let settings = [
            off(3, 1, 3, fixed),
            off(3, 3, 2, FrameRadius::Sensor),
            off(5, 1, 3, fixed),
            off(7, 1, 3, fixed),
            off(1, 1, 2, fixed),
            off(3, 1, 1, fixed),
            FrameParams::default().with_edges(Edges::Off),
            FrameParams::default(),
        ];
        let row = |params: FrameParams| {
            let mut reference = Smoothed::default();
            let outputs = Outputs::ALL.with_depth(true);
            let options = SmootherOptions::default().with_engine(Engine::Reference).with_outputs(outputs);
            Smoother::open_with(params, &options, KINECT_SHAPE)?.smooth(&*self.depth, &mut reference)?;
            let time = |bounds_checks| {
                self.check(params, &reference, bounds_checks)?;
                let mut smoother = self.open(params, |options| {
                    options.gpu.transfer = Transfer::Staged;
                    options.gpu.timestamps = true;
                    options.gpu.bounds_checks = bounds_checks;
                })?;
                let mut one = || -> Result<f64> {
                    smoother.submit_in_place(&*self.depth)?;
                    let timings = smoother.receive()?.and_then(|view| view.timings());
                    Ok(timings.map_or(f64::NAN, |timings| 1e6 * timings.kernel.as_secs_f64()))
                };
                self.spread(&mut one)
            };
            let WindowSize { half_width: window, stride, .. } = params.window.nominal();
            let (degree, keeps_edges) = (params.fit.degree, params.fit.edges != Edges::Off);
            let (kernel_us, checked_kernel_us) = (time(false)?, time(true)?);
            Ok(KernelRow { window, stride, degree, keeps_edges, kernel_us, checked_kernel_us })
        };
        settings.into_iter().map(row).collect()
    }

    /// Times single frames, from depth to the result, both in host memory.
    fn one_at_a_time(&self) -> Result<Vec<LatencyRow>> {
        let mut rows = Vec::new();
        for ((setting, params), transfer) in timed_settings() {
            for take in Take::ALL {
                let mut smoother = self.open(params, |options| {
                    options.outputs = take.outputs();
                    options.gpu.transfer = transfer;
                })?;
                let mut smoothed = Smoothed::default();
                let mut one = || -> Result<f64> {
                    let start = Instant::now();
                    if take == Take::PointsCopied {
                        smoother.smooth(&*self.depth, &mut smoothed)?;
                    } else {
                        smoother.submit_in_place(&*self.depth)?;
                        smoother.receive()?.iter().for_each(Take::touch);
                    }
                    Ok(1e6 * start.elapsed().as_secs_f64())
                };
                rows.push(LatencyRow {
                    setting,
                    what: take.name(),
                    transfer: format!("{transfer:?}").to_lowercase(),
                    microseconds: self.spread(&mut one)?,
                });
            }
        }
        Ok(rows)
    }

    /// Measures frames per second with one frame in flight per slot.
    fn in_flight(&self) -> Result<Vec<ThroughputRow>> {
        let mut rows = Vec::new();
        for ((setting, params), transfer) in timed_settings() {
            for take in Take::ALL {
                for slots in [2, 3, 4, 6] {
                    let mut smoother = self.open(params, |options| {
                        options.outputs = take.outputs();
                        options.gpu.transfer = transfer;
                        options.gpu.slots = slots;
                    })?;
                    let mut spare = Vec::new();
                    let mut one = |smoother: &mut Smoother| -> Result<()> {
                        if smoother.in_flight() == slots
                            && let Some(view) = smoother.receive()?
                        {
                            Take::touch(&view);
                            if take == Take::PointsCopied {
                                spare.push(view.into_smoothed());
                            }
                        }
                        match take {
                            Take::PointsCopied => smoother.submit(&*self.depth, spare.pop().unwrap_or_default())?,
                            _ => smoother.submit_in_place(&*self.depth)?,
                        }
                        Ok(())
                    };
                    let start = Instant::now();
                    while start.elapsed() < WARM_UP {
                        one(&mut smoother)?;
                    }
                    let timed = 5 * self.args.runs;
                    let start = Instant::now();
                    (0..timed).try_for_each(|_| one(&mut smoother))?;
                    let frames_per_second = f64::from(timed) / start.elapsed().as_secs_f64();
                    while smoother.receive()?.is_some() {}
                    rows.push(ThroughputRow {
                        setting,
                        what: take.name(),
                        transfer: format!("{transfer:?}").to_lowercase(),
                        slots,
                        frames_per_second,
                    });
                }
            }
        }
        Ok(rows)
    }

    /// Measures the frames per second of the first device alone and of all devices together, both as a fleet.
    fn fleets(&self) -> Result<Vec<FleetRow>> {
        let mut rows = Vec::new();
        let frame = Arc::clone(&self.depth);
        let counts = [1, self.args.devices.len()];
        let counts = &counts[..self.args.devices.len().min(2)];
        for (setting, params) in [("paper", FrameParams::paper()), ("default", FrameParams::default())] {
            for take in [Take::PointsInPlace, Take::PointsCopied] {
                let mut first = f64::NAN;
                for &count in counts {
                    let gpu = planish::GpuOptions::default().with_bounds_checks(false);
                    let options = SmootherOptions::default().with_outputs(take.outputs()).with_gpu(gpu);
                    let mut fleet = Fleet::open(params, &options, &self.args.devices[..count], KINECT_SHAPE)?;
                    let mut spare = Vec::new();
                    let mut one = |fleet: &mut Fleet| -> Result<()> {
                        if fleet.in_flight() == fleet.max_in_flight()
                            && let Some(view) = fleet.receive()?
                        {
                            Take::touch(&view);
                            if take == Take::PointsCopied {
                                spare.push(view.into_smoothed());
                            }
                        }
                        match take {
                            Take::PointsCopied => fleet.submit(Arc::clone(&frame), spare.pop().unwrap_or_default())?,
                            _ => fleet.submit_in_place(Arc::clone(&frame))?,
                        }
                        Ok(())
                    };
                    let start = Instant::now();
                    while start.elapsed() < WARM_UP {
                        one(&mut fleet)?;
                    }
                    let before: Vec<u64> = fleet.members().iter().map(|member| member.frames).collect();
                    let timed = 20 * self.args.runs;
                    let start = Instant::now();
                    (0..timed).try_for_each(|_| one(&mut fleet))?;
                    let frames_per_second = f64::from(timed) / start.elapsed().as_secs_f64();
                    let members = fleet.members();
                    let shares = members.iter().zip(before).map(|(member, before)| member.frames - before);
                    if count == 1 {
                        first = frames_per_second;
                    }
                    rows.push(FleetRow {
                        setting,
                        what: take.name(),
                        devices: count,
                        frames_per_second,
                        times: frames_per_second / first,
                        shares: shares.collect(),
                    });
                }
            }
        }
        Ok(rows)
    }

    fn batches(&self) -> Result<Vec<BatchRow>> {
        let [paper, default] = [("paper", FrameParams::paper()), ("default", FrameParams::default())];
        Ok([self.batches_of(paper)?, self.batches_of(default)?].concat())
    }

    fn batches_of(&self, (setting, params): (&'static str, FrameParams)) -> Result<Vec<BatchRow>> {
        let mut smoother = self.open(params, |options| {
            options.gpu.transfer = Transfer::Staged;
            options.gpu.timestamps = true;
        })?;
        let row = |count: usize| {
            let frames = vec![self.depth.into_frame().map_err(Error::from)?; count];
            let mut out = vec![Smoothed::default(); count];
            let mut one = || -> Result<f64> {
                smoother.smooth_batch(&frames, &mut out)?;
                Ok(smoother.timings().map_or(f64::NAN, |timings| 1e6 * timings.kernel.as_secs_f64()))
            };
            let kernel_us = self.spread(&mut one)?.median;
            Ok(BatchRow { setting, frames: count, kernel_us, kernel_us_a_frame: kernel_us / count as f64 })
        };
        [1, 2, 6, 16, 64].into_iter().map(row).collect()
    }
}
