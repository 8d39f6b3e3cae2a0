//! Copies a recording and smooths its depth.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufWriter, Seek, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use mcap::records::{Header as FileHeader, MessageHeader, Record};
use mcap::{Attachment, McapError, WriteOptions, Writer};

use super::of_mcap;
use super::poses::{CameraPoses, Poses};
use super::records::{Next, Records};
use super::schemas::{CLOUD, CLOUD_TYPE, IMAGE, IMAGE_TYPE, MESSAGE_ENCODING, SCHEMA_ENCODING};
use super::survey::{Channel, Channels, Chosen, MessageKind, Survey};
use super::writer::channel_metadata;
use crate::ros::{Header, MessageError, MessageSmoother, PointCloud2, Time, to_cdr};
use planish_core::{Camera, EngineError, Error, FormatError, IoError, ParamError, SensorPose, Settings};
use planish_io::{ReadOptions, Trajectory, internal::AtomicFile};

/// Options for smoothing a recording.
#[derive(Debug, Clone, PartialEq, Default)]
#[non_exhaustive]
pub struct SmoothBagOptions {
    /// The topics to smooth; if empty, the only topic with depth.
    pub topics: Vec<String>,
    /// The camera topic for all images; it replaces the camera topics in their namespaces.
    pub camera_info_topic: Option<String>,
    /// A camera that replaces the recording's. A width and height of 0 accept images of any shape.
    pub camera: Option<Camera>,
    /// The topic of clouds to add, one for each depth image; `None` adds no clouds.
    pub points_topic: Option<String>,
    /// The poses of the moving cameras, for smoothing over time.
    pub poses: Option<CameraPoses>,
    /// The memory limit for a message or chunk.
    pub read: ReadOptions,
}

impl SmoothBagOptions {
    /// Sets the topics to smooth.
    pub fn with_topics(self, topics: Vec<String>) -> Self {
        Self { topics, ..self }
    }

    /// Sets the camera topic for all images.
    pub fn with_camera_info_topic(self, camera_info_topic: Option<String>) -> Self {
        Self { camera_info_topic, ..self }
    }

    /// Sets a camera that replaces the recording's.
    pub fn with_camera(self, camera: Option<Camera>) -> Self {
        Self { camera, ..self }
    }

    /// Sets the topic of the clouds to add for depth images; `None` adds no clouds.
    pub fn with_points_topic(self, points_topic: Option<String>) -> Self {
        Self { points_topic, ..self }
    }

    /// Sets the poses of the moving cameras; `None` if the cameras stand still or are tracked.
    pub fn with_poses(self, poses: Option<CameraPoses>) -> Self {
        Self { poses, ..self }
    }

    /// Sets the memory limit for a message or chunk.
    pub fn with_read_options(self, read: ReadOptions) -> Self {
        Self { read, ..self }
    }
}

/// Report on a topic's messages.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct TopicReport {
    /// Name of the topic.
    pub topic: String,
    /// Type of the messages.
    pub kind: MessageKind,
    /// Number of messages smoothed.
    pub smoothed: u64,
    /// Number of messages copied unchanged because they could not be smoothed.
    pub failed: u64,
    /// Reason why the first of the failed messages could not be smoothed.
    pub first_failure: Option<String>,
}

/// Report on a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct SmoothBagReport {
    /// The smoothed topics.
    pub topics: Vec<TopicReport>,
    /// Warning about the first message that lost many of its points.
    pub warning: Option<String>,
    /// Number of messages without a pose, if poses were given.
    pub without_pose: u64,
    /// Number of messages of other topics, copied bit for bit.
    pub copied: u64,
    /// Number of chunks with a wrong checksum. Their messages, smoothed or copied like all others, may be damaged.
    pub damaged_chunks: u64,
    /// Reason why reading ended early; everything before that point was written. `None` for a complete recording.
    pub cut_off: Option<String>,
    /// Other topics with depth or points, copied unchanged; empty if the topics to smooth were named.
    pub not_chosen: Vec<String>,
}

/// Smooths the depth images and clouds of a recording. Everything else is copied bit for bit: other topics, stamps, log
/// times, sequence numbers, channels with their IDs and metadata, attachments and private records. Chunks keep the
/// compression of the input.
///
/// A message that cannot be smoothed is copied and counted. A truncated recording is smoothed up to its end. After
/// each message of the chosen topics, `tell` is called with the number of these messages so far and, if known, their
/// total. The output is either complete or absent.
///
/// # Errors
/// If the recording lacks the topics or their cameras, is in another format, or is damaged at the beginning; if
/// `points_topic` is invalid or already exists; if the engine fails; if the output cannot be written;
/// [`EngineError::Stopped`] if `stop` was set.
pub fn smooth_bag(
    input: &Path,
    output: &Path,
    smoother: &mut MessageSmoother,
    options: &SmoothBagOptions,
    stop: &AtomicBool,
    tell: &mut dyn FnMut(u64, Option<u64>),
) -> Result<SmoothBagReport, Error> {
    let survey = Survey::of(input, &options.read)?;
    let camera_topic = options.camera_info_topic.as_deref();
    let chosen = survey.choose(input, &options.topics, camera_topic, options.camera.as_ref())?;
    if let Some(name) = options.points_topic.as_ref().filter(|name| !is_topic(name)) {
        let allowed = "a name of letters, digits, _ and / that begins with a slash";
        return Err(ParamError { field: "points_topic", value: format!("{name:?}"), allowed }.into());
    }
    let names = || survey.topics.iter().map(|topic| &topic.name).chain(survey.others.iter().map(|topic| &topic.name));
    if let Some(taken) = options.points_topic.as_ref().filter(|topic| names().any(|name| name == *topic)) {
        let problem = FormatError::Unsupported(format!(
            "the recording already has a topic {taken}; choose another name for the clouds"
        ));
        return Err(IoError { path: input.to_path_buf(), problem }.into());
    }
    if smoother.flags_origins() {
        let of_depth = chosen.iter().filter(|chosen| chosen.kind != MessageKind::PointCloud2);
        if let Some(taken) = of_depth.map(Chosen::origin_topic).find(|topic| names().any(|name| name == topic)) {
            let text = format!(
                "the recording already has a topic {taken}, which shows filled pixels; smooth the original recording"
            );
            return Err(IoError { path: input.to_path_buf(), problem: FormatError::Unsupported(text) }.into());
        }
    }
    let poses = options.poses.as_ref().map(|poses| PosesOf::read(poses, &survey, input, &chosen, smoother, options));
    let poses = poses.transpose()?;
    let counts = survey.topics.iter().filter(|topic| chosen.iter().any(|chosen| chosen.topic == topic.name));
    let total = counts.map(|topic| topic.messages).sum::<Option<u64>>();
    let at_output = |problem: FormatError| -> Error { IoError { path: output.to_path_buf(), problem }.into() };
    let whole = AtomicFile::new(output).map_err(at_output)?;
    let mut records = Records::open(input, &options.read)?;
    let taken = survey.taken.clone();
    let not_chosen = if options.topics.is_empty() { survey.left(&chosen) } else { Vec::new() };
    let mut copy = Copy {
        chosen,
        options,
        smoother,
        channels: Channels::default(),
        reports: BTreeMap::new(),
        added: BTreeMap::new(),
        taken,
        poses,
        without_pose: 0,
        copied: 0,
        done: 0,
    };
    let mut writer = None;
    let (mut cut_off, mut damaged_chunks) = (None, 0);
    loop {
        if stop.load(Ordering::Relaxed) {
            return Err(EngineError::Stopped.into());
        }
        match records.next() {
            Ok(Next::Record(Record::Header(header))) if writer.is_none() => {
                writer = Some(open_writer(&whole, &header, survey.compression.as_deref()).map_err(at_output)?);
            }
            Ok(Next::Record(record)) => {
                let Some(writer) = &mut writer else {
                    let problem = FormatError::Malformed("not a recording: its header is missing".into());
                    return Err(IoError { path: input.to_path_buf(), problem }.into());
                };
                let before = copy.done;
                match copy.record(writer, record) {
                    Ok(()) => {}
                    Err(CopyError::Engine(error)) => return Err(error),
                    Err(CopyError::Write(McapError::Io(error))) => return Err(at_output(error.into())),
                    // Other write errors are due to the input: its channel or schema IDs contradict each other.
                    Err(CopyError::Write(error)) if copy.done + copy.copied > 0 => {
                        cut_off = Some(of_mcap(error).to_string());
                        break;
                    }
                    Err(CopyError::Write(error)) => {
                        return Err(IoError { path: input.to_path_buf(), problem: of_mcap(error) }.into());
                    }
                }
                if copy.done > before {
                    tell(copy.done, total);
                }
            }
            Ok(Next::DamagedChunk) => damaged_chunks += 1,
            Ok(Next::DamagedFile(problem)) => {
                cut_off.get_or_insert(problem);
            }
            Ok(Next::End) => break,
            Ok(Next::CutOff) if copy.done + copy.copied == 0 => {
                let problem = FormatError::Malformed("the recording ends before its first message".into());
                return Err(IoError { path: input.to_path_buf(), problem }.into());
            }
            Ok(Next::CutOff) => {
                cut_off = Some("the recording ends in the middle of a record".to_owned());
                break;
            }
            // Keep the messages that were read.
            Err(error) if copy.done + copy.copied > 0 => {
                cut_off = Some(error.to_string());
                break;
            }
            Err(problem) => return Err(IoError { path: input.to_path_buf(), problem }.into()),
        }
    }
    let Some(mut writer) = writer else {
        let problem = FormatError::Malformed("the recording ends before its header".into());
        return Err(IoError { path: input.to_path_buf(), problem }.into());
    };
    writer.finish().map_err(|error| at_output(of_mcap(error)))?;
    writer.into_inner().flush().map_err(|error| at_output(error.into()))?;
    let Copy { chosen, reports, copied, without_pose, smoother, .. } = copy;
    let warning = smoother.take_warning();
    whole.finish().map_err(at_output)?;
    let empty = |chosen: &Chosen| empty_report(chosen);
    let topics =
        chosen.iter().map(|chosen| reports.get(&chosen.topic).cloned().unwrap_or_else(|| empty(chosen))).collect();
    Ok(SmoothBagReport { topics, warning, without_pose, copied, damaged_chunks, cut_off, not_chosen })
}

/// Returns true if the name is a valid topic name.
fn is_topic(name: &str) -> bool {
    let is_word = |word: &str| !word.is_empty() && word.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
    name.strip_prefix('/').is_some_and(|rest| rest.split('/').all(is_word))
}

fn empty_report(chosen: &Chosen) -> TopicReport {
    TopicReport { topic: chosen.topic.clone(), kind: chosen.kind, smoothed: 0, failed: 0, first_failure: None }
}

/// Opens a writer with the input's compression, or with zstd if that is unknown. In builds without
/// `mcap-compression`, the output is uncompressed.
fn open_writer(
    whole: &AtomicFile,
    header: &FileHeader,
    compression: Option<&str>,
) -> Result<Writer<BufWriter<File>>, FormatError> {
    #[cfg(feature = "mcap-compression")]
    let compression = match compression {
        Some("") => None,
        Some("lz4") => Some(mcap::Compression::Lz4),
        _ => Some(mcap::Compression::Zstd),
    };
    #[cfg(not(feature = "mcap-compression"))]
    let compression = {
        let _ = compression;
        None
    };
    let options = WriteOptions::new().compression(compression).profile(header.profile.clone());
    options.create(BufWriter::new(whole.file().try_clone()?)).map_err(of_mcap)
}

/// Reason why a record could not be copied.
enum CopyError {
    Write(McapError),
    Engine(Error),
}

impl From<McapError> for CopyError {
    fn from(error: McapError) -> Self {
        Self::Write(error)
    }
}

impl Chosen {
    /// Returns the name of the topic for pixel origins.
    fn origin_topic(&self) -> String {
        format!("{}/origin", self.topic)
    }
}

/// The messages that replace one input message.
struct Rewritten {
    message: Vec<u8>,
    /// A cloud, if requested.
    points: Option<Vec<u8>>,
    /// The origins of a depth image's pixels, if the settings allow pixels that were not measured.
    origin: Option<Vec<u8>>,
}

/// The state of copying a recording.
struct Copy<'a> {
    chosen: Vec<Chosen>,
    options: &'a SmoothBagOptions,
    smoother: &'a mut MessageSmoother,
    channels: Channels,
    reports: BTreeMap<String, TopicReport>,
    /// Channels added to the output, by topic.
    added: BTreeMap<String, u16>,
    /// Channel and schema IDs in the input's summary.
    taken: BTreeSet<u16>,
    poses: Option<PosesOf<'a>>,
    without_pose: u64,
    copied: u64,
    done: u64,
}

/// The poses of the cameras.
enum PosesOf<'a> {
    Trajectory(&'a Trajectory),
    Topic(Poses),
}

impl<'a> PosesOf<'a> {
    /// Reads the poses, and checks that they apply to the cameras of the chosen topics.
    fn read(
        poses: &'a CameraPoses,
        survey: &Survey,
        input: &Path,
        chosen: &[Chosen],
        smoother: &MessageSmoother,
        options: &SmoothBagOptions,
    ) -> Result<Self, Error> {
        smoother.settings().map_or(Ok(()), Settings::check_poses)?;
        let at_input = |problem: FormatError| IoError { path: input.to_path_buf(), problem };
        match poses {
            CameraPoses::Trajectory(_) if chosen.len() > 1 => {
                let problem = "the poses of a file belong to one camera, but several topics were chosen";
                Err(at_input(FormatError::Unsupported(problem.into())).into())
            }
            CameraPoses::Trajectory(trajectory) => Ok(Self::Trajectory(trajectory)),
            CameraPoses::Topic(topic) => {
                let poses = Poses::read(input, topic, &options.read).map_err(at_input)?;
                for chosen in chosen {
                    let frame = survey.frame_of(input, std::slice::from_ref(&chosen.topic))?;
                    poses.check(&frame).map_err(at_input)?;
                }
                Ok(Self::Topic(poses))
            }
        }
    }

    /// Returns the pose of the camera of the message with this header and number.
    fn pose(&self, header: &Header, number: u64) -> Option<SensorPose> {
        match self {
            Self::Trajectory(trajectory) => trajectory.pose(number, Some(header.stamp.seconds()), None),
            Self::Topic(poses) => poses.pose(header),
        }
    }
}

impl Copy<'_> {
    fn record<W: Write + Seek>(&mut self, writer: &mut Writer<W>, record: Record<'_>) -> Result<(), CopyError> {
        self.channels.add(&record);
        match record {
            // Schema 0 means that a channel has no schema.
            Record::Schema { header, data } if header.id != 0 => {
                writer.add_schema_with_id(header.id, &header.name, &header.encoding, &data)?;
            }
            Record::Channel(channel) => {
                writer.add_channel_with_id(
                    channel.id,
                    channel.schema_id,
                    &channel.topic,
                    &channel.message_encoding,
                    &channel.metadata,
                )?;
            }
            Record::Message { header, data } => self.message(writer, header, &data)?,
            Record::Attachment { header, data, .. } => writer.attach(&Attachment {
                log_time: header.log_time,
                create_time: header.create_time,
                name: header.name,
                media_type: header.media_type,
                data,
            })?,
            Record::Metadata(metadata) => writer.write_metadata(&metadata)?,
            Record::Unknown { opcode, data } if opcode >= 0x80 => {
                writer.write_private_record(opcode, &data, Default::default())?;
            }
            // The writer creates new indices.
            _ => {}
        }
        Ok(())
    }

    fn message<W: Write + Seek>(
        &mut self,
        writer: &mut Writer<W>,
        header: MessageHeader,
        data: &[u8],
    ) -> Result<(), CopyError> {
        let Some(channel) = self.channels.get(header.channel_id).cloned() else {
            self.copied += 1;
            return Ok(writer.write_to_known_channel(&header, data)?);
        };
        self.chosen.iter_mut().for_each(|chosen| chosen.note_camera(&channel, data));
        let Channel { topic, kind, wire, .. } = channel;
        let Some(chosen) = self.chosen.iter().find(|chosen| chosen.is(&topic, kind, wire)).cloned() else {
            self.copied += 1;
            return Ok(writer.write_to_known_channel(&header, data)?);
        };
        self.done += 1;
        let result = self.smooth(&chosen, header.log_time, data);
        let report = self.reports.entry(topic).or_insert_with(|| empty_report(&chosen));
        match result {
            Ok(Rewritten { message, points, origin }) => {
                report.smoothed += 1;
                writer.write_to_known_channel(&header, &message)?;
                if let (Some(points), Some(topic)) = (points, &self.options.points_topic) {
                    let channel_id = self.added_channel(writer, topic, (CLOUD_TYPE, CLOUD))?;
                    writer.write_to_known_channel(&MessageHeader { channel_id, ..header }, &points)?;
                }
                if let Some(origin) = origin {
                    let channel_id = self.added_channel(writer, &chosen.origin_topic(), (IMAGE_TYPE, IMAGE))?;
                    writer.write_to_known_channel(&MessageHeader { channel_id, ..header }, &origin)?;
                }
                Ok(())
            }
            Err(MessageError::Engine(error)) => Err(CopyError::Engine(error)),
            Err(MessageError::Message(error)) => {
                report.failed += 1;
                report.first_failure.get_or_insert_with(|| error.to_string());
                Ok(writer.write_to_known_channel(&header, data)?)
            }
        }
    }

    /// Passes the pose of a message's camera to the smoother, if poses were given.
    fn set_pose(&mut self, header: &Header, log_time: u64) -> Result<(), MessageError> {
        let Some(poses) = &self.poses else { return Ok(()) };
        // Some programs never set the timestamp.
        let is_set = header.stamp != Time::default();
        let stamp = if is_set { header.stamp } else { Time::from_nanoseconds(log_time) };
        let pose = poses.pose(&Header { stamp, ..header.clone() }, self.done - 1);
        self.without_pose += u64::from(pose.is_none());
        Ok(self.smoother.set_camera_pose(pose)?)
    }

    /// Smooths a message.
    fn smooth(&mut self, chosen: &Chosen, log_time: u64, data: &[u8]) -> Result<Rewritten, MessageError> {
        self.smoother.set_topic(&chosen.topic)?;
        let Chosen { kind, wire, .. } = *chosen;
        if kind == MessageKind::PointCloud2 {
            let cloud = wire.cloud(data)?;
            self.set_pose(&cloud.header, log_time)?;
            let smoothed = self.smoother.smooth_cloud(cloud)?;
            let message = wire.with_cloud(data, &smoothed)?;
            return Ok(Rewritten { message, points: None, origin: None });
        }
        let message = wire.depth(kind, data, &self.options.read)?;
        self.set_pose(message.header(), log_time)?;
        let camera = |shape| chosen.camera(self.options.camera.as_ref(), shape);
        let wants_points = self.options.points_topic.is_some();
        let smoothed = self.smoother.smooth_depth(&message, camera, wants_points)?;
        let points = wants_points.then(|| PointCloud2::of_smoothed(message.header().clone(), self.smoother.smoothed()));
        let origin = self.smoother.origin_image(message.header().clone());
        let message = wire.with_depth(data, &message.with_pixels(&smoothed)?, &self.options.read)?;
        let points = points.as_ref().map(to_cdr).transpose()?;
        Ok(Rewritten { message, points, origin: origin.as_ref().map(to_cdr).transpose()? })
    }

    /// Returns the channel of a topic that the input lacks. Creates it on first use, with a channel ID and a schema
    /// ID that the input does not use.
    fn added_channel<W: Write + Seek>(
        &mut self,
        writer: &mut Writer<W>,
        topic: &str,
        (type_name, definition): (&str, &str),
    ) -> Result<u16, CopyError> {
        if let Some(channel) = self.added.get(topic) {
            return Ok(*channel);
        }
        let is_free = |number: &u16| {
            !self.taken.contains(number) && !self.channels.has(*number) && !self.added.values().any(|id| id == number)
        };
        let number = (1..=u16::MAX).rev().find(is_free).ok_or(McapError::TooManyChannels)?;
        let schema = writer.add_schema_with_id(number, type_name, SCHEMA_ENCODING, definition.as_bytes())?;
        let channel = writer.add_channel_with_id(number, schema, topic, MESSAGE_ENCODING, &channel_metadata())?;
        self.added.insert(topic.to_owned(), channel);
        Ok(channel)
    }
}
