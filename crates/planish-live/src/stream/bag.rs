//! A sink that writes results as a ROS 2 recording.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use planish_core::{DepthImage, Error, FrameError, Outputs, OwnedFrame};
use planish_ros2::bag::BagWriter;

use super::{Sink, StreamFrame};

/// A sink that writes results to a recording: depth if the stream's outputs include it, otherwise clouds.
pub struct BagSink {
    writer: Option<BagWriter>,
    name: String,
    outputs: Outputs,
    /// Flag that discards the recording at the end.
    discard: Option<Arc<AtomicBool>>,
}

impl BagSink {
    /// Creates the recording. `outputs` are the stream's: depth, or points with the fields to add to them.
    pub fn create(path: &Path, outputs: Outputs) -> Result<Self, Error> {
        Ok(Self { writer: Some(BagWriter::create(path)?), name: path.display().to_string(), outputs, discard: None })
    }

    /// Sets a flag. If the flag is true at the end, the recording is discarded, so that no partial recording remains.
    pub fn discarding_if(self, discard: Arc<AtomicBool>) -> Self {
        Self { discard: Some(discard), writer: self.writer.map(BagWriter::all_or_nothing), ..self }
    }
}

impl Sink for BagSink {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn write(&mut self, frame: &StreamFrame) -> Result<(), Error> {
        let Some(writer) = &mut self.writer else { return Ok(()) };
        let timestamp_s = frame.source.timestamp_s();
        if let Some(raw) = &frame.smoothed.depth {
            let camera = match &frame.source {
                OwnedFrame::Depth(depth) => Some(depth.camera),
                OwnedFrame::Cloud { cloud, .. } => cloud.camera,
            };
            let camera = camera.ok_or(FrameError::MissingCamera { what: "the output depth" })?;
            let (width, height) = (frame.smoothed.width, frame.smoothed.height);
            if let OwnedFrame::Depth(planish_core::DepthFrame { rgb: Some(rgb), .. }) = &frame.source {
                writer.add_colour((width, height), rgb, timestamp_s)?;
            }
            if let Some(mask) = frame.smoothed.origin_mask() {
                writer.add_origin((width, height), mask, timestamp_s)?;
            }
            return writer.add_depth(&DepthImage { width, height, raw: raw.clone() }, &camera, timestamp_s);
        }
        let mut cloud = match &frame.source {
            OwnedFrame::Depth(depth) => depth.deproject()?,
            OwnedFrame::Cloud { cloud, .. } => cloud.clone(),
        };
        cloud.points.apply(&frame.smoothed, self.outputs)?;
        writer.add_cloud(&cloud.points, Some((cloud.width(), cloud.height())), timestamp_s)
    }

    fn close(&mut self) -> Result<(), Error> {
        let is_unwanted = self.discard.as_ref().is_some_and(|discard| discard.load(Ordering::Relaxed));
        self.writer.take().filter(|_| !is_unwanted).map_or(Ok(()), BagWriter::finish)
    }
}
