//! Commands other than `smooth`: convert, compare, merge and mesh.

use std::fs;
use std::process::Command;

use planish::io::{self, Contents, Encoding, write_cloud};
use planish::{Camera, DepthImage, PointCloud, Xyz};

use super::{json_line, ok, planish, refused, small_frame, str, text};

/// Returns a folder with a depth image, and its camera as an option value.
fn with_depth() -> (tempfile::TempDir, String) {
    let folder = tempfile::tempdir().unwrap();
    let frame = small_frame(1);
    let Camera { width, height, fx, fy, cx, cy, .. } = frame.camera;
    io::write_depth(&folder.path().join("depth.png"), &DepthImage { width, height, raw: frame.raw }).unwrap();
    (folder, format!("{fx},{fy},{cx},{cy}"))
}

#[test]
fn files_are_converted_there_and_back() {
    let (folder, camera) = with_depth();
    let path = |name: &str| folder.path().join(name);
    let depth = path("depth.png");
    for name in ["cloud.pcd", "cloud.ply", "cloud.npz"] {
        ok(&["convert", str(&depth), str(&path(name)), "--camera", &camera]);
        ok(&["convert", str(&path(name)), str(&path("back.png")), "--camera", &camera]);
        assert!(io::read(&path("back.png")).unwrap() == io::read(&depth).unwrap(), "{name}");
    }
    ok(&["convert", str(&depth), str(&path("depth.tiff"))]);
    assert!(io::read(&path("depth.tiff")).unwrap().1 == io::read(&depth).unwrap().1);
    assert!(refused(&["convert", str(&depth), str(&path("x.pcd"))]).contains("--camera"));
    let said = refused(&["convert", str(&path("cloud.pcd")), str(&path("cloud.pcd"))]);
    assert!(said.contains("is the input"), "{said}");

    let run = planish(&["convert", str(&path("cloud.pcd")), str(&path("dense.xyz")), "--drop-holes", "--json"]);
    let report = json_line(&text(&run.stdout));
    assert!(report["width"] == report["valid"] && report["height"] == 1, "{report}");
    assert!(text(&run.stderr).contains("holes are dropped"));
    let Contents::General(dense) = io::read(&path("dense.xyz")).unwrap().1 else { panic!("a cloud") };
    assert_eq!(dense.len() as u64, report["valid"].as_u64().unwrap());

    let said = refused(&["convert", str(&path("dense.xyz")), str(&path("x.png"))]);
    assert!(said.contains("unorganized"), "{said}");
    let said = refused(&["convert", str(&depth), str(&path("x.tiff")), "--drop-holes"]);
    assert!(said.contains("not to depth images"), "{said}");
    assert!(refused(&["convert", str(&depth), str(&path("x.pcd")), "--encoding", "ascii,binary"]).contains("one of"));
}

#[test]
fn differences_are_measured_and_a_limit_decides_the_exit_code() {
    let (folder, camera) = with_depth();
    let path = |name: &str| folder.path().join(name);
    ok(&["smooth", str(&path("depth.png")), str(&path("smooth.png")), "--camera", &camera]);
    let (a, b) = (path("depth.png"), path("smooth.png"));
    let report = json_line(&ok(&["compare", str(&a), str(&b), "--json"]));
    let max = report["distances"]["max"].as_f64().unwrap();
    assert!(report["unit"] == "raw" && max > 3.0 && report["distances"]["rms"].as_f64().unwrap() < max, "{report}");
    ok(&["compare", str(&a), str(&a), "--max", "0"]);
    assert_eq!(planish(&["compare", str(&a), str(&b), "--max", "0.5"]).status.code(), Some(1));
    let said = ok(&["compare", str(&a), str(&b), "--camera", &camera, "--picture", str(&path("map.png"))]);
    assert!(said.contains(" mm, RMS "), "{said}");
    assert!(fs::read(path("map.png")).unwrap().starts_with(b"\x89PNG"));
    assert!(refused(&["compare", str(&a), str(&b), "--picture", str(&a)]).contains("is the input"));

    let cloud = |n: usize| PointCloud::new((0..n).map(|i| [i as f32, 0.0, 1.0]).collect::<Xyz>());
    write_cloud(&path("five.pcd"), &cloud(5), Encoding::Binary).unwrap();
    write_cloud(&path("three.pcd"), &cloud(3), Encoding::Binary).unwrap();
    let said = ok(&["compare", str(&path("five.pcd")), str(&path("three.pcd"))]);
    assert!(said.contains("to the nearest point") && said.contains("and back    3 of 3 equal"), "{said}");
    assert!(refused(&["compare", str(&a), str(&path("five.pcd"))]).contains("give the camera"));
}

#[test]
fn clouds_are_merged_by_their_poses() {
    let (folder, _) = with_depth();
    let path = |name: &str| folder.path().join(name);
    for name in ["0.pcd", "1.pcd"] {
        write_cloud(&path(name), &PointCloud::new([[0.0, 0.0, 1.0]].into_iter().collect()), Encoding::Binary).unwrap();
    }
    let poses = "0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n1 1 2\n1 0 0 2\n0 1 0 3\n0 0 1 4\n0 0 0 1\n";
    fs::write(path("trajectory.log"), poses).unwrap();
    let (a, b, out, log) = (path("0.pcd"), path("1.pcd"), path("all.ply"), path("trajectory.log"));
    ok(&["merge", str(&a), str(&b), "--poses", str(&log), "--out", str(&out)]);
    let Contents::General(merged) = io::read(&out).unwrap().1 else { panic!("a cloud") };
    assert_eq!(merged.positions.iter().collect::<Vec<_>>(), [[0.0, 0.0, 1.0], [2.0, 3.0, 5.0]]);
    assert!(merged.attribute("scan").is_some());
    assert!(refused(&["merge", str(&a), str(&b), "--out", str(&a)]).contains("is the input"));
    let third = path("2.pcd");
    fs::copy(&a, &third).unwrap();
    let said = refused(&["merge", str(&a), str(&b), str(&third), "--poses", str(&log), "--out", str(&out)]);
    assert!(said.contains("2.pcd: no pose for this cloud"), "{said}");
}

#[test]
fn meshes_are_written_in_every_format_and_clouds_without_pixels_are_refused() {
    let (folder, camera) = with_depth();
    let path = |name: &str| folder.path().join(name);
    let depth = path("depth.png");
    for name in ["mesh.ply", "mesh.obj", "mesh.stl", "mesh.glb"] {
        let said = ok(&["mesh", str(&depth), str(&path(name)), "--camera", &camera]);
        let triangles: usize = said.split(' ').rev().nth(1).unwrap().parse().unwrap();
        assert!((30_000..38_000).contains(&triangles), "{said}");
    }
    // planish also reads the vertices of meshes.
    let Contents::General(vertices) = io::read(&path("mesh.obj")).unwrap().1 else { panic!("a cloud") };
    let Contents::General(same) = io::read(&path("mesh.ply")).unwrap().1 else { panic!("a cloud") };
    assert!(vertices.len() > 18_000 && vertices.len() == same.len());
    let faces = fs::read_to_string(path("mesh.obj")).unwrap().lines().filter(|line| line.starts_with("f ")).count();
    assert_eq!(fs::metadata(path("mesh.stl")).unwrap().len() as usize, 84 + 50 * faces);
    write_cloud(&path("cloud.pcd"), &vertices, Encoding::Binary).unwrap();
    let said = refused(&["mesh", str(&path("cloud.pcd")), str(&path("x.ply"))]);
    assert!(said.contains("no pixels to connect") && said.contains("MeshLab"), "{said}");
    assert!(refused(&["mesh", str(&depth), str(&path("x.pcd")), "--camera", &camera]).contains(".glb"));
}

#[test]
fn normals_of_the_input_do_not_stay_on_moved_points() {
    let (folder, _) = with_depth();
    let path = |name: &str| folder.path().join(name);
    let mut cloud = small_frame(1).deproject().unwrap();
    let pixels = cloud.points.len();
    for (name, value) in [("normal_x", 1.0f32), ("normal_y", 0.0), ("normal_z", 0.0), ("intensity", 7.0)] {
        cloud.points.set_attribute(name, vec![value; pixels]);
    }
    write_cloud(&path("in.pcd"), &cloud, Encoding::Binary).unwrap();
    let run = planish(&["smooth", str(&path("in.pcd")), str(&path("out.pcd"))]);
    assert!(text(&run.stderr).contains("recomputed"), "{}", text(&run.stderr));
    let Contents::Organized(out) = io::read(&path("out.pcd")).unwrap().1 else { panic!("organized") };
    let count = |name: &str, is_so: &dyn Fn(f64) -> bool| {
        let values = &out.points.attribute(name).unwrap().values;
        (0..pixels).filter(|&i| is_so(values.get_f64(i))).count()
    };
    assert!(count("normal_x", &|x| x == 1.0) < 10);
    assert!(count("normal_z", &|z| z < -0.1) > pixels / 2);
    assert_eq!(count("intensity", &|value| value == 7.0), pixels);
}

#[test]
fn the_short_help_of_smooth_fits_on_a_screen() {
    let help =
        Command::new(env!("CARGO_BIN_EXE_planish")).args(["smooth", "-h"]).env("COLUMNS", "80").output().unwrap();
    let lines = text(&help.stdout).lines().count();
    assert!((10..=24).contains(&lines), "{lines} lines");
}
