//! Files and folders as inputs and outputs, and refusals.

use std::fs;
use std::path::Path;

use planish::io::{self, Contents, Encoding, write_cloud};
use planish::{AttributeValues, DepthImage, OrganizedCloud, SensorPose};
use serde_json::Value;

use super::{CAMERA, json_line, ok, planish, refused, small_frame, str, text, with_frame};

#[test]
fn demo_halves_the_error_and_writes_its_three_files() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let stdout = ok(&["demo", "--out", str(&out), "--seed", "3"]);
    let row = stdout.lines().find(|line| line.contains("0.5 to 1.5 m")).unwrap();
    let percent: f64 = row.split(['(', '%']).nth(1).unwrap().trim().parse().unwrap();
    assert!((5.0..50.0).contains(&percent), "{row}");
    for file in ["raw.pcd", "smoothed.pcd"] {
        let (_, contents) = io::read(&out.join(file)).unwrap();
        assert_eq!(contents.shape(), (640, 480));
    }
    let picture = fs::read(out.join("before-after.png")).unwrap();
    assert!(picture.starts_with(b"\x89PNG") && picture.len() > 100_000);
}

#[test]
fn smooth_keeps_grid_holes_and_colour_and_reports_in_json() {
    let (folder, input, path) = with_frame();
    let output = folder.path().join("smooth.pcd");
    let stdout = ok(&["smooth", str(&path), str(&output), "--preset", "paper", "--json", "--repeat", "3"]);
    let report: Value = serde_json::from_str(&stdout).unwrap();
    assert_eq!((report["width"].as_u64(), report["height"].as_u64()), (Some(160), Some(120)));
    assert_eq!(report["points_in"].as_u64(), Some(input.points.valid_points() as u64));
    assert_eq!(report["smooth_ms"]["runs"].as_u64(), Some(3));
    assert!(report["smooth_ms"]["median"].as_f64().unwrap() > 0.0);
    assert!(report["read_ms"].as_f64().unwrap() > 0.0 && report["write_ms"].as_f64().unwrap() > 0.0);
    let status = report["status"].as_object().unwrap();
    let names: Vec<&str> = status.keys().map(String::as_str).collect();
    assert_eq!(names.len(), 8);
    let sum: u64 = ["hole", "too_few", "degenerate", "plane", "polynomial", "isolated", "carried", "filled"]
        .iter()
        .map(|n| status[*n].as_u64().unwrap())
        .sum();
    assert_eq!(sum, 160 * 120);
    assert!(["auto", ""].iter().all(|name| report["engine"] != *name));

    let smoothed = planish::io::read_organized(&output).unwrap();
    assert_eq!((smoothed.width(), smoothed.height()), (160, 120));
    assert_eq!(smoothed.points.rgb(), input.points.rgb());
    assert_eq!(smoothed.points.attributes.len(), 1, "no fields but those of the input");
    let (mut moved, too_few) = (0, status["too_few"].as_u64().unwrap() as usize);
    for (p, q) in input.positions().iter().zip(smoothed.positions().iter()) {
        assert!(p[2].is_finite() || q[2].is_nan());
        moved += usize::from(p != q && q[2].is_finite());
    }
    assert!(moved > 5000, "{moved}");
    assert_eq!(smoothed.points.valid_points() + too_few, input.points.valid_points());
}

#[test]
fn fields_are_added_when_asked_for() {
    let (folder, _, path) = with_frame();
    let output = folder.path().join("fields.pcd");
    ok(&["smooth", str(&path), str(&output), "--fields", "normals,curvature,status"]);
    let cloud = planish::io::read_organized(&output).unwrap();
    let names: Vec<&str> = cloud.points.attributes.iter().map(|a| a.name.as_str()).collect();
    assert_eq!(names, ["rgb", "normal_x", "normal_y", "normal_z", "curvature", "status"]);
    let AttributeValues::U8(status) = &cloud.points.attribute("status").unwrap().values else { panic!("status") };
    assert!(status.contains(&0) && status.contains(&4));
}

#[test]
fn depth_in_gives_depth_out_and_points_when_the_name_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let frame = small_frame(2);
    let image = DepthImage { width: 160, height: 120, raw: frame.raw.clone() };
    let path = |name: &str| folder.path().join(name);
    for (input, output) in [("in.png", "out.png"), ("in.tiff", "out.tiff"), ("in.npy", "out.npy")] {
        io::write_depth(&path(input), &image).unwrap();
        ok(&["smooth", str(&path(input)), str(&path(output)), "--camera", CAMERA]);
        let Contents::Depth(smoothed) = io::read(&path(output)).unwrap().1 else { panic!("{output} is not depth") };
        let close = image.raw.iter().zip(&smoothed.raw).filter(|(a, b)| **a != 0 && a.abs_diff(**b) < 60).count();
        let valid = image.raw.iter().filter(|raw| **raw != 0).count();
        assert!(close * 100 > valid * 95, "{close} of {valid}");
        assert!(image.raw.iter().zip(&smoothed.raw).all(|(a, b)| *a != 0 || *b == 0));
        assert_ne!(image.raw, smoothed.raw);
    }
    fs::write(path("camera.json"), r#"{"fx":131.25,"fy":131.25,"cx":79.5,"cy":59.5,"width":160,"height":120}"#)
        .unwrap();
    ok(&["smooth", str(&path("in.png")), str(&path("points.ply")), "--camera-file", str(&path("camera.json"))]);
    assert_eq!(planish::io::read_organized(&path("points.ply")).unwrap().width(), 160);
    ok(&["smooth", str(&path("points.ply")), str(&path("points.npy"))]);
    assert_eq!(planish::io::read_organized(&path("points.npy")).unwrap().height(), 120);
    assert!(refused(&["smooth", str(&path("in.png")), str(&path("x.pcd"))]).contains("--camera"));
}

#[test]
fn general_clouds_are_smoothed_with_radii_of_their_density() {
    let folder = tempfile::tempdir().unwrap();
    let (input, output) = (folder.path().join("points.ply"), folder.path().join("smooth.ply"));
    let cloud = small_frame(1).deproject().unwrap().points;
    io::write_cloud(&input, &cloud, Encoding::Binary).unwrap();
    // The points of this cloud lie on the pixels of a camera, so their grid is rebuilt.
    let result = planish(&["smooth", str(&input), str(&output), "--window", "2"]);
    let told = text(&result.stderr);
    assert!(
        result.status.success() && told.contains("lost its grid; smoothed on a rebuilt grid of 160x120 pixels"),
        "{told}"
    );
    assert!(!told.contains("no effect"), "{told}");
    // Without its grid, the cloud is recognized as a Kinect's, and in another unit it is not.
    let result = planish(&["smooth", str(&input), str(&output), "--grid", "off"]);
    let told = text(&result.stderr);
    let sensor = "with the depth steps of a kinect1, smoothed by that sensor's noise (change with --sensor,";
    assert!(result.status.success() && told.contains(sensor), "{told}");
    ok(&["smooth", str(&input), str(&output), "--grid", "off", "--sensor", "kinect1", "--overwrite"]);
    let mut cloud = cloud;
    cloud.positions = cloud.positions.iter().map(|point| point.map(|value| 1.5 * value)).collect();
    io::write_cloud(&input, &cloud, Encoding::Binary).unwrap();
    let result = planish(&["smooth", str(&input), str(&output), "--grid", "off", "--window", "2"]);
    let told = text(&result.stderr);
    assert!(
        result.status.success()
            && told.contains("mm of noise, smoothed with about")
            && told.contains("neighbours per point"),
        "{told}"
    );
    assert!(told.contains("--window has no effect on unorganized clouds"), "{told}");
    let read = || {
        let Contents::General(smoothed) = io::read(&output).unwrap().1 else { panic!("points") };
        smoothed
    };
    let smoothed = read();
    assert_eq!(smoothed.valid_points(), cloud.valid_points());
    let moved = smoothed.positions.iter().zip(cloud.positions.iter()).filter(|(p, q)| p != q && q[0].is_finite());
    assert!(moved.count() * 10 > 9 * cloud.valid_points());
    for options in [["--neighbours", "20"], ["--radius", "0.05"], ["--preset", "paper"]] {
        let result = planish(&[&["smooth", str(&input), str(&output)][..], &options].concat());
        let told = text(&result.stderr);
        assert!(result.status.success() && !told.contains("neighbours per point") && !told.contains("grid"), "{told}");
        assert!(read() != smoothed, "{options:?}");
    }
    let report =
        |options: &[&str]| json_line(&ok(&[&["smooth", str(&input), str(&output), "--json"], options].concat()));
    let (rebuilt, chosen) = (report(&[]), report(&["--grid", "off"]));
    assert_eq!((&rebuilt["rebuilt_grid"], &rebuilt["cloud"]), (&serde_json::json!([160, 120]), &Value::Null));
    let choice = &chosen["cloud"];
    assert!(chosen["rebuilt_grid"].is_null() && choice["neighbours"].as_u64() > Some(10), "{chosen}");
    assert!(choice["noise_m"].as_f64() > Some(1e-4) && ["off", "robust"].contains(&choice["edges"].as_str().unwrap()));
    assert!(report(&["--neighbours", "20"])["cloud"].is_null());
    ok(&["smooth", str(&input), str(&output), "--even"]);
    assert!(read() != smoothed && read().valid_points() == cloud.valid_points());
    assert!(refused(&["smooth", str(&input), str(&output), "--neighbours", "3"]).contains("6 to 1000"));
    assert!(refused(&["smooth", str(&input), str(&output), "--radius", "sensor"]).contains("neighbours"));
    let (_folder, _, grid) = with_frame();
    assert!(refused(&["smooth", str(&grid), str(&output), "--neighbours", "20"]).contains("unorganized clouds"));
}

#[test]
fn info_and_render_tell_what_a_file_holds() {
    let (folder, input, path) = with_frame();
    let info: Value = serde_json::from_str(&ok(&["info", str(&path), "--json"])).unwrap();
    assert_eq!(info["format"], "PCD");
    assert_eq!(info["organized"], true);
    assert_eq!(info["valid_points"].as_u64(), Some(input.points.valid_points() as u64));
    assert_eq!(info["fields"][3], "rgb:F4");
    assert!((info["pixel_pitch_at_1m"].as_f64().unwrap() * 131.25 - 1.0).abs() < 1e-3);
    assert!(ok(&["info", str(&path)]).contains("organized cloud"));
    let picture = folder.path().join("relief.png");
    ok(&["render", str(&path), str(&picture)]);
    let header = fs::read(&picture).unwrap();
    // The relief and the colours are side by side, separated by 4 columns of pixels.
    assert_eq!(u32::from_be_bytes(header[16..20].try_into().unwrap()), 2 * 160 + 4);
}

#[test]
fn bad_arguments_and_bad_input_are_refused_with_exit_code_2() {
    let (folder, _, path) = with_frame();
    let output = folder.path().join("never.pcd");
    let smooth = |more: &[&str]| refused(&[&["smooth", str(&path), str(&output)], more].concat());
    assert!(smooth(&["--window", "9"]).contains("--window = 9 is not allowed: 1 to 7"));
    assert!(smooth(&["--radius", "-1"]).contains("--radius = -1"));
    assert!(smooth(&["--degree", "5"]).contains("degree = 5"));
    assert!(smooth(&["--threads", "0"]).contains("threads = 0"));
    assert!(smooth(&["--camera", "1,2,3"]).contains("FX,FY,CX,CY"));
    assert!(refused(&["smooth", "missing.pcd", str(&output)]).contains("missing.pcd"));
    let damaged = folder.path().join("damaged.pcd");
    fs::write(&damaged, &fs::read(&path).unwrap()[..5000]).unwrap();
    let message = refused(&["smooth", str(&damaged), str(&output)]);
    assert!(message.contains("damaged.pcd") && message.contains("truncated"), "{message}");
    assert_eq!(message.matches("truncated").count(), 1, "said once: {message}");
    assert!(refused(&["info", str(&damaged)]).contains("truncated"));
    assert!(refused(&["smooth", str(&path), str(&folder.path().join("none/x.pcd"))]).contains("does not exist"));
    assert!(refused(&["smooth", str(&path), str(&folder.path().join("x.png"))]).contains("--camera"));
    assert!(!output.exists());
}

#[test]
fn sensors_strengths_and_edges_are_chosen_by_name() {
    let (folder, _, path) = with_frame();
    let output = folder.path().join("smooth.pcd");
    let smooth = |options: &[&str]| {
        ok(&[&["smooth", str(&path), str(&output), "--engine", "cpu"], options].concat());
        fs::read(&output).unwrap()
    };
    let usual = smooth(&[]);
    assert_eq!(smooth(&["--preset", "default", "--sensor", "kinect1", "--edges", "robust"]), usual);
    let choices: [&[&str]; 8] = [
        &["--preset", "light"],
        &["--preset", "strong"],
        &["--edges", "off"],
        &["--sensor", "d435"],
        &["--sensor", "azure-kinect"],
        &["--sensor", "exact"],
        &["--sensor", "auto"],
        &["--remove-floating"],
    ];
    let results: Vec<_> = choices.into_iter().map(smooth).collect();
    for (i, result) in results.iter().enumerate() {
        assert!(*result != usual && !results[..i].contains(result), "{:?} is as another", choices[i]);
    }
    for (strength, preset) in [("0", "light"), ("0.5", "default"), ("1", "strong")] {
        assert_eq!(smooth(&["--strength", strength]), smooth(&["--preset", preset]));
    }
    assert!(!results.contains(&smooth(&["--strength", "0.3"])));
    for (bad, said) in [("1.5", "0 (light) to 1 (strong)"), ("-1", "strength"), ("NaN", "strength")] {
        assert!(refused(&["smooth", str(&path), str(&output), "--strength", bad]).contains(said), "{bad}");
    }
    assert!(
        refused(&["smooth", str(&path), str(&output), "--strength", "1", "--preset", "light"]).contains("--preset")
    );
    // A stream estimates the sensor from its first frame. Removal of floating pixels needs the sensor before any
    // frame has arrived, so the combination is refused.
    ok(&["stream", "synthetic", "--sensor", "auto", "--frames", "1"]);
    let early = ["stream", "synthetic", "--sensor", "auto", "--remove-floating", "--frames", "1"];
    assert!(refused(&early).contains("planish info"));
    let info: Value = serde_json::from_str(&ok(&["info", str(&path), "--json"])).unwrap();
    let step = |k: usize| info["sensor"]["step"][k].as_f64().unwrap();
    let step_m = step(0) + 2.0 * step(1) + 4.0 * step(2);
    assert!((8e-3..20e-3).contains(&step_m), "at 2 m: {step_m}");
}

#[test]
fn strides_follow_the_resolution_unless_they_are_given() {
    let (folder, _, path) = with_frame();
    let smooth = |input: &Path, more: &[&str]| {
        let output = folder.path().join("out.pcd");
        ok(&[&["smooth", str(input), str(&output), "--engine", "cpu"], more].concat());
        fs::read(&output).unwrap()
    };
    // These pixels are four times as coarse as a Kinect's, so the stride of 5 becomes 5 / 4 = 1. At that stride, the
    // default window of 2 would reach 2 pixels; it becomes 5 to keep half of its original reach of 2 x 5 = 10 pixels.
    let found = smooth(&path, &[]);
    assert_eq!(found, smooth(&path, &["--window", "5", "--stride", "1"]));
    assert_eq!(smooth(&path, &["--window", "2"]), smooth(&path, &["--window", "2", "--stride", "5"]));
    assert_ne!(found, smooth(&path, &["--stride", "5"]));
    assert_ne!(found, smooth(&path, &["--average-blocks", "false", "--stride", "5"]));
    assert_eq!(smooth(&path, &["--preset", "paper"]), smooth(&path, &["--preset", "paper", "--stride", "1"]));
    // A stream of the same file gives the same points.
    let saved = folder.path().join("stream");
    ok(&["stream", str(&path), "--frames", "1", "--engine", "cpu", "--save", str(&saved)]);
    let points = |bytes: &[u8]| {
        let Contents::Organized(cloud) = io::decode(bytes, None).unwrap().1 else { panic!() };
        cloud.points.positions.iter().map(|p| p.map(f32::to_bits)).collect::<Vec<_>>()
    };
    assert_eq!(points(&fs::read(saved.join("000000.pcd")).unwrap()), points(&found));
}

/// Returns a wall of 64x48 points 2 m in front of a camera, in a robot's base frame: x forward, z up.
fn wall_in_base_frame() -> OrganizedCloud {
    let point = |i: usize| {
        let (right, down) = (((i % 64) as f32 - 31.5) / 52.5 * 2.0, ((i / 64) as f32 - 23.5) / 52.5 * 2.0);
        [2.1, -right, 0.6 - down]
    };
    OrganizedCloud::from_positions(64, 48, (0..64 * 48).map(point).collect()).unwrap()
}

#[test]
fn a_cloud_in_another_frame_keeps_its_points_with_its_pose_by_option_or_without() {
    let folder = tempfile::tempdir().unwrap();
    let (input, output) = (folder.path().join("wall.pcd"), folder.path().join("smooth.pcd"));
    let viewpoint = "0.1,0,0.6,0.5,-0.5,0.5,-0.5";
    let mut cloud = wall_in_base_frame();
    let smooth = |cloud: &OrganizedCloud, more: &[&str]| {
        write_cloud(&input, cloud, Encoding::Binary).unwrap();
        let arguments = ["smooth", str(&input), str(&output), "--engine", "cpu", "--json"];
        let run = planish(&[&arguments[..], more].concat());
        assert!(run.status.success(), "{}", text(&run.stderr));
        let report: Value = serde_json::from_slice(&run.stdout).unwrap();
        assert_eq!((report["points_in"].as_u64(), report["points_lost"].as_u64()), (Some(3072), Some(0)));
        (fs::read(&output).unwrap(), text(&run.stderr).to_owned())
    };
    let (_, said) = smooth(&cloud, &[]);
    assert!(said.contains("--sensor-pose"), "{said}");
    let (_, said) = smooth(&cloud, &["--sensor-pose", viewpoint]);
    assert_eq!(said, "");
    cloud.points.pose = SensorPose::from_viewpoint([0.1, 0.0, 0.6, 0.5, -0.5, 0.5, -0.5]);
    let (posed, said) = smooth(&cloud, &[]);
    assert_eq!(said, "");
    let Contents::Organized(posed) = io::decode(&posed, None).unwrap().1 else { panic!() };
    assert_eq!(posed.points.pose, cloud.points.pose, "the file keeps its viewpoint");
    assert!(posed.positions().x().iter().all(|x| (x - 2.1).abs() < 1e-5));

    assert!(refused(&["smooth", str(&input), str(&output), "--sensor-pose", "0,0,0,2,0,0,0"]).contains("length 1"));
    assert!(refused(&["smooth", str(&input), str(&output), "--sensor-pose", "1,2,3"]).contains("7 numbers"));
    let info = ok(&["info", str(&input), "--sensor-pose", viewpoint]);
    assert!(info.contains("sensor pose") && info.contains("focal length 52.5"), "{info}");
}

#[test]
fn points_that_become_holes_are_told_with_a_cause() {
    let folder = tempfile::tempdir().unwrap();
    let (input, output) = (folder.path().join("wall.pcd"), folder.path().join("smooth.pcd"));
    write_cloud(&input, &wall_in_base_frame(), Encoding::Binary).unwrap();
    let run = planish(&["smooth", str(&input), str(&output), "--radius", "0.001"]);
    assert_eq!(run.status.code(), Some(1));
    let said = text(&run.stderr);
    assert!(said.contains("3072 of 3072 valid points (100.0 %)") && said.contains("--radius"), "{said}");
    assert!(said.contains("nothing is written") && !output.exists(), "{said}");
    // In a folder, the reason is printed once.
    let frames = folder.path().join("frames");
    fs::create_dir(&frames).unwrap();
    for name in ["0.pcd", "1.pcd", "2.pcd"] {
        fs::copy(&input, frames.join(name)).unwrap();
    }
    let run = planish(&["smooth", str(&frames), str(&folder.path().join("out")), "--radius", "0.001"]);
    let said = text(&run.stderr);
    assert_eq!((run.status.code(), said.matches("error: ").count()), (Some(1), 1), "{said}");
    assert!(said.contains("2 more frames: every point became a hole"), "{said}");
}

#[test]
fn camera_files_of_other_programs_are_read() {
    let (folder, ..) = with_frame();
    let camera = small_frame(1).camera;
    let (depth, file) = (folder.path().join("depth.png"), folder.path().join("camera.txt"));
    let image =
        DepthImage { width: camera.width, height: camera.height, raw: vec![1500; camera.width * camera.height] };
    io::write_depth(&depth, &image).unwrap();
    let smooth = |text: &str| {
        fs::write(&file, text).unwrap();
        let output = folder.path().join("out.pcd");
        ok(&["smooth", str(&depth), str(&output), "--camera-file", str(&file)]);
        ok(&["info", str(&depth), "--camera-file", str(&file)]);
        fs::read(output).unwrap()
    };
    let planish::Camera { width, height, fx, fy, cx, cy, .. } = camera;
    let flat = smooth(&format!("{{\"fx\":{fx},\"fy\":{fy},\"cx\":{cx},\"cy\":{cy}}}"));
    assert_eq!(flat, smooth(&format!("{fx} 0 {cx}\n0 {fy} {cy}\n0 0 1\n")));
    assert_eq!(flat, smooth(&format!("1 PINHOLE {width} {height} {fx} {fy} {} {}", cx + 0.5, cy + 0.5)));
    let info = format!(
        "image_width: {width}\nimage_height: {height}\ncamera_matrix: {{data: [{fx}, 0, {cx}, 0, {fy}, {cy}, 0, 0, \
         1]}}\n\
         distortion_model: plumb_bob\ndistortion_coefficients: {{data: [K1, 0, 0, 0, 0]}}\n"
    );
    assert_eq!(flat, smooth(&info.replace("K1", "0")));
    assert_ne!(flat, smooth(&info.replace("K1", "0.1")));
}

#[test]
fn clean_removes_what_was_asked_for_and_keeps_fields_and_grids() {
    let (folder, cloud, path) = with_frame();
    let path_of = |name: &str| folder.path().join(name);
    let cleaned = path_of("clean.pcd");
    let report = json_line(&ok(&["clean", str(&path), str(&cleaned), "--statistical", "20,2", "--json"]));
    let organized = planish::io::read_organized(&cleaned).unwrap();
    assert_eq!((organized.width(), organized.height()), (cloud.width(), cloud.height()));
    let removed = report["statistical_outliers"].as_u64().unwrap() as usize;
    assert!(removed > 0 && organized.points.valid_points() == cloud.points.valid_points() - removed);

    let thinned = path_of("thin.ply");
    let all = ["--crop", "-0.5,-0.5,0,0.5,0.5,3", "--voxel", "0.01", "--radius-outliers", "0.03,4", "--json"];
    let report = json_line(&ok(&[&["clean", str(&path), str(&thinned)], &all[..]].concat()));
    let Contents::General(points) = planish::io::read(&thinned).unwrap().1 else { panic!("a voxel is no pixel") };
    assert_eq!(report["points_out"].as_u64().unwrap() as usize, points.len());
    let removed = ["outside_box", "merged", "radius_outliers"].map(|step| report[step].as_u64().unwrap());
    assert_eq!(report["points_in"].as_u64().unwrap() - removed.iter().sum::<u64>(), points.len() as u64);
    assert!(removed.iter().all(|count| *count > 0), "{removed:?}");
    assert!(points.positions.iter().all(|[x, y, _]| x.abs() <= 0.5 && y.abs() <= 0.5));

    // The box is in the file's coordinates, even if they are far from the origin.
    let utm = path_of("utm.xyz");
    let lines = (0..1000).map(|i| format!("{} {} {}\n", 691_000 + i % 100, 5_335_000 + i / 100, 500.25));
    fs::write(&utm, lines.collect::<String>()).unwrap();
    let cropped = path_of("cropped.xyz");
    let report = json_line(&ok(&[
        "clean",
        str(&utm),
        str(&cropped),
        "--crop",
        "691010,5335002,500.25,691019,5335004,500.25",
        "--json",
    ]));
    assert_eq!(report["points_out"], 30);
    assert!(fs::read_to_string(&cropped).unwrap().lines().all(|line| line.starts_with("69101")));

    assert!(refused(&["clean", str(&path), str(&cleaned)]).contains("no step is given"));
    assert!(refused(&["clean", str(&path), str(&path), "--voxel", "0.01"]).contains("is the input"));
    assert!(refused(&["clean", str(&path), str(&cleaned), "--crop", "9,9,9,10,10,10"]).contains("no points remain"));
    assert!(refused(&["clean", str(&path), str(&cleaned), "--crop", "9,9,9,1,1,1"]).contains("smallest x, y, z"));
    assert!(refused(&["clean", str(&path), str(&cleaned), "--statistical", "a"]).contains("as 20,2"));
    assert!(refused(&["clean", str(&path), str(&path_of("out.png")), "--voxel", "1"]).contains("cannot store points"));
}

#[test]
fn a_general_cloud_is_drawn_from_where_one_asks() {
    let (folder, cloud, path) = with_frame();
    let [general, picture] = ["general.ply", "picture.png"].map(|name| folder.path().join(name));
    write_cloud(&general, &cloud.points, Encoding::Binary).unwrap();
    ok(&["render", str(&general), str(&picture), "--from", "0,0,-1"]);
    let image = planish::io::read_rgb_png(&picture).unwrap();
    assert!(image.width > image.height && image.rgb.iter().any(|&value| value > 100));
    assert!(refused(&["render", str(&path), str(&path)]).contains("expected .png"));
    assert!(
        refused(&["render", str(&path), str(&picture), "--from", "0,0,1"]).contains("applies to unorganized clouds")
    );
    assert!(refused(&["render", str(&general), str(&picture), "--from", "0,0"]).contains("3 numbers"));
}

#[test]
fn las_larger_than_memory_is_smoothed_in_tiles_and_described_in_parts() {
    let (folder, cloud, _) = with_frame();
    let file = |name: &str| folder.path().join(name);
    let (input, output, whole) = (file("a.las"), file("out.laz"), file("whole.laz"));
    write_cloud(&input, &cloud.points, Encoding::Binary).unwrap();
    // A fixed neighbour count. Otherwise the largest tile would determine the count in tiles, and the whole cloud the
    // count without tiles.
    let memory = ["--neighbours", "40", "--max-memory", "3M", "--json"];
    let tiled = planish(&[&["smooth", str(&input), str(&output)], &memory[..]].concat());
    assert!(tiled.status.success() && text(&tiled.stderr).contains("in tiles"), "{}", text(&tiled.stderr));
    let report = json_line(&text(&tiled.stdout));
    assert!(report["tiles"].as_u64().unwrap() > 1 && report["engine"] == "cpu", "{report}");
    let expected =
        json_line(&ok(&["smooth", str(&input), str(&whole), "--neighbours", "40", "--json", "--engine", "cpu"]));
    assert!(expected.get("tiles").is_none() && report["status"] == expected["status"], "{report} {expected}");
    // Tiles are written only in the input's kind of format, here LAS or LAZ.
    let refused = planish(&["smooth", str(&input), str(&file("out.ply")), "--max-memory", "1M"]);
    assert!(!refused.status.success() && !file("out.ply").exists(), "{}", text(&refused.stderr));

    let info = |arguments: &[&str]| json_line(&ok(&[&["info", str(&whole), "--json"], arguments].concat()));
    let (whole, parts) = (info(&[]), info(&["--max-memory", "1M"]));
    for field in ["format", "width", "fields", "valid_points"] {
        assert_eq!(whole[field], parts[field], "{field}");
    }
}

#[test]
fn a_ply_described_in_parts_is_described_as_whole() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.ply");
    let mut cloud = planish::PointCloud::new((0..40_000).map(|i| [(i % 97) as f32, 0.5, 1e-3 * i as f32]).collect());
    (0..40_000).filter(|i| i % 97 < 60).for_each(|i| cloud.positions.as_mut_slices()[0][i] = f32::NAN);
    cloud.pose = planish::SensorPose::from_viewpoint([1.0, 2.0, 3.0, 0.5, -0.5, 0.5, -0.5]);
    for encoding in [Encoding::Binary, Encoding::Ascii] {
        write_cloud(&file, &cloud, encoding).unwrap();
        let info = |arguments: &[&str]| json_line(&ok(&[&["info", str(&file), "--json"], arguments].concat()));
        let (whole, parts) = (info(&[]), info(&["--max-memory", "200K"]));
        for field in ["width", "valid_points", "bounds_m", "sensor_pose", "fields"] {
            assert_eq!(whole[field], parts[field], "{field}");
        }
        let median = |info: &serde_json::Value| info["median_z_m"].as_f64().unwrap();
        assert!((median(&whole) - median(&parts)).abs() < 0.5, "{whole} {parts}");
    }
    // An element without properties has neither bytes nor points, so it is refused.
    fs::write(&file, "ply\nformat binary_big_endian 1.0\nelement vertex 0\nend_header\n").unwrap();
    assert!(refused(&["info", str(&file)]).contains("no properties"));
    // A line without an end is not read into memory as a whole.
    let header = "ply\nformat ascii 1.0\nelement vertex 90000\nproperty float x\nproperty float y\nproperty float \
                  z\nend_header\n";
    fs::write(&file, header.to_owned() + &"1 ".repeat(400_000)).unwrap();
    assert!(refused(&["info", str(&file), "--max-memory", "500K"]).contains("65536 bytes"));
}
