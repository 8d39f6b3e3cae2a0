//! Tests with software cameras, which spend most of their time waiting for frames. Keep other tests out of this binary,
//! because librealsense's threads run until the process ends.

mod openni2;
mod realsense;
