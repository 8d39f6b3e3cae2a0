//! Guarantees of the GPU engine other than parity: order, batches, views, outputs and refusals. The tests run on
//! lavapipe or a real GPU.

use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::{
    AdapterKind, Camera, DepthFrame, Engine, EngineError, Error, Frame, FrameError, FrameParams, GpuAdapter,
    GpuOptions, IntoFrame, Outputs, Smoothed, Smoother, SmootherOptions, Transfer, auto_choice, gpu_adapters,
};
use planish_tests::bits::bits;
use planish_tests::data::skip;
use planish_tests::engines::{TestEngine, test_adapter};
use planish_tests::scenes::{grid, small_camera};

const SHAPE: (usize, usize) = (160, 120);
const EVERYTHING: Outputs = Outputs::ALL.with_depth(true).with_depth_m(true);

/// Returns the adapter of the tests; without an adapter, prints SKIP and returns `None`.
fn adapter(test: &str) -> Option<&'static GpuAdapter> {
    let adapter = test_adapter();
    if adapter.is_none() {
        skip(&format!("{test}: no GPU adapter"));
    }
    adapter
}

fn open(params: FrameParams, change: impl FnOnce(&mut SmootherOptions)) -> Result<Smoother, Error> {
    let mut options = TestEngine::gpu(true).options(Outputs::ALL);
    change(&mut options);
    Smoother::open_with(params, &options, SHAPE)
}

fn frame(seed: u64) -> DepthFrame {
    let camera = small_camera();
    let (scene, pose) = Scene::tabletop(seed);
    let truth = scene.render(&camera, &pose);
    DepthSimulator::new(DepthNoise::default(), camera, seed).frame(&truth, 0).unwrap()
}

fn one_by_one(frames: &[Frame<'_>], params: FrameParams) -> Vec<Vec<u32>> {
    let mut smoother = open(params, |_| ()).unwrap();
    let mut smoothed = Smoothed::default();
    let mut smooth = |&frame: &Frame<'_>| {
        smoother.smooth(frame, &mut smoothed).unwrap();
        bits(&smoothed)
    };
    frames.iter().map(&mut smooth).collect()
}

#[test]
fn frames_in_flight_come_back_in_order() {
    if adapter("frames in flight").is_none() {
        return;
    }
    let depths: Vec<_> = (0..4).map(frame).collect();
    let clouds: Vec<_> = depths.iter().map(|depth| depth.deproject().unwrap()).collect();
    // Depth and points alternate. Every third frame is in place; the others are copied.
    let frames: Vec<Frame<'_>> =
        depths.iter().zip(&clouds).flat_map(|(d, c)| [d.into_frame().unwrap(), c.into_frame().unwrap()]).collect();
    let expected = one_by_one(&frames, FrameParams::default());
    for transfer in [Transfer::Staged, Transfer::Auto] {
        let mut smoother = open(FrameParams::default(), |options| {
            options.gpu.transfer = transfer;
            options.gpu.slots = 3;
        })
        .unwrap();
        assert!(smoother.receive().unwrap().is_none());
        let mut found = Vec::new();
        for (i, &frame) in frames.iter().enumerate() {
            if smoother.in_flight() == smoother.max_in_flight() {
                let full = smoother.submit_in_place(frame).unwrap_err();
                assert!(matches!(full, Error::Engine(EngineError::Full { in_flight: 3 })), "{full}");
                found.push(bits(&smoother.receive().unwrap().unwrap().into_smoothed()));
            }
            match i % 3 {
                0 => smoother.submit_in_place(frame).unwrap(),
                _ => smoother.submit(frame, Smoothed::default()).unwrap(),
            }
        }
        while let Some(result) = smoother.receive().unwrap() {
            found.push(bits(&result.into_smoothed()));
        }
        assert!(found == expected, "{transfer:?}");
    }
}

#[test]
fn copies_need_no_thread_of_who_waits_for_them() {
    if adapter("copies inside rayon").is_none() {
        return;
    }
    let depth = frame(1);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let points = pool.install(|| {
        let mut smoother = open(FrameParams::paper(), |_| ()).unwrap();
        smoother.submit(&depth, Smoothed::default()).unwrap();
        smoother.receive().unwrap().unwrap().into_smoothed().points.len()
    });
    assert_eq!(points, SHAPE.0 * SHAPE.1);
}

#[test]
fn views_stay_what_they_are_while_frames_go_on_and_on_other_threads() {
    if adapter("views").is_none() {
        return;
    }
    let depths: Vec<_> = (0..5).map(frame).collect();
    let frames: Vec<Frame<'_>> = depths.iter().map(|depth| depth.into_frame().unwrap()).collect();
    let expected = one_by_one(&frames, FrameParams::paper());
    let mut smoother = open(FrameParams::paper(), |options| options.outputs.depth = true).unwrap();
    let mut views = Vec::new();
    for &frame in &frames {
        smoother.submit_in_place(frame).unwrap();
        views.push(smoother.receive().unwrap().unwrap());
    }
    let readers = views.into_iter().map(|view| {
        std::thread::spawn(move || {
            let mut copy = Smoothed::default();
            view.copy_to(&mut copy);
            let [x, y, z] = view.points().unwrap();
            let nan = |v: &f32| v.to_bits();
            assert!(x.iter().map(nan).eq(copy.points.x().iter().map(nan)));
            assert!(y.iter().map(nan).eq(copy.points.y().iter().map(nan)));
            assert!(z.iter().map(nan).eq(copy.points.z().iter().map(nan)));
            assert_eq!(view.shape(), SHAPE);
            assert!(view.status().unwrap().eq(copy.status.iter().flatten().copied()));
            assert_eq!(
                view.depth_rows().unwrap().flatten().copied().collect::<Vec<_>>(),
                *copy.depth.as_ref().unwrap()
            );
            assert!(view.curvature().unwrap().iter().map(nan).eq(copy.curvature.iter().flatten().map(nan)));
            assert!(view.normals().unwrap()[2].iter().map(nan).eq(copy.normals.as_ref().unwrap().z().iter().map(nan)));
            drop(view);
            copy.depth = None;
            bits(&copy)
        })
    });
    let readers: Vec<_> = readers.collect();
    drop(smoother);
    let found: Vec<_> = readers.into_iter().map(|reader| reader.join().unwrap()).collect();
    assert!(found == expected);
}

#[test]
fn a_batch_gives_what_its_frames_give() {
    if adapter("batches").is_none() {
        return;
    }
    let mut depths: Vec<_> = (0..5).map(frame).collect();
    // One frame has other intrinsics and another depth unit, but the same shape.
    depths[1].camera = Camera::new((160, 120), [140.0, 131.25], [79.5, 59.5]).with_depth_units_per_metre(900.0);
    let cloud = depths[2].deproject().unwrap();
    let mut frames: Vec<Frame<'_>> = depths.iter().map(|depth| depth.into_frame().unwrap()).collect();
    frames.insert(3, (&cloud).into_frame().unwrap());
    let expected = one_by_one(&frames, FrameParams::default());
    let mut smoother = open(FrameParams::default(), |_| ()).unwrap();
    let mut out = vec![Smoothed::default(); frames.len()];
    for _ in 0..2 {
        smoother.smooth_batch(&frames, &mut out).unwrap();
        assert!(out.iter().map(bits).eq(expected.iter().cloned()));
    }
    smoother.smooth_batch(&[], &mut []).unwrap();
    let error = smoother.smooth_batch(&frames, &mut out[1..]).unwrap_err();
    assert!(matches!(error, Error::Frame(FrameError::LengthMismatch { .. })), "{error}");
}

#[test]
fn outputs_that_were_not_asked_for_are_absent_and_change_nothing() {
    if adapter("outputs").is_none() {
        return;
    }
    let depth = frame(3);
    let all = TestEngine::gpu(true).smooth_to(&depth, FrameParams::default(), EVERYTHING);
    let mut smoothed = Smoothed::default();
    for wanted in (1..128u32).filter(|wanted| wanted.count_ones() == 1 || wanted % 18 == 9) {
        let wants = |output: u32| wanted & output != 0;
        let outputs = Outputs::POINTS
            .with_points(wants(1))
            .with_depth(wants(2))
            .with_normals(wants(4))
            .with_curvature(wants(8))
            .with_status(wants(16))
            .with_neighbours(wants(32))
            .with_depth_m(wants(64));
        let mut smoother = open(FrameParams::default(), |options| options.outputs = outputs).unwrap();
        smoother.smooth(&depth, &mut smoothed).unwrap();
        let mut expected = all.clone();
        expected.points = if outputs.points { expected.points } else { Default::default() };
        expected.depth = expected.depth.filter(|_| outputs.depth);
        expected.depth_m = expected.depth_m.filter(|_| outputs.depth_m);
        expected.normals = expected.normals.filter(|_| outputs.normals);
        expected.curvature = expected.curvature.filter(|_| outputs.curvature);
        expected.status = expected.status.filter(|_| outputs.status);
        expected.neighbours = expected.neighbours.filter(|_| outputs.neighbours);
        assert!(bits(&smoothed) == bits(&expected), "{outputs:?}");
    }
}

#[test]
fn shapes_around_the_tile_lose_no_pixel() {
    if adapter("shapes").is_none() {
        return;
    }
    let params = FrameParams::paper().with_stride(2);
    for (width, height) in [(1, 1), (1, 9), (2, 7), (3, 5), (31, 3), (32, 4), (33, 17), (63, 8), (65, 9)] {
        let z = |u: usize, v: usize| 1.0 + 0.0001 * ((u * v) % 5) as f32;
        let mut cloud = grid(width, height, |u, v| [0.003 * u as f32 * z(u, v), 0.003 * v as f32 * z(u, v), z(u, v)]);
        cloud.camera = Some(Camera::new((width, height), [1.0 / 0.003, 1.0 / 0.003], [0.0, 0.0]));
        let [found, expected] =
            [TestEngine::gpu(true), TestEngine::REFERENCE].map(|engine| engine.smooth_to(&cloud, params, EVERYTHING));
        assert_eq!(found.status, expected.status, "{width}x{height}");
        assert_eq!(found.neighbours, expected.neighbours, "{width}x{height}");
        let (found_raw, expected_raw) = (found.depth.unwrap(), expected.depth.unwrap());
        assert!(found_raw.iter().zip(&expected_raw).all(|(a, b)| a.abs_diff(*b) <= 1), "{width}x{height}");
        for (p, q) in found.points.iter().zip(expected.points.iter()) {
            assert!((0..3).all(|k| p[k].is_nan() == q[k].is_nan() && (p[k].is_nan() || (p[k] - q[k]).abs() < 2e-6)));
        }
    }
}

#[test]
fn time_stamps_say_where_the_time_went() {
    if adapter("time stamps").is_none() {
        return;
    }
    let depth = frame(1);
    let mut smoother = open(FrameParams::paper(), |options| options.gpu.timestamps = true).unwrap();
    let mut smoothed = Smoothed::default();
    smoother.smooth(&depth, &mut smoothed).unwrap();
    assert!(smoother.timings().unwrap().kernel.as_nanos() > 1000);
    smoother.submit_in_place(&depth).unwrap();
    assert!(smoother.receive().unwrap().unwrap().timings().unwrap().kernel.as_nanos() > 1000);
    let mut off = open(FrameParams::paper(), |_| ()).unwrap();
    off.smooth(&depth, &mut smoothed).unwrap();
    assert!(off.timings().is_none());
}

#[test]
fn the_bytes_of_its_buffers_are_known_wherever_they_are() {
    if adapter("bytes of buffers").is_none() {
        return;
    }
    let depth = frame(1);
    let mut smoother = open(FrameParams::paper(), |options| {
        options.gpu.transfer = Transfer::Staged;
        options.gpu.slots = 2;
    })
    .unwrap();
    // Without this call, the first frame in flight would use a slot of the queue opened earlier.
    smoother.prepare_in_flight();
    // Every slot has its buffers from the start.
    let one = smoother.buffer_bytes() / 2;
    // A slot has at least the depth and the outputs, each on both sides, and less than twice that.
    let least = 2 * SHAPE.0 as u64 * SHAPE.1 as u64 * (2 + 4 * 7 + 1);
    assert!(one >= least && one < 2 * least, "{one} {least}");
    smoother.submit_in_place(&depth).unwrap();
    smoother.submit_in_place(&depth).unwrap();
    assert_eq!(smoother.buffer_bytes(), 2 * one);
    let view = smoother.receive().unwrap().unwrap();
    smoother.receive().unwrap();
    assert_eq!(smoother.buffer_bytes(), 2 * one, "one is the view's, one is free");
    drop(view);
    smoother.smooth_batch(&[(&depth).into_frame().unwrap(); 4], &mut vec![Smoothed::default(); 4]).unwrap();
    assert!((5 * one..=6 * one).contains(&smoother.buffer_bytes()), "{} {one}", smoother.buffer_bytes());
    smoother.smooth_batch(&[(&depth).into_frame().unwrap(); 2], &mut vec![Smoothed::default(); 2]).unwrap();
    assert!(smoother.buffer_bytes() < 5 * one, "batches of other sizes are not kept");
}

#[test]
fn what_cannot_be_is_refused_with_a_reason() {
    let unknown = SmootherOptions::default()
        .with_engine(Engine::Gpu)
        .with_gpu(GpuOptions::default().with_adapter("no such card".to_owned()));
    let error = Smoother::open_with(FrameParams::paper(), &unknown, SHAPE).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("no such card") || error.contains("no adapter was found"), "{error}");
    if adapter("refusals").is_none() {
        return;
    }
    let error = open(FrameParams::paper(), |options| options.gpu.slots = 0).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("slots = 0"), "{error}");
    // A single row needs more workgroups than any device allows.
    let error =
        Smoother::open_with(FrameParams::paper(), &TestEngine::gpu(true).options(Outputs::POINTS), (1 << 26, 1))
            .map(|_| ())
            .unwrap_err();
    let is_limit = matches!(&error, Error::Engine(EngineError::Limit { needed, allowed, .. }) if needed > allowed);
    assert!(is_limit, "{error}");
    let none = Outputs::POINTS.with_points(false);
    let error = open(FrameParams::paper(), |options| options.outputs = none).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("outputs = none"), "{error}");
    let mut smoother = open(FrameParams::paper(), |options| options.outputs = Outputs::DEPTH).unwrap();
    // These intrinsics belong to an image of another size.
    let mut mistaken = frame(1).deproject().unwrap();
    mistaken.camera = Some(Camera::kinect_v1());
    let error = smoother.smooth(&mistaken, &mut Smoothed::default()).unwrap_err().to_string();
    assert!(error.contains("640x480"), "{error}");
    let bare = grid(SHAPE.0, SHAPE.1, |u, v| [u as f32, v as f32, 1.0]);
    let error = smoother.submit(&bare, Smoothed::default()).unwrap_err().to_string();
    assert!(error.contains("intrinsics"), "{error}");
    let error = smoother.submit_in_place(&grid(3, 3, |_, _| [0.0; 3])).unwrap_err().to_string();
    assert!(error.contains("3x3") && error.contains("160x120"), "{error}");
}

#[test]
fn auto_takes_a_real_gpu_or_the_cpu_and_says_why() {
    let adapters = gpu_adapters();
    let has_gpu = adapters
        .iter()
        .any(|a| matches!(a.kind, AdapterKind::Discrete | AdapterKind::Integrated | AdapterKind::Virtual));
    let (engine, reason) = auto_choice(&adapters);
    assert_eq!(engine == Engine::Gpu, has_gpu, "{reason}");
    let mut smoother = Smoother::open(FrameParams::paper(), Engine::Auto, SHAPE).unwrap();
    assert_eq!(smoother.engine(), engine);
    assert_eq!(smoother.chosen_because(), Some(&reason));
    let mut smoothed = Smoothed::default();
    smoother.smooth(&frame(1), &mut smoothed).unwrap();
    assert_eq!(smoothed.points.len(), SHAPE.0 * SHAPE.1);
    if !has_gpu {
        let error = Smoother::open(FrameParams::paper(), Engine::Gpu, SHAPE).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains("adapter"), "{error}");
    }
}

#[test]
fn the_cpu_engine_keeps_the_same_order_and_limit() {
    let depths: Vec<_> = (0..4).map(frame).collect();
    let options = SmootherOptions::default().with_engine(Engine::Cpu).with_gpu(GpuOptions::default().with_slots(3));
    let mut smoother = Smoother::open_with(FrameParams::default(), &options, SHAPE).unwrap();
    let mut expected = Vec::new();
    for depth in &depths[..3] {
        let mut smoothed = Smoothed::default();
        smoother.smooth(depth, &mut smoothed).unwrap();
        expected.push(bits(&smoothed));
        smoother.submit(depth, Smoothed::default()).unwrap();
    }
    assert!(smoother.submit(&depths[3], Smoothed::default()).is_err());
    for expected in expected {
        assert!(bits(&smoother.receive().unwrap().unwrap().into_smoothed()) == expected);
    }
    assert_eq!(smoother.in_flight(), 0);
}

#[test]
fn smoothers_and_views_go_to_other_threads() {
    fn is_send<T: Send>() {}
    is_send::<Smoother>();
    is_send::<planish::SmoothedView>();
}

#[test]
fn a_device_of_the_host_program_gives_the_same_bits() {
    use planish::wgpu;
    let Some(adapter) = adapter("a device of the host program") else { return };
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::all()));
    let own = adapters.into_iter().find(|own| own.get_info().name == adapter.name).unwrap();
    let request = wgpu::DeviceDescriptor { required_limits: own.limits(), ..Default::default() };
    let (device, queue) = pollster::block_on(own.request_device(&request)).unwrap();
    let depth = frame(2);
    for params in [FrameParams::paper(), FrameParams::default()] {
        let options = SmootherOptions::default().with_outputs(EVERYTHING);
        let mut smoother = Smoother::open_on(&device, &queue, params, &options, SHAPE).unwrap();
        assert_eq!((smoother.engine(), smoother.gpu_name()), (Engine::Gpu, Some(adapter.name.as_str())));
        let mut smoothed = Smoothed::default();
        smoother.smooth(&depth, &mut smoothed).unwrap();
        let expected = TestEngine::gpu(true).smooth_to(&depth, params, EVERYTHING);
        assert!(bits(&smoothed) == bits(&expected), "{params:?}");
        smoother.submit(&depth, Smoothed::default()).unwrap();
        smoother.submit_in_place(&depth).unwrap();
        while let Some(view) = smoother.receive().unwrap() {
            assert!(bits(&view.into_smoothed()) == bits(&expected), "{params:?}");
        }
    }
    // The host program can still use its device.
    let buffer = device.create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: 64,
        usage: wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    queue.write_buffer(&buffer, 0, &[1; 64]);
    queue.submit([]);
    assert!(device.poll(wgpu::PollType::wait_indefinitely()).is_ok());
}
