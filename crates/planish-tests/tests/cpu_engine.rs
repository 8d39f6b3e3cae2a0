//! Guarantees of the CPU engine other than its numbers: identical bits for any number of threads, no allocation after
//! the first frame, equal results for depth frames and clouds, and only the requested outputs.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::{
    Camera, DepthFrame, Engine, FrameParams, GpuOptions, IntoFrame, OrganizedCloud, Outputs, SimdLevel, Smoothed,
    Smoother, SmootherOptions,
};
use planish_tests::bits::bits;
use planish_tests::engines::TestEngine;
use planish_tests::scenes::{grid, nasty_scenes, simulated, small_camera};

/// The system allocator with a count of its allocations.
struct Counting;

static ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller upholds the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller upholds the contract of `dealloc`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn frame(camera: Camera) -> DepthFrame {
    let (scene, pose) = Scene::tabletop(4);
    let truth = scene.render(&camera, &pose);
    DepthSimulator::new(DepthNoise::default(), camera, 4).frame(&truth, 0).unwrap()
}

/// Lock that lets these tests run one at a time, so that no test counts the allocations of another.
static ALONE: std::sync::Mutex<()> = std::sync::Mutex::new(());

#[test]
fn threads_and_runs_change_no_bit() {
    let _alone = ALONE.lock();
    let mut clouds: Vec<OrganizedCloud> = nasty_scenes().into_iter().map(|scene| scene.cloud).collect();
    clouds.push(simulated(3, false, small_camera()));
    for cloud in &clouds {
        for params in [FrameParams::paper(), FrameParams::default()] {
            let with =
                |threads| TestEngine { engine: Engine::Cpu, threads, ..TestEngine::REFERENCE }.smooth(cloud, params);
            let one = bits(&with(Some(1)));
            for threads in [Some(1), Some(2), Some(3), Some(7), None] {
                assert!(bits(&with(threads)) == one, "{threads:?}");
            }
        }
    }
}

#[test]
fn nothing_is_allocated_after_the_first_frame() {
    let _alone = ALONE.lock();
    let depth = frame(small_camera());
    let cloud = depth.deproject().unwrap();
    // The pixel pitch of a cloud without a camera is estimated for every frame.
    let mut bare = cloud.clone();
    bare.camera = None;
    for (threads, allowed) in [(1, 0), (2, FRAMES / 50)] {
        for outputs in [Outputs::POINTS, Outputs::ALL] {
            let options =
                SmootherOptions::default().with_engine(Engine::Cpu).with_outputs(outputs).with_threads(Some(threads));
            let mut smoother = Smoother::open_with(FrameParams::default(), &options, (160, 120)).unwrap();
            let mut smoothed = Smoothed::default();
            let mut run = |smoothed: &mut Smoothed| {
                smoother.smooth(&depth, smoothed).unwrap();
                smoother.smooth(&cloud, smoothed).unwrap();
                smoother.smooth(&bare, smoothed).unwrap();
            };
            run(&mut smoothed);
            let before = ALLOCATIONS.load(Ordering::Relaxed);
            for _ in 0..FRAMES / 3 {
                run(&mut smoothed);
            }
            let allocations = ALLOCATIONS.load(Ordering::Relaxed) - before;
            // With more than one thread, rayon's job queue allocates a block for every 63 jobs.
            assert!(allocations <= allowed, "{allocations} allocations in {FRAMES} frames on {threads} threads");
        }
    }
}

const FRAMES: usize = 300;

#[test]
fn a_depth_frame_gives_the_bits_of_its_cloud() {
    let _alone = ALONE.lock();
    let mut depth = frame(small_camera());
    depth.raw[777] = planish::SATURATED_DEPTH;
    let cloud = depth.deproject().unwrap();
    for engine in [TestEngine::cpu(SimdLevel::best()), TestEngine::REFERENCE] {
        for params in [FrameParams::paper(), FrameParams::default()] {
            assert!(bits(&engine.smooth(&depth, params)) == bits(&engine.smooth(&cloud, params)), "{params:?}");
        }
    }
}

#[test]
fn outputs_that_were_not_asked_for_are_absent_and_change_nothing() {
    let _alone = ALONE.lock();
    let cloud = simulated(3, true, small_camera());
    let all = TestEngine::cpu(SimdLevel::best()).smooth(&cloud, FrameParams::default());
    let mut smoothed = Smoothed::default();
    for wanted in 0..16u32 {
        let wants = |output: u32| wanted & output != 0;
        let outputs = Outputs::POINTS
            .with_normals(wants(1))
            .with_curvature(wants(2))
            .with_status(wants(4))
            .with_neighbours(wants(8));
        let options = SmootherOptions::default().with_engine(Engine::Cpu).with_outputs(outputs);
        let mut smoother = Smoother::open_with(FrameParams::default(), &options, (160, 120)).unwrap();
        // The same result struct is used each time, so outputs that are no longer requested disappear.
        smoother.smooth(&cloud, &mut smoothed).unwrap();
        let mut expected = all.clone();
        expected.normals = expected.normals.filter(|_| outputs.normals);
        expected.curvature = expected.curvature.filter(|_| outputs.curvature);
        expected.status = expected.status.filter(|_| outputs.status);
        expected.neighbours = expected.neighbours.filter(|_| outputs.neighbours);
        assert!(bits(&smoothed) == bits(&expected), "{outputs:?}");
    }
}

#[test]
fn widths_around_the_lane_counts_lose_no_pixel() {
    let _alone = ALONE.lock();
    for width in [1, 2, 3, 4, 5, 7, 8, 9, 15, 16, 17, 31, 33] {
        let cloud = grid(width, 9, |u, v| [0.003 * u as f32, 0.003 * v as f32, 1.0 + 0.0001 * ((u * v) % 5) as f32]);
        let reference = TestEngine::REFERENCE.smooth(&cloud, FrameParams::paper());
        for level in SimdLevel::available() {
            let result = TestEngine::cpu(level).smooth(&cloud, FrameParams::paper());
            assert_eq!(result.status, reference.status, "width {width}, {}", level.name());
            for (p, q) in result.points.iter().zip(reference.points.iter()) {
                assert!(
                    (0..3).all(|k| p[k].is_nan() == q[k].is_nan() && (p[k].is_nan() || (p[k] - q[k]).abs() < 2e-6))
                );
            }
        }
    }
}

#[test]
fn a_level_that_the_machine_lacks_and_zero_threads_are_refused() {
    let open = |simd, threads| {
        let options = SmootherOptions::default().with_engine(Engine::Cpu).with_threads(threads).with_simd(simd);
        Smoother::open_with(FrameParams::paper(), &options, (4, 4)).map(|_| ())
    };
    let missing = SimdLevel::ALL.into_iter().find(|level| SimdLevel::available().all(|have| have != *level)).unwrap();
    assert!(open(Some(missing), None).unwrap_err().to_string().contains(missing.name()));
    assert!(open(None, Some(0)).unwrap_err().to_string().contains("threads = 0"));
}

#[test]
fn times_are_told_when_asked_and_bytes_always() {
    let _alone = ALONE.lock();
    let depth = frame(small_camera());
    let open = |params, timestamps| {
        let gpu = GpuOptions::default().with_timestamps(timestamps);
        let options = SmootherOptions::default().with_engine(Engine::Cpu).with_gpu(gpu);
        Smoother::open_with(params, &options, (160, 120)).unwrap()
    };
    let mut smoother = open(FrameParams::paper(), true);
    assert!(smoother.timings().is_none());
    let mut smoothed = Smoothed::default();
    smoother.smooth(&depth, &mut smoothed).unwrap();
    let alone = smoother.timings().unwrap();
    assert!(!alone.upload.is_zero() && !alone.kernel.is_zero() && alone.readback.is_zero(), "{alone:?}");
    smoother.submit_in_place(&depth).unwrap();
    assert!(!smoother.receive().unwrap().unwrap().timings().unwrap().kernel.is_zero());
    // The times of a batch are the sums over its frames, and together at most the time that the host waits.
    let start = Instant::now();
    smoother.smooth_batch(&[(&depth).into_frame().unwrap(); 8], &mut vec![Smoothed::default(); 8]).unwrap();
    let (all, batch) = (start.elapsed(), smoother.timings().unwrap());
    assert!(!batch.kernel.is_zero() && batch.upload + batch.kernel <= all, "{batch:?} of {all:?}");
    // x, y and z each have 160 columns (a multiple of 16), a border of 3 pixels and 16 numbers at the end.
    let padded = (160 + 6) * (120 + 6) + 16;
    assert_eq!(smoother.buffer_bytes(), 4 * 3 * padded);
    // Each cell has 3 numbers for its points, 6 for means, 13 for first planes and 10 for surfaces; the border is 6
    // cells wide. Each pixel has 6 numbers, in half as many columns, with a border of 4.
    let (cells, pixels) = ((80 + 12) * (60 + 12) + 16, (80 + 8) * (120 + 8) + 16);
    let mut robust = open(FrameParams::default(), false);
    assert_eq!(robust.buffer_bytes(), 4 * (32 * cells + 6 * pixels));
    robust.smooth(&depth, &mut smoothed).unwrap();
    assert!(robust.timings().is_none());
}
