//! Cameras in software, for which these tests mostly wait. No others should be here: librealsense has threads until the
//! process ends.

mod openni2;
mod realsense;
