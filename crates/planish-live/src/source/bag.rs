//! ROS 2 recordings as a source of frames.

use planish_core::{Error, OwnedFrame};
use planish_ros2::bag::BagSource;

use super::Source;

impl Source for BagSource {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        BagSource::next_frame(self)
    }
}
