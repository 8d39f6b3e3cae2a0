//! Writes frames as a recording: depth images with their camera, or clouds.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;
use mcap::{WriteOptions, Writer};

use super::of_mcap;
use super::schemas::{
    CAMERA_INFO, CAMERA_INFO_TYPE, CLOUD, CLOUD_TYPE, IMAGE, IMAGE_TYPE, MESSAGE_ENCODING, PROFILE, SCHEMA_ENCODING,
};
use crate::ros::{CameraInfo, DepthPixels, Header, Image, PointCloud2, Time, camera_info_topic, to_cdr};
use planish_core::{Camera, DepthImage, Error, FormatError, IoError, OwnedFrame};
use planish_io::internal::AtomicFile;

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

/// Writes frames to a recording, which is there whole after [`finish`](Self::finish) or not at all.
///
/// Depth is written to `/camera/depth/image_rect` (`image_raw` with distortion) with its `camera_info`: as 16UC1 if the
/// camera's unit is the millimetre, otherwise as 32FC1 in metres. Clouds are written to `/camera/depth/points`, and
/// colour registered to depth to `/camera/rgb/image_rect_color`, in the frame `camera_depth_optical_frame`. Stamps are
/// the frames' in microseconds (negative ones become 0), or 30 frames per second.
pub struct BagWriter {
    path: PathBuf,
    whole: AtomicFile,
    writer: Writer<BufWriter<File>>,
    channels: BTreeMap<String, u16>,
    frames: u32,
}

impl BagWriter {
    /// Creates a recording.
    pub fn create(path: &Path) -> Result<Self, Error> {
        let opened = || -> Result<_, FormatError> {
            let whole = AtomicFile::new(path)?;
            let file = BufWriter::new(whole.file().try_clone()?);
            let writer = WriteOptions::new().profile(PROFILE).create(file).map_err(of_mcap)?;
            Ok((whole, writer))
        };
        let (whole, writer) = opened().map_err(IoError::at(path))?;
        Ok(Self { path: path.to_path_buf(), whole, writer, channels: BTreeMap::new(), frames: 0 })
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
        self.frames += 1;
        Ok(())
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
        self.frames += 1;
        Ok(())
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

    /// Completes the recording and puts it in its place.
    pub fn finish(mut self) -> Result<(), Error> {
        let finish = || -> Result<(), FormatError> {
            self.writer.finish().map_err(of_mcap)?;
            self.writer.into_inner().flush()?;
            self.whole.finish()
        };
        Ok(finish().map_err(IoError::at(&self.path))?)
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
        let result = message.and_then(|bytes| {
            let channel_id = match self.channels.get(topic) {
                Some(channel) => *channel,
                None => {
                    let schema =
                        self.writer.add_schema(type_name, SCHEMA_ENCODING, definition.as_bytes()).map_err(of_mcap)?;
                    let metadata = channel_metadata();
                    let added = self.writer.add_channel(schema, topic, MESSAGE_ENCODING, &metadata);
                    *self.channels.entry(topic.to_owned()).or_insert(added.map_err(of_mcap)?)
                }
            };
            let time = header.stamp.nanoseconds();
            let header = MessageHeader { channel_id, sequence: self.frames, log_time: time, publish_time: time };
            self.writer.write_to_known_channel(&header, &bytes).map_err(of_mcap)
        });
        result.map_err(IoError::at(&self.path))
    }
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
