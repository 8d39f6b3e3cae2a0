//! Small valid files of every kind that the command reads, for tests that change them.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use planish::io::{Encoding, write_cloud, write_depth, write_depth_metres};
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::{Camera, DepthImage, PointCloud};

use super::program;

pub const SIZE: (usize, usize) = (32, 24);
pub const CAMERA: &str = "26.25,26.25,15.5,11.5";

/// The role of a file.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Kind {
    Cloud,
    Depth,
    Recording,
    Camera,
    Settings,
    Rig,
    Calibration,
    /// Poses of several clouds.
    Poses,
    /// A data set's `depth.txt`.
    List,
}

pub struct Sample {
    pub kind: Kind,
    pub name: String,
    pub bytes: Vec<u8>,
}

impl Sample {
    fn new(kind: Kind, name: &str, bytes: impl Into<Vec<u8>>) -> Self {
        Self { kind, name: name.to_owned(), bytes: bytes.into() }
    }
}

/// Writes the files that stay unchanged into `folder`, and returns the files to change.
pub fn samples(folder: &Path) -> Vec<Sample> {
    let camera = Camera::new(SIZE, [26.25; 2], [15.5, 11.5]);
    let (scene, pose) = Scene::tabletop(1);
    let truth = scene.render(&camera, &pose);
    let frame = DepthSimulator::new(DepthNoise::default(), camera, 1).frame(&truth, 0).unwrap();
    let cloud = frame.deproject().unwrap();
    let mut with_field = PointCloud::new(cloud.points.positions.clone());
    with_field.set_attribute("confidence", vec![0.5f32; cloud.points.len()]);
    let path = |name: &str| folder.join(name);
    write_cloud(&path("ascii.pcd"), &cloud, Encoding::Ascii).unwrap();
    write_cloud(&path("frame.pcd"), &cloud, Encoding::Binary).unwrap();
    write_cloud(&path("compressed.pcd"), &cloud, Encoding::BinaryCompressed).unwrap();
    write_cloud(&path("general.pcd"), &cloud.points, Encoding::Binary).unwrap();
    write_cloud(&path("ascii.ply"), &cloud, Encoding::Ascii).unwrap();
    write_cloud(&path("binary.ply"), &cloud, Encoding::Binary).unwrap();
    for name in ["points.npy", "points.las", "points.laz", "points.e57", "points.npz", "points.csv", "points.xyz"] {
        write_cloud(&path(name), &with_field, Encoding::Binary).unwrap();
    }
    let image = DepthImage { width: SIZE.0, height: SIZE.1, raw: frame.raw };
    for name in ["depth.png", "depth.tiff", "depth.npy"] {
        write_depth(&path(name), &image).unwrap();
    }
    write_depth_metres(&path("metres.npy"), SIZE.0, cloud.positions().z()).unwrap();
    fs::create_dir(path("page")).unwrap();
    fs::write(path("page/index.html"), "").unwrap();
    fs::create_dir(path("frames")).unwrap();
    for i in 0..3 {
        fs::copy(path("depth.png"), path("frames").join(format!("{i}.png"))).unwrap();
    }
    for (arguments, output) in [
        (&["record", "depth.png", "recording.mcap", "--frames", "3", "--camera", CAMERA][..], "recording.mcap"),
        (&["record", "depth.png", "set", "--frames", "3", "--camera", CAMERA], "set/depth.txt"),
        (&["rig", "--simulate", "2", "--frames", "1", "--out", "rig"], "rig/rig.json"),
    ] {
        let arguments: Vec<_> = arguments.iter().map(|argument| (*argument).to_owned()).collect();
        let process = program::start(folder, &arguments, None, 4 << 20);
        let ended = process.wait(Duration::from_secs(120));
        assert!(ended.status.success() && path(output).exists(), "{arguments:?}: {}", ended.stderr);
    }

    let mut samples = Vec::new();
    let mut keep = |kind, names: &[&str]| {
        samples.extend(names.iter().map(|name| Sample::new(kind, name, fs::read(path(name)).unwrap())));
    };
    keep(Kind::Cloud, &["ascii.pcd", "frame.pcd", "compressed.pcd", "general.pcd", "ascii.ply", "binary.ply"]);
    keep(
        Kind::Cloud,
        &["points.npy", "points.las", "points.laz", "points.e57", "points.npz", "points.csv", "points.xyz"],
    );
    keep(Kind::Depth, &["depth.png", "depth.tiff", "depth.npy", "metres.npy"]);
    keep(Kind::Recording, &["recording.mcap"]);
    keep(Kind::List, &["set/depth.txt"]);
    keep(Kind::Rig, &["rig/rig.json"]);
    samples.extend(written_by_others());
    samples.extend(settings_and_poses());
    samples
}

/// Returns inputs of the fuzz targets: files in formats of other programs, recordings and camera files.
fn written_by_others() -> Vec<Sample> {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus");
    let kinds = [
        (Kind::Cloud, &["bin", "gltf", "obj", "off", "ptx", "stl", "text", "las", "e57", "npz", "pcd"][..]),
        (Kind::Depth, &["exr", "pfm", "pgm", "depth_tiff"]),
        (Kind::Recording, &["mcap"]),
        (Kind::Camera, &["camera"]),
    ];
    let mut samples = Vec::new();
    for (kind, folders) in kinds {
        for folder in folders {
            let mut paths: Vec<PathBuf> =
                fs::read_dir(corpus.join(folder)).unwrap().map(|entry| entry.unwrap().path()).collect();
            paths.sort();
            // Most PCD files of the corpus are already damaged.
            paths.retain(|path| *folder != "pcd" || path.to_str().unwrap().contains("valid-"));
            assert!(!paths.is_empty(), "{folder}");
            for path in paths {
                let name = path.file_name().unwrap().to_str().unwrap();
                samples.push(Sample::new(kind, name, fs::read(&path).unwrap()));
            }
        }
    }
    samples
}

fn settings_and_poses() -> [Sample; 7] {
    let pose = "0 0 0 0 0 0 1";
    let poses: String = (0..3).map(|i| format!("{i}.5 {pose}\n")).collect();
    let log: String = (0..3).map(|i| format!("{i} {i} 3\n1 0 0 0\n0 1 0 0\n0 0 1 {i}\n0 0 0 1\n")).collect();
    let transform = "  transform: {translation: {x: 0.1, y: 0, z: 0}, rotation: {x: 0, y: 0, z: 0, w: 1}}\n";
    let frames: String = ["left", "right"]
        .map(|side| format!("- header: {{frame_id: base}}\n  child_frame_id: {side}_depth_optical_frame\n{transform}"))
        .concat();
    let urdf = "<robot name=\"r\"><link name=\"base\"/><link name=\"cam_depth_optical_frame\"/><joint name=\"j\" \
                type=\"fixed\"><parent link=\"base\"/><child link=\"cam_depth_optical_frame\"/><origin xyz=\"0 0 1\" \
                rpy=\"0 0.5 0\"/></joint></robot>";
    let kalibr = "cam0:\n  camera_model: pinhole\n  intrinsics: [26.0, 26.0, 15.5, 11.5]\n  distortion_model: radtan\n  \
                  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]\n  resolution: [32, 24]\ncam1:\n  camera_model: pinhole\n  \
                  intrinsics: [26.0, 26.0, 15.5, 11.5]\n  distortion_model: radtan\n  distortion_coeffs: [0.1, 0.0, \
                  0.0, 0.0]\n  resolution: [32, 24]\n  T_cn_cnm1: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, \
                  0, 1]]\n";
    [
        Sample::new(Kind::Settings, "settings.yaml", "preset: strong\nstrength: 0.5\nengine: cpu\nfields: [normals]\n"),
        Sample::new(Kind::Settings, "settings.json", "{\"edges\": true, \"window\": 5, \"fill\": 3, \"ridge\": 1e-4}"),
        Sample::new(Kind::Poses, "poses.txt", poses),
        Sample::new(Kind::Poses, "trajectory.log", log),
        Sample::new(Kind::Calibration, "tf_static.yaml", format!("transforms:\n{frames}")),
        Sample::new(Kind::Calibration, "robot.urdf", urdf),
        Sample::new(Kind::Calibration, "camchain.yaml", kalibr),
    ]
}
