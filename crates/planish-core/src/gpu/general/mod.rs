//! Smooths unorganized clouds on the GPU (docs/method.md, section 8). The points are sorted along a curve on the
//! device, boxes are built over them, and each position is fitted by a thread that walks through the boxes within its
//! reach. Nothing is read back before the results.
//!
//! [`passes`] lists the kernels in execution order, [`buffers`] their data. Passes over all positions are submitted in
//! parts, to stay below the GPU watchdog timeout and to report progress.
//!
//! Clouds that exceed the device's capacity are smoothed in overlapping parts ([`in_parts`]).

mod buffers;
mod in_parts;
mod parts;
mod passes;
mod results;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytemuck::bytes_of;

use super::device::{GpuDevice, OpenAdapter, Purpose};
use super::layout::{Batch, InputKind, Layout};
use super::upload::Uploader;
use crate::devices::{GpuOptions, choose};
use crate::error::{EngineError, Error};
use crate::frame::{Frame, PointsView};
use crate::neighbours::middle;
use crate::outputs::{Outputs, SmoothedMut};
use crate::params::{Edges, EngineParams};
use crate::progress::Progress;
use crate::range::MAX_RANGE_M;
use crate::smoothing_engine::{AdmittedFrame, ImmediateEngine};
use crate::threads::on_a_thread_each;
use crate::timings::FrameTimings;
use buffers::{Buffers, CloudUniform, Levels, MOST_PARTS, SAMPLES, STATE_BYTES};
use passes::{Compiled, DIGITS, Pass, TILE};
use results::GeneralResults;

/// Minimum number of positions fitted per submission: the number of threads of the largest devices.
const PART_PLACES: usize = 1 << 18;
/// Maximum number of workgroups along the first axis of a dispatch; every device allows more.
const MOST_GROUPS_ACROSS: usize = 1 << 15;
/// Minimum half extent in metres. Smaller half extents are raised to it, so that the inverse stays within f32.
const LEAST_EXTENT_M: f64 = 1e-18;

/// The points of a run that need results. They precede all other points.
#[derive(Debug, Clone, Copy)]
struct Own {
    points: usize,
    /// Number of progress steps reported for the run.
    steps: usize,
    /// Upper limit of the radius by density, in metres, for all points of the run.
    largest_radius_m: f32,
}

/// The GPU engine for unorganized clouds, with its buffers.
pub(crate) struct GeneralGpu {
    gpu: Arc<GpuDevice>,
    /// Keeps the adapter open, so that other smoothers can share it.
    _adapter: Arc<OpenAdapter>,
    params: EngineParams,
    outputs: Outputs,
    options: GpuOptions,
    kernels: Vec<Compiled>,
    uploader: Uploader,
    buffers: Option<Buffers>,
    /// Maximum number of points on the device at once.
    most_points: usize,
    /// True if radii by density are read back for [`ImmediateEngine::own_radius_m`].
    keeps_radii: bool,
    /// Radii by density of the last cloud, in metres.
    radii: Vec<f32>,
    progress: Arc<Progress>,
    timings: Option<FrameTimings>,
    bytes: Arc<AtomicU64>,
}

impl GeneralGpu {
    /// Opens the engine on the adapter that the options select.
    pub(crate) fn open(params: EngineParams, outputs: Outputs, options: &GpuOptions) -> Result<Self, EngineError> {
        let adapter = OpenAdapter::open(choose(&super::adapters(), options.adapter.as_deref())?, Purpose::OneAtATime)?;
        let gpu = Arc::clone(&adapter.devices[0]);
        gpu.check_timestamps(options)?;
        // Kernels are compiled in parallel, because drivers compile on the calling thread.
        let compile = |pass| Compiled::new(&gpu, pass, &params, outputs, options.bounds_checks);
        let failed = || Err(gpu.failed("a kernel could not be compiled"));
        let compiled = on_a_thread_each(Pass::ALL, compile).into_iter();
        let kernels = compiled.map(|result| result.unwrap_or_else(|_| failed())).collect::<Result<_, _>>()?;
        let uploader = Uploader::new(params);
        let options = options.clone();
        let (radii, progress, bytes) = Default::default();
        let mut engine = Self {
            gpu,
            _adapter: adapter,
            params,
            outputs,
            options,
            kernels,
            uploader,
            buffers: None,
            most_points: 0,
            keeps_radii: false,
            radii,
            progress,
            timings: None,
            bytes,
        };
        let most_points = buffers::most_points(&engine.gpu, engine.output_words(), params.edges != Edges::Off);
        engine.most_points = engine.options.points_at_once.unwrap_or(usize::MAX).min(most_points).max(1);
        Ok(engine)
    }

    fn is_by_density(&self) -> bool {
        self.params.radius.density().is_some()
    }

    /// Returns the layout of the points' results. Words with status and neighbours follow the other channels.
    fn layout(&self, points: usize) -> Layout {
        let outputs = Outputs { status: false, neighbours: false, ..self.outputs };
        let kind = InputKind::Points;
        Layout { width: points, height: 1, kind, outputs, keeps_points: false, keeps_planes: false, cell: 1 }
    }

    /// Returns the number of words in the result of a point.
    fn output_words(&self) -> usize {
        self.layout(1).output_words() + usize::from(self.outputs.status || self.outputs.neighbours)
    }

    /// Returns buffers for `points` points; allocates new ones if the existing ones are too small.
    fn take_buffers(&mut self, points: usize) -> Result<Buffers, EngineError> {
        if let Some(buffers) = self.buffers.take().filter(|buffers| buffers.capacity >= points) {
            return Ok(buffers);
        }
        let (words, timestamps) = (self.output_words(), self.options.timestamps);
        let keeps_edges = self.params.edges != Edges::Off;
        Buffers::new(&self.gpu, &self.kernels, points, words, keeps_edges, timestamps, &self.bytes)
    }

    fn uniform(&self, view: &PointsView<'_>, levels: &Levels, own: Own) -> CloudUniform {
        let middle = middle_of(view);
        let extent_m = view.extent_m().unwrap_or_else(|| extent_m(&middle));
        let half = middle.iter().map(|[low, high]| high - low).fold(0.0, f64::max) / 2.0;
        let half_count = self.params.radius.density().map_or(0.0, |count| count as f32 / 2.0);
        CloudUniform {
            points: view.len() as u32,
            tiles: view.len().div_ceil(TILE) as u32,
            top: levels.top as u32,
            top_nodes: levels.top_nodes as u32,
            middle: middle.map(|[low, high]| ((low + high) / 2.0) as f32),
            per_half_extent: (1.0 / half.max(LEAST_EXTENT_M)) as f32,
            half_count,
            largest_radius: (extent_m as f32 / 2.0).min(MAX_RANGE_M).min(own.largest_radius_m),
            least_neighbours: self.params.least_neighbours(view),
            part_places: part_places(view.len()) as u32,
            levels: levels.firsts,
            own_points: own.points as u32,
            padding: [0; 3],
        }
    }

    /// Uploads a cloud, runs all passes, and waits for the results. The readback buffer then contains, in this order:
    /// the results of the points, the state, and the radii by density if requested.
    fn run(
        &mut self,
        buffers: &Buffers,
        frame: &AdmittedFrame<'_>,
        view: &PointsView<'_>,
        wants_radii: bool,
        own: Own,
    ) -> Result<(), EngineError> {
        let (points, layout, levels) = (view.len(), self.layout(view.len()), Levels::of(view.len()));
        let uniform = self.uniform(view, &levels, own);
        {
            let Self { gpu, uploader, .. } = self;
            let mut range = buffers.upload.get_mapped_range_mut(..).map_err(|error| gpu.failed(error))?;
            uploader.write_general(&layout, frame, SAMPLES, &mut |word: usize, bytes: &[u8]| {
                range.slice(4 * word..4 * word + bytes.len()).copy_from_slice(bytes);
            });
        }
        let output_bytes = (4 * self.output_words() * points) as u64;
        let batch = Batch { width: points as u32, height: 1, input_words: 0, output_words: 0 };
        let gpu = &self.gpu;
        gpu.queue.write_buffer(&buffers.batch, 0, bytes_of(&batch));
        gpu.queue.write_buffer(&buffers.cloud, 0, bytes_of(&uniform));
        buffers.upload.unmap();

        let stamp = |encoder: &mut wgpu::CommandEncoder, index| {
            if let Some(stamps) = &buffers.stamps {
                stamps.write(encoder, index);
            }
        };
        let encoder = || gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let mut commands = encoder();
        stamp(&mut commands, 0);
        let input_bytes = (4 * (SAMPLES + 3 * points)) as u64;
        commands.copy_buffer_to_buffer(&buffers.upload, 0, &buffers.input, 0, input_bytes);
        commands.clear_buffer(&buffers.state, 0, None);
        stamp(&mut commands, 1);
        let mut submissions = vec![gpu.submit(commands.finish())];
        for steps in index_steps(points, &levels) {
            submissions.push(self.submit_steps(buffers, &steps, encoder()));
        }
        let part = part_places(points);
        let parts = points.div_ceil(part);
        let (by_density, keeps_edges) = (self.is_by_density(), self.params.edges != Edges::Off);
        for (pass, wanted) in [(Pass::Radii, by_density), (Pass::FirstPlanes, keeps_edges), (Pass::Fit, true)] {
            for number in (0..parts).filter(|_| wanted) {
                let places = part.min(points - number * part);
                submissions.push(self.submit_steps(buffers, &[(pass, number, places)], encoder()));
            }
        }
        submissions.push(self.submit_steps(buffers, &[(Pass::Repeat, 0, points)], encoder()));
        let mut commands = encoder();
        stamp(&mut commands, 2);
        commands.copy_buffer_to_buffer(&buffers.output, 0, &buffers.readback, 0, output_bytes);
        commands.copy_buffer_to_buffer(&buffers.state, 0, &buffers.readback, output_bytes, STATE_BYTES);
        stamp(&mut commands, 3);
        if let Some(stamps) = &buffers.stamps {
            stamps.resolve(&mut commands);
        }
        submissions.push(gpu.submit(commands.finish()));
        if wants_radii {
            submissions.push(self.submit_steps(buffers, &[(Pass::PointRadii, 0, points)], encoder()));
            let mut commands = encoder();
            let to = output_bytes + STATE_BYTES;
            commands.copy_buffer_to_buffer(&buffers.output, 0, &buffers.readback, to, 4 * points as u64);
            submissions.push(gpu.submit(commands.finish()));
        }
        let stamps = buffers.stamps.as_ref().map(|stamps| (&stamps.readback, wgpu::MapMode::Read));
        let asked = [(&buffers.upload, wgpu::MapMode::Write), (&buffers.readback, wgpu::MapMode::Read)];
        buffers.mapped.ask_for(asked.into_iter().chain(stamps));
        let count = submissions.len();
        for (number, submission) in submissions.into_iter().enumerate() {
            // Work already submitted still runs; its results are discarded.
            self.progress.check()?;
            gpu.wait(submission)?;
            self.progress.add(own.steps * (number + 1) / count - own.steps * number / count);
        }
        buffers.mapped.wait(gpu)?;
        if let Some(timings) = buffers.stamps.as_ref().and_then(|stamps| stamps.timings()) {
            *self.timings.get_or_insert_default() += timings;
        }
        Ok(())
    }

    /// Submits parts of passes. wgpu runs them in order because they share buffers.
    fn submit_steps(
        &self,
        buffers: &Buffers,
        steps: &[Step],
        mut commands: wgpu::CommandEncoder,
    ) -> wgpu::SubmissionIndex {
        {
            let mut compute = commands.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            for &(pass, part, count) in steps {
                let groups = pass.groups(count);
                let across = groups.min(MOST_GROUPS_ACROSS);
                compute.set_pipeline(&self.kernels[pass as usize].pipeline);
                compute.set_bind_group(0, buffers.bind_group(pass, part), &[]);
                compute.dispatch_workgroups(across as u32, groups.div_ceil(across) as u32, 1);
            }
        }
        self.gpu.submit(commands.finish())
    }

    /// Smooths a cloud that fits on the device.
    fn smooth_at_once(
        &mut self,
        frame: &AdmittedFrame<'_>,
        view: &PointsView<'_>,
        out: SmoothedMut<'_>,
    ) -> Result<(), EngineError> {
        let buffers = self.take_buffers(view.len())?;
        let wants_radii = self.keeps_radii && self.is_by_density();
        // After an error the buffers are dropped, since they may still be mapped.
        let own = Own { points: view.len(), steps: view.len(), largest_radius_m: f32::INFINITY };
        self.run(&buffers, frame, view, wants_radii, own)?;
        self.radii = self.with_results(&buffers, view.len(), |results| {
            results.copy_into(out);
            if wants_radii { results.radii.to_vec() } else { Vec::new() }
        })?;
        self.buffers = Some(buffers);
        Ok(())
    }

    /// Calls `use_results` with the results of a run in mapped memory, then unmaps the memory.
    fn with_results<T>(
        &self,
        buffers: &Buffers,
        points: usize,
        use_results: impl FnOnce(GeneralResults<'_>) -> T,
    ) -> Result<T, EngineError> {
        let bytes = buffers.readback.get_mapped_range(..).map_err(|error| self.gpu.failed(error))?;
        let state_at = 4 * self.output_words() * points;
        let radii_at = state_at + STATE_BYTES as usize;
        let [_, ended_early]: [u32; 2] = bytemuck::pod_read_unaligned(&bytes[state_at..radii_at]);
        if ended_early != 0 {
            return Err(self.gpu.failed(
                "its driver ended a loop early; try a smaller radius, fewer neighbours, edges off or the CPU engine",
            ));
        }
        let words = bytemuck::cast_slice(&bytes[..state_at]);
        let radii = bytemuck::cast_slice(&bytes[radii_at..radii_at + 4 * points]);
        let result = use_results(GeneralResults { layout: self.layout(points), words, radii });
        drop(bytes);
        buffers.readback.unmap();
        Ok(result)
    }
}

/// A pass, the number of its part, and the number of points, positions or nodes that it processes.
type Step = (Pass, usize, usize);

/// Returns the steps that sort the points and build the boxes, one list per submission. The first three submissions
/// sort by the lowest, the middle and the highest bits of the keys; the last finds positions and builds boxes.
fn index_steps(points: usize, levels: &Levels) -> [Vec<Step>; 4] {
    let sort = |digits: std::ops::Range<usize>| {
        digits.flat_map(|digit| {
            [
                (Pass::CountDigits, digit, points),
                (Pass::ScanCounts, DIGITS, points),
                (Pass::ScatterDigits, digit, points),
            ]
        })
    };
    let keys = |part| std::iter::once((Pass::Keys, part, points));
    let places = [(Pass::CountHeads, 0, points), (Pass::ScanCounts, 1, points), (Pass::PlaceHeads, 0, points)];
    let nodes = (1..=levels.top).map(|level| (Pass::Nodes, level, levels.nodes(level)));
    let boxes = std::iter::once((Pass::Leaves, 0, levels.nodes(0))).chain(nodes);
    [
        keys(0).chain(sort(0..8)).collect(),
        keys(1).chain(sort(0..8)).collect(),
        sort(8..16).collect(),
        places.into_iter().chain(boxes).collect(),
    ]
}

/// Returns the smallest and largest coordinate along each axis, without the outermost hundredth of the points at
/// either end.
fn middle_of(view: &PointsView<'_>) -> [[f64; 2]; 3] {
    [0, 1, 2].map(|axis| middle(view.len(), |i| f64::from(view.get(i)[axis] as f32)).unwrap_or_default())
}

/// Returns the diagonal in metres of a box that [`middle_of`] returned.
fn extent_m(middle: &[[f64; 2]; 3]) -> f64 {
    middle.iter().map(|[low, high]| (high - low).powi(2)).sum::<f64>().sqrt()
}

/// Returns the number of positions per submission.
fn part_places(points: usize) -> usize {
    points.div_ceil(MOST_PARTS).next_multiple_of(PART_PLACES)
}

impl ImmediateEngine for GeneralGpu {
    fn smooth(&mut self, frame: &AdmittedFrame<'_>, mut out: SmoothedMut<'_>) -> Result<(), Error> {
        let Frame::Points(view) = frame.frame else { return Ok(()) };
        self.gpu.check()?;
        self.timings = None;
        self.radii.clear();
        self.progress.reset();
        if view.is_empty() {
            return Ok(());
        }
        loop {
            self.progress.begin(view.len());
            let result = if view.len() <= self.most_points {
                self.smooth_at_once(frame, &view, out.reborrow()).map_err(Error::from)
            } else {
                self.smooth_in_parts(frame, &view, out.reborrow())
            };
            match result {
                // The device's limits allow more points than its memory holds: try again with half as many.
                Err(Error::Engine(EngineError::OutOfMemory { .. }))
                    if self.most_points.min(view.len()) > PART_PLACES =>
                {
                    self.most_points = self.most_points.min(view.len()) / 2;
                }
                result => return result,
            }
        }
    }

    fn timings(&self) -> Option<FrameTimings> {
        self.timings
    }

    fn keep_radii(&mut self) {
        self.keeps_radii = true;
    }

    fn own_radius_m(&self, i: usize) -> Option<f32> {
        self.radii.get(i).copied().filter(|radius_m| radius_m.is_finite())
    }

    fn buffer_bytes(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed)
    }

    fn progress(&self) -> Option<Arc<Progress>> {
        Some(Arc::clone(&self.progress))
    }

    fn device_name(&self) -> Option<&str> {
        Some(&self.gpu.name)
    }
}
