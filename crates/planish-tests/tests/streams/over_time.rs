//! Reports of streams with temporal smoothing.

use planish::Camera;
use planish::simulate::{DepthNoise, Event, Sequence};
use planish::stream::{Frames, StreamOptions};

use super::stream::{Given, Seen, run};

#[test]
fn a_stream_over_time_reports_how_much_less_it_flickers() {
    let still = || Given::frames(14);
    let off = StreamOptions::from_settings("engine=cpu".parse().unwrap()).unwrap();
    let steady = StreamOptions::from_settings("engine=cpu temporal=steady".parse().unwrap()).unwrap();
    let (statistics, _) = run(still(), &off, Seen::default());
    assert!(statistics.flicker.is_none());
    let mut seen = Vec::new();
    for frame in Frames::start(Box::new(still()), steady.clone()).unwrap() {
        let frame = frame.unwrap();
        // Only points were requested.
        assert!(frame.smoothed.frames.is_none() && frame.smoothed.status.is_none());
        seen.push(frame.flicker);
    }
    assert!(seen.len() == 14 && seen[0].is_none());
    let last = seen[13].unwrap();
    assert!(last.smoothed_m < 0.25 * last.measured_m && last.restarted < 0.02, "{last:?}");
    let (statistics, _) = run(still(), &steady, Seen::default());
    let mean = statistics.flicker.unwrap();
    assert!(mean.smoothed_m < 0.4 * mean.measured_m && mean.smoothed_m > last.smoothed_m, "{mean:?}");
    // A camera that moves without a known pose is detected, although each point averages a little of its past.
    let camera = Camera::new((320, 240), [262.5; 2], [159.5, 119.5]);
    let mut moving = Sequence::new(Event::MovingCamera, camera, DepthNoise::default(), 2);
    let frames = (0..12).map(|number| Ok(moving.frame(number).unwrap().frame.clone())).collect();
    let (statistics, _) = run(Given::new(frames), &steady, Seen::default());
    let of_moving = statistics.flicker.unwrap();
    assert!(of_moving.looks_like_a_moving_camera() && !mean.looks_like_a_moving_camera(), "{of_moving:?}");
    // The median depth is 0.9 m, where the noise of a Kinect v1 is about 2 mm.
    assert!((0.5e-3..4e-3).contains(&mean.measured_m), "{mean:?}");
    assert!((0.0..0.02).contains(&mean.carried), "{mean:?}");
}
