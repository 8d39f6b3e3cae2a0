//! Mutated files as inputs of every subcommand, with usual and extreme options.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

use planish::io;

use super::mutate::mutate;
use super::numbers::Numbers;
use super::program::{self, Ended};
use super::samples::{CAMERA, Kind, Sample, samples};

/// Maximum duration of a run.
const LONGEST: Duration = Duration::from_secs(20);
/// Address space of a run in KiB, unless it is a run with little memory.
const ADDRESS_SPACE_KIB: u64 = 3 << 19;
/// Maximum memory of a run beyond `--max-memory`, in bytes.
const BEYOND_BYTES: u64 = 100 << 20;
/// The default of `--max-memory`, in bytes.
const USUAL_BYTES: u64 = 2 << 30;

/// Options with usual and extreme values.
const OPTIONS: [(&str, &[&str]); 22] = [
    ("--preset", &["paper", "fast", "light", "strong", "none"]),
    ("--strength", &["0", "1", "0.3", "-1", "nan", "1e9"]),
    ("--sensor", &["kinect1", "d435", "azure-kinect", "x"]),
    ("--edges", &["keep", "robust", "off"]),
    ("--window", &["1", "3", "9", "101", "4", "0", "18446744073709551615"]),
    ("--stride", &["1", "2", "7", "0", "255", "99999999999"]),
    ("--radius", &["0.05", "0", "1e-30", "1e30", "inf", "nan", "sensor"]),
    ("--neighbours", &["3", "40", "1", "1000000"]),
    ("--passes", &["1", "2", "3"]),
    ("--degree", &["1", "2", "3", "9", "-1"]),
    ("--bandwidth", &["0.01", "0", "1e-40", "inf"]),
    ("--ridge", &["0", "1e-4", "1e30", "-1"]),
    ("--fill", &["0", "8", "24", "1000000"]),
    ("--min-range", &["0.4", "nan", "-1", "1e30"]),
    ("--max-range", &["2", "0", "1e-30", "inf"]),
    ("--decimate", &["2", "0", "1000", "18446744073709551615"]),
    ("--fields", &["normals", "status,curvature", "sigma", "x", "\u{1b}[31m"]),
    ("--grid", &["auto", "off"]),
    ("--even", &["true", "false"]),
    ("--remove-floating", &["true", "false"]),
    ("--remove-isolated", &["true"]),
    ("--temporal", &["steady", "off"]),
];
const OUTPUTS: [&str; 12] = ["pcd", "ply", "npy", "npz", "las", "laz", "e57", "csv", "xyz", "png", "tiff", "bin"];

/// One run of the command.
struct Attack {
    arguments: Vec<String>,
    stdin: Option<PathBuf>,
    max_memory: u64,
    address_space_kib: u64,
}

/// Changes files, runs the command on each, and panics with a list of the faults.
pub fn run(files: usize, seed: u64) {
    let sound = tempfile::tempdir().unwrap();
    let samples = samples(sound.path());
    let only = std::env::var("PLANISH_HOSTILE_ONLY").ok().map(|text| text.parse().unwrap());
    let (next, succeeded, peak) = (AtomicUsize::new(only.unwrap_or(0)), AtomicUsize::new(0), AtomicU64::new(0));
    let faults = Mutex::new(Vec::new());
    let end = only.map_or(files, |only: usize| only + 1);
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(2, usize::from) {
            scope.spawn(|| {
                loop {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    if number >= end {
                        break;
                    }
                    let case = Case::new(sound.path(), &samples, seed, number);
                    match case.attack() {
                        Ok(ended) => {
                            succeeded.fetch_add(usize::from(ended.status.success()), Ordering::Relaxed);
                            peak.fetch_max(ended.peak_bytes, Ordering::Relaxed);
                        }
                        Err(fault) => faults.lock().unwrap().push(case.keep(&fault)),
                    }
                }
            });
        }
    });
    let (faults, succeeded) = (faults.into_inner().unwrap(), succeeded.into_inner());
    println!("{files} files, {succeeded} of them used; at most {} MB", peak.into_inner() >> 20);
    assert!(faults.is_empty(), "{} faults:\n{}", faults.len(), faults.join("\n"));
    // If every file were refused, only headers would have been tested.
    assert!(only.is_some() || succeeded > files / 10, "{succeeded} of {files}");
}

/// A changed file in a new folder.
struct Case<'a> {
    sound: &'a Path,
    folder: tempfile::TempDir,
    input: PathBuf,
    bytes: Vec<u8>,
    attack: Attack,
    seed: u64,
    number: usize,
}

impl<'a> Case<'a> {
    fn new(sound: &'a Path, samples: &[Sample], seed: u64, number: usize) -> Self {
        let mut numbers = Numbers::new(seed, number as u64);
        let sample = &samples[number % samples.len()];
        let mut bytes = sample.bytes.clone();
        // One file in twenty stays unchanged, so that options are tested too.
        if !numbers.one_in(20) {
            let other = &samples[numbers.below(samples.len())];
            mutate(&mut bytes, &sample.name, &other.bytes, &mut numbers);
        }
        let folder = tempfile::tempdir().unwrap();
        let name = Path::new(&sample.name).file_name().unwrap();
        let within = match sample.kind {
            Kind::Rig => folder.path().join("rig"),
            Kind::List => folder.path().join("set"),
            Kind::Recording if numbers.one_in(3) => folder.path().join("a.part"),
            _ => folder.path().to_owned(),
        };
        if matches!(sample.kind, Kind::Rig | Kind::List) {
            // The changed file refers to these files.
            copy_folder(&sound.join(within.file_name().unwrap()), &within);
        }
        fs::create_dir_all(&within).unwrap();
        let input = within.join(name);
        fs::write(&input, &bytes).unwrap();
        fs::create_dir(folder.path().join("out")).unwrap();
        let attack = Attack::new(sample, &input, sound, &mut numbers);
        Self { sound, folder, input, bytes, attack, seed, number }
    }

    /// Runs the command; the error describes the fault.
    fn attack(&self) -> Result<Ended, String> {
        let folder = self.folder.path();
        let process =
            program::start(folder, &self.attack.arguments, self.attack.stdin.as_deref(), self.attack.address_space_kib);
        if self.attack.arguments[0] == "view" {
            process.interrupt_after("press Ctrl-C", LONGEST);
        }
        let ended = process.wait(LONGEST);
        let printed = format!("{}{}", ended.stdout, ended.stderr);
        let code = ended.status.code();
        if ended.too_long {
            return Err(format!("took over {LONGEST:?}"));
        }
        // If there is no memory for a new thread, libraries below planish end the process.
        let of_threads = ["Fatal glibc error", "failed to allocate an alternative stack"];
        let has_little = self.attack.address_space_kib < ADDRESS_SPACE_KIB;
        if has_little && of_threads.iter().any(|fault| printed.contains(fault)) {
            return Ok(ended);
        }
        if !matches!(code, Some(0..=2)) || printed.contains("panicked") {
            return Err(format!("{}: {}", ended.status, ended.stderr));
        }
        if code != Some(0) && ended.stderr.trim().is_empty() {
            return Err(format!("{code:?} without a message"));
        }
        if let Some(sign) = printed.chars().find(|c| c.is_control() && !"\n\t".contains(*c)) {
            return Err(format!("prints {sign:?}"));
        }
        if ended.peak_bytes > self.attack.max_memory + BEYOND_BYTES {
            return Err(format!("{} MB, {} allowed", ended.peak_bytes >> 20, self.attack.max_memory >> 20));
        }
        let recovers = self.attack.arguments[0] == "recover";
        if !recovers && fs::read(&self.input).ok().as_ref() != Some(&self.bytes) {
            return Err("the input was changed".to_owned());
        }
        self.check_outputs(&folder.join("out")).map_err(|fault| format!("{code:?}, {fault}"))?;
        Ok(ended)
    }

    /// Checks that every file that was written is whole.
    fn check_outputs(&self, out: &Path) -> Result<(), String> {
        for entry in fs::read_dir(out).unwrap().map(Result::unwrap) {
            let path = entry.path();
            if path.is_dir() {
                self.check_outputs(&path)?;
                continue;
            }
            // If memory runs out, an unfinished recording stays for `planish recover`.
            let has_little = self.attack.address_space_kib < ADDRESS_SPACE_KIB;
            if has_little && path.extension().is_some_and(|extension| extension == "part") {
                continue;
            }
            check_output(&path, self.sound).map_err(|error| format!("{}: {error}", path.display()))?;
        }
        Ok(())
    }

    /// Saves the changed file for inspection, and returns a description of the fault.
    fn keep(&self, fault: &str) -> String {
        let name = self.input.file_name().unwrap().to_str().unwrap();
        let kept = std::env::temp_dir().join(format!("planish-hostile-{}-{}-{name}", self.seed, self.number));
        fs::write(&kept, &self.bytes).unwrap();
        format!(
            "{} of seed {}: {fault}\n    {:?}\n    file: {}",
            self.number,
            self.seed,
            self.attack.arguments,
            kept.display()
        )
    }
}

/// Returns an error if a file is not whole.
pub fn check_output(path: &Path, scratch: &Path) -> Result<(), String> {
    let name = path.file_name().unwrap().to_str().unwrap();
    if name.contains(".tmp") || name.starts_with('.') {
        return Err("a temporary file is left".to_owned());
    }
    let extension = path.extension().and_then(|extension| extension.to_str()).unwrap_or("");
    match extension {
        "png" => io::read_rgb_png(path).map(drop).or_else(|_| io::read(path).map(drop)).map_err(|e| e.to_string()),
        "json" => {
            let text = fs::read_to_string(path).map_err(|e| e.to_string())?;
            serde_json::from_str::<serde_json::Value>(&text).map(drop).map_err(|e| e.to_string())
        }
        // The number of columns of a lidar's .bin cannot be detected from a few points.
        "bin" => io::read_with(path, &io::ReadOptions::default().with_columns(Some(4)))
            .map(drop)
            .or_else(|_| io::read(path).map(drop))
            .map_err(|e| e.to_string()),
        // Lists of data sets, and reports.
        "txt" | "yaml" | "md" | "svg" | "1" => Ok(()),
        "glb" => io::read(path).map(drop).map_err(|e| e.to_string()),
        "mcap" => {
            let folder = tempfile::tempdir_in(scratch).unwrap();
            let arguments = ["info".to_owned(), path.to_str().unwrap().to_owned()];
            let process = program::start(folder.path(), &arguments, None, ADDRESS_SPACE_KIB);
            let ended = process.wait(LONGEST);
            let is_whole = ended.status.success() && !ended.stderr.contains("cut");
            if is_whole { Ok(()) } else { Err(ended.stderr) }
        }
        _ => io::read(path).map(drop).map_err(|e| e.to_string()),
    }
}

fn copy_folder(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap().map(Result::unwrap) {
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy_folder(&entry.path(), &target);
        } else {
            fs::copy(entry.path(), target).unwrap();
        }
    }
}

impl Attack {
    fn new(sample: &Sample, input: &Path, sound: &Path, numbers: &mut Numbers) -> Self {
        let file = input.to_str().unwrap().to_owned();
        let good = |name: &str| sound.join(name).to_str().unwrap().to_owned();
        let out = |extension: &str| format!("out/out.{extension}");
        let written = out(numbers.of(&OUTPUTS));
        let mut stdin = None;
        let camera = vec!["--camera".to_owned(), CAMERA.to_owned()];
        let words = |words: &[&str]| words.iter().map(|word| (*word).to_owned()).collect::<Vec<_>>();
        let with = |first: &[&str], rest: &[String]| [words(first), rest.to_vec()].concat();
        let cpu = ["--engine", "cpu", "--threads", "1"];
        let smooths = |arguments: Vec<String>| [arguments, words(&cpu)].concat();
        let live = ["--frames", "2"];
        let mut arguments = match sample.kind {
            Kind::Cloud | Kind::Depth => {
                let mut camera = camera.clone();
                if sample.kind == Kind::Cloud {
                    camera.clear();
                }
                match numbers.below(17) {
                    0 => with(&["info", &file, "--image", numbers.of(&["1", "2"])], &camera),
                    1 => with(&["info", &file, "--json"], &camera),
                    2 | 3 => smooths(with(&["smooth", &file, &written], &camera)),
                    4 => {
                        stdin = Some(input.to_owned());
                        smooths(with(&["smooth", "-", &written], &camera))
                    }
                    5 => with(&["convert", &file, &written], &camera),
                    6 => with(&["convert", &file, &out(input.extension().unwrap().to_str().unwrap())], &camera),
                    7 => {
                        let step = numbers.of(&[
                            ["--crop", "-1,-1,0,1,1,2"],
                            ["--voxel", "0.02"],
                            ["--voxel", "1e-30"],
                            ["--statistical", "8,1"],
                            ["--radius-outliers", "0.05,4"],
                            ["--radius-outliers", "1e30,2"],
                        ]);
                        with(&["clean", &file, &written, step[0], step[1]], &camera)
                    }
                    8 => with(&["render", &file, &out("png")], &camera),
                    9 => {
                        let mesh = out(numbers.of(&["ply", "obj", "stl", "glb"]));
                        smooths(with(&["mesh", &file, &mesh], &camera))
                    }
                    10 => with(&["compare", &file, &good("general.pcd"), "--nearest"], &camera),
                    11 => with(&["compare", &good("frame.pcd"), &file, "--picture", &out("png")], &camera),
                    12 => with(&["merge", &file, &good("general.pcd"), "--out", &written], &camera),
                    13 => smooths(with(&["evaluate", "--input", &file], &camera)),
                    14 => with(&["view", &file, "--page", &good("page"), "--no-browser"], &camera),
                    15 => {
                        let what = numbers.of(&["profile", "quality"]);
                        with(&["bench", what, "--quick", "--engine", "cpu", "--input", &file], &camera)
                    }
                    _ => {
                        let save = numbers.of(&["out/frames", "out/out.mcap"]);
                        smooths(with(&[&["stream", &file, "--save", save][..], &live].concat(), &camera))
                    }
                }
            }
            Kind::Recording => match numbers.below(9) {
                0 => with(&["info", &file, "--json"], &[]),
                1 => smooths(with(&["smooth", &file, numbers.of(&["out/out.mcap", "out/frames"])], &[])),
                2 => smooths(with(&[&["stream", &file][..], &live].concat(), &camera)),
                3 | 4 => with(&["recover", &file], &[]),
                5 => smooths(with(&["evaluate", "--sequence", "--input", &file, "--frames", "3"], &[])),
                6 => smooths(with(&["stream", &file, "--temporal", "steady", "--pose-topic", "/tf"], &[])),
                7 => {
                    let poses = ["--temporal", "steady", "--pose-topic", numbers.of(&["/tf", "/points"])];
                    smooths(with(&[&["smooth", &file, "out/out.mcap"][..], &poses].concat(), &[]))
                }
                _ => with(&[&["record", &file, numbers.of(&["out/out.mcap", "out/set"])][..], &live].concat(), &camera),
            },
            Kind::List => {
                let set = input.parent().unwrap().to_str().unwrap();
                smooths(with(&[&["stream", set, "--save", "out/out.mcap"][..], &live].concat(), &camera))
            }
            Kind::Camera => with(
                &[numbers.of(&["convert", "smooth"]), &good("depth.png"), &out("ply"), "--camera-file", &file],
                &[],
            ),
            Kind::Settings => {
                let (input, output) =
                    numbers.of(&[("general.pcd", "out/a.pcd"), ("frame.pcd", "out/a.pcd"), ("frames", "out/a")]);
                with(&["smooth", &good(input), output, "--settings", &file], &camera)
            }
            Kind::Rig if numbers.one_in(3) => with(&["rig", &file, "--json"], &[]),
            Kind::Rig => {
                let fuse = numbers.of(&[["--fuse", "each"], ["--fuse", "views"], ["--voxel", "0.05"]]);
                let way = if fuse[0] == "--voxel" { &["--fuse", "merged"][..] } else { &[] };
                let first = ["stream", "--rig", &file, "--frames", "1", fuse[0], fuse[1], "--save", "out/fused"];
                smooths(with(&[&first[..], way].concat(), &[]))
            }
            Kind::Calibration => with(&["rig", &file, "--out", "out/rig.json"], &[]),
            Kind::Poses if numbers.one_in(2) => {
                let clouds = ["frame.pcd", "general.pcd", "frame.pcd"].map(good);
                with(&["merge", &clouds[0], &clouds[1], &clouds[2], "--out", &written, "--poses", &file], &[])
            }
            Kind::Poses => {
                let poses = ["smooth", &good("frames"), "out/a", "--temporal", "steady", "--poses", &file];
                smooths(with(&poses, &camera))
            }
        };
        let command = arguments[0].clone();
        if matches!(command.as_str(), "smooth" | "stream" | "mesh" | "evaluate") && numbers.one_in(3) {
            for _ in 0..1 + numbers.below(2) {
                let (option, values) = numbers.of(&OPTIONS);
                if !arguments.iter().any(|argument| argument == option) {
                    arguments.push(format!("{option}={}", numbers.of(values)));
                }
            }
        }
        let mut max_memory = USUAL_BYTES;
        if command != "rig" && numbers.one_in(2) {
            max_memory = numbers.of(&[1 << 20, 16 << 20, 64 << 20, 64 << 20]);
            arguments.extend(["--max-memory".to_owned(), max_memory.to_string()]);
        }
        // One run in ten has less address space than the limit allows.
        let address_space_kib =
            if numbers.one_in(10) { 80_000 + numbers.below(200_000) as u64 } else { ADDRESS_SPACE_KIB };
        Self { arguments, stdin, max_memory, address_space_kib }
    }
}
