//! Processes that are stopped or killed while they write.

use std::fs;
use std::path::Path;
use std::process::{Command, ExitStatus};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use planish::io::{self, Encoding};
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::{Camera, DepthImage, PointCloud};

use super::attack::check_output;
use super::numbers::Numbers;
use super::program;

const LONGEST: Duration = Duration::from_secs(60);
const ADDRESS_SPACE_KIB: u64 = 4 << 20;
const CAMERA: &str = "262.5,262.5,159.5,119.5";

/// Commands that write into `out/`; `IN` is replaced by the folder of inputs.
const COMMANDS: [&[&str]; 18] = [
    &["smooth", "IN/frame.pcd", "out/a.pcd"],
    &["smooth", "IN/frames", "out/smoothed", "--camera", CAMERA],
    &["smooth", "IN/cloud.las", "out/tiled.laz", "--max-memory", "1M", "--radius", "0.02"],
    &["smooth", "IN/recording.mcap", "out/smoothed.mcap"],
    &["convert", "IN/frame.pcd", "out/a.e57"],
    &["convert", "IN/frame.pcd", "out/a.npz"],
    &["convert", "IN/cloud.las", "out/a.laz"],
    &["clean", "IN/frame.pcd", "out/a.ply", "--statistical", "8"],
    &["merge", "IN/frame.pcd", "IN/cloud.las", "--out", "out/a.ply"],
    &["mesh", "IN/frame.pcd", "out/a.glb"],
    &["render", "IN/frame.pcd", "out/a.png"],
    &["compare", "IN/frame.pcd", "IN/other.pcd", "--picture", "out/a.png"],
    &["record", "IN/depth.png", "out/a.mcap", "--camera", CAMERA, "--fps", "200", "--frames", "200"],
    &["record", "IN/depth.png", "out/set", "--camera", CAMERA, "--fps", "200", "--frames", "200"],
    &["stream", "IN/depth.png", "--save", "out/frames", "--camera", CAMERA, "--frames", "20"],
    &["stream", "IN/depth.png", "--save", "out/a.mcap", "--camera", CAMERA, "--frames", "40"],
    &["rig", "--simulate", "2", "--frames", "3", "--out", "out/rig"],
    &["demo", "--out", "out/demo"],
];

/// Ends processes at random times, and panics with a list of the faults.
pub fn run(runs: usize, seed: u64) {
    let inputs = tempfile::tempdir().unwrap();
    write_inputs(inputs.path());
    // Duration of each command in microseconds, 0 if not measured yet. Processes are ended within this time.
    let took = COMMANDS.map(|_| AtomicU64::new(0));
    let (next, faults) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    let ended_early = AtomicUsize::new(0);
    thread::scope(|scope| {
        for _ in 0..thread::available_parallelism().map_or(2, usize::from) {
            scope.spawn(|| {
                loop {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    if number >= runs {
                        break;
                    }
                    let (command, took) = (COMMANDS[number % COMMANDS.len()], &took[number % COMMANDS.len()]);
                    match end_one(inputs.path(), command, took, &mut Numbers::new(seed, number as u64)) {
                        Ok(early) => _ = ended_early.fetch_add(usize::from(early), Ordering::Relaxed),
                        Err(fault) => faults.lock().unwrap().push(format!("{number}: {command:?}: {fault}")),
                    }
                }
            });
        }
    });
    let (faults, ended_early) = (faults.into_inner().unwrap(), ended_early.into_inner());
    println!("{runs} processes, {ended_early} ended early");
    assert!(faults.is_empty(), "{} faults:\n{}", faults.len(), faults.join("\n"));
    assert!(ended_early > runs / 4, "only {ended_early} of {runs} ended early");
}

/// Ends one process at a random time; returns true if it had not finished.
fn end_one(inputs: &Path, command: &[&str], took: &AtomicU64, numbers: &mut Numbers) -> Result<bool, String> {
    let arguments: Vec<_> = command.iter().map(|word| word.replace("IN/", &format!("{}/", inputs.display()))).collect();
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let prepare = || {
        let _ = fs::remove_dir_all(folder.join("out"));
        fs::create_dir(folder.join("out")).unwrap();
    };
    let finish = |what: &str| {
        let start = Instant::now();
        let process = program::start(folder, &arguments, None, ADDRESS_SPACE_KIB);
        let ended = process.wait(LONGEST);
        if !ended.status.success() {
            return Err(format!("{what}: {} {}", ended.status, ended.stderr));
        }
        check_all(&folder.join("out"), true).map_err(|fault| format!("{what}: {fault}"))?;
        Ok(start.elapsed())
    };
    prepare();
    if took.load(Ordering::Relaxed) == 0 {
        took.store(finish("undisturbed")?.as_micros() as u64, Ordering::Relaxed);
        prepare();
    }
    let process = program::start(folder, &arguments, None, ADDRESS_SPACE_KIB);
    thread::sleep(Duration::from_micros(numbers.next() % took.load(Ordering::Relaxed).max(1)));
    let signal = numbers.of(&[libc::SIGKILL, libc::SIGKILL, libc::SIGTERM, libc::SIGINT, libc::SIGHUP]);
    process.signal(signal);
    if signal != libc::SIGKILL && numbers.one_in(3) {
        thread::sleep(Duration::from_millis(numbers.next() % 30));
        process.signal(signal);
    }
    let ended = process.wait(LONGEST);
    if ended.too_long {
        return Err(format!("signal {signal} did not end it"));
    }
    // A signal before the handlers are installed ends the process directly.
    let is_expected = |status: ExitStatus| matches!(status.code(), None | Some(0 | 130));
    if !is_expected(ended.status) || ended.stderr.contains("panicked") {
        return Err(format!("signal {signal}: {} {}", ended.status, ended.stderr));
    }
    let killed = ended.status.code().is_none();
    check_all(&folder.join("out"), !killed).map_err(|fault| format!("signal {signal}, {}: {fault}", ended.status))?;
    recover_all(&folder.join("out"))?;
    // The command can be run again, unless it requires a new or empty folder.
    if !["record", "stream", "rig"].contains(&command[0]) {
        finish("again")?;
    }
    Ok(ended.status.code() != Some(0))
}

/// Checks that every file is whole. After a kill, temporary files and unfinished recordings may remain.
fn check_all(folder: &Path, all: bool) -> Result<(), String> {
    for entry in fs::read_dir(folder).unwrap().map(Result::unwrap) {
        let path = entry.path();
        if path.is_dir() {
            check_all(&path, all)?;
            continue;
        }
        let name = entry.file_name().into_string().unwrap();
        if !all && (name.contains(".tmp") || name.starts_with('.') || name.ends_with(".part")) {
            continue;
        }
        check_output(&path, folder.parent().unwrap()).map_err(|error| format!("{}: {error}", path.display()))?;
    }
    Ok(())
}

/// Completes unfinished recordings, and checks that they are whole.
fn recover_all(folder: &Path) -> Result<(), String> {
    for entry in fs::read_dir(folder).unwrap().map(Result::unwrap) {
        let path = entry.path();
        if path.extension().is_none_or(|extension| extension != "part") {
            continue;
        }
        let is_large = entry.metadata().unwrap().len() > 2000;
        let recovered = Command::new(program::planish()).arg("recover").arg(&path).output().unwrap();
        let said = String::from_utf8_lossy(&recovered.stderr).into_owned();
        if !recovered.status.success() {
            // A recording with only a header cannot be completed.
            if is_large { Err(said) } else { Ok(()) }?;
            continue;
        }
        check_output(&path.with_extension(""), folder).map_err(|error| format!("recovered: {error}"))?;
    }
    Ok(())
}

fn write_inputs(folder: &Path) {
    let path = |name: &str| folder.join(name);
    let camera = Camera::new((320, 240), [262.5; 2], [159.5, 119.5]);
    let (scene, pose) = Scene::tabletop(1);
    let truth = scene.render(&camera, &pose);
    let frame = |seed| DepthSimulator::new(DepthNoise::default(), camera, seed).frame(&truth, 0).unwrap();
    for (name, seed) in [("frame.pcd", 1), ("other.pcd", 2)] {
        io::write_cloud(&path(name), &frame(seed).deproject().unwrap(), Encoding::Binary).unwrap();
    }
    let cloud = PointCloud::new(frame(3).deproject().unwrap().points.positions);
    io::write_cloud(&path("cloud.las"), &cloud, Encoding::Binary).unwrap();
    let image = DepthImage { width: 320, height: 240, raw: frame(4).raw };
    io::write_depth(&path("depth.png"), &image).unwrap();
    fs::create_dir(path("frames")).unwrap();
    for i in 0..6 {
        fs::copy(path("depth.png"), path("frames").join(format!("{i}.png"))).unwrap();
    }
    let recording = path("recording.mcap");
    let record = ["record", path("depth.png").to_str().unwrap(), recording.to_str().unwrap(), "--frames", "10"]
        .map(str::to_owned);
    let record = [&record[..], &["--camera".to_owned(), CAMERA.to_owned()]].concat();
    let process = program::start(folder, &record, None, ADDRESS_SPACE_KIB);
    let ended = process.wait(LONGEST);
    assert!(ended.status.success(), "{}", ended.stderr);
}
