//! Filled holes: flagged in every file, measured, and refused if the output cannot flag them.

use std::fs;

use planish::io::{self, Contents, Encoding};
use planish::{Camera, DepthImage, Origin, OwnedFrame, Status};

use super::{json_line, ok, refused, small_frame, str};

/// Returns a folder with a depth image that has a 4x4-pixel hole in a flat part, its camera as an option value, and
/// the indices of the hole's pixels.
fn with_hole() -> (tempfile::TempDir, String, Vec<usize>) {
    let folder = tempfile::tempdir().unwrap();
    let mut frame = small_frame(1);
    let Camera { width, height, fx, fy, cx, cy, .. } = frame.camera;
    let hole: Vec<usize> = (0..16).map(|k| (100 + k / 4) * width + 80 + k % 4).collect();
    assert!(hole.iter().all(|&i| frame.raw[i] != 0));
    hole.iter().for_each(|&i| frame.raw[i] = 0);
    io::write_depth(&folder.path().join("depth.png"), &DepthImage { width, height, raw: frame.raw }).unwrap();
    (folder, format!("{fx},{fy},{cx},{cy}"), hole)
}

#[test]
fn files_flag_filled_pixels() {
    let (folder, camera, hole) = with_hole();
    let path = |name: &str| folder.path().join(name);
    let smooth = |to: &str, more: &[&str]| {
        let (from, to) = (path("depth.png"), path(to));
        json_line(&ok(&[&["smooth", str(&from), str(&to), "--camera", &camera, "--json"], more].concat()))
    };
    let report = smooth("filled.png", &["--fill", "6"]);
    let count = report["status"]["filled"].as_u64().unwrap();
    assert!((16..2000).contains(&count), "{report}");
    let Contents::Depth(image) = io::read(&path("filled.png")).unwrap().1 else { panic!("depth") };
    let picture = planish::io::read_rgb_png(&path("filled.origin.png")).unwrap();
    let mask: Vec<u8> = picture.rgb.iter().step_by(3).copied().collect();
    let is = |origin: Origin| move |value: &&u8| **value == origin.mask_value();
    assert_eq!(mask.iter().filter(is(Origin::Filled)).count() as u64, count);
    assert!(hole.iter().all(|&i| mask[i] == Origin::Filled.mask_value() && image.raw[i] != 0));
    let holes = image.raw.iter().filter(|raw| **raw == 0).count();
    assert_eq!(mask.iter().filter(is(Origin::None)).count(), holes);
    // With `--fill`, a cloud has the field `status` even without `--fields status`.
    smooth("filled.pcd", &["--fill", "6", "--fields", "normals,sigma"]);
    let Contents::Organized(cloud) = io::read(&path("filled.pcd")).unwrap().1 else { panic!("organized") };
    let (status, sigma) = (cloud.points.attribute("status").unwrap(), cloud.points.attribute("sigma").unwrap());
    for &i in &hole {
        assert_eq!(status.values.get_f64(i) as u8, Status::Filled as u8);
        assert!(cloud.positions().is_finite(i) && sigma.values.get_f64(i) > 0.0);
    }
    smooth("unfilled.png", &[]);
    assert!(!path("unfilled.origin.png").exists());
    // Clouds in which no hole was filled also have the field `status`.
    smooth("full.pcd", &["--fill", "1"]);
    let Contents::Organized(cloud) = io::read(&path("full.pcd")).unwrap().1 else { panic!("organized") };
    assert!(cloud.points.attribute("status").is_some());
}

#[test]
fn a_mask_replaces_no_other_file_and_no_depth_is_without_one() {
    let (folder, camera, _) = with_hole();
    let path = |name: &str| folder.path().join(name);
    fs::copy(path("depth.png"), path("in.origin.png")).unwrap();
    let (from, to) = (path("in.origin.png"), path("in.png"));
    let before = fs::read(&from).unwrap();
    for more in [&[][..], &["--overwrite"]] {
        let said = refused(&[&["smooth", str(&from), str(&to), "--camera", &camera, "--fill", "6"], more].concat());
        assert!(
            said.contains("in.origin.png") && said.contains("mask of filled pixels would replace this file"),
            "{said}"
        );
        assert!(fs::read(&from).unwrap() == before && !to.exists());
    }
    // Without `--fill`, a file whose name ends in .origin.png is an ordinary frame of its folder.
    let frames = path("frames");
    fs::create_dir(&frames).unwrap();
    fs::copy(&from, frames.join("a.origin.png")).unwrap();
    let report = json_line(&ok(&["smooth", str(&frames), str(&path("out")), "--camera", &camera, "--json"]));
    assert_eq!(report["frames"].as_array().unwrap().len(), 1);
    // A mask left over from an earlier result is reported.
    let smooth = |more: &[&str]| {
        let (from, to) = (path("depth.png"), path("again.png"));
        super::planish(&[&["smooth", str(&from), str(&to), "--camera", &camera], more].concat())
    };
    assert!(smooth(&["--fill", "6"]).status.success() && smooth(&["--fill", "6"]).status.success());
    let said = super::text(&smooth(&[]).stderr);
    assert!(said.contains("again.origin.png: left over from an earlier result"), "{said}");
}

#[test]
fn a_folder_of_frames_has_masks_that_are_no_frames() {
    let (folder, camera, _) = with_hole();
    let (frames, filled) = (folder.path().join("frames"), folder.path().join("filled"));
    fs::create_dir(&frames).unwrap();
    for name in ["1.png", "2.png"] {
        fs::copy(folder.path().join("depth.png"), frames.join(name)).unwrap();
    }
    ok(&["smooth", str(&frames), str(&filled), "--camera", &camera, "--fill", "6"]);
    let names = |folder: &std::path::Path| {
        let mut names: Vec<String> = fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
            .filter(|name| name.ends_with(".png"))
            .collect();
        names.sort();
        names
    };
    assert_eq!(names(&filled), ["1.origin.png", "1.png", "2.origin.png", "2.png"]);
    let again = folder.path().join("again");
    let report = json_line(&ok(&["smooth", str(&filled), str(&again), "--camera", &camera, "--json"]));
    assert_eq!(report["frames"].as_array().unwrap().len(), 2);
    // A stream writes the same files into a data set, also with temporal smoothing.
    for (name, more) in [("stream", ["--fill", "6"]), ("steady", ["--temporal", "steady"])] {
        let saved = folder.path().join(name);
        ok(&[&["stream", str(&frames), "--camera", &camera, "--save", str(&saved), "--format", "png"], &more[..]]
            .concat());
        assert_eq!(names(&saved), ["1.origin.png", "1.png", "2.origin.png", "2.png"], "{name}");
    }
}

#[test]
fn recordings_get_a_topic_of_origins() {
    let (folder, camera, hole) = with_hole();
    let path = |name: &str| folder.path().join(name);
    let frames = path("frames");
    fs::create_dir(&frames).unwrap();
    fs::copy(path("depth.png"), frames.join("1.png")).unwrap();
    ok(&["smooth", str(&frames), str(&path("raw.mcap")), "--camera", &camera]);
    // Fill the holes in a recording, then in a folder of frames.
    ok(&["smooth", str(&path("raw.mcap")), str(&path("a.mcap")), "--fill", "6"]);
    ok(&["smooth", str(&frames), str(&path("b.mcap")), "--camera", &camera, "--fill", "6"]);
    let topics = |name: &str| {
        // The recording is not compressed, so its bytes contain the names of its topics.
        String::from_utf8_lossy(&fs::read(path(name)).unwrap()).into_owned()
    };
    assert!(!topics("raw.mcap").contains("/origin"));
    assert!(topics("a.mcap").contains("/camera/depth/image_rect/origin"));
    assert!(topics("b.mcap").contains("/camera/depth/origin"));
    let said = refused(&["smooth", str(&path("a.mcap")), str(&path("c.mcap")), "--fill", "6"]);
    assert!(said.contains("already has a topic /camera/depth/image_rect/origin"), "{said}");
    // The depth in both recordings is filled.
    for name in ["a.mcap", "b.mcap"] {
        let mut source = planish::source::open(str(&path(name)), &planish::source::SourceOptions::default()).unwrap();
        let Some(OwnedFrame::Depth(depth)) = source.next_frame().unwrap() else { panic!("depth") };
        assert!(hole.iter().all(|&i| depth.raw[i] != 0), "{name}");
    }
}

#[test]
fn filling_is_measured_and_widths_are_checked() {
    let report = json_line(&ok(&["evaluate", "--fill", "6", "--seed", "1", "--json"]));
    let cut = &report["cut"];
    assert!(cut["filled"].as_f64().unwrap() > 0.8 && cut["rms_mm"].as_f64().unwrap() < 5.0, "{report}");
    assert!(cut["wrong"].as_f64().unwrap() < 0.01 && report["own"]["wrong"].as_f64().unwrap() < 0.02, "{report}");
    let (folder, camera, _) = with_hole();
    let depth = folder.path().join("depth.png");
    let report = json_line(&ok(&["evaluate", "--fill", "6", "--input", str(&depth), "--camera", &camera, "--json"]));
    assert!(report["cut"]["pixels"].as_u64().unwrap() > 300, "{report}");
    // The exported frames, given as another program's results, fill no hole.
    let exported = folder.path().join("exported");
    let common = ["evaluate", "--fill", "6", "--seed", "1"];
    ok(&[&common[..], &["--export", str(&exported)]].concat());
    let report = json_line(&ok(&[&common[..], &["--results", str(&exported), "--json"]].concat()));
    assert_eq!(report["cut"]["filled"].as_f64(), Some(0.0));
    for (width, expected) in [("0", "--fill = 0 is not allowed: 1 to 64 pixels"), ("65", "1 to 64 pixels")] {
        let out = folder.path().join("x.png");
        let said = refused(&["smooth", str(&depth), str(&out), "--camera", &camera, "--fill", width]);
        assert!(said.contains(expected), "{said}");
    }
    // A cloud without pixels cannot have holes to fill.
    let cloud = folder.path().join("cloud.ply");
    let points = planish::PointCloud::new((0..500).map(|i| [(i % 25) as f32, (i / 25) as f32, 1.0]).collect());
    io::write_cloud(&cloud, &points, Encoding::Binary).unwrap();
    let said = refused(&["smooth", str(&cloud), str(&folder.path().join("x.ply")), "--fill", "4"]);
    assert!(said.contains("only for frames on a grid"), "{said}");
}
