//! Steps before smoothing, and implausible inputs.

use planish::io::{self, Contents};
use planish::{Camera, DepthImage};

use super::{json_line, ok, planish, refused, small_frame, str, text};

#[test]
fn inputs_that_make_no_sense_are_questioned_before_any_work() {
    let folder = tempfile::tempdir().unwrap();
    let (depth, output) = (folder.path().join("depth.png"), folder.path().join("smooth.png"));
    let frame = small_frame(1);
    let Camera { width, height, fx, fy, cx, cy, .. } = frame.camera;
    io::write_depth(&depth, &DepthImage { width, height, raw: frame.raw }).unwrap();
    let camera = format!("{fx},{fy},{cx},{cy}");
    let smooth = ["smooth", str(&depth), str(&output), "--camera"];
    for (options, reason) in [
        (&[camera.as_str(), "--depth-units-per-metre", "0.001"][..], "the inverse"),
        (&[&camera, "--depth-units-per-metre", "10"], "check the depth unit"),
        (&["79.5,59.5,131.25,131.25"], "swapped"),
        (&[&format!("{fx},{fy},319.5,239.5")], "another size"),
    ] {
        let said = refused(&[&smooth, options].concat());
        assert!(said.contains(reason) && said.contains("--force") && !output.exists(), "{said}");
    }
    ok(&[&smooth, &["79.5,59.5,131.25,131.25", "--force"][..]].concat());
    let metres = folder.path().join("depth.npy");
    io::write_depth_metres(&metres, 160, &vec![1090.0; 160 * 120]).unwrap();
    let said = refused(&["smooth", str(&metres), str(&output), "--camera", &camera]);
    assert!(said.contains("millimetres") && said.contains("--unit"), "{said}");
    let said = ok(&["info", str(&metres), "--camera", &camera]);
    assert!(said.contains("note") && said.contains("most points are 1090 m away"), "{said}");
}

#[test]
fn floating_point_lengths_in_other_units_become_metres() {
    let folder = tempfile::tempdir().unwrap();
    let (input, output) = (folder.path().join("mm.npy"), folder.path().join("smooth.npy"));
    let frame = small_frame(1);
    let Camera { width, fx, fy, cx, cy, .. } = frame.camera;
    let millimetres: Vec<f32> = frame.raw.iter().map(|&raw| f32::from(raw)).collect();
    io::write_depth_metres(&input, width, &millimetres).unwrap();
    let camera = format!("{fx},{fy},{cx},{cy}");
    let median_m = |options: &[&str]| {
        ok(&[&["smooth", str(&input), str(&output), "--overwrite", "--camera", &camera][..], options].concat());
        let Contents::DepthMetres { mut depth_m, .. } = io::read(&output).unwrap().1 else { panic!("depth") };
        depth_m.retain(|depth| *depth > 0.0);
        depth_m.sort_by(f32::total_cmp);
        depth_m[depth_m.len() / 2]
    };
    let [by_unit, by_scale] = [median_m(&["--unit", "mm"]), median_m(&["--depth-scale", "1000"])];
    assert!((0.3..5.0).contains(&by_unit) && (by_unit - by_scale).abs() < 1e-6, "{by_unit} {by_scale}");
    let said = refused(&["info", str(&input), "--unit", "furlong"]);
    assert!(said.contains("mm, cm, m, inch or ft"), "{said}");
}

#[test]
fn guesses_about_a_camera_file_are_reported_once() {
    let folder = tempfile::tempdir().unwrap();
    let (depth, camera) = (folder.path().join("depth.png"), folder.path().join("camera.json"));
    let frame = small_frame(1);
    let Camera { width, height, fx, fy, cx, cy, .. } = frame.camera;
    io::write_depth(&depth, &DepthImage { width, height, raw: frame.raw }).unwrap();
    let file = format!(r#"{{"fx":{fx},"fy":{fy},"cx":{cx},"cy":{cy},"depth_scale":0.001}}"#);
    std::fs::write(&camera, file).unwrap();
    let run = planish(&["info", str(&depth), "--camera-file", str(&camera)]);
    let said = text(&run.stderr);
    assert_eq!(said.matches("1000 units per metre").count(), 1, "{said}");
}

#[test]
fn frames_are_decimated_and_their_ranges_cut_off() {
    let folder = tempfile::tempdir().unwrap();
    let (depth, output) = (folder.path().join("depth.png"), folder.path().join("smooth.png"));
    let frame = small_frame(1);
    let Camera { width, height, fx, fy, cx, cy, .. } = frame.camera;
    let beyond = frame.raw.iter().filter(|raw| **raw > 1000).count();
    io::write_depth(&depth, &DepthImage { width, height, raw: frame.raw }).unwrap();
    let camera = format!("{fx},{fy},{cx},{cy}");
    let run = planish(&[
        "smooth",
        str(&depth),
        str(&output),
        "--camera",
        &camera,
        "--max-range",
        "1",
        "--decimate",
        "2",
        "--json",
    ]);
    assert!(run.status.success() && text(&run.stderr).contains(&format!("{beyond} pixels out of range")));
    let report = json_line(&text(&run.stdout));
    assert_eq!((&report["width"], &report["height"]), (&80.into(), &60.into()));
    let Contents::Depth(image) = io::read(&output).unwrap().1 else { panic!("depth") };
    assert_eq!((image.width, image.height), (80, 60));
    assert!(image.raw.iter().all(|raw| *raw <= 1010) && image.raw.iter().filter(|raw| **raw > 0).count() > 300);
    let cloud = folder.path().join("cloud.pcd");
    ok(&["smooth", str(&depth), str(&cloud), "--camera", &camera, "--decimate", "4"]);
    assert!(ok(&["info", str(&cloud)]).contains("40 x 30"));
    assert!(refused(&["smooth", str(&depth), str(&cloud), "--camera", &camera, "--decimate", "9"]).contains("2 to 8"));
}
