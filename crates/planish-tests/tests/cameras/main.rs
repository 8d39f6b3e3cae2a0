//! Tests with software cameras, which mostly wait for their frames. Other tests do not belong here, because the
//! threads of librealsense run until the process ends.

mod openni2;
mod realsense;
