//! Cameras in software, for which the tests mostly wait. No other test is here: librealsense has threads to the end of the process.

mod openni2;
mod realsense;
