//! A stream whose GPU is lost.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::stream::{self, Sink, StreamEvent, StreamFrame, StreamOptions};
use planish::{Engine, Error, FrameParams, GpuOptions, SmootherOptions};
use planish_tests::data::skip;
use planish_tests::engines::test_adapter;
use planish_tests::scenes::small_camera;
use planish_tests::sources::OneByOne;

/// Counts frames and keeps their timestamps.
struct Seen(Arc<AtomicU64>, Arc<Mutex<Vec<u64>>>);

impl Sink for Seen {
    fn name(&self) -> String {
        "seen".to_owned()
    }

    fn write(&mut self, frame: &StreamFrame) -> Result<(), Error> {
        assert_eq!(frame.smoothed.points.len(), 160 * 120);
        self.1.lock().unwrap().push(frame.source.timestamp_s().unwrap() as u64);
        self.0.fetch_add(1, Ordering::Relaxed);
        Ok(())
    }
}

#[test]
fn a_lost_gpu_is_opened_once_more_and_then_the_cpu_takes_over_in_order() {
    let _alone = crate::alone();
    let Some(adapter) = test_adapter() else {
        skip("a stream whose GPU is lost: no adapter");
        return;
    };
    let camera = small_camera();
    let (scene, pose) = Scene::tabletop(1);
    let truth = scene.render(&camera, &pose);
    let frame = DepthSimulator::new(DepthNoise::default(), camera, 1).frame(&truth, 0).unwrap();
    let (count, results) = (Arc::new(AtomicU64::new(0)), Arc::new(Mutex::new(Vec::new())));
    let source = OneByOne::new(frame, 9, Arc::clone(&count)).losing_gpus_before(&[3, 6]);
    let gpu = GpuOptions::default().with_adapter(adapter.index.to_string());
    let options =
        StreamOptions::new(FrameParams::default(), SmootherOptions::default().with_engine(Engine::Gpu).with_gpu(gpu));
    let (mut warnings, gpu_frames) = (Vec::new(), AtomicU64::new(0));
    let tell = |event: StreamEvent<'_>| match event {
        StreamEvent::Warning(warning) => warnings.push(warning),
        StreamEvent::Frame(statistics) => {
            gpu_frames.fetch_add(u64::from(statistics.engine == Engine::Gpu), Ordering::Relaxed);
        }
        _ => {}
    };
    let sinks: Vec<Box<dyn Sink>> = vec![Box::new(Seen(count, Arc::clone(&results)))];
    let statistics = stream::Stream::new(Box::new(source), options).with_sinks(sinks).with_events(tell).run().unwrap();
    assert_eq!(*results.lock().unwrap(), (0..9).collect::<Vec<_>>());
    assert_eq!((statistics.frames_out, statistics.engine), (9, Engine::Cpu));
    assert!(warnings.len() == 2 && warnings[1].contains("CPU"), "{warnings:?}");
    assert!(gpu_frames.load(Ordering::Relaxed) >= 6);
}
