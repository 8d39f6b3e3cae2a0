//! Devices: cameras in software, of which the tests mostly wait, and GPUs that are lost. No other test that takes a GPU is here: those
//! destroy every device of the process.

mod lost_gpu;
mod openni2;
mod realsense;
