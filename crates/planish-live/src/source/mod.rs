//! Frame sources: cameras, data sets, folders, files and the simulator.
//!
//! A [`Source`] delivers one frame after another. [`open`] resolves a source named on the command line. To add a
//! camera, implement [`Source`]; [`stream`](crate::stream) accepts any implementation.

#[cfg(feature = "mcap")]
mod bag;
mod driver;
mod files;
mod freenect;
mod kinect;
mod openni2;
mod paced;
mod prepared;
mod realsense;
mod reconnecting;
mod silence;
mod synthetic;
mod tum;

use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use planish_core::{Camera, Error, FormatError, IoError, ParamError};
use planish_io::ReadOptions;

pub use files::FileSource;
pub use freenect::FreenectRecording;
pub use planish_core::OwnedFrame;

/// Items for this project's own tests.
#[cfg(feature = "internal")]
pub(crate) mod internal {
    pub use super::freenect::{disparity_depth_m, write_freenect_recording};
    pub use super::realsense::start_realsense;
    pub use super::silence::set_longest_silence_s;
}
pub use kinect::KinectSource;
pub use openni2::OpenNi2Source;
pub use paced::Paced;
pub use prepared::PreparedSource;
pub use realsense::{RealSenseInput, RealSenseSource};
pub use reconnecting::Reconnecting;
pub use synthetic::SyntheticSource;
pub use tum::{TumRecorder, TumSource};

/// A source that delivers one frame after another.
pub trait Source: Send {
    /// Returns the next frame; `None` at the end. A live source waits until a frame arrives.
    ///
    /// An unreadable frame is an error, after which the caller may request the next frame.
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error>;

    /// Returns the name of the last frame, if it has one: its file's name without the extension.
    fn frame_name(&self) -> Option<String> {
        None
    }

    /// Returns a description of the camera, if available.
    fn description(&self) -> Option<String> {
        None
    }

    /// Receives, before the first frame, a flag that the stream sets when it ends. A source whose waits may be long
    /// must check this flag.
    fn end_with(&mut self, _ended: Arc<AtomicBool>) {}

    /// Returns the number of frames that a live source replaced by newer ones before they were taken.
    fn dropped(&self) -> u64 {
        0
    }

    /// Returns true if frames arrive at their own pace and are lost if not taken in time. A stream takes the newest
    /// frame of such a source, and every frame of any other.
    fn is_live(&self) -> bool {
        false
    }
}

/// Returns the warning for the `number`th unreadable frame of a source, counted from 1; `None` after the tenth.
///
/// Without this limit, a list of a million missing files would fill the terminal.
pub fn unreadable_warning(error: &Error, number: u64) -> Option<String> {
    const MOST_TOLD: u64 = 10;
    let only_counted = if number == MOST_TOLD { "; further unreadable frames are only counted" } else { "" };
    (number <= MOST_TOLD).then(|| format!("{error}{only_counted}"))
}

/// The camera image to which both depth and colour are mapped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Alignment {
    /// The depth image: depth is unchanged, and each pixel gets the colour of its 3D point.
    Depth,
    /// The colour image: depth is mapped onto its pixels, by the driver or by the camera.
    Colour,
    /// No mapping: depth is unchanged and has no colour.
    None,
}

impl Alignment {
    const ALL: [Self; 3] = [Self::Depth, Self::Colour, Self::None];

    /// Returns the name used in files and options.
    pub fn name(self) -> &'static str {
        match self {
            Self::Depth => "depth",
            Self::Colour => "color",
            Self::None => "none",
        }
    }
}

impl FromStr for Alignment {
    type Err = ParamError;

    /// Reads a [`name`](Self::name).
    fn from_str(text: &str) -> Result<Self, ParamError> {
        let allowed = "depth, color or none";
        let found = Self::ALL.into_iter().find(|alignment| alignment.name() == text);
        found.ok_or_else(|| ParamError { field: "align", value: text.to_owned(), allowed })
    }
}

/// Size and rate of a camera's depth images.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StreamMode {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Frames per second; `None` for any rate.
    pub fps: Option<u32>,
}

impl FromStr for StreamMode {
    type Err = ParamError;

    /// Reads `WIDTHxHEIGHT` or `WIDTHxHEIGHT@FPS`.
    fn from_str(text: &str) -> Result<Self, ParamError> {
        let (size, fps) = text.split_once('@').map_or((text, None), |(size, fps)| (size, Some(fps)));
        let sides = size.split_once(['x', 'X']).map(|(width, height)| (width.parse(), height.parse()));
        match (sides, fps.map(str::parse)) {
            (Some((Ok(width @ 1..), Ok(height @ 1..))), None) => Ok(Self { width, height, fps: None }),
            (Some((Ok(width @ 1..), Ok(height @ 1..))), Some(Ok(fps @ 1..))) => {
                Ok(Self { width, height, fps: Some(fps) })
            }
            _ => Err(ParamError {
                field: "mode",
                value: text.to_owned(),
                allowed: "WIDTHxHEIGHT or WIDTHxHEIGHT@FPS, such as 848x480@30",
            }),
        }
    }
}

impl fmt::Display for StreamMode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}", self.width, self.height)?;
        self.fps.map_or(Ok(()), |fps| write!(f, "@{fps}"))
    }
}

/// Options of a source that is opened by name.
#[derive(Debug, Clone, PartialEq, Default)]
#[non_exhaustive]
pub struct SourceOptions {
    /// The camera; depth images need one. A width and height of 0 accept frames of any shape; other values must match
    /// the frames.
    pub camera: Option<Camera>,
    /// Depth units per metre of a data set in TUM layout; `None` keeps the data set's, by default 5000.
    pub tum_units_per_metre: Option<f64>,
    /// Rate in frames per second at which a source that is not live is played as if it were live; `None` plays it as
    /// fast as possible.
    pub fps: Option<f64>,
    /// The topic of an MCAP recording; may be omitted if only one topic has depth.
    pub topic: Option<String>,
    /// The topic of an MCAP recording's camera, if it is not next to the images' topic.
    pub camera_info_topic: Option<String>,
    /// The image to which depth and colour of a RealSense or OpenNI2 camera are mapped; `None` uses the source's
    /// default.
    pub alignment: Option<Alignment>,
    /// The mode of a RealSense or OpenNI2 camera; `None` uses its default.
    pub mode: Option<StreamMode>,
    /// The number of frames that will be requested, if known. A source that prepares frames in advance prepares at
    /// most this many.
    pub frames: Option<u64>,
    /// Options for reading files and recordings. Frames that a stream could not smooth within the memory limit are
    /// refused.
    pub read: ReadOptions,
}

impl SourceOptions {
    /// Sets the camera.
    pub fn with_camera(self, camera: Option<Camera>) -> Self {
        Self { camera, ..self }
    }

    /// Sets the depth units per metre of data sets in TUM layout; `None` keeps the data set's.
    pub fn with_tum_units_per_metre(self, tum_units_per_metre: Option<f64>) -> Self {
        Self { tum_units_per_metre, ..self }
    }

    /// Sets the topics of an MCAP recording: depth and camera.
    pub fn with_topics(self, topic: Option<String>, camera_info_topic: Option<String>) -> Self {
        Self { topic, camera_info_topic, ..self }
    }

    /// Sets the image to which depth and colour are mapped.
    pub fn with_alignment(self, alignment: Option<Alignment>) -> Self {
        Self { alignment, ..self }
    }

    /// Sets the camera's mode.
    pub fn with_mode(self, mode: Option<StreamMode>) -> Self {
        Self { mode, ..self }
    }

    /// Sets the number of frames that will be requested; `None` if unknown.
    pub fn with_frames(self, frames: Option<u64>) -> Self {
        Self { frames, ..self }
    }

    /// Sets the options for reading files and recordings.
    pub fn with_read_options(self, read: ReadOptions) -> Self {
        Self { read, ..self }
    }

    /// Sets the playback rate in frames per second; `None` plays as fast as possible.
    pub fn with_fps(self, fps: Option<f64>) -> Self {
        Self { fps, ..self }
    }
}

/// Opens a source by name: `kinect[:INDEX]`, `realsense[:SERIAL]`, `realsense:RECORDING`, `openni2[:URI]`,
/// `synthetic[:SEED]`, a data set in TUM RGB-D layout, a libfreenect recording, a ROS 2 recording in MCAP (with the
/// feature `mcap`), a folder of frames, or a single file, which is repeated endlessly unless it has several images.
pub fn open(name: &str, options: &SourceOptions) -> Result<Box<dyn Source>, Error> {
    let (kind, rest) = name.split_once(':').unwrap_or((name, ""));
    let &SourceOptions { camera, alignment, mode, fps, frames, .. } = options;
    if matches!(kind, "kinect" | "synthetic" | "realsense" | "openni2") {
        refuse_topics(options)?;
        refuse_units(options)?;
    }
    if !matches!(kind, "realsense" | "openni2") {
        refuse_modes(options)?;
    }
    let source: Box<dyn Source> = match kind {
        "kinect" => Box::new(KinectSource::open(parse_number(name, rest, 0)?, camera)?),
        "realsense" => Box::new(RealSenseSource::open(&RealSenseInput::parse(rest), camera, alignment, mode)?),
        "openni2" => Box::new(OpenNi2Source::open(rest, camera, alignment, mode)?),
        "synthetic" if camera.is_some() => {
            let allowed = "the simulator has a fixed camera; omit camera";
            return Err(ParamError { field: "camera", value: "given".into(), allowed }.into());
        }
        "synthetic" => {
            let (seed, frames) = (parse_number(name, rest, 1)?, frames.unwrap_or(u64::MAX));
            Box::new(SyntheticSource::of_frames(seed, Camera::kinect_v1(), frames)?)
        }
        _ => open_path(Path::new(name), options)?,
    };
    match fps {
        None => Ok(source),
        Some(fps) if source.is_live() => {
            let allowed = "a camera sets its own rate; omit fps";
            Err(ParamError { field: "fps", value: fps.to_string(), allowed }.into())
        }
        Some(fps) => Ok(Box::new(Paced::new(source, fps)?)),
    }
}

/// Returns true if a source named on the command line is a camera, which may be unplugged and reconnected.
pub fn is_camera(name: &str) -> bool {
    let (kind, rest) = name.split_once(':').unwrap_or((name, ""));
    match kind {
        "kinect" => true,
        "realsense" => !matches!(RealSenseInput::parse(rest), RealSenseInput::Recording(_)),
        "openni2" => !OpenNi2Source::is_recording(rest),
        _ => false,
    }
}

fn open_path(path: &Path, options: &SourceOptions) -> Result<Box<dyn Source>, Error> {
    #[cfg(feature = "mcap")]
    {
        planish_ros2::bag::refuse_other_bags(path)?;
        let file = planish_ros2::bag::file_of(path)?;
        if planish_ros2::bag::is_bag(&file) {
            let (topic, camera_info) = (options.topic.as_deref(), options.camera_info_topic.as_deref());
            let (camera, read) = (options.camera, options.read);
            return Ok(Box::new(planish_ros2::bag::BagSource::open_with(&file, topic, camera_info, camera, read)?));
        }
        if file.is_file() && planish_ros2::bag::is_named_mcap(&file) {
            return Err(malformed(&file, "not an MCAP recording: its signature is missing").into());
        }
    }
    refuse_topics(options)?;
    if path.is_file() {
        return Ok(Box::new(FileSource::repeat(path, options.camera).with_read_options(options.read)));
    }
    if !path.is_dir() {
        let problem =
            "no such file or folder; expected kinect, realsense, openni2, synthetic, a data set, a folder or a file";
        return Err(malformed(path, problem).into());
    }
    if path.join("INDEX.txt").is_file() {
        return Ok(Box::new(FreenectRecording::open(path, options.camera)?));
    }
    if ["associations.txt", "associate.txt", "depth.txt"].iter().any(|file| path.join(file).is_file()) {
        let (camera, units) = (options.camera, options.tum_units_per_metre);
        return Ok(Box::new(TumSource::open_within(path, camera, units, options.read)?));
    }
    Ok(Box::new(FileSource::folder_within(path, options.camera, options.read)?))
}

/// Refuses topics for sources other than MCAP recordings.
fn refuse_topics(options: &SourceOptions) -> Result<(), ParamError> {
    match options.topic.as_ref().or(options.camera_info_topic.as_ref()) {
        None => Ok(()),
        Some(topic) => {
            let allowed = "topics apply only to MCAP recordings";
            Err(ParamError { field: "topic", value: topic.clone(), allowed })
        }
    }
}

/// Refuses depth units for sources that state their own.
fn refuse_units(options: &SourceOptions) -> Result<(), ParamError> {
    let allowed = "this source states its own units; omit depth_units_per_metre";
    options
        .tum_units_per_metre
        .map_or(Ok(()), |units| Err(ParamError { field: "depth_units_per_metre", value: units.to_string(), allowed }))
}

/// Refuses options that apply only to RealSense and OpenNI2 cameras.
fn refuse_modes(options: &SourceOptions) -> Result<(), ParamError> {
    let allowed = "available only for RealSense and OpenNI2 cameras";
    if let Some(alignment) = options.alignment {
        return Err(ParamError { field: "align", value: format!("{alignment:?}").to_lowercase(), allowed });
    }
    match options.mode {
        None => Ok(()),
        Some(mode) => Err(ParamError { field: "mode", value: mode.to_string(), allowed }),
    }
}

fn parse_number<T: std::str::FromStr>(name: &str, number: &str, default: T) -> Result<T, Error> {
    if number.is_empty() {
        return Ok(default);
    }
    number.parse().map_err(|_| malformed(Path::new(name), "expected a whole number after the colon").into())
}

/// Returns the camera, with this shape if it has none.
pub(crate) fn with_shape(camera: Camera, (width, height): (usize, usize)) -> Camera {
    if (camera.width, camera.height) == (0, 0) { camera.with_shape((width, height)) } else { camera }
}

/// Returns an error that names the malformed file or source.
fn malformed(path: &Path, problem: impl Into<String>) -> IoError {
    IoError { path: PathBuf::from(path), problem: FormatError::Malformed(problem.into()) }
}
