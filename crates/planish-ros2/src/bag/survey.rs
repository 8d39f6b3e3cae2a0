//! The topics of a recording, and the choice of topics to smooth.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use mcap::records::Record;

use super::records::{Next, Records, Summary, first_compression};
use super::refuse_other_bags;
use super::schemas::{CAMERA_INFO_TYPE, CLOUD_TYPE, COMPRESSED_TYPE, IMAGE_TYPE};
use super::wire::{Wire, is_known_type, kind_of};
use crate::ros::{CameraInfo, DepthMessage, camera_info_topic as beside, is_rectified};
use planish_core::{Camera, Error, FormatError, IoError};
use planish_io::internal::brief;
use planish_io::{ReadOptions, printable_line};

/// Message type of a topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[non_exhaustive]
pub enum MessageKind {
    /// `sensor_msgs/Image`, or Foxglove's `RawImage` or `CompressedImage`.
    Image,
    /// `sensor_msgs/CompressedImage`.
    CompressedImage,
    /// `sensor_msgs/PointCloud2`, or Foxglove's `PointCloud`.
    PointCloud2,
    /// `sensor_msgs/CameraInfo`, or Foxglove's `CameraCalibration`.
    CameraInfo,
}

impl MessageKind {
    /// Returns the name of the type in ROS.
    pub fn type_name(self) -> &'static str {
        match self {
            Self::Image => IMAGE_TYPE,
            Self::CompressedImage => COMPRESSED_TYPE,
            Self::PointCloud2 => CLOUD_TYPE,
            Self::CameraInfo => CAMERA_INFO_TYPE,
        }
    }
}

/// A topic with images, clouds or cameras.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Topic {
    /// Name of the topic.
    pub name: String,
    /// Type of the messages.
    pub kind: MessageKind,
    /// Name of the message type in the recording.
    pub type_name: String,
    pub(super) wire: Wire,
    /// Number of messages, if the recording states it.
    pub messages: Option<u64>,
    /// Description of the first message: the encoding of an image, the format of a compressed image, or the shape of a
    /// cloud or camera.
    pub encoding: String,
    /// Coordinate frame of the first message.
    pub frame_id: String,
    /// Whether the first message contains depth or points.
    pub is_depth: bool,
    /// The first message of a camera topic.
    pub(super) camera_info: Option<CameraInfo>,
}

/// A topic that planish copies unchanged.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct OtherTopic {
    /// Name of the topic.
    pub name: String,
    /// Type of the messages; empty if the recording does not state it.
    pub type_name: String,
    /// Number of messages, if the recording states it.
    pub messages: Option<u64>,
}

/// The topics of a recording.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Survey {
    /// Topics with images, clouds and cameras, sorted by name.
    pub topics: Vec<Topic>,
    /// All other topics, sorted by name, in the summary or in the part of the recording that was read.
    pub others: Vec<OtherTopic>,
    /// Number of messages in the recording, if the recording states it.
    pub messages: Option<u64>,
    /// Compression of the chunks: `zstd`, `lz4`, or an empty string for none; `None` if unknown.
    pub compression: Option<String>,
    /// Channel and schema IDs in the summary.
    pub(super) taken: BTreeSet<u16>,
}

/// A topic to smooth, with its camera.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Chosen {
    pub(super) topic: String,
    pub(super) kind: MessageKind,
    pub(super) wire: Wire,
    /// The camera topic and its latest message.
    pub(super) camera: Option<(String, CameraInfo)>,
}

impl Survey {
    /// Surveys a recording: reads its summary and the first message of each topic.
    ///
    /// # Errors
    /// If the file is not an MCAP recording, or is damaged before the first message with depth or points.
    pub fn of(path: &Path, options: &ReadOptions) -> Result<Self, IoError> {
        refuse_other_bags(path)?;
        survey(path, options).map_err(IoError::at(path))
    }

    /// Chooses the topics to smooth: the named topics, or, if none is named, the only topic with depth images, with
    /// compressed depth or with clouds, in this order of preference.
    ///
    /// Unless the caller provides a camera, each depth image needs one: on `camera_info_topic`, on the conventional
    /// topic next to the image, or the only camera in the same coordinate frame.
    pub(super) fn choose(
        &self,
        path: &Path,
        topics: &[String],
        camera_info_topic: Option<&str>,
        camera: Option<&Camera>,
    ) -> Result<Vec<Chosen>, Error> {
        let refuse = |problem: String| -> Error {
            let problem = FormatError::Unsupported(printable_line(&problem).into_owned());
            IoError { path: path.to_path_buf(), problem }.into()
        };
        let chosen: Vec<&Topic> = if topics.is_empty() {
            vec![self.only_topic().map_err(refuse)?]
        } else {
            let named = |name: &String| {
                let topic =
                    self.topics.iter().find(|topic| topic.name == *name && topic.kind != MessageKind::CameraInfo);
                topic.ok_or_else(|| refuse(format!("the recording has no images or clouds on {name}; {}", self.told())))
            };
            let mut known = BTreeSet::new();
            topics.iter().filter(|topic| known.insert(topic.as_str())).map(named).collect::<Result<_, _>>()?
        };
        let with_camera = |topic: &Topic| {
            let of_topic = self.camera_of(topic, camera_info_topic).map_err(refuse)?;
            if of_topic.is_none() && camera.is_none() && topic.kind != MessageKind::PointCloud2 {
                return Err(refuse(format!(
                    "the recording has no camera for {}: no CameraInfo on {} or in the frame of its images; name a \
                     topic (camera_info_topic), or give the intrinsics (camera) as FX,FY,CX,CY",
                    topic.name,
                    beside(&topic.name)
                )));
            }
            Ok(Chosen { topic: topic.name.clone(), kind: topic.kind, wire: topic.wire, camera: of_topic })
        };
        chosen.into_iter().map(with_camera).collect()
    }

    /// Returns the only topic with depth. Images come before compressed images, which may be the same images, and
    /// both come before clouds, which may be computed from them.
    fn only_topic(&self) -> Result<&Topic, String> {
        let found = || self.topics.iter().filter(|topic| topic.is_depth);
        for kind in [MessageKind::Image, MessageKind::CompressedImage, MessageKind::PointCloud2] {
            let mut of_kind = found().filter(|topic| topic.kind == kind);
            match (of_kind.next(), of_kind.next()) {
                (None, _) => {}
                (Some(only), None) => return Ok(only),
                (Some(_), Some(_)) => {
                    let names: Vec<_> = found().map(|topic| topic.name.as_str()).collect();
                    return Err(format!(
                        "the recording has depth on several topics; choose one (topic): {}",
                        names.join(", ")
                    ));
                }
            }
        }
        let is_damaged = self.topics.iter().any(|topic| topic.encoding == DAMAGED);
        let hint = if is_damaged { "; name a topic to read beyond its first message" } else { "" };
        Err(format!("the recording has no depth images and no clouds; {}{hint}", self.told()))
    }

    /// Returns the coordinate frame of the first of the named topics, or of the topic that is chosen if none is named.
    pub(super) fn frame_of(&self, path: &Path, topics: &[String]) -> Result<String, IoError> {
        let topic = match topics.first() {
            Some(name) => self
                .topics
                .iter()
                .find(|topic| topic.name == *name)
                .ok_or_else(|| format!("the recording has no images or clouds on {name}; {}", self.told())),
            None => self.only_topic(),
        };
        topic.map(|topic| topic.frame_id.clone()).map_err(|problem| {
            let problem = FormatError::Unsupported(printable_line(&problem).into_owned());
            IoError { path: path.to_path_buf(), problem }
        })
    }

    /// Returns the topics with depth that were not chosen and are copied unchanged.
    pub(super) fn left(&self, chosen: &[Chosen]) -> Vec<String> {
        let is_chosen = |topic: &&Topic| chosen.iter().any(|chosen| chosen.is(&topic.name, topic.kind, topic.wire));
        self.topics.iter().filter(|topic| topic.is_depth && !is_chosen(topic)).map(|topic| topic.name.clone()).collect()
    }

    fn told(&self) -> String {
        const MOST: usize = 12;
        let described: Vec<_> =
            self.topics.iter().take(MOST).map(|topic| format!("{} ({})", topic.name, topic.encoding)).collect();
        match &described[..] {
            [] => "expected images or clouds as ROS 2 (CDR) or Foxglove (Protocol Buffers, JSON or CDR) messages"
                .to_owned(),
            all => format!("available are {}", all.join(", ")),
        }
    }

    fn camera_of(&self, topic: &Topic, named: Option<&str>) -> Result<Option<(String, CameraInfo)>, String> {
        let cameras = || self.topics.iter().filter_map(|topic| Some((topic, topic.camera_info.as_ref()?)));
        let of = |(topic, info): (&Topic, &CameraInfo)| (topic.name.clone(), info.clone());
        if let Some(named) = named {
            let found = cameras().find(|(topic, _)| topic.name == named).map(of);
            return found
                .map(Some)
                .ok_or_else(|| format!("the recording has no CameraInfo on {named}; {}", self.told()));
        }
        let beside = beside(&topic.name);
        if let Some(found) = cameras().find(|(topic, _)| topic.name == beside) {
            return Ok(Some(of(found)));
        }
        let mut same_frame = cameras().filter(|(_, info)| info.header.frame_id == topic.frame_id);
        Ok(match (same_frame.next(), same_frame.next()) {
            (Some(only), None) => Some(of(only)),
            _ => None,
        })
    }
}

impl Chosen {
    /// Updates the camera from a message on the camera topic; ignores other topics and damaged messages.
    pub(super) fn note_camera(&mut self, channel: &Channel, data: &[u8]) {
        if let (MessageKind::CameraInfo, Some((camera_topic, info))) = (channel.kind, &mut self.camera)
            && *camera_topic == channel.topic
            && let Ok(newer) = channel.wire.camera(data)
        {
            *info = newer;
        }
    }

    /// Returns true if a channel has this topic and message type; a topic may have messages of several types.
    pub(super) fn is(&self, topic: &str, kind: MessageKind, wire: Wire) -> bool {
        self.topic == topic && self.kind == kind && self.wire == wire
    }

    /// Returns the camera for an image with this shape: the caller's camera if given, otherwise the recording's.
    pub(super) fn camera(&self, given: Option<&Camera>, shape: (usize, usize)) -> Result<Camera, FormatError> {
        match (given, &self.camera) {
            (Some(camera), _) if (camera.width, camera.height) == (0, 0) => Ok(camera.with_shape(shape)),
            (Some(camera), _) => Ok(*camera),
            (None, Some((_, info))) => info.camera(shape, is_rectified(&self.topic)),
            (None, None) => Err(FormatError::Unsupported("the camera of the image is unknown".into())),
        }
    }
}

/// A channel with images, clouds or cameras.
#[derive(Debug, Clone)]
pub(super) struct Channel {
    pub(super) topic: String,
    pub(super) kind: MessageKind,
    pub(super) wire: Wire,
    type_name: String,
}

/// The channels of a recording by ID.
#[derive(Default)]
pub(super) struct Channels {
    types: BTreeMap<u16, String>,
    known: BTreeMap<u16, Channel>,
    /// Topic and message type of all channels.
    all: BTreeMap<u16, (String, String)>,
}

impl Channels {
    /// Registers a schema or channel; ignores other records.
    pub(super) fn add(&mut self, record: &Record<'_>) {
        match record {
            Record::Schema { header, .. } => {
                self.types.insert(header.id, header.name.clone());
            }
            Record::Channel(channel) => {
                let type_name = self.types.get(&channel.schema_id).cloned().unwrap_or_default();
                let topic = channel.topic.clone();
                self.all.insert(channel.id, (topic.clone(), type_name.clone()));
                if let Some((kind, wire)) = kind_of(&type_name, &channel.message_encoding) {
                    self.known.insert(channel.id, Channel { topic, kind, wire, type_name });
                }
            }
            _ => {}
        }
    }

    /// Returns true if a schema or a channel has this ID.
    pub(super) fn has(&self, id: u16) -> bool {
        self.types.contains_key(&id) || self.all.contains_key(&id)
    }

    pub(super) fn get(&self, id: u16) -> Option<&Channel> {
        self.known.get(&id)
    }
}

fn survey(path: &Path, options: &ReadOptions) -> Result<Survey, FormatError> {
    let summary = Summary::of(path, options);
    let mut counts = BTreeMap::<String, u64>::new();
    // Topics whose first message is still to be found; `None` without a complete summary.
    let mut awaited = None;
    if let Some(Summary { channels, messages: Some((of_channels, _)), is_partial: false, .. }) = &summary {
        let mut topics = BTreeSet::new();
        for (id, (topic, kind)) in channels {
            let count = of_channels.get(id).copied().unwrap_or(0);
            *counts.entry(topic.clone()).or_default() += count;
            if count > 0 && is_known_type(kind) {
                topics.insert(topic.clone());
            }
        }
        awaited = Some(topics);
    }
    let mut records = Records::open(path, options).map_err(|error| error.problem)?;
    let (mut channels, mut topics) = (Channels::default(), BTreeMap::<String, Topic>::new());
    let mut is_cut_off = false;
    while awaited.as_ref().is_none_or(|awaited| !awaited.is_empty()) {
        let record = match records.next() {
            Ok(Next::Record(record)) => record,
            Ok(Next::DamagedChunk | Next::DamagedFile(_)) => continue,
            Ok(Next::End) => break,
            Ok(Next::CutOff) => {
                is_cut_off = true;
                break;
            }
            // The topics found before the damage can be used.
            Err(_) if topics.values().any(|topic| topic.is_depth) => break,
            Err(error) => return Err(error),
        };
        channels.add(&record);
        let Record::Message { header, data } = &record else { continue };
        let Some(channel) = channels.get(header.channel_id) else { continue };
        let name = &channel.topic;
        if !topics.contains_key(name) {
            let messages = counts.get(name).copied();
            topics.insert(name.clone(), Topic { messages, ..first_message(channel, data, options) });
            awaited.iter_mut().for_each(|awaited| {
                awaited.remove(name);
            });
        }
    }
    if is_cut_off && topics.is_empty() {
        return Err(FormatError::Malformed(
            "the recording ends before its first message with an image, a cloud or a camera".into(),
        ));
    }
    let Summary { channels: of_summary, schemas, messages, compression, .. } = summary.unwrap_or_default();
    let all = of_summary.values().chain(channels.all.values());
    let others: BTreeMap<_, _> = all.filter(|(name, _)| !topics.contains_key(name)).cloned().collect();
    let other = |(name, type_name)| OtherTopic { messages: counts.get(&name).copied(), name, type_name };
    Ok(Survey {
        topics: topics.into_values().collect(),
        others: others.into_iter().map(other).collect(),
        messages: messages.map(|(_, all)| all),
        compression: compression.or_else(|| first_compression(path)),
        taken: of_summary.into_keys().chain(schemas.into_keys()).collect(),
    })
}

/// Description of a topic whose first message cannot be read.
const DAMAGED: &str = "damaged";

/// Describes a topic by its first message; an unreadable message does not count as depth.
fn first_message(channel: &Channel, data: &[u8], options: &ReadOptions) -> Topic {
    let Channel { topic: name, kind, wire, type_name } = channel.clone();
    let mut topic = Topic {
        name,
        kind,
        type_name,
        wire,
        messages: None,
        encoding: DAMAGED.into(),
        frame_id: String::new(),
        is_depth: false,
        camera_info: None,
    };
    match (kind, wire) {
        (MessageKind::Image, Wire::FoxglovePng(encoding)) => {
            if let Ok(image) = encoding.codec().compressed_image(data) {
                topic.is_depth = image.is_depth();
                (topic.encoding, topic.frame_id) = (image.format, image.header.frame_id);
            }
        }
        (MessageKind::Image | MessageKind::CompressedImage, _) => match wire.depth(kind, data, options) {
            Ok(DepthMessage::Image(image)) => {
                topic.is_depth = image.is_depth();
                (topic.encoding, topic.frame_id) = (image.encoding, image.header.frame_id);
            }
            Ok(DepthMessage::Compressed(image)) => {
                topic.is_depth = image.format.contains("compressedDepth");
                (topic.encoding, topic.frame_id) = (image.format, image.header.frame_id);
            }
            Err(_) => {}
        },
        (MessageKind::PointCloud2, _) => {
            if let Ok(cloud) = wire.cloud(data) {
                topic.is_depth = true;
                topic.encoding = format!("cloud of {}x{}", cloud.width, cloud.height);
                topic.frame_id = cloud.header.frame_id;
            }
        }
        (MessageKind::CameraInfo, _) => {
            if let Ok(info) = wire.camera(data) {
                topic.encoding = format!("camera of {}x{}", info.width, info.height);
                topic.frame_id.clone_from(&info.header.frame_id);
                topic.camera_info = Some(info);
            }
        }
    }
    // An encoding may be a text of any length.
    topic.encoding = brief(&topic.encoding);
    topic
}
