//! All depth of a recording, of which some has colour.
//!
//! The library puts depth and colour together from the first image to the last; depth before and after those does not
//! come with them. A second player, of depth alone, has it.

use crate::source::{OwnedFrame, Source};
use planish_core::{DepthFrame, Error};

/// The second player, and the pending frame of the first.
pub(super) struct AllDepth {
    pub(super) player: Box<dyn Source>,
    coloured: Option<DepthFrame>,
    is_colour_over: bool,
}

impl AllDepth {
    /// Takes a player of the same recording that gives depth alone.
    pub(super) fn new(player: Box<dyn Source>) -> Self {
        Self { player, coloured: None, is_colour_over: false }
    }

    /// Returns the next frame of depth, with colour where `next_coloured` has it.
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
