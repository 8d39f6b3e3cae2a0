//! Streams from sources to sinks: order, counts, and failures on the way.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use planish::internal::{disparity_depth_m, write_freenect_recording};
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::source::{FileSource, FreenectRecording, OwnedFrame, Paced, Source, TumRecorder, TumSource};
use planish::stream::{self, FolderSink, Sink, SinkFormat, StreamEvent, StreamFrame, StreamOptions, StreamStatistics};
use planish::{
    Camera, DepthFrame, Engine, Error, FrameParams, OrganizedCloud, Outputs, Smoothed, Smoother, SmootherOptions, Xyz,
};
use planish_tests::data::{folder, skip};
use planish_tests::engines::{TestEngine, test_adapter};
use planish_tests::scenes::small_camera;

fn frame(camera: Camera, number: u64) -> DepthFrame {
    let (scene, pose) = Scene::tabletop(1);
    let truth = scene.render(&camera, &pose);
    let mut frame = DepthSimulator::new(DepthNoise::default(), camera, 1).frame(&truth, number).unwrap();
    frame.timestamp_s = Some(number as f64);
    frame
}

/// A source that delivers the given frames and errors, and calls a function with each frame's number.
pub struct Given(std::vec::IntoIter<Result<DepthFrame, &'static str>>, Box<dyn FnMut(u64) + Send>, u64);

impl Given {
    pub fn frames(count: u64) -> Self {
        Self::new((0..count).map(|i| Ok(frame(small_camera(), i))).collect())
    }

    pub fn new(frames: Vec<Result<DepthFrame, &'static str>>) -> Self {
        Self(frames.into_iter(), Box::new(|_| ()), 0)
    }
}

impl Source for Given {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        (self.1)(self.2);
        self.2 += 1;
        match self.0.next() {
            None => Ok(None),
            Some(Ok(frame)) => Ok(Some(OwnedFrame::Depth(frame))),
            Some(Err(missing)) => Err(planish::io::read(Path::new(missing)).unwrap_err().into()),
        }
    }
}

/// A sink that keeps the index and timestamp of each frame; it may delay every frame, and fail at one of them.
#[derive(Default, Clone)]
pub struct Seen {
    frames: Arc<Mutex<Vec<(u64, f64)>>>,
    fails_at: Option<u64>,
    takes: Duration,
}

impl Sink for Seen {
    fn name(&self) -> String {
        "a sink that sees".to_owned()
    }

    fn write(&mut self, frame: &StreamFrame) -> Result<(), Error> {
        std::thread::sleep(self.takes);
        if self.fails_at == Some(frame.index) {
            return Err(planish::io::read(Path::new("/there is none")).unwrap_err().into());
        }
        assert!(frame.smoothed.status_counts().is_none_or(|counts| counts[4] > 0));
        self.frames.lock().unwrap().push((frame.index, frame.source.timestamp_s().unwrap()));
        Ok(())
    }
}

fn options(engine: Engine) -> StreamOptions {
    let smoother = match engine {
        Engine::Gpu => TestEngine::gpu(true).options(Outputs::POINTS),
        engine => SmootherOptions::default().with_engine(engine),
    };
    StreamOptions::new(FrameParams::default(), smoother)
}

pub fn run(source: impl Source + 'static, options: &StreamOptions, sink: Seen) -> (StreamStatistics, Vec<String>) {
    let mut warnings = Vec::new();
    let tell = |event: StreamEvent<'_>| {
        if let StreamEvent::Warning(warning) = event {
            warnings.push(warning);
        }
    };
    let statistics = stream::Stream::new(Box::new(source), options.clone())
        .with_sinks(vec![Box::new(sink)])
        .with_events(tell)
        .run()
        .unwrap();
    (statistics, warnings)
}

fn in_order(seen: &Seen, count: u64) {
    let expected: Vec<_> = (0..count).map(|i| (i, i as f64)).collect();
    assert_eq!(*seen.frames.lock().unwrap(), expected);
}

#[test]
fn every_frame_of_a_finite_source_comes_in_order_on_every_engine() {
    let gpu = test_adapter().map(|_| Engine::Gpu);
    if gpu.is_none() {
        skip("streams on a GPU: no adapter");
    }
    for engine in [Some(Engine::Cpu), gpu].into_iter().flatten() {
        let seen = Seen { takes: Duration::from_millis(1), ..Seen::default() };
        let (statistics, warnings) = run(Given::frames(12), &options(engine), seen.clone());
        in_order(&seen, 12);
        assert_eq!((statistics.frames_in, statistics.frames_out, statistics.dropped), (12, 12, 0));
        assert_eq!((statistics.engine, warnings.len()), (engine, 0));
        let latency = statistics.latency();
        assert!(latency.p50 <= latency.p99 && latency.p99 <= latency.max && latency.max > Duration::ZERO);
    }
}

#[test]
fn a_live_source_drops_what_comes_too_fast_and_counts_it() {
    // The reference cannot smooth 2,000 frames per second.
    let seen = Seen::default();
    let source = Paced::new(Box::new(Given::frames(100)), 2000.0).unwrap();
    let (statistics, _) = run(source, &options(Engine::Reference), seen.clone());
    assert_eq!(statistics.frames_in, 100);
    assert!(statistics.dropped > 0 && statistics.frames_out > 0);
    assert_eq!(statistics.frames_out + statistics.dropped, 100);
    let times: Vec<_> = seen.frames.lock().unwrap().iter().map(|(_, time)| *time).collect();
    // No newer frame replaces the last frame, so it is always smoothed.
    assert!(times.is_sorted() && times.last() == Some(&99.0), "{times:?}");
}

#[test]
fn a_frame_that_cannot_be_read_is_told_and_the_stream_goes_on() {
    let given = vec![Ok(frame(small_camera(), 0)), Err("/there is none"), Ok(frame(small_camera(), 1))];
    let seen = Seen::default();
    let (statistics, warnings) =
        run(Given(given.into_iter(), Box::new(|_| ()), 0), &options(Engine::Cpu), seen.clone());
    in_order(&seen, 2);
    assert_eq!(statistics.unreadable, 1);
    assert!(warnings.len() == 1 && warnings[0].contains("there is none"), "{warnings:?}");
}

/// A source of clouds without a camera, as in files.
struct Clouds(std::vec::IntoIter<OrganizedCloud>);

impl Source for Clouds {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        Ok(self.0.next().map(|cloud| OwnedFrame::Cloud { cloud, timestamp_s: None }))
    }
}

/// A sink that keeps the points it receives.
#[derive(Default, Clone)]
struct Points(Arc<Mutex<Vec<String>>>);

impl Sink for Points {
    fn name(&self) -> String {
        "a sink that keeps points".to_owned()
    }

    fn write(&mut self, frame: &StreamFrame) -> Result<(), Error> {
        self.0.lock().unwrap().push(format!("{:?}", frame.smoothed.points));
        Ok(())
    }
}

#[test]
fn windows_are_adapted_by_the_first_frame_that_says_how_coarse_it_is() {
    let mut cloud = frame(small_camera(), 0).deproject().unwrap();
    cloud.camera = None;
    let mut cut = cloud.clone();
    cut.points.positions.resize(100, 0.0);
    let mut empty = cloud.clone();
    empty.points.positions = Xyz::filled(160 * 120, f32::NAN);
    let alone = |params: FrameParams| {
        let options = SmootherOptions::default().with_engine(Engine::Cpu);
        let mut smoothed = Smoothed::default();
        Smoother::open_with(params, &options, (160, 120)).unwrap().smooth(&cloud, &mut smoothed).unwrap();
        format!("{:?}", smoothed.points)
    };
    let streamed = |params: FrameParams| {
        let points = Points::default();
        let source = Clouds(vec![cut.clone(), empty.clone(), cloud.clone(), empty.clone(), cloud.clone()].into_iter());
        let mut warnings = Vec::new();
        let tell = |event: StreamEvent<'_>| {
            if let StreamEvent::Warning(warning) = event {
                warnings.push(warning);
            }
        };
        let options = StreamOptions::new(params, SmootherOptions::default().with_engine(Engine::Cpu));
        let sinks: Vec<Box<dyn Sink>> = vec![Box::new(points.clone())];
        let statistics =
            stream::Stream::new(Box::new(source), options).with_sinks(sinks).with_events(tell).run().unwrap();
        assert_eq!((statistics.unreadable, statistics.frames_out, warnings.len()), (1, 4, 1), "{warnings:?}");
        points.0.lock().unwrap().clone()
    };
    // A fixed stride keeps the nominal window at any resolution.
    let fixed = FrameParams::default().with_stride(5);
    let (adapted, given) = (streamed(FrameParams::default()), streamed(fixed));
    let [expected_adapted, expected_given] = [FrameParams::default().at_resolution_of(&cloud), fixed].map(alone);
    assert!(adapted[1] == expected_adapted && adapted[3] == expected_adapted && expected_adapted != expected_given);
    assert!(given[1] == expected_given && given[3] == expected_given);
}

#[test]
fn a_sink_that_fails_is_told_once_and_the_others_go_on() {
    let (good, bad) = (Seen::default(), Seen { fails_at: Some(2), ..Seen::default() });
    let mut warnings = 0;
    let sinks: Vec<Box<dyn Sink>> = vec![Box::new(bad.clone()), Box::new(good.clone())];
    let tell = |event: StreamEvent<'_>| warnings += usize::from(matches!(event, StreamEvent::Warning(_)));
    let source = Box::new(Given::frames(15));
    let statistics =
        stream::Stream::new(source, options(Engine::Cpu)).with_sinks(sinks).with_events(tell).run().unwrap();
    in_order(&good, 15);
    assert_eq!((bad.frames.lock().unwrap().len(), statistics.failed_sinks, warnings), (2, 1, 1));
}

/// A live camera in front of a static scene, without end.
struct Still(DepthFrame);

impl Source for Still {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        Ok(Some(OwnedFrame::Depth(self.0.clone())))
    }

    fn is_live(&self) -> bool {
        true
    }
}

/// A sink that holds its first frame until it gets a message.
struct Held {
    go: Receiver<()>,
    written: Arc<Mutex<Vec<u64>>>,
}

impl Sink for Held {
    fn name(&self) -> String {
        "a sink that is held".to_owned()
    }

    fn write(&mut self, frame: &StreamFrame) -> Result<(), Error> {
        if self.written.lock().unwrap().is_empty() {
            // The timeout makes the test fail below, instead of hanging, if the stream waits for this sink.
            let _ = self.go.recv_timeout(Duration::from_secs(60));
        }
        self.written.lock().unwrap().push(frame.index);
        Ok(())
    }
}

#[test]
fn a_sink_that_is_too_slow_for_a_live_stream_holds_nothing_up() {
    const FRAMES: u64 = 20;
    let (let_go, go) = channel();
    let written = Arc::new(Mutex::new(Vec::new()));
    let sink = Held { go, written: Arc::clone(&written) };
    let (mut warnings, mut written_by_then) = (0, None);
    let tell = |event: StreamEvent<'_>| match event {
        StreamEvent::Warning(_) => warnings += 1,
        StreamEvent::Frame(statistics) if statistics.frames_out == FRAMES => {
            written_by_then = Some(written.lock().unwrap().len());
            let_go.send(()).unwrap();
        }
        _ => {}
    };
    let source = Box::new(Still(frame(small_camera(), 0)));
    let options = options(Engine::Cpu).with_max_frames(Some(FRAMES));
    let statistics =
        stream::Stream::new(source, options).with_sinks(vec![Box::new(sink)]).with_events(tell).run().unwrap();
    // All frames were smoothed before the sink had written one. The sink received only the frame that it held and the
    // waiting ones.
    assert_eq!((statistics.frames_out, written_by_then, warnings), (FRAMES, Some(0), 1));
    let written = written.lock().unwrap().len() as u64;
    assert!((1..=9).contains(&written), "{written}");
    assert_eq!(written + statistics.dropped_by_sinks, FRAMES);
}

#[test]
fn a_stream_ends_when_it_is_told_to() {
    let stop = AtomicBool::new(false);
    let mut count = 0;
    let source = planish::source::SyntheticSource::new(1, small_camera()).unwrap();
    let tell = |event: StreamEvent<'_>| {
        if let StreamEvent::Frame(statistics) = event {
            count = statistics.frames_out;
            stop.store(count >= 7, Ordering::Relaxed);
        }
    };
    let statistics =
        stream::Stream::new(Box::new(source), options(Engine::Cpu)).with_stop(&stop).with_events(tell).run().unwrap();
    assert!((7..=10).contains(&statistics.frames_out));
}

#[test]
fn a_simulated_source_repeats_the_frames_that_it_rendered() {
    use planish::source::{OwnedFrame, SyntheticSource};
    let take = |mut source: SyntheticSource| -> Vec<_> {
        let frames = (0..3).map(|_| source.next_frame().unwrap().unwrap());
        let depth = frames.map(|frame| if let OwnedFrame::Depth(frame) = frame { frame } else { panic!("no depth") });
        depth.map(|frame| (frame.timestamp_s, frame.raw)).collect()
    };
    let whole = take(SyntheticSource::new(1, small_camera()).unwrap());
    let two = take(SyntheticSource::of_frames(1, small_camera(), 2).unwrap());
    assert!(whole[..2] == two[..2] && whole[0].1 != whole[1].1);
    assert!(two[2].0 == whole[2].0 && two[2].1 == two[0].1);
}

#[test]
fn a_source_that_panics_ends_the_stream_and_not_the_process() {
    let mut given = Given::frames(3);
    given.1 = Box::new(|number| assert!(number < 2, "a defect of this source"));
    let seen = Seen::default();
    let (statistics, warnings) = run(given, &options(Engine::Cpu), seen.clone());
    in_order(&seen, 2);
    assert_eq!((statistics.frames_out, warnings.len()), (2, 1));
    assert!(warnings[0].contains("panicked"));
}

#[test]
fn frames_of_another_shape_reopen_the_engine() {
    let larger = small_camera().with_shape((200, 120));
    let given = vec![0, 1, 2, 3].into_iter().map(|i| Ok(frame(if i % 2 == 0 { small_camera() } else { larger }, i)));
    let seen = Seen::default();
    let given: Vec<_> = given.collect();
    run(Given(given.into_iter(), Box::new(|_| ()), 0), &options(Engine::Cpu), seen.clone());
    in_order(&seen, 4);
}

#[test]
fn a_recording_in_tum_layout_comes_back_identical() {
    let folder = tempfile::tempdir().unwrap();
    let frames: Vec<_> = (0..4).map(|i| frame(small_camera(), i)).collect();
    let mut recorder = TumRecorder::create(folder.path()).unwrap();
    frames.iter().for_each(|frame| recorder.add(frame).unwrap());
    assert!(TumRecorder::create(folder.path()).is_err());
    let mut source = TumSource::open(folder.path(), None, None).unwrap();
    for expected in &frames {
        let Some(OwnedFrame::Depth(found)) = source.next_frame().unwrap() else { panic!("a depth frame") };
        assert_eq!((found.timestamp_s, &found.rgb), (expected.timestamp_s, &expected.rgb));
        assert_eq!((found.camera.fx, found.camera.depth_units_per_metre), (expected.camera.fx, 5000.0));
        assert!(found.raw.iter().zip(&expected.raw).all(|(found, raw)| *found == 5 * raw));
    }
    assert!(source.next_frame().unwrap().is_none());
    // If the camera states no depth unit, the unit of the layout is used.
    let other = Camera::new((0, 0), [500.0, 525.0], [319.5, 239.5]);
    let mut source = TumSource::open(folder.path(), Some(other), None).unwrap();
    let Some(OwnedFrame::Depth(found)) = source.next_frame().unwrap() else { panic!("a depth frame") };
    assert_eq!((found.camera.fx, found.camera.depth_units_per_metre), (500.0, 5000.0));
}

#[test]
fn a_recording_in_tum_layout_keeps_finer_units_and_counts_what_is_too_far() {
    let record = |units, raw: u16| {
        let folder = tempfile::tempdir().unwrap();
        let camera = small_camera().with_depth_units_per_metre(units);
        let mut recorder = TumRecorder::create(folder.path()).unwrap();
        assert!(std::fs::read_dir(folder.path()).unwrap().next().is_none(), "nothing before the first frame");
        recorder.add(&DepthFrame::new(camera, vec![raw; 160 * 120]).unwrap()).unwrap();
        let other = DepthFrame::new(camera.with_depth_units_per_metre(2.0 * units), vec![raw; 160 * 120]).unwrap();
        assert!(recorder.add(&other).unwrap_err().to_string().contains("units per metre, but had"));
        let mut source = TumSource::open(folder.path(), None, None).unwrap();
        let Some(OwnedFrame::Depth(found)) = source.next_frame().unwrap() else { panic!("a depth frame") };
        assert_eq!(recorder.depth_units_per_metre(), Some(found.camera.depth_units_per_metre));
        (found.camera.depth_units_per_metre, found.raw[0], recorder.too_far())
    };
    // A D405 measures tenths of a millimetre, an L515 quarters.
    assert_eq!(record(10_000.0, 65_534), (10_000.0, 65_534, 0));
    assert_eq!(record(4000.0, 14_001), (4000.0, 14_001, 0));
    assert_eq!(record(1000.0, 13_106), (5000.0, 65_530, 0));
    assert_eq!(record(1000.0, 13_107), (5000.0, 0, 160 * 120));
    assert_eq!(record(1000.0, 14_000), (5000.0, 0, 160 * 120));
}

#[test]
fn a_recording_of_libfreenect_comes_back_to_a_disparity_step() {
    let folder = tempfile::tempdir().unwrap();
    let frames: Vec<_> = (0..2).map(|i| frame(Camera::kinect_v1(), i)).collect();
    write_freenect_recording(folder.path(), &frames).unwrap();
    let mut source = FreenectRecording::open(folder.path(), None).unwrap();
    for expected in &frames {
        let Some(OwnedFrame::Depth(found)) = source.next_frame().unwrap() else { panic!("a depth frame") };
        assert_eq!(found.timestamp_s, expected.timestamp_s);
        assert_disparity_steps(&found, expected);
    }
    assert!(source.next_frame().unwrap().is_none());
}

/// Asserts that depths differ by at most half a step of the disparity and a millimetre of rounding.
fn assert_disparity_steps(found: &DepthFrame, expected: &DepthFrame) {
    // Nearest and farthest depth in metres that 11 bits of disparity represent.
    let reach = disparity_depth_m(0)..9.9;
    for (found, expected) in found.raw.iter().zip(&expected.raw) {
        let z = f64::from(*expected) * 1e-3;
        if reach.contains(&z) {
            let step = 3.1e-3 * z * z;
            assert!((f64::from(*found) * 1e-3 - z).abs() <= 0.5 * step + 1e-3, "{found} {expected}");
        } else {
            assert!(*expected != 0 || *found == 0);
        }
    }
}

#[test]
fn a_folder_gives_its_frames_by_name_and_keeps_results_whole() {
    let folder = tempfile::tempdir().unwrap();
    for i in [2u64, 0, 1] {
        let depth = frame(small_camera(), i);
        let image = planish::DepthImage { width: 160, height: 120, raw: depth.raw };
        planish::io::write_depth(&folder.path().join(format!("{i}.png")), &image).unwrap();
    }
    let out = folder.path().join("out");
    let sinks: Vec<Box<dyn Sink>> =
        vec![Box::new(FolderSink::create(&out, SinkFormat::DepthPng, Outputs::DEPTH).unwrap())];
    let source = FileSource::folder(folder.path(), Some(small_camera())).unwrap();
    let mut options = options(Engine::Cpu);
    options.smoother.outputs = Outputs::DEPTH;
    stream::Stream::new(Box::new(source), options).with_sinks(sinks).run().unwrap();
    for i in 0..3 {
        let found = planish::io::read_depth_frame(&out.join(format!("{i}.png")), small_camera()).unwrap();
        let expected = TestEngine::cpu(planish::SimdLevel::best()).smooth_to(
            &frame(small_camera(), i),
            FrameParams::default(),
            Outputs::DEPTH,
        );
        assert_eq!(Some(found.raw), expected.depth);
    }
    let Err(error) = FileSource::folder(&folder.path().join("none"), None) else { panic!("there is none") };
    assert!(error.to_string().contains("none"));
}

#[test]
fn a_folder_of_depth_needs_its_camera_at_once_and_intrinsics_are_those_of_one_size() {
    let folder = tempfile::tempdir().unwrap();
    for (i, width) in [160, 80, 160].into_iter().enumerate() {
        let image = planish::DepthImage { width, height: 120, raw: vec![1000; width * 120] };
        planish::io::write_depth(&folder.path().join(format!("{i}.png")), &image).unwrap();
    }
    let Err(error) = FileSource::folder(folder.path(), None) else { panic!("no camera") };
    assert!(error.to_string().contains("0.png") && error.to_string().contains("camera"), "{error}");

    let mut source = FileSource::folder(folder.path(), Some(small_camera().with_shape((0, 0)))).unwrap();
    let mut next = || source.next_frame().map(|frame| frame.unwrap().shape());
    assert_eq!(next().unwrap(), (160, 120));
    let error = next().unwrap_err().to_string();
    assert!(error.contains("1.png") && error.contains("80x120") && error.contains("160x120"), "{error}");
    assert_eq!(next().unwrap(), (160, 120));
}

#[test]
fn what_is_read_ahead_of_the_last_frame_does_not_count() {
    let folder = tempfile::tempdir().unwrap();
    for i in 0..2u64 {
        let depth = frame(small_camera(), i);
        let image = planish::DepthImage { width: 160, height: 120, raw: depth.raw };
        planish::io::write_depth(&folder.path().join(format!("{i}.png")), &image).unwrap();
    }
    std::fs::write(folder.path().join("2.png"), b"no image").unwrap();
    let count = |most: Option<u64>| {
        let source = Box::new(FileSource::folder(folder.path(), Some(small_camera())).unwrap());
        let options = options(Engine::Cpu).with_max_frames(most);
        let statistics = stream::Stream::new(source, options).run().unwrap();
        (statistics.frames_out, statistics.unreadable)
    };
    assert_eq!((count(Some(2)), count(None)), ((2, 0), (2, 1)));
}

#[test]
fn real_data_sets_stream() {
    let Some(data) = folder("real data sets") else { return };
    let camera = planish::io::read_camera(&data.join("redwood/camera_primesense.json"), Some((640, 480)));
    let source = FileSource::folder(&data.join("redwood/depth"), Some(camera.unwrap())).unwrap();
    let (statistics, warnings) = {
        let mut warnings = 0;
        let tell = |event: StreamEvent<'_>| warnings += usize::from(matches!(event, StreamEvent::Warning(_)));
        let stop = AtomicBool::new(false);
        (
            stream::Stream::new(Box::new(source), options(Engine::Cpu))
                .with_stop(&stop)
                .with_events(tell)
                .run()
                .unwrap(),
            warnings,
        )
    };
    assert_eq!((statistics.frames_out, warnings), (5, 0));
}
