//! Sinks for results: folders, or any [`Sink`], each on a separate thread.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::thread::{self, JoinHandle};

use super::mailbox::TimeSpent;
use super::{StreamFrame, StreamStatistics};
use crate::new_folder::refuse_used;
use crate::source::OwnedFrame;
use planish_core::{DepthFrame, DepthImage, EngineError, Error, IoError, Outputs};
use planish_io::internal::{append_to, create_output_folder};
use planish_io::{self as io, CloudRef, Encoding, RgbImage};

/// A consumer of results, one after another.
pub trait Sink: Send {
    /// Returns the name of the sink for messages.
    fn name(&self) -> String;

    /// Consumes one result.
    fn write(&mut self, frame: &StreamFrame) -> Result<(), Error>;

    /// Consumes one result that may be kept without a copy; calls [`write`](Self::write) by default.
    fn write_shared(&mut self, frame: &Arc<StreamFrame>) -> Result<(), Error> {
        self.write(frame)
    }

    /// Finishes the output. Called after the last result.
    fn close(&mut self) -> Result<(), Error> {
        Ok(())
    }
}

/// The file format of a folder sink.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum SinkFormat {
    /// Binary PCD files with organized clouds.
    Pcd,
    /// PLY files.
    Ply,
    /// PNG files with 16-bit depth; the stream's outputs must include depth.
    DepthPng,
}

impl SinkFormat {
    pub(crate) fn extension(self) -> &'static str {
        match self {
            Self::Pcd => "pcd",
            Self::Ply => "ply",
            Self::DepthPng => "png",
        }
    }
}

/// A sink that writes every result to a folder, each file atomically. Files are named like their frames or, for
/// frames without a name, `000000.pcd` and so on.
///
/// Depth becomes a data set in TUM layout: `depth.txt` with the timestamps, `camera.json` with intrinsics and units,
/// and colour in `rgb` with `rgb.txt`. NAME.origin.png shows the origin of each pixel if values may be filled or
/// carried over time. Clouds whose source has timestamps are listed in `points.txt`.
pub struct FolderSink {
    folder: PathBuf,
    format: SinkFormat,
    outputs: Outputs,
    /// Names already used.
    names: HashSet<String>,
    /// Whether the camera has been written.
    has_camera: bool,
}

impl FolderSink {
    /// Creates the folder. `outputs` are the fields to add to points. Refuses a non-empty folder.
    pub fn create(folder: &Path, format: SinkFormat, outputs: Outputs) -> Result<Self, Error> {
        refuse_used(folder)?;
        create_output_folder(folder).map_err(|error| IoError { path: folder.to_path_buf(), problem: error.into() })?;
        Ok(Self { folder: folder.to_path_buf(), format, outputs, names: HashSet::new(), has_camera: false })
    }

    /// Returns a unique name for a frame's file, without its extension.
    fn name_of(&mut self, frame: &StreamFrame) -> String {
        // The lists of a data set separate names by spaces and lines, and begin comments with #.
        let listed = |name: &String| {
            name.replace(|c: char| c.is_whitespace() || c.is_control() || c == '#', "_")
                .trim_start_matches('.')
                .to_owned()
        };
        let named = frame.name.as_ref().map(listed).filter(|name| !name.is_empty());
        let number = format!("{:06}", frame.index);
        let origin_of = |name: &String| format!("{name}.origin");
        let is_free = |name: &String| !self.names.contains(name) && !self.names.contains(&origin_of(name));
        let base = named.as_ref().map_or_else(|| number.clone(), |taken| format!("{taken}-{number}"));
        let numbered = std::iter::successors(Some(base), |name| Some(format!("{name}-{number}")));
        let name = named.into_iter().chain(numbered).find(is_free).unwrap_or(number);
        self.names.extend([origin_of(&name), name.clone()]);
        name
    }

    /// Writes depth, its colour and the lists of a data set.
    fn write_depth(&mut self, frame: &StreamFrame, name: &str) -> Result<(), Error> {
        let (width, height) = (frame.smoothed.width, frame.smoothed.height);
        let missing = planish_core::FrameError::MissingCamera { what: "the output depth" };
        let raw = frame.smoothed.depth.clone().ok_or(missing)?;
        let file = format!("{name}.{}", self.format.extension());
        if frame.smoothed.status.is_some() {
            io::write_origin_mask(&self.folder.join(&file), &frame.smoothed)?;
        }
        io::write_depth(&self.folder.join(&file), &DepthImage { width, height, raw })?;
        let seconds = frame.source.timestamp_s().unwrap_or(frame.index as f64 / FRAMES_PER_SECOND);
        if let OwnedFrame::Depth(DepthFrame { rgb: Some(rgb), .. }) = &frame.source {
            let colour = format!("rgb/{name}.png");
            let folder = self.folder.join("rgb");
            create_output_folder(&folder).map_err(|error| IoError { path: folder, problem: error.into() })?;
            planish_io::write_rgb_png(&self.folder.join(&colour), &RgbImage { width, height, rgb: rgb.clone() })?;
            self.append("rgb.txt", &format!("{seconds:.6} {colour}\n"))?;
        }
        // Written after its images, so that an interrupted stream leaves a complete data set.
        self.append("depth.txt", &format!("{seconds:.6} {file}\n"))?;
        let camera = match &frame.source {
            OwnedFrame::Depth(depth) => Some(depth.camera),
            OwnedFrame::Cloud { cloud, .. } => cloud.camera,
        };
        if let (Some(camera), false) = (camera, self.has_camera) {
            self.append("camera.json", &io::camera_to_json(&camera))?;
            self.has_camera = true;
        }
        Ok(())
    }

    fn append(&self, name: &str, text: &str) -> Result<(), IoError> {
        let path = self.folder.join(name);
        append_to(&path, text).map_err(|problem| IoError { path, problem })
    }
}

impl Sink for FolderSink {
    fn name(&self) -> String {
        self.folder.display().to_string()
    }

    fn write(&mut self, frame: &StreamFrame) -> Result<(), Error> {
        let name = self.name_of(frame);
        if self.format == SinkFormat::DepthPng {
            return self.write_depth(frame, &name);
        }
        let mut cloud = match &frame.source {
            OwnedFrame::Depth(depth) => depth.deproject()?,
            OwnedFrame::Cloud { cloud, .. } => cloud.clone(),
        };
        cloud.points.apply(&frame.smoothed, self.outputs)?;
        if self.format == SinkFormat::Ply {
            cloud.points.unpack_colour();
        }
        let file = format!("{name}.{}", self.format.extension());
        io::write_cloud(&self.folder.join(&file), CloudRef::Organized(&cloud), Encoding::Binary)?;
        if let Some(seconds) = frame.source.timestamp_s() {
            self.append("points.txt", &format!("{seconds:.6} {file}\n"))?;
        }
        Ok(())
    }
}

/// Assumed frame rate of sources without timestamps, in frames per second.
const FRAMES_PER_SECOND: f64 = 30.0;

/// Warning when a stream ends because all of its sinks have failed.
pub(crate) const ALL_SINKS_FAILED: &str = "the stream stops, since every sink has failed";

/// Length of a sink's queue in results, a quarter of a second at 30 frames/s. When the queue is full, a live stream
/// drops results, and any other stream waits.
const QUEUE: usize = 8;

/// A consumer of results of one type, on a separate thread.
pub(crate) trait Consumer<T>: Send + 'static {
    fn name(&self) -> String;
    fn write(&mut self, result: &Arc<T>) -> Result<(), Error>;
    fn close(&mut self) -> Result<(), Error>;
}

impl Consumer<StreamFrame> for Box<dyn Sink> {
    fn name(&self) -> String {
        Sink::name(&**self)
    }

    fn write(&mut self, frame: &Arc<StreamFrame>) -> Result<(), Error> {
        Sink::write_shared(&mut **self, frame)
    }

    fn close(&mut self) -> Result<(), Error> {
        Sink::close(&mut **self)
    }
}

/// A sink on a separate thread.
pub(crate) struct SinkThread<T> {
    name: String,
    frames: Option<SyncSender<Arc<T>>>,
    thread: Option<JoinHandle<Result<(), Error>>>,
    dropped: u64,
    warned: bool,
    time: Arc<TimeSpent>,
}

impl<T: Send + Sync + 'static> SinkThread<T> {
    pub(crate) fn start(mut sink: impl Consumer<T>) -> Result<Self, Error> {
        let name = sink.name();
        let (frames, queue) = sync_channel::<Arc<T>>(QUEUE);
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

    /// Queues a result. Returns a warning if the sink failed or is too slow, at most once for each reason.
    pub(crate) fn give(&mut self, frame: &Arc<T>, live: bool) -> Option<String> {
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
                is_first.then(|| format!("{}: the sink is slower than the stream; frames are dropped", self.name))
            }
            Err(TrySendError::Disconnected(_)) => {
                self.frames = None;
                let reason = self.reason().unwrap_or_else(|| "its thread ended".to_owned());
                Some(format!("{}: the sink stopped: {reason}", self.name))
            }
        }
    }

    /// Returns true if there are sinks, and all have failed.
    pub(crate) fn all_failed(sinks: &[Self]) -> bool {
        !sinks.is_empty() && sinks.iter().all(|sink| sink.frames.is_none())
    }

    /// Waits for the thread to end, and returns the reason if the sink failed.
    fn reason(&mut self) -> Option<String> {
        match self.thread.take()?.join() {
            Ok(Ok(())) => None,
            Ok(Err(error)) => Some(error.to_string()),
            Err(_) => Some("its thread panicked".to_owned()),
        }
    }

    /// Waits until the sink has written everything, and updates the counts; returns a warning if the sink failed.
    pub(crate) fn finish(mut self, statistics: &mut StreamStatistics) -> Option<String> {
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
