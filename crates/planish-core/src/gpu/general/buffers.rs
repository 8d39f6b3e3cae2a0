//! Device buffers for unorganized clouds, which are reused from cloud to cloud, and their bind groups.

use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use bytemuck::{Pod, Zeroable, bytes_of};

use super::super::device::GpuDevice;
use super::super::layout::{Batch, HEADER_WORDS};
use super::super::mapped::Mapped;
use super::super::slot::Counted;
use super::super::stamps::Stamps;
use super::passes::{Compiled, DIGITS, Pass, Resource, TILE};
use crate::error::EngineError;
use crate::neighbours::LEAF;
use crate::xyz::MAX_PIXELS;

/// Number of children of a node.
const CHILDREN: usize = 8;
/// Maximum number of levels of nodes, plus one.
const LEVELS: usize = 12;
/// Distance in bytes between the uniforms of parts; every device accepts this alignment.
const PART_STRIDE: u64 = 256;
/// Maximum number of parts per pass.
pub(super) const MOST_PARTS: usize = 64;
/// Size in bytes of the cloud-wide state that the kernels write (cloud.wgsl).
pub(super) const STATE_BYTES: u64 = 8;
/// Size of a node's box and moments, in bytes.
const NODE_BYTES: usize = 48;
/// Size of a first plane, in bytes.
const PLANE_BYTES: usize = 48;

/// The uniform of all kernels, as declared in cloud.wgsl.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub(super) struct CloudUniform {
    pub(super) points: u32,
    pub(super) tiles: u32,
    pub(super) top: u32,
    pub(super) top_nodes: u32,
    pub(super) middle: [f32; 3],
    pub(super) per_half_extent: f32,
    pub(super) half_count: f32,
    pub(super) largest_radius: f32,
    pub(super) least_neighbours: u32,
    pub(super) part_places: u32,
    pub(super) levels: [u32; LEVELS],
    /// Number of points that need results: a part without its halo. They precede all other points.
    pub(super) own_points: u32,
    pub(super) padding: [u32; 3],
}

const _: () = assert!(size_of::<CloudUniform>() == 112);

/// The levels of nodes over a cloud's points.
pub(super) struct Levels {
    /// Index of the first node of each level; for levels above the highest, the total number of nodes.
    pub(super) firsts: [u32; LEVELS],
    pub(super) top: usize,
    pub(super) top_nodes: usize,
}

impl Levels {
    pub(super) fn of(points: usize) -> Self {
        let mut firsts = [0; LEVELS];
        let (mut top, mut nodes) = (0, points.div_ceil(LEAF).max(1));
        loop {
            let end = firsts[top] + nodes.next_multiple_of(CHILDREN) as u32;
            firsts[top + 1..].fill(end);
            if nodes <= CHILDREN {
                return Self { firsts, top, top_nodes: nodes };
            }
            (top, nodes) = (top + 1, nodes.div_ceil(CHILDREN));
        }
    }

    /// Returns the number of nodes of a level, including those that pad the last group of children.
    pub(super) fn nodes(&self, level: usize) -> usize {
        (self.firsts[level + 1] - self.firsts[level]) as usize
    }

    fn all_nodes(&self) -> usize {
        self.firsts[self.top + 1] as usize
    }
}

/// Sizes in bytes of the buffers that grow with a cloud.
struct Sizes {
    kept: [(&'static str, u64); 10],
    input: u64,
    output: u64,
    /// Size of results, state and radii by density.
    readback: u64,
}

impl Sizes {
    fn of(points: usize, output_words: usize, keeps_edges: bool) -> Self {
        let levels = Levels::of(points);
        let padded = points.next_multiple_of(LEAF);
        let bytes = |words: usize| 4 * words as u64;
        let kept = [
            ("keys", bytes(2 * points)),
            ("keys", bytes(2 * points)),
            ("order", bytes(points)),
            ("order", bytes(points)),
            ("counts", bytes(DIGITS * points.div_ceil(TILE))),
            ("positions", bytes(4 * padded)),
            ("nodes", (NODE_BYTES * levels.all_nodes()) as u64),
            ("radii", bytes(padded)),
            ("firsts", bytes(points + 1)),
            // No buffer may be empty.
            ("planes", (PLANE_BYTES * if keeps_edges { padded } else { 1 }) as u64),
        ];
        let output = bytes(output_words * points);
        Self { kept, input: bytes(SAMPLES + 3 * points), output, readback: output + STATE_BYTES + bytes(points) }
    }

    /// Returns the size of the largest buffer in bytes.
    fn largest(&self) -> u64 {
        self.kept.iter().map(|&(_, size)| size).chain([self.input, self.readback]).max().unwrap_or(0)
    }
}

/// Returns the size in bytes of the largest buffer that the device allows.
fn largest_buffer(gpu: &GpuDevice) -> u64 {
    gpu.limits.max_buffer_size.min(gpu.limits.max_storage_buffer_binding_size)
}

/// Returns the maximum number of points whose buffers are within the device's limits.
pub(super) fn most_points(gpu: &GpuDevice, output_words: usize, keeps_edges: bool) -> usize {
    let allowed = largest_buffer(gpu);
    let fits = |points: usize| Sizes::of(points, output_words, keeps_edges).largest() <= allowed;
    let (mut fit, mut beyond) = (0, MAX_PIXELS + 1);
    while beyond - fit > 1 {
        let middle = fit.midpoint(beyond);
        if fits(middle) { fit = middle } else { beyond = middle }
    }
    fit
}

/// The buffers for clouds of up to `capacity` points.
pub(super) struct Buffers {
    pub(super) capacity: usize,
    /// Buffer that the host writes. It is mapped whenever no cloud is being smoothed.
    pub(super) upload: wgpu::Buffer,
    pub(super) input: wgpu::Buffer,
    pub(super) output: wgpu::Buffer,
    pub(super) readback: wgpu::Buffer,
    pub(super) batch: wgpu::Buffer,
    pub(super) cloud: wgpu::Buffer,
    pub(super) state: wgpu::Buffer,
    pub(super) mapped: Mapped,
    pub(super) stamps: Option<Stamps>,
    /// Bind groups, by pass and part.
    groups: Vec<Vec<wgpu::BindGroup>>,
    _counted: Counted,
}

/// Number of words of the input before its points.
pub(super) const SAMPLES: usize = HEADER_WORDS;

impl Buffers {
    pub(super) fn new(
        gpu: &GpuDevice,
        kernels: &[Compiled],
        capacity: usize,
        output_words: usize,
        keeps_edges: bool,
        timestamps: bool,
        all_bytes: &Arc<AtomicU64>,
    ) -> Result<Self, EngineError> {
        use wgpu::BufferUsages as Usage;
        let sizes = Sizes::of(capacity, output_words, keeps_edges);
        let (allowed, needed) = (largest_buffer(gpu), sizes.largest());
        if needed > allowed {
            return Err(EngineError::Limit { device: gpu.name.clone(), what: "bytes in a buffer", allowed, needed });
        }
        let kept_bytes: u64 = sizes.kept.iter().map(|&(_, size)| size).sum();
        let total = kept_bytes + 2 * sizes.input + sizes.output + sizes.readback;
        gpu.allocate(total, || {
            let buffer = |label, size, usage, mapped_at_creation| {
                gpu.device.create_buffer(&wgpu::BufferDescriptor {
                    label: Some(label),
                    size,
                    usage,
                    mapped_at_creation,
                })
            };
            let upload = buffer("upload", sizes.input, Usage::MAP_WRITE | Usage::COPY_SRC, true);
            let readback = buffer("readback", sizes.readback, Usage::MAP_READ | Usage::COPY_DST, false);
            let input = buffer("input", sizes.input, Usage::STORAGE | Usage::COPY_DST, false);
            let output = buffer("output", sizes.output, Usage::STORAGE | Usage::COPY_SRC, false);
            let batch = buffer("batch", size_of::<Batch>() as u64, Usage::UNIFORM | Usage::COPY_DST, false);
            let cloud = buffer("cloud", size_of::<CloudUniform>() as u64, Usage::UNIFORM | Usage::COPY_DST, false);
            let state = buffer("state", STATE_BYTES, Usage::STORAGE | Usage::COPY_SRC | Usage::COPY_DST, false);
            let parts = buffer("parts", MOST_PARTS as u64 * PART_STRIDE, Usage::UNIFORM, true);
            if let Ok(mut range) = parts.get_mapped_range_mut(..) {
                for part in 0..MOST_PARTS {
                    let at = part * PART_STRIDE as usize;
                    range.slice(at..at + 4).copy_from_slice(bytes_of(&(part as u32)));
                }
            }
            parts.unmap();
            let kept = sizes.kept.map(|(label, size)| buffer(label, size, Usage::STORAGE, false));
            let bind = |kernel: &Compiled, part: usize, is_swapped: bool| {
                // Every second pass of the sort writes back to the first buffers.
                let (from, to) = if is_swapped { (1, 0) } else { (0, 1) };
                kernel.bind(gpu, |resource| {
                    let buffer = match resource {
                        Resource::Batch => &batch,
                        Resource::Input => &input,
                        Resource::Output => &output,
                        Resource::Keys => &kept[from],
                        Resource::KeysOut => &kept[to],
                        Resource::Order => &kept[2 + from],
                        Resource::OrderOut => &kept[2 + to],
                        Resource::Counts => &kept[4],
                        Resource::Positions => &kept[5],
                        Resource::Nodes => &kept[6],
                        Resource::Radii => &kept[7],
                        Resource::Firsts => &kept[8],
                        Resource::Planes => &kept[9],
                        Resource::State => &state,
                        Resource::Cloud => &cloud,
                        Resource::Part => {
                            let size = std::num::NonZero::new(16);
                            return wgpu::BufferBinding { buffer: &parts, offset: part as u64 * PART_STRIDE, size };
                        }
                    };
                    wgpu::BufferBinding { buffer, offset: 0, size: None }
                })
            };
            let groups = Pass::ALL
                .into_iter()
                .zip(kernels)
                .map(|(pass, kernel)| {
                    let is_of_sort = matches!(pass, Pass::CountDigits | Pass::ScatterDigits);
                    (0..MOST_PARTS).map(|part| bind(kernel, part, is_of_sort && part % 2 == 1)).collect()
                })
                .collect();
            Self {
                capacity,
                upload,
                input,
                output,
                readback,
                batch,
                cloud,
                state,
                mapped: Mapped::default(),
                stamps: timestamps.then(|| Stamps::new(gpu)),
                groups,
                _counted: Counted::new(total, all_bytes),
            }
        })
    }

    /// Returns the bind group for a part of a pass.
    pub(super) fn bind_group(&self, pass: Pass, part: usize) -> &wgpu::BindGroup {
        &self.groups[pass as usize][part]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_hold_all_children_of_the_one_above() {
        for points in [1, 16, 17, 128, 129, 5000, 1 << 20, 200_000_000] {
            let levels = Levels::of(points);
            assert!(levels.nodes(0) * LEAF >= points && levels.top_nodes <= CHILDREN);
            for level in 1..=levels.top {
                assert!(levels.nodes(level) * CHILDREN >= levels.nodes(level - 1), "{points}");
            }
            assert_eq!(levels.all_nodes(), (0..=levels.top).map(|level| levels.nodes(level)).sum::<usize>());
        }
    }
}
