//! The commands that measure: `evaluate` and `bench`.

use std::fs;
use std::path::Path;
use std::process::Command;

use planish::Camera;
use planish::io::{Encoding, write_cloud};
use serde_json::Value;

use super::{CAMERA, frame_of, ok, refused, str, with_frame};

#[test]
fn evaluate_measures_simulated_frames_and_draws_their_errors() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let rows: Value =
        serde_json::from_str(&ok(&["evaluate", "--seed", "2", "--json", "--still-frames", "10", "--out", str(&out)]))
            .unwrap();
    let names: Vec<_> = rows.as_array().unwrap().iter().map(|row| row["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["raw", "paper", "smoothed"]);
    assert!(near(&rows[2]) < 0.36 * near(&rows[0]) && near(&rows[2]) < near(&rows[1]));
    assert!(rows[2]["jitter_mm"].as_f64().unwrap() < 0.5 * rows[0]["jitter_mm"].as_f64().unwrap());
    assert!(fs::read_to_string(out.join("error-over-z.svg")).unwrap().contains("</svg>"));
    for file in ["table-2.png", "room-2.png", "shapes-2.png"] {
        assert!(fs::read(out.join(file)).unwrap().starts_with(b"\x89PNG"));
    }
    assert_eq!(serde_json::from_slice::<Value>(&fs::read(out.join("report.json")).unwrap()).unwrap()[2], rows[2]);

    // Frames are simulated with the noise of the chosen sensor and smoothed with its model.
    let azure = ok(&["evaluate", "--seed", "2", "--json", "--still-frames", "0", "--sensor", "azure-kinect"]);
    let azure: Value = serde_json::from_str(&azure).unwrap();
    assert!(near(&azure[0]) < 0.5 * near(&rows[0]) && near(&azure[2]) < 0.25 * near(&azure[0]));
    assert!(azure[0]["jitter_mm"].is_null() && azure[2]["jitter_mm"].is_null());
}

/// Returns the RMS error of positions in the nearest range, in millimetres.
fn near(row: &Value) -> f64 {
    row["ranges"][0]["rmse_mm"].as_f64().unwrap()
}

#[test]
fn evaluate_measures_what_others_made_of_the_same_frames_and_files_by_themselves() {
    let folder = tempfile::tempdir().unwrap();
    let frames = folder.path().join("frames");
    ok(&["evaluate", "--seed", "2", "--export", str(&frames)]);
    // A program that changes nothing has the same errors as the raw frames.
    let others = ok(&["evaluate", "--seed", "2", "--json", "--still-frames", "0", "--results", str(&frames)]);
    let others: Value = serde_json::from_str(&others).unwrap();
    for (raw, same) in others[0]["ranges"].as_array().unwrap().iter().zip(others[1]["ranges"].as_array().unwrap()) {
        assert_eq!(raw["rmse_mm"], same["rmse_mm"]);
        // The normals of the results were normalized again, so their errors differ slightly.
        let [raw, same] = [raw, same].map(|range| range["normal_mean_deg"].as_f64().unwrap());
        assert!((raw - same).abs() < 1e-3, "{raw} {same}");
    }
    assert!(near(&others[0]) > 1.0);
    let frame = frames.join("table-2.pcd");
    fs::remove_file(&frame).unwrap();
    assert!(refused(&["evaluate", "--seed", "2", "--results", str(&frames)]).contains("table-2.pcd"));

    // Evaluate a file on its own.
    let frame = frames.join("room-2.pcd");
    let tiles: Value = serde_json::from_str(&ok(&["evaluate", "--input", str(&frame), "--json"])).unwrap();
    let rms = |of: &str| tiles[of]["rms_mm"].as_f64().unwrap();
    assert!(rms("smoothed") < 0.3 * rms("raw") && tiles["raw"]["tiles"].as_u64().unwrap() > 1000);
    let same = ok(&["evaluate", "--input", str(&frame), "--results", str(&frame), "--json"]);
    let same: Value = serde_json::from_str(&same).unwrap();
    assert_eq!(same["raw"]["rms_mm"], same["smoothed"]["rms_mm"]);
    assert_eq!(same["raw"]["tiles"], same["smoothed"]["tiles"]);

    // Evaluate the same file without its grid.
    let general = folder.path().join("general.ply");
    let points = planish::io::read(&frame).unwrap().1;
    let planish::io::Contents::Organized(cloud) = points else { panic!("a frame") };
    planish::io::write_cloud(&general, &cloud.points, planish::io::Encoding::Binary).unwrap();
    let patches: Value = serde_json::from_str(&ok(&["evaluate", "--input", str(&general), "--json"])).unwrap();
    let rms = |of: &str| patches[of]["rms_mm"].as_f64().unwrap();
    assert!(rms("smoothed") < 0.5 * rms("raw") && patches["raw"]["patches"].as_u64().unwrap() > 1000, "{patches}");
    assert!(patches["raw"]["normal_deg"].is_null() && patches["smoothed"]["normal_deg"].as_f64().unwrap() < 20.0);
    let error = refused(&["evaluate", "--input", str(&general), "--results", str(&frame)]);
    assert!(error.contains("room-2.pcd") && error.contains("has a grid"), "{error}");
}

#[test]
fn evaluate_measures_simulated_frames_without_their_grid() {
    let general = ["evaluate", "--seed", "2", "--json", "--general", "--neighbours", "60", "--still-frames", "3"];
    let rows: Value = serde_json::from_str(&ok(&general)).unwrap();
    assert_eq!(rows[1]["name"], "on the grid");
    let of_points = |row: usize| rows[row]["ranges"][1]["rmse_mm"].as_f64().unwrap();
    assert!(of_points(1) < 0.3 * of_points(0) && of_points(2) < 0.63 * of_points(0), "{rows}");
    assert!(near(&rows[2]) < 0.6 * near(&rows[0]), "{rows}");
    let jitter = |row: usize| rows[row]["jitter_mm"].as_f64().unwrap();
    assert!(jitter(2) < 0.8 * jitter(0), "{rows}");
}

#[test]
fn the_experiments_write_tables_numbers_and_pictures() {
    // This frame has a quarter of the other tests' pixels because it is smoothed thousands of times.
    let (folder, camera) = (tempfile::tempdir().unwrap(), Camera::new((80, 60), [65.625; 2], [39.5, 29.5]));
    let [cloud, depth] = ["frame.pcd", "frame.png"].map(|name| folder.path().join(name));
    write_cloud(&cloud, &frame_of(camera, 1).deproject().unwrap(), Encoding::Binary).unwrap();
    let camera = "65.625,65.625,39.5,29.5";
    ok(&["smooth", str(&cloud), str(&depth), "--camera", camera]);
    let document = folder.path().join("B.md");
    fs::write(
        &document,
        "before\n<!-- planish bench small -->\nstale figures\n<!-- end of planish bench small -->\nafter\n",
    )
    .unwrap();
    let out = folder.path().join("plots/small");
    let [cloud, depth, out_text, document_text] = [&cloud, &depth, &out, &document].map(|path| str(path));
    let bench = ["bench", "all", "--quick", "--engine", "cpu", "--camera", camera, "--out", out_text];
    let stdout = ok(&[&bench[..], &["--update", document_text, "--input", cloud, depth]].concat());
    let written = |name: &str| fs::read_to_string(out.join(name)).unwrap();
    let json = |name: &str| -> Value { serde_json::from_str(&written(&format!("{name}.json"))).unwrap() };
    let results = |name: &str| json(name)["results"].clone();
    let text = fs::read_to_string(&document).unwrap();
    assert!(text.starts_with("before\n<!-- planish bench small -->\n\n`planish bench all --quick"), "{text}");
    assert!(text.ends_with("\n<!-- end of planish bench small -->\nafter\n") && !text.contains("stale"), "{text}");
    for name in ["speedup", "connectivity", "scaleup", "profile", "quality"] {
        let markdown = written(&format!("{name}.md"));
        let table = markdown.lines().find(|line| line.starts_with("| --- |")).unwrap();
        let rows: Vec<_> = markdown.lines().filter(|line| line.starts_with('|') && *line != table).collect();
        assert!(rows.len() > 1 && rows.iter().all(|row| stdout.contains(*row) && text.contains(*row)), "{markdown}");
    }
    for (plot, reference) in [
        ("speedup-0.svg", "![Speedup over the serial"),
        ("connectivity-0.svg", "![Time per frame"),
        ("scaleup.svg", "![Scale-up"),
        ("profile-0.svg", "![Time per stage"),
    ] {
        assert!(written(plot).contains("</svg>"));
        assert!(text.contains(reference) && text.contains(&format!("(plots/small/{plot})")), "{text}");
    }
    for i in 0..2 {
        assert!(fs::read(out.join(format!("quality-{i}.png"))).unwrap().starts_with(b"\x89PNG"));
    }
    assert_eq!(json("speedup")["origin"]["version"], ok(&["--version"]).trim().replace("planish ", ""));

    let speedup = results("speedup");
    let rows = speedup.as_array().unwrap();
    assert_eq!(
        (&rows[0]["engine"], &rows[0]["frame"]),
        (&"general serial method".into(), &"frame.pcd, 80x60 as points".into())
    );
    // The rows are the general serial method and each SIMD level with one thread and with all threads; each row has a
    // time.
    let levels = planish::SimdLevel::available().count();
    assert!(rows.len() == 1 + levels || rows.len() == 1 + 2 * levels);
    assert!(rows.iter().all(|row| row["time"]["ms"]["median"].as_f64().unwrap() > 0.0));
    ok(&["bench", "simd", "--quick", "--engine", "cpu", "--input", cloud, "--out", out_text]);
    let by_level = results("simd");
    let rows = by_level.as_array().unwrap();
    assert_eq!(rows.len(), 4 * levels);
    let widest = rows.iter().skip(levels - 1).step_by(levels);
    assert!(widest.clone().all(|row| row["times_the_widest"] == 1.0), "{by_level}");
    assert!(widest.map(|row| &row["preset"]).eq(["light", "default", "strong", "paper"]), "{by_level}");

    let curves = results("connectivity");
    for curve in curves.as_array().unwrap() {
        assert_eq!(curve["candidates"], serde_json::json!([9, 49, 121, 225]));
        // On a busy machine, times need not grow with the work.
        assert!(curve["slope_ms"].as_f64().unwrap().is_finite() && curve["r2"].as_f64().unwrap() <= 1.0);
    }
    assert_eq!(curves.as_array().unwrap().len(), 2);
    assert!(written("connectivity.md").contains("frame.png, 80x60 as 16-bit depth"));
    let copies = results("scaleup")["copies"].clone();
    assert_eq!(copies.as_array().unwrap().len(), 10);
    assert_eq!(copies[0]["scaleup"], 1.0);
    // A cloud twice as tall needs twice the planes, except for their border.
    let buffers = |i: usize| copies[i]["buffers_mib"].as_f64().unwrap();
    assert!(buffers(1) > 1.8 * buffers(0) && buffers(1) < 2.0 * buffers(0), "{copies}");
    let stages = results("profile")[0]["stages"].clone();
    assert!(stages.as_array().unwrap().len() == 4 && stages[0]["ms"].as_f64().unwrap() > 0.0, "{stages}");
    let planes = results("quality");
    let variance = |row: &Value, of: &str| row[of].as_f64().unwrap();
    for row in planes.as_array().unwrap() {
        assert!(variance(row, "smoothed_variance_mm2") > 0.0 && variance(row, "raw_variance_mm2") > 0.0, "{row}");
    }
}

#[test]
fn experiments_that_cannot_be_recorded_are_refused_before_they_run() {
    let (folder, _, cloud) = with_frame();
    let (document, out) = (folder.path().join("B.md"), folder.path().join("small"));
    let record = |document: &Path| {
        refused(&["bench", "all", "--input", str(&cloud), "--out", str(&out), "--update", str(document)])
    };
    assert!(record(&document).contains("B.md"));
    fs::write(&document, "nothing marked\n").unwrap();
    assert!(record(&document).contains("<!-- planish bench small -->"));
    assert!(refused(&["bench", "all", "--update", str(&document)]).contains("--out"));
    fs::write(&document, "<!-- planish bench small -->\n<!-- end of planish bench small -->\n").unwrap();
    let one = ["bench", "speedup", "--out", str(&out), "--update", str(&document)];
    assert!(refused(&one).contains("bench all"), "the other experiments would be gone from it");
    let missing = record(&folder.path().join("missing.md"));
    assert!(missing.contains("missing.md") && missing.contains("os error"), "{missing}");
    assert!(refused(&["bench", "speedup", "--input", "missing.pcd"]).contains("missing.pcd"));
    let depth = folder.path().join("frame.png");
    ok(&["smooth", str(&cloud), str(&depth), "--camera", CAMERA]);
    assert!(refused(&["bench", "speedup", "--input", str(&depth)]).contains("--camera"));
    assert!(!out.exists());
}

#[test]
fn two_frames_of_one_name_are_told_apart_and_an_engine_that_is_not_there_is_refused() {
    let (folder, cloud, path) = with_frame();
    let other = folder.path().join("other");
    fs::create_dir(&other).unwrap();
    let mut nearer = cloud;
    nearer.points.positions.as_mut_slices()[2].iter_mut().for_each(|z| *z *= 0.9);
    let other = other.join("frame.pcd");
    write_cloud(&other, &nearer, Encoding::Binary).unwrap();
    let out = folder.path().join("out");
    let bench = ["bench", "quality", "--quick", "--engine", "reference", "--input", str(&path), str(&other)];
    let stdout = ok(&[&bench[..], &["--out", str(&out)]].concat());
    assert!(stdout.contains("engine: reference (f64)"), "{stdout}");
    let quality: Value = serde_json::from_slice(&fs::read(out.join("quality.json")).unwrap()).unwrap();
    let variances: Vec<_> = (0..4).map(|i| quality["results"][i]["smoothed_variance_mm2"].as_f64().unwrap()).collect();
    assert!(variances[0] != variances[2] && variances[1] != variances[3], "{quality}");
    assert!(out.join("quality-0.png").exists() && out.join("quality-1.png").exists());
    // The reference engine alone is too slow for this experiment.
    let text = ok(&["bench", "profile", "--quick", "--engine", "reference", "--input", str(&path)]);
    assert!(text.contains("Not run with the reference engine alone."), "{text}");
    // Without a driver, the command reports that no GPU was found and does not fall back to another engine.
    let output = Command::new(env!("CARGO_BIN_EXE_planish"))
        .args(["bench", "quality", "--engine", "gpu", "--input", str(&path)])
        .env("VK_DRIVER_FILES", "/nonexistent")
        .env("VK_ICD_FILENAMES", "/nonexistent")
        .output()
        .unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    if cfg!(target_os = "linux") {
        assert_eq!(output.status.code(), Some(2), "{stderr}");
        assert!(stderr.contains("--engine gpu: no GPU was found"), "{stderr}");
    }
}
