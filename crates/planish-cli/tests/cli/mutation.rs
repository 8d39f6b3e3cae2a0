//! Mutated files of every format, given to the command: an error or a result, never a panic, an abort, a long run, much
//! memory, or a file that is not whole.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use planish::io::{Encoding, write_cloud, write_depth, write_depth_metres};
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::{Camera, DepthImage};

use super::{str, text};

/// Limits of a run: time, and address space in KiB.
const LONGEST: Duration = Duration::from_secs(5);
const MEMORY_KIB: u32 = 1 << 20;

const SIZE: (usize, usize) = (32, 24);
const CAMERA: &str = "26.25,26.25,15.5,11.5";

/// Numbers in a sequence that looks random, the same for every run (Marsaglia's xorshift).
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    fn below(&mut self, end: usize) -> usize {
        (self.next() % end.max(1) as u64) as usize
    }
}

/// Small valid files of every format: name and bytes.
fn seeds(folder: &Path) -> Vec<(&'static str, Vec<u8>)> {
    let camera = Camera::new(SIZE, [26.25; 2], [15.5, 11.5]);
    let (scene, pose) = Scene::tabletop(1);
    let truth = scene.render(&camera, &pose);
    let frame = DepthSimulator::new(DepthNoise::default(), camera, 1).frame(&truth, 0).unwrap();
    let cloud = frame.deproject().unwrap();
    let path = |name: &str| folder.join(name);
    write_cloud(&path("ascii.pcd"), &cloud, Encoding::Ascii).unwrap();
    write_cloud(&path("binary.pcd"), &cloud, Encoding::Binary).unwrap();
    write_cloud(&path("compressed.pcd"), &cloud, Encoding::BinaryCompressed).unwrap();
    write_cloud(&path("general.pcd"), &cloud.points, Encoding::Binary).unwrap();
    write_cloud(&path("ascii.ply"), &cloud, Encoding::Ascii).unwrap();
    write_cloud(&path("binary.ply"), &cloud, Encoding::Binary).unwrap();
    write_cloud(&path("points.npy"), &cloud, Encoding::Binary).unwrap();
    let mut with_field = cloud.points.clone();
    with_field.set_attribute("confidence", vec![0.5f32; cloud.points.len()]);
    for name in ["points.las", "points.laz", "points.e57", "points.npz"] {
        write_cloud(&path(name), &with_field, Encoding::Binary).unwrap();
    }
    let image = DepthImage { width: SIZE.0, height: SIZE.1, raw: frame.raw };
    for name in ["depth.png", "depth.tiff", "depth.npy"] {
        write_depth(&path(name), &image).unwrap();
    }
    write_depth_metres(&path("metres.npy"), SIZE.0, cloud.positions().z()).unwrap();
    let names = [
        "ascii.pcd",
        "binary.pcd",
        "compressed.pcd",
        "general.pcd",
        "ascii.ply",
        "binary.ply",
        "points.npy",
        "points.las",
        "points.laz",
        "points.e57",
        "points.npz",
        "depth.png",
        "depth.tiff",
        "depth.npy",
        "metres.npy",
    ];
    names.map(|name| (name, fs::read(path(name)).unwrap())).into()
}

/// Changes some bytes: most of them near the beginning, where headers are.
fn mutate(bytes: &mut Vec<u8>, numbers: &mut Numbers) {
    const TELLING: [&[u8]; 14] = [
        b"-1",
        b"0",
        b"4294967295",
        b"18446744073709551616",
        b"1e999",
        b"nan",
        b"\n",
        b" ",
        b"[",
        b"(",
        b"{",
        b"\0\0\0\0",
        b"\xff\xff\xff\xff",
        b"x",
    ];
    for _ in 0..1 + numbers.below(6) {
        let near = if numbers.below(4) > 0 { bytes.len().min(400) } else { bytes.len() };
        let at = numbers.below(near);
        match numbers.below(6) {
            0 => bytes.truncate(at),
            1 if !bytes.is_empty() => bytes[at] = numbers.next() as u8,
            2 if !bytes.is_empty() => bytes[at] ^= 1 << numbers.below(8),
            3 => {
                let telling = TELLING[numbers.below(TELLING.len())];
                bytes.splice(at..at, telling.iter().copied());
            }
            4 => {
                let end = (at + 1 + numbers.below(8)).min(bytes.len());
                let telling = TELLING[numbers.below(TELLING.len())];
                bytes.splice(at..end, telling.iter().copied());
            }
            _ => {
                let end = (at + numbers.below(60)).min(bytes.len());
                let again = bytes[at..end].to_vec();
                bytes.splice(end..end, again);
            }
        }
    }
}

/// Runs the command with little memory and time; returns its exit code and standard error.
fn run(arguments: &[&str]) -> (Option<i32>, String) {
    let script = format!("ulimit -v {MEMORY_KIB}; exec \"$0\" \"$@\"");
    let start = Instant::now();
    let output = Command::new("sh")
        .args(["-c", &script, env!("CARGO_BIN_EXE_planish")])
        .args(arguments)
        .stdin(Stdio::null())
        .output()
        .unwrap();
    assert!(start.elapsed() < LONGEST, "{arguments:?} took {:?}", start.elapsed());
    (output.status.code(), text(&output.stderr))
}

fn mutated_files_are_survived(files: usize, seed: u64) {
    let folder = tempfile::tempdir().unwrap();
    let seeds = seeds(folder.path());
    let mut numbers = Numbers(seed);
    let mut read = 0;
    for number in 0..files {
        let (name, bytes) = &seeds[number % seeds.len()];
        let mut bytes = bytes.clone();
        mutate(&mut bytes, &mut numbers);
        let input = folder.path().join(format!("mutated-{name}"));
        let output = folder.path().join("out").join(name);
        fs::create_dir_all(output.parent().unwrap()).unwrap();
        fs::write(&input, &bytes).unwrap();
        let depth = ["--camera", CAMERA];
        let camera = if name.starts_with("depth") || name.starts_with("metres") { &depth[..] } else { &[] };
        let smooth = ["smooth", str(&input), str(&output), "--engine", "cpu", "--threads", "1"];
        for arguments in [[&["info", str(&input)], camera].concat(), [&smooth[..], camera].concat()] {
            let (code, stderr) = run(&arguments);
            let keep = || {
                let kept = std::env::temp_dir().join(format!("planish-mutation-{seed}-{number}-{name}"));
                fs::write(&kept, &bytes).unwrap();
                format!("{arguments:?} on {}: {code:?} {stderr}", kept.display())
            };
            // 1: nothing of it can be smoothed.
            assert!(matches!(code, Some(0..=2)) && !stderr.contains("panicked"), "{}", keep());
            read += usize::from(code == Some(0));
        }
        // In any case the output is either complete or absent.
        for entry in fs::read_dir(output.parent().unwrap()).unwrap().map(Result::unwrap) {
            assert_eq!(entry.file_name().to_str(), Some(*name), "mutation {number}");
            planish::io::read(&entry.path()).unwrap_or_else(|error| panic!("mutation {number}: {error}"));
            fs::remove_file(entry.path()).unwrap();
        }
    }
    // Some mutated files must be readable, otherwise only headers were tested.
    assert!(read > files / 10, "{read} of {files} read");
}

#[test]
fn some_mutated_files_are_survived() {
    mutated_files_are_survived(390, 1);
}

#[test]
#[ignore = "takes ten minutes: run it when a reader changes"]
fn twenty_thousand_mutated_files_are_survived() {
    mutated_files_are_survived(20_000, 2);
}
