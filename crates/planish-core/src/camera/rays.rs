//! The rays of a camera's pixels: X/Z and Y/Z, computed once per camera.

use super::Camera;

/// The factors of deprojection, which are recomputed only if the camera changes.
#[derive(Debug, Clone, Default)]
pub struct Rays {
    camera: Option<Camera>,
    /// X/Z per column, or per pixel with lens distortion; NaN where the lens model is not invertible.
    pub x: Vec<f32>,
    /// Y/Z per row, or per pixel with lens distortion; NaN where the lens model is not invertible.
    pub y: Vec<f32>,
}

/// The rays of one row of pixels.
#[derive(Clone, Copy)]
pub struct RowRays<'a> {
    pub x: &'a [f32],
    pub y: RowRaysY<'a>,
}

/// The values of Y/Z along a row.
#[derive(Clone, Copy)]
pub enum RowRaysY<'a> {
    /// One value for all pixels of the row.
    Same(f32),
    Each(&'a [f32]),
}

impl Rays {
    /// Sets the camera, and recomputes the rays if it differs from the previous one.
    pub fn set(&mut self, camera: &Camera) {
        if self.camera.as_ref() == Some(camera) {
            return;
        }
        let Camera { width, height, fx, fy, cx, cy, distortion, .. } = *camera;
        let (column, row) = (|u: usize| (u as f64 - cx) / fx, |v: usize| (v as f64 - cy) / fy);
        self.camera = Some(*camera);
        if distortion.is_none() {
            self.x = (0..width).map(|u| column(u) as f32).collect();
            self.y = (0..height).map(|v| row(v) as f32).collect();
            return;
        }
        let pixels = (0..width * height).map(|i| {
            let [x, y] = distortion.undistort([column(i % width), row(i / width)]).unwrap_or([f64::NAN; 2]);
            (x as f32, y as f32)
        });
        (self.x, self.y) = pixels.unzip();
    }

    /// Returns true if there is a ray for each pixel, rather than one for each column and row.
    pub fn are_distorted(&self) -> bool {
        self.camera.is_some_and(|camera| !camera.distortion.is_none())
    }

    /// Returns the rays of row `v`.
    pub fn row(&self, v: usize) -> RowRays<'_> {
        if !self.are_distorted() {
            return RowRays { x: &self.x, y: RowRaysY::Same(self.y[v]) };
        }
        let width = self.camera.map_or(0, |camera| camera.width);
        let pixels = v * width..(v + 1) * width;
        RowRays { x: &self.x[pixels.clone()], y: RowRaysY::Each(&self.y[pixels]) }
    }

    /// Returns `[X/Z, Y/Z]` of a pixel.
    pub fn at(&self, u: usize, v: usize) -> [f32; 2] {
        self.row(v).at(u)
    }
}

impl RowRays<'_> {
    #[inline(always)]
    pub fn at(&self, u: usize) -> [f32; 2] {
        let y = match self.y {
            RowRaysY::Same(y) => y,
            RowRaysY::Each(y) => y[u],
        };
        [self.x[u], y]
    }
}
