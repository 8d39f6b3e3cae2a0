//! Where frames come from: a camera, a data set, a folder, a file, the simulator.
//!
//! A [`Source`] delivers one frame after another. [`open`] resolves a source named on the command line. To use a camera of your
//! own, implement [`Source`]; [`stream`](crate::stream) takes any.

mod files;
mod freenect;
mod kinect;
mod paced;
mod synthetic;
mod tum;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use crate::camera::Camera;
use crate::cloud::OrganizedCloud;
use crate::error::{Error, FormatError, FrameError, IoError, ParamError};
use crate::frame::{DepthFrame, Frame, IntoFrame};

pub use files::FileSource;
pub use freenect::FreenectRecording;

/// For this project's own tests.
#[cfg(feature = "internal")]
pub(crate) mod internal {
    pub use super::freenect::{disparity_depth_m, write_freenect_recording};
}
pub use kinect::KinectSource;
pub use paced::Paced;
pub use synthetic::SyntheticSource;
pub use tum::{TumRecorder, TumSource};

/// A frame that owns its data.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
#[expect(clippy::large_enum_variant, reason = "a few hundred bytes beside the megabytes of a frame")]
pub enum SourceFrame {
    /// A depth image with its camera, time stamp and optional colour.
    Depth(DepthFrame),
    /// An organized cloud.
    Cloud {
        /// The points.
        cloud: OrganizedCloud,
        /// When it was taken, in seconds of the source's clock.
        timestamp_s: Option<f64>,
    },
}

impl SourceFrame {
    /// Width and height in pixels.
    pub fn shape(&self) -> (usize, usize) {
        match self {
            Self::Depth(depth) => (depth.camera.width, depth.camera.height),
            Self::Cloud { cloud, .. } => (cloud.width(), cloud.height()),
        }
    }

    /// When it was taken, in seconds of the source's clock.
    pub fn timestamp_s(&self) -> Option<f64> {
        match self {
            Self::Depth(depth) => depth.timestamp_s,
            Self::Cloud { timestamp_s, .. } => *timestamp_s,
        }
    }
}

impl<'a> IntoFrame<'a> for &'a SourceFrame {
    fn into_frame(self) -> Result<Frame<'a>, FrameError> {
        match self {
            SourceFrame::Depth(depth) => depth.into_frame(),
            SourceFrame::Cloud { cloud, .. } => cloud.into_frame(),
        }
    }
}

/// Delivers one frame after another.
pub trait Source: Send {
    /// Returns the next frame; `None` at the end. A live source waits for it.
    ///
    /// A frame that cannot be read is an error; the caller may go on with the one after it.
    fn next_frame(&mut self) -> Result<Option<SourceFrame>, Error>;

    /// Returns the name of the frame delivered last, where it has one of its own: that of its file, without the extension.
    fn frame_name(&self) -> Option<String> {
        None
    }

    /// Takes a flag that a stream sets when it ends, before the first frame. A source that may wait for long looks at it.
    fn end_with(&mut self, _ended: Arc<AtomicBool>) {}

    /// Returns how many frames a live source has replaced by newer ones before they were taken.
    fn dropped(&self) -> u64 {
        0
    }

    /// Whether frames arrive at their own pace and are lost if not taken in time. A stream then wants the newest frame; of any
    /// other source it wants every frame.
    fn is_live(&self) -> bool {
        false
    }
}

/// What a source named on the command line may need besides its name.
#[derive(Debug, Clone, PartialEq, Default)]
#[non_exhaustive]
pub struct SourceOptions {
    /// The camera; depth images need one. Width and height 0 stand for the frames' shape; any other must match it.
    pub camera: Option<Camera>,
    /// Depth units per metre of a data set in TUM layout, if not its standard 5000.
    pub tum_units_per_metre: Option<f64>,
    /// Plays a source that is not live at this rate, in frames per second, as if it were.
    pub fps: Option<f64>,
    /// The topic of a recording in MCAP; may be left out where only one has depth.
    pub topic: Option<String>,
    /// The topic with the camera of a recording in MCAP, if it is not beside the images'.
    pub camera_info_topic: Option<String>,
}

impl SourceOptions {
    /// The same with a camera, or without.
    pub fn with_camera(self, camera: Option<Camera>) -> Self {
        Self { camera, ..self }
    }

    /// The same with other units of a data set in TUM layout, or its own.
    pub fn with_tum_units_per_metre(self, tum_units_per_metre: Option<f64>) -> Self {
        Self { tum_units_per_metre, ..self }
    }

    /// The same with topics of a recording in MCAP: that of the depth, and that of its camera.
    pub fn with_topics(self, topic: Option<String>, camera_info_topic: Option<String>) -> Self {
        Self { topic, camera_info_topic, ..self }
    }

    /// The same paced as live, or not.
    pub fn with_fps(self, fps: Option<f64>) -> Self {
        Self { fps, ..self }
    }
}

/// Opens `kinect[:INDEX]`, `synthetic[:SEED]`, a data set in TUM RGB-D layout, a recording of libfreenect, one of ROS 2 in MCAP (with the
/// feature `mcap`), a folder of frames, or one file, which is repeated without end.
pub fn open(name: &str, options: &SourceOptions) -> Result<Box<dyn Source>, Error> {
    let (kind, number) = name.split_once(':').unwrap_or((name, ""));
    if matches!(kind, "kinect" | "synthetic") {
        refuse_topics(options)?;
    }
    let source: Box<dyn Source> = match kind {
        "kinect" if options.fps.is_some() => {
            let allowed = "none for a Kinect, which has its own pace";
            return Err(ParamError { field: "fps", value: format!("{:?}", options.fps), allowed }.into());
        }
        "kinect" => return Ok(Box::new(KinectSource::open(parse_number(name, number, 0)?, options.camera)?)),
        "synthetic" if options.camera.is_some() => {
            let allowed = "none for the simulator, which has its own";
            return Err(ParamError { field: "camera", value: "given".into(), allowed }.into());
        }
        "synthetic" => Box::new(SyntheticSource::new(parse_number(name, number, 1)?, Camera::kinect_v1())?),
        _ => open_path(Path::new(name), options)?,
    };
    match options.fps {
        Some(fps) => Ok(Box::new(Paced::new(source, fps)?)),
        None => Ok(source),
    }
}

fn open_path(path: &Path, options: &SourceOptions) -> Result<Box<dyn Source>, Error> {
    #[cfg(feature = "mcap")]
    {
        crate::bag::refuse_other_bags(path)?;
        let file = crate::bag::file_of(path)?;
        if crate::bag::is_bag(&file) {
            let (topic, camera_info) = (options.topic.as_deref(), options.camera_info_topic.as_deref());
            return Ok(Box::new(crate::bag::BagSource::open(&file, topic, camera_info, options.camera)?));
        }
    }
    refuse_topics(options)?;
    if path.is_file() {
        return Ok(Box::new(FileSource::repeat(path, options.camera)));
    }
    if !path.is_dir() {
        let problem = "no such file or folder; a source is kinect, synthetic, a data set, a folder or a file";
        return Err(malformed(path, problem).into());
    }
    if path.join("INDEX.txt").is_file() {
        return Ok(Box::new(FreenectRecording::open(path, options.camera)?));
    }
    if ["associations.txt", "associate.txt", "depth.txt"].iter().any(|file| path.join(file).is_file()) {
        return Ok(Box::new(TumSource::open(path, options.camera, options.tum_units_per_metre)?));
    }
    Ok(Box::new(FileSource::folder(path, options.camera)?))
}

/// Refuses topics where there are none.
fn refuse_topics(options: &SourceOptions) -> Result<(), ParamError> {
    match options.topic.as_ref().or(options.camera_info_topic.as_ref()) {
        None => Ok(()),
        Some(topic) => {
            let allowed = "topics of recordings in MCAP, which this source is not";
            Err(ParamError { field: "topic", value: topic.clone(), allowed })
        }
    }
}

fn parse_number<T: std::str::FromStr>(name: &str, number: &str, default: T) -> Result<T, Error> {
    if number.is_empty() {
        return Ok(default);
    }
    number.parse().map_err(|_| malformed(Path::new(name), "a whole number is expected behind the colon").into())
}

/// Returns the camera for frames of a shape; one without a shape takes it.
fn with_shape(camera: Camera, (width, height): (usize, usize)) -> Camera {
    if (camera.width, camera.height) == (0, 0) { camera.with_shape((width, height)) } else { camera }
}

/// Returns an error about a file or source of that name.
fn malformed(path: &Path, problem: impl Into<String>) -> IoError {
    IoError { path: PathBuf::from(path), problem: FormatError::Malformed(problem.into()) }
}
