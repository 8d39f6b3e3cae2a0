//! Where results go: folders, or any [`Sink`], each on a thread of its own.

use std::fs::OpenOptions;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::thread::{self, JoinHandle};

use super::mailbox::TimeSpent;
use super::{StreamFrame, StreamStatistics};
use crate::error::{EngineError, Error, FormatError, IoError};
use crate::frame::DepthImage;
use crate::io::{self, CloudRef, Encoding};
use crate::outputs::Outputs;
use crate::source::SourceFrame;

/// Consumes results, one after another.
pub trait Sink: Send {
    /// Its name in messages.
    fn name(&self) -> String;

    /// Consumes one result.
    fn write(&mut self, frame: &StreamFrame) -> Result<(), Error>;

    /// Called after the last result.
    fn close(&mut self) -> Result<(), Error> {
        Ok(())
    }
}

/// The kind of files that a folder sink writes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum SinkFormat {
    /// Organized clouds, binary.
    Pcd,
    /// The same as PLY.
    Ply,
    /// 16-bit depth; the stream's outputs must include depth.
    DepthPng,
}

impl SinkFormat {
    fn extension(self) -> &'static str {
        match self {
            Self::Pcd => "pcd",
            Self::Ply => "ply",
            Self::DepthPng => "png",
        }
    }
}

/// Writes every result to a folder, as `000000.pcd` and so on, each file atomically. Depth becomes a data set: `depth.txt` with the time
/// stamps, and `camera.json` with intrinsics and units.
pub struct FolderSink {
    folder: PathBuf,
    format: SinkFormat,
    outputs: Outputs,
    /// Whether the camera has been written.
    has_camera: bool,
}

impl FolderSink {
    /// Creates the folder. `outputs` are the fields to add to points. Depth is not put into a folder that has a data set already, whose
    /// list and camera it would replace.
    pub fn create(folder: &Path, format: SinkFormat, outputs: Outputs) -> Result<Self, Error> {
        std::fs::create_dir_all(folder)
            .map_err(|error| IoError { path: folder.to_path_buf(), problem: error.into() })?;
        if format == SinkFormat::DepthPng && ["depth.txt", "camera.json"].iter().any(|name| folder.join(name).exists())
        {
            let problem = FormatError::Unsupported("has a data set already; save into another folder".into());
            return Err(IoError { path: folder.to_path_buf(), problem }.into());
        }
        Ok(Self { folder: folder.to_path_buf(), format, outputs, has_camera: false })
    }

    fn append(&self, name: &str, text: &str) -> Result<(), IoError> {
        let path = self.folder.join(name);
        let file = OpenOptions::new().create(true).append(true).open(&path);
        file.and_then(|mut file| file.write_all(text.as_bytes()))
            .map_err(|error| IoError { path, problem: error.into() })
    }
}

impl Sink for FolderSink {
    fn name(&self) -> String {
        self.folder.display().to_string()
    }

    fn write(&mut self, frame: &StreamFrame) -> Result<(), Error> {
        let name = format!("{:06}.{}", frame.index, self.format.extension());
        let path = self.folder.join(&name);
        if self.format == SinkFormat::DepthPng {
            let (width, height) = (frame.smoothed.width, frame.smoothed.height);
            let missing = crate::FrameError::MissingCamera { what: "depth as an output" };
            let raw = frame.smoothed.depth.clone().ok_or(missing)?;
            io::write_depth(&path, &DepthImage { width, height, raw })?;
            let seconds = frame.source.timestamp_s().unwrap_or(frame.index as f64 / FRAMES_PER_SECOND);
            // After its image, so that a stream that is cut off leaves a data set up to there.
            self.append("depth.txt", &format!("{seconds:.6} {name}\n"))?;
            if let (SourceFrame::Depth(depth), false) = (&frame.source, self.has_camera) {
                self.append("camera.json", &io::camera_to_json(&depth.camera))?;
                self.has_camera = true;
            }
            return Ok(());
        }
        let mut cloud = match &frame.source {
            SourceFrame::Depth(depth) => depth.deproject()?,
            SourceFrame::Cloud { cloud, .. } => cloud.clone(),
        };
        cloud.points.apply(&frame.smoothed, self.outputs)?;
        if self.format == SinkFormat::Ply {
            cloud.points.unpack_colour();
        }
        Ok(io::write_cloud(&path, CloudRef::Organized(&cloud), Encoding::Binary)?)
    }
}

/// Of a source without time stamps.
const FRAMES_PER_SECOND: f64 = 30.0;

/// Length of a sink's queue. When it is full a live stream drops results; any other waits.
const QUEUE: usize = 4;

/// A sink on its thread.
pub(super) struct SinkThread {
    name: String,
    frames: Option<SyncSender<Arc<StreamFrame>>>,
    thread: Option<JoinHandle<Result<(), Error>>>,
    dropped: u64,
    warned: bool,
    time: Arc<TimeSpent>,
}

impl SinkThread {
    pub(super) fn start(mut sink: Box<dyn Sink>) -> Result<Self, Error> {
        let name = sink.name();
        let (frames, queue) = sync_channel::<Arc<StreamFrame>>(QUEUE);
        let time = Arc::new(TimeSpent::default());
        let spent = Arc::clone(&time);
        let work = move || {
            for frame in queue {
                spent.on(|| sink.write(&frame))?;
            }
            sink.close()
        };
        let failed = |error: std::io::Error| EngineError::Threads { threads: 1, reason: error.to_string() };
        let thread = thread::Builder::new().name("planish-sink".into()).spawn(work).map_err(failed)?;
        Ok(Self { name, frames: Some(frames), thread: Some(thread), dropped: 0, warned: false, time })
    }

    /// Queues a result; returns a warning, once, if the sink failed.
    pub(super) fn give(&mut self, frame: &Arc<StreamFrame>, live: bool) -> Option<String> {
        let frames = self.frames.as_ref()?;
        let given = if live {
            frames.try_send(Arc::clone(frame))
        } else {
            frames.send(Arc::clone(frame)).map_err(|gone| TrySendError::Disconnected(gone.0))
        };
        match given {
            Ok(()) => None,
            Err(TrySendError::Full(_)) => {
                self.dropped += 1;
                let is_first = !std::mem::replace(&mut self.warned, true);
                is_first.then(|| format!("{}: is slower than the stream; frames are left out", self.name))
            }
            Err(TrySendError::Disconnected(_)) => {
                self.frames = None;
                let reason = self.reason().unwrap_or_else(|| "it ended".to_owned());
                Some(format!("{}: gets nothing more: {reason}", self.name))
            }
        }
    }

    /// Returns why it failed, once its thread has ended.
    fn reason(&mut self) -> Option<String> {
        match self.thread.take()?.join() {
            Ok(Ok(())) => None,
            Ok(Err(error)) => Some(error.to_string()),
            Err(_) => Some("its thread panicked".to_owned()),
        }
    }

    /// Waits until it has written everything, and updates the counts; returns a warning if it failed.
    pub(super) fn finish(mut self, statistics: &mut StreamStatistics) -> Option<String> {
        let had_failed = self.frames.take().is_none();
        statistics.dropped_by_sinks += self.dropped;
        let reason = self.reason();
        statistics.time_in_sinks += self.time.total();
        if had_failed || reason.is_some() {
            statistics.failed_sinks += 1;
        }
        reason.map(|reason| format!("{}: {reason}", self.name))
    }
}
