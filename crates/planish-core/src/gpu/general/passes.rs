//! The kernels for unorganized clouds: the buffers that each kernel reads and writes, and its WGSL.

use std::fmt::Write;

use super::super::device::GpuDevice;
use super::super::kernel;
use super::super::layout::{InputKind, constants};
use super::super::shader::shader;
use crate::error::EngineError;
use crate::outputs::Outputs;
use crate::params::{Edges, EngineParams, Radius};
use crate::range::{DENSITIES_IN_CLOUD, WINDOWS_IN_CLOUD};

/// Number of values of a digit. A digit is four bits of a key; each pass of the sort orders the points by one digit.
pub(super) const DIGITS: usize = 16;
/// Number of points per tile of the sort; one workgroup handles one tile.
pub(super) const TILE: usize = 2048;
/// Number of threads per workgroup in passes in which each thread handles one position or node.
const THREADS: usize = 64;
/// Number of threads per workgroup in passes in which each thread handles one point.
const POINT_THREADS: usize = 256;

/// A kernel's buffer; the discriminant is its binding.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Resource {
    Batch,
    Input,
    Output,
    Keys,
    Order,
    KeysOut,
    OrderOut,
    Counts,
    Positions,
    Nodes,
    Radii,
    Firsts,
    Planes,
    State,
    Cloud,
    Part,
}

impl Resource {
    fn name_and_type(self) -> (&'static str, &'static str) {
        match self {
            Self::Batch => ("batch", "Batch"),
            Self::Input => ("input", "array<u32>"),
            Self::Output => ("output", "array<u32>"),
            Self::Keys => ("keys", "array<vec2<u32>>"),
            Self::Order => ("order", "array<u32>"),
            Self::KeysOut => ("keys_out", "array<vec2<u32>>"),
            Self::OrderOut => ("order_out", "array<u32>"),
            Self::Counts => ("counts", "array<u32>"),
            Self::Positions => ("positions", "array<vec4<f32>>"),
            Self::Nodes => ("nodes", "array<vec4<f32>>"),
            Self::Radii => ("radii", "array<f32>"),
            Self::Firsts => ("firsts", "array<u32>"),
            Self::Planes => ("planes", "array<vec4<f32>>"),
            Self::State => ("state", "array<atomic<u32>, 2>"),
            Self::Cloud => ("cloud", "Cloud"),
            Self::Part => ("part", "Part"),
        }
    }

    fn is_uniform(self) -> bool {
        matches!(self, Self::Batch | Self::Cloud | Self::Part)
    }
}

/// The kernels, in the order in which they run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Pass {
    /// Computes the position of each point along the curve, and writes the results of holes.
    Keys,
    /// Counts the keys of each tile by digit, in one pass of the sort.
    CountDigits,
    /// Replaces each count by the sum of the counts before it.
    ScanCounts,
    /// Orders keys and points by a digit, in one pass of the sort.
    ScatterDigits,
    /// Counts the distinct positions of each tile.
    CountHeads,
    /// Assigns one index to equal positions.
    PlaceHeads,
    /// Builds the boxes of the leaves.
    Leaves,
    /// Builds the boxes of a higher level of nodes.
    Nodes,
    /// Finds the radii by density.
    Radii,
    /// Fits the planes of all positions, if edges are kept.
    FirstPlanes,
    /// Fits the surfaces and stores the result of each position's first point.
    Fit,
    /// Copies each result to the other points at the same position.
    Repeat,
    /// Writes the radii in the order of the points, if the host requests them.
    PointRadii,
}

impl Pass {
    pub(super) const ALL: [Self; 13] = [
        Self::Keys,
        Self::CountDigits,
        Self::ScanCounts,
        Self::ScatterDigits,
        Self::CountHeads,
        Self::PlaceHeads,
        Self::Leaves,
        Self::Nodes,
        Self::Radii,
        Self::FirstPlanes,
        Self::Fit,
        Self::Repeat,
        Self::PointRadii,
    ];

    fn entry_point(self) -> &'static str {
        match self {
            Self::Keys => "find_keys",
            Self::CountDigits => "count_digits",
            Self::ScanCounts => "scan_counts",
            Self::ScatterDigits => "scatter_digits",
            Self::CountHeads => "count_heads",
            Self::PlaceHeads => "place_heads",
            Self::Leaves => "build_leaves",
            Self::Nodes => "build_nodes",
            Self::Radii => "find_radii",
            Self::FirstPlanes => "fit_first_planes",
            Self::Fit => "fit_places",
            Self::Repeat => "repeat_results",
            Self::PointRadii => "write_point_radii",
        }
    }

    /// Returns the buffers that the kernel reads and the buffers that it writes; at most eight of them are storage
    /// buffers.
    fn resources(self, edges: Edges) -> (&'static [Resource], &'static [Resource]) {
        use Resource::*;
        match self {
            Self::Keys => (&[Batch, Cloud, Part, Input], &[Output, Keys, Order]),
            Self::CountDigits => (&[Batch, Cloud, Part, Input, Keys], &[Counts]),
            Self::ScanCounts => (&[Batch, Cloud, Part, Input], &[Counts]),
            Self::ScatterDigits => (&[Batch, Cloud, Part, Input, Keys, Order, Counts], &[KeysOut, OrderOut]),
            Self::CountHeads => (&[Batch, Cloud, Input, Keys, Order], &[Counts]),
            Self::PlaceHeads => (&[Batch, Cloud, Input, Keys, Order, Counts], &[Positions, Firsts, State, OrderOut]),
            Self::Leaves => (&[Batch, Cloud, Input, Firsts], &[Positions, Nodes, State]),
            Self::Nodes => (&[Batch, Cloud, Part, Input], &[Nodes]),
            Self::Radii => (&[Batch, Cloud, Part, Input, Positions, Nodes], &[Radii, State]),
            Self::FirstPlanes => (&[Batch, Cloud, Part, Input, Positions, Nodes, Radii], &[Planes, State]),
            Self::Fit if edges == Edges::Off => {
                (&[Batch, Cloud, Part, Input, Order, Positions, Nodes, Radii, Firsts], &[Output, State])
            }
            Self::Fit => (&[Batch, Cloud, Part, Input, Order, Positions, Nodes, Planes, Firsts], &[Output, State]),
            Self::Repeat => (&[Batch, Cloud, Input, Keys, Order, OrderOut, Firsts], &[Output]),
            Self::PointRadii => (&[Batch, Cloud, Input, Keys, Order, OrderOut, Radii], &[Output]),
        }
    }

    /// Returns the number of workgroups for `count` points, positions or nodes.
    pub(super) fn groups(self, count: usize) -> usize {
        match self {
            Self::Keys | Self::Repeat | Self::PointRadii => count.div_ceil(POINT_THREADS),
            Self::ScanCounts => 1,
            Self::CountDigits | Self::ScatterDigits | Self::CountHeads | Self::PlaceHeads => count.div_ceil(TILE),
            Self::Leaves | Self::Nodes | Self::Radii | Self::FirstPlanes | Self::Fit => count.div_ceil(THREADS),
        }
    }

    /// Returns the WGSL of this kernel.
    pub(super) fn wgsl(self, params: &EngineParams, outputs: Outputs) -> String {
        let mut text = constants(InputKind::Points, outputs, 1);
        let _ = writeln!(text, "const KEEPS_ISOLATED: bool = {};", !params.remove_isolated);
        text += shader!("../shaders/buffers.wgsl");
        text += shader!("../shaders/words.wgsl");
        text += shader!("../shaders/general/cloud.wgsl");
        let (read, written) = self.resources(params.edges);
        for (resources, access) in [(read, "read"), (written, "read_write")] {
            for &resource in resources {
                let (name, wgsl_type) = resource.name_and_type();
                let space = if resource.is_uniform() { "uniform".into() } else { format!("storage, {access}") };
                // buffers.wgsl declares the buffers shared by all kernels.
                if !matches!(resource, Resource::Batch | Resource::Input | Resource::Output) {
                    let binding = resource as u32;
                    let _ = writeln!(text, "@group(0) @binding({binding}) var<{space}> {name}: {wgsl_type};");
                }
            }
        }
        let gate = shader!("../shaders/gate.wgsl");
        let node = shader!("../shaders/general/node.wgsl");
        let walk = shader!("../shaders/general/walk.wgsl");
        let digit = shader!("../shaders/general/digit.wgsl");
        let heads = shader!("../shaders/general/heads.wgsl");
        let store = [shader!("../shaders/pixel_result.wgsl"), shader!("../shaders/general/store.wgsl")];
        match self {
            Self::Keys => text += &(store.concat() + shader!("../shaders/general/keys.wgsl")),
            Self::CountDigits => text += &(digit.to_owned() + shader!("../shaders/general/count_digits.wgsl")),
            Self::ScanCounts => text += shader!("../shaders/general/scan.wgsl"),
            Self::ScatterDigits => text += &(digit.to_owned() + shader!("../shaders/general/scatter_digits.wgsl")),
            Self::CountHeads => text += &(heads.to_owned() + shader!("../shaders/general/count_heads.wgsl")),
            Self::PlaceHeads => text += &(heads.to_owned() + shader!("../shaders/general/place_heads.wgsl")),
            Self::Repeat => text += shader!("../shaders/general/repeat.wgsl"),
            Self::PointRadii => {
                let result = shader!("../shaders/pixel_result.wgsl");
                text += &(result.to_owned() + shader!("../shaders/general/point_radii.wgsl"));
            }
            Self::Leaves => text += &(node.to_owned() + shader!("../shaders/general/leaves.wgsl")),
            Self::Nodes => text += &(node.to_owned() + shader!("../shaders/general/nodes.wgsl")),
            Self::Radii => {
                let has_sensor = matches!(params.radius, Radius::SensorAndDensity { .. });
                let _ = writeln!(text, "const HAS_SENSOR: bool = {has_sensor};");
                let _ = writeln!(text, "const WINDOWS_IN_CLOUD: f32 = {WINDOWS_IN_CLOUD:?};");
                let _ = writeln!(text, "const DENSITIES_IN_CLOUD: f32 = {DENSITIES_IN_CLOUD:?};");
                text += &[gate, walk, shader!("../shaders/sensor.wgsl")].concat();
                text += shader!("../shaders/general/radii.wgsl");
            }
            Self::FirstPlanes => {
                text += &[gate, walk, shader!("../shaders/eigen.wgsl")].concat();
                text += shader!("../shaders/sensor.wgsl");
                text += shader!("../shaders/plane.wgsl");
                text += shader!("../shaders/general/neighbours.wgsl");
                text += radius_of(params.radius);
                text += shader!("../shaders/general/first_planes.wgsl");
                text += shader!("../shaders/general/fit_first_planes.wgsl");
            }
            Self::Fit => {
                let keeps_edges = params.edges != Edges::Off;
                text += &[gate, walk, shader!("../shaders/eigen.wgsl")].concat();
                text += shader!("../shaders/sensor.wgsl");
                let _ = writeln!(text, "const DEGREE: u32 = {}u;", params.degree);
                let _ = writeln!(text, "const KEEPS_EDGES: bool = {keeps_edges};");
                let _ = writeln!(text, "const KEEPS_RESULTS: bool = false;");
                // Bends are estimated only for frames (docs/method.md, section 10).
                let _ = writeln!(text, "const BENDS: bool = false;");
                text += shader!("../shaders/plane.wgsl");
                text += shader!("../shaders/general/neighbours.wgsl");
                text += &kernel::surface(params.degree as usize, LEAVES_LOOP);
                text += &store.concat();
                text += shader!("../shaders/result_depth.wgsl");
                text += shader!("../shaders/result.wgsl");
                if keeps_edges {
                    text += shader!("../shaders/general/first_planes.wgsl");
                    text += shader!("../shaders/general/fit_found_surface.wgsl");
                } else {
                    text += radius_of(params.radius);
                    text += shader!("../shaders/general/fit_own_plane.wgsl");
                }
                text += shader!("../shaders/general/fit.wgsl");
            }
        }
        text
    }
}

/// Returns the WGSL function that returns the radius at a position.
fn radius_of(radius: Radius) -> &'static str {
    match radius {
        Radius::Neighbours { .. } | Radius::SensorAndDensity { .. } => {
            shader!("../shaders/general/radius_limited.wgsl")
        }
        Radius::Fixed { .. } | Radius::Sensor => shader!("../shaders/general/radius_fixed.wgsl"),
    }
}

/// The WGSL loop over the points within reach: the text before its body, and the text after it.
const LEAVES_LOOP: [&str; 2] = [
    "var walk = new_walk();
    while next_leaf(&walk, p, reach_squared_of(radius_squared)) {
        for (var place = LEAF * walk.leaf; place < LEAF * (walk.leaf + 1u); place++) {
        let q = positions[place];
        let e = q.xyz - p;
        let count = q.w;",
    "} }
    check_done(walk);",
];

/// A compiled kernel.
pub(super) struct Compiled {
    pub(super) pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
    resources: Vec<Resource>,
}

impl Compiled {
    pub(super) fn new(
        gpu: &GpuDevice,
        pass: Pass,
        params: &EngineParams,
        outputs: Outputs,
        bounds_checks: bool,
    ) -> Result<Self, EngineError> {
        let (read, written) = pass.resources(params.edges);
        let entry = |&resource: &Resource, read_only| {
            let ty = if resource.is_uniform() {
                wgpu::BufferBindingType::Uniform
            } else {
                wgpu::BufferBindingType::Storage { read_only }
            };
            wgpu::BindGroupLayoutEntry {
                binding: resource as u32,
                visibility: wgpu::ShaderStages::COMPUTE,
                ty: wgpu::BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None },
                count: None,
            }
        };
        let entries: Vec<_> =
            read.iter().map(|r| entry(r, true)).chain(written.iter().map(|w| entry(w, false))).collect();
        let layout =
            gpu.device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: None, entries: &entries });
        let pipeline_layout = gpu.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: None,
            bind_group_layouts: &[Some(&layout)],
            immediate_size: 0,
        });
        let wgsl = pass.wgsl(params, outputs);
        let pipeline = gpu.compile(pass.entry_point(), wgsl, &pipeline_layout, bounds_checks)?;
        Ok(Self { pipeline, layout, resources: [read, written].concat() })
    }

    /// Creates the kernel's bind group from the buffers that `buffer` returns.
    pub(super) fn bind<'a>(
        &self,
        gpu: &GpuDevice,
        buffer: impl Fn(Resource) -> wgpu::BufferBinding<'a>,
    ) -> wgpu::BindGroup {
        let entries: Vec<_> = self
            .resources
            .iter()
            .map(|&resource| wgpu::BindGroupEntry {
                binding: resource as u32,
                resource: wgpu::BindingResource::Buffer(buffer(resource)),
            })
            .collect();
        gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &self.layout,
            entries: &entries,
        })
    }
}
