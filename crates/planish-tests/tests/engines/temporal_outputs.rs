//! Outputs of a session for frames of a video, and for frames that are not part of a video.

use planish::{
    Camera, DepthFrame, Engine, Error, FrameParams, OrganizedCloud, Outputs, Session, Settings, Smoothed, Smoother,
    SmootherOptions, Xyz,
};

use super::temporal::{HEIGHT, WIDTH, steady, video};

#[test]
fn frames_are_counted_only_in_videos() {
    let frame = &video(1)[0];
    let outputs = Outputs::POINTS.with_frames(true);
    let mut smoothed = Smoothed::default();
    let refused = |error: Error| {
        let message = error.to_string();
        assert!(message.contains("frames") && message.contains("temporal"), "{message}");
    };
    let mut single = Session::new(Settings::default()).unwrap();
    single.set_outputs(outputs);
    refused(single.smooth(&**frame, &mut smoothed).unwrap_err());
    // A cloud without a grid is not a frame of a video.
    let mut session = Session::new(steady("cpu")).unwrap();
    session.set_outputs(outputs);
    session.smooth(&**frame, &mut smoothed).unwrap();
    assert!(smoothed.frames.as_ref().unwrap().iter().all(|&frames| frames <= 1.0));
    refused(session.smooth(&frame.deproject().unwrap().points, &mut smoothed).unwrap_err());
    let options = SmootherOptions::new(Engine::Cpu, outputs);
    refused(Smoother::open_with(FrameParams::default(), &options, (WIDTH, HEIGHT)).unwrap_err());
}

#[test]
fn results_of_other_shapes_and_of_frames_without_ranges_are_complete() {
    let outputs = Outputs::DEPTH.with_frames(true);
    let mut session = Session::new(steady("cpu")).unwrap();
    session.set_outputs(outputs);
    let mut smoothed = Smoothed::default();
    for width in [16, 64, 32, 160] {
        let camera = Camera::new((width, width), [100.0; 2], [0.5 * width as f64; 2]);
        let frame = DepthFrame::new(camera, vec![1500; width * width]).unwrap();
        session.smooth(&frame, &mut smoothed).unwrap();
        assert_eq!(smoothed.depth.as_ref().unwrap().len(), width * width);
        assert!(smoothed.frames.as_ref().unwrap().iter().all(|&frames| frames == 1.0));
    }
    // Terrain seen from above has no sensor from which ranges could be measured. Here it follows a camera's cloud.
    session.set_outputs(Outputs::POINTS.with_frames(true));
    let seen = |width: usize, height: usize, point: &dyn Fn(f32, f32) -> [f32; 3]| {
        let points: Xyz = (0..width * height).map(|i| point((i % width) as f32, (i / width) as f32)).collect();
        OrganizedCloud::from_positions(width, height, points).unwrap()
    };
    let of_camera = seen(64, 48, &|u, v| [0.01 * (u - 32.0) * 2.0, 0.01 * (v - 24.0) * 2.0, 2.0 + 0.001 * u]);
    let terrain = seen(128, 96, &|u, v| [0.5 * (u - 64.0), 0.5 * (v - 48.0), 0.2 * (0.1 * u).sin() + 0.01 * v]);
    for cloud in [&of_camera, &of_camera, &terrain, &terrain, &of_camera] {
        session.smooth(cloud, &mut smoothed).unwrap();
        let frames = smoothed.frames.as_ref().unwrap();
        assert_eq!(frames.len(), cloud.points.len());
        assert!(cloud.width() == 64 || frames.iter().all(|&frames| frames <= 1.0));
    }
}
