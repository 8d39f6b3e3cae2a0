//! The parameters in the form that engines use: the window size is resolved, and frames and unorganized clouds share
//! one type.

use super::cloud::{CloudParams, CloudRadius};
use super::fit::{Edges, Fit, Project};
use super::frame::{FrameParams, FrameRadius};
use super::window::WindowSize;
use crate::frame::PointsView;
use crate::sensor::SensorModel;

/// Number of neighbours that evenly spread points have at least within a radius by range.
const LEAST_NEIGHBOURS: u32 = 20;

/// The rules for the radius, for frames and unorganized clouds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Radius {
    Fixed {
        radius_m: f32,
    },
    Neighbours {
        count: u32,
    },
    Sensor,
    /// For unorganized clouds: by range, or by density for `count` neighbours where that radius is larger.
    SensorAndDensity {
        count: u32,
    },
}

impl Radius {
    /// Returns the number of neighbours of a radius by density; `None` for frames and for a fixed radius.
    pub(crate) fn density(self) -> Option<u32> {
        match self {
            Self::Neighbours { count } | Self::SensorAndDensity { count } => Some(count),
            Self::Fixed { .. } | Self::Sensor => None,
        }
    }
}

/// Parameters in the form that engines compute with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct EngineParams {
    pub(crate) window: u32,
    pub(crate) stride: u32,
    pub(crate) average_blocks: bool,
    pub(crate) radius: Radius,
    pub(crate) degree: u32,
    pub(crate) bandwidth_m: Option<f32>,
    pub(crate) ridge: f32,
    pub(crate) project: Project,
    pub(crate) edges: Edges,
    pub(crate) remove_isolated: bool,
    pub(crate) sensor: SensorModel,
}

impl From<FrameParams> for EngineParams {
    /// Converts frame parameters with the window's nominal size.
    fn from(params: FrameParams) -> Self {
        let WindowSize { half_width: window, stride } = params.window.nominal();
        let Fit { degree, bandwidth_m, ridge, edges } = params.fit;
        let radius = match params.radius {
            FrameRadius::Sensor => Radius::Sensor,
            FrameRadius::Fixed { radius_m } => Radius::Fixed { radius_m },
        };
        let FrameParams { average_blocks, project, sensor, .. } = params;
        Self {
            window,
            stride,
            average_blocks,
            radius,
            degree,
            bandwidth_m,
            ridge,
            project,
            edges,
            remove_isolated: false,
            sensor,
        }
    }
}

impl From<CloudParams> for EngineParams {
    fn from(params: CloudParams) -> Self {
        let Fit { degree, bandwidth_m, ridge, edges } = params.fit;
        let (radius, of_sensor) = match params.radius {
            CloudRadius::Neighbours { count } => (Radius::Neighbours { count }, None),
            CloudRadius::Fixed { radius_m } => (Radius::Fixed { radius_m }, None),
            CloudRadius::Sensor { sensor, strength } => {
                let of_sensor = FrameParams::for_sensor(sensor, strength);
                (Radius::SensorAndDensity { count: LEAST_NEIGHBOURS }, Some(of_sensor))
            }
        };
        // Without a sensor, the window has no effect.
        let FrameParams { window, average_blocks, project, sensor, .. } = of_sensor.unwrap_or_else(FrameParams::paper);
        let WindowSize { half_width: window, stride } = window.nominal();
        Self {
            window,
            stride,
            average_blocks,
            radius,
            degree,
            bandwidth_m,
            ridge,
            project,
            edges,
            remove_isolated: params.remove_isolated,
            sensor,
        }
    }
}

impl EngineParams {
    /// Returns these parameters with another window.
    pub(crate) fn with_size(self, size: WindowSize) -> Self {
        Self { window: size.half_width, stride: size.stride, ..self }
    }

    /// Returns the reach of a window from its centre in pixels: k s.
    pub(crate) fn reach_px(&self) -> usize {
        (self.window * self.stride) as usize
    }

    /// Returns the width in pixels of the cells that share a surface (docs/method.md, section 10): two if edges are
    /// kept and windows skip pixels, otherwise one.
    pub(crate) fn cell_px(&self) -> usize {
        if self.edges == Edges::Robust && self.stride > 1 { 2 } else { 1 }
    }

    /// Returns the width and height in cells of a frame with this width and height in pixels.
    pub(crate) fn cells_of(&self, (width, height): (usize, usize)) -> (usize, usize) {
        (width.div_ceil(self.cell_px()), height.div_ceil(self.cell_px()))
    }

    /// Returns the distance in cells from the centre of a window to its i-th column of samples.
    pub(crate) fn sample_offset(&self, i: usize) -> usize {
        (i * self.stride as usize).div_ceil(self.cell_px())
    }

    /// Returns the reach of a window from its centre in cells.
    pub(crate) fn reach(&self) -> usize {
        self.sample_offset(self.window as usize)
    }

    /// Returns the distance in cells to the planes that distinguish surfaces. It slightly exceeds the reach of a
    /// window, so that next to an edge, the window of at least one of the planes does not cross the edge.
    pub(crate) fn edge_shift(&self) -> usize {
        (13 * self.reach() + 6 * self.cell_px()) / 12
    }

    /// Returns the half-width of the averaged blocks in pixels. Blocks are as wide as the stride, or one pixel wider
    /// if the stride is even.
    pub(crate) fn block_half_px(&self) -> usize {
        self.stride as usize / 2
    }

    /// Returns true if samples are means of more than one pixel.
    pub(crate) fn averages_blocks(&self) -> bool {
        self.average_blocks && self.block_half_px() > 0
    }

    /// Returns the number of samples of a window: (2k+1)².
    #[cfg(any(test, feature = "reference"))]
    pub(crate) fn candidates(&self) -> usize {
        let side = 2 * self.window as usize + 1;
        side * side
    }

    /// Returns the number of neighbours below which a point of an unorganized cloud is isolated (docs/method.md,
    /// section 8).
    pub(crate) fn least_neighbours(&self, cloud: &PointsView<'_>) -> u32 {
        let Some(count) = self.radius.density() else { return 3 };
        let few = u32::try_from(cloud.points_of_whole().div_ceil(16)).unwrap_or(u32::MAX);
        count.div_ceil(4).min(few).max(3)
    }
}
