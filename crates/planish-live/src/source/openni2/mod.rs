//! OpenNI2 cameras (Xtion, Carmine, Astra, Structure), and recordings of them, through the OpenNI2 library, loaded at
//! run time and never linked.
//!
//! The library is `libOpenNI2.so.0`, or the path in the environment variable PLANISH_LIBOPENNI2. Depth is mapped to
//! the colour camera if the device supports it and has colour images of the same size. The library reports fields of
//! view but no intrinsics: the focal lengths are computed from the fields of view, and the principal point is assumed
//! at the centre. Mirrored images are flipped back. A live camera delivers its newest frame, and gaps in frame
//! numbers are counted as dropped. A recording (.oni) delivers every depth frame in order; frames that the library
//! loses are also counted as dropped.

mod api;
mod device;

use std::ffi::c_int;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use super::silence::longest_silence;
use super::{Alignment, OwnedFrame, Source, StreamMode, malformed, with_shape};
use api::{Frame, Functions, Handle, Holder, VideoMode};
use device::{Device, Stream, Watch};
use planish_core::{Camera, DepthFrame, DeviceError, Error, IoError, ParamError};

/// Interval in milliseconds at which a wait checks whether a frame is still wanted.
const PATIENCE_MS: c_int = 100;

/// Maximum gap in frame numbers that counts as lost frames.
const MOST_LOST: u64 = 10_000;

/// The playback speed at which a recording waits until its frames are taken.
const AS_TAKEN: f32 = -1.0;

/// A running OpenNI2 camera, or a recording of one.
pub struct OpenNi2Source {
    library: &'static Functions,
    /// The caller's camera, which replaces the one derived from the device's field of view.
    camera: Option<Camera>,
    description: String,
    recording: Option<PathBuf>,
    rgb: Option<Image>,
    last_index: Option<u64>,
    /// True once a recording is over: at its end, or after an error, which is returned only once.
    has_ended: bool,
    dropped: u64,
    ended: Arc<AtomicBool>,
    /// The stream of colour images, if depth is mapped to them. Streams are closed before the device, in field order.
    color: Option<Stream>,
    depth: Stream,
    watch: Watch,
    _device: Device,
}

/// Result of waiting for the streams.
enum Polled {
    Depth(DepthFrame),
    Color,
    Nothing,
}

struct Image {
    width: usize,
    height: usize,
    bytes: Vec<u8>,
}

impl OpenNi2Source {
    /// Opens the device or recording with a URI; an empty URI selects the first device. By default, depth is 640x480
    /// at 30 frames per second, mapped to colour if possible.
    pub fn open(
        uri: &str,
        camera: Option<Camera>,
        alignment: Option<Alignment>,
        mode: Option<StreamMode>,
    ) -> Result<Self, Error> {
        if alignment == Some(Alignment::Depth) {
            let allowed = "color or none, since OpenNI2 can only map depth to colour";
            return Err(ParamError { field: "align", value: "depth".into(), allowed }.into());
        }
        let recording = Self::is_recording(uri).then(|| PathBuf::from(uri));
        if let Some(file) = &recording {
            // The library's error does not say whether the file exists.
            std::fs::File::open(file).map_err(|error| IoError { path: file.clone(), problem: error.into() })?;
            if let Some(mode) = mode {
                let allowed = "a recording has a fixed mode; omit mode";
                return Err(ParamError { field: "mode", value: mode.to_string(), allowed }.into());
            }
        }
        let library = Functions::load()?;
        let device = Device::open(library, uri).map_err(|error| named(recording.as_deref(), error.into()))?;
        let started = Self::start(library, device, camera, recording.clone(), alignment, mode);
        started.map_err(|error| named(recording.as_deref(), error))
    }

    /// Returns true if a URI names a recording.
    pub(super) fn is_recording(uri: &str) -> bool {
        device::is_recording(uri)
    }

    fn start(
        library: &'static Functions,
        device: Device,
        camera: Option<Camera>,
        recording: Option<PathBuf>,
        alignment: Option<Alignment>,
        mode: Option<StreamMode>,
    ) -> Result<Self, Error> {
        let of_device = Holder::Device(device.handle);
        let (description, uri) = library.info_of(device.handle).unwrap_or_default();
        let watch = Watch::start(library, uri)?;
        let depth = Stream::create(library, device.handle, api::SENSOR_DEPTH, "the device has no depth sensor")?;
        if recording.is_some() {
            library.set(of_device, api::PLAYBACK_REPEAT, 0)?;
            library.set(of_device, api::PLAYBACK_SPEED, AS_TAKEN)?;
        } else {
            let modes = library.modes_of(device.handle, api::SENSOR_DEPTH);
            if let Some(mode) = mode_of(&modes, mode)? {
                depth.set_mode(mode)?;
            }
        }
        // Map depth to colour only if colour is delivered; otherwise the camera of the depth image would be unknown. A
        // recording does not state whether its depth was mapped, but the caller can state this with `alignment`.
        let wants_colour = alignment.map_or(recording.is_none(), |alignment| alignment == Alignment::Colour);
        let color =
            if wants_colour { colour_stream(library, device.handle, &depth, recording.is_some()) } else { None };
        let is_registered = color.is_some() && (recording.is_some() || register(library, device.handle));
        let color = color.filter(|_| is_registered);
        if !is_registered && recording.is_none() {
            // Another program may have left the mapping on.
            let _ = library.set(of_device, api::IMAGE_REGISTRATION, 0);
        }
        if alignment == Some(Alignment::Colour) && !is_registered {
            let what = format!("{description} cannot map depth to colour images of its size; use align none");
            return Err(DeviceError::Failed { what }.into());
        }
        for stream in std::iter::once(&depth).chain(&color) {
            // Some devices do not allow mirroring to be set; images that are still mirrored are flipped back.
            let _ = library.set(Holder::Stream(stream.handle), api::MIRRORING, 0);
            stream.start()?;
        }
        Ok(Self {
            library,
            camera,
            description,
            recording,
            rgb: None,
            last_index: None,
            has_ended: false,
            dropped: 0,
            ended: Arc::default(),
            color,
            depth,
            watch,
            _device: device,
        })
    }

    /// Waits for a frame of either stream. A colour frame is kept for the next depth frames.
    fn poll(&mut self) -> Result<Polled, Error> {
        let mut streams: Vec<Handle> = std::iter::once(&self.depth).chain(&self.color).map(|s| s.handle).collect();
        let mut ready = -1;
        let count = streams.len() as c_int;
        // SAFETY: the streams are open.
        let status =
            unsafe { (self.library.WaitForAnyStream)(streams.as_mut_ptr(), count, &raw mut ready, PATIENCE_MS) };
        if status == api::STATUS_TIME_OUT {
            return Ok(Polled::Nothing);
        }
        self.library.check("the camera failed", status)?;
        if ready == 0 {
            let frame = self.depth.read()?;
            return Ok(Polled::Depth(self.depth_frame(&frame)?));
        }
        if let Some(color) = &self.color {
            let frame = color.read()?;
            if frame.mode.format == api::RGB888 {
                self.rgb = Some(Image::of(&frame, 3, color.is_mirrored())?);
            }
        }
        Ok(Polled::Color)
    }

    fn depth_frame(&mut self, frame: &Frame) -> Result<DepthFrame, Error> {
        let units_per_metre = match frame.mode.format {
            api::DEPTH_1_MM => 1000.0,
            api::DEPTH_100_UM => 10_000.0,
            format => {
                let what = format!("unsupported OpenNI2 depth format {format}; expected 1 mm (100) or 0.1 mm (101)");
                return Err(DeviceError::Failed { what }.into());
            }
        };
        let Image { width, height, bytes } = Image::of(frame, 2, self.depth.is_mirrored())?;
        let camera = match self.camera {
            Some(camera) => with_shape(camera, (width, height)),
            None => self.camera_of(frame)?,
        };
        camera.check_shape((width, height))?;
        let raw = bytes.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]])).collect();
        let mut depth = DepthFrame::new(camera.with_depth_units_per_metre(units_per_metre), raw)?;
        let index = u64::try_from(frame.index).unwrap_or(0);
        let lost = self.last_index.replace(index).and_then(|last| index.checked_sub(last + 1));
        self.dropped += lost.filter(|&lost| lost <= MOST_LOST).unwrap_or(0);
        let rgb = self.rgb.as_ref().filter(|image| (image.width, image.height) == (width, height));
        depth.rgb = rgb.map(|image| image.bytes.clone());
        Ok(depth.with_timestamp_s(1e-6 * frame.timestamp_us as f64))
    }

    /// Returns the camera derived from the stated field of view: the colour camera if depth is mapped to it,
    /// otherwise the depth camera.
    fn camera_of(&self, frame: &Frame) -> Result<Camera, DeviceError> {
        let stream = self.color.as_ref().unwrap_or(&self.depth);
        let angle = |property| {
            let angle = self.library.get::<f32>(Holder::Stream(stream.handle), property).map(f64::from);
            angle.filter(|angle| (0.01..3.0).contains(angle))
        };
        let focal_length = |pixels: c_int, angle: f64| 0.5 * f64::from(pixels) / (0.5 * angle).tan();
        let VideoMode { width, height, .. } = frame.mode;
        let Some(fx) = angle(api::HORIZONTAL_FOV).map(|angle| focal_length(width, angle)) else {
            let what = format!("{} reports no field of view", self.description);
            return Err(DeviceError::Driver { what, help: "give its intrinsics (camera) as FX,FY,CX,CY" });
        };
        let fy = angle(api::VERTICAL_FOV).map_or(fx, |angle| focal_length(height, angle));
        let (mut cx, mut cy) = (0.5 * f64::from(width - 1), 0.5 * f64::from(height - 1));
        if frame.is_cropped != 0 {
            cx -= f64::from(frame.crop_x);
            cy -= f64::from(frame.crop_y);
        }
        Ok(Camera::new((size(frame.width), size(frame.height)), [fx, fy], [cx, cy]))
    }
}

impl OpenNi2Source {
    fn wait_for_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        let deadline = Instant::now() + longest_silence();
        while !self.ended.load(Ordering::Relaxed) {
            // Checked before waiting: a frame that arrives after the end of the recording is its last.
            let is_over = self.watch.is_over();
            match self.poll()? {
                Polled::Depth(frame) => return Ok(Some(OwnedFrame::Depth(frame))),
                Polled::Nothing if is_over => return self.over(),
                // Colour may continue without depth.
                Polled::Color | Polled::Nothing if Instant::now() >= deadline => return Err(self.silent()),
                Polled::Color | Polled::Nothing => {}
            }
        }
        Ok(None)
    }

    /// Returns the result at the end of the source: `None` for a recording with frames, otherwise an error.
    fn over(&self) -> Result<Option<OwnedFrame>, Error> {
        match &self.recording {
            Some(_) if self.last_index.is_some() => Ok(None),
            Some(file) => Err(malformed(file, "the recording contains no depth that OpenNI2 can play").into()),
            None => Err(DeviceError::Gone { what: format!("{} was disconnected", self.description) }.into()),
        }
    }

    /// Returns the error for a source that has been silent for too long.
    fn silent(&self) -> Error {
        let what = format!("{} delivered no depth for {} s", self.description, longest_silence().as_secs());
        match &self.recording {
            Some(file) => malformed(file, format!("{what}; the recording is truncated")).into(),
            None => DeviceError::Gone { what }.into(),
        }
    }
}

impl Source for OpenNi2Source {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        if self.has_ended {
            return Ok(None);
        }
        let result = self.wait_for_frame();
        // An error in a recording is permanent.
        self.has_ended = self.recording.is_some() && !matches!(result, Ok(Some(_)));
        result.map_err(|error| named(self.recording.as_deref(), error))
    }

    fn dropped(&self) -> u64 {
        self.dropped
    }

    fn is_live(&self) -> bool {
        self.recording.is_none()
    }

    fn end_with(&mut self, ended: Arc<AtomicBool>) {
        self.ended = ended;
    }

    fn description(&self) -> Option<String> {
        Some(self.description.clone())
    }
}

/// Returns the mode to set: the requested one, or 640x480 at 30 frames per second if available, with depth units of 1
/// mm or 0.1 mm.
fn mode_of(modes: &[VideoMode], asked: Option<StreamMode>) -> Result<Option<VideoMode>, DeviceError> {
    let usable = |mode: &&VideoMode| matches!(mode.format, api::DEPTH_1_MM | api::DEPTH_100_UM);
    let wanted = asked.unwrap_or(StreamMode { width: 640, height: 480, fps: Some(30) });
    let is_wanted = |mode: &&VideoMode| {
        let rate = wanted.fps.is_none_or(|fps| u32::try_from(mode.fps) == Ok(fps));
        (size(mode.width), size(mode.height)) == (wanted.width, wanted.height) && rate
    };
    match (modes.iter().filter(usable).find(is_wanted), asked) {
        (Some(mode), _) => Ok(Some(*mode)),
        (None, None) => Ok(None),
        (None, Some(asked)) => {
            let text = |mode: &VideoMode| format!("{}x{}@{}", mode.width, mode.height, mode.fps);
            let mut there: Vec<String> = modes.iter().filter(usable).map(text).collect();
            there.dedup();
            Err(DeviceError::Failed {
                what: format!("the camera has no depth mode {asked}; available are {}", there.join(", ")),
            })
        }
    }
}

/// Makes a device map depth to its colour camera; returns false if it cannot.
fn register(library: &Functions, device: Handle) -> bool {
    // SAFETY: the device is open.
    let can = unsafe { (library.DeviceIsImageRegistrationModeSupported)(device, api::DEPTH_TO_COLOR) != 0 };
    can && library.set(Holder::Device(device), api::IMAGE_REGISTRATION, api::DEPTH_TO_COLOR).is_ok()
}

/// Opens a stream of colour images with the size of the depth images; `None` if the device has none.
fn colour_stream(library: &'static Functions, device: Handle, depth: &Stream, is_recording: bool) -> Option<Stream> {
    let color = Stream::create(library, device, api::SENSOR_COLOR, "the device has no colour sensor").ok()?;
    let of_depth: VideoMode = library.get(Holder::Stream(depth.handle), api::VIDEO_MODE)?;
    let fits =
        |mode: &VideoMode| (mode.format, mode.width, mode.height) == (api::RGB888, of_depth.width, of_depth.height);
    let modes = library.modes_of(device, api::SENSOR_COLOR);
    let mode =
        modes.iter().find(|mode| fits(mode) && mode.fps == of_depth.fps).or(modes.iter().find(|mode| fits(mode)));
    match mode {
        Some(mode) if !is_recording => color.set_mode(*mode).ok()?,
        _ => {}
    }
    library.get(Holder::Stream(color.handle), api::VIDEO_MODE).filter(fits).map(|_| color)
}

/// Adds the name of the recording to a device error.
fn named(recording: Option<&Path>, error: Error) -> Error {
    match (recording, error) {
        (Some(file), Error::Device(error)) => {
            malformed(file, format!("the recording cannot be played: {error}")).into()
        }
        (_, error) => error,
    }
}

fn size(value: c_int) -> usize {
    usize::try_from(value).unwrap_or(0)
}

impl Image {
    /// Copies a frame's rows without their padding, flipped if the device mirrors them.
    fn of(frame: &Frame, bytes_a_pixel: usize, is_mirrored: bool) -> Result<Self, DeviceError> {
        let (width, height, stride) = (size(frame.width), size(frame.height), size(frame.stride));
        let (row, bytes) = (width * bytes_a_pixel, size(frame.bytes));
        if frame.data.is_null() || row == 0 || height == 0 || row > stride || bytes < stride * (height - 1) + row {
            let what = format!("a frame of {width}x{height} pixels, {stride} bytes per row, has {bytes} bytes");
            return Err(DeviceError::Failed { what });
        }
        // SAFETY: the frame has this many bytes, and is released only after they are copied.
        let data = unsafe { std::slice::from_raw_parts(frame.data.cast::<u8>(), bytes) };
        let mut image = Vec::with_capacity(row * height);
        for line in data.chunks(stride).take(height) {
            if is_mirrored {
                line[..row].rchunks_exact(bytes_a_pixel).for_each(|pixel| image.extend_from_slice(pixel));
            } else {
                image.extend_from_slice(&line[..row]);
            }
        }
        Ok(Self { width, height, bytes: image })
    }
}
