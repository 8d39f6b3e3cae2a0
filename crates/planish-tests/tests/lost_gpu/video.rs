//! A video that loses its GPU, and thus its state, while frames are in flight.

use std::sync::Arc;

use planish::internal::lose_gpu_devices;
use planish::simulate::{DepthNoise, Event, Sequence};
use planish::{Camera, DepthFrame, Engine, GpuOptions, Outputs, SensorPose, Session, Smoothed, SmootherOptions};
use planish_tests::data::skip;
use planish_tests::engines::test_adapter;

#[test]
fn a_video_starts_again_on_what_takes_over_and_no_result_lacks_an_output() {
    let _alone = crate::alone();
    let Some(adapter) = test_adapter() else {
        skip("a video whose GPU is lost: no adapter");
        return;
    };
    let camera = Camera::new((160, 120), [131.25; 2], [79.5, 59.5]);
    let mut sequence = Sequence::new(Event::MovingCamera, camera, DepthNoise::default(), 2);
    let mut frame = |number| -> (Arc<DepthFrame>, SensorPose) {
        let seen = sequence.frame(number).unwrap();
        (Arc::new(seen.frame.clone()), seen.pose.sensor_pose().unwrap())
    };
    let frames: Vec<_> = (0..9).map(&mut frame).collect();
    let gpu = GpuOptions::default().with_adapter(adapter.index.to_string());
    let outputs = Outputs::DEPTH.with_frames(true);
    let mut session = Session::new("temporal=steady engine=gpu".parse().unwrap()).unwrap();
    session = session.with_kept_window(true).with_options(SmootherOptions::new(Engine::Gpu, outputs).with_gpu(gpu));
    session.set_outputs(outputs);
    // The GPU is opened again after the first loss; after the second, the CPU takes over.
    for (group, engine) in frames.chunks(3).zip([Engine::Gpu, Engine::Cpu, Engine::Cpu]) {
        for (frame, pose) in group {
            session.set_camera_pose(Some(*pose)).unwrap();
            session.submit(Arc::clone(frame), Smoothed::default()).unwrap();
            if session.max_in_flight() == 1 {
                break;
            }
        }
        lose_gpu_devices();
        let mut averaged = Vec::new();
        while let Some(view) = session.receive().unwrap() {
            let smoothed = view.into_smoothed();
            assert!(smoothed.points.is_empty() && smoothed.status.is_none());
            let raw = smoothed.depth.as_ref().unwrap();
            assert!(raw.iter().filter(|&&raw| raw > 0).count() > raw.len() / 2);
            let counts = smoothed.frames.as_ref().unwrap();
            averaged.push(counts.iter().sum::<f32>() / counts.iter().filter(|&&count| count > 0.0).count() as f32);
        }
        // Results that were ready before the loss are kept. The next result restarts the video, and later results
        // continue it by their own poses.
        let starts = averaged.iter().filter(|&&count| count < 1.01).count();
        let going_on = averaged.iter().filter(|&&count| count > 1.5).count();
        assert!(starts <= 2 && starts + going_on == averaged.len(), "{averaged:?}");
        assert_eq!(session.engine(), Some(engine));
    }
}
