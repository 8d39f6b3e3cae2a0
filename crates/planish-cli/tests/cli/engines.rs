//! Engines: agreement, devices, and selection by name.

use std::fs;
use std::process::Command;

use serde_json::Value;

use super::{ok, refused, str, text, with_frame};

#[test]
fn engines_agree_and_threads_change_no_byte() {
    let (folder, _, path) = with_frame();
    let run = |name: &str, more: &[&str]| {
        let output = folder.path().join(name);
        let stdout = ok(&[&["smooth", str(&path), str(&output), "--json"], more].concat());
        let report: Value = serde_json::from_str(&stdout).unwrap();
        (report["engine"].as_str().unwrap().to_owned(), fs::read(&output).unwrap(), output)
    };
    let (auto, auto_bytes, _) = run("auto.pcd", &[]);
    let (cpu, one, cpu_path) = run("one.pcd", &["--engine", "cpu", "--threads", "1"]);
    let (_, three, _) = run("three.pcd", &["--engine", "cpu", "--threads", "3"]);
    assert_eq!((auto.as_str(), cpu.as_str()), ("cpu", "cpu"));
    assert!(one == three && one == auto_bytes);
    let (reference, _, reference_path) = run("reference.pcd", &["--engine", "reference"]);
    assert_eq!(reference, "reference");
    let (fast, slow) =
        (planish::io::read_organized(&cpu_path).unwrap(), planish::io::read_organized(&reference_path).unwrap());
    let far = fast.positions().iter().zip(slow.positions().iter()).filter(|(p, q)| {
        let off = (0..3).map(|k| (p[k] - q[k]).powi(2)).sum::<f32>().sqrt();
        p[2].is_nan() != q[2].is_nan() || off > 2e-5
    });
    assert!(far.count() <= 2);
}

#[test]
fn engines_that_are_not_there_say_so() {
    let (folder, _, path) = with_frame();
    let output = folder.path().join("never.pcd");
    let message = refused(&["smooth", str(&path), str(&output), "--engine", "gpu"]);
    assert!(message.contains("gpu"), "{message}");
    assert!(!output.exists());
}

#[test]
fn devices_says_what_auto_takes_and_why() {
    let devices: Value = serde_json::from_str(&ok(&["devices", "--json"])).unwrap();
    let taken = devices["auto"]["engine"].as_str().unwrap();
    let is_real = |gpu: &Value| ["discrete", "integrated", "virtual"].contains(&gpu["kind"].as_str().unwrap());
    let has_gpu = devices["gpus"].as_array().unwrap().iter().any(is_real);
    assert_eq!(taken, if has_gpu { "gpu" } else { "cpu" });
    assert!(!devices["auto"]["reason"].as_str().unwrap().is_empty());
    assert!(devices["cpu"]["simd_levels"].as_array().unwrap().contains(&devices["cpu"]["simd"]));
    assert!(ok(&["devices"]).contains(&format!("selects {taken}")));
}

#[test]
fn an_adapter_is_taken_by_name_and_its_absence_said() {
    let (folder, _, path) = with_frame();
    let smooth = folder.path().join("smooth.pcd");
    let arguments = |more: &[&'static str]| [&["smooth", str(&path), str(&smooth)], more].concat();
    assert!(refused(&arguments(&["--adapter", "0"])).contains("engine gpu"));
    assert!(refused(&arguments(&["--engine", "gpu", "--adapter", "no such card"])).contains("adapter"));
    // Simulate a machine without GPU drivers.
    let output = Command::new(env!("CARGO_BIN_EXE_planish"))
        .args(arguments(&["--engine", "gpu"]))
        .env("VK_DRIVER_FILES", "/nonexistent")
        .env("VK_ICD_FILENAMES", "/nonexistent")
        .output()
        .unwrap();
    if cfg!(target_os = "linux") {
        assert_eq!(output.status.code(), Some(2));
        assert!(text(&output.stderr).contains("no adapter was found"), "{}", text(&output.stderr));
    }
    assert!(!smooth.exists());
    let devices: Value = serde_json::from_str(&ok(&["devices", "--json"])).unwrap();
    let Some(gpu) = devices["gpus"].get(0) else {
        eprintln!("SKIP the GPU engine from the command line: no adapter");
        return;
    };
    let report: Value =
        serde_json::from_str(&ok(&arguments(&["--engine", "gpu", "--adapter", "0", "--json"]))).unwrap();
    assert_eq!((&report["engine"], &report["adapter"]), (&Value::from("gpu"), &gpu["name"]));
    assert!(smooth.exists());
}
