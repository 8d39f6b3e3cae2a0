//! libfreenect recordings: a folder with INDEX.txt, depth in d-*.pgm and colour in r-*.ppm, as written by its tool
//! `fakenect-record`.
//!
//! Depth is the Kinect's raw 11-bit disparity, two bytes per pixel, little-endian; 2047 is a hole. Files are named
//! KIND-SECONDS-TICKS.EXTENSION, in order of time. Disparity comes from the infrared camera and colour from the
//! colour camera: each point gets the colour of the colour camera's pixel that it projects to.

use std::f64::consts::PI;
#[cfg(any(test, feature = "internal"))]
use std::fmt::Write;
#[cfg(any(test, feature = "internal"))]
use std::fs;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};

use super::{OwnedFrame, Source, malformed, with_shape};
use planish_core::{Camera, DepthFrame, Error, FormatError, IoError};
use planish_io::{self as io, ReadOptions};

/// Smallest raw disparity that marks a hole.
const HOLE_DISPARITY: u16 = 2047;

const REACH_M: f64 = 10.0;

/// Maximum size of INDEX.txt in bytes, enough for a day of frames.
const LARGEST_INDEX: u64 = 256 << 20;
/// Maximum length of an image's header in bytes.
const LONGEST_HEADER: usize = 1024;

/// The infrared camera, which measures raw disparities: N. Burrus, "Kinect calibration", 2011.
const INFRARED_CAMERA: Camera = Camera::new((640, 480), [594.21434, 591.04054], [339.30781, 242.73914]);

/// The colour camera, from the same reference as [`INFRARED_CAMERA`].
const COLOUR_CAMERA: Camera = Camera::new((640, 480), [529.21508, 525.56394], [328.94272, 267.48068]);
/// Rotation from the infrared camera to the colour camera, from the same reference as [`INFRARED_CAMERA`]. Axes follow
/// our convention: x to the right, y down.
const COLOUR_FROM_INFRARED: DMat3 = DMat3::from_cols_array(&[
    0.999_846_29,
    -0.001_477_91,
    0.017_470_42,
    0.001_263_54,
    0.999_923_86,
    0.012_275_34,
    -0.017_487_23,
    -0.012_251_38,
    0.999_772_02,
]);
const COLOUR_OFFSET_M: DVec3 = DVec3::new(0.019_985_24, -0.000_744_24, -0.010_916_74);

/// Returns the colour of each pixel of a depth frame that was computed from disparities: black for holes and for
/// points outside the colour camera's image.
fn colour_of_depth(frame: &DepthFrame, rgb: &[u8]) -> Vec<u8> {
    let camera = &frame.camera;
    let colour_at = |(i, &raw): (usize, &u16)| -> Option<[u8; 3]> {
        let z = f64::from(camera.depth_m(raw));
        let (u, v) = ((i % camera.width) as f64, (i / camera.width) as f64);
        let seen = DVec3::new((u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy, z);
        let at = COLOUR_FROM_INFRARED * seen + COLOUR_OFFSET_M;
        let (u, v) = (COLOUR_CAMERA.fx * at.x / at.z, COLOUR_CAMERA.fy * at.y / at.z);
        let (u, v) = ((u + COLOUR_CAMERA.cx).round(), (v + COLOUR_CAMERA.cy).round());
        // False for holes, which are NaN.
        let inside = (0.0..640.0).contains(&u) && (0.0..480.0).contains(&v);
        let pixel = inside.then(|| 640 * v as usize + u as usize)?;
        rgb.get(3 * pixel..3 * pixel + 3)?.try_into().ok()
    };
    frame.raw.iter().enumerate().flat_map(|pixel| colour_at(pixel).unwrap_or_default()).collect()
}

/// Returns the depth in metres of a Kinect v1's raw 11-bit disparity: z = 0.1236 tan(d/2842.5 + 1.1863), the fit of
/// S. Magnenat (OpenKinect, "Imaging Information", 2010), accurate to about 4 mm at 1 m. NaN for a hole, and beyond
/// the sensor's range of 10 m.
pub fn disparity_depth_m(disparity: u16) -> f64 {
    let angle = f64::from(disparity) / 2842.5 + 1.1863;
    // The tangent is negative beyond its pole.
    let depth_m = 0.1236 * angle.tan();
    if disparity < HOLE_DISPARITY && angle < 0.5 * PI && depth_m <= REACH_M { depth_m } else { f64::NAN }
}

/// Returns the disparity whose depth is nearest; a hole for depths out of range.
#[cfg(any(test, feature = "internal"))]
fn depth_disparity(depth_m: f32) -> u16 {
    let disparity = ((f64::from(depth_m) / 0.1236).atan() - 1.1863) * 2842.5;
    if disparity >= 0.0 && disparity < f64::from(HOLE_DISPARITY) { disparity.round() as u16 } else { HOLE_DISPARITY }
}

/// Converts a Kinect's raw disparities, two bytes each, least significant first, to a depth frame in millimetres.
/// `rgb` is the image of the Kinect's colour camera.
pub(super) fn frame_of_disparities(
    bytes: &[u8],
    rgb: Option<&[u8]>,
    camera: Option<Camera>,
    timestamp_s: Option<f64>,
) -> DepthFrame {
    let camera = with_shape(camera.unwrap_or(INFRARED_CAMERA), (640, 480));
    let camera = camera.with_depth_units_per_metre(1000.0);
    let disparities = bytes.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]]));
    let raw = disparities.map(|disparity| camera.raw_depth(disparity_depth_m(disparity) as f32)).collect();
    let mut frame = DepthFrame::unchecked(camera, raw);
    frame.timestamp_s = timestamp_s;
    let rgb = rgb.map(|rgb| colour_of_depth(&frame, rgb));
    frame.rgb = rgb;
    frame
}

/// A source that reads a recording: every depth image, with the last colour image taken before it.
pub struct FreenectRecording {
    /// The files of each depth image and its colour image.
    files: Vec<(PathBuf, Option<PathBuf>)>,
    camera: Option<Camera>,
    next: usize,
}

impl FreenectRecording {
    /// Opens the folder that has INDEX.txt. The default camera is the infrared camera of a typical Kinect.
    pub fn open(folder: &Path, camera: Option<Camera>) -> Result<Self, Error> {
        let index = folder.join("INDEX.txt");
        let text = io::read_bytes(&index, &ReadOptions::default().with_max_memory_bytes(LARGEST_INDEX));
        let text = text.map_err(|error| match error {
            FormatError::TooLarge { .. } => malformed(&index, "the index is larger than 256 MiB"),
            error => IoError::at(&index)(error),
        })?;
        let text = String::from_utf8_lossy(&text);
        let (mut files, mut colour) = (Vec::new(), None);
        for name in text.lines().map(str::trim).filter(|name| !name.contains(['/', '\\'])) {
            match name.as_bytes() {
                [b'd', b'-', ..] => files.push((folder.join(name), colour.clone())),
                [b'r', b'-', ..] => colour = Some(folder.join(name)),
                _ => {}
            }
        }
        if files.is_empty() {
            return Err(malformed(&index, "the index lists no depth images (d-*.pgm)").into());
        }
        Ok(Self { files, camera, next: 0 })
    }
}

impl Source for FreenectRecording {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        let Some((file, colour)) = self.files.get(self.next) else { return Ok(None) };
        self.next += 1;
        let disparities = read_netpbm(file, "P5", 2)?;
        // Depth matters more, so an unreadable colour image is skipped.
        let rgb = colour.as_deref().and_then(|colour| read_netpbm(colour, "P6", 3).ok());
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        let seconds = name.split('-').nth(1).and_then(|seconds| seconds.parse().ok());
        Ok(Some(OwnedFrame::Depth(frame_of_disparities(&disparities, rgb.as_deref(), self.camera, seconds))))
    }
}

/// Returns the pixel bytes of an image in a recording. The image has a header of one line, such as "P5 640 480
/// 65535", and its 16-bit pixels are little-endian, contrary to the PGM standard.
fn read_netpbm(file: &Path, kind: &str, bytes_a_pixel: usize) -> Result<Vec<u8>, Error> {
    let pixels = bytes_a_pixel * 640 * 480;
    let most = (pixels + LONGEST_HEADER) as u64;
    let mut bytes = match io::read_bytes(file, &ReadOptions::default().with_max_memory_bytes(most)) {
        // A file of another size is not a libfreenect image.
        Err(FormatError::TooLarge { .. }) => Vec::new(),
        bytes => bytes.map_err(IoError::at(file))?,
    };
    let end = bytes.iter().position(|&byte| byte == b'\n').map_or(0, |at| at + 1);
    let header = String::from_utf8_lossy(&bytes[..end]);
    if header.split_whitespace().take(3).ne([kind, "640", "480"]) || bytes.len() != end + pixels {
        let problem = format!(
            "not a libfreenect image; expected '{kind} 640 480 ..' on the first line, followed by {pixels} bytes"
        );
        return Err(malformed(file, problem).into());
    }
    Ok(bytes.split_off(end))
}

/// Writes frames of a Kinect v1 as a recording for libfreenect's playback library: depth as the nearest disparity, with
/// colour.
#[cfg(any(test, feature = "internal"))]
pub fn write_freenect_recording(folder: &Path, frames: &[DepthFrame]) -> Result<(), Error> {
    fs::create_dir_all(folder).map_err(|error| IoError { path: folder.to_path_buf(), problem: error.into() })?;
    let mut index = String::new();
    let mut write = |name: String, bytes: &[u8]| -> Result<(), Error> {
        let path = folder.join(&name);
        planish_io::write_whole(&path, bytes).map_err(|problem| IoError { path, problem })?;
        let _ = writeln!(index, "{name}");
        Ok(())
    };
    for (i, frame) in frames.iter().enumerate() {
        if (frame.camera.width, frame.camera.height) != (640, 480) {
            return Err(malformed(folder, "a libfreenect recording needs frames of 640x480").into());
        }
        let seconds = frame.timestamp_s.unwrap_or(i as f64 / 30.0);
        // The device's clock ticks 60 million times a second, and wraps after 71 s.
        let stamp = format!("{seconds:.6}-{}", (seconds * 60e6) as u64 as u32);
        if let Some(rgb) = &frame.rgb {
            write(format!("r-{stamp}.ppm"), &[b"P6 640 480 255 \n", &rgb[..]].concat())?;
        }
        let disparities = frame.raw.iter().map(|&raw| depth_disparity(frame.camera.depth_m(raw)));
        let bytes: Vec<u8> = disparities.flat_map(u16::to_le_bytes).collect();
        write(format!("d-{stamp}.pgm"), &[b"P5 640 480 65535 \n", &bytes[..]].concat())?;
    }
    let path = folder.join("INDEX.txt");
    Ok(planish_io::write_whole(&path, index.as_bytes()).map_err(|problem| IoError { path, problem })?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn disparities_come_back_from_their_depths() {
        for disparity in 330..1000 {
            let depth_m = disparity_depth_m(disparity) as f32;
            assert_eq!(depth_disparity(depth_m), disparity);
        }
        assert!((disparity_depth_m(800) - 1.195).abs() < 0.001);
        assert!(disparity_depth_m(HOLE_DISPARITY).is_nan() && disparity_depth_m(1093).is_nan());
        assert_eq!(depth_disparity(f32::NAN), HOLE_DISPARITY);
    }

    #[test]
    fn a_point_takes_the_colour_of_the_pixel_that_the_colour_camera_saw_it_in() {
        // The colour camera's picture: red is the column, green the row, both divided by 4 to fit a byte.
        let rgb: Vec<u8> = (0..640 * 480).flat_map(|i| [((i % 640) / 4) as u8, ((i / 640) / 4) as u8, 77]).collect();
        let disparity = depth_disparity(1.0);
        let mut bytes = disparity.to_le_bytes().repeat(640 * 480);
        bytes[..2].copy_from_slice(&HOLE_DISPARITY.to_le_bytes());
        let frame = frame_of_disparities(&bytes, Some(&rgb), None, None);
        let colours = frame.rgb.unwrap();
        assert_eq!(colours[..3], [0; 3], "a hole has no colour");
        // The point straight ahead at 1 m is 2 cm to the right of the colour camera's axis, which is turned by a
        // degree.
        let i = 3 * (640 * 243 + 339);
        let z = f64::from(frame.camera.depth_m(frame.raw[640 * 243 + 339]));
        let u = COLOUR_CAMERA.cx + COLOUR_CAMERA.fx * (0.019_985 - 0.017_487 * z) / (0.999_772 * z - 0.010_917);
        let v = COLOUR_CAMERA.cy + COLOUR_CAMERA.fy * (-0.000_744 - 0.012_251 * z) / (0.999_772 * z - 0.010_917);
        assert!((f64::from(colours[i]) - u / 4.0).abs() <= 1.0, "{} {u}", colours[i]);
        assert!((f64::from(colours[i + 1]) - v / 4.0).abs() <= 1.0, "{} {v}", colours[i + 1]);
        assert_eq!(colours[i + 2], 77);
    }
}
