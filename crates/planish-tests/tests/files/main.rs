//! Files of every format, hostile ones among them, and clouds larger than memory.

mod attacked;
mod bag_poses;
mod bags;
mod formats;
mod fuzzed;
mod hostile;
mod las;
mod lost_grid;
mod odd_values;
mod ply;
mod reported;
mod scanners;
mod tiles;
