//! Benchmarks the CPU engine by window, stride, degree, threads, SIMD level, outputs and frame size, on simulated
//! frames.
//!
//! Run `cargo bench -p planish-tests --bench cpu` on a quiet machine. Each setting's result is compared with the
//! reference before the setting is timed.

use divan::Bencher;
use divan::counter::ItemsCount;
use planish::agreement::{Agreement, radii_m};
use planish::{
    Camera, Engine, FrameParams, FrameRadius, OrganizedCloud, Outputs, SimdLevel, Smoothed, Smoother, SmootherOptions,
};
use planish_tests::engines::TestEngine;
use planish_tests::scenes::simulated;

fn main() {
    divan::main();
}

/// Returns a camera with a Kinect's field of view at another resolution.
fn camera((width, height): (usize, usize)) -> Camera {
    let scale = width as f64 / 640.0;
    let (cx, cy) = ((width - 1) as f64 / 2.0, (height - 1) as f64 / 2.0);
    Camera::new((width, height), [525.0 * scale; 2], [cx, cy])
}

fn frame() -> OrganizedCloud {
    simulated(1, true, camera((640, 480)))
}

fn options(threads: usize) -> SmootherOptions {
    SmootherOptions::default().with_engine(Engine::Cpu).with_threads(Some(threads))
}

/// Checks that the result of a setting agrees with the reference, then times the setting. The counter is the number
/// of valid points per iteration.
fn time(bencher: Bencher<'_, '_>, cloud: &OrganizedCloud, params: FrameParams, options: SmootherOptions) {
    let engine =
        TestEngine { threads: options.threads, simd: options.simd, engine: options.engine, ..TestEngine::REFERENCE };
    let mut agreement = Agreement::default();
    let reference = TestEngine::REFERENCE.smooth(cloud, params);
    let radii_m = radii_m(cloud, params);
    agreement.add(&engine.smooth(cloud, params), &reference, |i| radii_m[i]);
    let misses = agreement.misses();
    assert!(misses.is_empty(), "the result is wrong, so it is not timed: {misses:?}");

    let mut smoother = Smoother::open_with(params, &options, (cloud.width(), cloud.height())).expect("an engine");
    let mut smoothed = Smoothed::default();
    bencher
        .counter(ItemsCount::new(cloud.points.valid_points()))
        .bench_local(|| smoother.smooth(cloud, &mut smoothed).expect("a result"));
}

#[divan::bench(args = [1, 2, 3, 4, 5, 6, 7], sample_count = 20)]
fn window(bencher: Bencher<'_, '_>, window: u32) {
    time(bencher, &frame(), FrameParams::paper().with_window(window), options(2));
}

#[divan::bench(args = [1, 2, 3, 8], sample_count = 20)]
fn stride(bencher: Bencher<'_, '_>, stride: u32) {
    time(bencher, &frame(), FrameParams::default().with_stride(stride), options(2));
}

#[divan::bench(args = [1, 2, 3], sample_count = 20)]
fn degree(bencher: Bencher<'_, '_>, degree: u32) {
    time(bencher, &frame(), FrameParams::paper().with_degree(degree), options(2));
}

#[divan::bench(args = [1, 2], sample_count = 20)]
fn threads(bencher: Bencher<'_, '_>, threads: usize) {
    time(bencher, &frame(), FrameParams::paper(), options(threads));
}

#[divan::bench(args = SimdLevel::available().map(SimdLevel::name), sample_count = 20)]
fn simd(bencher: Bencher<'_, '_>, name: &str) {
    let simd = SimdLevel::available().find(|level| level.name() == name);
    time(bencher, &frame(), FrameParams::paper(), options(2).with_simd(simd));
}

#[divan::bench(args = [(320, 240), (640, 480), (1280, 720), (1920, 1080)], sample_count = 10)]
fn size(bencher: Bencher<'_, '_>, shape: (usize, usize)) {
    time(bencher, &simulated(1, true, camera(shape)), FrameParams::default(), options(2));
}

#[divan::bench(args = ["points", "normals", "curvature", "status", "neighbours", "all"], sample_count = 20)]
fn outputs(bencher: Bencher<'_, '_>, name: &str) {
    let wants = |output| name == output || name == "all";
    let outputs = Outputs::POINTS
        .with_normals(wants("normals"))
        .with_curvature(wants("curvature"))
        .with_status(wants("status"))
        .with_neighbours(wants("neighbours"));
    time(bencher, &frame(), FrameParams::paper(), options(1).with_outputs(outputs));
}

#[divan::bench(sample_count = 20)]
fn depth_frame(bencher: Bencher<'_, '_>) {
    use planish::simulate::{DepthNoise, DepthSimulator, Scene};
    let camera = camera((640, 480));
    let (scene, pose) = Scene::room(1);
    let truth = scene.render(&camera, &pose);
    let frame = DepthSimulator::new(DepthNoise::default(), camera, 1).frame(&truth, 0).expect("one camera");
    let params = FrameParams::paper().with_radius(FrameRadius::Sensor);
    let mut smoother = Smoother::open_with(params, &options(2), (640, 480)).expect("an engine");
    let mut smoothed = Smoothed::default();
    let reference = TestEngine::REFERENCE.smooth(&frame, params);
    let mut agreement = Agreement::default();
    let cloud = frame.deproject().expect("a valid frame");
    let radii_m = radii_m(&cloud, params);
    agreement.add(&TestEngine::cpu(SimdLevel::best()).smooth(&frame, params), &reference, |i| radii_m[i]);
    assert!(agreement.misses().is_empty(), "the result is wrong, so it is not timed");
    bencher.bench_local(|| smoother.smooth(&frame, &mut smoothed).expect("a result"));
}
