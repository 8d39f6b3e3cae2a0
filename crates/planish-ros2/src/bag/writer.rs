//! Writes frames as a recording: depth images with their camera, or clouds.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{BufWriter, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError, Weak};
use std::time::{Duration, Instant};

use mcap::records::MessageHeader;
use mcap::{McapError, WriteOptions, Writer};

use super::recover::{complete_in_place, part_of};
use super::schemas::{
    CAMERA_INFO, CAMERA_INFO_TYPE, CLOUD, CLOUD_TYPE, IMAGE, IMAGE_TYPE, MESSAGE_ENCODING, PROFILE, SCHEMA_ENCODING,
};
use super::{MAGIC, of_mcap};
use crate::ros::{CameraInfo, DepthPixels, Header, Image, PointCloud2, Time, camera_info_topic, to_cdr};
use planish_core::{Camera, DepthImage, Error, FormatError, IoError, OwnedFrame};
use planish_io::ReadOptions;
use planish_io::internal::check_target;

/// Topics of frames: names that depth_image_proc and RViz expect.
const RECTIFIED_TOPIC: &str = "/camera/depth/image_rect";
const RAW_TOPIC: &str = "/camera/depth/image_raw";
const COLOUR_TOPIC: &str = "/camera/rgb/image_rect_color";
const ORIGIN_TOPIC: &str = "/camera/depth/origin";
const POINTS_TOPIC: &str = "/camera/depth/points";
const FRAME_ID: &str = "camera_depth_optical_frame";

/// For frames without time stamps.
const FRAMES_PER_SECOND: f64 = 30.0;

/// Metadata that rosbag2 expects of a channel; empty, since the publisher's QoS is unknown.
pub(super) fn channel_metadata() -> BTreeMap<String, String> {
    BTreeMap::from([("offered_qos_profiles".to_owned(), String::new())])
}

/// Recordings that are being written, to be finished when the process has to end.
static OPEN: Mutex<Vec<Weak<Mutex<Option<Open>>>>> = Mutex::new(Vec::new());

/// How long to wait for a frame that is being written when the process has to end.
const PATIENCE: Duration = Duration::from_secs(2);

/// Finishes all recordings that are being written, for a process that is about to end; later frames are errors.
pub fn finish_recordings() {
    let open = std::mem::take(&mut *OPEN.lock().unwrap_or_else(PoisonError::into_inner));
    let deadline = Instant::now() + PATIENCE;
    for recording in open.iter().filter_map(Weak::upgrade) {
        while let Err(TryLockError::WouldBlock) = recording.try_lock()
            && Instant::now() < deadline
        {
            std::thread::sleep(Duration::from_millis(5));
        }
        // Locked until it is done: its own thread may be about to end the process too.
        let mut recording = match recording.try_lock() {
            Ok(recording) => recording,
            Err(TryLockError::Poisoned(recording)) => recording.into_inner(),
            // Its frames until now are in NAME.mcap.part.
            Err(TryLockError::WouldBlock) => continue,
        };
        let _ = recording.take().map(Open::close);
    }
}

/// Writes frames to a recording. While it is written, its name is `NAME.mcap.part`, which other programs can read up to
/// the last frame; [`finish`](Self::finish) and dropping it give it its name. A process that is killed leaves the part,
/// which [`recover`](super::recover()) completes.
///
/// Depth is written to `/camera/depth/image_rect` (`image_raw` with distortion) with its `camera_info`: as 16UC1 if the
/// camera's unit is the millimetre, otherwise as 32FC1 in metres. Clouds are written to `/camera/depth/points`, and
/// colour registered to depth to `/camera/rgb/image_rect_color`, in the frame `camera_depth_optical_frame`. Stamps are
/// the frames' in microseconds (negative ones become 0), or 30 frames per second.
pub struct BagWriter {
    path: PathBuf,
    /// None once it is finished.
    open: Arc<Mutex<Option<Open>>>,
    frames: u32,
}

/// A recording that is being written.
struct Open {
    path: PathBuf,
    writer: Writer<BufWriter<File>>,
    channels: BTreeMap<String, u16>,
    has_failed: bool,
    has_frames: bool,
    /// The file, and its length after the last frame.
    file: File,
    whole_bytes: u64,
    /// Whether a recording that is not finished is worthless.
    is_all_or_nothing: bool,
}

impl BagWriter {
    /// Creates a recording.
    ///
    /// # Errors
    /// If `NAME.mcap.part` exists, a recording that was cut off: it is never overwritten.
    pub fn create(path: &Path) -> Result<Self, Error> {
        refuse_cut_off(path)?;
        let opened = || -> Result<_, FormatError> {
            check_target(path)?;
            let file = OpenOptions::new().read(true).write(true).create_new(true).open(part_of(path))?;
            let handle = file.try_clone()?;
            // A chunk is written in one go, with its length: what is in the file is never changed again.
            let options = WriteOptions::new().compression(None).disable_seeking(true).profile(PROFILE);
            let mut writer = options.create(BufWriter::new(file)).map_err(of_mcap)?;
            writer.flush().map_err(of_mcap)?;
            Ok((writer, handle))
        };
        let (writer, file) = opened().map_err(IoError::at(path))?;
        let open = Open {
            path: path.to_path_buf(),
            writer,
            file,
            whole_bytes: MAGIC.len() as u64,
            channels: BTreeMap::new(),
            has_failed: false,
            has_frames: false,
            is_all_or_nothing: false,
        };
        let open = Arc::new(Mutex::new(Some(open)));
        OPEN.lock().unwrap_or_else(PoisonError::into_inner).push(Arc::downgrade(&open));
        Ok(Self { path: path.to_path_buf(), open, frames: 0 })
    }

    /// Makes it a recording that is removed unless it is finished: of what can be computed again.
    pub fn all_or_nothing(self) -> Self {
        if let Some(open) = &mut *self.lock() {
            open.is_all_or_nothing = true;
        }
        self
    }

    fn lock(&self) -> MutexGuard<'_, Option<Open>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a depth image with its camera, whose unit may be any.
    pub fn add_depth(&mut self, image: &DepthImage, camera: &Camera, timestamp_s: Option<f64>) -> Result<(), Error> {
        camera.validate()?;
        camera.check_shape((image.width, image.height))?;
        let header = self.header(timestamp_s);
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
        let header = self.header(timestamp_s);
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
        let header = self.header(timestamp_s);
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

    /// Adds where the pixels of the depth image that is added next come from
    /// ([`Smoothed::origin_mask`](planish_core::Smoothed::origin_mask)), on `/camera/depth/origin`.
    pub fn add_origin(&mut self, shape: (usize, usize), mask: Vec<u8>, timestamp_s: Option<f64>) -> Result<(), Error> {
        let header = self.header(timestamp_s);
        let image = Image::of_origins(header.clone(), shape, mask);
        Ok(self.write(ORIGIN_TOPIC, IMAGE_TYPE, IMAGE, &header, to_cdr(&image))?)
    }

    /// Adds a frame as its source gave it.
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

    /// Completes the recording and gives it its name.
    pub fn finish(self) -> Result<(), Error> {
        // Locked until it is done: the process may be about to end.
        let mut open = self.lock();
        let finished = open.take().map_or(Ok(()), Open::finish);
        drop(open);
        Ok(finished.map_err(IoError::at(&self.path))?)
    }

    fn header(&self, timestamp_s: Option<f64>) -> Header {
        let seconds = timestamp_s.unwrap_or(f64::from(self.frames) / FRAMES_PER_SECOND);
        // As f64 seconds, a recent date cannot represent nanoseconds.
        Header { stamp: Time::from_nanoseconds(1000 * (1e6 * seconds).round() as u64), frame_id: FRAME_ID.into() }
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
            return Err(IoError::at(&self.path)(FormatError::Os(ErrorKind::Interrupted.into())));
        };
        let result = message.and_then(|bytes| open.write(topic, (type_name, definition), header, self.frames, &bytes));
        result.map_err(IoError::at(&self.path))
    }

    /// Ends a frame: from here on it is in the file.
    fn end_frame(&mut self) -> Result<(), IoError> {
        self.frames += 1;
        if let Some(open) = &mut *self.lock() {
            open.has_frames = true;
            let mut flush = || -> Result<u64, FormatError> {
                open.writer.flush().map_err(of_mcap)?;
                Ok(open.file.metadata()?.len())
            };
            match flush() {
                Ok(bytes) => open.whole_bytes = bytes,
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

    /// Completes it, or removes it where nobody would miss it.
    fn close(self) -> Result<(), FormatError> {
        if self.has_frames && !self.is_all_or_nothing {
            return self.finish();
        }
        let part = part_of(&self.path);
        drop(self);
        Ok(std::fs::remove_file(part)?)
    }

    fn finish(mut self) -> Result<(), FormatError> {
        let part = part_of(&self.path);
        let finished = if self.has_failed { Err(McapError::AttemptedWriteAfterFailure) } else { self.writer.finish() };
        let path = self.path.clone();
        // The rest of its buffer goes out here, if it can.
        drop(self.writer);
        if finished.is_err() {
            // A full disk: what is whole gets an index in the place of what is not.
            self.file.set_len(self.whole_bytes)?;
            complete_in_place(&part, &ReadOptions::default())?;
        }
        if path.symlink_metadata().is_ok() && !path.is_file() {
            return Err(FormatError::Unsupported(format!("its name was taken meanwhile; it is {}", part.display())));
        }
        Ok(std::fs::rename(&part, &path)?)
    }
}

/// Refuses a recording whose `NAME.mcap.part` exists: it is being written, or was cut off.
pub fn refuse_cut_off(path: &Path) -> Result<(), IoError> {
    let part = part_of(path);
    if part.symlink_metadata().is_err() {
        return Ok(());
    }
    let name = part.display();
    let problem = format!(
        "a recording that is being written or was cut off; complete it with `planish recover {name}`, or choose another \
         name"
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
