//! Hostile files, strange arguments, full disks and signals: one clear sentence, the right exit code, nothing lost.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use planish::io::{Encoding, write_cloud};
use planish::{DepthImage, PointCloud};

use super::{json_line, ok, planish, refused, small_frame, str, text, with_frame};

/// Maximum duration of a refusal, far shorter than these files took before they were refused.
const AT_ONCE: Duration = Duration::from_secs(5);

fn refused_at_once(arguments: &[&str]) -> String {
    let start = Instant::now();
    let stderr = refused(arguments);
    assert!(start.elapsed() < AT_ONCE, "{arguments:?} took {:?}", start.elapsed());
    assert_eq!(stderr.lines().count(), 1, "{stderr}");
    assert!(stderr.len() < 600, "{stderr}");
    stderr
}

fn npy(version: u8, stated: &[u8], header: &str) -> Vec<u8> {
    [b"\x93NUMPY", &[version, 0][..], stated, header.as_bytes()].concat()
}

#[test]
fn headers_that_nest_or_announce_gigabytes_are_refused_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("x.npy");
    let nested =
        ["[".repeat(30), "{1:".repeat(10), format!("{{'descr': {}'<f4'{}, }}", "(".repeat(12), ")".repeat(12))];
    for header in nested {
        fs::write(&file, npy(1, &(header.len() as u16).to_le_bytes(), &header)).unwrap();
        assert!(refused_at_once(&["info", str(&file)]).contains("damaged NPY header"), "{header}");
    }
    fs::write(&file, npy(2, &[0xff; 4], "")).unwrap();
    assert!(refused_at_once(&["info", str(&file)]).contains("4294967295 bytes"));
    for cut in [&b"\x93NUMPY"[..], b"\x93NUMPY\x01", b"\x93NUMPY\x01\x00\x40", b"\x93NUMPY\x09\x00\x10\x00"] {
        fs::write(&file, cut).unwrap();
        refused_at_once(&["info", str(&file)]);
    }
}

#[test]
fn fields_of_one_name_and_long_names_are_refused_in_a_short_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let (pcd, ply) = (folder.path().join("x.pcd"), folder.path().join("x.ply"));
    let pcd_with = |fields: &str, n: usize| {
        let [sizes, types] = ["4", "F"].map(|word| vec![word; n].join(" "));
        format!("VERSION .7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nWIDTH 1\nHEIGHT 1\nDATA ascii\n0 0 0 0\n")
    };
    fs::write(&pcd, pcd_with("x x y z", 4)).unwrap();
    assert!(refused_at_once(&["info", str(&pcd)]).contains("two FIELDS have the name \"x\""));
    fs::write(&pcd, pcd_with(&"q".repeat(5000), 1)).unwrap();
    refused_at_once(&["info", str(&pcd)]);
    fs::write(&pcd, format!("VERSION {}\n", "9".repeat(5000))).unwrap();
    assert!(refused_at_once(&["info", str(&pcd)]).contains("0.5, 0.6 or 0.7"));

    let header = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float x\n\
                  property float y\nproperty float z\nend_header\n";
    fs::write(&ply, [header.as_bytes(), &[0; 16]].concat()).unwrap();
    assert!(refused_at_once(&["info", str(&ply)]).contains("same name"));
    fs::write(&ply, format!("ply\nformat ascii 1.0\n{} 1\nend_header\n", "e".repeat(5000))).unwrap();
    refused_at_once(&["info", str(&ply)]);
    let many: String = (0..100_000).map(|i| format!("element e{i} 0\n")).collect();
    fs::write(&ply, format!("ply\nformat ascii 1.0\n{many}end_header\n")).unwrap();
    assert!(refused_at_once(&["info", str(&ply)]).contains("64 KiB"));
    let bare =
        "element e 200000000\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
    fs::write(&ply, format!("ply\nformat binary_little_endian 1.0\n{bare}")).unwrap();
    refused_at_once(&["info", str(&ply)]);
}

#[test]
fn older_pcd_versions_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("x.pcd");
    for version in [".5", "0.5", ".6", ".7"] {
        let header =
            format!("# .PCD v{version}\nVERSION {version}\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\n");
        fs::write(&file, header + "POINTS 2\nDATA ascii\n1 2 3\n4 5 6\n").unwrap();
        assert!(ok(&["info", str(&file)]).contains("2 of 2"), "{version}");
    }
}

#[test]
fn what_needs_more_memory_than_allowed_is_refused_before_it_is_allocated() {
    let (folder, _, path) = with_frame();
    let output = folder.path().join("out.pcd");
    let compressed = folder.path().join("c.pcd");
    let cloud = small_frame(1).deproject().unwrap();
    write_cloud(&compressed, &cloud, Encoding::BinaryCompressed).unwrap();
    for file in [&path, &compressed] {
        assert!(
            refused_at_once(&["info", str(file), "--max-memory", "30K"]).contains("of memory"),
            "{}",
            file.display()
        );
        ok(&["info", str(file), "--max-memory", "1G"]);
    }
    // A small file with 6 MB of pixels. `info` describes it without holding the pixels in memory, unless a camera is
    // given to compute points.
    let (width, height) = (2000, 1500);
    for name in ["flat.png", "flat.tiff"] {
        let flat = folder.path().join(name);
        let image = planish::DepthImage { width, height, raw: vec![1500; width * height] };
        planish::io::write_depth(&flat, &image).unwrap();
        let info = json_line(&ok(&["info", str(&flat), "--json", "--max-memory", "3M"]));
        assert!(info["valid_points"] == width * height && info["raw_depth"][1] == 1500, "{info}");
        let with_camera = ["info", str(&flat), "--max-memory", "3M", "--camera", "525,525,319.5,239.5"];
        assert!(refused_at_once(&with_camera).contains("of memory"), "{name}");
    }
    // The file can be read within this limit, but an engine needs more.
    assert!(refused(&["smooth", str(&path), str(&output), "--max-memory", "1M"]).contains("--max-memory"));
    assert!(!output.exists());
    assert!(refused(&["info", str(&path), "--max-memory", "much"]).contains("500M"));

    // Unorganized clouds of all sizes share one engine, so the memory need of each cloud is checked.
    let input = folder.path().join("in");
    fs::create_dir(&input).unwrap();
    let points = |n: usize| planish::PointCloud::new((0..n).map(|i| [0.01 * i as f32, 0.0, 1.0]).collect());
    write_cloud(&input.join("a.pcd"), &points(50), Encoding::Binary).unwrap();
    write_cloud(&input.join("b.pcd"), &points(8000), Encoding::Binary).unwrap();
    let smoothed = folder.path().join("smoothed");
    let run = planish(&["smooth", str(&input), str(&smoothed), "--max-memory", "1M", "--radius", "0.05"]);
    assert_eq!(run.status.code(), Some(1));
    assert!(text(&run.stderr).contains("b.pcd") || text(&run.stderr).contains("8000 points"), "{}", text(&run.stderr));
}

#[cfg(unix)]
#[test]
fn pipes_and_devices_are_refused_and_standard_input_is_read() {
    let (folder, _, path) = with_frame();
    let pipe = folder.path().join("pipe.pcd");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    for file in [pipe.as_path(), Path::new("/dev/zero")] {
        assert!(refused_at_once(&["info", str(file)]).contains("expected a regular file"));
    }
    let mut child = Command::new(env!("CARGO_BIN_EXE_planish"))
        .args(["info", "-"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    child.stdin.take().unwrap().write_all(&fs::read(&path).unwrap()).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success() && text(&output.stdout).contains("160 x 120"));
}

#[test]
fn strange_arguments_are_refused_by_name() {
    let (folder, _, path) = with_frame();
    let output = folder.path().join("out.pcd");
    let smooth = |more: &[&str]| refused_at_once(&[&["smooth", str(&path), str(&output)], more].concat());
    assert!(smooth(&["--threads", "10000", "--engine", "cpu"]).contains("1024"));
    assert!(smooth(&["--format", "a/b"]).contains("--format"));
    for (option, value) in
        [("--window", "-1"), ("--stride", "-3"), ("--degree", "-2"), ("--threads", "-1"), ("--radius", "-1")]
    {
        let stderr = refused(&["smooth", str(&path), str(&output), option, value]);
        assert!(!stderr.contains("unexpected argument") && stderr.contains(value), "{stderr}");
    }
    // A duration beyond the clock's range does not limit the stream.
    ok(&["stream", "synthetic", "--duration", "1e19", "--frames", "1"]);
    let recording = folder.path().join("recording");
    ok(&["record", "synthetic", str(&recording), "--duration", "1e19", "--frames", "1"]);
}

#[cfg(unix)]
#[test]
fn output_that_nobody_reads_or_that_has_no_room_is_no_panic() {
    let (_folder, _, path) = with_frame();
    let run = |stdout: Stdio| -> Output {
        Command::new(env!("CARGO_BIN_EXE_planish")).args(["info", str(&path)]).stdout(stdout).output().unwrap()
    };
    let full = run(fs::OpenOptions::new().write(true).open("/dev/full").unwrap().into());
    let stderr = text(&full.stderr);
    assert_eq!(full.status.code(), Some(2));
    assert!(stderr.contains("standard output") && !stderr.contains("panicked"), "{stderr}");

    let mut closed = Command::new(env!("CARGO_BIN_EXE_planish"));
    let mut child = closed.args(["info", str(&path)]).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let closed = child.wait_with_output().unwrap();
    assert_eq!((closed.status.code(), text(&closed.stderr)), (Some(0), String::new()));
}

#[cfg(target_os = "linux")]
#[test]
fn paths_that_are_not_utf8_are_reported() {
    use std::os::unix::ffi::OsStringExt;
    let (folder, _, path) = with_frame();
    let output = folder.path().join(std::ffi::OsString::from_vec(b"smo\xffth.pcd".to_vec()));
    let run = Command::new(env!("CARGO_BIN_EXE_planish"))
        .arg("smooth")
        .arg(&path)
        .arg(&output)
        .arg("--json")
        .output()
        .unwrap();
    assert!(run.status.success() && output.exists(), "{}", text(&run.stderr));
    let report: serde_json::Value = serde_json::from_slice(&run.stdout).unwrap();
    assert!(report["output"].as_str().unwrap().contains("smo\u{fffd}th.pcd"));
}

#[cfg(unix)]
#[test]
fn the_input_is_not_overwritten_unless_that_is_asked_for() {
    let (folder, _, path) = with_frame();
    let raw = fs::read(&path).unwrap();
    let [soft, hard] = ["soft.pcd", "hard.pcd"].map(|name| folder.path().join(name));
    std::os::unix::fs::symlink(&path, &soft).unwrap();
    fs::hard_link(&path, &hard).unwrap();
    for output in [&path, &soft, &hard] {
        assert!(refused(&["smooth", str(&path), str(output)]).contains("--overwrite"));
    }
    assert_eq!(fs::read(&path).unwrap(), raw);
    ok(&["smooth", str(&path), str(&soft), "--overwrite"]);
    assert!(fs::read(&path).unwrap() != raw && fs::symlink_metadata(&soft).unwrap().is_symlink());
}

#[cfg(unix)]
#[test]
fn read_only_files_are_replaced_only_with_overwrite_and_keep_their_owner() {
    use std::os::unix::fs::{MetadataExt, chown};
    let (folder, _, path) = with_frame();
    let output = folder.path().join("kept.pcd");
    fs::write(&output, "precious").unwrap();
    // Only root can give files away.
    let owner = if chown(&output, Some(1234), Some(1234)).is_ok() { 1234 } else { fs::metadata(&path).unwrap().uid() };
    let mut permissions = fs::metadata(&output).unwrap().permissions();
    permissions.set_readonly(true);
    fs::set_permissions(&output, permissions).unwrap();
    let picture = folder.path().join("kept.png");
    fs::rename(&output, &picture).unwrap();
    let error = refused(&["render", str(&path), str(&picture)]);
    assert!(
        error.contains("kept.png: the file is read-only; write to another file") && !error.contains("--overwrite"),
        "{error}"
    );
    fs::rename(&picture, &output).unwrap();
    for command in ["smooth", "convert"] {
        let error = refused(&[command, str(&path), str(&output)]);
        assert!(error.contains("kept.pcd: the file is read-only") && error.contains("--overwrite"), "{error}");
    }
    assert_eq!(fs::read(&output).unwrap(), b"precious");
    ok(&["smooth", str(&path), str(&output), "--overwrite"]);
    let metadata = fs::metadata(&output).unwrap();
    assert!(metadata.len() > 1000 && metadata.permissions().readonly() && metadata.uid() == owner);
}

#[cfg(unix)]
#[test]
fn a_signal_at_any_time_leaves_no_temporary_and_no_broken_file() {
    let folder = tempfile::tempdir().unwrap();
    let input = folder.path().join("in");
    fs::create_dir(&input).unwrap();
    for seed in 0..6 {
        write_cloud(&input.join(format!("{seed}.pcd")), &small_frame(seed).deproject().unwrap(), Encoding::Binary)
            .unwrap();
    }
    let whole = fs::metadata(input.join("0.pcd")).unwrap().len();
    let end_one = |run: u64, output: &Path| {
        let mut child = Command::new(env!("CARGO_BIN_EXE_planish"))
            .args(["smooth", str(&input), str(output), "--engine", "cpu", "--threads", "1"])
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        std::thread::sleep(Duration::from_millis(37 * run % 60));
        let signal = if run.is_multiple_of(2) { "-TERM" } else { "-INT" };
        // The process may already have ended.
        let _ = Command::new("kill").args([signal, &child.id().to_string()]).stderr(Stdio::null()).status().unwrap();
        let code = child.wait().unwrap().code();
        // A signal that arrives before the handler is installed ends the process directly.
        assert!(matches!(code, None | Some(0 | 130)), "{code:?}");
        for entry in fs::read_dir(output).into_iter().flatten().map(Result::unwrap) {
            let name = entry.file_name();
            assert!(!str(Path::new(&name)).contains(".tmp"), "{name:?}");
            assert!(entry.metadata().unwrap().len() >= whole / 2, "{name:?}");
        }
    };
    // Write two folders of results in parallel, because each run mostly waits.
    std::thread::scope(|scope| {
        for runs in [0..50, 50..100] {
            let output = folder.path().join(format!("out from {}", runs.start));
            let end_one = &end_one;
            scope.spawn(move || runs.for_each(|run| end_one(run, &output)));
        }
    });
}

#[test]
fn what_changes_nothing_for_a_general_cloud_is_said_and_slips_of_units_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let [input, output] = ["cloud.pcd", "out.pcd"].map(|name| folder.path().join(name));
    let cloud = small_frame(1).deproject().unwrap();
    write_cloud(&input, &cloud.points, Encoding::Ascii).unwrap();
    let smooth = |more: &[&str]| planish(&[&["smooth", str(&input), str(&output), "--radius", "0.05"], more].concat());
    let quiet = smooth(&[]);
    assert!(!text(&quiet.stderr).contains("no effect"));
    let usual = fs::read(&output).unwrap();
    // The input's encoding is kept.
    assert!(String::from_utf8_lossy(&usual).contains("DATA ascii"));
    let told = smooth(&["--window", "5", "--preset", "strong"]);
    assert!(text(&told.stderr).contains("--window, --preset have no effect"), "{}", text(&told.stderr));
    assert!(fs::read(&output).unwrap() == usual);
    let robust = smooth(&["--edges", "robust"]);
    assert!(!text(&robust.stderr).contains("no effect") && fs::read(&output).unwrap() != usual);
    let slip = refused_at_once(&["smooth", str(&input), str(&output), "--radius", "30"]);
    assert!(slip.contains("millimetres") && slip.contains("--force"));
}

#[test]
fn completions_and_manual_pages_are_written() {
    assert!(ok(&["completions", "bash"]).contains("--strength"));
    let folder = tempfile::tempdir().unwrap();
    let pages = folder.path().join("man");
    ok(&["man", str(&pages)]);
    assert!(fs::read_to_string(pages.join("planish-smooth.1")).unwrap().contains("max\\-memory"));
    assert!(ok(&["--help"]).contains("Exit codes"));
}

#[test]
fn options_that_the_output_has_no_use_for_are_refused_before_anything_is_read() {
    let (folder, _, path) = with_frame();
    let path_of = |name: &str| folder.path().join(name);
    for name in ["out.las", "out.csv", "out.xyz", "out.npy"] {
        let stderr = refused_at_once(&["smooth", str(&path), str(&path_of(name)), "--encoding", "ascii"]);
        assert!(stderr.contains("--encoding applies to .pcd and .ply"), "{stderr}");
    }
    assert!(refused_at_once(&["smooth", "no-such-file", str(&path_of("out.abc"))]).contains("expected .pcd"));
}

#[test]
fn a_radius_with_thousands_of_neighbours_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let [input, output] = ["cloud.pcd", "out.pcd"].map(|name| folder.path().join(name));
    // 120,000 points in a square of half a metre, and two points far away.
    let dense = (0..120_000).map(|i| [0.5 * (i % 400) as f32 / 400.0, 0.5 * (i / 400) as f32 / 300.0, 1.0]);
    let cloud = PointCloud::new(dense.chain([[0.0, 0.0, 50.0], [50.0, 0.0, 1.0]]).collect());
    write_cloud(&input, &cloud, Encoding::Binary).unwrap();
    let smooth = ["smooth", str(&input), str(&output), "--radius"];
    let stderr = refused_at_once(&[&smooth[..], &["0.2"]].concat());
    assert!(stderr.contains("covers about") && stderr.contains("--force"), "{stderr}");
    ok(&[&smooth[..], &["0.02"]].concat());
    ok(&[&smooth[..], &["0.07", "--force"]].concat());
}

#[test]
fn the_encoding_of_standard_input_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let [input, output] = ["in.pcd", "out.pcd"].map(|name| folder.path().join(name));
    write_cloud(&input, &small_frame(1).deproject().unwrap(), Encoding::BinaryCompressed).unwrap();
    let mut child = Command::new(env!("CARGO_BIN_EXE_planish"))
        .args(["smooth", "-", str(&output), "--engine", "cpu"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    child.stdin.take().unwrap().write_all(&fs::read(&input).unwrap()).unwrap();
    assert!(child.wait().unwrap().success());
    let header = fs::read(&output).unwrap();
    assert!(String::from_utf8_lossy(&header[..400]).contains("DATA binary_compressed"));
}

/// Writes a depth image, which a stream repeats without end, and returns its path.
#[cfg(feature = "mcap")]
fn repeated_depth(folder: &Path) -> PathBuf {
    let frame = small_frame(1);
    let path = folder.join("depth.png");
    let image = DepthImage { width: frame.camera.width, height: frame.camera.height, raw: frame.raw };
    planish::io::write_depth(&path, &image).unwrap();
    path
}

/// Starts a recording at 300 frames per second and waits for its first 100 kB. Without a rate, it could fill the disk
/// before a busy machine sends the signal.
#[cfg(all(unix, feature = "mcap"))]
fn record(input: &Path, output: &Path) -> std::process::Child {
    use std::os::unix::process::CommandExt;
    unsafe extern "C" {
        fn signal(signal: i32, handler: usize) -> usize;
    }
    let mut command = Command::new(env!("CARGO_BIN_EXE_planish"));
    command.args(["record", str(input), str(output), "--camera", "70,70,39.5,29.5", "--fps", "300"]);
    // Tests in the background ignore SIGHUP and SIGINT. The command would inherit that and respect it, so this resets
    // both.
    // SAFETY: `signal` may be called between fork and exec.
    unsafe {
        command.pre_exec(|| {
            for number in [1, 2] {
                signal(number, 0);
            }
            Ok(())
        })
    };
    let child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let part = output.with_extension("mcap.part");
    let start = Instant::now();
    while fs::metadata(&part).map_or(0, |metadata| metadata.len()) < 100_000 {
        assert!(start.elapsed() < Duration::from_secs(60), "no frame was recorded");
        std::thread::sleep(Duration::from_millis(2));
    }
    child
}

#[cfg(all(unix, feature = "mcap"))]
#[test]
fn a_recording_that_is_killed_is_completed_and_never_overwritten() {
    let folder = tempfile::tempdir().unwrap();
    let input = repeated_depth(folder.path());
    let camera = small_frame(1).camera;
    let frame_bytes = (2 * camera.width * camera.height + 2000) as u64;
    for run in 0..10 {
        let output = folder.path().join(format!("walk {run}.mcap"));
        let part = output.with_extension("mcap.part");
        let mut child = record(&input, &output);
        std::thread::sleep(Duration::from_millis(17 * run));
        let before = fs::metadata(&part).unwrap().len();
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(!output.exists());
        // Another process writes into the folder, and another recording wants the same name.
        write_cloud(&folder.path().join("beside.pcd"), &small_frame(1).deproject().unwrap(), Encoding::Binary).unwrap();
        let error = refused(&["record", str(&input), str(&output), "--frames", "1", "--camera", "70,70,39.5,29.5"]);
        assert!(error.contains("planish recover"), "{error}");
        let report = json_line(&ok(&["recover", str(&part), "--json"]));
        let messages = report["messages"].as_u64().unwrap();
        assert!(!part.exists() && report["damaged_chunks"] == 0);
        // A frame is two messages: its image and its camera. At most the last frame is lost.
        assert!(messages / 2 >= before / frame_bytes - 1, "{messages} of {before} bytes");
        let described = ok(&["info", str(&output)]);
        assert!(described.contains(&format!("{} messages", messages / 2)), "{described}");
        assert_eq!(json_line(&ok(&["recover", str(&output), "--json"]))["was_whole"], true);
    }
}

#[cfg(all(unix, feature = "mcap"))]
#[test]
fn signals_however_many_end_a_recording_that_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let input = repeated_depth(folder.path());
    for (run, gap_ms) in [0, 0, 1, 5, 20, 60].into_iter().enumerate() {
        let output = folder.path().join(format!("{run}.mcap"));
        let child = record(&input, &output);
        let signal = ["-INT", "-TERM", "-HUP"][run % 3];
        for _ in 0..2 {
            let id = child.id().to_string();
            let _ = Command::new("kill").args([signal, &id]).stderr(Stdio::null()).status().unwrap();
            std::thread::sleep(Duration::from_millis(gap_ms));
        }
        let ended = child.wait_with_output().unwrap();
        let code = ended.status.code();
        assert!(matches!(code, Some(0 | 130)), "{signal} {gap_ms} ms: {code:?} {}", text(&ended.stderr));
        assert!(output.exists() && !output.with_extension("mcap.part").exists(), "{signal} {gap_ms} ms");
        assert_eq!(json_line(&ok(&["recover", str(&output), "--json"]))["was_whole"], true);
    }
}

#[cfg(feature = "mcap")]
#[test]
fn frames_are_recorded_into_empty_folders_only() {
    let folder = tempfile::tempdir().unwrap();
    let input = repeated_depth(folder.path());
    let raw = folder.path().join("raw");
    fs::create_dir(&raw).unwrap();
    fs::write(raw.join("000000.png"), "mine").unwrap();
    let camera = ["--camera", "70,70,39.5,29.5"];
    for arguments in [
        &["record", str(&input), str(&raw), "--frames", "1"][..],
        &["stream", str(&input), "--frames", "1", "--save", str(&raw), "--format", "png"],
        &["stream", str(&input), "--frames", "1", "--save", str(&raw)],
    ] {
        let error = refused(&[arguments, &camera].concat());
        assert!(error.contains("raw: the folder is not empty"), "{error}");
    }
    assert_eq!(fs::read(raw.join("000000.png")).unwrap(), b"mine");
    assert_eq!(fs::read_dir(&raw).unwrap().count(), 1);
}

#[test]
fn every_command_refuses_what_needs_more_memory_than_allowed() {
    let folder = tempfile::tempdir().unwrap();
    let (width, height) = (2000, 2000);
    let path = folder.path().join("large.png");
    planish::io::write_depth(&path, &DepthImage { width, height, raw: vec![1500; width * height] }).unwrap();
    let out = |name: &str| folder.path().join(name);
    let [png, ply, mesh] = ["relief.png", "points.ply", "mesh.ply"].map(out);
    let limits = ["--camera", "1600,1600,999.5,999.5", "--max-memory", "60M"];
    for arguments in [
        &["smooth", str(&path), str(&ply)][..],
        &["convert", str(&path), str(&ply)],
        &["render", str(&path), str(&png)],
        &["mesh", str(&path), str(&mesh)],
        &["info", str(&path)],
        &["clean", str(&path), str(&ply), "--voxel", "0.01"],
        &["compare", str(&path), str(&path)],
    ] {
        let error = refused_at_once(&[arguments, &limits].concat());
        assert!(error.contains("memory"), "{arguments:?}: {error}");
    }
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn names_in_files_cannot_control_the_terminal() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a\u{1b}[31m.ply");
    let header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
                  property float \u{1b}]0;title\u{7}\nend_header\n0 0 1 2\n";
    fs::write(&path, header).unwrap();
    let missing = folder.path().join("\u{9b}2J\u{202e}.pcd");
    let hostile = "x\u{1b}]0;title\u{7}\u{9b}2J";
    for arguments in [
        &["info", str(&path)][..],
        &["info", str(&missing)],
        &["smooth", str(&path), str(&missing)],
        &["info", str(&path), hostile],
        &[hostile],
    ] {
        let output = planish(arguments);
        let printed = text(&output.stdout) + &text(&output.stderr);
        assert!(!printed.contains(['\u{1b}', '\u{7}', '\u{9b}', '\u{202e}']), "{printed:?}");
        assert!(printed.contains("\\u00") || printed.contains("\\u{1b}"), "{printed:?}");
    }
}
