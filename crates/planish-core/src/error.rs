//! The error types, by cause: the caller's parameters, the frame, the engine, a device, or a file.
//!
//! A pixel that cannot be smoothed is never an error: it has a [`Status`](crate::Status).

use std::path::Path;
use std::path::PathBuf;

/// A parameter outside its range.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field} = {} is not allowed: {allowed}", shortened(value))]
pub struct ParamError {
    /// The name of the field in the parameter struct, as in code.
    pub field: &'static str,
    /// The refused value.
    pub value: String,
    /// The allowed values.
    pub allowed: &'static str,
}

/// Converts a number of more than 40 characters to exponent form.
fn shortened(value: &str) -> String {
    const LONGEST: usize = 40;
    match value.parse::<f64>() {
        Ok(number) if value.len() > LONGEST => format!("{number:e}"),
        _ => value.to_owned(),
    }
}

/// Bytes in a KiB.
pub const KIB: u64 = 1 << 10;

/// Formats a number of bytes: in whole KiB below 10 MiB, otherwise in MiB with one decimal place.
pub fn memory(bytes: u64) -> String {
    let kib = bytes / KIB;
    if kib < 10 * KIB { format!("{kib} KiB") } else { format!("{:.1} MiB", kib as f64 / KIB as f64) }
}

/// A malformed frame.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum FrameError {
    /// A frame whose dimensions differ from the smoother's.
    #[error(
        "the frame is {frame_width}x{frame_height}, but the smoother is for {width}x{height}; open another smoother"
    )]
    ShapeMismatch {
        /// Width of the frame in pixels.
        frame_width: usize,
        /// Height of the frame in pixels.
        frame_height: usize,
        /// Width in pixels that the smoother was opened for.
        width: usize,
        /// Height in pixels that the smoother was opened for.
        height: usize,
    },
    /// A width or height of zero, or more pixels than can be addressed.
    #[error("a frame of {width}x{height} pixels is not allowed: {allowed}")]
    BadShape {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
        /// The allowed sizes.
        allowed: &'static str,
    },
    /// A camera whose image size differs from the frame's.
    #[error(
        "the camera is {width}x{height}, but the frame is {frame_width}x{frame_height}; give the camera of this frame"
    )]
    CameraShapeMismatch {
        /// Width of the frame in pixels.
        frame_width: usize,
        /// Height of the frame in pixels.
        frame_height: usize,
        /// Width of the camera's images in pixels.
        width: usize,
        /// Height of the camera's images in pixels.
        height: usize,
    },
    /// A frame on a grid, passed to a smoother for unorganized clouds, or the reverse.
    #[error(
        "the frame {found}, but the smoother was opened for {expected}; open another smoother, or set the view's grid"
    )]
    GridMismatch {
        /// Description of the frame.
        found: String,
        /// Description of the expected input.
        expected: String,
    },
    /// A stride so small that rows or points would overlap.
    #[error("a {what} of {stride} is not allowed; expected at least {least}")]
    BadStride {
        /// The name of the stride.
        what: &'static str,
        /// The stride.
        stride: usize,
        /// The smallest allowed stride.
        least: usize,
    },
    /// An address outside the memory of the GPU that the smoother was opened for.
    #[error(
        "{what} is not in the memory of CUDA device {device} ({gpu}); copy it there, or open a smoother for another GPU"
    )]
    NotOnGpu {
        /// Description of the data at the address.
        what: &'static str,
        /// The name of the GPU.
        gpu: String,
        /// The CUDA device number of the GPU.
        device: i32,
    },
    /// A buffer for an output that the smoother was not opened for.
    #[error("the smoother was opened without the output {output}; request it when opening the smoother")]
    OutputNotOpened {
        /// The name of the output.
        output: &'static str,
    },
    /// A cloud without finite points, where at least one is required.
    #[error("the cloud has no points")]
    NoPoints,
    /// Coordinates that f32 cannot hold.
    #[error("a coordinate exceeds 3.4e38 m, the limit of f32")]
    TooFar,
    /// Coordinates that f32 rounds too coarsely for the distances between points. Contains the text of
    /// [`Doubt::Coarse`](crate::Doubt::Coarse).
    #[error("{0}")]
    TooCoarse(String),
    /// An invalid sensor pose.
    #[error("sensor pose: {0}")]
    BadPose(ParamError),
    /// A grid of points whose sensor position is unknown.
    #[error("the sensor's position is unknown, but is needed to compute ranges; give the sensor's pose")]
    UnknownSensor,
    /// An invalid voxel size.
    #[error(transparent)]
    BadVoxel(ParamError),
    /// A buffer whose length does not match the shape.
    #[error("{what} has {len} values; expected {expected}")]
    LengthMismatch {
        /// The name of the buffer.
        what: String,
        /// The actual length.
        len: usize,
        /// The expected length.
        expected: usize,
    },
    /// A frame without the required camera.
    #[error("{what} needs the camera's intrinsics (fx, fy, cx, cy), which are unknown; give the camera")]
    MissingCamera {
        /// The feature that needs the camera.
        what: &'static str,
    },
    /// Invalid camera intrinsics.
    #[error("camera: {0}")]
    BadCamera(ParamError),
}

/// An engine that is unavailable, or that failed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EngineError {
    /// The engine is not in this build or not on this machine.
    #[error("engine {engine} is not available: {reason}")]
    Unavailable {
        /// The name of the requested engine.
        engine: &'static str,
        /// The reason and the remedy.
        reason: String,
    },
    /// A frame, or a batch of frames, that exceeds the device's limits.
    #[error(
        "the GPU {device} allows {allowed} {what}, but {needed} are needed; smooth smaller frames or use the CPU \
         engine"
    )]
    Limit {
        /// The device's name.
        device: String,
        /// Description of the exceeded limit.
        what: &'static str,
        /// The value that the device allows.
        allowed: u64,
        /// The required value.
        needed: u64,
    },
    /// The neighbourhoods of an unorganized cloud exceed the memory of the device, or smoothing it in parts would take
    /// too long.
    #[error(
        "the GPU {device} holds at most {points_at_once} points at once, too few for the neighbourhoods of this cloud; \
         use a smaller radius, fewer neighbours or the CPU engine"
    )]
    Crowded {
        /// The device's name.
        device: String,
        /// Number of points that the device can hold at once.
        points_at_once: u64,
    },
    /// The device is out of memory.
    #[error("the GPU {device} could not allocate {bytes} bytes: {reason}")]
    OutOfMemory {
        /// The device's name.
        device: String,
        /// The requested number of bytes.
        bytes: u64,
        /// The driver's message.
        reason: String,
    },
    /// The device was reset, unplugged or hung. Frames in flight are lost; open another smoother.
    #[error("the GPU {device} was lost: {reason}; open the smoother again")]
    Lost {
        /// The device's name.
        device: String,
        /// The driver's message.
        reason: String,
    },
    /// The driver reported an error.
    #[error("the GPU {device} failed: {reason}")]
    Device {
        /// The device's name.
        device: String,
        /// The driver's message.
        reason: String,
    },
    /// The maximum number of frames is in flight: receive one first.
    #[error("{in_flight} frames are in flight, the maximum; receive one before submitting the next")]
    Full {
        /// Number of frames in flight.
        in_flight: usize,
    },
    /// The frame was stopped by [`Progress::stop`](crate::Progress::stop) and has no result.
    #[error("smoothing was stopped")]
    Stopped,
    /// Threads could not be started.
    #[error("cannot start {threads} thread{}: {reason}", if *threads == 1 { "" } else { "s" })]
    Threads {
        /// The requested number of threads.
        threads: usize,
        /// The system's message.
        reason: String,
    },
}

impl EngineError {
    /// Returns true if the frame was too large for the device; another engine may still smooth it.
    pub fn is_too_large(&self) -> bool {
        matches!(self, Self::Limit { .. } | Self::Crowded { .. } | Self::OutOfMemory { .. })
    }
}

/// A camera or a viewer that is missing or was disconnected.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DeviceError {
    /// The device was not found; it may be connected later.
    #[error("{what}; {help}")]
    NotFound {
        /// Description of the missing device.
        what: String,
        /// The remedy.
        help: &'static str,
    },
    /// The device's driver is missing, or cannot use the device.
    #[error("{what}; {help}")]
    Driver {
        /// Description of the fault.
        what: String,
        /// The remedy.
        help: &'static str,
    },
    /// The device failed.
    #[error("{what}")]
    Failed {
        /// Description of the failure.
        what: String,
    },
    /// The device was disconnected (unplugged or hung) while in use; it may be reconnected.
    #[error("{what}; check whether it was unplugged")]
    Gone {
        /// Description of the event.
        what: String,
    },
}

/// A fault in a file, without the file's name.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FormatError {
    /// The operating system could not read or write the file.
    #[error(transparent)]
    Os(#[from] std::io::Error),
    /// The contents of the file violate the format. The text names the fault and the remedy.
    #[error("{0}")]
    Malformed(String),
    /// A valid file that planish cannot use. The text gives the reason and an alternative.
    #[error("{0}")]
    Unsupported(String),
    /// The contents of the file are not a valid frame.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// Reading the file needs more memory than allowed.
    #[error("needs {} of memory, but the limit is {}; raise the limit if the file is correct", memory(needed.saturating_add(KIB - 1)), memory(*allowed))]
    TooLarge {
        /// Number of bytes needed.
        needed: u64,
        /// Number of bytes allowed.
        allowed: u64,
    },
}

/// A file that could not be read or written.
#[derive(Debug, thiserror::Error)]
#[error("{}: {problem}", path.display())]
pub struct IoError {
    /// The file.
    pub path: PathBuf,
    /// The fault.
    pub problem: FormatError,
}

impl IoError {
    /// Returns a function that converts a fault in the file `path` into an error with the file's name.
    pub fn at(path: &Path) -> impl FnOnce(FormatError) -> Self + '_ {
        move |problem| Self { path: path.to_path_buf(), problem }
    }
}

/// Any error of planish.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A parameter outside its range.
    #[error(transparent)]
    Param(#[from] ParamError),
    /// A frame that cannot be used.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// An engine that is unavailable, or that failed.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// A camera or a viewer that is missing or was disconnected.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// A file that could not be read or written.
    #[error(transparent)]
    Io(#[from] IoError),
}
