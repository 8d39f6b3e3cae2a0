//! All depth of a recording, of which some has colour.
//!
//! The library puts depth and colour together from the first image to the last; depth before and after those does not come with
//! them. A second player, of depth alone, has it.

use super::{RealSenseInput, RealSenseSource};
use crate::camera::Camera;
use crate::error::Error;
use crate::frame::DepthFrame;
use crate::source::{Alignment, Source, SourceFrame};

/// The second player, and what the first has ready.
pub(super) struct AllDepth {
    pub(super) player: Box<RealSenseSource>,
    coloured: Option<DepthFrame>,
    is_colour_over: bool,
}

impl AllDepth {
    pub(super) fn open(input: &RealSenseInput, camera: Option<Camera>) -> Result<Self, Error> {
        let player = RealSenseSource::open(input, camera, Some(Alignment::None), None)?;
        Ok(Self { player: Box::new(player), coloured: None, is_colour_over: false })
    }

    /// Returns the next frame of depth, with colour where `next_coloured` has it.
    pub(super) fn next_frame(
        &mut self,
        mut next_coloured: impl FnMut() -> Result<Option<SourceFrame>, Error>,
    ) -> Result<Option<SourceFrame>, Error> {
        let Some(SourceFrame::Depth(depth)) = self.player.next_frame()? else { return Ok(None) };
        let time = depth.timestamp_s;
        while !self.is_colour_over && self.coloured.as_ref().is_none_or(|frame| frame.timestamp_s < time) {
            // Where colour ends is no error, and what is wrong with depth its own player finds.
            self.coloured = match next_coloured() {
                Ok(Some(SourceFrame::Depth(frame))) => Some(frame),
                _ => None,
            };
            self.is_colour_over = self.coloured.is_none();
        }
        let coloured = self.coloured.take_if(|frame| frame.timestamp_s == time);
        Ok(Some(SourceFrame::Depth(coloured.unwrap_or(depth))))
    }
}
