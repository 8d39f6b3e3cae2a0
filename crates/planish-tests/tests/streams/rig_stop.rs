//! A rig's stream that is stopped while it smooths all points as one cloud abandons that moment.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use planish::evaluate::RigSuite;
use planish::rig::{RigOptions, RigStream, RigWay, merged_params};
use planish::source::{OwnedFrame, Source};
use planish::{Camera, DepthFrame, Engine, Error, Outputs, SmootherOptions};
use planish_tests::rigs::rig_of;

/// Delivers one frame, and reports that it was requested.
struct Once {
    frame: Option<DepthFrame>,
    has_given: Arc<AtomicBool>,
}

impl Source for Once {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        self.has_given.store(true, Ordering::Relaxed);
        Ok(self.frame.take().map(OwnedFrame::Depth))
    }

    fn is_live(&self) -> bool {
        false
    }
}

#[test]
fn a_moment_of_merged_points_is_given_up_when_the_stream_is_stopped() {
    let camera = Camera::new((320, 240), [262.5; 2], [159.5, 119.5]);
    let case = RigSuite { camera, ..RigSuite::new(2) }.case(1).unwrap();
    let rig = rig_of(&case);
    let (has_given, stop) = (Arc::new(AtomicBool::new(false)), AtomicBool::new(false));
    let source = |frame: &DepthFrame| -> Box<dyn Source> {
        Box::new(Once { frame: Some(frame.clone().with_timestamp_s(0.0)), has_given: Arc::clone(&has_given) })
    };
    let sources = case.cameras.iter().map(|camera| source(&camera.frame)).collect();
    // With a radius of 30 cm, smoothing takes minutes.
    let options = RigOptions::new(&rig, RigWay::Merged, SmootherOptions::new(Engine::Cpu, Outputs::POINTS));
    let params = options.params.clone();
    let options = options.with_params(params, merged_params().with_radius_m(0.3));
    let statistics = thread::scope(|scope| {
        scope.spawn(|| {
            while !has_given.load(Ordering::Relaxed) {
                thread::sleep(Duration::from_millis(1));
            }
            // After half a second, the moment is being smoothed.
            thread::sleep(Duration::from_millis(500));
            stop.store(true, Ordering::Relaxed);
        });
        RigStream::new(&rig, sources, options).with_stop(&stop).run().unwrap()
    });
    assert_eq!(statistics.moments.frames_out, 0);
}
