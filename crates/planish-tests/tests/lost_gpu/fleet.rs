//! Fleets of a GPU and the CPU, and their frames after the loss of the GPU.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use planish::internal::lose_gpu_devices;
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::source::{OwnedFrame, Source};
use planish::stream::{Sink, Stream, StreamEvent, StreamFrame, StreamOptions};
use planish::{
    DepthFrame, Engine, Error, Fleet, FleetDevice, FrameParams, Outputs, Smoothed, Smoother, SmootherOptions, Xyz,
};
use planish_tests::data::skip;
use planish_tests::engines::test_adapter;
use planish_tests::scenes::small_camera;

const FRAMES: usize = 40;

/// Returns different frames of one scene, and the CPU's result for each.
fn frames() -> Vec<(Arc<DepthFrame>, Xyz)> {
    let camera = small_camera();
    let (scene, pose) = Scene::tabletop(3);
    let truth = scene.render(&camera, &pose);
    let simulator = DepthSimulator::new(DepthNoise::default(), camera, 3);
    let options = SmootherOptions::new(Engine::Cpu, Outputs::POINTS);
    let mut smoother = Smoother::open_with(params(), &options, (camera.width, camera.height)).unwrap();
    let frame = |i: u64| {
        let frame = simulator.frame(&truth, i).unwrap();
        let mut smoothed = Smoothed::default();
        smoother.smooth(&frame, &mut smoothed).unwrap();
        (Arc::new(frame), smoothed.points)
    };
    (0..FRAMES as u64).map(frame).collect()
}

fn params() -> FrameParams {
    FrameParams::default()
}

/// Returns true if a result belongs to the expected frame, whatever the engine. The noise of other frames is a
/// thousand times the tolerance.
fn is_result_of(found: [&[f32]; 3], expected: &Xyz) -> bool {
    let off = found[2].iter().zip(expected.z()).filter(|(a, b)| (*a - *b).abs() > 1e-5).count();
    let holes = found[2].iter().zip(expected.z()).filter(|(a, b)| a.is_nan() != b.is_nan()).count();
    100 * (off + holes) < expected.len()
}

/// Plays frames repeatedly until a warning is reported or 30 s have passed. Then it finishes the round and plays all
/// frames once more.
struct Recorded {
    frames: Vec<Arc<DepthFrame>>,
    next: usize,
    told: Arc<AtomicBool>,
    last: Option<usize>,
    start: Instant,
}

impl Source for Recorded {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        let is_over = self.told.load(Ordering::Relaxed) || self.start.elapsed() > Duration::from_secs(30);
        if is_over {
            self.last.get_or_insert(self.next.next_multiple_of(FRAMES) + FRAMES);
        }
        if self.last.is_some_and(|last| self.next >= last) {
            return Ok(None);
        }
        let frame = &self.frames[self.next % FRAMES];
        self.next += 1;
        Ok(Some(OwnedFrame::Depth(DepthFrame::clone(frame))))
    }
}

struct Kept(Arc<Mutex<Vec<Xyz>>>);

impl Sink for Kept {
    fn name(&self) -> String {
        "kept".to_owned()
    }

    fn write(&mut self, frame: &StreamFrame) -> Result<(), Error> {
        let mut kept = self.0.lock().unwrap();
        kept.push(frame.smoothed.points.clone());
        if kept.len() == 5 {
            lose_gpu_devices();
        }
        Ok(())
    }
}

#[test]
fn a_gpu_and_the_cpu_share_frames_and_a_lost_gpu_leaves_its_own_to_the_cpu() {
    let _alone = crate::alone();
    let Some(adapter) = test_adapter() else {
        skip("a fleet with a GPU: no adapter");
        return;
    };
    let frames = frames();
    let devices = [FleetDevice::Gpu(adapter.index.to_string()), FleetDevice::Cpu];
    let shape = (frames[0].0.camera.width, frames[0].0.camera.height);
    let mut fleet = Fleet::open(params(), &SmootherOptions::default(), &devices, shape).unwrap();
    assert_eq!(fleet.engine(), Engine::Gpu);
    let (mut submitted, mut received, start) = (0, 0, Instant::now());
    // The fleet retries a device that it left out as too slow only after a second, and only then notices the loss.
    while received < FRAMES || fleet.in_flight() > 0 || fleet.members()[0].lost.is_none() {
        assert!(start.elapsed() < Duration::from_secs(30), "{:?}", fleet.members());
        let is_enough = submitted >= FRAMES && fleet.members()[0].lost.is_some();
        if !is_enough && fleet.in_flight() < fleet.max_in_flight() {
            let frame = Arc::clone(&frames[submitted % FRAMES].0);
            if submitted % 2 == 0 {
                fleet.submit(frame, Smoothed::default()).unwrap();
            } else {
                fleet.submit_in_place(frame).unwrap();
            }
            submitted += 1;
            continue;
        }
        let view = fleet.receive().unwrap().unwrap();
        assert!(is_result_of(view.points().unwrap(), &frames[received % FRAMES].1), "frame {received}");
        received += 1;
        if received == FRAMES / 2 {
            let members = fleet.members();
            assert!(members.iter().all(|member| member.frames > 0), "{members:?}");
            lose_gpu_devices();
        }
    }
    assert_eq!(received, submitted);
    let members = fleet.members();
    assert!(members[0].lost.is_some() && members[1].lost.is_none(), "{members:?}");
    assert_eq!(fleet.engine(), Engine::Cpu);
    drop(fleet);

    // A stream reports the loss and loses no frame.
    let kept = Arc::new(Mutex::new(Vec::new()));
    let told = Arc::new(AtomicBool::new(false));
    let source = Recorded {
        frames: frames.iter().map(|(frame, _)| Arc::clone(frame)).collect(),
        next: 0,
        told: Arc::clone(&told),
        last: None,
        start: Instant::now(),
    };
    let options = StreamOptions::new(params(), SmootherOptions::default()).with_devices(devices.to_vec());
    let mut warnings = Vec::new();
    let sinks: Vec<Box<dyn Sink>> = vec![Box::new(Kept(Arc::clone(&kept)))];
    let statistics = Stream::new(Box::new(source), options)
        .with_sinks(sinks)
        .with_events(|event| {
            if let StreamEvent::Warning(warning) = event {
                warnings.push(warning);
                told.store(true, Ordering::Relaxed);
            }
        })
        .run();
    let statistics = statistics.unwrap();
    assert_eq!((statistics.frames_out, statistics.dropped, statistics.unreadable), (statistics.frames_in, 0, 0));
    let kept = kept.lock().unwrap();
    for (i, (found, (_, expected))) in kept.iter().zip(frames.iter().cycle()).enumerate() {
        assert!(is_result_of(found.as_slices(), expected), "frame {i}");
    }
    assert!(kept.len() >= 2 * FRAMES && kept.len() as u64 == statistics.frames_in, "{}", kept.len());
    assert!(warnings.iter().any(|warning| warning.contains("continuing on one device")), "{warnings:?}");
    assert_eq!(statistics.engine, Engine::Cpu);
}
