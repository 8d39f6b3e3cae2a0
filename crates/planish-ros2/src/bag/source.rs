//! The frames of one topic of a recording.

use std::path::{Path, PathBuf};

use mcap::records::Record;

use super::records::{Next, Records};
use super::survey::{Channels, Chosen, MessageKind, Survey};
use crate::ros::{DepthMessage, DepthPixels, Header, PointCloud2, from_cdr};
use planish_core::{Camera, DepthFrame, DepthView, Error, FormatError, IoError, OwnedFrame};
use planish_io::ReadOptions;

/// Reads the depth images or clouds of a topic in order, with their time stamps.
pub struct BagSource {
    path: PathBuf,
    records: Records,
    channels: Channels,
    chosen: Chosen,
    camera: Option<Camera>,
    options: ReadOptions,
    /// Whether the rest cannot be read.
    is_over: bool,
}

impl BagSource {
    /// Opens a recording. `topic` may be left out where only one has depth; `camera` is taken instead of the
    /// recording's.
    ///
    /// # Errors
    /// If the file is not a recording, or lacks such a topic or its camera, or has several.
    pub fn open(
        path: &Path,
        topic: Option<&str>,
        camera_info_topic: Option<&str>,
        camera: Option<Camera>,
    ) -> Result<Self, Error> {
        let options = ReadOptions::default();
        let topics: Vec<String> = topic.map(str::to_owned).into_iter().collect();
        let survey = Survey::of(path, &options)?;
        let chosen = survey.choose(path, &topics, camera_info_topic, camera.as_ref())?;
        let chosen = chosen.into_iter().next().ok_or_else(|| IoError {
            path: path.to_path_buf(),
            problem: FormatError::Unsupported("has no topic to read".into()),
        })?;
        let records = Records::open(path, &options)?;
        Ok(Self {
            path: path.to_path_buf(),
            records,
            channels: Channels::default(),
            chosen,
            camera,
            options,
            is_over: false,
        })
    }

    /// Returns the next frame; `None` at the end. After an error the caller may ask for the next frame.
    ///
    /// # Errors
    /// If the recording is damaged, or a message cannot be converted.
    pub fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        if self.is_over {
            return Ok(None);
        }
        let frame = self.next();
        frame.map_err(|problem| IoError { path: self.path.clone(), problem }.into())
    }

    fn next(&mut self) -> Result<Option<OwnedFrame>, FormatError> {
        loop {
            let record = match self.records.next() {
                Ok(Next::Record(record)) => record,
                Ok(Next::DamagedChunk) => {
                    let problem =
                        "damaged: the checksum of a chunk is wrong; its frames, already delivered, may be damaged";
                    return Err(FormatError::Malformed(problem.into()));
                }
                Ok(Next::End) => return Ok(None),
                // Told once: there is nothing more to read.
                Ok(Next::CutOff) => {
                    self.is_over = true;
                    let problem = "truncated within a record; all earlier frames were read";
                    return Err(FormatError::Malformed(problem.into()));
                }
                Err(error) => {
                    self.is_over = true;
                    return Err(error);
                }
            };
            self.channels.add(&record);
            let Record::Message { header, data } = &record else { continue };
            let Some((topic, kind)) = self.channels.get(header.channel_id) else { continue };
            self.chosen.note_camera(topic, *kind, data);
            if self.chosen.is(topic, *kind) {
                return self.frame(header.log_time, data).map(Some);
            }
        }
    }

    fn frame(&self, log_time: u64, data: &[u8]) -> Result<OwnedFrame, FormatError> {
        let seconds = |header: &Header| match header.stamp.seconds() {
            // A stamp that was never set.
            0.0 => 1e-9 * log_time as f64,
            seconds => seconds,
        };
        let message = match self.chosen.kind {
            MessageKind::PointCloud2 => {
                let message: PointCloud2 = from_cdr::<PointCloud2>(data)?.into_native()?;
                let timestamp_s = Some(seconds(&message.header));
                let mut cloud = message.to_organized()?;
                let shape = (cloud.width(), cloud.height());
                cloud.camera = self.chosen.camera(self.camera.as_ref(), shape).ok();
                return Ok(OwnedFrame::Cloud { cloud, timestamp_s });
            }
            MessageKind::CompressedImage => DepthMessage::Compressed(from_cdr(data)?),
            _ => DepthMessage::Image(from_cdr(data)?),
        };
        let pixels = message.pixels(&self.options)?;
        let camera = self.chosen.camera(self.camera.as_ref(), pixels.shape())?;
        let timestamp_s = seconds(message.header());
        match pixels {
            DepthPixels::Millimetres(image) => {
                Ok(OwnedFrame::Depth(DepthFrame::from_image(camera, image)?.with_timestamp_s(timestamp_s)))
            }
            DepthPixels::Metres { depth_m, .. } => {
                let cloud = DepthView::from_metres(&depth_m, &camera)?.deproject()?;
                Ok(OwnedFrame::Cloud { cloud, timestamp_s: Some(timestamp_s) })
            }
        }
    }
}
