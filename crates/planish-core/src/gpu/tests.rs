//! Compares the shader's primitives with f64, and tests device faults. Runs on the first adapter, even a software
//! adapter.

use std::sync::Arc;

use glam::{DMat3, DVec3};

use super::device::{self, GpuDevice, OpenAdapter, Purpose, lock};
use super::engine::{Gpu, adapters};
use super::kernel;
use super::slot::Slot;
use crate::camera::Camera;
use crate::devices::{GpuAdapter, GpuOptions};
use crate::error::{EngineError, Error};
use crate::frame::{DepthFrame, FrameGeometry, GeometryScratch, IntoFrame};
use crate::outputs::Outputs;
use crate::params::{EngineParams, FrameParams};
use crate::smoothed::Smoothed;
use crate::smoothing_engine::{AdmittedFrame, SmoothingEngine};
use crate::testing::{DepthNoise, Random, Scene, simulated, simulated_frame};

/// Opens the first adapter, and returns it with its description. Without an adapter, prints SKIP and returns `None`,
/// or panics if PLANISH_REQUIRE_GPU is set.
pub(super) fn device(test: &str) -> Option<(Arc<OpenAdapter>, GpuAdapter)> {
    let Some(adapter) = adapters().into_iter().next() else {
        assert!(std::env::var_os("PLANISH_REQUIRE_GPU").is_none(), "no GPU adapter, and one is required");
        use std::io::Write;
        let _ = writeln!(std::io::stderr(), "SKIP {test}: no GPU adapter");
        return None;
    };
    Some((OpenAdapter::open(&adapter, Purpose::OneAtATime).unwrap(), adapter))
}

/// Runs the WGSL `body` once per `inputs` values of `input` and returns all outputs. `at` is the index of the first
/// value; `body` writes `outputs` values, the first at index `to`.
fn run(gpu: &GpuDevice, functions: &str, body: &str, input: &[f32], inputs: usize, outputs: usize) -> Vec<f32> {
    let count = input.len() / inputs;
    let text = format!(
        "@group(0) @binding(1) var<storage, read> input: array<f32>;
         @group(0) @binding(2) var<storage, read_write> output: array<f32>;
         {functions}
         @compute @workgroup_size(64)
         fn test_main(@builtin(global_invocation_id) id: vec3<u32>) {{
             if id.x >= {count}u {{ return; }}
             let at = id.x * {inputs}u;
             let to = id.x * {outputs}u;
             {body}
         }}"
    );
    let source = wgpu::ShaderSource::Wgsl(text.into());
    let module = gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor { label: None, source });
    let pipeline = gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: None,
        layout: None,
        module: &module,
        entry_point: None,
        compilation_options: Default::default(),
        cache: None,
    });
    use wgpu::BufferUsages as Usage;
    let bytes = (4 * count * outputs) as u64;
    let buffer = |size, usage| {
        gpu.device.create_buffer(&wgpu::BufferDescriptor { label: None, size, usage, mapped_at_creation: false })
    };
    let from = buffer(4 * input.len() as u64, Usage::STORAGE | Usage::COPY_DST);
    gpu.queue.write_buffer(&from, 0, bytemuck::cast_slice(input));
    let to = buffer(bytes, Usage::STORAGE | Usage::COPY_SRC);
    let readback = buffer(bytes, Usage::MAP_READ | Usage::COPY_DST);
    let bind_group = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &pipeline.get_bind_group_layout(0),
        entries: &[
            wgpu::BindGroupEntry { binding: 1, resource: from.as_entire_binding() },
            wgpu::BindGroupEntry { binding: 2, resource: to.as_entire_binding() },
        ],
    });
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    {
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(0, &bind_group, &[]);
        pass.dispatch_workgroups(count.div_ceil(64) as u32, 1, 1);
    }
    encoder.copy_buffer_to_buffer(&to, 0, &readback, 0, None);
    let submission = gpu.queue.submit([encoder.finish()]);
    readback.map_async(wgpu::MapMode::Read, .., |_| ());
    gpu.wait(submission).unwrap();
    let mapped = readback.get_mapped_range(..).unwrap();
    bytemuck::cast_slice(&mapped).to_vec()
}

/// `eigen.wgsl`, preceded by the constant that it expects from a layout.
const EIGEN: &str = concat!("const MIN_POSITIVE: f32 = 1.1754944e-38;\n", include_str!("shaders/eigen.wgsl"));

#[test]
fn the_cosine_of_a_third_of_the_arc_cosine_keeps_its_error() {
    let Some((gpu, _)) = device("cos(acos(x)/3)") else { return };
    let input: Vec<f32> = (-100_000..=100_000).map(|i| i as f32 * 1e-5).collect();
    let found = run(&gpu.devices[0], EIGEN, "output[to] = cos_third_acos(input[at]);", &input, 1, 1);
    for (x, found) in input.iter().zip(found) {
        let expected = (f64::from(*x).clamp(-1.0, 1.0).acos() / 3.0).cos();
        assert!((f64::from(found) - expected).abs() < 1e-6, "{x}: {found} {expected}");
    }
}

#[test]
fn the_smallest_eigenvector_is_as_good_as_f32_allows() {
    let Some((gpu, _)) = device("the eigen solve") else { return };
    let mut random = Random::new(11, 1);
    let mut cases = Vec::new();
    let mut input = Vec::new();
    for case in 0..20_000 {
        // Planes, lines, balls and shapes in between, at the scales of a window.
        let l2 = 10f64.powf(random.between(-10.0, 0.0));
        let l1 = l2 * 10f64.powf(random.between(-3.0, 0.0));
        let l0 = l1 * if case % 5 == 0 { 0.0 } else { random.between(0.0, 0.9) };
        let n = DVec3::new(random.normal(), random.normal(), random.normal()).normalize();
        let u = n.any_orthonormal_vector();
        let rotation = DMat3::from_cols(n, u, n.cross(u));
        let m = rotation * DMat3::from_diagonal(DVec3::new(l0, l1, l2)) * rotation.transpose();
        input.extend([m.x_axis.x, m.x_axis.y, m.x_axis.z, m.y_axis.y, m.y_axis.z, m.z_axis.z].map(|v| v as f32));
        cases.push((n, [l0, l1, l2]));
    }
    // Matrices whose smallest eigenvector is ambiguous, exactly or in f32: any unit vector is accepted.
    let nasty = [[0.0; 6], [1.0, 0.0, 0.0, 1.0, 0.0, 1.0], [1.0; 6], [1e-30, 0.0, 0.0, 1e-30, 0.0, 1e-36]];
    input.extend(nasty.as_flattened());
    let body = "
        let e = smallest_eigenvector(Symmetric(
            input[at], input[at + 1u], input[at + 2u], input[at + 3u], input[at + 4u], input[at + 5u]));
        output[to] = e.values.x; output[to + 1u] = e.values.y; output[to + 2u] = e.values.z;
        output[to + 3u] = e.vector.x; output[to + 4u] = e.vector.y; output[to + 5u] = e.vector.z;";
    let found = run(&gpu.devices[0], EIGEN, body, &input, 6, 6);
    for (i, found) in found.chunks_exact(6).enumerate() {
        let vector = DVec3::new(found[3].into(), found[4].into(), found[5].into());
        assert!((vector.length() - 1.0).abs() < 2e-6, "case {i}: {vector}");
        let Some((n, values)) = cases.get(i) else { continue };
        let [l0, l1, l2] = *values;
        // Rounding the matrix to f32 limits the accuracy of its eigenvector.
        let off = n.cross(vector).length();
        assert!(off < 4e-6 * l2 / (l1 - l0) + 1e-6, "case {i}, {values:?}: off by {off:e}");
        for (value, expected) in found.iter().zip(values) {
            // Two equal eigenvalues are each determined only to the square root of a rounding error.
            let tolerance = if l2 - l1 < 0.01 * l2 { 1e-3 } else { 1e-5 };
            assert!((f64::from(*value) - expected).abs() < tolerance * l2, "case {i}: {value:e} {expected:e}");
        }
    }
}

/// Returns the moments of points (a, b, f) with weight 1, in the order of `struct Moments`.
fn moments(points: &[[f64; 3]], degree: usize) -> Vec<f32> {
    let sum = |i: usize, j: usize, k: i32| {
        let term = |[a, b, f]: &[f64; 3]| a.powi(i as i32) * b.powi(j as i32) * f.powi(k);
        points.iter().map(term).sum::<f64>() as f32
    };
    let of = |degree: usize, k| (0..=degree).flat_map(move |i| (0..=degree - i).map(move |j| (i, j, k)));
    of(2 * degree, 0).chain(of(degree, 1)).map(|(i, j, k)| sum(i, j, k)).collect()
}

#[test]
fn the_solve_finds_coefficients_and_damps_what_is_not_supported() {
    let Some((gpu, _)) = device("the solve") else { return };
    for degree in [2usize, 3] {
        let functions = kernel::moments_struct(degree) + &kernel::solve(degree);
        let len = moments(&[], degree).len();
        let fields: Vec<_> = (0..len).map(|i| format!("input[at + {i}u]")).collect();
        let body = format!(
            "let c = solve(Moments({}), 1e-7, 1.0, input[at + {len}u]);
             output[to] = c.x; output[to + 1u] = c.y; output[to + 2u] = c.z;",
            fields.join(", ")
        );
        let mut random = Random::new(5, degree as u64);
        let (mut input, mut expected) = (Vec::new(), Vec::new());
        for case in 0..500 {
            let c: Vec<f64> = (0..6).map(|_| random.between(-1.0, 1.0)).collect();
            // Spread over the square, or on the line b = 0, which determines no monomial with b.
            let on_line = case % 2 == 1;
            let points: Vec<[f64; 3]> = (0..49)
                .map(|_| {
                    let (a, b) = (random.between(-1.0, 1.0), if on_line { 0.0 } else { random.between(-1.0, 1.0) });
                    [a, b, c[0] + c[1] * a + c[2] * b + c[3] * a * a + c[4] * a * b + c[5] * b * b]
                })
                .collect();
            input.extend(moments(&points, degree));
            input.push(49.0);
            expected.push([c[0], c[1], if on_line { 0.0 } else { c[2] }]);
        }
        let found = run(&gpu.devices[0], &functions, &body, &input, len + 1, 3);
        for (found, expected) in found.chunks_exact(3).zip(&expected) {
            for (found, expected) in found.iter().zip(expected) {
                assert!((f64::from(*found) - expected).abs() < 2e-4, "degree {degree}: {found} {expected}");
            }
        }
    }
}

fn frame() -> DepthFrame {
    let camera = Camera::new((64, 48), [52.5; 2], [31.5, 23.5]);
    simulated(Scene::tabletop(1), DepthNoise::default(), camera, 1)
}

fn admit(frame: &DepthFrame) -> AdmittedFrame<'_> {
    let frame = frame.into_frame().unwrap();
    AdmittedFrame::new(frame, FrameGeometry::of(frame, true, &mut GeometryScratch::default()))
}

#[test]
fn a_lost_device_is_an_error_and_the_next_smoother_has_another() {
    let Some((_, adapter)) = device("a lost device") else { return };
    // The devices are not shared, so other tests in this process keep theirs.
    let options = GpuOptions::default().with_adapter(adapter.index.to_string());
    let frame = frame();
    let frame = admit(&frame);
    let (params, shape) = (EngineParams::from(FrameParams::paper()), (64, 48));
    let own = Arc::new(device::open_alone(&adapter, 2));
    let mut lost = Gpu::open_in(own, params, Outputs::ALL, &options, shape).unwrap();

    let mut smoothed = Smoothed::default();
    smoothed.prepare(64, 48, Outputs::ALL);
    lost.smooth(&frame, smoothed.as_mut()).unwrap();
    lost.submit(&frame, None).unwrap();
    lost.submit(&frame, Some(Smoothed::default())).unwrap();
    lost.adapter.devices.iter().for_each(|gpu| gpu.device.destroy());
    let is_lost = |error: Error| match error {
        Error::Engine(EngineError::Lost { .. }) => {}
        other => panic!("{other}"),
    };
    is_lost(lost.smooth(&frame, smoothed.as_mut()).unwrap_err());
    // Frames in flight have either finished before the loss or are lost; receiving neither hangs nor panics.
    for _ in 0..2 {
        if let Err(error) = lost.receive() {
            is_lost(error);
        }
    }
    is_lost(lost.submit(&frame, None).unwrap_err());
    assert!(lost.adapter.devices[0].check().is_err());
    let mut next = Gpu::open(params, Outputs::ALL, &options, shape).unwrap();
    next.smooth(&frame, smoothed.as_mut()).unwrap();
}

#[test]
fn frames_on_several_queues_come_back_in_order_and_the_same() {
    let Some((_, adapter)) = device("several queues") else { return };
    let options = GpuOptions::default().with_slots(4);
    let (params, shape) = (EngineParams::from(FrameParams::default()), (64, 48));
    let open_alone = |queues| Arc::new(device::open_alone(&adapter, queues));
    let mut alone = Gpu::open_in(open_alone(1), params, Outputs::ALL, &options, shape).unwrap();
    let mut spread = Gpu::open_in(open_alone(1), params, Outputs::ALL, &options, shape).unwrap();
    let several = open_alone(3);
    spread.several = Some(Box::new(|| Ok(several)));
    let camera = Camera::new(shape, [52.5; 2], [31.5, 23.5]);
    let frame = |index| simulated_frame(Scene::tabletop(1), DepthNoise::default(), camera, 1, index);
    let frames: Vec<_> = (0..12).map(frame).collect();
    let admitted: Vec<_> = frames.iter().map(admit).collect();
    let mut received = Vec::new();
    for frame in &admitted {
        if spread.in_flight() == options.slots {
            received.extend(spread.receive().unwrap());
        }
        spread.submit(frame, None).unwrap();
    }
    while let Some(view) = spread.receive().unwrap() {
        received.push(view);
    }
    assert_eq!((received.len(), spread.adapter.devices.len()), (frames.len(), 3));
    let received: Vec<_> = received.into_iter().map(|view| view.into_smoothed()).collect();
    for (found, frame) in received.into_iter().zip(&admitted) {
        let mut expected = Smoothed::default();
        expected.prepare(64, 48, Outputs::ALL);
        alone.smooth(frame, expected.as_mut()).unwrap();
        let bits = |smoothed: &Smoothed| {
            let [x, y, z] = smoothed.points.as_slices();
            [x, y, z].map(|channel| channel.iter().map(|value| value.to_bits()).collect::<Vec<_>>())
        };
        assert_eq!((bits(&found), found.status), (bits(&expected), expected.status));
    }
    // All slots were returned. The slot of the device opened first is not used again.
    spread.submit(&admitted[0], None).unwrap();
    drop(spread.receive().unwrap());
    let is_of_several = |slot: &Slot| spread.adapter.devices.iter().any(|gpu| Arc::ptr_eq(gpu, &slot.gpu));
    assert!(lock(&spread.free).iter().all(is_of_several));
}

#[test]
fn a_lack_of_memory_is_an_error_that_says_how_much() {
    let Some((_, adapter)) = device("a lack of memory") else { return };
    let alone = device::open_alone(&adapter, 1);
    let gpu = &alone.devices[0];
    let size = gpu.limits.max_buffer_size / 4 * 4;
    let usage = wgpu::BufferUsages::STORAGE;
    let mut taken = Vec::new();
    let result = (0..100).try_for_each(|_| {
        taken.push(gpu.allocate(size, || {
            gpu.device.create_buffer(&wgpu::BufferDescriptor { label: None, size, usage, mapped_at_creation: false })
        })?);
        Ok(())
    });
    match result {
        Err(EngineError::OutOfMemory { bytes, .. }) => assert_eq!(bytes, size),
        Err(other) => panic!("{other}"),
        // A software adapter allocates only memory that is used.
        Ok(()) => assert_eq!(adapter.kind, crate::AdapterKind::Software),
    }
    drop(taken);
    // The error was returned, not recorded: the device still works.
    gpu.check().unwrap();
    let usual = gpu.allocate(1024, || {
        gpu.device.create_buffer(&wgpu::BufferDescriptor { label: None, size: 1024, usage, mapped_at_creation: false })
    });
    usual.unwrap();
}
