//! Tests of the source `realsense` with a librealsense software device and its recordings.
//!
//! PLANISH_LIBREALSENSE names the library. `.ci/run` requires it (PLANISH_REQUIRE_REALSENSE).

mod software_realsense;

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::source::{Alignment, OwnedFrame, RealSenseInput, RealSenseSource, Source, SourceOptions, StreamMode};
use planish::stream::{self, StreamOptions};
use planish::{Camera, DepthFrame, DeviceError, Engine, Error, FrameParams, SmootherOptions};

use software_realsense::{Intrinsics, RealSense, SoftwareCamera, intrinsics};

const SHAPE: (usize, usize) = (848, 480);
const COLOR_SHAPE: (usize, usize) = (640, 480);

fn library() -> Option<&'static RealSense> {
    planish::internal::set_longest_silence_s(3);
    let library = RealSense::load();
    if let Err(reason) = &library {
        assert!(std::env::var_os("PLANISH_REQUIRE_REALSENSE").is_none(), "{reason}");
        eprintln!("SKIP the RealSense: {reason}");
    }
    library.ok()
}

fn next(source: &mut RealSenseSource) -> Result<Option<DepthFrame>, Error> {
    Ok(source.next_frame()?.map(|frame| match frame {
        OwnedFrame::Depth(frame) => frame,
        _ => panic!("a frame of depth"),
    }))
}

fn depth_intrinsics() -> Intrinsics {
    intrinsics((848, 480), 425.0)
}

fn color_intrinsics() -> Intrinsics {
    intrinsics((640, 480), 600.0)
}

fn camera() -> Camera {
    Camera::new(SHAPE, [425.0, 426.0], [427.5, 237.75])
}

/// Returns frames of a table that differ only by their noise.
fn frames(count: usize) -> Vec<DepthFrame> {
    let (scene, pose) = Scene::tabletop(1);
    let simulator = DepthSimulator::new(DepthNoise::default(), camera(), 1);
    let truth = scene.render(&camera(), &pose);
    (0..count).map(|i| simulator.frame(&truth, i as u64).unwrap()).collect()
}

fn timestamp_ms(i: usize) -> f64 {
    1.6e12 + 1000.0 / 30.0 * i as f64
}

/// Returns a colour image that encodes the position of each pixel, divided by 4, and the number of its frame.
fn color_image(number: usize) -> Vec<u8> {
    let (width, height) = COLOR_SHAPE;
    (0..width * height).flat_map(|i| [(i % width / 4) as u8, (i / width / 4) as u8, number as u8]).collect()
}

fn software_camera(color: bool) -> Option<SoftwareCamera> {
    let color = color.then(color_intrinsics);
    library().map(|library| SoftwareCamera::new(library, "000123", depth_intrinsics(), color, 0.001))
}

/// Records frames to recording.db3; librealsense 2.58 and later require that extension instead of .bag.
fn record(folder: &Path, frames: &[DepthFrame], color: bool) -> Option<PathBuf> {
    let camera = software_camera(color)?;
    let file = folder.join("recording.db3");
    camera.record(&file, || {
        for (i, frame) in frames.iter().enumerate() {
            camera.deliver(i + 1, timestamp_ms(i), &frame.raw, color.then(|| color_image(i + 1)).as_deref());
            thread::sleep(Duration::from_millis(10));
        }
        thread::sleep(Duration::from_millis(200));
    });
    Some(file)
}

fn open(file: &Path, alignment: Option<Alignment>) -> Result<RealSenseSource, Error> {
    RealSenseSource::open(&RealSenseInput::Recording(file.to_path_buf()), None, alignment, None)
}

/// Runs a check on several cases in parallel, because recordings play in real time and each check mostly waits.
fn side_by_side<T: Copy + Send, const N: usize>(cases: [T; N], check: impl Fn(T) + Sync) {
    thread::scope(|scope| {
        for case in cases {
            let check = &check;
            scope.spawn(move || check(case));
        }
    });
}

#[test]
fn depth_of_a_recording_comes_back_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let recorded = frames(20);
    side_by_side([false, true], |color| {
        let folder = folder.path().join(color.to_string());
        fs::create_dir(&folder).unwrap();
        let Some(file) = record(&folder, &recorded, color) else { return };
        side_by_side([None, Some(Alignment::None)], |alignment| {
            let mut source = open(&file, alignment).unwrap();
            assert!(!source.is_live() && source.description().unwrap().contains("000123"));
            for (i, expected) in recorded.iter().enumerate() {
                let found = next(&mut source).unwrap().unwrap_or_else(|| panic!("frame {i} of 20"));
                assert!(found.raw == expected.raw, "depth of frame {i}");
                assert_eq!(found.camera, camera());
                assert!((found.timestamp_s.unwrap() - 1e-3 * timestamp_ms(i)).abs() < 1e-4);
                assert_eq!(found.rgb.is_some(), color && alignment.is_none());
                // The colour image must have the depth's timestamp; it must not be the previous image.
                let number = found.rgb.map(|rgb| rgb.chunks_exact(3).map(|pixel| pixel[2]).max());
                assert!(number.is_none_or(|number| number == Some(i as u8 + 1)), "frame {i}: {number:?}");
            }
            assert!(next(&mut source).unwrap().is_none());
            assert_eq!(source.dropped(), 0);
        });
    });
}

/// Returns a wall at 1 m.
fn wall() -> DepthFrame {
    DepthFrame::new(camera(), vec![1000; 848 * 480]).unwrap()
}

#[test]
fn colour_and_depth_are_mapped_to_one_image() {
    let folder = tempfile::tempdir().unwrap();
    let Some(file) = record(folder.path(), &[wall(), wall()], true) else { return };
    let found = next(&mut open(&file, Some(Alignment::Depth)).unwrap()).unwrap().unwrap();
    let rgb = found.rgb.unwrap();
    for (u, v) in [(424, 240), (300, 100), (600, 400)] {
        // The colour camera is 15 mm to the left of the depth camera, so the point is shifted in its frame.
        let x = (f64::from(u) - 427.5) / 425.0 + 0.015;
        let y = (f64::from(v) - 237.75) / 426.0;
        let expected = [(600.0 * x + 323.5) / 4.0, (601.0 * y + 237.75) / 4.0];
        let at = 3 * (848 * v + u) as usize;
        // The tolerance is one pixel, which is 0.25 in these units, plus 1 for truncation.
        let seen = [rgb[at], rgb[at + 1]].map(f64::from);
        assert!(
            (seen[0] - expected[0]).abs() <= 1.25 && (seen[1] - expected[1]).abs() <= 1.25,
            "{seen:?} {expected:?}"
        );
    }
    let found = next(&mut open(&file, Some(Alignment::Colour)).unwrap()).unwrap().unwrap();
    assert_eq!(found.camera, Camera::new(COLOR_SHAPE, [600.0, 601.0], [323.5, 237.75]));
    assert_eq!(found.raw[640 * 240 + 320], 1000);
    let rgb = found.rgb.unwrap();
    assert!(rgb == color_image(1), "{:?}", &rgb[..12]);
}

#[test]
fn depth_that_is_mapped_to_a_distorted_colour_image_stays_on_its_surface() {
    let folder = tempfile::tempdir().unwrap();
    let Some(library) = library() else { return };
    // A plane z = 1 m + 0.3 x, in millimetres.
    let plane = |i: usize| (1000.0 / (1.0 - 0.3 * (((i % 848) as f64) - 427.5) / 425.0)).round() as u16;
    let plane: Vec<u16> = (0..848 * 480).map(plane).collect();
    // Distortion of a D455's colour camera, with the model that librealsense states for it.
    let coefficients = [-0.0559, 0.0668, -0.000_77, 0.000_44, -0.0213];
    let color = Intrinsics { model: 2, coefficients, ..intrinsics((640, 480), 320.0) };
    let camera = SoftwareCamera::new(library, "455", depth_intrinsics(), Some(color), 0.001);
    let file = folder.path().join("plane.db3");
    camera.record(&file, || {
        for number in 1..=3 {
            camera.deliver(number, timestamp_ms(number), &plane, Some(&color_image(number)));
            thread::sleep(Duration::from_millis(30));
        }
        thread::sleep(Duration::from_millis(200));
    });
    let found = next(&mut open(&file, Some(Alignment::Colour)).unwrap()).unwrap().unwrap();
    let cloud = found.deproject().unwrap();
    let (mut seen, mut worst) = (0, 0.0f32);
    for [x, _, z] in cloud.points.positions.iter().filter(|point| point[2].is_finite()) {
        // The colour camera is 15 mm to the left of the depth camera.
        worst = worst.max((z - (1.0 + 0.3 * (x - 0.015))).abs());
        seen += 1;
    }
    assert!(seen > 100_000, "{seen}");
    // A pixel is 3 mm wide at this distance, which the slope of 0.3 turns into 1 mm of depth.
    assert!(worst < 0.002, "{worst}");
}

#[test]
fn a_recording_that_begins_and_ends_without_colour_plays_whole() {
    let folder = tempfile::tempdir().unwrap();
    let Some(camera) = software_camera(true) else { return };
    let (recorded, file) = (frames(20), folder.path().join("late.db3"));
    camera.record(&file, || {
        for (i, frame) in recorded.iter().enumerate() {
            let rgb = (5..15).contains(&i).then(|| color_image(i + 1));
            camera.deliver(i + 1, timestamp_ms(i), &frame.raw, rgb.as_deref());
            thread::sleep(Duration::from_millis(10));
        }
        thread::sleep(Duration::from_millis(200));
    });
    // Returns the number of each frame, and true for each frame with colour.
    let played = |alignment| {
        let mut source = open(&file, alignment).unwrap();
        let frames = std::iter::from_fn(|| next(&mut source).unwrap());
        let number = |frame: &DepthFrame| recorded.iter().position(|recorded| recorded.raw == frame.raw).unwrap();
        frames.map(|frame| (number(&frame), frame.rgb.is_some())).collect::<Vec<_>>()
    };
    side_by_side([Some(Alignment::None), Some(Alignment::Depth), None], |alignment| {
        let played = played(alignment);
        assert!(played.iter().map(|(number, _)| *number).eq(0..20), "{alignment:?}: {played:?}");
        let coloured = played.iter().filter(|(_, has_colour)| *has_colour).map(|(number, _)| *number);
        let coloured: Vec<_> = coloured.collect();
        if alignment == Some(Alignment::None) {
            assert!(coloured.is_empty());
        } else {
            assert!(coloured.windows(2).all(|pair| pair[1] == pair[0] + 1), "{coloured:?}");
            assert!(coloured[0] <= 5 && coloured.last() >= Some(&13), "{coloured:?}");
        }
    });
}

#[test]
fn a_recording_whose_colour_stops_plays_on_and_what_needs_colour_ends_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    if library().is_none() {
        return;
    }
    let recorded = frames(40);
    // Each case has a name, the number of images before the first gap, and the condition under which a frame has an
    // image.
    let cases = [
        ("stops", 10, (|i| i < 10) as fn(usize) -> bool),
        ("none", 0, |_| false),
        ("pauses", 10, |i| !(10..30).contains(&i)),
    ];
    side_by_side(cases, |(name, at_start, has_image)| {
        let camera = software_camera(true).unwrap();
        let file = &folder.path().join(name).with_extension("db3");
        camera.record(file, || {
            for (i, frame) in recorded.iter().enumerate() {
                let rgb = has_image(i).then(|| color_image(i + 1));
                camera.deliver(i + 1, timestamp_ms(i), &frame.raw, rgb.as_deref());
                thread::sleep(Duration::from_millis(10));
            }
            thread::sleep(Duration::from_millis(200));
        });
        let mut source = open(file, None).unwrap();
        let played: Vec<_> = std::iter::from_fn(|| next(&mut source).unwrap()).collect();
        assert!(played.iter().map(|frame| &frame.raw).eq(recorded.iter().map(|frame| &frame.raw)), "{}", played.len());
        let coloured = played.iter().filter(|frame| frame.rgb.is_some()).count();
        assert!(coloured + 1 >= at_start && (at_start > 0 || coloured == 0), "{name}: {coloured}");

        let mut source = open(file, Some(Alignment::Colour)).unwrap();
        let mut found = 0;
        let said = loop {
            match next(&mut source) {
                Ok(Some(_)) => found += 1,
                Ok(None) => break String::new(),
                Err(error) => break error.to_string(),
            }
        };
        assert!(found + 1 >= at_start && (said.contains("align none") || found == 40), "{name}: {found}, {said}");
        assert!(next(&mut source).unwrap().is_none());
    });
}

#[test]
fn a_live_camera_gives_each_frame_once_with_its_colour() {
    let Some(camera) = software_camera(true) else { return };
    let mut source = live(&camera, None, None).unwrap();
    let delivers = Deliver::start(camera, vec![wall()], |number| number + 1);
    let mut last = None;
    for _ in 0..20 {
        let frame = next(&mut source).unwrap().unwrap();
        assert!(frame.timestamp_s > last, "{:?} {last:?}", frame.timestamp_s);
        last = frame.timestamp_s;
        assert!(frame.raw.iter().all(|&depth| depth == 1000));
        let rgb = frame.rgb.unwrap();
        let number = rgb.chunks_exact(3).map(|pixel| pixel[2]).max().unwrap();
        let expected = 1 + ((1e3 * last.unwrap() - timestamp_ms(0)) * 30.0 / 1000.0).round() as u8;
        assert!(number.abs_diff(expected) <= 1, "{number} {expected}");
    }
    drop(delivers);
}

#[test]
fn units_of_depth_are_the_devices() {
    let Some(library) = library() else { return };
    let camera = SoftwareCamera::new(library, "7", depth_intrinsics(), None, 0.000_25);
    let mut source = live(&camera, None, None).unwrap();
    let delivers = Deliver::start(camera, vec![wall()], |number| number + 1);
    let frame = next(&mut source).unwrap().unwrap();
    assert_eq!(frame.camera.depth_units_per_metre, 4000.0);
    assert_eq!(frame.camera.depth_m(frame.raw[0]), 0.25);
    drop(delivers);
}

fn live(
    camera: &SoftwareCamera,
    alignment: Option<Alignment>,
    mode: Option<StreamMode>,
) -> Result<RealSenseSource, Error> {
    // SAFETY: context and pipeline belong to the same library, and the source takes ownership of both.
    unsafe { planish::internal::start_realsense(camera.pipeline(), alignment, mode) }
}

/// A thread that delivers 30 frames per second of a camera until it is dropped.
struct Deliver {
    stop: Arc<AtomicBool>,
    thread: Option<thread::JoinHandle<usize>>,
}

impl Deliver {
    fn start(camera: SoftwareCamera, frames: Vec<DepthFrame>, after: impl Fn(usize) -> usize + Send + 'static) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let ended = Arc::clone(&stop);
        let thread = thread::spawn(move || {
            let (start, mut number) = (Instant::now(), 1);
            let mut delivered = 0;
            while !ended.load(Ordering::Relaxed) {
                let frame = &frames[delivered % frames.len()];
                let rgb = camera.has_color().then(|| color_image(number));
                camera.deliver(number, timestamp_ms(delivered), &frame.raw, rgb.as_deref());
                number = after(number);
                delivered += 1;
                let due = start + Duration::from_secs(delivered as u64) / 30;
                thread::sleep(due.saturating_duration_since(Instant::now()));
            }
            delivered
        });
        Self { stop, thread: Some(thread) }
    }
}

impl Drop for Deliver {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let _ = self.thread.take().map(thread::JoinHandle::join);
    }
}

#[test]
fn a_live_camera_gives_the_newest_frame_and_counts_those_that_are_missing() {
    let Some(camera) = software_camera(false) else { return };
    let mut source = live(&camera, None, None).unwrap();
    assert!(source.is_live());
    // Two of every three frame numbers are missing.
    let delivers = Deliver::start(camera, frames(3), |number| number + 3);
    for i in 0..5 {
        assert!(next(&mut source).unwrap().is_some());
        assert!(source.dropped() >= 2 * i, "{i}: {}", source.dropped());
    }
    let before = source.dropped();
    thread::sleep(Duration::from_millis(500));
    next(&mut source).unwrap();
    assert!(source.dropped() >= before + 10, "15 frames arrived, with two numbers missing before each");
    drop(delivers);
    // No more frames arrive. A stream that ends does not wait for one, and a camera that stays silent counts as gone.
    source.end_with(Arc::new(AtomicBool::new(true)));
    assert!(next(&mut source).unwrap().is_none());
    source.end_with(Arc::default());
    let gone = (0..100).find_map(|_| next(&mut source).err()).unwrap();
    assert!(matches!(&gone, Error::Device(DeviceError::Gone { .. })), "{gone}");
}

#[test]
fn modes_that_a_camera_lacks_are_refused() {
    let Some(camera) = software_camera(false) else { return };
    let refused = |result: Result<RealSenseSource, Error>| result.map(|_| ()).unwrap_err().to_string();
    let mode = |width, fps| Some(StreamMode { width, height: 480, fps });
    assert!(live(&camera, None, mode(848, Some(30))).is_ok());
    let missing = refused(live(&camera, None, mode(1280, None)));
    assert!(missing.contains("1280x480"), "{missing}");
    // The camera has no colour sensor.
    let color = refused(live(&camera, Some(Alignment::Colour), None));
    assert!(color.contains("colour"), "{color}");
}

#[test]
fn files_that_are_no_recordings_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let Some(file) = record(folder.path(), &frames(10), false) else { return };
    let bytes = fs::read(&file).unwrap();
    let refused = |file: &Path| {
        let options = SourceOptions::default();
        let mut source = match planish::source::open(&format!("realsense:{}", file.display()), &options) {
            Ok(source) => source,
            Err(error) => return error.to_string(),
        };
        let said = (0..100).find_map(|_| source.next_frame().err()).map(|error| error.to_string());
        // The error is returned once; then the stream ends.
        assert!(source.next_frame().unwrap().is_none());
        said.unwrap_or_default()
    };
    let missing = folder.path().join("missing.bag");
    assert!(refused(&missing).contains("missing.bag"));
    for (name, contents) in [("text.db3", &b"no recording"[..]), ("empty.bag", b""), ("text.bag", b"#ROSBAG V2.0\nno")]
    {
        let file = folder.path().join(name);
        fs::write(&file, contents).unwrap();
        assert!(refused(&file).contains(name), "{name}: {}", refused(&file));
    }
    // A truncated recording gives its complete frames or an error; it ends in both cases.
    let cut = folder.path().join("cut.db3");
    for share in [9, 5, 1] {
        fs::write(&cut, &bytes[..bytes.len() * share / 10]).unwrap();
        let said = refused(&cut);
        assert!(said.is_empty() || said.contains("cut.db3"), "{said}");
    }
    let options = SourceOptions::default().with_fps(Some(30.0));
    assert!(planish::source::open(&format!("realsense:{}", file.display()), &options).unwrap().is_live());
    let topic = SourceOptions::default().with_topics(Some("/depth".into()), None);
    assert!(planish::source::open("realsense", &topic).is_err());
}

/// Measures the frame rate in the README. Run it alone, on an otherwise idle machine.
#[test]
#[ignore = "a minute of measurement"]
fn rates() {
    let Some(camera) = software_camera(false) else { return };
    let source = live(&camera, None, None).unwrap();
    let delivers = Deliver::start(camera, frames(10), |number| number + 1);
    let smoother = SmootherOptions::default().with_engine(Engine::Cpu);
    let options = StreamOptions::new(FrameParams::default(), smoother).with_max_duration(Some(Duration::from_secs(60)));
    let stop = AtomicBool::new(false);
    let statistics = stream::Stream::new(Box::new(source), options).with_stop(&stop).run().unwrap();
    drop(delivers);
    let latency = statistics.latency();
    println!(
        "{} frames smoothed, {} dropped, {:.1} a second, p50 {:?}, p99 {:?}",
        statistics.frames_out,
        statistics.dropped,
        statistics.fps(),
        latency.p50,
        latency.p99
    );
}
