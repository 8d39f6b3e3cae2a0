//! A borrowed depth image with its camera.

use std::ops::Range;

use rayon::prelude::*;

use super::{Colours, check_rows};
use crate::camera::{Camera, Rays, RowRaysY, SATURATED_DEPTH, depth_m};
use crate::cloud::OrganizedCloud;
use crate::error::FrameError;
use crate::xyz::Xyz;

/// Minimum number of rows that one task deprojects.
const ROWS_OF_A_TASK: usize = 16;

/// A borrowed depth image with its camera: raw 16-bit values or metres, row by row, optionally with a row stride.
///
/// ```
/// use planish::{Camera, DepthView};
///
/// let camera = Camera::kinect_v1();
/// let raw = vec![1500u16; 640 * 480];
/// let view = DepthView::new(&raw, &camera)?;
/// assert_eq!(view.shape(), (640, 480));
/// # Ok::<(), planish::FrameError>(())
/// ```
#[derive(Debug, Clone, Copy)]
pub struct DepthView<'a> {
    camera: &'a Camera,
    samples: DepthSamples<'a>,
    /// Distance between the starts of consecutive rows, in values.
    row_stride: usize,
    colours: Option<Colours<'a>>,
}

/// The samples of a depth image.
#[derive(Debug, Clone, Copy)]
pub(crate) enum DepthSamples<'a> {
    /// Raw values in the camera's units; 0 and 65535 are holes.
    U16(&'a [u16]),
    /// Metres; values that are not finite or not positive are holes.
    F32(&'a [f32]),
}

impl<'a> DepthView<'a> {
    /// Borrows raw values in the camera's units, row by row; 0 and 65535 are holes.
    pub fn new(raw: &'a [u16], camera: &'a Camera) -> Result<Self, FrameError> {
        let view = Self { camera, samples: DepthSamples::U16(raw), row_stride: camera.width, colours: None };
        view.check_exact(raw.len())
    }

    /// Borrows depth in metres, row by row; values that are not finite or not positive are holes.
    pub fn from_metres(depth_m: &'a [f32], camera: &'a Camera) -> Result<Self, FrameError> {
        let view = Self { camera, samples: DepthSamples::F32(depth_m), row_stride: camera.width, colours: None };
        view.check_exact(depth_m.len())
    }

    /// Borrows raw values whose rows begin `row_stride` values apart; the first `width` values of each row are used.
    pub fn with_row_stride(raw: &'a [u16], row_stride: usize, camera: &'a Camera) -> Result<Self, FrameError> {
        Self { camera, samples: DepthSamples::U16(raw), row_stride, colours: None }.check(raw.len())
    }

    /// Same as [`DepthView::from_metres`], with rows that begin `row_stride` values apart.
    pub fn from_metres_with_row_stride(
        depth_m: &'a [f32],
        row_stride: usize,
        camera: &'a Camera,
    ) -> Result<Self, FrameError> {
        Self { camera, samples: DepthSamples::F32(depth_m), row_stride, colours: None }.check(depth_m.len())
    }

    fn check(self, len: usize) -> Result<Self, FrameError> {
        self.camera.validate()?;
        check_rows("depth", len, self.shape(), self.row_stride)?;
        Ok(self)
    }

    /// Checks the view, and that the buffer has no values after the image.
    fn check_exact(self, len: usize) -> Result<Self, FrameError> {
        let (width, height) = self.shape();
        let view = self.check(len)?;
        match width * height {
            expected if expected == len => Ok(view),
            expected => Err(FrameError::LengthMismatch { what: "depth".into(), len, expected }),
        }
    }

    /// Sets the colours registered to the depth, 3 bytes (red, green, blue) per pixel, row by row. The colours guide
    /// the filling of holes.
    pub fn with_rgb(self, rgb: &'a [u8]) -> Result<Self, FrameError> {
        match 3 * self.camera.width * self.camera.height {
            expected if expected == rgb.len() => Ok(Self { colours: Some(Colours::Bytes(rgb)), ..self }),
            expected => Err(FrameError::LengthMismatch { what: "rgb".into(), len: rgb.len(), expected }),
        }
    }

    /// Returns the colours set by [`with_rgb`](Self::with_rgb).
    pub fn rgb(&self) -> Option<&'a [u8]> {
        match self.colours {
            Some(Colours::Bytes(rgb)) => Some(rgb),
            _ => None,
        }
    }

    pub(super) fn colours(&self) -> Option<Colours<'a>> {
        self.colours
    }

    /// Returns the camera.
    pub fn camera(&self) -> &'a Camera {
        self.camera
    }

    /// Returns the width and height in pixels.
    pub fn shape(&self) -> (usize, usize) {
        (self.camera.width, self.camera.height)
    }

    /// Returns the depth of a pixel in metres; NaN for a hole.
    pub fn depth_m(&self, u: usize, v: usize) -> f32 {
        let at = v * self.row_stride + u;
        match self.samples {
            DepthSamples::U16(raw) => self.camera.depth_m(raw[at]),
            DepthSamples::F32(depth_m) if depth_m[at] > 0.0 && depth_m[at].is_finite() => depth_m[at],
            DepthSamples::F32(_) => f32::NAN,
        }
    }

    /// Returns the number of pixels that are not holes.
    pub fn valid_pixels(&self) -> usize {
        (0..self.camera.height)
            .map(|v| match self.row(v) {
                DepthSamples::U16(row) => row.iter().filter(|&&raw| raw != 0 && raw != SATURATED_DEPTH).count(),
                DepthSamples::F32(row) => row.iter().filter(|z| **z > 0.0 && z.is_finite()).count(),
            })
            .sum()
    }

    /// Returns the organized cloud of this image (docs/method.md, section 1).
    pub fn deproject(&self) -> Result<OrganizedCloud, FrameError> {
        let (width, height) = self.shape();
        let mut rays = Rays::default();
        rays.set(self.camera);
        let cloud = OrganizedCloud::from_positions(width, height, self.deproject_with(&rays))?;
        Ok(cloud.with_camera(*self.camera))
    }

    /// Returns the points of all pixels, computed with the rays of the image's camera; NaN for holes.
    pub fn deproject_with(&self, rays: &Rays) -> Xyz {
        let (width, height) = self.shape();
        let mut points = Xyz::filled(width * height, 0.0);
        let [x, y, z] = points.as_mut_slices();
        let rows = x.par_chunks_mut(width).zip(y.par_chunks_mut(width)).zip(z.par_chunks_mut(width)).enumerate();
        rows.with_min_len(ROWS_OF_A_TASK).for_each(|(v, ((x, y), z))| {
            let metres_per_unit = self.camera.metres_per_unit();
            match self.row(v) {
                DepthSamples::U16(raw) => {
                    z.iter_mut().zip(raw).for_each(|(z, &raw)| *z = depth_m(raw, metres_per_unit));
                }
                DepthSamples::F32(depth_m) => {
                    let metres = depth_m.iter().map(|&z| if z > 0.0 && z < f32::INFINITY { z } else { f32::NAN });
                    z.iter_mut().zip(metres).for_each(|(z, metres)| *z = metres);
                }
            }
            let row = rays.row(v);
            x.iter_mut().zip(row.x).zip(&*z).for_each(|((x, ray), z)| *x = ray * z);
            match row.y {
                RowRaysY::Same(ray) => y.iter_mut().zip(&*z).for_each(|(y, z)| *y = ray * z),
                RowRaysY::Each(rays) => y.iter_mut().zip(rays).zip(&*z).for_each(|((y, ray), z)| *y = ray * z),
            }
        });
        points
    }

    /// Returns the samples of a row.
    pub(crate) fn row(&self, v: usize) -> DepthSamples<'a> {
        let pixels: Range<usize> = v * self.row_stride..v * self.row_stride + self.camera.width;
        match self.samples {
            DepthSamples::U16(raw) => DepthSamples::U16(&raw[pixels]),
            DepthSamples::F32(depth_m) => DepthSamples::F32(&depth_m[pixels]),
        }
    }

    /// Returns all samples; `None` if there are gaps between the rows.
    #[cfg(any(test, feature = "gpu", feature = "webgpu"))]
    pub(crate) fn contiguous(&self) -> Option<DepthSamples<'a>> {
        let pixels = self.camera.width * self.camera.height;
        (self.row_stride == self.camera.width).then(|| match self.samples {
            DepthSamples::U16(raw) => DepthSamples::U16(&raw[..pixels]),
            DepthSamples::F32(depth_m) => DepthSamples::F32(&depth_m[..pixels]),
        })
    }

    /// Returns true if the samples are in metres, false if they are in raw units.
    pub fn is_metres(&self) -> bool {
        matches!(self.samples, DepthSamples::F32(_))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_where_the_stride_says_and_short_buffers_are_refused() {
        let camera = Camera::new((3, 2), [500.0; 2], [1.0; 2]);
        let raw = [1, 2, 3, 99, 4, 5, 6];
        let view = DepthView::with_row_stride(&raw, 4, &camera).unwrap();
        assert_eq!(view.depth_m(1, 1), camera.depth_m(5));
        assert!(view.contiguous().is_none());
        assert!(DepthView::with_row_stride(&raw[..6], 4, &camera).is_err());
        assert!(DepthView::with_row_stride(&raw, 2, &camera).unwrap_err().to_string().contains("stride"));
        assert!(DepthView::new(&raw, &camera).is_err() && DepthView::new(&raw[..6], &camera).is_ok());
        let metres = [1.0, f32::NAN, 0.0, -1.0, f32::INFINITY, 2.0];
        let view = DepthView::from_metres(&metres, &camera).unwrap();
        assert_eq!(view.valid_pixels(), 2);
        assert!(view.depth_m(1, 1).is_nan() && view.depth_m(2, 1) == 2.0);
    }
}
