//! Temporal smoothing: measured on videos, and with the poses of a camera.

use std::fs;

use serde_json::Value;

use super::{ok, planish, refused, str, text};

#[test]
fn videos_are_measured_simulated_exported_and_from_folders() {
    let folder = tempfile::tempdir().unwrap();
    let (exported, pictures) = (folder.path().join("exported"), folder.path().join("pictures"));
    let quick = ["--frames", "10", "--preset", "light"];
    let run = |arguments: &[&str]| ok(&[&["evaluate"], arguments, &quick].concat());
    let scores = |arguments: &[&str]| -> Value { serde_json::from_str(&run(arguments)).unwrap() };
    let simulated = scores(&["--sequence", "moving-camera", "--out", str(&pictures), "--json"]);
    let ways = simulated[0]["ways"].as_array().unwrap();
    let rms = |way: usize| ways[way]["far"]["rms_mm"].as_f64().unwrap();
    assert_eq!(ways.len(), 5);
    assert_eq!(ways[3]["name"], "steady, tracked");
    assert!(rms(1) < rms(0) && rms(3) < rms(1) && rms(4) < rms(1), "{simulated}");
    assert_eq!(simulated[0]["moved_frames"]["steady, tracked"], 9);
    let animation = fs::read(pictures.join("moving-camera.png")).unwrap();
    assert!(animation.windows(4).any(|chunk| chunk == b"acTL"));

    // The exported frames give the same scores. Another program's results are measured alongside planish's.
    run(&["--sequence", "still", "--export", str(&exported)]);
    let still = exported.join("still");
    let camera_file = still.join("camera.json");
    let found = scores(&[
        "--sequence",
        "--input",
        str(&still),
        "--camera-file",
        str(&camera_file),
        "--results",
        str(&still),
        "--json",
    ]);
    let ways = found[0]["ways"].as_array().unwrap();
    assert_eq!((found[0]["frames"].as_u64(), ways.len()), (Some(10), 4));
    assert_eq!((&ways[3]["name"], &ways[3]["far"]), (&"still".into(), &ways[0]["far"]));

    assert!(refused(&["evaluate", "--sequence", "standing"]).contains("still, fixed-pattern"));
    assert!(
        refused(&["evaluate", "--sequence", "still", "--input", str(&still)])
            .contains("cannot be combined with --input")
    );
    assert!(
        refused(&["evaluate", "--sequence", "--input", str(&still.join("0000.png"))]).contains("is a single frame")
    );
    assert!(refused(&["evaluate", "--sequence", "--temporal", "off"]).contains("--temporal off"));
    assert!(refused(&["evaluate", "--frames", "3"]).contains("--sequence"));
    assert!(refused(&["evaluate", "--results", "a", "--results", "b"]).contains("only with --sequence"));
    let message = refused(&["evaluate", "--sequence", "--input", str(&still)]);
    assert!(message.contains("needs its camera"), "{message}");
}

#[test]
fn poses_of_a_folder_are_read_and_checked() {
    let folder = tempfile::tempdir().unwrap();
    let frames = folder.path().join("frames");
    let arguments = ["evaluate", "--sequence", "moving-camera", "--export", str(folder.path()), "--frames", "4"];
    ok(&arguments);
    fs::rename(folder.path().join("moving-camera"), &frames).unwrap();
    let camera_file = frames.join("camera.json");
    let (poses, smoothed) = (folder.path().join("poses.log"), folder.path().join("smoothed"));
    let block = |k: u32| format!("{k} {k} {}\n1 0 0 {}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", k + 1, 0.01 * f64::from(k));
    let smooth = ["smooth", str(&frames), str(&smoothed), "--overwrite", "--camera-file", str(&camera_file)];
    let smooth = [&smooth[..], &["--poses", str(&poses)]].concat();
    let given = [&smooth[..], &["--temporal", "steady"]].concat();
    fs::write(&poses, (0..3).map(block).collect::<String>()).unwrap();
    assert!(refused(&given).contains("has 3 poses without timestamps") && !smoothed.exists());
    fs::write(&poses, (0..4).map(block).collect::<String>()).unwrap();
    ok(&given);
    let by_time = folder.path().join("poses.txt");
    fs::write(&by_time, "\u{feff}0 0 0 0 0 0 0 1\n0.1 0 0 0 0 0 0 1\n").unwrap();
    let output = planish(&[&smooth[..6], &["--poses", str(&by_time), "--temporal", "steady"]].concat());
    let message = text(&output.stderr);
    assert!(output.status.success() && message.contains("has no pose for 3 frames"), "{message}");
    ok(&given);
    let clouds = folder.path().join("clouds");
    let as_clouds =
        [&given[..2], &[str(&clouds)], &given[3..], &["--format", "pcd", "--fields", "frames,status"]].concat();
    ok(&as_clouds);
    let heading = fs::read(clouds.join("0003.pcd")).unwrap();
    assert!(text(&heading[..200]).contains("FIELDS x y z status frames"));
    let message = refused(&[&smooth[..6], &["--format", "pcd", "--fields", "frames"]].concat());
    assert!(message.contains("--fields = frames") && message.contains("temporal"), "{message}");
    // According to the poses, the camera moved by 1 cm between the second and third frame, so the carried state
    // differs from that without poses.
    let without_poses = folder.path().join("without");
    ok(&["smooth", str(&frames), str(&without_poses), "--camera-file", str(&camera_file), "--temporal", "steady"]);
    let differs = |name: &str| fs::read(smoothed.join(name)).unwrap() != fs::read(without_poses.join(name)).unwrap();
    assert!(!differs("0000.png") && differs("0002.png"));
    fs::write(&poses, "0 0 1\n2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n").unwrap();
    assert!(refused(&given).contains("not a rotation"));
    assert!(refused(&smooth).contains("--temporal steady"));
    assert!(refused(&[&smooth[..], &["--track"]].concat()).contains("cannot be combined"));
}
