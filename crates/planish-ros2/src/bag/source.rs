//! The frames of one topic of a recording.

use std::path::{Path, PathBuf};

use mcap::records::Record;

use super::records::{Next, Records};
use super::survey::{Channels, Chosen, MessageKind, Survey};
use crate::ros::{DepthPixels, Header};
use planish_core::{
    Camera, DepthFrame, DepthView, Error, FormatError, Frame, IntoFrame, IoError, OwnedFrame, PointCloud,
};
use planish_io::{ReadOptions, Work};

/// A source of the depth images or clouds of one topic, in order and with their timestamps.
pub struct BagSource {
    path: PathBuf,
    records: Records,
    channels: Channels,
    chosen: Chosen,
    camera: Option<Camera>,
    options: ReadOptions,
    /// Whether the rest of the recording cannot be read.
    is_over: bool,
}

impl BagSource {
    /// Opens a recording. `topic` is optional if only one topic has depth. `camera` replaces the recording's camera.
    ///
    /// # Errors
    /// If the file is not a recording, lacks the topic or its camera, or has several depth topics and none is named.
    pub fn open(
        path: &Path,
        topic: Option<&str>,
        camera_info_topic: Option<&str>,
        camera: Option<Camera>,
    ) -> Result<Self, Error> {
        Self::open_with(path, topic, camera_info_topic, camera, ReadOptions::default())
    }

    /// Same as [`open`](Self::open), with a memory limit. Refuses frames that a stream could not smooth within this
    /// limit.
    ///
    /// # Errors
    /// Same as [`open`](Self::open).
    pub fn open_with(
        path: &Path,
        topic: Option<&str>,
        camera_info_topic: Option<&str>,
        camera: Option<Camera>,
        options: ReadOptions,
    ) -> Result<Self, Error> {
        let topics: Vec<String> = topic.map(str::to_owned).into_iter().collect();
        let survey = Survey::of(path, &options)?;
        let chosen = survey.choose(path, &topics, camera_info_topic, camera.as_ref())?;
        let chosen = chosen.into_iter().next().ok_or_else(|| IoError {
            path: path.to_path_buf(),
            problem: FormatError::Unsupported("the recording has no topic to read".into()),
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

    /// Returns the next frame; `None` at the end. Further frames may follow an error.
    ///
    /// # Errors
    /// If the recording is damaged, or a message cannot be converted.
    pub fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        self.next_as(Self::frame)
    }

    /// Returns true if the first readable message is an unorganized cloud. Skips that message.
    pub fn has_clouds_without_grid(&mut self) -> bool {
        /// Number of messages to try, since some at the beginning may be damaged.
        const TRIED: usize = 16;
        if self.chosen.kind != MessageKind::PointCloud2 {
            return false;
        }
        let is_organized = |source: &Self, _, data: &[u8]| Ok(source.chosen.wire.cloud(data)?.is_organized());
        let mut first = std::iter::repeat_with(|| self.next_as(is_organized)).take(TRIED).filter_map(Result::ok);
        first.next().flatten() == Some(false)
    }

    /// Returns the next cloud, organized or not, with all its fields and its timestamp in seconds; `None` at the end,
    /// and for image topics.
    ///
    /// # Errors
    /// Same as [`next_frame`](Self::next_frame).
    pub fn next_cloud(&mut self) -> Result<Option<(PointCloud, f64)>, Error> {
        match self.chosen.kind {
            MessageKind::PointCloud2 => self.next_as(|source, log_time, data| {
                let message = source.chosen.wire.cloud(data)?.into_native()?;
                source.check_memory(Frame::Points(message.view()?), message.point_step as usize)?;
                Ok((message.to_cloud()?, seconds(&message.header, log_time)))
            }),
            _ => Ok(None),
        }
    }

    /// Reads the next message and passes its log time in nanoseconds and its data to `convert`.
    fn next_as<T>(
        &mut self,
        convert: impl Fn(&Self, u64, &[u8]) -> Result<T, FormatError>,
    ) -> Result<Option<T>, Error> {
        if self.is_over {
            return Ok(None);
        }
        let next = self
            .next_message()
            .and_then(|message| message.map(|(log_time, data)| convert(self, log_time, &data)).transpose());
        next.map_err(|problem| IoError { path: self.path.clone(), problem }.into())
    }

    fn next_message(&mut self) -> Result<Option<(u64, Vec<u8>)>, FormatError> {
        loop {
            let record = match self.records.next() {
                Ok(Next::Record(record)) => record,
                Ok(Next::DamagedChunk) => {
                    let problem = "damaged: the checksum of a chunk is wrong; frames already delivered from this chunk \
                                   may be damaged";
                    return Err(FormatError::Malformed(problem.into()));
                }
                Ok(Next::DamagedFile(problem)) => return Err(FormatError::Malformed(problem)),
                Ok(Next::End) => return Ok(None),
                // Reported once, since nothing more can be read.
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
            let Record::Message { header, data } = record else { continue };
            let Some(channel) = self.channels.get(header.channel_id) else { continue };
            self.chosen.note_camera(channel, &data);
            if self.chosen.is(&channel.topic, channel.kind, channel.wire) {
                return Ok(Some((header.log_time, data.into_owned())));
            }
        }
    }

    fn check_memory(&self, frame: Frame<'_>, field_bytes: usize) -> Result<(), FormatError> {
        self.options.check_work_on_frame(Work::Stream, frame, field_bytes)
    }

    fn frame(&self, log_time: u64, data: &[u8]) -> Result<OwnedFrame, FormatError> {
        let Chosen { kind, wire, .. } = self.chosen;
        if kind == MessageKind::PointCloud2 {
            let message = wire.cloud(data)?.into_native()?;
            let timestamp_s = Some(seconds(&message.header, log_time));
            self.check_memory(Frame::Points(message.view()?), message.point_step as usize)?;
            let mut cloud = message.to_organized()?;
            let shape = (cloud.width(), cloud.height());
            cloud.camera = self.chosen.camera(self.camera.as_ref(), shape).ok();
            return Ok(OwnedFrame::Cloud { cloud, timestamp_s });
        }
        let message = wire.depth(kind, data, &self.options)?;
        let pixels = message.pixels(&self.options)?;
        let (width, height) = pixels.shape();
        let camera = self.chosen.camera(self.camera.as_ref(), (width, height))?;
        let timestamp_s = seconds(message.header(), log_time);
        match pixels {
            DepthPixels::Millimetres(image) => {
                let frame = DepthFrame::from_image(camera, image)?.with_timestamp_s(timestamp_s);
                self.check_memory((&frame).into_frame()?, 0)?;
                Ok(OwnedFrame::Depth(frame))
            }
            DepthPixels::Metres { depth_m, .. } => {
                let view = DepthView::from_metres(&depth_m, &camera)?;
                self.check_memory(Frame::Depth(view), 0)?;
                let cloud = view.deproject()?;
                Ok(OwnedFrame::Cloud { cloud, timestamp_s: Some(timestamp_s) })
            }
        }
    }
}

/// Returns the timestamp of a message in seconds, or the log time if the timestamp was never set.
fn seconds(header: &Header, log_time: u64) -> f64 {
    match header.stamp.seconds() {
        0.0 => 1e-9 * log_time as f64,
        seconds => seconds,
    }
}
