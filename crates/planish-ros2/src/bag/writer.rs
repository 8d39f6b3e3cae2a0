//! Writes frames as a recording: depth images with their camera, or clouds.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{BufWriter, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError, Weak};
use std::time::{Duration, Instant};

use mcap::records::MessageHeader;
use mcap::{McapError, WriteOptions, Writer};

use super::of_mcap;
use super::recover::{complete_in_place, mark_as_being_written, part_of};
use super::schemas::{
    CAMERA_INFO, CAMERA_INFO_TYPE, CLOUD, CLOUD_TYPE, IMAGE, IMAGE_TYPE, MESSAGE_ENCODING, PROFILE, SCHEMA_ENCODING,
};
use crate::ros::{CameraInfo, DepthPixels, Header, Image, PointCloud2, Time, camera_info_topic, to_cdr};
use planish_core::{Camera, DepthImage, Error, FormatError, IoError, OwnedFrame};
use planish_io::ReadOptions;
use planish_io::internal::check_target;

/// Topic of depth images without distortion. This name and those of raw images, colour and clouds follow the
/// conventions of depth_image_proc and RViz.
const RECTIFIED_TOPIC: &str = "/camera/depth/image_rect";
/// Topic of depth images with distortion.
const RAW_TOPIC: &str = "/camera/depth/image_raw";
/// Topic of colour registered to depth.
const COLOUR_TOPIC: &str = "/camera/rgb/image_rect_color";
/// Topic of the origins of depth pixels.
const ORIGIN_TOPIC: &str = "/camera/depth/origin";
/// Topic of clouds.
const POINTS_TOPIC: &str = "/camera/depth/points";
/// Coordinate frame of all messages.
const FRAME_ID: &str = "camera_depth_optical_frame";

/// Frame rate in frames per second that is assumed for frames without timestamps.
const FRAMES_PER_SECOND: f64 = 30.0;

/// Returns the channel metadata that rosbag2 expects, with empty QoS profiles since those of the publisher are
/// unknown.
pub(super) fn channel_metadata() -> BTreeMap<String, String> {
    BTreeMap::from([("offered_qos_profiles".to_owned(), String::new())])
}

/// Recordings that are being written, to be finished when the process has to end; `None` once the process is ending.
static OPEN: Mutex<Option<Vec<Weak<Shared>>>> = Mutex::new(Some(Vec::new()));

/// A recording that either its writer or a signal finishes; `None` once it is finished.
type Shared = Mutex<Option<Open>>;

/// Maximum time to wait for a frame that is being written when the process has to end.
const PATIENCE: Duration = Duration::from_secs(2);

/// Finishes all recordings that are being written, for a process that is about to end. Adding frames and creating
/// recordings fail from then on.
pub fn finish_recordings() {
    let deadline = Instant::now() + PATIENCE;
    // If the process ends for lack of memory, this thread may already hold the lock.
    let open = loop {
        match OPEN.try_lock() {
            Ok(mut open) => break open.take().unwrap_or_default(),
            Err(TryLockError::Poisoned(open)) => break open.into_inner().take().unwrap_or_default(),
            Err(TryLockError::WouldBlock) if Instant::now() > deadline => return,
            Err(TryLockError::WouldBlock) => std::thread::sleep(Duration::from_millis(1)),
        }
    };
    for recording in open.iter().filter_map(Weak::upgrade) {
        while let Err(TryLockError::WouldBlock) = recording.try_lock()
            && Instant::now() < deadline
        {
            std::thread::sleep(Duration::from_millis(5));
        }
        // Locked until the recording is finished, since its own thread may be about to end the process, too.
        let mut recording = match recording.try_lock() {
            Ok(recording) => recording,
            Err(TryLockError::Poisoned(recording)) => recording.into_inner(),
            // The recording's frames so far are in NAME.mcap.part.
            Err(TryLockError::WouldBlock) => continue,
        };
        let _ = recording.take().map(Open::close);
    }
}

/// A writer of frames to a recording. Frames go to `NAME.mcap.part`, which other programs can read up to the last
/// frame. [`finish`](Self::finish), or dropping the writer, renames the file to `NAME.mcap`. A process that is killed
/// leaves the part file, which [`recover`](super::recover()) completes.
///
/// Depth is written to `/camera/depth/image_rect` (`image_raw` with distortion) with its `camera_info`: as 16UC1 if
/// the camera's unit is the millimetre, otherwise as 32FC1 in metres. Clouds are written to `/camera/depth/points`,
/// and colour registered to depth to `/camera/rgb/image_rect_color`, in the frame `camera_depth_optical_frame`.
/// Stamps are the frames' timestamps, rounded to microseconds; a negative timestamp is an error. Frames without
/// timestamps are stamped 1/30 s apart.
pub struct BagWriter {
    path: PathBuf,
    /// `None` once the recording is finished.
    open: Arc<Shared>,
    frames: u32,
}

/// A recording that is being written.
struct Open {
    path: PathBuf,
    writer: Writer<BufWriter<File>>,
    channels: BTreeMap<String, u16>,
    has_failed: bool,
    has_frames: bool,
    /// The file `NAME.mcap.part`.
    file: File,
    /// Length of the file in bytes up to the end of the last whole frame.
    whole_bytes: u64,
    /// Whether to delete the file unless it is finished.
    is_all_or_nothing: bool,
}

impl BagWriter {
    /// Creates a recording.
    ///
    /// # Errors
    /// If `NAME.mcap.part` exists, since it may be a recording that was cut off, or if the file cannot be created.
    pub fn create(path: &Path) -> Result<Self, Error> {
        // Locked until the recording is registered, so that a signal finds all files that exist.
        let mut all = OPEN.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(all) = &mut *all else { return Err(IoError::at(path)(stopped()).into()) };
        refuse_cut_off(path)?;
        let open = Arc::new(Mutex::new(Some(Open::create(path).map_err(IoError::at(path))?)));
        all.retain(|recording| recording.strong_count() > 0);
        all.push(Arc::downgrade(&open));
        Ok(Self { path: path.to_path_buf(), open, frames: 0 })
    }

    /// Makes the writer delete the recording, instead of finishing it, if the writer is dropped or a signal ends the
    /// process. Use this for results that can be computed again.
    pub fn all_or_nothing(self) -> Self {
        if let Some(open) = &mut *self.lock() {
            open.is_all_or_nothing = true;
        }
        self
    }

    fn lock(&self) -> MutexGuard<'_, Option<Open>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a depth image in any unit, with its camera.
    pub fn add_depth(&mut self, image: &DepthImage, camera: &Camera, timestamp_s: Option<f64>) -> Result<(), Error> {
        camera.validate()?;
        camera.check_shape((image.width, image.height))?;
        let header = self.header(timestamp_s)?;
        let topic = if camera.distortion.is_none() { RECTIFIED_TOPIC } else { RAW_TOPIC };
        let pixels = depth_pixels(image, camera);
        let info = CameraInfo::of_camera(header.clone(), camera);
        self.write(&camera_info_topic(topic), CAMERA_INFO_TYPE, CAMERA_INFO, &header, to_cdr(&info))?;
        self.write(topic, IMAGE_TYPE, IMAGE, &header, to_cdr(&Image::of_depth(header.clone(), &pixels)))?;
        Ok(self.end_frame()?)
    }

    /// Adds a cloud.
    pub fn add_cloud(
        &mut self,
        cloud: &planish_core::PointCloud,
        grid: Option<(usize, usize)>,
        timestamp_s: Option<f64>,
    ) -> Result<(), Error> {
        let header = self.header(timestamp_s)?;
        let message = PointCloud2::of_cloud(header.clone(), cloud, grid)?;
        self.write(POINTS_TOPIC, CLOUD_TYPE, CLOUD, &header, to_cdr(&message))?;
        Ok(self.end_frame()?)
    }

    /// Adds colour registered to the depth image that is added next, 3 bytes (red, green, blue) per pixel.
    pub fn add_colour(
        &mut self,
        (width, height): (usize, usize),
        rgb: &[u8],
        timestamp_s: Option<f64>,
    ) -> Result<(), Error> {
        let header = self.header(timestamp_s)?;
        let image = Image {
            header: header.clone(),
            height: height as u32,
            width: width as u32,
            encoding: "rgb8".into(),
            is_bigendian: 0,
            step: 3 * width as u32,
            data: rgb.to_vec(),
        };
        Ok(self.write(COLOUR_TOPIC, IMAGE_TYPE, IMAGE, &header, to_cdr(&image))?)
    }

    /// Adds the pixel origins ([`Smoothed::origin_mask`](planish_core::Smoothed::origin_mask)) of the depth image
    /// that is added next, on `/camera/depth/origin`.
    pub fn add_origin(&mut self, shape: (usize, usize), mask: Vec<u8>, timestamp_s: Option<f64>) -> Result<(), Error> {
        let header = self.header(timestamp_s)?;
        let image = Image::of_origins(header.clone(), shape, mask);
        Ok(self.write(ORIGIN_TOPIC, IMAGE_TYPE, IMAGE, &header, to_cdr(&image))?)
    }

    /// Adds a frame as its source delivered it.
    pub fn add(&mut self, frame: &OwnedFrame) -> Result<(), Error> {
        match frame {
            OwnedFrame::Depth(depth) => {
                let (width, height) = frame.shape();
                let image = DepthImage { width, height, raw: depth.raw.clone() };
                if let Some(rgb) = &depth.rgb {
                    self.add_colour((width, height), rgb, depth.timestamp_s)?;
                }
                self.add_depth(&image, &depth.camera, depth.timestamp_s)
            }
            OwnedFrame::Cloud { cloud, timestamp_s } => {
                self.add_cloud(&cloud.points, Some(frame.shape()), *timestamp_s)
            }
        }
    }

    /// Completes the recording under its final name, or deletes it if nothing was added.
    pub fn finish(self) -> Result<(), Error> {
        // Locked until the recording is finished, since the process may be about to end.
        let mut open = self.lock();
        let finished = open.take().map_or(Ok(()), Open::finish_or_delete);
        drop(open);
        Ok(finished.map_err(IoError::at(&self.path))?)
    }

    fn header(&self, timestamp_s: Option<f64>) -> Result<Header, IoError> {
        let seconds = timestamp_s.unwrap_or(f64::from(self.frames) / FRAMES_PER_SECOND);
        let stamp = Time::from_seconds(seconds).ok_or_else(|| {
            let allowed = "ROS 2 messages allow 0 to 2147483647 s";
            IoError::at(&self.path)(FormatError::Unsupported(format!(
                "the timestamp {seconds} s is out of range; {allowed}"
            )))
        })?;
        Ok(Header { stamp, frame_id: FRAME_ID.into() })
    }

    fn write(
        &mut self,
        topic: &str,
        type_name: &str,
        definition: &str,
        header: &Header,
        message: Result<Vec<u8>, FormatError>,
    ) -> Result<(), IoError> {
        let mut open = self.lock();
        let Some(open) = &mut *open else {
            return Err(IoError::at(&self.path)(stopped()));
        };
        let result = message.and_then(|bytes| open.write(topic, (type_name, definition), header, self.frames, &bytes));
        result.map_err(IoError::at(&self.path))
    }

    /// Ends a frame and flushes it to the file.
    fn end_frame(&mut self) -> Result<(), IoError> {
        self.frames += 1;
        if let Some(open) = &mut *self.lock() {
            let mut flush = || -> Result<u64, FormatError> {
                open.writer.flush().map_err(of_mcap)?;
                Ok(open.file.metadata()?.len())
            };
            match flush() {
                Ok(bytes) => (open.whole_bytes, open.has_frames) = (bytes, true),
                Err(problem) => {
                    open.has_failed = true;
                    return Err(IoError { path: self.path.clone(), problem });
                }
            }
        }
        Ok(())
    }
}

impl Drop for BagWriter {
    fn drop(&mut self) {
        let mut open = self.lock();
        let _ = open.take().map(Open::close);
    }
}

impl Open {
    fn create(path: &Path) -> Result<Self, FormatError> {
        check_target(path)?;
        if path.is_symlink() {
            return Err(FormatError::Unsupported("the path is a symbolic link; choose another name".into()));
        }
        let part = part_of(path);
        let file = OpenOptions::new().read(true).write(true).create_new(true).open(&part)?;
        mark_as_being_written(&file);
        let begun = || -> Result<_, FormatError> {
            // Chunks are appended whole, with their length; nothing in the file changes later.
            let options = WriteOptions::new().compression(None).disable_seeking(true).profile(PROFILE);
            let mut writer = options.create(BufWriter::new(file.try_clone()?)).map_err(of_mcap)?;
            writer.flush().map_err(of_mcap)?;
            Ok((writer, file.metadata()?.len()))
        };
        match begun() {
            Ok((writer, whole_bytes)) => Ok(Self {
                path: path.to_path_buf(),
                writer,
                channels: BTreeMap::new(),
                has_failed: false,
                has_frames: false,
                file,
                whole_bytes,
                is_all_or_nothing: false,
            }),
            Err(problem) => {
                let _ = std::fs::remove_file(part);
                Err(problem)
            }
        }
    }

    fn write(
        &mut self,
        topic: &str,
        (type_name, definition): (&str, &str),
        header: &Header,
        sequence: u32,
        message: &[u8],
    ) -> Result<(), FormatError> {
        let mut written = || -> Result<(), McapError> {
            let channel_id = match self.channels.get(topic) {
                Some(channel) => *channel,
                None => {
                    let schema = self.writer.add_schema(type_name, SCHEMA_ENCODING, definition.as_bytes())?;
                    let added = self.writer.add_channel(schema, topic, MESSAGE_ENCODING, &channel_metadata())?;
                    *self.channels.entry(topic.to_owned()).or_insert(added)
                }
            };
            let time = header.stamp.nanoseconds();
            let header = MessageHeader { channel_id, sequence, log_time: time, publish_time: time };
            self.writer.write_to_known_channel(&header, message)
        };
        let result = written();
        self.has_failed |= result.is_err();
        result.map_err(of_mcap)
    }

    /// Finishes the recording, or deletes it if it is empty or all-or-nothing.
    fn close(self) -> Result<(), FormatError> {
        if self.has_frames && !self.is_all_or_nothing { self.finish() } else { self.delete() }
    }

    fn finish_or_delete(self) -> Result<(), FormatError> {
        match (self.channels.is_empty(), self.has_frames || !self.has_failed) {
            (false, true) => self.finish(),
            (true, true) => self.delete(),
            (_, false) => {
                self.delete()?;
                Err(of_mcap(McapError::AttemptedWriteAfterFailure))
            }
        }
    }

    fn delete(self) -> Result<(), FormatError> {
        let part = part_of(&self.path);
        drop(self);
        Ok(std::fs::remove_file(part)?)
    }

    fn finish(mut self) -> Result<(), FormatError> {
        let part = part_of(&self.path);
        let finished = if self.has_failed { Err(McapError::AttemptedWriteAfterFailure) } else { self.writer.finish() };
        let Self { path, writer, mut file, whole_bytes, .. } = self;
        // Dropping flushes the buffer.
        drop(writer);
        if finished.is_err() {
            // Disk full: truncate to the last whole frame, and write the index there.
            file.set_len(whole_bytes)?;
            complete_in_place(&mut file, &ReadOptions::default())?;
        }
        file.sync_all()?;
        if path.symlink_metadata().is_ok() && !path.is_file() {
            let text =
                format!("the name is now taken by something other than a file; the recording is in {}", part.display());
            return Err(FormatError::Unsupported(text));
        }
        // Windows can rename only closed files.
        drop(file);
        Ok(std::fs::rename(&part, &path)?)
    }
}

/// Returns the error for a recording that a signal has already finished.
fn stopped() -> FormatError {
    FormatError::Os(ErrorKind::Interrupted.into())
}

/// Refuses a recording whose `NAME.mcap.part` exists: it is being written, or was cut off.
pub fn refuse_cut_off(path: &Path) -> Result<(), IoError> {
    let part = part_of(path);
    if part.symlink_metadata().is_err() {
        return Ok(());
    }
    let name = part.display();
    let problem = format!(
        "the recording is being written or was cut off; complete it with `planish recover {name}`, delete it, or \
         choose another name"
    );
    Err(IoError { path: part.clone(), problem: FormatError::Unsupported(problem) })
}

/// Returns depth in whole millimetres if the camera's unit is the millimetre, otherwise in metres, so that a topic has
/// one encoding and nothing is rounded.
fn depth_pixels(image: &DepthImage, camera: &Camera) -> DepthPixels {
    if camera.depth_units_per_metre == 1000.0 {
        return DepthPixels::Millimetres(image.clone());
    }
    let depth_m = image.raw.iter().map(|&raw| camera.depth_m(raw)).collect();
    DepthPixels::Metres { width: image.width, height: image.height, depth_m }
}
