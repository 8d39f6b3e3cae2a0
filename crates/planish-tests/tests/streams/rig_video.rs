//! Temporal smoothing of each camera of a rig.

use planish::evaluate::{RigCase, RigSuite};
use planish::rig::{RigOptions, RigSmoother, RigWay, merged_params};
use planish::simulate::{DepthNoise, DepthSimulator};
use planish::{
    Camera, Engine, FrameParams, GpuOptions, IntoFrame, Outputs, PointCloud, Session, Settings, Smoothed,
    SmootherOptions, TemporalParams, Xyz,
};
use planish_tests::data::skip;
use planish_tests::engines::test_adapter;
use planish_tests::rigs::{frames_of, rig_of};

const MOMENTS: usize = 8;

/// Returns moments of a rig at rest, with new noise in every moment.
fn moments() -> Vec<RigCase> {
    let suite = RigSuite { camera: Camera::new((160, 120), [131.25; 2], [79.5, 59.5]), ..RigSuite::new(2) };
    let first = suite.case(3).unwrap();
    let of = |t: u64| {
        let mut moment = first.clone();
        for (i, camera) in moment.cameras.iter_mut().enumerate() {
            let simulator = DepthSimulator::new(DepthNoise::default(), suite.camera, i as u64);
            camera.frame = simulator.frame(&camera.truth, t).unwrap();
        }
        moment
    };
    (0..MOMENTS as u64).map(of).collect()
}

fn outputs() -> Outputs {
    Outputs::POINTS.with_status(true).with_frames(true)
}

fn smoother(case: &RigCase, way: RigWay, options: &SmootherOptions) -> RigSmoother {
    let params = vec![FrameParams::default(); case.cameras.len()];
    RigSmoother::new(&rig_of(case), way, &params, merged_params(), options).unwrap()
}

fn over_time(case: &RigCase, way: RigWay, options: &SmootherOptions) -> RigSmoother {
    smoother(case, way, options).with_temporal(Some(TemporalParams::STEADY), false)
}

fn landed(results: planish::rig::RigResults) -> Vec<Smoothed> {
    results.into_iter().map(|result| result.unwrap().unwrap()).collect()
}

fn same(a: &Xyz, b: &Xyz) -> bool {
    a.iter().zip(b.iter()).all(|(a, b)| a.map(f32::to_bits) == b.map(f32::to_bits) || a[2].is_nan() && b[2].is_nan())
}

/// Returns the RMS distance in metres to the mean depth over the second half of the moments, for one camera.
fn wander_m(results: &[Smoothed]) -> f64 {
    let half = &results[MOMENTS / 2..];
    let (mut sum, mut count) = (0.0, 0.0);
    for i in 0..half[0].points.len() {
        let z: Vec<f64> = half.iter().map(|smoothed| f64::from(smoothed.points.z()[i])).collect();
        let mean = z.iter().sum::<f64>() / z.len() as f64;
        let square = z.iter().map(|z| (z - mean).powi(2)).sum::<f64>();
        // Skip pixels at edges, whose depth jumps.
        if square.is_finite() && square < 1e-4 {
            (sum, count) = (sum + square, count + z.len() as f64);
        }
    }
    (sum / count).sqrt()
}

#[test]
fn each_camera_has_the_video_of_a_session_of_its_own() {
    let moments = moments();
    let options = SmootherOptions::new(Engine::Cpu, outputs());
    let mut rig = over_time(&moments[0], RigWay::Each, &options);
    let settings: Settings = "engine=cpu temporal=steady".parse().unwrap();
    let session = || {
        let mut session = Session::new(settings.clone()).unwrap();
        session.set_outputs(outputs());
        session
    };
    let mut sessions = [session(), session()];
    for (t, moment) in moments.iter().enumerate() {
        let mut frames = frames_of(moment);
        // A camera that misses a moment continues its video.
        if t == 5 {
            frames[1] = None;
        }
        rig.set_moment_time(Some(t as f64 / 30.0));
        let results = rig.smooth(&frames).unwrap();
        for ((session, frame), result) in sessions.iter_mut().zip(&frames).zip(results) {
            let Some(frame) = *frame else { continue };
            let (mut alone, found) = (Smoothed::default(), result.unwrap().unwrap());
            session.set_frame_time(Some(t as f64 / 30.0));
            session.smooth(frame, &mut alone).unwrap();
            assert!(same(&found.points, &alone.points), "moment {t}");
            assert_eq!((&found.status, &found.frames), (&alone.status, &alone.frames));
            assert!(found.normals.is_none() && found.depth_m.is_none());
        }
    }
    // Videos restart after a gap in time, and when `restart_videos` is called.
    for restart in [false, true] {
        let newest = |rig: &mut RigSmoother, moment: &RigCase| {
            let result = landed(rig.smooth(&frames_of(moment)).unwrap());
            result[0].frames.as_ref().unwrap().iter().fold(0.0f32, |most, frames| most.max(*frames))
        };
        rig.set_moment_time(Some(1000.0));
        if restart {
            rig.restart_videos();
        }
        assert_eq!(newest(&mut rig, &moments[0]), 1.0);
        rig.set_moment_time(Some(1000.03));
        assert!(newest(&mut rig, &moments[1]) > 1.9);
    }
}

#[test]
fn every_way_is_steadier_over_time() {
    let moments = moments();
    let options = SmootherOptions::new(Engine::Cpu, outputs());
    for way in RigWay::ALL {
        let run = |mut rig: RigSmoother| -> Vec<Smoothed> {
            moments.iter().map(|moment| landed(rig.smooth(&frames_of(moment)).unwrap()).remove(0)).collect()
        };
        let (space, time) = (
            run(smoother(&moments[0], way, &SmootherOptions::new(Engine::Cpu, Outputs::POINTS))),
            run(over_time(&moments[0], way, &options)),
        );
        let (before_m, after_m) = (wander_m(&space), wander_m(&time));
        assert!(after_m < 0.6 * before_m, "{}: {before_m} {after_m}", way.name());
        let frames = time[MOMENTS - 1].frames.as_ref().unwrap();
        let many = frames.iter().filter(|&&frames| frames > 6.0).count();
        assert!(2 * many > frames.len(), "{}: {many} of {}", way.name(), frames.len());
    }
}

#[test]
fn moments_in_flight_are_smoothed_over_time_in_their_order_and_fused_with_their_frames() {
    let Some(adapter) = test_adapter() else { return skip("no Vulkan adapter") };
    let moments = moments();
    let gpu =
        SmootherOptions::new(Engine::Gpu, outputs()).with_gpu(GpuOptions::default().with_adapter(adapter.name.clone()));
    for options in [gpu, SmootherOptions::new(Engine::Cpu, outputs())] {
        let mut one_by_one = over_time(&moments[0], RigWay::Each, &options);
        let expected: Vec<Vec<Smoothed>> =
            moments.iter().map(|moment| landed(one_by_one.smooth(&frames_of(moment)).unwrap())).collect();
        let mut in_flight = over_time(&moments[0], RigWay::Each, &options);
        let mut found = Vec::new();
        for moment in &moments {
            if in_flight.in_flight() >= in_flight.max_in_flight() {
                found.push(landed(in_flight.receive().unwrap().unwrap()));
            }
            in_flight.submit(&frames_of(moment)).unwrap();
        }
        while let Some(results) = in_flight.receive().unwrap() {
            found.push(landed(results));
        }
        assert_eq!(found.len(), MOMENTS);
        for (found, expected) in found.iter().flatten().zip(expected.iter().flatten()) {
            assert!(same(&found.points, &expected.points) && found.frames == expected.frames);
        }
        let mut fusing = over_time(&moments[0], RigWay::Each, &options);
        let mut fused = PointCloud::new(Xyz::default());
        let mut count = 0;
        for moment in &moments {
            count += usize::from(fusing.next_fused(&frames_of(moment), &mut fused).unwrap());
        }
        while fusing.receive_fused(&mut fused).unwrap() {
            count += 1;
        }
        assert_eq!(count, MOMENTS);
        let Some(planish::AttributeValues::F32(frames)) = fused.attribute("frames").map(|field| &field.values) else {
            panic!("the field frames")
        };
        let of_last = expected[MOMENTS - 1].iter().flat_map(|smoothed| smoothed.frames.as_ref().unwrap());
        assert_eq!(*frames, of_last.copied().filter(|&frames| frames > 0.0).collect::<Vec<_>>());
    }
}

#[test]
fn voxels_and_frames_without_a_video_are_refused() {
    let case = RigSuite::new(2).case(1).unwrap();
    let rig = rig_of(&case);
    let settings: Settings = "engine=cpu temporal=steady".parse().unwrap();
    let options = RigOptions::from_settings(&rig, RigWay::Merged, &settings, Some(0.005)).unwrap();
    assert!(options.validate().unwrap_err().to_string().contains("voxels"));
    RigOptions::from_settings(&rig, RigWay::Merged, &settings, None).unwrap().validate().unwrap();
    let options = SmootherOptions::new(Engine::Cpu, outputs());
    let error = smoother(&case, RigWay::Each, &options).smooth(&frames_of(&case)).unwrap_err();
    assert!(error.to_string().contains("temporal"), "{error}");
    assert!(case.cameras[0].frame.into_frame().is_ok());
}
