//! Statistics of a rig's stream.

use crate::stream::StreamStatistics;

/// Frame counts of a camera.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct CameraStatistics {
    /// Name of the camera.
    pub name: String,
    /// Frames received.
    pub frames_in: u64,
    /// Frames smoothed.
    pub frames_out: u64,
    /// Moments without a frame of this camera.
    pub missing: u64,
    /// Frames that arrived after their moment was taken.
    pub late: u64,
    /// Frames with the timestamp of the previous frame, or an earlier one.
    pub out_of_order: u64,
    /// Number of jumps of the camera's clock.
    pub jumps: u64,
    /// Frames of a live camera that newer ones replaced after the engine was opened.
    pub dropped: u64,
    /// Frames that could not be read, or that the engine refused.
    pub unreadable: u64,
    /// Whether the camera's source ended before the stream did.
    pub has_ended: bool,
}

/// Counts and timings of a rig's stream.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct RigStatistics {
    /// Statistics of the moments: number, latency, sinks, engine. A moment replaced by a newer one counts as dropped.
    pub moments: StreamStatistics,
    /// Moments with a frame of every camera.
    pub complete: u64,
    /// Statistics of each camera.
    pub cameras: Vec<CameraStatistics>,
}
