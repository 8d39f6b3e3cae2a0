//! Events that a session reports in addition to results.

use std::fmt;

use crate::cpu::CloudEstimate;
use crate::doubts::Doubt;
use crate::error::EngineError;
use crate::fleet::FleetDevice;
use crate::params::{CloudParams, CloudRadius, Edges};
use crate::sensor::SensorModel;
use crate::threads::ONE_THREAD;

/// The parameters for an unorganized cloud, chosen by planish where the settings do not give them.
/// [`Display`](fmt::Display) formats them as one line for the user.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct CloudChoice {
    /// The approximate number of neighbours per point.
    pub neighbours: u32,
    /// Whether edges are kept.
    #[cfg_attr(feature = "serde", serde(serialize_with = "serialize_edges"))]
    pub edges: Edges,
    /// The number of passes: 2 if there is a first pass with few neighbours, otherwise 1.
    pub passes: u32,
    /// The noise of the points, as a standard deviation perpendicular to the surface in metres; `None` if the cloud
    /// is too small for an estimate.
    pub noise_m: Option<f32>,
}

impl CloudChoice {
    /// Returns the choice that corresponds to these parameters; `None` for a fixed radius.
    pub fn of(params: &CloudParams, passes: u32, estimate: Option<CloudEstimate>) -> Option<Self> {
        let CloudRadius::Neighbours { count } = params.radius else { return None };
        let noise_m = estimate.map(|estimate| estimate.noise_m);
        Some(Self { neighbours: count, edges: params.fit.edges, passes, noise_m })
    }
}

impl fmt::Display for CloudChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an unorganized cloud")?;
        if let Some(noise_m) = self.noise_m {
            if noise_m < 5e-6 {
                f.write_str(" without noticeable noise")?;
            } else {
                write!(f, " with about {:.2} mm of noise", 1e3 * noise_m)?;
            }
        }
        write!(f, ", smoothed with about {} neighbours per point", self.neighbours)?;
        f.write_str(if self.edges == Edges::Robust { ", edges kept" } else { "" })?;
        f.write_str(if self.passes > 1 { ", in two passes" } else { "" })
    }
}

#[cfg(feature = "serde")]
fn serialize_edges<S: serde::Serializer>(edges: &Edges, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(edges.name())
}

/// An estimate, choice or fault that a session reports. [`Display`](fmt::Display) formats it as one line for the user.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum SessionEvent {
    /// The sensor was estimated from a frame, and differs from the previous estimate.
    SensorEstimated {
        /// The estimated model.
        sensor: SensorModel,
    },
    /// A sensor was recognized by the depth steps of an unorganized cloud, which is smoothed by its noise.
    SensorRecognized {
        /// The recognized model.
        sensor: SensorModel,
    },
    /// Neighbours, edges and passes for an unorganized cloud were chosen by its noise and shape.
    NeighboursChosen(CloudChoice),
    /// An unorganized cloud was recognized as a frame without its grid. The grid was rebuilt, and the cloud was
    /// smoothed on the grid.
    GridRebuilt {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// The frame is implausible for a depth camera. It was smoothed anyway.
    Doubtful(Doubt),
    /// The motion of the camera cannot be compensated as requested, because no camera fits the points of the frames.
    CameraUnknown,
    /// Holes cannot be filled as requested, because the points are not on the pixels of a camera.
    NotFilled,
    /// A cloud did not fit the GPU that `Auto` chose; clouds are smoothed on the CPU from now on.
    TooLargeForGpu {
        /// The error of the GPU.
        error: EngineError,
    },
    /// The GPU failed and is opened once more.
    Reopening {
        /// The error of the GPU.
        error: EngineError,
    },
    /// The GPU failed again; the CPU engine continues.
    UsingCpu {
        /// The error of the GPU.
        error: EngineError,
    },
    /// A device failed; the session continues on another device in its list.
    DeviceLeft {
        /// The failed device.
        device: FleetDevice,
        /// The error that the device reported.
        error: EngineError,
    },
    /// A device that shared the frames in flight failed; the others continue.
    DeviceLost {
        /// The failed device.
        device: FleetDevice,
        /// The error that the device reported.
        error: EngineError,
        /// The number of remaining devices.
        left: usize,
    },
}

impl SessionEvent {
    /// Returns true for faults and doubts, false for estimates and choices.
    pub fn is_fault(&self) -> bool {
        !matches!(
            self,
            Self::SensorEstimated { .. }
                | Self::SensorRecognized { .. }
                | Self::NeighboursChosen(_)
                | Self::GridRebuilt { .. }
        )
    }
}

impl fmt::Display for SessionEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::SensorEstimated { sensor } => {
                let SensorModel { step, sigma } = sensor;
                write!(f, "estimated the sensor from a frame: step {step:?}, sigma {sigma:?}")
            }
            Self::SensorRecognized { sensor } => {
                let name = sensor.name().unwrap_or("known sensor");
                write!(f, "an unorganized cloud with the depth steps of a {name}, smoothed by that sensor's noise")
            }
            Self::NeighboursChosen(choice) => choice.fmt(f),
            Self::GridRebuilt { width, height } => {
                write!(f, "the frame lost its grid; smoothed on a rebuilt grid of {width}x{height} pixels")
            }
            Self::Doubtful(doubt) => doubt.fmt(f),
            Self::CameraUnknown => f.write_str(
                "the camera's motion cannot be compensated, since the points do not match a camera without distortion; \
                 give the camera",
            ),
            // WebAssembly builds fill no holes.
            Self::NotFilled if ONE_THREAD => Ok(()),
            Self::NotFilled => f.write_str(
                "holes are not filled, since the points do not match a camera without distortion; give the camera",
            ),
            Self::TooLargeForGpu { error } => write!(f, "{error}; smoothed on the CPU"),
            Self::Reopening { error } => write!(f, "{error}; reopening the GPU"),
            Self::UsingCpu { error } => write!(f, "{error}; continuing with the CPU engine"),
            Self::DeviceLeft { error, .. } => write!(f, "{error}; continuing on another device"),
            Self::DeviceLost { error, left: 1, .. } => write!(f, "{error}; continuing on one device"),
            Self::DeviceLost { error, left, .. } => write!(f, "{error}; continuing on {left} devices"),
        }
    }
}
