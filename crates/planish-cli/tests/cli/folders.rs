//! Folders of frames: each frame has the same result as on its own.

use std::fs;
use std::path::Path;

use planish::DepthImage;
use planish::io::{self, Encoding, write_cloud};
use serde_json::Value;

use super::{CAMERA, json_line, ok, planish, refused, small_frame, str, text, with_frame};

#[test]
fn a_folder_goes_on_after_a_bad_file_and_says_so_at_the_end() {
    let (folder, _, path) = with_frame();
    let (input, output) = (folder.path().join("in"), folder.path().join("out"));
    fs::create_dir(&input).unwrap();
    for name in ["a.pcd", "c.pcd"] {
        fs::copy(&path, input.join(name)).unwrap();
    }
    fs::write(input.join("b.pcd"), "no cloud").unwrap();
    fs::write(input.join("notes.txt"), "neither depth nor points").unwrap();
    let result = planish(&["smooth", str(&input), str(&output), "--json"]);
    assert_eq!(result.status.code(), Some(1));
    let report: Value = serde_json::from_slice(&result.stdout).unwrap();
    assert_eq!((report["frames"].as_array().unwrap().len(), report["failed"].as_array().unwrap().len()), (2, 1));
    assert!(report["failed"][0]["input"].as_str().unwrap().ends_with("b.pcd"));
    assert!(text(&result.stderr).contains("b.pcd"));
    let mut names: Vec<_> = fs::read_dir(&output).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(names, ["a.pcd", "c.pcd"]);
    assert!(refused(&["smooth", str(&input), str(&input)]).contains("--overwrite"));
}

#[test]
fn a_folder_of_clouds_and_depth_images_gives_each_what_it_gets_alone() {
    // The engine stays open between frames of the same shape. The second frame must get outputs that the first did
    // not need.
    let (folder, _, path) = with_frame();
    let (input, output) = (folder.path().join("in"), folder.path().join("out"));
    fs::create_dir(&input).unwrap();
    fs::copy(&path, input.join("a.pcd")).unwrap();
    let image = DepthImage { width: 160, height: 120, raw: small_frame(2).raw };
    io::write_depth(&input.join("b.png"), &image).unwrap();
    ok(&["smooth", str(&input), str(&output), "--camera", CAMERA]);
    let alone = folder.path().join("alone.png");
    ok(&["smooth", str(&input.join("b.png")), str(&alone), "--camera", CAMERA]);
    assert_eq!(io::read(&output.join("b.png")).unwrap(), io::read(&alone).unwrap());
}

#[test]
fn two_frames_that_would_take_one_name_are_refused_before_anything_is_written() {
    let (folder, _, path) = with_frame();
    let (input, output) = (folder.path().join("in"), folder.path().join("out"));
    fs::create_dir(&input).unwrap();
    fs::copy(&path, input.join("a.pcd")).unwrap();
    fs::copy(&path, input.join("a.ply")).unwrap();
    let message = refused(&["smooth", str(&input), str(&output), "--format", "ply"]);
    assert!(message.contains("a.pcd") && message.contains("a.ply"), "{message}");
    assert_eq!(fs::read_dir(&output).unwrap().count(), 0);
}

#[test]
fn frames_of_a_folder_are_the_same_one_by_one_and_beside_each_other() {
    let folder = tempfile::tempdir().unwrap();
    let input = folder.path().join("in");
    fs::create_dir(&input).unwrap();
    for seed in 0..9 {
        let name = input.join(format!("{seed}.png"));
        let frame = small_frame(seed);
        let (width, height) = (frame.camera.width, frame.camera.height);
        planish::io::write_depth(&name, &planish::DepthImage { width, height, raw: frame.raw }).unwrap();
    }
    fs::write(input.join("5.png"), "no picture").unwrap();
    write_cloud(&input.join("7.ply"), &small_frame(3).deproject().unwrap(), Encoding::Binary).unwrap();
    // This frame needs more than a worker's share of the memory although its file is small, so it is retried alone.
    let flat = planish::DepthImage { width: 1000, height: 800, raw: vec![1500; 800_000] };
    planish::io::write_depth(&input.join("6.png"), &flat).unwrap();
    let scan = planish::PointCloud::new((0..30_000).map(|i| [(i % 200) as f32, (i / 200) as f32, 1.0]).collect());
    write_cloud(&input.join("8.pcd"), &scan, Encoding::Binary).unwrap();
    let camera = small_frame(0).camera;
    let camera = format!("{},{},{},{}", camera.fx, camera.fy, camera.cx, camera.cy);
    let smooth = |name: &str, options: &[&str]| {
        let out = folder.path().join(name);
        let arguments = ["smooth", str(&input), str(&out), "--camera", &camera, "--engine", "cpu", "--force", "--json"];
        let run = planish(&[&arguments, options].concat());
        assert_eq!(run.status.code(), Some(1), "{}", text(&run.stderr));
        assert_eq!(text(&run.stderr).matches("5.png").count(), 1, "{}", text(&run.stderr));
        let report = json_line(&text(&run.stdout));
        let inputs: Vec<_> = report["frames"].as_array().unwrap().iter().map(|frame| frame["input"].clone()).collect();
        assert_eq!(report["failed"].as_array().unwrap().len(), 1, "{report}");
        let mut files: Vec<_> = fs::read_dir(&out).unwrap().map(|entry| entry.unwrap().path()).collect();
        files.sort();
        (inputs, files.iter().map(|file| fs::read(file).unwrap()).collect::<Vec<_>>())
    };
    let one_by_one = smooth("one", &["--threads", "1"]);
    assert_eq!((one_by_one.0.len(), one_by_one.1.len()), (10, 10));
    assert!(smooth("many", &["--threads", "4"]) == one_by_one);
    assert!(smooth("little", &["--threads", "4", "--max-memory", "200M"]) == one_by_one);
}

#[test]
fn a_folder_is_a_video_in_the_order_of_its_numbers() {
    let folder = tempfile::tempdir().unwrap();
    let [input, alone, video] = ["in", "alone", "video"].map(|name| folder.path().join(name));
    fs::create_dir(&input).unwrap();
    // A wall that approaches by 5 mm per frame. A frame out of order would restart temporal smoothing.
    for t in 0..12 {
        let noise = |i: usize| ((i * 7919 + t * 104_729) % 13) as u16;
        let raw = (0..160 * 120).map(|i| 2000 - 5 * t as u16 + noise(i)).collect();
        io::write_depth(&input.join(format!("frame{t}.png")), &DepthImage { width: 160, height: 120, raw }).unwrap();
    }
    let report = ok(&["smooth", str(&input), str(&video), "--camera", CAMERA, "--temporal", "steady", "--json"]);
    let report: Value = serde_json::from_str(&report).unwrap();
    let names: Vec<&str> =
        report["frames"].as_array().unwrap().iter().map(|frame| frame["input"].as_str().unwrap()).collect();
    assert!(names[2].ends_with("frame2.png") && names[11].ends_with("frame11.png"), "{names:?}");
    ok(&["smooth", str(&input), str(&alone), "--camera", CAMERA]);
    let read = |folder: &Path, t: usize| io::read(&folder.join(format!("frame{t}.png"))).unwrap();
    assert_eq!(read(&video, 0), read(&alone, 0));
    assert_ne!(read(&video, 11), read(&alone, 11));
    let message =
        refused(&["smooth", str(&input), str(&video), "--overwrite", "--temporal", "steady", "--repeat", "3"]);
    assert!(message.contains("--repeat"), "{message}");
    assert!(refused(&["evaluate", "--temporal", "steady"]).contains("only for consecutive frames of a camera"));
}
