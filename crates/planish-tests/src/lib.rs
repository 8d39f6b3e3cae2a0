//! Items shared by tests and benchmarks: scenes, named tolerances, and the location of the real frames.

pub mod bits;
pub mod data;
pub mod engines;
pub mod parity;
pub mod poses;
pub mod rigs;
pub mod scenes;
pub mod sources;
pub mod tolerances;
