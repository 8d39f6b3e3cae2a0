//! Input of a smoother: borrowed views of depth images and points, and owned types that convert into them.

mod colours;
mod depth_view;
mod geometry;
mod lattice;
mod owned;
mod points_view;
mod range_rule;
mod sample;

use crate::camera::Camera;
use crate::cloud::{Attribute, OrganizedCloud, PointCloud};
use crate::error::FrameError;
use crate::threads::ONE_THREAD;
use crate::xyz::validate_shape;

pub(crate) use colours::Colours;
pub(crate) use depth_view::DepthSamples;
pub use depth_view::DepthView;
pub use geometry::{assumed_sensor_of_sample, sampling_step};
pub(crate) use lattice::Lattice;
pub use owned::OwnedFrame;
pub use points_view::{PointLayout, PointsView, Scalar};
pub use range_rule::RangeRule;
pub(crate) use range_rule::{FrameGeometry, assumed_range_m};
pub(crate) use sample::GeometryScratch;

/// A 16-bit depth image, row by row, without its camera. 0 and 65535 are holes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DepthImage {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// The `width * height` raw depth values.
    pub raw: Vec<u16>,
}

/// An owned depth image with its camera. [`DepthView`] is the borrowed equivalent.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct DepthFrame {
    /// The camera, whose width and height are those of the image.
    pub camera: Camera,
    /// Raw depth values, row by row. 0 and 65535 are holes.
    pub raw: Vec<u16>,
    /// Colour registered to the depth image, 3 bytes (red, green, blue) per pixel.
    pub rgb: Option<Vec<u8>>,
    /// Time of capture in seconds, on the clock of the source.
    pub timestamp_s: Option<f64>,
}

impl DepthFrame {
    /// Combines raw depth values with their camera; refuses values that do not match the camera's shape.
    pub fn new(camera: Camera, raw: Vec<u16>) -> Result<Self, FrameError> {
        let frame = Self { camera, raw, rgb: None, timestamp_s: None };
        frame.validate()?;
        Ok(frame)
    }

    /// Combines raw depth values with their camera without checking them; see [`validate`](Self::validate).
    #[doc(hidden)]
    pub fn unchecked(camera: Camera, raw: Vec<u16>) -> Self {
        Self { camera, raw, rgb: None, timestamp_s: None }
    }

    /// Creates a frame from a depth image and its camera.
    pub fn from_image(camera: Camera, image: DepthImage) -> Result<Self, FrameError> {
        camera.check_shape((image.width, image.height))?;
        Self::new(camera, image.raw)
    }

    /// Sets the colour registered to the depth image, 3 bytes (red, green, blue) per pixel.
    pub fn with_rgb(self, rgb: Vec<u8>) -> Self {
        Self { rgb: Some(rgb), ..self }
    }

    /// Sets the time of capture in seconds, on the clock of the source.
    pub fn with_timestamp_s(self, timestamp_s: f64) -> Self {
        Self { timestamp_s: Some(timestamp_s), ..self }
    }

    /// Refuses an invalid camera, and buffers whose lengths do not match the camera's shape.
    pub fn validate(&self) -> Result<(), FrameError> {
        DepthView::new(&self.raw, &self.camera)?;
        let expected = 3 * self.raw.len();
        match &self.rgb {
            Some(rgb) if rgb.len() != expected => {
                Err(FrameError::LengthMismatch { what: "rgb".into(), len: rgb.len(), expected })
            }
            _ => Ok(()),
        }
    }

    /// Returns the organized cloud of this frame (docs/method.md, section 1). Colour, if any, becomes PCL's packed
    /// field `rgb`.
    pub fn deproject(&self) -> Result<OrganizedCloud, FrameError> {
        self.validate()?;
        let mut cloud = DepthView::new(&self.raw, &self.camera)?.deproject()?;
        cloud.points.attributes.extend(self.packed_rgb());
        Ok(cloud)
    }

    /// Returns the colour as PCL's packed field `rgb`; `None` without colour.
    pub fn packed_rgb(&self) -> Option<Attribute> {
        let packed = self.rgb.as_ref()?.chunks_exact(3).map(|c| u32::from_be_bytes([0, c[0], c[1], c[2]]));
        let values = packed.map(f32::from_bits).collect::<Vec<_>>().into();
        Some(Attribute { name: "rgb".into(), count: 1, values })
    }
}

/// A borrowed, well-formed frame: a depth image or points.
#[derive(Debug, Clone, Copy)]
pub enum Frame<'a> {
    /// A depth image with its camera.
    Depth(DepthView<'a>),
    /// Points, on a grid or not.
    Points(PointsView<'a>),
}

impl<'a> Frame<'a> {
    /// Returns the width and height in pixels; `None` for an unorganized cloud.
    pub fn grid(&self) -> Option<(usize, usize)> {
        match self {
            Self::Depth(depth) => Some(depth.shape()),
            Self::Points(points) => points.grid(),
        }
    }

    /// Returns the width and height of the results: the number of points and 1 for an unorganized cloud.
    pub fn shape(&self) -> (usize, usize) {
        match self {
            Self::Depth(depth) => depth.shape(),
            Self::Points(points) => points.grid().unwrap_or((points.len(), 1)),
        }
    }

    /// Returns the number of pixels or points that are not holes.
    pub fn valid_points(&self) -> usize {
        match self {
            Self::Depth(depth) => depth.valid_pixels(),
            Self::Points(points) => points.valid_points(),
        }
    }

    /// Returns the colours of the pixels; `None` without colour.
    pub(crate) fn colours(&self) -> Option<Colours<'a>> {
        match self {
            Self::Depth(depth) => depth.colours(),
            Self::Points(points) => points.colours(),
        }
    }

    /// Returns the camera, if known.
    pub fn camera(&self) -> Option<&'a Camera> {
        match self {
            Self::Depth(depth) => Some(depth.camera()),
            Self::Points(points) => points.camera(),
        }
    }
}

/// Conversion into a well-formed [`Frame`] without copying, from views, [`DepthFrame`], [`OrganizedCloud`] and
/// [`PointCloud`].
///
/// The owned types have public fields, so the conversion checks them: lengths, the camera, the pose.
pub trait IntoFrame<'a> {
    /// Returns the frame.
    ///
    /// # Errors
    /// If buffers contradict the shape, or the camera or the pose is invalid.
    fn into_frame(self) -> Result<Frame<'a>, FrameError>;
}

impl<'a> IntoFrame<'a> for Frame<'a> {
    fn into_frame(self) -> Result<Frame<'a>, FrameError> {
        Ok(self)
    }
}

impl<'a> IntoFrame<'a> for DepthView<'a> {
    fn into_frame(self) -> Result<Frame<'a>, FrameError> {
        Ok(Frame::Depth(self))
    }
}

impl<'a> IntoFrame<'a> for PointsView<'a> {
    fn into_frame(self) -> Result<Frame<'a>, FrameError> {
        Ok(Frame::Points(self))
    }
}

impl<'a> IntoFrame<'a> for &'a DepthFrame {
    fn into_frame(self) -> Result<Frame<'a>, FrameError> {
        self.validate()?;
        let view = DepthView::new(&self.raw, &self.camera)?;
        Ok(Frame::Depth(match &self.rgb {
            Some(rgb) if !ONE_THREAD => view.with_rgb(rgb)?,
            _ => view,
        }))
    }
}

impl<'a> IntoFrame<'a> for &'a OrganizedCloud {
    fn into_frame(self) -> Result<Frame<'a>, FrameError> {
        Ok(Frame::Points(PointsView::from_organized(self)?))
    }
}

impl<'a> IntoFrame<'a> for &'a PointCloud {
    fn into_frame(self) -> Result<Frame<'a>, FrameError> {
        Ok(Frame::Points(PointsView::from_cloud(self)?))
    }
}

/// Refuses a row stride below the width, and a buffer that is too short for the shape and stride.
fn check_rows(what: &str, len: usize, (width, height): (usize, usize), row_stride: usize) -> Result<(), FrameError> {
    validate_shape(width, height)?;
    if row_stride < width {
        return Err(FrameError::BadStride { what: "row stride", stride: row_stride, least: width });
    }
    let expected = row_stride.checked_mul(height - 1).and_then(|rows| rows.checked_add(width));
    match expected {
        Some(expected) if len >= expected => Ok(()),
        _ => Err(FrameError::LengthMismatch { what: what.into(), len, expected: expected.unwrap_or(usize::MAX) }),
    }
}
