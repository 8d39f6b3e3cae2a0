//! Timestamps of a submission.

use std::time::Duration;

use super::device::GpuDevice;
use crate::timings::FrameTimings;

/// Number of timestamps: before the upload, before and after the kernels, and after the readback.
const STAMPS: u32 = 4;

pub(super) struct Stamps {
    queries: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    pub(super) readback: wgpu::Buffer,
    nanoseconds_per_tick: f64,
}

impl Stamps {
    pub(super) fn new(gpu: &GpuDevice) -> Self {
        use wgpu::BufferUsages as Usage;
        let buffer = |label, usage| {
            let size = u64::from(STAMPS) * 8;
            gpu.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some(label),
                size,
                usage,
                mapped_at_creation: false,
            })
        };
        Self {
            queries: gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: None,
                ty: wgpu::QueryType::Timestamp,
                count: STAMPS,
            }),
            resolved: buffer("stamps", Usage::QUERY_RESOLVE | Usage::COPY_SRC),
            readback: buffer("stamps read", Usage::MAP_READ | Usage::COPY_DST),
            nanoseconds_per_tick: f64::from(gpu.queue.get_timestamp_period()),
        }
    }

    pub(super) fn write(&self, encoder: &mut wgpu::CommandEncoder, index: u32) {
        encoder.write_timestamp(&self.queries, index);
    }

    /// Returns the timestamp writes for the compute pass of all kernels.
    pub(super) fn around_kernels(&self) -> wgpu::ComputePassTimestampWrites<'_> {
        wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: Some(1),
            end_of_pass_write_index: Some(2),
        }
    }

    pub(super) fn resolve(&self, encoder: &mut wgpu::CommandEncoder) {
        encoder.resolve_query_set(&self.queries, 0..STAMPS, &self.resolved, 0);
        encoder.copy_buffer_to_buffer(&self.resolved, 0, &self.readback, 0, None);
    }

    /// Returns the times of the last submission and unmaps its timestamps, which must be mapped.
    pub(super) fn timings(&self) -> Option<FrameTimings> {
        let ticks: [u64; STAMPS as usize] = {
            let range = self.readback.get_mapped_range(..).ok()?;
            bytemuck::pod_read_unaligned(&range)
        };
        self.readback.unmap();
        let between = |from: usize, to: usize| {
            let ticks = ticks[to].wrapping_sub(ticks[from]) as i64;
            Duration::from_nanos((ticks.max(0) as f64 * self.nanoseconds_per_tick) as u64)
        };
        Some(FrameTimings { upload: between(0, 1), kernel: between(1, 2), readback: between(2, 3) })
    }
}
