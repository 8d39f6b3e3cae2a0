//! The contents of a file, independent of its format.

use planish_core::{DepthImage, FormatError, OrganizedCloud, PointCloud};

use super::input::FormatResult;

/// The contents of a file.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Contents {
    /// A 16-bit depth image; converting it to points requires a camera.
    Depth(DepthImage),
    /// Depth in metres; converting it to points requires a camera.
    DepthMetres {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
        /// Depth in metres, row by row; non-finite, zero and negative values are holes.
        depth_m: Vec<f32>,
    },
    /// Points on a pixel grid.
    Organized(OrganizedCloud),
    /// An unorganized cloud: points in any order.
    General(PointCloud),
}

impl Contents {
    /// Returns the width and height in pixels; for an unorganized cloud, the number of points and 1.
    pub fn shape(&self) -> (usize, usize) {
        match self {
            Self::Depth(image) => (image.width, image.height),
            Self::DepthMetres { width, height, .. } => (*width, *height),
            Self::Organized(cloud) => (cloud.width(), cloud.height()),
            Self::General(cloud) => (cloud.len(), 1),
        }
    }

    /// Returns the size of a cloud's fields in bytes per point; 0 for depth.
    pub fn field_bytes_per_point(&self) -> usize {
        match self {
            Self::Organized(cloud) => cloud.points.field_bytes_per_point(),
            Self::General(cloud) => cloud.field_bytes_per_point(),
            Self::Depth(_) | Self::DepthMetres { .. } => 0,
        }
    }

    /// Returns true for depth, whose conversion to points requires a camera.
    pub fn is_depth(&self) -> bool {
        matches!(self, Self::Depth(_) | Self::DepthMetres { .. })
    }
}

/// Returns a depth image made from integers; negative values become holes. Values over 65535 are an error.
pub(crate) fn depth_of_integers(
    (width, height): (usize, usize),
    values: &[impl Copy + Into<i64>],
    notes: &mut Vec<String>,
) -> FormatResult<Contents> {
    let values = values.iter().map(|value| (*value).into());
    if let Some(largest) = values.clone().max().filter(|largest: &i64| *largest > i64::from(u16::MAX)) {
        return Err(FormatError::Unsupported(format!(
            "the depth value {largest} exceeds 65535, the limit of 16-bit depth; save depth in metres, as floats"
        )));
    }
    let negative = values.clone().filter(|value| *value < 0).count();
    if negative > 0 {
        notes.push(format!("{negative} negative values are read as holes"));
    }
    let raw = values.map(|value| value.max(0) as u16).collect();
    Ok(Contents::Depth(DepthImage { width, height, raw }))
}

/// A summary of a 16-bit depth image.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct DepthSummary {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Number of pixels with a depth: neither 0 nor [`SATURATED_DEPTH`](planish_core::SATURATED_DEPTH).
    pub valid: usize,
    /// Smallest and largest raw value of the valid pixels; `None` if no pixel is valid.
    pub raw: Option<[u16; 2]>,
}

impl DepthSummary {
    /// Adds pixels, given as raw values, to the summary.
    pub(crate) fn add(&mut self, raw: impl Iterator<Item = u16>) {
        for raw in raw.filter(|&raw| raw != 0 && raw != planish_core::SATURATED_DEPTH) {
            self.valid += 1;
            let [low, high] = self.raw.unwrap_or([raw; 2]);
            self.raw = Some([low.min(raw), high.max(raw)]);
        }
    }
}

impl From<&DepthImage> for DepthSummary {
    fn from(image: &DepthImage) -> Self {
        let mut summary = Self { width: image.width, height: image.height, ..Self::default() };
        summary.add(image.raw.iter().copied());
        summary
    }
}

/// A picture with 3 bytes (red, green, blue) per pixel, row by row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RgbImage {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Red, green and blue of each pixel: 3 * width * height bytes.
    pub rgb: Vec<u8>,
}

/// A cloud with the grid that its file states; a height of 1 means no grid.
pub(crate) struct Gridded {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) points: PointCloud,
}

pub(crate) fn organized_if_grid(gridded: Gridded) -> FormatResult<Contents> {
    let Gridded { width, height, points } = gridded;
    if height > 1 {
        Ok(Contents::Organized(OrganizedCloud::new(width, height, points)?))
    } else {
        Ok(Contents::General(points))
    }
}

/// A cloud to write, organized or not.
#[derive(Debug, Clone, Copy)]
pub enum CloudRef<'a> {
    /// Points on a pixel grid.
    Organized(&'a OrganizedCloud),
    /// An unorganized cloud.
    General(&'a PointCloud),
}

impl<'a> CloudRef<'a> {
    pub(super) fn points(self) -> &'a PointCloud {
        match self {
            Self::Organized(cloud) => &cloud.points,
            Self::General(points) => points,
        }
    }

    /// Returns the width and height for a file's header; for an unorganized cloud, the number of points and 1.
    pub(super) fn grid(self) -> (usize, usize) {
        match self {
            Self::Organized(cloud) => (cloud.width(), cloud.height()),
            Self::General(points) => (points.len(), 1),
        }
    }
}

impl<'a> From<&'a OrganizedCloud> for CloudRef<'a> {
    fn from(cloud: &'a OrganizedCloud) -> Self {
        Self::Organized(cloud)
    }
}

impl<'a> From<&'a PointCloud> for CloudRef<'a> {
    fn from(cloud: &'a PointCloud) -> Self {
        Self::General(cloud)
    }
}
