//! Compares the device's standard errors with the CPU's, which are estimated from the same result.

use super::super::engine::Gpu;
use super::super::tests::device;
use crate::camera::{Camera, Distortion};
use crate::cloud::OrganizedCloud;
use crate::devices::GpuOptions;
use crate::frame::{DepthView, Frame, FrameGeometry, GeometryScratch, IntoFrame, RangeRule};
use crate::outputs::Outputs;
use crate::params::{EngineParams, FrameParams, Window, WindowSize};
use crate::pose::SensorPose;
use crate::sigma::{Sigma, SigmaBuffers};
use crate::smoothed::Smoothed;
use crate::smoothing_engine::{AdmittedFrame, DeviceSteps, SmoothingEngine};
use crate::testing::{DepthNoise, Random, Scene, simulated_frame};
use crate::threads::Threads;

const OUTPUTS: Outputs = Outputs::POINTS.with_status(true).with_neighbours(true);

/// Compares a frame's standard errors with the CPU's, and those of a batch with the single frame's.
fn compare(name: &str, frame: Frame<'_>, params: FrameParams, bounds_checks: bool) {
    let Some((_, adapter)) = device("standard errors") else { return };
    let options = GpuOptions::default().with_adapter(adapter.index.to_string()).with_bounds_checks(bounds_checks);
    let params = EngineParams::from(params);
    let shape = frame.grid().unwrap();
    let mut engine = Gpu::open(params, OUTPUTS, &options, shape).unwrap();
    let steps = DeviceSteps { sigma: true, fill_px: None, outputs: OUTPUTS.with_sigma(true) };
    assert!(engine.take_steps(&steps).unwrap(), "{name}");
    let geometry = FrameGeometry::of(frame, true, &mut GeometryScratch::default());
    let admitted = AdmittedFrame::new(frame, geometry);
    let mut found = Smoothed::default();
    found.prepare(shape.0, shape.1, OUTPUTS.with_sigma(true));
    engine.smooth(&admitted, found.as_mut()).unwrap();
    let mut expected = found.clone();
    let (threads, mut buffers) = (Threads::open(Some(1)).unwrap(), SigmaBuffers::default());
    Sigma { geometry, params }.estimate(frame, &mut expected, &threads, &mut buffers);
    let (found_m, expected_m) = (found.sigma.as_ref().unwrap(), expected.sigma.as_ref().unwrap());
    let mut finite = 0;
    for (i, (found, expected)) in found_m.iter().zip(expected_m).enumerate() {
        assert_eq!(found.is_nan(), expected.is_nan(), "{name} {i}");
        finite += usize::from(found.is_finite());
        assert!(found.is_nan() || (found - expected).abs() <= 2e-3 * expected, "{name} {i}: {found} {expected}");
    }
    assert!(finite > found_m.len() / 3, "{name}: {finite} of {}", found_m.len());
    let mut batch = vec![Smoothed::default(); 3];
    engine.smooth_batch(&[admitted; 3], &mut batch).unwrap();
    let bits = |smoothed: &Smoothed| smoothed.sigma.as_ref().unwrap().iter().map(|m| m.to_bits()).collect::<Vec<_>>();
    assert!(batch.iter().all(|one| bits(one) == bits(&found)), "{name}: a batch");
}

#[test]
fn depth_of_every_kind_has_the_errors_of_the_cpu() {
    let window = Window::Fixed(WindowSize { half_width: 2, stride: 3 });
    let params = [
        ("default", FrameParams::default()),
        ("paper", FrameParams::paper()),
        ("blocks", FrameParams { window, fit: FrameParams::paper().fit, ..FrameParams::default() }),
    ];
    // The last is wider than two segments of the correlation.
    for shape in [(96, 64), (61, 43), (261, 40)] {
        let camera = Camera::new(shape, [76.8; 2], [shape.0 as f64 / 2.0, shape.1 as f64 / 2.0]);
        let frame = simulated_frame(Scene::tabletop(2), DepthNoise::default(), camera, 2, 0);
        for (name, params) in params {
            for checks in [false, true] {
                compare(name, (&frame).into_frame().unwrap(), params, checks);
            }
        }
        let depth_m: Vec<f32> = frame.raw.iter().map(|raw| camera.depth_m(*raw)).collect();
        let in_metres = DepthView::from_metres(&depth_m, &camera).unwrap();
        compare("metres", in_metres.into_frame().unwrap(), FrameParams::default(), false);
        let distorted =
            Camera { distortion: Distortion::from_opencv(&[0.05, -0.01, 0.0, 0.0, 0.0]).unwrap(), ..camera };
        let view = DepthView::new(&frame.raw, &distorted).unwrap();
        compare("distorted", view.into_frame().unwrap(), FrameParams::default(), false);
    }
    // Frames no larger than the largest lag along one axis.
    for shape in [(6, 40), (40, 5), (1, 30)] {
        let camera = Camera::new(shape, [525.0; 2], [0.0; 2]);
        let raw: Vec<u16> = (0..shape.0 * shape.1).map(|i| 1000 + (i * i % 7) as u16).collect();
        let view = DepthView::new(&raw, &camera).unwrap();
        compare("narrow", view.into_frame().unwrap(), FrameParams::paper(), true);
    }
}

#[test]
fn clouds_have_the_errors_of_the_cpu_wherever_their_sensor_is() {
    let camera = Camera::new((96, 64), [76.8; 2], [47.5, 31.5]);
    let frame = simulated_frame(Scene::tabletop(2), DepthNoise::default(), camera, 2, 0);
    let mut cloud = DepthView::new(&frame.raw, &camera).unwrap().deproject().unwrap();
    compare("cloud", (&cloud).into_frame().unwrap(), FrameParams::default(), false);
    // Seen by a robot from above: its z is up.
    let pose = SensorPose::from_viewpoint([0.1, -0.3, 0.6, 0.5, -0.5, 0.5, -0.5]);
    let transform = pose.transform().unwrap();
    let to_cloud = |point| transform.to_cloud(glam::Vec3::from_array(point).as_dvec3()).as_vec3().to_array();
    cloud.points.positions = cloud.points.positions.iter().map(to_cloud).collect();
    cloud.points.pose = pose;
    compare("posed", (&cloud).into_frame().unwrap(), FrameParams::default(), false);
    // A lidar in a room: its range is a distance.
    let (mut random, (across, down)) = (Random::new(3, 0), (180, 24));
    let mut points = Vec::new();
    for i in 0..across * down {
        let azimuth = std::f64::consts::TAU * (i % across) as f64 / across as f64;
        let elevation = 0.4 - 0.8 * (i / across) as f64 / down as f64;
        let ray = [azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin()];
        let wall_m = [4.0, 3.0, 1.4].into_iter().zip(ray).map(|(half, ray)| half / ray.abs().max(1e-9));
        let distance_m = wall_m.fold(f64::INFINITY, f64::min) + 0.01 * random.normal();
        points.push(ray.map(|axis| (axis * distance_m) as f32));
    }
    let lidar = OrganizedCloud::from_positions(across, down, points.into_iter().collect()).unwrap();
    let view = (&lidar).into_frame().unwrap();
    let geometry = FrameGeometry::of(view, true, &mut GeometryScratch::default());
    assert!(matches!(geometry.rule, RangeRule::Distance { .. }), "{:?}", geometry.rule);
    compare("lidar", view, FrameParams::default(), false);
}

#[test]
fn what_the_device_cannot_estimate_is_left_to_the_session() {
    let Some((_, adapter)) = device("refused standard errors") else { return };
    let options = GpuOptions::default().with_adapter(adapter.index.to_string());
    let params = EngineParams::from(FrameParams::paper());
    for outputs in [Outputs::POINTS, OUTPUTS.with_points(false).with_normals(true)] {
        let steps = DeviceSteps { sigma: true, fill_px: None, outputs: outputs.with_sigma(true) };
        assert!(!Gpu::open(params, outputs, &options, (64, 48)).unwrap().take_steps(&steps).unwrap());
    }
}
