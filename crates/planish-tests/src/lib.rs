//! What the tests and benchmarks share: scenes written once, named tolerances, and the way to the real frames.

pub mod bits;
pub mod data;
pub mod engines;
pub mod parity;
pub mod poses;
pub mod rigs;
pub mod scenes;
pub mod sources;
pub mod tolerances;
