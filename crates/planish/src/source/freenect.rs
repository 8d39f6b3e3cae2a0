//! Recordings of libfreenect: a folder with INDEX.txt, depth in d-*.pgm, colour in r-*.ppm, as its tool `fakenect-record` writes.
//!
//! Depth there is the Kinect's raw 11-bit disparity, two bytes a pixel, least significant first; 2047 is a hole. A name is
//! KIND-SECONDS-TICKS.EXTENSION, in the order of time.

use std::f64::consts::PI;
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use super::{Source, SourceFrame, malformed, with_shape};
use crate::camera::Camera;
use crate::error::{Error, IoError};
use crate::frame::DepthFrame;
use crate::io;

/// Raw disparities from here on are holes.
const HOLE_DISPARITY: u16 = 2047;

const REACH_M: f64 = 10.0;

/// The infrared camera, which raw disparity is in: N. Burrus, "Kinect calibration", 2011.
const INFRARED_CAMERA: Camera = Camera {
    width: 640,
    height: 480,
    fx: 594.21434,
    fy: 591.04054,
    cx: 339.30781,
    cy: 242.73914,
    depth_units_per_metre: 1000.0,
};

/// Depth in metres of a Kinect v1's raw 11-bit disparity: z = 0.1236 tan(d/2842.5 + 1.1863), the fit of S. Magnenat
/// (OpenKinect, "Imaging Information", 2010), good to some 4 mm at 1 m. NaN for a hole, and beyond the 10 m that the sensor reaches.
pub fn disparity_depth_m(disparity: u16) -> f64 {
    let angle = f64::from(disparity) / 2842.5 + 1.1863;
    // The tangent is negative once it has passed its pole.
    let depth_m = 0.1236 * angle.tan();
    if disparity < HOLE_DISPARITY && angle < 0.5 * PI && depth_m <= REACH_M { depth_m } else { f64::NAN }
}

/// The disparity whose depth is nearest; a hole for what is out of reach.
fn depth_disparity(depth_m: f32) -> u16 {
    let disparity = ((f64::from(depth_m) / 0.1236).atan() - 1.1863) * 2842.5;
    if disparity >= 0.0 && disparity < f64::from(HOLE_DISPARITY) { disparity.round() as u16 } else { HOLE_DISPARITY }
}

/// A Kinect's depth frame from its raw disparities, two bytes each, least significant first: millimetres.
pub(super) fn frame_of_disparities(bytes: &[u8], camera: Option<Camera>, timestamp_s: Option<f64>) -> DepthFrame {
    let camera = with_shape(camera.unwrap_or(INFRARED_CAMERA), (640, 480));
    let camera = Camera { depth_units_per_metre: 1000.0, ..camera };
    let disparities = bytes.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]]));
    let raw = disparities.map(|disparity| camera.raw_depth(disparity_depth_m(disparity) as f32)).collect();
    DepthFrame { camera, raw, rgb: None, timestamp_s }
}

/// Reads the depth of a recording. Its colour is not registered to the depth and is left out.
pub struct FreenectRecording {
    files: Vec<PathBuf>,
    camera: Option<Camera>,
    next: usize,
}

impl FreenectRecording {
    /// Opens the folder that has INDEX.txt. Without a camera it is a usual Kinect's infrared one.
    pub fn open(folder: &Path, camera: Option<Camera>) -> Result<Self, Error> {
        let index = folder.join("INDEX.txt");
        let text =
            fs::read_to_string(&index).map_err(|error| IoError { path: index.clone(), problem: error.into() })?;
        let names = text.lines().map(str::trim).filter(|name| name.starts_with("d-"));
        let files: Vec<PathBuf> = names.map(|name| folder.join(name)).collect();
        if files.is_empty() {
            return Err(malformed(&index, "lists no depth images (d-*.pgm)").into());
        }
        Ok(Self { files, camera, next: 0 })
    }
}

impl Source for FreenectRecording {
    fn next_frame(&mut self) -> Result<Option<SourceFrame>, Error> {
        let Some(file) = self.files.get(self.next) else { return Ok(None) };
        self.next += 1;
        let bytes = fs::read(file).map_err(|error| IoError { path: file.clone(), problem: error.into() })?;
        let pixels = 2 * 640 * 480;
        // The header is one line, "P5 640 480 65535", and the pixels are not in the byte order that PGM asks for.
        let end = bytes.iter().position(|&byte| byte == b'\n').map_or(0, |at| at + 1);
        let header = String::from_utf8_lossy(&bytes[..end]);
        if header.split_whitespace().take(3).ne(["P5", "640", "480"]) || bytes.len() != end + pixels {
            let problem =
                "no depth image of libfreenect: 'P5 640 480 65535' on one line and 614,400 bytes are expected";
            return Err(malformed(file, problem).into());
        }
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        let seconds = name.split('-').nth(1).and_then(|seconds| seconds.parse().ok());
        Ok(Some(SourceFrame::Depth(frame_of_disparities(&bytes[end..], self.camera, seconds))))
    }
}

/// Writes frames of a Kinect v1 as a recording that libfreenect's playback library gives to programs: depth becomes the nearest
/// disparity, colour goes along.
pub fn write_freenect_recording(folder: &Path, frames: &[DepthFrame]) -> Result<(), Error> {
    fs::create_dir_all(folder).map_err(|error| IoError { path: folder.to_path_buf(), problem: error.into() })?;
    let mut index = String::new();
    let mut write = |name: String, bytes: &[u8]| -> Result<(), Error> {
        let path = folder.join(&name);
        io::write_whole(&path, bytes).map_err(|problem| IoError { path, problem })?;
        let _ = writeln!(index, "{name}");
        Ok(())
    };
    for (i, frame) in frames.iter().enumerate() {
        if (frame.camera.width, frame.camera.height) != (640, 480) {
            return Err(malformed(folder, "a recording of libfreenect has frames of 640x480").into());
        }
        let seconds = frame.timestamp_s.unwrap_or(i as f64 / 30.0);
        // The device's clock ticks 60 million times a second.
        let stamp = format!("{seconds:.6}-{}", (seconds * 60e6) as u32);
        if let Some(rgb) = &frame.rgb {
            write(format!("r-{stamp}.ppm"), &[b"P6 640 480 255 \n", &rgb[..]].concat())?;
        }
        let disparities = frame.raw.iter().map(|&raw| depth_disparity(frame.camera.depth_m(raw)));
        let bytes: Vec<u8> = disparities.flat_map(u16::to_le_bytes).collect();
        write(format!("d-{stamp}.pgm"), &[b"P5 640 480 65535 \n", &bytes[..]].concat())?;
    }
    let path = folder.join("INDEX.txt");
    Ok(io::write_whole(&path, index.as_bytes()).map_err(|problem| IoError { path, problem })?)
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
}
