//! Prepares a frame before it is smoothed: cuts off ranges, removes floating pixels, and reduces the resolution.

use rayon::prelude::*;

use crate::camera::Camera;
use crate::cloud::{OrganizedCloud, PointCloud};
use crate::error::{FrameError, ParamError};
use crate::frame::{DepthFrame, PointsView};
use crate::sensor::SensorModel;

/// Maximum deviation of a surface's ranges from the median of their block, in standard deviations of the noise.
const SAME_SURFACE_DEVIATIONS: f64 = 4.0;

/// Deviation from the median of a block, as a share of the median, up to which ranges always count as the same surface.
/// It allows for sloping surfaces.
const SAME_SURFACE_SHARE: f64 = 0.01;

/// Maximum side of a block in pixels.
const MAX_DECIMATE: u32 = 8;

/// Steps before smoothing, applied in the order of the fields. By default, no step is applied.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[non_exhaustive]
pub struct Preparation {
    /// Minimum range in metres; nearer pixels become holes. In depth images this is the depth, in clouds the range that
    /// smoothing uses (docs/method.md, section 11).
    pub min_range_m: Option<f32>,
    /// Maximum range in metres, measured like the minimum; farther pixels become holes.
    pub max_range_m: Option<f32>,
    /// True if pixels that float between two surfaces become holes.
    pub remove_floating: bool,
    /// Side in pixels, 2 to 8, of the blocks that become one pixel each.
    pub decimate: Option<u32>,
}

/// The numbers of pixels that preparation turned into holes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct Prepared {
    /// Number of pixels nearer than the minimum or farther than the maximum range.
    pub out_of_range: usize,
    /// Number of floating pixels.
    pub floating: usize,
}

impl Preparation {
    /// Returns true if no step is set.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Refuses invalid ranges, a maximum that does not exceed the minimum, and block sizes other than 2 to 8.
    pub fn validate(&self) -> Result<(), ParamError> {
        for (field, range_m) in [("min_range_m", self.min_range_m), ("max_range_m", self.max_range_m)] {
            if let Some(range_m) = range_m.filter(|range_m| !(range_m.is_finite() && *range_m >= 0.0)) {
                return Err(ParamError { field, value: range_m.to_string(), allowed: "a range in metres, 0 or more" });
            }
        }
        if let (Some(min_m), Some(max_m)) = (self.min_range_m, self.max_range_m)
            && min_m >= max_m
        {
            let allowed = "more than min_range_m";
            return Err(ParamError { field: "max_range_m", value: max_m.to_string(), allowed });
        }
        match self.decimate.filter(|k| !(2..=MAX_DECIMATE).contains(k)) {
            Some(k) => Err(ParamError { field: "decimate", value: k.to_string(), allowed: "2 to 8" }),
            None => Ok(()),
        }
    }

    fn is_outside(&self, range_m: f64) -> bool {
        let Self { min_range_m, max_range_m, .. } = *self;
        min_range_m.is_some_and(|min_m| range_m < f64::from(min_m))
            || max_range_m.is_some_and(|max_m| range_m > f64::from(max_m))
    }

    /// Prepares a depth image. Each block gets the colour of one of its pixels, and the camera is scaled to match.
    ///
    /// # Errors
    /// If the image is smaller than a block.
    pub fn depth(&self, frame: &mut DepthFrame, sensor: &SensorModel) -> Result<Prepared, FrameError> {
        let mut prepared = Prepared::default();
        if self.min_range_m.is_some() || self.max_range_m.is_some() {
            let camera = frame.camera;
            let is_outside = |raw: u16| self.is_outside(f64::from(camera.depth_m(raw)));
            for raw in frame.raw.iter_mut().filter(|raw| **raw != 0 && is_outside(**raw)) {
                *raw = 0;
                prepared.out_of_range += 1;
            }
        }
        if self.remove_floating {
            prepared.floating = frame.remove_floating(sensor);
        }
        if let Some(k) = self.decimate {
            let blocks = Blocks::new((frame.camera.width, frame.camera.height), k)?;
            let depth_m = |i: usize| f64::from(frame.camera.depth_m(frame.raw[i]));
            let of_blocks = blocks.means(&depth_m, sensor);
            let camera = blocks.camera(&frame.camera);
            let raw = of_blocks.iter().map(|block| block.map_or(0, |(_, mean_m)| camera.raw_depth(mean_m as f32)));
            let raw = raw.collect();
            let rgb = frame.rgb.as_ref().map(|rgb| {
                let pixel = |(i, block): (usize, &Option<(usize, f64)>)| {
                    let pixel = block.map_or_else(|| blocks.middle(i), |(median, _)| median);
                    [rgb[3 * pixel], rgb[3 * pixel + 1], rgb[3 * pixel + 2]]
                };
                of_blocks.iter().enumerate().flat_map(pixel).collect()
            });
            (frame.camera, frame.raw, frame.rgb) = (camera, raw, rgb);
        }
        Ok(prepared)
    }

    /// Prepares an organized cloud. Each block keeps the fields of its pixel with the median range.
    ///
    /// # Errors
    /// If the cloud is malformed, the position of its sensor is unknown, or its grid is smaller than a block.
    pub fn cloud(&self, cloud: &mut OrganizedCloud, sensor: &SensorModel) -> Result<Prepared, FrameError> {
        let mut prepared = Prepared::default();
        if !self.is_empty() && PointsView::from_organized(cloud)?.seen_from().is_none() {
            return Err(FrameError::UnknownSensor);
        }
        if self.min_range_m.is_some() || self.max_range_m.is_some() {
            let ranges_m = PointsView::from_organized(cloud)?.ranges_m();
            for (i, _) in ranges_m.iter().enumerate().filter(|(_, range_m)| self.is_outside(**range_m)) {
                cloud.points.positions.set(i, [f32::NAN; 3]);
                prepared.out_of_range += 1;
            }
        }
        if self.remove_floating {
            prepared.floating = cloud.remove_floating(sensor);
        }
        if let Some(k) = self.decimate {
            let blocks = Blocks::new((cloud.width(), cloud.height()), k)?;
            let ranges_m = PointsView::from_organized(cloud)?.ranges_m();
            let of_blocks = blocks.means(&|i| ranges_m[i], sensor);
            let medians = of_blocks.iter().enumerate();
            let medians = medians.map(|(i, block)| block.map_or_else(|| blocks.middle(i), |(median, _)| median));
            let mut points: PointCloud = cloud.points.select(&medians.collect::<Vec<_>>());
            // The position of each block is the mean of its points on the same surface as the point with the median
            // range.
            for (i, block) in of_blocks.iter().enumerate() {
                let point = block.map_or([f32::NAN; 3], |(median, _)| {
                    let is_same = |j: &usize| same_surface(ranges_m[*j], ranges_m[median], sensor);
                    let same: Vec<usize> = blocks.pixels(i).filter(is_same).collect();
                    let sum = same.iter().fold([0.0f64; 3], |sum, &j| {
                        let point = cloud.points.positions.get(j);
                        [0, 1, 2].map(|axis| sum[axis] + f64::from(point[axis]))
                    });
                    sum.map(|sum| (sum / same.len() as f64) as f32)
                });
                points.positions.set(i, point);
            }
            points.exact_m = None;
            let camera = cloud.camera.map(|camera| blocks.camera(&camera));
            *cloud = OrganizedCloud::new(blocks.columns, blocks.rows, points)?;
            cloud.camera = camera;
        }
        Ok(prepared)
    }
}

/// Blocks of k by k pixels; incomplete blocks at the right and lower borders are dropped.
struct Blocks {
    width: usize,
    k: usize,
    columns: usize,
    rows: usize,
}

impl Blocks {
    fn new((width, height): (usize, usize), k: u32) -> Result<Self, FrameError> {
        let k = k as usize;
        let (columns, rows) = (width / k.max(1), height / k.max(1));
        if columns == 0 || rows == 0 {
            return Err(FrameError::BadShape { width, height, allowed: "at least one block of pixels (decimate)" });
        }
        Ok(Self { width, k, columns, rows })
    }

    /// Returns the pixels of a block.
    fn pixels(&self, block: usize) -> impl Iterator<Item = usize> + use<> {
        let (u, v) = (block % self.columns * self.k, block / self.columns * self.k);
        let (width, k) = (self.width, self.k);
        (0..k * k).map(move |i| (v + i / k) * width + u + i % k)
    }

    /// Returns the pixel in the middle of a block.
    fn middle(&self, block: usize) -> usize {
        let (u, v) = (block % self.columns * self.k, block / self.columns * self.k);
        (v + self.k / 2) * self.width + u + self.k / 2
    }

    /// Returns the pixel with the median range of each block, and the mean of the ranges on the same surface; `None` if
    /// more than half of the block's pixels are holes.
    fn means(&self, range_m: &(impl Fn(usize) -> f64 + Sync), sensor: &SensorModel) -> Vec<Option<(usize, f64)>> {
        let of_block = |block: usize| {
            let mut found: Vec<(f64, usize)> =
                self.pixels(block).map(|i| (range_m(i), i)).filter(|(range_m, _)| *range_m > 0.0).collect();
            found.sort_by(|a, b| a.0.total_cmp(&b.0));
            let &(median_m, pixel) = found.get(found.len().saturating_sub(1) / 2)?;
            if 2 * found.len() < self.k * self.k {
                return None;
            }
            let same = found.iter().map(|(range_m, _)| *range_m).filter(|&m| same_surface(m, median_m, sensor));
            let (sum, count) = same.fold((0.0, 0.0), |(sum, count), range_m| (sum + range_m, count + 1.0));
            Some((pixel, sum / count))
        };
        (0..self.columns * self.rows).into_par_iter().with_min_len(self.columns).map(of_block).collect()
    }

    /// Returns the camera of the smaller image.
    fn camera(&self, camera: &Camera) -> Camera {
        let k = self.k as f64;
        Camera {
            width: self.columns,
            height: self.rows,
            fx: camera.fx / k,
            fy: camera.fy / k,
            // Pixel centres are at integer coordinates.
            cx: (camera.cx + 0.5) / k - 0.5,
            cy: (camera.cy + 0.5) / k - 0.5,
            ..*camera
        }
    }
}

fn same_surface(range_m: f64, median_m: f64, sensor: &SensorModel) -> bool {
    let near_m = (SAME_SURFACE_DEVIATIONS * sensor.sigma_m(median_m)).max(SAME_SURFACE_SHARE * median_m);
    (range_m - median_m).abs() <= near_m
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame() -> DepthFrame {
        let camera = Camera::new((9, 6), [20.0; 2], [3.5, 2.5]);
        // A step between the blocks of 2x2 pixels, and one within them.
        let raw =
            (0..54).map(|i| if i % 9 < 4 || (i % 9 == 4 && i / 9 < 2) { 1000 + 2 * (i as u16 % 2) } else { 2000 });
        DepthFrame::new(camera, raw.collect()).unwrap().with_rgb((0..162).map(|i| i as u8).collect())
    }

    fn prepared(settings: Preparation) -> DepthFrame {
        let mut frame = frame();
        settings.validate().unwrap();
        settings.depth(&mut frame, &SensorModel::KINECT_V1).unwrap();
        frame
    }

    #[test]
    fn blocks_are_means_of_one_surface_and_the_camera_is_scaled() {
        let half = prepared(Preparation { decimate: Some(2), ..Preparation::default() });
        let Camera { width, height, fx, fy, cx, cy, .. } = half.camera;
        assert_eq!((width, height, fx, fy, cx, cy), (4, 3, 10.0, 10.0, 1.5, 1.0));
        // The third column has both surfaces in its first row, and the median is the nearer one.
        assert_eq!(half.raw, [1001, 1001, 1001, 2000, 1001, 1001, 2000, 2000, 1001, 1001, 2000, 2000]);
        assert_eq!(half.rgb.as_ref().map(Vec::len), Some(36));
        // The same surface, whether depth or points are decimated.
        let mut cloud = frame().deproject().unwrap();
        let settings = Preparation { decimate: Some(2), ..Preparation::default() };
        settings.cloud(&mut cloud, &SensorModel::KINECT_V1).unwrap();
        let expected = half.deproject().unwrap();
        assert_eq!((cloud.width(), cloud.height(), cloud.camera), (4, 3, Some(half.camera)));
        for (found, expected) in cloud.positions().iter().zip(expected.positions().iter()) {
            // Raw values are rounded to millimetres, and the mean point of a block may be off the ray through its
            // middle.
            assert!((found[2] - expected[2]).abs() < 1e-3 && (found[0] - expected[0]).abs() < 0.06, "{found:?}");
        }
        assert!(cloud.points.attribute("rgb").is_some_and(|rgb| rgb.values.len() == 12));
    }

    #[test]
    fn ranges_are_cut_off_and_nonsense_is_refused() {
        let far = prepared(Preparation { max_range_m: Some(1.5), ..Preparation::default() });
        assert_eq!(far.raw.iter().filter(|raw| **raw == 0).count(), 28);
        let near = prepared(Preparation { min_range_m: Some(1.5), ..Preparation::default() });
        assert_eq!(near.raw.iter().filter(|raw| **raw == 0).count(), 26);
        let mut cloud = frame().deproject().unwrap();
        let settings = Preparation { max_range_m: Some(1.5), ..Preparation::default() };
        assert_eq!(settings.cloud(&mut cloud, &SensorModel::KINECT_V1).unwrap().out_of_range, 28);
        for (wrong, field) in [
            (Preparation { min_range_m: Some(-1.0), ..Preparation::default() }, "min_range_m"),
            (Preparation { min_range_m: Some(2.0), max_range_m: Some(2.0), ..Preparation::default() }, "max_range_m"),
            (Preparation { decimate: Some(9), ..Preparation::default() }, "decimate"),
        ] {
            assert_eq!(wrong.validate().unwrap_err().field, field);
        }
        let eighth = Preparation { decimate: Some(8), ..Preparation::default() };
        assert!(eighth.depth(&mut frame(), &SensorModel::KINECT_V1).is_err());
    }
}
