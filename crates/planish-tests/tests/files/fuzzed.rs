//! Every input of the fuzz targets: valid files, and one file for each kind of damage found so far.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use planish::io::Format;

#[path = "../../../../fuzz/src/lib.rs"]
mod checks;

fn fuzz() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz")
}

fn names(folder: &Path) -> BTreeSet<String> {
    let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    entries.map(|path| path.file_stem().unwrap().to_str().unwrap().to_owned()).collect()
}

/// Checks bytes as the given fuzz target does.
fn check(target: &str, bytes: &[u8]) {
    let format = match target {
        "camera" => return checks::check_camera(std::str::from_utf8(bytes).unwrap()),
        "lzf" => return checks::check_lzf(bytes),
        "laz_chunks" => return checks::check_laz_chunks(bytes),
        "mcap" => return checks::check_bag(bytes),
        "recover" => return checks::check_recover(bytes),
        "rig" => return checks::check_rig(bytes),
        "tum" => return checks::check_tum(bytes),
        "depth_png" => Format::DepthPng,
        "depth_tiff" => Format::DepthTiff,
        "e57" => Format::E57,
        "las" => Format::Las,
        "npy" => Format::Npy,
        "npz" => Format::Npz,
        "obj" => Format::Obj,
        "pcd" => Format::Pcd,
        "ply" => Format::Ply,
        "stl" => Format::Stl,
        "ptx" => Format::Ptx,
        "off" => Format::Off,
        "pgm" => Format::Pgm,
        "pfm" => Format::Pfm,
        "exr" => Format::Exr,
        "gltf" => Format::Gltf,
        "text" => Format::Text,
        "bin" => Format::KittiBin,
        other => panic!("no check for the target {other}"),
    };
    checks::check_decoder(bytes, format);
}

#[test]
fn every_fuzz_target_has_inputs_and_stands_them() {
    let corpus = fuzz().join("corpus");
    assert_eq!(names(&corpus), names(&fuzz().join("fuzz_targets")));
    for target in names(&corpus) {
        let inputs: Vec<_> = fs::read_dir(corpus.join(&target)).unwrap().map(|entry| entry.unwrap().path()).collect();
        assert!(!inputs.is_empty(), "{target}");
        for input in inputs {
            println!("{}", input.display());
            check(&target, &fs::read(&input).unwrap());
        }
    }
}
