//! Smooths over time on the device (docs/method.md, section 16), in three passes after the passes of a frame, or in
//! four if the camera moves.
//!
//! The video's state stays in one device buffer and the spatial result in the slot; only the temporal result is read
//! back. Frames update the state in the order of submission, so all of them use one queue.

use bytemuck::{Pod, Zeroable, bytes_of};

use super::device::GpuDevice;
use super::layout::{Layout, channels, result_constants, write_constant, write_numbers, write_words};
use super::shader::shader;
use crate::error::EngineError;
use crate::outputs::Outputs;
use crate::smoothing_engine::{Video, VideoStep};
use crate::status::Status;
use crate::temporal::{CameraMotion, Domain, constants};

/// Number of words per pixel in the state.
const STATE_WORDS: usize = 3;
/// Number of words per pixel in the changes.
const CHANGE_WORDS: usize = 2;
/// Number of words per tile.
const TILE_WORDS: usize = 5;

/// A frame's uniform, as declared in `over_time/buffers.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, Pod, Zeroable)]
struct Step {
    width: u32,
    height: u32,
    input_words: u32,
    output_words: u32,
    state_at: u32,
    previous_at: u32,
    changes_at: u32,
    tiles_at: u32,
    starts: u32,
    knows_motion: u32,
    averages_inverse: u32,
    most_frames: f32,
    sigma: [f32; 3],
    fx: f32,
    rotation_x: [f32; 3],
    fy: f32,
    rotation_y: [f32; 3],
    cx: f32,
    rotation_z: [f32; 3],
    cy: f32,
    translation: [f32; 3],
    padding: f32,
}

const _: () = assert!(size_of::<Step>() == 128);

/// A pass over all pixels or tiles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Pass {
    MoveState,
    MeasureChanges,
    UpdateTiles,
    UpdatePixels,
}

impl Pass {
    const ALL: [Self; 4] = [Self::MoveState, Self::MeasureChanges, Self::UpdateTiles, Self::UpdatePixels];

    fn entry_point(self) -> &'static str {
        match self {
            Self::MoveState => "move_state",
            Self::MeasureChanges => "measure_changes",
            Self::UpdateTiles => "update_tiles",
            Self::UpdatePixels => "update_pixels",
        }
    }

    /// Returns the WGSL of the pass's kernel, for the given spatial and temporal outputs.
    fn wgsl(self, in_space: Outputs, over_time: Outputs) -> String {
        let mut text = temporal_constants(in_space);
        text += shader!("shaders/over_time/buffers.wgsl");
        text += shader!("shaders/words.wgsl");
        match self {
            Self::MoveState => text += shader!("shaders/over_time/move_state.wgsl"),
            Self::MeasureChanges => text += shader!("shaders/over_time/measure_changes.wgsl"),
            Self::UpdateTiles => text += shader!("shaders/over_time/update_tiles.wgsl"),
            Self::UpdatePixels => {
                text += &result_constants(over_time);
                let words = [
                    ("FRAMES_CHANNEL", channels(over_time).frames),
                    ("STATUS_CARRIED", Status::Carried as usize),
                    ("TILE_WIDTH", constants::TILE),
                    ("TILE_HEIGHT", constants::TILE),
                    ("ROW_STEP", 1),
                ];
                write_words(&mut text, &words);
                write_constant(&mut text, "WANTS_FRAMES", "bool", over_time.frames);
                text += shader!("shaders/pixel_result.wgsl");
                text += shader!("shaders/result_depth.wgsl");
                text += shader!("shaders/output.wgsl");
                text += shader!("shaders/over_time/update_pixels.wgsl");
            }
        }
        text
    }
}

/// Returns the WGSL constants of the temporal filter and of the channels of the spatial result.
fn temporal_constants(in_space: Outputs) -> String {
    let mut text = String::new();
    let channels = channels(in_space);
    let words = [
        ("TILE", constants::TILE),
        ("PAIR", constants::PAIR),
        ("LEAST_TILES", constants::LEAST_TILES),
        ("CARRIED", constants::CARRIED as usize),
        ("LOW", constants::LOW as usize),
        ("SPATIAL_Z", 2),
        ("SPATIAL_NORMALS", channels.normals),
        ("SPATIAL_CURVATURE", channels.curvature),
        ("SPATIAL_DEPTH_M", channels.depth_m),
        ("SPATIAL_CHANNELS", channels.count),
    ];
    write_words(&mut text, &words);
    let numbers = [
        // Marks a pixel without a change; finite, unlike NaN.
        ("NO_CHANGE", 4.0e18),
        ("MOST_DEPTH_M", constants::MOST_DEPTH_M),
        ("LEAST_NOISE", constants::LEAST_NOISE),
        ("CLIP", constants::CLIP),
        ("CLIP_OF_TILE", constants::CLIP_OF_TILE),
        ("CANDIDATE", constants::CANDIDATE),
        ("LEAST_DEVIATION", constants::LEAST_DEVIATION),
        ("AT_ONCE", constants::AT_ONCE),
        ("SUPPORT", constants::SUPPORT),
        ("FRAMES_TO_WAIT", constants::FRAMES_TO_WAIT),
        ("CHANGE", constants::CHANGE),
        ("BIAS", constants::BIAS),
        ("OWN_CHANGE", constants::OWN_CHANGE),
        ("LEAK", constants::LEAK),
        ("LEARN", constants::LEARN),
        ("LEARNT", constants::LEARNT),
        ("LEAST_VARIANCE", constants::LEAST_VARIANCE),
        ("MOST_VARIANCE", constants::MOST_VARIANCE),
        ("MEMORY", constants::MEMORY),
        ("FIRST_VARIANCE", constants::FIRST_VARIANCE),
        ("PER_UNIT", constants::PER_UNIT),
        ("PER_VARIANCE", constants::PER_VARIANCE),
        ("MOST_BIAS", constants::MOST_BIAS),
        ("FEW", constants::FEW),
        ("TILE_CHANGE", constants::TILE_CHANGE),
        ("TILE_BIAS", constants::TILE_BIAS),
        ("PERSISTENT", constants::PERSISTENT),
        ("PERSISTENT_NOISE", constants::PERSISTENT_NOISE),
        ("AGREEING", constants::AGREEING),
        ("AGREEING_NOISE", constants::AGREEING_NOISE),
        ("LEAST_CHANGE", constants::LEAST_CHANGE),
        ("FIRST_TILE_VARIANCE", constants::FIRST_TILE_VARIANCE),
        ("LEAST_TILE_VARIANCE", constants::LEAST_TILE_VARIANCE),
        ("SAME_SURFACE", constants::SAME_SURFACE),
        ("SLOPE", constants::SLOPE),
        ("LEAST_WEIGHT", constants::LEAST_WEIGHT),
        ("NEAREST_M", constants::NEAREST_M),
    ];
    write_numbers(&mut text, &numbers);
    text
}

/// The temporal filter of a video, on a device.
pub(super) struct OverTime {
    video: Video,
    shape: (usize, usize),
    memory: wgpu::Buffer,
    kernels: Vec<(Pass, wgpu::ComputePipeline, [usize; 2])>,
    /// Offset of the current state in `memory`, in words.
    state_at: usize,
    bytes: u64,
}

/// A slot's buffers for the temporal passes.
pub(super) struct SlotOverTime {
    step: wgpu::Buffer,
    /// The spatial result.
    pub(super) in_space: wgpu::Buffer,
    bind_group: wgpu::BindGroup,
}

impl OverTime {
    /// Compiles the passes and allocates the state, for frames whose spatial results have the given layout.
    pub(super) fn new(gpu: &GpuDevice, video: Video, layout: Layout, bounds_checks: bool) -> Result<Self, EngineError> {
        let shape = (layout.width, layout.height);
        let size = [layout.width.div_ceil(constants::TILE), layout.height.div_ceil(constants::TILE)];
        let passes = Pass::ALL.into_iter().filter(|pass| *pass != Pass::MoveState || video.moves);
        let kernels = passes
            .map(|pass| {
                let wgsl = pass.wgsl(layout.outputs, video.outputs);
                let kernel = gpu.compile(pass.entry_point(), wgsl, &gpu.pipeline_layout, bounds_checks)?;
                Ok((pass, kernel, if pass == Pass::UpdateTiles { [1, 1] } else { size }))
            })
            .collect::<Result<_, EngineError>>()?;
        let bytes = 4 * Self::words(&video, shape) as u64;
        let memory = gpu.allocate(bytes, || gpu.buffer("state over time", bytes, wgpu::BufferUsages::STORAGE))?;
        Ok(Self { video, shape, memory, kernels, state_at: 0, bytes })
    }

    /// Returns the total number of words of the state (two copies if the camera moves), the changes and the tiles.
    fn words(video: &Video, (width, height): (usize, usize)) -> usize {
        let tiles = width.div_ceil(constants::TILE) * height.div_ceil(constants::TILE);
        let states = if video.moves { 2 } else { 1 };
        (STATE_WORDS * states + CHANGE_WORDS) * width * height + TILE_WORDS * tiles
    }

    /// Returns the size in bytes of the largest buffer needed for frames whose spatial results have the given layout.
    pub(super) fn largest_buffer(video: &Video, layout: Layout) -> u64 {
        let results = Layout { outputs: video.outputs, ..layout };
        let words = Self::words(video, (layout.width, layout.height)).max(results.output_words());
        4 * words.max(layout.output_words()) as u64
    }

    /// Returns the size of the state's buffer in bytes.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Returns the layout of the temporal results, given that of the spatial results.
    pub(super) fn results(&self, in_space: Layout) -> Layout {
        Layout { outputs: self.video.outputs, ..in_space }
    }

    /// Creates a slot's buffers for the temporal passes. `bound` contains the slot's input and result.
    pub(super) fn slot(&self, gpu: &GpuDevice, layout: &Layout, bound: [&wgpu::Buffer; 2]) -> SlotOverTime {
        use wgpu::BufferUsages as Usage;
        let step = gpu.buffer("step", size_of::<Step>() as u64, Usage::UNIFORM | Usage::COPY_DST);
        let in_space = gpu.buffer("in space", 4 * layout.output_words() as u64, Usage::STORAGE);
        let [input, output] = bound;
        let bind_group = gpu.bind([&step, input, output, &in_space, &self.memory]);
        SlotOverTime { step, in_space, bind_group }
    }

    /// Writes the uniform of the next frame. Returns true if the state must first be moved into the frame's view.
    pub(super) fn begin(&mut self, gpu: &GpuDevice, slot: &SlotOverTime, layout: &Layout, next: &VideoStep) -> bool {
        let pixels = self.shape.0 * self.shape.1;
        let transform = next.motion.as_ref().and_then(|motion| motion.previous_from_current.transform().ok());
        let moved = transform.filter(|transform| self.video.moves && !next.starts && !transform.is_identity());
        let previous_at = self.state_at;
        if moved.is_some() {
            self.state_at = STATE_WORDS * pixels - self.state_at;
        }
        let states = if self.video.moves { 2 } else { 1 };
        let changes_at = STATE_WORDS * states * pixels;
        let mut step = Step {
            width: self.shape.0 as u32,
            height: self.shape.1 as u32,
            input_words: layout.input_words() as u32,
            output_words: self.results(*layout).output_words() as u32,
            state_at: self.state_at as u32,
            previous_at: previous_at as u32,
            changes_at: changes_at as u32,
            tiles_at: (changes_at + CHANGE_WORDS * pixels) as u32,
            starts: u32::from(next.starts),
            knows_motion: u32::from(next.motion.is_some()),
            averages_inverse: u32::from(Domain::of(&self.video.sensor) == Domain::InverseDepth),
            most_frames: self.video.params.frames,
            sigma: self.video.sensor.sigma,
            ..Step::default()
        };
        if let (Some(transform), Some(CameraMotion { camera, .. })) = (moved, &next.motion) {
            let rotation = transform.rotation.as_mat3();
            [step.rotation_x, step.rotation_y, step.rotation_z] = rotation.to_cols_array_2d();
            step.translation = transform.translation.as_vec3().to_array();
            [step.fx, step.fy, step.cx, step.cy] =
                [camera.fx, camera.fy, camera.cx, camera.cy].map(|value| value as f32);
        }
        gpu.queue.write_buffer(&slot.step, 0, bytes_of(&step));
        moved.is_some()
    }

    /// Encodes the passes, including the one that moves the state if `moves` is set.
    pub(super) fn encode(&self, pass: &mut wgpu::ComputePass<'_>, slot: &SlotOverTime, moves: bool) {
        pass.set_bind_group(0, &slot.bind_group, &[]);
        for (which, kernel, [across, down]) in &self.kernels {
            if *which == Pass::MoveState && !moves {
                continue;
            }
            pass.set_pipeline(kernel);
            pass.dispatch_workgroups(*across as u32, *down as u32, 1);
        }
    }
}
