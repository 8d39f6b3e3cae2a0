//! Streams of several cameras survive failures of cameras and sinks.

use std::collections::VecDeque;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use planish::rig::{
    CamerasSink, Clock, FusedSink, Rig, RigCamera, RigEvent, RigFrame, RigOptions, RigSink, RigStatistics, RigStream,
    RigWay,
};
use planish::source::{OwnedFrame, Source};
use planish::stream::SinkFormat;
use planish::{AttributeValues, Camera, DepthFrame, DeviceError, Engine, Error, Outputs, SensorPose, SmootherOptions};

/// A camera that plays a script.
struct Script {
    steps: VecDeque<Step>,
    start: Option<Instant>,
    is_live: bool,
    ended: Arc<AtomicBool>,
}

#[derive(Clone)]
enum Step {
    /// A frame with this timestamp in seconds, delivered this long after the start.
    Frame(f64, Duration),
    Unreadable,
    Gone,
}

fn small() -> Camera {
    Camera::new((32, 24), [26.0; 2], [15.5, 11.5])
}

impl Source for Script {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        let start = *self.start.get_or_insert_with(Instant::now);
        match self.steps.pop_front() {
            Some(Step::Frame(time_s, after)) => {
                if self.is_live {
                    thread::sleep((start + after).saturating_duration_since(Instant::now()));
                }
                let frame = DepthFrame::new(small(), vec![1000; 32 * 24]).unwrap();
                Ok(Some(OwnedFrame::Depth(frame.with_timestamp_s(time_s))))
            }
            Some(Step::Unreadable) => Err(planish::FrameError::NoPoints.into()),
            Some(Step::Gone) => Err(DeviceError::Gone { what: "the test's camera".into() }.into()),
            None => Ok(None),
        }
    }

    fn is_live(&self) -> bool {
        self.is_live
    }

    fn end_with(&mut self, ended: Arc<AtomicBool>) {
        self.ended = ended;
    }
}

/// Returns frame `i` of 50 per second; a live camera delivers them at that rate.
fn frame(i: u32) -> Step {
    Step::Frame(f64::from(i) / 50.0, Duration::from_millis(20 * u64::from(i)))
}

fn script(steps: Vec<Step>, is_live: bool) -> Box<dyn Source> {
    Box::new(Script { steps: steps.into(), start: None, is_live, ended: Arc::default() })
}

/// A sink that keeps the moments.
#[derive(Clone, Default)]
struct Kept(Arc<Mutex<Vec<Moment>>>);

/// Time of a moment in seconds, and true for each camera with a frame.
type Moment = (f64, Vec<bool>);

impl RigSink for Kept {
    fn name(&self) -> String {
        "kept".into()
    }

    fn write(&mut self, frame: &RigFrame) -> Result<(), Error> {
        let has = frame.cameras.iter().map(Option::is_some).collect();
        self.0.lock().unwrap().push((frame.time_s, has));
        Ok(())
    }
}

fn rig_of_two() -> Rig {
    let apart = SensorPose { position_m: [1.0, 0.0, 0.0], ..SensorPose::IDENTITY };
    Rig::new(vec![RigCamera::new("left", SensorPose::IDENTITY), RigCamera::new("right", apart)])
        .unwrap()
        .with_tolerance_s(0.008)
}

fn stream(sources: Vec<Box<dyn Source>>) -> (Result<RigStatistics, Error>, Vec<Moment>, Vec<String>) {
    let (rig, kept, mut warnings) = (rig_of_two(), Kept::default(), Vec::new());
    let options = RigOptions::new(&rig, RigWay::Each, SmootherOptions::new(Engine::Cpu, Outputs::POINTS));
    let result = RigStream::new(&rig, sources, options)
        .with_sinks(vec![Box::new(kept.clone())])
        .with_events(|event| {
            if let RigEvent::Warning(warning) = event {
                warnings.push(warning);
            }
        })
        .run();
    let moments = kept.0.lock().unwrap().clone();
    (result, moments, warnings)
}

#[test]
fn every_moment_of_recordings_comes_once_in_order_and_one_that_ends_early_holds_nobody_up() {
    let left = (0..30).map(frame).collect();
    let right = (0..10).filter(|&i| i != 4).map(frame).collect();
    let (result, moments, warnings) = stream(vec![script(left, false), script(right, false)]);
    let statistics = result.unwrap();
    let expected: Vec<Moment> = (0..30).map(|i| (f64::from(i) / 50.0, vec![true, i < 10 && i != 4])).collect();
    assert_eq!(moments, expected);
    assert_eq!((statistics.moments.frames_out, statistics.complete, statistics.moments.dropped), (30, 9, 0));
    let right = &statistics.cameras[1];
    assert_eq!((right.frames_in, right.frames_out, right.missing, right.has_ended), (9, 9, 21, true));
    assert!(warnings.is_empty(), "{warnings:?}");
    // A camera that ends long before the other is reported.
    let (result, _, warnings) =
        stream(vec![script((0..40).map(frame).collect(), false), script((0..10).map(frame).collect(), false)]);
    assert_eq!(result.unwrap().moments.frames_out, 40);
    assert!(warnings.len() == 1 && warnings[0].contains("right") && warnings[0].contains("0.6 s"), "{warnings:?}");
    // Cutting off the stream does not count as the end of its cameras.
    let slow = |i: u32| Step::Frame(f64::from(i), Duration::ZERO);
    let sources = (0..2).map(|_| script((0..30).map(slow).collect(), false)).collect();
    let rig = rig_of_two();
    let options = RigOptions::new(&rig, RigWay::Each, SmootherOptions::new(Engine::Cpu, Outputs::POINTS));
    let mut warnings = Vec::new();
    let tell = |event: RigEvent<'_>| {
        if let RigEvent::Warning(warning) = event {
            warnings.push(warning);
        }
    };
    let options = options.with_max_moments(Some(2));
    let statistics = RigStream::new(&rig, sources, options).with_events(tell).run().unwrap();
    assert!(statistics.cameras.iter().all(|camera| !camera.has_ended) && warnings.is_empty(), "{warnings:?}");
}

#[test]
fn time_stamps_of_no_clock_are_refused_and_so_is_the_arrival_of_recordings() {
    let mut right: Vec<Step> = (0..4).map(frame).collect();
    right.insert(2, Step::Frame(1e300, Duration::ZERO));
    right.insert(3, Step::Frame(f64::NAN, Duration::ZERO));
    let (result, moments, warnings) = stream(vec![script((0..4).map(frame).collect(), false), script(right, false)]);
    assert_eq!((result.unwrap().cameras[1].unreadable, moments.len()), (2, 4));
    assert!(moments.iter().all(|(_, has)| has == &[true, true]), "{moments:?}");
    assert!(warnings.len() == 2 && warnings[0].contains("1e300"), "{warnings:?}");

    let rig = rig_of_two().with_clock(Clock::Arrival);
    let options = RigOptions::new(&rig, RigWay::Each, SmootherOptions::new(Engine::Cpu, Outputs::POINTS));
    let sources = (0..2).map(|_| script(vec![frame(0)], false)).collect();
    let error = RigStream::new(&rig, sources, options).run().unwrap_err();
    assert!(error.to_string().contains("recordings"), "{error}");
}

/// A sink that fails at once, as if the disk were full.
struct Full;

impl RigSink for Full {
    fn name(&self) -> String {
        "full".into()
    }

    fn write(&mut self, _: &RigFrame) -> Result<(), Error> {
        Err(planish::FrameError::NoPoints.into())
    }
}

#[test]
fn a_stream_whose_sinks_have_all_failed_ends_and_one_that_has_another_goes_on() {
    let rig = rig_of_two();
    let options = RigOptions::new(&rig, RigWay::Each, SmootherOptions::new(Engine::Cpu, Outputs::POINTS));
    let of = |sinks: Vec<Box<dyn RigSink>>| {
        let sources = (0..2).map(|_| script((0..200).map(frame).collect(), false)).collect();
        let mut last = String::new();
        let statistics = RigStream::new(&rig, sources, options.clone())
            .with_sinks(sinks)
            .with_events(|event| {
                if let RigEvent::Warning(warning) = event {
                    last = warning;
                }
            })
            .run();
        (statistics.unwrap().moments, last)
    };
    let (moments, last) = of(vec![Box::new(Full)]);
    assert!(moments.frames_out < 200 && moments.failed_sinks == 1, "{moments:?}");
    assert!(last.contains("the stream stops"), "{last}");
    let (moments, _) = of(vec![Box::new(Full), Box::new(Kept::default())]);
    assert_eq!((moments.frames_out, moments.failed_sinks), (200, 1));
}

#[test]
fn frames_that_cannot_be_read_and_a_camera_that_goes_are_reported_and_the_others_go_on() {
    let left = (0..12).map(frame).collect();
    let mut right: Vec<Step> = (0..4).map(frame).collect();
    right.insert(2, Step::Unreadable);
    right.push(Step::Gone);
    let (result, moments, warnings) = stream(vec![script(left, false), script(right, false)]);
    let statistics = result.unwrap();
    assert_eq!((moments.len(), statistics.complete, statistics.cameras[1].unreadable), (12, 4, 2));
    assert!(warnings.len() == 2 && warnings.iter().all(|warning| warning.contains("right")), "{warnings:?}");
    assert!(warnings[1].contains("continue"), "{warnings:?}");
    // If all cameras are gone, the stream returns an error.
    let (result, ..) = stream(vec![script(vec![Step::Gone], false), script(vec![Step::Gone], false)]);
    assert!(matches!(result, Err(Error::Device(DeviceError::Gone { .. }))));
    // Live cameras cannot be mixed with recordings.
    let (result, ..) = stream(vec![script(vec![frame(0)], true), script(vec![frame(0)], false)]);
    assert!(matches!(result, Err(Error::Param(_))));
}

#[test]
fn live_cameras_are_matched_and_clocks_with_nothing_in_common_are_told() {
    // Frames come at half the pace, so that they are matched on a busy machine too.
    let slow = |i: u32| match frame(i) {
        Step::Frame(time_s, after) => Step::Frame(time_s, 2 * after),
        other => other,
    };
    let left = (0..40).map(slow).collect();
    // The right camera is unplugged from frame 10 until frame 20.
    let right = (0..40).filter(|i| !(10..20).contains(i)).map(slow).collect();
    let (result, moments, warnings) = stream(vec![script(left, true), script(right, true)]);
    let statistics = result.unwrap();
    let both = moments.iter().filter(|(_, has)| has.iter().all(|&has| has)).count();
    assert!(both >= 10 && statistics.cameras[1].missing >= 5, "{both} {statistics:?}");
    assert!(moments.windows(2).all(|pair| pair[0].0 < pair[1].0), "{moments:?}");
    assert!(warnings.is_empty(), "{warnings:?}");
    // The clocks of the cameras are an hour apart.
    let late = |i: u32| match frame(i) {
        Step::Frame(time_s, after) => Step::Frame(time_s + 3600.0, after),
        other => other,
    };
    let (result, _, warnings) =
        stream(vec![script((0..60).map(frame).collect(), true), script((0..60).map(late).collect(), true)]);
    assert!(result.unwrap().complete < 5);
    assert!(warnings.iter().any(|warning| warning.contains("time_offset_s")), "{warnings:?}");
}

#[test]
fn fused_clouds_and_each_camera_s_own_are_saved() {
    let (folder, rig) = (tempfile::tempdir().unwrap(), rig_of_two());
    let (fused, own) = (folder.path().join("fused"), folder.path().join("own"));
    let options = RigOptions::new(&rig, RigWay::Each, SmootherOptions::new(Engine::Cpu, Outputs::POINTS));
    let sinks: Vec<Box<dyn RigSink>> = vec![
        Box::new(FusedSink::create(&fused, SinkFormat::Pcd, &rig).unwrap()),
        Box::new(CamerasSink::create(&own, SinkFormat::Pcd, Outputs::POINTS, &rig).unwrap()),
    ];
    let sources = (0..2).map(|_| script((0..3).map(frame).collect(), false)).collect();
    let statistics = RigStream::new(&rig, sources, options).with_sinks(sinks).run().unwrap();
    assert_eq!((statistics.moments.frames_out, statistics.moments.failed_sinks), (3, 0));
    let (_, contents) = planish::io::read(&fused.join("000002.pcd")).unwrap();
    let planish::io::Contents::General(cloud) = contents else { panic!("an unorganized cloud") };
    assert_eq!(cloud.len(), 2 * 32 * 24);
    let Some(AttributeValues::U8(cameras)) = cloud.attribute("camera").map(|field| &field.values) else {
        panic!("the field camera")
    };
    assert!(cameras[..768].iter().all(|&camera| camera == 0) && cameras[768..].iter().all(|&camera| camera == 1));
    // The right camera is a metre to the right of the left one.
    assert!((cloud.positions.x()[768] - cloud.positions.x()[0] - 1.0).abs() < 1e-6);
    let list = std::fs::read_to_string(fused.join("points.txt")).unwrap();
    assert!(list.lines().count() == 3 && list.contains("0.040000 000002.pcd"), "{list}");
    assert_eq!(
        std::fs::read_dir(own.join("right"))
            .unwrap()
            .filter(|entry| { entry.as_ref().unwrap().path().extension().is_some_and(|extension| extension == "pcd") })
            .count(),
        3
    );
    let saved = Rig::read(&own.join("rig.json")).unwrap();
    assert_eq!(saved.cameras[1].pose, rig.cameras[1].pose);
    // A sink refuses to replace existing files.
    assert!(FusedSink::create(&fused, SinkFormat::Pcd, &rig).is_err());
}
