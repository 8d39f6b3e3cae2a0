//! The engines: results of each, and agreement between them.

mod analytic;
mod camera_motion;
mod clean;
mod cpu_parity;
mod edges;
mod fill;
mod general;
mod general_on_gpu;
mod gpu_engine;
mod gpu_parity;
mod poses;
mod reference;
mod sigma;
mod temporal;
mod temporal_gpu;
mod temporal_outputs;
