//! The capture thread.

use std::time::Instant;

use super::mailbox::{Arrived, Mailbox};
use crate::source::Source;
use planish_core::Error;

/// Guard that ends a mailbox when it is dropped, even by a panic.
struct EndOf<'a>(&'a Mailbox);

impl Drop for EndOf<'_> {
    fn drop(&mut self) {
        self.0.end();
    }
}

/// Moves frames from the source into the mailbox until the source ends or the mailbox is closed.
pub(super) fn capture(mut source: Box<dyn Source>, mailbox: &Mailbox) {
    let _end = EndOf(mailbox);
    // A live source that fails repeatedly counts as gone; other sources end on their own.
    let mut failures = 0;
    // Frames that arrive while an engine is being opened, which takes many frame intervals, do not count as dropped.
    // A source may report such frames only with its next frame.
    let (mut is_ready, mut missed_before) = (false, Some(0));
    while !mailbox.is_closed() {
        if let Some(missed) = missed_before {
            mailbox.set_dropped_by_source(source.dropped().saturating_sub(missed));
        }
        match mailbox.capture_time.on(|| source.next_frame()) {
            Ok(Some(frame)) => {
                failures = 0;
                missed_before = missed_before.or_else(|| Some(source.dropped()));
                mailbox.put(Ok(Arrived { frame, name: source.frame_name(), since: Instant::now() }));
                if source.is_live() && !is_ready {
                    mailbox.wait_ready();
                    missed_before = None;
                    is_ready = true;
                }
            }
            Ok(None) => break,
            Err(error) => {
                failures += 1;
                let is_over = matches!(error, Error::Device(_)) || (source.is_live() && failures >= 100);
                mailbox.put(Err((error, is_over)));
                if is_over {
                    break;
                }
            }
        }
    }
}
