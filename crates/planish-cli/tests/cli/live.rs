//! Streams and recordings.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use planish::io::{Encoding, write_cloud};
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::{Camera, DepthFrame};

use super::{json_line, ok, refused, small_frame, str, text};

#[test]
fn a_stream_is_saved_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let report =
        json_line(&ok(&["stream", "synthetic", "--frames", "5", "--engine", "cpu", "--save", str(&out), "--json"]));
    assert_eq!((report["frames_out"].as_u64(), report["dropped"].as_u64()), (Some(5), Some(0)));
    assert!(report["latency_ms"]["p99"].as_f64().unwrap() > 0.0 && report["engine"] == "cpu");
    for i in 0..5 {
        let cloud = planish::io::read_organized(&out.join(format!("{i:06}.pcd"))).unwrap();
        assert!(cloud.points.attribute("rgb").is_some() && cloud.points.valid_points() > 200_000);
    }
    if !cfg!(feature = "rerun") {
        assert!(refused(&["stream", "synthetic", "--rerun"]).contains("without the feature rerun"));
    }
    assert!(refused(&["stream", "no-such-source"]).contains("expected kinect"));
    assert!(refused(&["stream", "synthetic:x"]).contains("whole number"));
    assert!(refused(&["stream", "synthetic", "--reconnect"]).contains("applies only to cameras"));
}

#[test]
fn a_stream_that_settings_do_not_fit_writes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let saved = folder.path().join("frames");
    for settings in [&["--neighbours", "30"][..], &["--sensor", "auto", "--neighbours", "30"]] {
        refused(&[&["stream", "synthetic", "--frames", "1", "--save", str(&saved)], settings].concat());
        assert!(!saved.exists());
    }
}

#[test]
fn a_recording_streams_back() {
    let folder = tempfile::tempdir().unwrap();
    let recording = folder.path().join("recording");
    let report = json_line(&ok(&["record", "synthetic:3", str(&recording), "--frames", "4", "--json"]));
    assert_eq!(report["frames"], 4);
    let saved = folder.path().join("saved");
    let report = json_line(&ok(&["stream", str(&recording), "--save", str(&saved), "--format", "png", "--json"]));
    assert_eq!(report["frames_out"], 4);
    // Saved frames form a data set again, with names, colour, camera, units and timestamps.
    let names = |folder: &Path| -> Vec<String> {
        let files = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<String> = files.filter(|name| name.ends_with(".png")).collect();
        names.sort();
        names
    };
    assert_eq!(names(&saved), names(&recording.join("depth")));
    for name in names(&recording.join("rgb")) {
        let colour = |folder: &Path| planish::io::read_rgb_png(&folder.join("rgb").join(&name)).unwrap();
        assert_eq!(colour(&saved), colour(&recording));
    }
    let again = json_line(&ok(&["stream", str(&saved), "--json"]));
    assert_eq!(again["frames_out"], report["frames_out"]);
    let stamps = |list: &Path| -> Vec<f64> {
        let text = fs::read_to_string(list.join("depth.txt")).unwrap();
        let lines = text.lines().filter(|line| !line.starts_with('#'));
        lines.map(|line| line.split(' ').next().unwrap().parse().unwrap()).collect()
    };
    assert_eq!(stamps(&saved), stamps(&recording));
    let camera = |folder: &Path| fs::read_to_string(folder.join("camera.json")).unwrap();
    assert_eq!(camera(&saved), camera(&recording));
    // An existing data set is not overwritten.
    let list = fs::read(saved.join("depth.txt")).unwrap();
    assert!(
        refused(&["stream", str(&recording), "--save", str(&saved), "--format", "png"])
            .contains("the folder is not empty")
    );
    assert_eq!(fs::read(saved.join("depth.txt")).unwrap(), list);
    assert!(refused(&["record", "synthetic", str(&recording), "--frames", "1"]).contains("the folder is not empty"));
    #[cfg(feature = "mcap")]
    {
        let bag = folder.path().join("walk.mcap");
        ok(&["record", "synthetic", str(&bag), "--frames", "2"]);
        let bytes = fs::read(&bag).unwrap();
        assert!(refused(&["record", "synthetic", str(&bag), "--frames", "1"]).contains("already exists"));
        assert!(refused(&["stream", str(&recording), "--save", str(&bag)]).contains("already exists"));
        assert!(fs::read(&bag).unwrap() == bytes);
    }
}

#[test]
fn frames_are_saved_under_their_own_names() {
    let folder = tempfile::tempdir().unwrap();
    let [frames, saved] = ["frames", "saved"].map(|name| folder.path().join(name));
    fs::create_dir(&frames).unwrap();
    let cloud = small_frame(1).deproject().unwrap();
    for name in ["kitchen.pcd", "kitchen.ply", "yard.pcd"] {
        write_cloud(&frames.join(name), &cloud, Encoding::Binary).unwrap();
    }
    ok(&["stream", str(&frames), "--engine", "cpu", "--save", str(&saved)]);
    let names = fs::read_dir(&saved).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let mut names: Vec<String> = names.collect();
    names.sort();
    assert_eq!(names, ["kitchen-000001.pcd", "kitchen.pcd", "yard.pcd"]);
    let before = fs::read(frames.join("yard.pcd")).unwrap();
    assert!(refused(&["stream", str(&frames), "--save", str(&frames)]).contains("is the input"));
    assert_eq!(fs::read(frames.join("yard.pcd")).unwrap(), before);
}

#[test]
fn a_stream_that_is_killed_leaves_only_whole_files() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let mut child = Command::new(env!("CARGO_BIN_EXE_planish"))
        .args(["stream", "synthetic", "--frames", "20", "--engine", "cpu", "--save", str(&out)])
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    let saved = || {
        let entries = fs::read_dir(&out).into_iter().flatten().flatten().map(|entry| entry.path());
        entries.filter(|path| path.extension().is_some_and(|extension| extension == "pcd")).collect::<Vec<_>>()
    };
    while saved().len() < 5 {
        assert!(child.try_wait().unwrap().is_none_or(|status| status.success()), "it ended early");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    for file in saved() {
        assert_eq!(planish::io::read_organized(&file).unwrap().points.len(), 640 * 480);
    }
}

/// Returns libfreenect's playback library, if installed.
fn playback_library() -> Option<PathBuf> {
    let folders = fs::read_dir("/usr/lib").into_iter().flatten().flatten().map(|entry| entry.path());
    let library = folders.map(|folder| folder.join("fakenect/libfreenect.so.0.5")).find(|library| library.exists());
    assert!(library.is_some() || std::env::var_os("PLANISH_REQUIRE_FREENECT").is_none(), "no libfreenect0.5");
    if library.is_none() {
        eprintln!("SKIP the Kinect: no playback library of libfreenect");
    }
    library
}

#[test]
fn a_kinect_that_plays_a_recording_is_recorded_and_streams_back() {
    let Some(library) = playback_library() else { return };
    let folder = tempfile::tempdir().unwrap();
    let camera = Camera::kinect_v1();
    let (scene, pose) = Scene::tabletop(1);
    let truth = scene.render(&camera, &pose);
    let simulator = DepthSimulator::new(DepthNoise::default(), camera, 1);
    let frames: Vec<DepthFrame> =
        (0..6).map(|i| simulator.frame(&truth, i).unwrap().with_timestamp_s(i as f64 / 30.0)).collect();
    let played = folder.path().join("played");
    planish::internal::write_freenect_recording(&played, &frames).unwrap();

    let kinect = |arguments: &[&str], recording: &Path| {
        Command::new(env!("CARGO_BIN_EXE_planish"))
            .args(arguments)
            .env("PLANISH_LIBFREENECT", &library)
            .env("FAKENECT_PATH", recording)
            .output()
            .unwrap()
    };
    let recorded = folder.path().join("recorded");
    let output = kinect(&["record", "kinect", str(&recorded)], &played);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let mut source = planish::source::TumSource::open(&recorded, None, None).unwrap();
    let mut count = 0;
    while let Some(frame) = planish::source::Source::next_frame(&mut source).unwrap() {
        let planish::source::OwnedFrame::Depth(found) = frame else { panic!("a depth frame") };
        // A busy machine may miss frames; each delivered frame must be one of the played frames.
        let number = (found.timestamp_s.unwrap() * 30.0).round() as usize;
        for (found, expected) in found.raw.iter().zip(&frames[number].raw) {
            let (found, z) = (f64::from(*found) / 5000.0, f64::from(*expected) / 1000.0);
            let within_a_step = (found - z).abs() <= 0.5 * 3.1e-3 * z * z + 1e-3;
            assert!(within_a_step || !(0.4..9.0).contains(&z), "{found} {z}");
        }
        count += 1;
    }
    assert!((1..=6).contains(&count));

    let output = kinect(&["stream", "kinect", "--json", "--engine", "cpu"], &played);
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert!(json_line(&text(&output.stdout))["frames_out"].as_u64().unwrap() >= 1);
    // Without a recording, the library itself would end the process.
    let output = kinect(&["stream", "kinect"], &folder.path().join("none"));
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("FAKENECT_PATH"));
}

#[test]
fn a_kinect_without_driver_or_device_says_so() {
    let stream = |library: &Path| {
        let output = Command::new(env!("CARGO_BIN_EXE_planish"))
            .args(["stream", "kinect"])
            .env("PLANISH_LIBFREENECT", library)
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(2));
        text(&output.stderr)
    };
    assert!(stream(Path::new("/nonexistent/libfreenect.so")).contains("install libfreenect"));
    let Some(library) = playback_library() else { return };
    // The real library is in the parent folder of the playback library.
    let real = library.ancestors().nth(2).unwrap().join("libfreenect.so.0.5");
    let said = stream(&real);
    assert!(said.contains("Kinect number 0 not found") || said.contains("cannot start libfreenect"), "{said}");
}

#[test]
fn a_camera_that_is_not_there_yet_is_waited_for_and_a_missing_driver_is_not() {
    let stream = |variables: &[(&str, &str)]| {
        let output = Command::new(env!("CARGO_BIN_EXE_planish"))
            .args(["stream", "openni2", "--reconnect", "--duration", "1"])
            .envs(variables.iter().copied())
            .output()
            .unwrap();
        (output.status.code(), text(&output.stderr))
    };
    let (code, said) = stream(&[("PLANISH_LIBOPENNI2", "/nonexistent/libOpenNI2.so")]);
    assert!(code == Some(2) && said.contains("install OpenNI2") && !said.contains("waiting"), "{code:?} {said}");
    let (code, said) = stream(&[]);
    if said.contains("install OpenNI2") {
        assert!(std::env::var_os("PLANISH_REQUIRE_OPENNI2").is_none(), "{said}");
        eprintln!("SKIP: there is no OpenNI2");
        return;
    }
    assert!(
        code == Some(0) && said.contains("no OpenNI2 camera: none found") && said.contains("waiting"),
        "{code:?} {said}"
    );
}

#[cfg(feature = "mcap")]
#[test]
fn time_stamps_that_ros_cannot_hold_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (set, recording) = (folder.path().join("set"), folder.path().join("walk.mcap"));
    ok(&["record", "synthetic", str(&set), "--frames", "1"]);
    let list = fs::read_to_string(set.join("depth.txt")).unwrap();
    let image = list.lines().last().unwrap().split_whitespace().nth(1).unwrap().to_owned();
    let _ = fs::remove_file(set.join("rgb.txt"));
    for stamp in ["2147483648", "-0.5", "1e18", "1e300"] {
        fs::write(set.join("depth.txt"), format!("{stamp} {image}\n")).unwrap();
        let error = refused(&["record", str(&set), str(&recording)]);
        assert!(error.contains("the timestamp") && error.contains("2147483647"), "{error}");
        assert!(!recording.exists() && !recording.with_extension("mcap.part").exists(), "{stamp}");
    }
    fs::write(set.join("depth.txt"), format!("2147483647.5 {image}\n")).unwrap();
    ok(&["record", str(&set), str(&recording)]);
}

#[cfg(feature = "mcap")]
#[test]
fn a_source_of_damaged_frames_leaves_no_recording() {
    let folder = tempfile::tempdir().unwrap();
    let (set, recording) = (folder.path().join("set"), folder.path().join("walk.mcap"));
    ok(&["record", "synthetic", str(&set), "--frames", "1"]);
    let list = fs::read_to_string(set.join("depth.txt")).unwrap();
    let image = list.lines().last().unwrap().split_whitespace().nth(1).unwrap();
    fs::write(set.join(image), "cut").unwrap();
    let _ = fs::remove_file(set.join("rgb.txt"));
    let stream = ["stream", str(&set), "--save", str(&recording)];
    for arguments in [&["record", str(&set), str(&recording)][..], &stream] {
        let output = Command::new(env!("CARGO_BIN_EXE_planish")).args(arguments).output().unwrap();
        let said = text(&output.stderr);
        assert!(!output.status.success() && said.contains("damaged PNG"), "{arguments:?}: {said}");
        assert!(!recording.exists() && !planish::bag::part_of(&recording).exists(), "{arguments:?}");
    }
}
