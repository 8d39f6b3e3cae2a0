//! Items shared by tests and benchmarks: engines, scenes, real frames, invariants and comparisons.

pub mod bits;
pub mod data;
pub mod engines;
pub mod parity;
pub mod poses;
pub mod rigs;
pub mod scenes;
pub mod sources;
pub mod tolerances;
