//! Rigs, and multiple devices.

use std::fs;
use std::path::{Path, PathBuf};

use planish::PointCloud;
use planish::io::{self, Contents};

use super::{json_line, ok, refused, str};

/// Simulates two cameras with three frames each; returns the temporary folder and the path of rig.json.
fn simulated() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let rig = folder.path().join("rig");
    ok(&["rig", "--simulate", "2", "--frames", "3", "--out", str(&rig)]);
    (folder, rig.join("rig.json"))
}

fn read(path: &Path) -> PointCloud {
    match io::read(path).unwrap().1 {
        Contents::General(cloud) => cloud,
        Contents::Organized(cloud) => cloud.points,
        _ => panic!("{}: no cloud", path.display()),
    }
}

/// Returns all files below a folder with their bytes, sorted by path.
fn files(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() { found.extend(files(&path)) } else { found.push((path.clone(), fs::read(&path).unwrap())) }
    }
    found.sort();
    found
}

#[test]
fn a_rig_is_streamed_saved_and_what_is_saved_is_a_rig_again() {
    let (folder, rig) = simulated();
    let path = |name: &str| folder.path().join(name);
    let (fused, cameras, picture) = (path("fused"), path("cameras"), path("above.png"));
    let outputs = ["--save", str(&fused), "--save-cameras", str(&cameras), "--picture", str(&picture)];
    let stream = ["stream", "--rig", str(&rig), "--engine", "cpu", "--format", "png", "--json"];
    let report = json_line(&ok(&[&stream[..], &outputs].concat()));
    assert_eq!((report["moments"].as_u64(), report["complete"].as_u64()), (Some(3), Some(3)));
    let points = read(&fused.join("000002.pcd"));
    assert!(points.len() > 200_000 && points.attribute("camera").is_some());
    assert!(picture.is_file());

    let again = path("again");
    let saved = cameras.join("rig.json");
    let report = json_line(&ok(&["stream", "--rig", str(&saved), "--save", str(&again), "--engine", "cpu", "--json"]));
    assert_eq!(report["complete"], 3);
    assert_eq!(read(&again.join("000000.pcd")).len().abs_diff(points.len()) * 50 / points.len(), 0);

    // Existing files (results, measured frames, the rig) are kept.
    let before = files(folder.path());
    let source = rig.parent().unwrap().join("camera0");
    for (outputs, said) in [
        (["--save", str(&fused)], "is not empty"),
        (["--save-cameras", str(&cameras)], "is not empty"),
        (["--save", str(&source)], "is not empty"),
        (["--picture", str(&rig)], ".png"),
        (["--picture", str(&source.join("depth/new.png"))], "part of the input"),
        (["--picture", str(&path("none/above.png"))], "its parent folder does not exist"),
    ] {
        let stderr = refused(&[&["stream", "--rig", str(&rig)], &outputs[..]].concat());
        assert!(stderr.contains(said), "{outputs:?}: {stderr}");
    }
    let both = str(&path("both")).to_owned();
    let stderr = refused(&["stream", "--rig", str(&rig), "--save", &both, "--save-cameras", &both]);
    assert!(stderr.contains("need separate folders"), "{stderr}");
    let within = str(&path("both").join("within")).to_owned();
    assert!(
        refused(&["stream", "--rig", str(&rig), "--save", &within, "--save-cameras", &both])
            .contains("neither inside the other")
    );
    assert!(refused(&["stream", "synthetic", "--picture", "a.png"]).contains("--rig"));
    assert!(refused(&["stream", str(&rig)]).contains("stream --rig"));
    assert!(files(folder.path()) == before);
}

#[test]
fn a_simulated_rig_is_there_as_a_whole_or_not_at_all() {
    let folder = tempfile::tempdir().unwrap();
    // If the output's name is that of an existing file, nothing is left next to that file.
    let file = folder.path().join("file");
    fs::write(&file, "mine").unwrap();
    let simulate = |out: &Path| {
        ["rig", "--simulate", "2", "--frames", "1", "--out"]
            .map(str::to_owned)
            .into_iter()
            .chain([out.to_str().unwrap().to_owned()])
            .collect::<Vec<_>>()
    };
    let refused_into = |out: &Path| refused(&simulate(out).iter().map(String::as_str).collect::<Vec<_>>());
    refused_into(&file);
    assert_eq!((fs::read_dir(folder.path()).unwrap().count(), fs::read(&file).unwrap()), (1, b"mine".to_vec()));
    // Write into an existing empty folder, and into a folder whose parents do not exist.
    let rig = folder.path().join("rig");
    fs::create_dir(&rig).unwrap();
    for out in [&rig, &folder.path().join("new/parent/rig")] {
        ok(&simulate(out).iter().map(String::as_str).collect::<Vec<_>>());
        let mut names: Vec<_> = fs::read_dir(out).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        assert_eq!(names, ["camera0", "camera1", "rig.json"]);
    }
    let before = files(folder.path());
    assert!(refused_into(&rig).contains("is not empty"));
    let of_calibrations = refused(&["rig", str(&rig.join("rig.json")), "--scale", "2"]);
    assert!(of_calibrations.contains("--scale applies to calibrations"), "{of_calibrations}");
    assert!(files(folder.path()) == before);
}

#[test]
fn a_rig_that_is_written_elsewhere_finds_its_sources() {
    let (folder, rig) = simulated();
    let elsewhere = folder.path().join("elsewhere");
    fs::create_dir(&elsewhere).unwrap();
    let copy = elsewhere.join("copy.json");
    ok(&["rig", str(&rig), "--out", str(&copy)]);
    let report = json_line(&ok(&["stream", "--rig", str(&copy), "--engine", "cpu", "--frames", "1", "--json"]));
    assert_eq!(report["complete"], 1);
}

#[test]
fn frames_are_dealt_to_the_devices_that_are_named() {
    let (_folder, rig) = simulated();
    let source = rig.parent().unwrap().join("camera0");
    let report = json_line(&ok(&["stream", str(&source), "--gpus", "cpu", "--json"]));
    assert_eq!((report["frames_out"].as_u64(), report["engine"].as_str()), (Some(3), Some("cpu")));
    let report = json_line(&ok(&["stream", "--rig", str(&rig), "--gpus", "cpu", "--json"]));
    assert_eq!((report["complete"].as_u64(), report["engine"].as_str()), (Some(3), Some("cpu")));
    let (frames, smoothed) = (source.join("depth"), source.join("smoothed"));
    let camera = ["--camera", "525,525,319.5,239.5", "--depth-units-per-metre", "5000"];
    let report =
        json_line(&ok(&[&["smooth", str(&frames), str(&smoothed), "--gpus", "cpu", "--json"], &camera[..]].concat()));
    assert!(report["frames"].as_array().unwrap().iter().all(|frame| frame["engine"] == "cpu"));

    for (arguments, said) in [
        (["--gpus", "cpu,cpu"], "the CPU twice"),
        (["--gpus", "no such gpu"], "no such gpu"),
        (["--gpus", ""], "--gpus"),
    ] {
        let stderr = refused(&[&["stream", str(&source)], &arguments[..]].concat());
        assert!(stderr.contains(said), "{stderr}");
    }
    let stderr = refused(&["stream", str(&source), "--gpus", "cpu", "--engine", "reference"]);
    assert!(stderr.contains("--gpus = cpu is not allowed: only with the engine auto or gpu"), "{stderr}");
    let one = fs::read_dir(&frames).unwrap().next().unwrap().unwrap().path();
    let stderr = refused(&["smooth", str(&one), "out.png", "--gpus", "cpu"]);
    assert!(stderr.contains("applies to folders"), "{stderr}");
}

#[test]
fn merged_points_in_voxels_are_one_a_voxel_and_each_camera_s_own_beside() {
    let (folder, rig) = simulated();
    let (fused, own) = (folder.path().join("fused"), folder.path().join("own"));
    let stream = ["stream", "--rig", str(&rig), "--fuse", "merged", "--voxel", "0.02", "--engine", "cpu"];
    let save = ["--save", str(&fused), "--save-cameras", str(&own), "--fields", "normals"];
    ok(&[&stream[..], &save].concat());
    let cloud = read(&fused.join("000002.pcd"));
    assert!(cloud.len() > 5_000 && cloud.valid_points() == cloud.len(), "{}", cloud.len());
    assert!(planish::clean::voxel_downsample(&cloud, 0.02).unwrap().len() == cloud.len());
    assert!(cloud.attribute("camera").is_some() && cloud.attribute("normal_x").is_some());
    for camera in ["camera0", "camera1"] {
        let frames = files(&own.join(camera));
        assert!(frames.len() >= 3, "{camera}");
    }
    // Invalid voxel sizes are refused, and so are voxels without `--fuse merged`.
    let none = folder.path().join("none");
    for size in ["0", "nan", "-0.01", "inf", "1e-9"] {
        let voxel = format!("--voxel={size}");
        let said = refused(&["stream", "--rig", str(&rig), "--fuse", "merged", &voxel, "--save", str(&none)]);
        assert!(said.contains("voxel"), "{said}");
        assert!(!none.exists(), "{size}");
    }
    let small = ["--fuse", "merged", "--voxel", "0.02", "--radius", "0.01", "--save", str(&none)];
    let said = refused(&[&["stream", "--rig", str(&rig)], &small[..]].concat());
    assert!(said.contains("two voxels") && !none.exists(), "{said}");
    assert!(refused(&["stream", "synthetic", "--voxel", "0.01"]).contains("--rig"));
    let said = refused(&["stream", "--rig", str(&rig), "--voxel", "0.01"]);
    assert!(said.contains("--fuse merged"), "{said}");
}
