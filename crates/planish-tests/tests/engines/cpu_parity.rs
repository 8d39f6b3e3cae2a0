//! The CPU engine against the f64 reference, at every SIMD level of this machine (docs/method.md, section 9).

use planish::SimdLevel;
use planish_tests::data::skip;
use planish_tests::engines::TestEngine;
use planish_tests::parity::{self, Subject};

fn levels() -> Vec<Subject> {
    SimdLevel::available().map(|level| (level.name().to_owned(), TestEngine::cpu(level))).collect()
}

#[test]
fn every_level_of_this_machine_is_tested() {
    let names: Vec<_> = SimdLevel::available().map(SimdLevel::name).collect();
    println!("SIMD levels: {}", names.join(" "));
    for level in SimdLevel::ALL.into_iter().filter(|level| !names.contains(&level.name())) {
        skip(&format!("SIMD level {}: not on this machine", level.name()));
    }
    assert!(names.contains(&SimdLevel::best().name()));
}

#[test]
#[ignore = "takes minutes: the gate runs it"]
fn simulated_frames_agree_over_the_whole_grid() {
    parity::simulated_frames_agree(&levels());
}

#[test]
#[ignore = "takes minutes: the gate runs it"]
fn real_frames_agree() {
    parity::real_frames_agree(&levels(), usize::MAX, "the CPU engine on real frames");
}

#[test]
fn nasty_clouds_keep_the_invariants() {
    parity::nasty_clouds_keep_the_invariants(&levels());
}

#[test]
fn ordinary_small_clouds_agree_too() {
    parity::ordinary_small_clouds_agree(&levels());
}
