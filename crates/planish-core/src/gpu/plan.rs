//! The GPU engine for WebGPU hosts other than wgpu: a browser, or another program's own device.
//!
//! A [`Plan`] describes the host's work for one frame: which kernels to compile and dispatch in which order, the sizes
//! of buffers and the data to write. It also reads the results. The host needs no knowledge of the method. Every kernel
//! has one bind group:
//!
//! | binding | buffer | bytes |
//! |---|---|---|
//! | 0 | uniform: [`Plan::uniform`] | 16 |
//! | 1 | storage, read only: [`Plan::upload`] | its length |
//! | 2 | storage: the result, given to [`Plan::read`] | [`Plan::output_bytes`] |
//! | 3, 4 | storage, for data passed between passes | [`Plan::kept_bytes`] |
//!
//! The passes are dispatched in order, in one compute pass, since WebGPU puts barriers between dispatches.

use super::kernel::{KernelKey, Pass};
use super::layout::{InputKind, Layout};
use super::results::Results;
use super::upload::Uploader;
use crate::engines::{Engine, SmootherOptions};
use crate::error::{EngineError, Error, FrameError};
use crate::frame::{Frame, FrameGeometry, GeometryScratch, IntoFrame};
use crate::outputs::Outputs;
use crate::params::{Edges, EngineParams, FrameParams};
use crate::smoothed::Smoothed;
use crate::smoother::{check_frame, check_options, needs_range};
use crate::smoothing_engine::AdmittedFrame;
use crate::threads::Threads;

/// The limits of a WebGPU device that plans depend on, named as in `GPUSupportedLimits`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct WebGpuLimits {
    /// `maxComputeWorkgroupStorageSize` in bytes. With the default of 16 KiB, some kernels read data from buffers
    /// instead of workgroup memory.
    pub workgroup_bytes: u64,
    /// The smaller of `maxStorageBufferBindingSize` and `maxBufferSize`, in bytes.
    pub buffer_bytes: u64,
    /// `maxComputeWorkgroupsPerDimension`.
    pub workgroups: u64,
}

impl Default for WebGpuLimits {
    /// Returns limits that every WebGPU device supports.
    fn default() -> Self {
        Self { workgroup_bytes: 16 << 10, buffer_bytes: 128 << 20, workgroups: 65_535 }
    }
}

impl WebGpuLimits {
    /// Creates the limits of a device.
    pub const fn new(workgroup_bytes: u64, buffer_bytes: u64, workgroups: u64) -> Self {
        Self { workgroup_bytes, buffer_bytes, workgroups }
    }
}

/// One kernel of a frame.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct PlannedPass {
    /// The name of the kernel's entry point.
    pub entry_point: &'static str,
    /// The kernel's source. Passes with equal sources can share a compiled kernel, even across plans.
    pub wgsl: String,
    /// Number of workgroups to dispatch, across and down.
    pub workgroups: [u32; 2],
}

/// Instructions for a WebGPU host to smooth frames with one grid and one kind of samples.
pub struct Plan {
    params: EngineParams,
    outputs: Outputs,
    layout: Layout,
    keys: Vec<KernelKey>,
    uploader: Uploader,
    scratch: GeometryScratch,
}

impl Plan {
    /// Plans how to smooth frames with the same grid, resolution and kind of samples as the given frame.
    ///
    /// # Errors
    /// If the parameters are invalid, or the frame is an unorganized cloud or exceeds the device's limits.
    pub fn new<'a>(
        params: FrameParams,
        outputs: Outputs,
        frame: impl IntoFrame<'a>,
        limits: &WebGpuLimits,
    ) -> Result<Self, Error> {
        let frame = frame.into_frame()?;
        // The kernels are compiled for one window, so its size is decided here.
        let params = params.at_resolution_of(frame);
        let Some((width, height)) = frame.grid() else {
            let reason = "WebGPU smooths only organized frames; use the CPU engine for unorganized clouds".to_owned();
            return Err(EngineError::Unavailable { engine: "webgpu", reason }.into());
        };
        check_options(params.into(), &SmootherOptions::new(Engine::Gpu, outputs), Some((width, height)))?;
        let params = EngineParams::from(params);
        let kind = InputKind::of(&frame);
        let keeps_planes = params.edges != Edges::Off;
        let keeps_points = keeps_planes || params.averages_blocks();
        let layout = Layout { width, height, kind, outputs, keeps_points, keeps_planes, cell: params.cell_px() };
        let workgroup_bytes = usize::try_from(limits.workgroup_bytes).unwrap_or(usize::MAX);
        let key = |&pass| KernelKey::new(&params, pass, kind, outputs, true, workgroup_bytes);
        let keys: Vec<KernelKey> = Pass::of(&params).iter().map(key).collect();
        let (uploader, scratch) = (Uploader::new(params), GeometryScratch::default());
        let plan = Self { params, outputs, layout, keys, uploader, scratch };
        plan.check(limits)?;
        Ok(plan)
    }

    fn check(&self, limits: &WebGpuLimits) -> Result<(), EngineError> {
        let [points, planes] = self.kept_bytes();
        let bytes = self.output_bytes().max(4 * self.layout.input_words()).max(points).max(planes);
        let workgroups = self.passes().iter().flat_map(|pass| pass.workgroups).max().unwrap_or(0);
        let needs = [
            ("bytes in a buffer", limits.buffer_bytes, bytes as u64),
            ("workgroups across or down", limits.workgroups, u64::from(workgroups)),
        ];
        match needs.into_iter().find(|(_, allowed, needed)| needed > allowed) {
            None => Ok(()),
            Some((what, allowed, needed)) => {
                Err(EngineError::Limit { device: "of WebGPU".to_owned(), what, allowed, needed })
            }
        }
    }

    /// Returns the plan's kernels in the order of dispatch.
    pub fn passes(&self) -> Vec<PlannedPass> {
        let shape = (self.layout.width, self.layout.height);
        let pass = |key: &KernelKey| PlannedPass {
            entry_point: key.pass.entry_point(),
            wgsl: key.wgsl(),
            workgroups: key.workgroups(shape).map(|groups| groups as u32),
        };
        self.keys.iter().map(pass).collect()
    }

    /// Returns the words of the uniform.
    pub fn uniform(&self) -> [u32; 4] {
        bytemuck::cast(self.layout.batch())
    }

    /// Returns the size of the result in bytes.
    pub fn output_bytes(&self) -> usize {
        4 * self.layout.output_words()
    }

    /// Returns the number of bytes of an upload before its samples. These bytes depend only on the camera.
    #[cfg(feature = "cuda")]
    pub(super) fn head_bytes(&self) -> usize {
        4 * self.layout.rays().end
    }

    /// Returns the sizes, in bytes, of the two buffers for data passed between passes.
    pub fn kept_bytes(&self) -> [usize; 2] {
        // Every kernel binds both buffers, whether it uses them or not, so neither may be empty.
        self.layout.kept_words().map(|words| 4 * words.max(4))
    }

    /// Returns the bytes to upload for a frame.
    ///
    /// # Errors
    /// If the frame's grid or kind of samples differs from that of the planned frames.
    pub fn upload<'a>(&mut self, frame: impl IntoFrame<'a>) -> Result<Vec<u8>, Error> {
        let frame = self.expected(frame.into_frame()?)?;
        let grid = Some((self.layout.width, self.layout.height));
        check_frame(frame, self.outputs, grid)?;
        let geometry = FrameGeometry::of(frame, needs_range(&self.params), &mut self.scratch);
        let admitted = AdmittedFrame::new(frame, geometry);
        let mut bytes = vec![0u8; 4 * self.layout.input_words()];
        self.uploader.write(&self.layout, &admitted, &mut |word, from| {
            bytes[4 * word..4 * word + from.len()].copy_from_slice(from);
        });
        Ok(bytes)
    }

    fn expected<'a>(&self, frame: Frame<'a>) -> Result<Frame<'a>, Error> {
        if InputKind::of(&frame) == self.layout.kind {
            return Ok(frame);
        }
        let reason =
            "the plan is for another kind of frame (depth, depth in metres, or points); make a new plan".to_owned();
        Err(EngineError::Unavailable { engine: "webgpu", reason }.into())
    }

    /// Reads a result into `out`.
    ///
    /// # Errors
    /// If the result is not [`output_bytes`](Self::output_bytes) long.
    pub fn read(&self, result: &[u8], out: &mut Smoothed) -> Result<(), FrameError> {
        let expected = self.output_bytes();
        if result.len() != expected {
            return Err(FrameError::LengthMismatch { what: "the result".into(), len: result.len(), expected });
        }
        // Mapped memory need not be aligned for words.
        let mut words = vec![0u32; expected / 4];
        bytemuck::cast_slice_mut(&mut words).copy_from_slice(result);
        Results::of_frame(&self.layout, bytemuck::cast_slice(&words), 0).copy_to(out, &Threads::default());
        Ok(())
    }
}
