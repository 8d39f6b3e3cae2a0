//! Tests of the source `openni2` with a software camera and its recordings. The tests compile the camera's driver
//! (`driver.rs`).
//!
//! Debian's package libopenni2-0 contains the library. `.ci/run` requires it (PLANISH_REQUIRE_OPENNI2).

mod recorder;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use planish::source::{Alignment, OpenNi2Source, OwnedFrame, Source, SourceOptions, StreamMode};
use planish::{Camera, DepthFrame, DeviceError, Error};
use recorder::OpenNi2;

/// Returns the folder of Debian's OpenNI2 library, if installed.
fn installed() -> Option<PathBuf> {
    let folders = fs::read_dir("/usr/lib").into_iter().flatten().flatten().map(|entry| entry.path());
    let folder = folders.into_iter().find(|folder| folder.join("libOpenNI2.so.0").exists());
    assert!(folder.is_some() || std::env::var_os("PLANISH_REQUIRE_OPENNI2").is_none(), "no libopenni2-0");
    if folder.is_none() {
        eprintln!("SKIP OpenNI2: no libOpenNI2.so.0");
    }
    folder
}

/// Copies the OpenNI2 library and its driver for recordings into a folder, compiles the test's driver there, and
/// returns the library's path.
fn set_up(folder: &Path, installed: &Path) -> PathBuf {
    let (library, drivers) = (folder.join("libOpenNI2.so.0"), folder.join("OpenNI2/Drivers"));
    fs::create_dir_all(&drivers).unwrap();
    fs::copy(installed.join("libOpenNI2.so.0"), &library).unwrap();
    fs::copy(installed.join("OpenNI2/Drivers/libOniFile.so.0"), drivers.join("libOniFile.so.0")).unwrap();
    let compiler = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/cameras/openni2/driver.rs");
    let driver = drivers.join("libPlanishTest.so.0");
    let compiled = Command::new(compiler)
        .args(["--edition", "2024", "--crate-type", "cdylib", "-O", "-o"])
        .args([&driver, &source])
        .output()
        .unwrap();
    assert!(compiled.status.success(), "{}", String::from_utf8_lossy(&compiled.stderr));
    library
}

fn open(uri: &str, alignment: Option<Alignment>, mode: Option<StreamMode>) -> Result<OpenNi2Source, Error> {
    OpenNi2Source::open(uri, None, alignment, mode)
}

fn refused<T>(result: Result<T, Error>) -> String {
    result.err().expect("an error").to_string()
}

fn next(source: &mut OpenNi2Source) -> Result<Option<DepthFrame>, Error> {
    Ok(source.next_frame()?.map(|frame| match frame {
        OwnedFrame::Depth(frame) => frame,
        _ => panic!("a frame of depth"),
    }))
}

/// Checks every pixel of a frame of the test's driver, and returns the frame's number.
fn number_of(frame: &DepthFrame) -> usize {
    let Camera { width, height, .. } = frame.camera;
    let number = usize::from(frame.raw[0]) - 1000;
    let expected = (0..width * height).map(|i| (1000 + i % width + 2 * (i / width) + number) as u16);
    assert!(frame.raw.iter().copied().eq(expected), "frame {number}");
    number
}

fn focal_length(pixels: usize, field_of_view: f32) -> f64 {
    0.5 * pixels as f64 / (0.5 * f64::from(field_of_view)).tan()
}

fn mode(width: usize, height: usize, fps: Option<u32>) -> Option<StreamMode> {
    Some(StreamMode { width, height, fps })
}

/// Environment variable that passes the test's temporary folder to the child process.
const FOLDER: &str = "PLANISH_TEST_OPENNI2";

/// Name of the file in the folder of [`FOLDER`] with the number of frames after which the driver unplugs its camera.
const UNPLUG: &str = "unplug";

/// Line that the process prints at its end.
const DONE: &str = "OpenNI2: all done";

#[test]
fn cameras_stream_and_recordings_play() {
    let Some(installed) = installed() else { return };
    let folder = tempfile::tempdir().unwrap();
    let library = set_up(folder.path(), &installed);
    let output = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "openni2::in_a_process_of_its_own", "--ignored", "--nocapture"])
        .envs([(FOLDER, folder.path()), ("PLANISH_LIBOPENNI2", &library)])
        .env("PLANISH_TEST_UNPLUG", folder.path().join(UNPLUG))
        .output()
        .unwrap();
    let [said, failed] = [&output.stdout, &output.stderr].map(|bytes| String::from_utf8_lossy(bytes));
    assert!(output.status.success() && said.contains(DONE), "{said}{failed}");
}

#[test]
#[ignore = "the test above runs it in its own process, because the library's devices belong to a process"]
fn in_a_process_of_its_own() {
    let Some(folder) = std::env::var_os(FOLDER).map(PathBuf::from) else {
        eprintln!("SKIP OpenNI2: {FOLDER} names no folder");
        return;
    };
    let library = folder.join("libOpenNI2.so.0");
    planish::internal::set_longest_silence_s(3);

    a_camera_streams_in_its_mode();
    colour_comes_with_depth_that_is_mapped_to_it();
    what_it_lacks_is_refused();
    recordings_play(&library, &folder);
    one_that_is_unplugged_is_gone_and_comes_back(&folder);
    println!("{DONE}");
}

fn a_camera_streams_in_its_mode() {
    let mut source = open("", Some(Alignment::None), None).unwrap();
    assert!(source.is_live());
    assert_eq!(source.description().unwrap(), "planish test camera");
    let mut last = None;
    for _ in 0..5 {
        let frame = next(&mut source).unwrap().unwrap();
        let [fx, fy] = [focal_length(640, 1.0), focal_length(480, 0.75)];
        assert_eq!(frame.camera, Camera::new((640, 480), [fx, fy], [319.5, 239.5]));
        let number = number_of(&frame);
        assert!((frame.timestamp_s.unwrap() - 0.033_333 * number as f64).abs() < 1e-9);
        assert!(last < Some(number) && frame.rgb.is_none());
        last = Some(number);
    }
    let (before, last) = (source.dropped(), last.unwrap());
    std::thread::sleep(Duration::from_millis(400));
    // Skip the waiting frame, because it may be the oldest frame that was delivered in the meantime.
    next(&mut source).unwrap();
    let number = number_of(&next(&mut source).unwrap().unwrap());
    assert_eq!(source.dropped() - before, (number - last - 2) as u64);
    assert!(source.dropped() - before >= 5);

    source.end_with(Arc::new(AtomicBool::new(true)));
    assert!(next(&mut source).unwrap().is_none());
    drop(source);
    let mut source = open("planish-test", Some(Alignment::None), mode(320, 240, None)).unwrap();
    let frame = next(&mut source).unwrap().unwrap();
    number_of(&frame);
    assert_eq!((frame.camera.width, frame.camera.fx), (320, focal_length(320, 1.0)));
}

fn colour_comes_with_depth_that_is_mapped_to_it() {
    for alignment in [None, Some(Alignment::Colour)] {
        let mut source = open("", alignment, None).unwrap();
        let frames = std::iter::from_fn(|| next(&mut source).unwrap());
        let frame = frames.take(30).find(|frame| frame.rgb.is_some()).expect("a frame with colour");
        // Depth has the intrinsics of the colour camera, to which it is mapped.
        assert_eq!(frame.camera.fx, focal_length(640, 1.1));
        let (number, rgb) = (number_of(&frame), frame.rgb.unwrap());
        let expected = (0..640 * 480).map(|i| [(i % 640) as u8, (i / 640) as u8, rgb[2]]);
        assert!(rgb.iter().copied().eq(expected.flatten()));
        assert!(rgb[2].abs_diff(number as u8) <= 3, "{} {number}", rgb[2]);
    }
}

fn what_it_lacks_is_refused() {
    let missing = refused(open("", None, mode(1280, 1024, Some(15))));
    assert!(missing.contains("1280x1024@15") && missing.contains("320x240@30, 640x480@30"), "{missing}");
    assert!(refused(open("", Some(Alignment::Depth), None)).contains("color or none"));
    let absent = refused(open("1d27/0601@1/99", None, None));
    assert!(absent.contains("1d27/0601@1/99") && absent.contains("planish-test (planish test camera)"), "{absent}");
    let options = SourceOptions::default().with_fps(Some(30.0));
    assert!(refused(planish::source::open("openni2", &options)).contains("sets its own rate"));
}

fn one_that_is_unplugged_is_gone_and_comes_back(folder: &Path) {
    fs::write(folder.join(UNPLUG), "5").unwrap();
    let mut source = open("", Some(Alignment::None), None).unwrap();
    let gone = (0..20).find_map(|_| next(&mut source).err()).expect("an error");
    assert!(matches!(gone, Error::Device(DeviceError::Gone { .. })), "{gone}");
    drop(source);
    fs::remove_file(folder.join(UNPLUG)).unwrap();
    let back = (0..50).find_map(|_| {
        std::thread::sleep(Duration::from_millis(20));
        open("planish-test", Some(Alignment::None), None).ok()
    });
    number_of(&next(&mut back.expect("the camera")).unwrap().unwrap());
}

fn recordings_play(library: &Path, folder: &Path) {
    let file = folder.join("walk.oni");
    OpenNi2::load(library).record("planish-test", &file, Duration::from_millis(700));
    let uri = file.to_str().unwrap();
    let mut source = open(uri, None, None).unwrap();
    assert!(!source.is_live());
    let mut numbers = Vec::new();
    while let Some(frame) = next(&mut source).unwrap() {
        assert_eq!((frame.camera.width, frame.camera.fx), (320, focal_length(320, 1.0)));
        numbers.push(number_of(&frame));
    }
    assert!(numbers.len() > 10 && numbers.windows(2).all(|pair| pair[1] == pair[0] + 1), "{numbers:?}");
    assert_eq!(source.dropped(), 0);
    drop(source);
    assert!(refused(open(uri, None, mode(320, 240, None))).contains("recording"));
    // The recording does not state that its depth was mapped to colour, but the user may.
    let mut source = open(uri, Some(Alignment::Colour), None).unwrap();
    let frame = std::iter::from_fn(|| next(&mut source).unwrap()).find(|frame| frame.rgb.is_some()).unwrap();
    assert_eq!(frame.camera.fx, focal_length(320, 1.1));
    drop(source);

    assert!(refused(open(folder.join("missing.oni").to_str().unwrap(), None, None)).contains("missing.oni"));
    for (name, contents) in [("empty.oni", &b""[..]), ("text.oni", b"no recording at all")] {
        let file = folder.join(name);
        fs::write(&file, contents).unwrap();
        let (said, _) = played(&file);
        assert!(said.contains(name), "{name}: {said}");
    }
    let bytes = fs::read(&file).unwrap();
    // A truncated recording is read up to the cut, then an error follows. A shorter part is not a recording at all.
    let cut = folder.join("cut.oni");
    for share in [1, 5] {
        fs::write(&cut, &bytes[..bytes.len() * share / 10]).unwrap();
        let (said, frames) = played(&cut);
        assert!(said.contains("cut.oni") && frames <= numbers.len(), "{said}");
    }
}

/// Plays a recording to its end; returns its error, if any, and the number of frames.
fn played(file: &Path) -> (String, usize) {
    let mut source = match planish::source::open(&format!("openni2:{}", file.display()), &SourceOptions::default()) {
        Ok(source) => source,
        Err(error) => return (error.to_string(), 0),
    };
    let mut frames = 0;
    loop {
        match source.next_frame() {
            Ok(Some(_)) => frames += 1,
            Ok(None) => return (String::new(), frames),
            Err(error) => {
                // The error is returned once; then the stream ends.
                assert!(source.next_frame().unwrap().is_none());
                return (error.to_string(), frames);
            }
        }
    }
}
