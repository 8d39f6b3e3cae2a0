//! Streams of frames, fleets of devices, and rigs of several cameras.

mod fleet;
mod over_time;
mod rig;
mod rig_endurance;
mod rig_stop;
mod rig_stream;
mod rig_video;
mod rig_viewpoints;
mod rig_voxels;
mod stream;
