//! The command as users and scripts run it: a process with arguments, exit codes, files and JSON.

mod engines;
mod files;
mod fill;
mod folders;
mod hostile;
mod live;
mod measure;
mod outputs;
mod preparation;
mod rigs;
mod settings;
mod surroundings;
mod tools;
mod video;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use planish::io::{self, Encoding};
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::{Camera, DepthFrame, OrganizedCloud};
use serde_json::Value;

const CAMERA: &str = "131.25,131.25,79.5,59.5";

fn planish(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_planish")).args(arguments).output().expect("the command starts")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Runs the command, which must succeed, and returns its standard output.
fn ok(arguments: &[&str]) -> String {
    let output = planish(arguments);
    assert!(output.status.success(), "{arguments:?}: {}", text(&output.stderr));
    text(&output.stdout)
}

/// Runs the command, which must fail with exit code 2 and without a panic, and returns its standard error.
fn refused(arguments: &[&str]) -> String {
    let output = planish(arguments);
    let stderr = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {stderr}");
    assert!(!stderr.contains("panicked"), "{stderr}");
    stderr
}

fn small_frame(seed: u64) -> DepthFrame {
    frame_of(Camera::new((160, 120), [131.25, 131.25], [79.5, 59.5]), seed)
}

fn frame_of(camera: Camera, seed: u64) -> DepthFrame {
    let (scene, pose) = Scene::tabletop(seed);
    let truth = scene.render(&camera, &pose);
    DepthSimulator::new(DepthNoise::default(), camera, seed).frame(&truth, 0).unwrap()
}

/// Returns a folder with `frame.pcd`, an organized cloud with colour.
fn with_frame() -> (tempfile::TempDir, OrganizedCloud, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let cloud = small_frame(1).deproject().unwrap();
    let path = folder.path().join("frame.pcd");
    io::write_cloud(&path, &cloud, Encoding::Binary).unwrap();
    (folder, cloud, path)
}

fn str(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Returns the JSON line of a command; drivers may have printed other lines.
fn json_line(stdout: &str) -> Value {
    let line = stdout.lines().find_map(|line| line.find('{').map(|at| &line[at..])).expect(stdout);
    serde_json::Deserializer::from_str(line).into_iter().next().unwrap().unwrap()
}
