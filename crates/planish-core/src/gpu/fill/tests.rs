//! Compares the device's filled holes with the CPU's, which are computed from the same result.

use super::super::engine::Gpu;
use super::super::tests::device;
use crate::camera::Camera;
use crate::devices::{GpuOptions, Transfer};
use crate::fill::{Fill, FillBuffers};
use crate::frame::{DepthFrame, DepthView, Frame, FrameGeometry, GeometryScratch, IntoFrame};
use crate::outputs::Outputs;
use crate::params::{EngineParams, FrameParams};
use crate::sensor::SensorModel;
use crate::sigma::{Sigma, SigmaBuffers};
use crate::smoothed::Smoothed;
use crate::smoothing_engine::{AdmittedFrame, DeviceSteps, SmoothingEngine};
use crate::status::Status;
use crate::testing::{DepthNoise, Random, Scene, simulated_frame};
use crate::threads::Threads;

const OUTPUTS: Outputs = Outputs::ALL.with_depth(true).with_depth_m(true);

/// Returns a frame with round holes of many sizes, single missing pixels, and a missing strip at a border.
fn frame_with_holes(camera: Camera, seed: u64) -> DepthFrame {
    let mut frame = simulated_frame(Scene::tabletop(seed), DepthNoise::default(), camera, seed, 0);
    let (mut random, (width, height)) = (Random::new(seed, 1), (camera.width, camera.height));
    for hole in 0..40 {
        let [x, y] = [width, height].map(|size| random.uniform() * size as f64);
        let radius_px = 1.0 + 9.0 * random.uniform() * f64::from(hole % 3);
        for v in 0..height {
            for u in 0..width {
                if (u as f64 - x).hypot(1.4 * (v as f64 - y)) < radius_px || u < 4 {
                    frame.raw[v * width + u] = 0;
                }
            }
        }
    }
    for _ in 0..width * height / 50 {
        let i = (random.uniform() * frame.raw.len() as f64) as usize;
        frame.raw[i] = 0;
    }
    frame
}

/// The results of a frame: filled by the device, filled by the CPU, and unfilled.
struct Results {
    found: Smoothed,
    expected: Smoothed,
    unfilled: Smoothed,
}

/// Fills the holes of a frame on both sides. Checks that every frame of a batch has the same result as a single frame.
/// Returns `None` without a device.
fn fill(frame: Frame<'_>, params: FrameParams, width_px: u32, options: GpuOptions) -> Option<Results> {
    let (_, adapter) = device("filled holes")?;
    let options = options.with_adapter(adapter.index.to_string());
    let (params, shape) = (EngineParams::from(params), frame.grid().unwrap());
    let mut engine = Gpu::open(params, OUTPUTS, &options, shape).unwrap();
    let geometry = FrameGeometry::of(frame, true, &mut GeometryScratch::default());
    let admitted = AdmittedFrame::new(frame, geometry);
    let outputs = OUTPUTS.with_sigma(true);
    let mut expected = Smoothed::default();
    expected.prepare(shape.0, shape.1, outputs);
    engine.smooth(&admitted, expected.as_mut()).unwrap();
    let unfilled = expected.clone();
    let threads = Threads::open(Some(1)).unwrap();
    Sigma { geometry, params }.estimate(frame, &mut expected, &threads, &mut SigmaBuffers::default());
    let fill = Fill { width_px, geometry, sensor: params.sensor, frame };
    assert!(fill.apply(&mut expected, &mut FillBuffers::default(), &threads));

    let steps = DeviceSteps { sigma: true, fill_px: Some(width_px), outputs };
    assert!(steps.finish(&frame) && engine.take_steps(&steps).unwrap());
    let mut found = Smoothed::default();
    found.prepare(shape.0, shape.1, outputs);
    engine.smooth(&admitted, found.as_mut()).unwrap();
    let mut batch = vec![Smoothed::default(); 3];
    engine.smooth_batch(&[admitted; 3], &mut batch).unwrap();
    let bits = |smoothed: &Smoothed| -> Vec<u32> {
        let values = smoothed.points.as_slices().into_iter().chain(smoothed.sigma.as_deref());
        values.flatten().map(|value| value.to_bits()).collect()
    };
    assert!(batch.iter().all(|one| bits(one) == bits(&found) && one.status == found.status), "a batch");
    Some(Results { found, expected, unfilled })
}

/// Compares which pixels are filled and their values.
fn compare(name: &str, frame: Frame<'_>, params: FrameParams, width_px: u32, options: GpuOptions) {
    let Some(Results { found, expected, unfilled }) = fill(frame, params, width_px, options) else { return };
    let status = |smoothed: &Smoothed| smoothed.status.clone().unwrap();
    let (found_status, expected_status) = (status(&found), status(&expected));
    let count = |status: &[Status]| status.iter().filter(|status| **status == Status::Filled).count();
    let filled = count(&expected_status);
    let different = found_status.iter().zip(&expected_status).filter(|(a, b)| a != b).count();
    // A value within rounding of a limit may be filled by one side only.
    assert!(200 * different <= filled, "{name}: {different} of {filled} filled pixels differ");
    assert!(filled > 20, "{name}: {filled} pixels");
    let value = |values: &Option<Vec<f32>>, i: usize| values.as_ref().unwrap()[i];
    let dot = |a: [f32; 3], b: [f32; 3]| (0..3).map(|axis| a[axis] * b[axis]).sum::<f32>();
    let mut far = 0;
    for i in 0..found_status.len() {
        match (found_status[i], expected_status[i]) {
            (Status::Filled, Status::Filled) => {
                let (a, b) = (found.points.get(i), expected.points.get(i));
                let off_m = dot([0, 1, 2].map(|k| a[k] - b[k]), [0, 1, 2].map(|k| a[k] - b[k])).sqrt();
                let sigma = [&found.sigma, &expected.sigma].map(|sigma| value(sigma, i));
                let normals = [&found.normals, &expected.normals].map(|normals| normals.as_ref().unwrap().get(i));
                let is_near = off_m <= 1e-4 * b[2]
                    && (sigma[0] - sigma[1]).abs() <= 2e-2 * sigma[1]
                    && dot(normals[0], normals[1]) > 0.9999;
                far += usize::from(!is_near);
                assert_eq!(value(&found.depth_m, i), a[2], "{name} {i}");
                let curvature = [&found.curvature, &expected.curvature].map(|curvature| value(curvature, i));
                assert_eq!(curvature[0].is_nan(), curvature[1].is_nan(), "{name} {i}");
            }
            (one, other) if one == other => {
                let bits = |smoothed: &Smoothed| smoothed.points.get(i).map(f32::to_bits);
                assert_eq!((bits(&found), one), (bits(&unfilled), status(&unfilled)[i]), "{name} {i}");
            }
            _ => {}
        }
    }
    // Gaps next to a pixel that only one side filled get other values.
    assert!(100 * far <= filled, "{name}: {far} of {filled} filled pixels are far from the CPU's");
}

#[test]
fn holes_are_filled_as_on_the_cpu() {
    let kinect = FrameParams { sensor: SensorModel::KINECT_V1, ..FrameParams::default() };
    let flight = FrameParams { sensor: SensorModel::AZURE_KINECT, ..FrameParams::default() };
    for (shape, seed) in [((160, 120), 1), ((161, 90), 2), ((97, 61), 3)] {
        let camera = Camera::new(shape, [0.8 * shape.0 as f64; 2], [shape.0 as f64 / 2.0, shape.1 as f64 / 2.0]);
        let frame = frame_with_holes(camera, seed);
        let view = || (&frame).into_frame().unwrap();
        for checks in [false, true] {
            let options = GpuOptions::default().with_bounds_checks(checks);
            compare("kinect", view(), kinect, 12, options.clone());
            compare("time of flight", view(), flight, 5, options);
        }
        compare("staged", view(), kinect, 64, GpuOptions::default().with_transfer(Transfer::Staged));
        let depth_m: Vec<f32> = frame.raw.iter().map(|raw| camera.depth_m(*raw)).collect();
        let in_metres = DepthView::from_metres(&depth_m, &camera).unwrap();
        compare("metres", in_metres.into_frame().unwrap(), kinect, 12, GpuOptions::default());
    }
}

/// Returns true for a column and a row of a hole.
type Mask = fn(usize, usize) -> bool;

/// Most of each hole is too wide to be filled, so the narrow rest stays open, too, if it is joined with the wide part.
#[test]
fn holes_that_are_joined_far_away_are_one_hole() {
    let kinect = FrameParams { sensor: SensorModel::KINECT_V1, ..FrameParams::default() };
    let shape @ (width, height) = (161, 110);
    let camera = Camera::new(shape, [150.0; 2], [80.0, 55.0]);
    let is_wide = |x: usize, y: usize| ((10..50).contains(&x) || (110..150).contains(&x)) && (5..45).contains(&y);
    // Taller than the number of rows that are climbed at once.
    let narrow: [(&str, Mask); 3] = [
        ("corners to the right", |x, y| x + y == 154 && (45..96).contains(&y)),
        ("corners to the left", |x, y| x == y + 5 && (45..96).contains(&y)),
        ("teeth", |x, y| {
            let is_tooth = (122..125).contains(&x) || (70..73).contains(&x) && y > 50;
            is_tooth && (45..101).contains(&y) || (70..125).contains(&x) && (98..101).contains(&y)
        }),
    ];
    for (name, narrow) in narrow {
        let raw = |i: usize| {
            let (x, y) = (i % width, i / width);
            let is_small = x % 20 > 17 && (104..106).contains(&y);
            if is_wide(x, y) || narrow(x, y) || is_small { 0 } else { 1500 + (2 * x + i * i % 5) as u16 }
        };
        let frame = DepthFrame::new(camera, (0..width * height).map(raw).collect()).unwrap();
        compare(name, (&frame).into_frame().unwrap(), kinect, 8, GpuOptions::default());
    }
}

#[test]
fn frames_of_any_shape_and_with_any_holes_are_filled() {
    let kinect = FrameParams { sensor: SensorModel::KINECT_V1, ..FrameParams::default() };
    for shape @ (width, height) in [(1, 40), (40, 1), (2, 2), (33, 9), (5, 70)] {
        let camera = Camera::new(shape, [100.0; 2], [0.5 * width as f64, 0.5 * height as f64]);
        for missing in [0, 1, 7, 100] {
            let is_hole = |i: usize| (i * 37 + i / 5) % 100 < missing;
            let raw = (0..width * height).map(|i| if is_hole(i) { 0 } else { 1500 + (i % 3) as u16 }).collect();
            let frame = DepthFrame::new(camera, raw).unwrap();
            let options = GpuOptions::default().with_bounds_checks(true);
            let Some(results) = fill((&frame).into_frame().unwrap(), kinect, 9, options) else { return };
            assert_eq!(results.found.status, results.expected.status, "{shape:?} {missing}");
        }
    }
}

#[test]
fn only_requested_outputs_are_returned() {
    let Some((_, adapter)) = device("requested outputs") else { return };
    let options = GpuOptions::default().with_adapter(adapter.index.to_string());
    let camera = Camera::new((160, 120), [128.0; 2], [80.0, 60.0]);
    let frame = frame_with_holes(camera, 4);
    let view = (&frame).into_frame().unwrap();
    let geometry = FrameGeometry::of(view, true, &mut GeometryScratch::default());
    let params = EngineParams::from(FrameParams::default());
    let results = [OUTPUTS, Outputs::DEPTH.with_status(true)].map(|outputs| {
        let mut engine = Gpu::open(params, OUTPUTS, &options, (160, 120)).unwrap();
        assert!(engine.take_steps(&DeviceSteps { sigma: false, fill_px: Some(9), outputs }).unwrap());
        let mut batch = [Smoothed::default(), Smoothed::default()];
        engine.smooth_batch(&[AdmittedFrame::new(view, geometry); 2], &mut batch).unwrap();
        let [smoothed, again] = batch;
        assert_eq!((&smoothed.depth, &smoothed.status), (&again.depth, &again.status));
        smoothed
    });
    let [all, depth] = results;
    assert!(all.has_filled() && depth.points.is_empty() && depth.normals.is_none());
    assert_eq!((depth.depth, depth.status), (all.depth, all.status));
}
