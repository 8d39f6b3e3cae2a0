//! Intel RealSense cameras, and recordings of them, through librealsense2, loaded at run time and never linked.
//!
//! The library is `librealsense2.so`, or the path in the environment variable PLANISH_LIBREALSENSE. Its pipeline uses
//! the device's default modes, or the requested one, and pairs depth and colour by time; its `align` maps one onto
//! the other. A live camera delivers its newest frames, and gaps in frame numbers are counted as dropped. A recording
//! delivers every depth frame once, paired with the colour image closest in time; depth before the first and after
//! the last colour image is delivered without colour ([`all_depth`]). Depth mapped onto colour is delivered only with
//! colour.

mod all_depth;
mod api;
mod camera;
mod input;
mod start;

use std::ffi::c_int;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::silence::longest_silence;
use super::{Alignment, OwnedFrame, Source, StreamMode, malformed, with_shape};
use all_depth::AllDepth;
use api::{Functions, Intrinsics, Owned, STREAM_COLOR, STREAM_DEPTH};
use camera::camera_of;
pub use input::RealSenseInput;
use planish_core::{Camera, DepthFrame, DeviceError, Error, IoError, ParamError};
use start::{Colour, Started, check_device, start};

/// Interval at which a wait checks whether a frame is still wanted.
const PATIENCE: Duration = Duration::from_millis(100);

/// Number of waits of [`PATIENCE`] without a frame after which a recording is over once its player has stopped.
const WAITS_AT_END: u32 = 5;

/// Maximum gap in frame numbers that counts as lost frames.
const MOST_LOST: u64 = 10_000;

/// A running RealSense camera, or a recording of one.
pub struct RealSenseSource {
    library: &'static Functions,
    /// The caller's camera, which replaces the device's own.
    camera: Option<Camera>,
    description: String,
    recording: Option<PathBuf>,
    aligner: Option<Aligner>,
    held: Option<Held>,
    /// A second player, which delivers all depth frames, for a recording whose colour is mapped onto depth.
    all_depth: Option<AllDepth>,
    /// True once a recording has begun.
    has_begun: bool,
    /// Number of frames delivered.
    delivered: u64,
    /// True once a recording is over: at its end, or after an error, which is returned only once.
    is_over: bool,
    last_number: Option<u64>,
    last_camera: Option<(Intrinsics, f32, Camera)>,
    dropped: u64,
    ended: Arc<AtomicBool>,
    device: Owned,
    _profile: Owned,
    pipeline: Owned,
    _context: Owned,
}

/// Depth and colour frames of a recording, held in case a colour image follows that is closer in time.
struct Held {
    /// Number of the depth frame.
    number: u64,
    /// Time between the depth and the colour frame, in milliseconds.
    apart_ms: f64,
    frames: Owned,
}

/// A processing block that maps colour onto depth, or depth onto colour.
struct Aligner {
    /// The stream onto which the other one is mapped.
    to: c_int,
    block: Owned,
    queue: Owned,
}

impl RealSenseSource {
    /// Starts a camera or a recording. `camera` replaces the device's intrinsics. By default, the device's default
    /// mode is used, and colour is mapped onto depth if available.
    pub fn open(
        input: &RealSenseInput,
        camera: Option<Camera>,
        alignment: Option<Alignment>,
        mode: Option<StreamMode>,
    ) -> Result<Self, Error> {
        let library = Functions::load()?;
        let context = library.create_context()?;
        match input {
            // The library's error does not say whether the file exists.
            RealSenseInput::Recording(file) => {
                std::fs::File::open(file).map_err(|error| IoError { path: file.clone(), problem: error.into() })?;
            }
            RealSenseInput::Any => check_device(&library.devices(&context)?, None)?,
            RealSenseInput::Serial(serial) => check_device(&library.devices(&context)?, Some(serial))?,
        }
        let pipeline = library.create_pipeline(&context)?;
        Self::start(library, context, pipeline, input, camera, alignment, mode)
    }

    fn start(
        library: &'static Functions,
        context: Owned,
        pipeline: Owned,
        input: &RealSenseInput,
        camera: Option<Camera>,
        alignment: Option<Alignment>,
        mode: Option<StreamMode>,
    ) -> Result<Self, Error> {
        let recording = match input {
            RealSenseInput::Recording(file) => Some(file.clone()),
            _ => None,
        };
        if let (Some(mode), Some(_)) = (mode, &recording) {
            let allowed = "a recording has a fixed mode; omit mode";
            return Err(ParamError { field: "mode", value: mode.to_string(), allowed }.into());
        }
        let named = |error: DeviceError| named(recording.as_deref(), error.into());
        let Started { device, profile, colour } = start(library, &pipeline, input, alignment, mode).map_err(named)?;
        let to = if alignment == Some(Alignment::Colour) { STREAM_COLOR } else { STREAM_DEPTH };
        let aligner = (colour != Colour::None).then(|| Aligner::new(library, to)).transpose()?;
        let all_depth = match &recording {
            Some(_) if colour != Colour::None && to == STREAM_DEPTH => {
                let player = Self::open(input, camera, Some(Alignment::None), None)?;
                Some(AllDepth::new(Box::new(player)))
            }
            _ => None,
        };
        let name = library.name_of(&device);
        let mut description = match name.serial.as_str() {
            "" => name.name,
            serial => format!("{}, serial number {serial}", name.name),
        };
        if alignment != Some(Alignment::None) && colour == Colour::None {
            description += ", without colour";
        }
        Ok(Self {
            library,
            camera,
            description,
            recording,
            aligner,
            held: None,
            all_depth,
            has_begun: false,
            delivered: 0,
            is_over: false,
            last_number: None,
            last_camera: None,
            dropped: 0,
            ended: Arc::default(),
            device,
            _profile: profile,
            pipeline,
            _context: context,
        })
    }

    /// Returns frames whose depth has not been delivered yet. Holds them back while the same depth may still arrive
    /// with a colour image that is closer in time.
    fn take(&mut self, frames: Owned) -> Result<Option<Owned>, DeviceError> {
        let Some(depth) = self.library.frame_of(&frames, STREAM_DEPTH)? else { return Ok(None) };
        // SAFETY: the frame outlives the call.
        let number = |f: &Functions, e| unsafe { (f.get_frame_number)(depth.get(), e) };
        let number = self.library.call("a frame has no number", number)?;
        if self.recording.is_some() && self.aligner.is_some() {
            // The same depth may arrive again with the next colour image.
            let apart_ms = match self.library.frame_of(&frames, STREAM_COLOR)? {
                Some(colour) => (self.timestamp_ms(&depth)? - self.timestamp_ms(&colour)?).abs(),
                None => f64::INFINITY,
            };
            return Ok(match self.held.take() {
                Some(held) if held.number == number && held.apart_ms <= apart_ms => {
                    self.held = Some(held);
                    None
                }
                held => {
                    self.held = Some(Held { number, apart_ms, frames });
                    held.filter(|held| held.number != number).map(|held| held.frames)
                }
            });
        }
        let last = self.last_number.replace(number);
        if last == Some(number) {
            return Ok(None);
        }
        let lost = last.and_then(|last| number.checked_sub(last + 1)).filter(|&lost| lost <= MOST_LOST);
        self.dropped += if self.recording.is_none() { lost.unwrap_or(0) } else { 0 };
        Ok(Some(frames))
    }

    fn timestamp_ms(&self, frame: &Owned) -> Result<f64, DeviceError> {
        // SAFETY: the frame outlives the call.
        let call = |f: &Functions, e| unsafe { (f.get_frame_timestamp)(frame.get(), e) };
        self.library.call("a frame has no timestamp", call)
    }

    /// Returns depth and colour as one frame; `None` if depth cannot be aligned because colour has not arrived yet.
    fn frame_from(&mut self, frames: Owned) -> Result<Option<OwnedFrame>, Error> {
        let library = self.library;
        let what = "a depth frame cannot be read";
        let Some(depth) = library.frame_of(&frames, STREAM_DEPTH)? else { return Ok(None) };
        // SAFETY: the frame outlives the call.
        let units = |f: &Functions, e| unsafe { (f.depth_frame_get_units)(depth.get(), e) };
        let metres_per_unit = library.call(what, units)?;
        let timestamp_s = 1e-3 * self.timestamp_ms(&depth)?;
        let colour = library.frame_of(&frames, STREAM_COLOR)?;
        let (depth, colour) = match (&self.aligner, colour) {
            (Some(aligner), Some(_)) => {
                drop(depth);
                let frames = library.process(&aligner.block, &aligner.queue, frames)?;
                (library.frame_of(&frames, STREAM_DEPTH)?, library.frame_of(&frames, STREAM_COLOR)?)
            }
            (Some(aligner), None) if aligner.to == STREAM_COLOR => return Ok(None),
            (_, _) => (Some(depth), None),
        };
        let Some(depth) = depth else { return Ok(None) };
        let camera = self.camera_of(&depth, metres_per_unit)?;
        let (width, height, raw) = library.image_of(&depth, 2, self.recording.is_some())?;
        camera.check_shape((width, height))?;
        let raw = raw.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]])).collect();
        let mut frame = DepthFrame::new(camera, raw)?.with_timestamp_s(timestamp_s);
        if let Some(colour) = colour {
            let (colour_width, colour_height, rgb) = library.image_of(&colour, 3, self.recording.is_some())?;
            if (colour_width, colour_height) == (width, height) {
                frame = frame.with_rgb(rgb);
            }
        }
        Ok(Some(OwnedFrame::Depth(frame)))
    }

    /// Returns the camera of a depth frame: the caller's if given, otherwise the device's. The depth units are the
    /// device's.
    fn camera_of(&mut self, depth: &Owned, metres_per_unit: f32) -> Result<Camera, DeviceError> {
        let intrinsics = self.library.intrinsics_of(depth)?;
        if let Some((of, units, camera)) = &self.last_camera
            && (of, *units) == (&intrinsics, metres_per_unit)
        {
            return Ok(*camera);
        }
        let is_aligned = self.aligner.as_ref().is_some_and(|aligner| aligner.to == STREAM_COLOR);
        let of_device = camera_of(&intrinsics, metres_per_unit, is_aligned)?;
        let given = self.camera.map(|camera| with_shape(camera, (of_device.width, of_device.height)));
        let units = of_device.depth_units_per_metre;
        let camera = given.map_or(of_device, |camera| camera.with_depth_units_per_metre(units));
        self.last_camera = Some((intrinsics, metres_per_unit, camera));
        Ok(camera)
    }
}

impl RealSenseSource {
    fn wait_for_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        let deadline = Instant::now() + longest_silence();
        let mut quiet = 0;
        while !self.ended.load(Ordering::Relaxed) {
            // Checked before waiting: a frame that arrives after the end of the recording is its last.
            let is_playing = self.recording.is_none() || self.library.is_playing(&self.device);
            let frames = match self.library.wait(&self.pipeline, PATIENCE)? {
                Some(frames) => {
                    (self.has_begun, quiet) = (true, 0);
                    self.take(frames)?
                }
                // Frames may still be in transit within the library after its player has stopped.
                None if self.has_begun && !is_playing => {
                    quiet += 1;
                    match self.held.take_if(|_| quiet >= WAITS_AT_END) {
                        Some(held) => Some(held.frames),
                        None if quiet < WAITS_AT_END => None,
                        None if self.delivered == 0 => return Err(self.empty()),
                        None => return Ok(None),
                    }
                }
                None => None,
            };
            self.has_begun |= self.recording.is_some() && is_playing;
            if let Some(frames) = frames
                && let Some(frame) = self.frame_from(frames)?
            {
                self.delivered += 1;
                return Ok(Some(frame));
            }
            // Other streams may continue without depth.
            if Instant::now() >= deadline {
                // The held frame is complete.
                let last = self.held.take().map(|held| self.frame_from(held.frames)).transpose()?.flatten();
                return last.map_or_else(|| Err(self.silent()), |frame| Ok(Some(frame)));
            }
        }
        Ok(None)
    }

    /// Returns advice for an error message, in case the library waits for colour.
    fn advice(&self) -> &'static str {
        if self.aligner.is_some() { "; align none plays depth without colour" } else { "" }
    }

    /// Returns the error for a recording that delivered no frame.
    fn empty(&self) -> Error {
        let file = self.recording.as_deref().unwrap_or(Path::new(""));
        let what = if self.aligner.is_some() { "no depth with matching colour" } else { "no depth" };
        malformed(file, format!("the recording contains {what}, or is damaged{}", self.advice())).into()
    }

    /// Returns the error for a source that has been silent for too long.
    fn silent(&self) -> Error {
        let what = format!("{} delivered no depth for {} s", self.description, longest_silence().as_secs());
        match &self.recording {
            Some(file) => {
                malformed(file, format!("{what}; the recording or one of its streams is truncated{}", self.advice()))
                    .into()
            }
            None => DeviceError::Gone { what }.into(),
        }
    }
}

impl Source for RealSenseSource {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        if self.is_over {
            return Ok(None);
        }
        let result = match self.all_depth.take() {
            Some(mut all_depth) => {
                let result = all_depth.next_frame(|| self.wait_for_frame());
                self.all_depth = Some(all_depth);
                result
            }
            None => self.wait_for_frame(),
        };
        // An error in a recording is permanent.
        self.is_over = self.recording.is_some() && !matches!(result, Ok(Some(_)));
        result.map_err(|error| named(self.recording.as_deref(), error))
    }

    fn dropped(&self) -> u64 {
        self.dropped
    }

    fn is_live(&self) -> bool {
        self.recording.is_none()
    }

    fn end_with(&mut self, ended: Arc<AtomicBool>) {
        if let Some(all_depth) = &mut self.all_depth {
            all_depth.player.end_with(Arc::clone(&ended));
        }
        self.ended = ended;
    }

    fn description(&self) -> Option<String> {
        Some(self.description.clone())
    }
}

impl Drop for RealSenseSource {
    fn drop(&mut self) {
        // Frames are released before their pipeline. The pipeline of an unplugged camera cannot be stopped, and need
        // not be.
        self.held = None;
        // SAFETY: the pipeline is deleted after this.
        let _ = self.library.call("", |f, e| unsafe { (f.pipeline_stop)(self.pipeline.get(), e) });
    }
}

impl Aligner {
    fn new(library: &Functions, to: c_int) -> Result<Self, DeviceError> {
        let what = "depth and colour cannot be aligned";
        // SAFETY: the queue outlives the block's use of it, since both are dropped together.
        unsafe {
            let block = library.create(what, library.delete_processing_block, |f, e| (f.create_align)(to, e))?;
            let queue = library.create(what, library.delete_frame_queue, |f, e| (f.create_frame_queue)(1, e))?;
            library.call(what, |f, e| (f.start_processing_queue)(block.get(), queue.get(), e))?;
            Ok(Self { to, block, queue })
        }
    }
}

/// Starts the caller's pipeline, which may have a software device.
///
/// # Safety
/// The context and its pipeline must be objects of the library that PLANISH_LIBREALSENSE names. They must not be used
/// afterwards, since this function takes ownership.
#[cfg(feature = "internal")]
pub unsafe fn start_realsense(
    [context, pipeline]: [*mut std::ffi::c_void; 2],
    alignment: Option<Alignment>,
    mode: Option<StreamMode>,
) -> Result<RealSenseSource, Error> {
    let library = Functions::load()?;
    let [context, pipeline] = library.own(context, pipeline);
    RealSenseSource::start(library, context, pipeline, &RealSenseInput::Any, None, alignment, mode)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_behind_the_colon_is_a_file_or_a_serial_number() {
        assert_eq!(RealSenseInput::parse(""), RealSenseInput::Any);
        assert_eq!(RealSenseInput::parse("827112070000"), RealSenseInput::Serial("827112070000".into()));
        // Cargo runs tests in the folder of their crate.
        for file in ["a.bag", "folder/A.BAG", "walk.db3", "Cargo.toml"] {
            assert_eq!(RealSenseInput::parse(file), RealSenseInput::Recording(file.into()));
        }
    }
}
