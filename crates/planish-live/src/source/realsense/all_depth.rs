//! All depth frames of a recording, with colour if available.
//!
//! The library pairs depth and colour from the first colour image to the last, and skips depth frames before and
//! after. A second player, for depth alone, delivers all depth frames.

use crate::source::{OwnedFrame, Source};
use planish_core::{DepthFrame, Error};

/// The second player, and the pending coloured frame of the first player.
pub(super) struct AllDepth {
    pub(super) player: Box<dyn Source>,
    coloured: Option<DepthFrame>,
    is_colour_over: bool,
}

impl AllDepth {
    /// Creates the state from a second player of the same recording, which delivers depth alone.
    pub(super) fn new(player: Box<dyn Source>) -> Self {
        Self { player, coloured: None, is_colour_over: false }
    }

    /// Returns the next depth frame, with colour if `next_coloured` has a frame with the same timestamp.
    pub(super) fn next_frame(
        &mut self,
        mut next_coloured: impl FnMut() -> Result<Option<OwnedFrame>, Error>,
    ) -> Result<Option<OwnedFrame>, Error> {
        let Some(OwnedFrame::Depth(depth)) = self.player.next_frame()? else { return Ok(None) };
        let time = depth.timestamp_s;
        while !self.is_colour_over && self.coloured.as_ref().is_none_or(|frame| frame.timestamp_s < time) {
            // The end of colour is not an error, and the depth player detects errors in depth.
            self.coloured = match next_coloured() {
                Ok(Some(OwnedFrame::Depth(frame))) => Some(frame),
                _ => None,
            };
            self.is_colour_over = self.coloured.is_none();
        }
        let coloured = self.coloured.take_if(|frame| frame.timestamp_s == time);
        Ok(Some(OwnedFrame::Depth(coloured.unwrap_or(depth))))
    }
}
