//! Draws a rig from above: the fused cloud with a colour per camera, and the cameras with their directions.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use glam::{DVec2, DVec3};

use super::fused::CAMERA_FIELD;
use super::{Rig, RigCamera, RigFrame, RigSink};
use planish_core::{AttributeValues, Error, FrameError, PointCloud};
use planish_io::RgbImage;

/// Width and height of the picture, in pixels.
const SIZE_PX: usize = 1000;
/// Width of the picture's margin, in pixels.
const MARGIN_PX: f64 = 30.0;

/// One colour per camera, repeated for more cameras.
const COLOURS: [[u8; 3]; 8] = [
    [86, 156, 214],
    [230, 140, 60],
    [110, 190, 100],
    [214, 96, 110],
    [170, 130, 210],
    [200, 180, 70],
    [90, 190, 190],
    [220, 130, 190],
];
/// Returns the colour of a camera.
pub(super) fn colour_of(camera: usize) -> [u8; 3] {
    COLOURS[camera % COLOURS.len()]
}

const BACKGROUND: [u8; 3] = [18, 18, 22];

/// Fraction of the points, at either end of an axis, that is ignored when the picture is scaled.
const STRAY_SHARE: f64 = 0.01;

/// Length of the lines that show a camera's view, as a fraction of the picture's width.
const FRUSTUM_SHARE: f64 = 0.08;
/// Tangent of half a camera's field of view if its intrinsics are unknown.
const HALF_VIEW: f64 = 0.6;

/// Draws a rig's fused cloud from above. Up is the axis of the rig's frame closest to the cameras' mean upward
/// direction.
///
/// # Errors
/// If the results contradict their frames.
pub fn top_down(frame: &RigFrame) -> Result<RgbImage, FrameError> {
    let fused = frame.fused()?;
    Ok(draw(&frame.rig, fused))
}

/// Returns the axes of the picture: right, down, and up towards the viewer.
pub(super) fn axes(rig: &Rig) -> [DVec3; 3] {
    // A camera's y axis points down.
    let up: DVec3 = rig.cameras.iter().map(|camera| -axis_of(camera, 1)).sum();
    let signed = [DVec3::X, DVec3::Y, DVec3::Z].into_iter().flat_map(|axis| [axis, -axis]);
    let up = signed.max_by(|a, b| a.dot(up).total_cmp(&b.dot(up))).unwrap_or(DVec3::Z);
    // The rig's x is to the right, unless x is vertical.
    let right = if up.x == 0.0 { DVec3::X } else { DVec3::Y };
    [right, right.cross(up), up]
}

/// Returns an axis of a camera in the rig's frame.
fn axis_of(camera: &RigCamera, axis: usize) -> DVec3 {
    DVec3::from_array(camera.pose.rotation().map(|row| row[axis]))
}

fn draw(rig: &Rig, fused: &PointCloud) -> RgbImage {
    let [right, down, up] = axes(rig);
    let origin = DVec3::from_array(fused.origin_m);
    let points: Vec<(DVec2, f64)> = fused
        .positions
        .iter()
        .map(|p| {
            let p = DVec3::from_array(p.map(f64::from)) + origin;
            (DVec2::new(p.dot(right), p.dot(down)), p.dot(up))
        })
        .collect();
    let lenses = rig.cameras.iter().map(|camera| DVec3::from_array(camera.pose.position_m));
    let lenses: Vec<DVec2> = lenses.map(|lens| DVec2::new(lens.dot(right), lens.dot(down))).collect();
    let (low, high) = bounds(&points, &lenses);
    let scale = (SIZE_PX as f64 - 2.0 * MARGIN_PX) / (high - low).max_element().max(1e-6);
    let shift = (DVec2::splat(SIZE_PX as f64) - scale * (high - low)) / 2.0;
    let to_px = |p: DVec2| scale * (p - low) + shift;
    let mut picture = Picture::new();
    let cameras = match fused.attribute(CAMERA_FIELD).map(|field| &field.values) {
        Some(AttributeValues::U8(cameras)) => &cameras[..],
        _ => &[],
    };
    for (i, (p, height)) in points.iter().enumerate() {
        picture.point(to_px(*p), *height, colour_of(cameras.get(i).copied().unwrap_or(0).into()));
    }
    for (i, (camera, lens)) in rig.cameras.iter().zip(&lenses).enumerate() {
        let half = camera.camera.map_or(HALF_VIEW, |of| of.width.max(1) as f64 / (2.0 * of.fx));
        let length = FRUSTUM_SHARE * SIZE_PX as f64 / scale;
        let ends = [-half, half].map(|side| {
            let ray = axis_of(camera, 2) + side * axis_of(camera, 0);
            *lens + length * DVec2::new(ray.dot(right), ray.dot(down))
        });
        let colour = colour_of(i);
        for (a, b) in [(*lens, ends[0]), (*lens, ends[1]), (ends[0], ends[1])] {
            picture.line(to_px(a), to_px(b), colour);
        }
    }
    picture.image()
}

/// Returns the bounding box of the cameras and of most points.
fn bounds(points: &[(DVec2, f64)], lenses: &[DVec2]) -> (DVec2, DVec2) {
    let span = |of: fn(&DVec2) -> f64| {
        let mut values: Vec<f64> = points.iter().map(|(p, _)| of(p)).collect();
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values.get((share * values.len().saturating_sub(1) as f64) as usize).copied();
        let ends = lenses.iter().map(of).chain(at(STRAY_SHARE)).chain(at(1.0 - STRAY_SHARE));
        ends.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)))
    };
    let (x, y) = (span(|p| p.x), span(|p| p.y));
    (DVec2::new(x.0, y.0), DVec2::new(x.1, y.1))
}

/// The pixels of a picture; each shows the highest point in it.
struct Picture {
    colours: Vec<[u8; 3]>,
    heights: Vec<f64>,
}

impl Picture {
    fn new() -> Self {
        let pixels = SIZE_PX * SIZE_PX;
        Self { colours: vec![BACKGROUND; pixels], heights: vec![f64::NEG_INFINITY; pixels] }
    }

    fn point(&mut self, at: DVec2, height: f64, colour: [u8; 3]) {
        let inside = |value: f64| (0.0..SIZE_PX as f64).contains(&value);
        if inside(at.x) && inside(at.y) {
            let i = at.y as usize * SIZE_PX + at.x as usize;
            if height >= self.heights[i] {
                (self.heights[i], self.colours[i]) = (height, colour);
            }
        }
    }

    fn line(&mut self, from: DVec2, to: DVec2, colour: [u8; 3]) {
        let steps = (to - from).length().ceil().clamp(1.0, 4.0 * SIZE_PX as f64) as usize;
        for step in 0..=steps {
            self.point(from.lerp(to, step as f64 / steps as f64), f64::INFINITY, colour);
        }
    }

    fn image(self) -> RgbImage {
        RgbImage { width: SIZE_PX, height: SIZE_PX, rgb: self.colours.into_iter().flatten().collect() }
    }
}

/// A sink that keeps a picture of the rig in a file and redraws it once per second.
pub struct PictureSink {
    file: PathBuf,
    drawn: Option<Instant>,
}

/// Minimum time between two pictures.
const EVERY: Duration = Duration::from_secs(1);

impl PictureSink {
    /// Creates a sink for a PNG file.
    pub fn create(file: &Path) -> Self {
        Self { file: file.to_path_buf(), drawn: None }
    }
}

impl RigSink for PictureSink {
    fn name(&self) -> String {
        self.file.display().to_string()
    }

    fn write(&mut self, frame: &RigFrame) -> Result<(), Error> {
        if self.drawn.is_none_or(|drawn| drawn.elapsed() >= EVERY) {
            self.drawn = Some(Instant::now());
            planish_io::write_rgb_png(&self.file, &top_down(frame)?)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rig::fuse;
    use planish_core::SensorPose;

    #[test]
    fn cameras_and_their_points_are_where_they_stand() {
        // Two cameras of a robot: x ahead, z up; the second one 2 m to the left.
        let ahead = |y: f64| SensorPose { position_m: [0.0, y, 0.5], orientation: [0.5, -0.5, 0.5, -0.5] };
        let rig = Rig::new(vec![RigCamera::new("a", ahead(0.0)), RigCamera::new("b", ahead(2.0))]).unwrap();
        let [right, down, up] = axes(&rig);
        assert_eq!((right, down, up), (DVec3::X, -DVec3::Y, DVec3::Z));
        let wall = PointCloud::new((0..100).map(|i| [0.01 * i as f32 - 0.5, 0.0, 3.0]).collect());
        let fused = fuse(&[(0, ahead(0.0), &wall), (1, ahead(2.0), &wall)]).unwrap();
        let image = draw(&rig, &fused);
        // The mean position of a colour's pixels: of the cameras in the left half of the picture, or of their walls
        // in the right half.
        let seen = |colour: [u8; 3], right: bool| {
            let at = |i: usize| DVec2::new((i % SIZE_PX) as f64, (i / SIZE_PX) as f64);
            let pixels = image.rgb.chunks_exact(3).enumerate().filter(|(_, pixel)| *pixel == colour);
            let pixels: Vec<DVec2> =
                pixels.map(|(i, _)| at(i)).filter(|p| (p.x > SIZE_PX as f64 / 2.0) == right).collect();
            assert!(pixels.len() > 50, "{}", pixels.len());
            pixels.iter().sum::<DVec2>() / pixels.len() as f64
        };
        // 3 m ahead spans the width of the picture, with the camera on the left; 2 m to the left is upwards.
        let width = SIZE_PX as f64 - 2.0 * MARGIN_PX;
        for right in [false, true] {
            let (a, b) = (seen(COLOURS[0], right), seen(COLOURS[1], right));
            let apart = DVec2::new(0.0, 2.0 / 3.0 * width);
            assert!((a - b - apart).length() < 3.0, "{a} {b}");
        }
        let ends = [false, true].map(|right| seen(COLOURS[0], right).x);
        assert!(ends[0] < 0.1 * SIZE_PX as f64 && (ends[1] - MARGIN_PX - width).abs() < 2.0, "{ends:?}");
    }
}
