//! What a smoother takes: a depth frame as the camera gives it, or an organized cloud.

use crate::camera::Camera;
use crate::cloud::{OrganizedCloud, PointCloud, Xyz, validate_shape};
use crate::error::FrameError;

/// A 16-bit depth image, row by row, without the camera that took it. 0 and 65535 are holes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DepthImage {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Raw depth values, width * height of them.
    pub raw: Vec<u16>,
}

/// A depth image with its camera: what a depth sensor delivers.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthFrame {
    /// The camera; its width and height are the image's.
    pub camera: Camera,
    /// Raw depth values, row by row. 0 and 65535 are holes.
    pub raw: Vec<u16>,
    /// Colour registered to the depth image, 3 bytes (red, green, blue) a pixel.
    pub rgb: Option<Vec<u8>>,
    /// When the frame was taken, in seconds of the source's clock.
    pub timestamp_s: Option<f64>,
}

impl DepthFrame {
    /// Puts a depth image and its camera together; refuses a camera of another shape.
    pub fn new(camera: Camera, image: DepthImage) -> Result<Self, FrameError> {
        camera.validate()?;
        if (camera.width, camera.height) != (image.width, image.height) {
            return Err(FrameError::ShapeMismatch {
                frame_width: image.width,
                frame_height: image.height,
                width: camera.width,
                height: camera.height,
            });
        }
        let frame = Self { camera, raw: image.raw, rgb: None, timestamp_s: None };
        frame.validate()?;
        Ok(frame)
    }

    /// Refuses buffers whose lengths do not follow from the camera.
    pub fn validate(&self) -> Result<(), FrameError> {
        validate_shape(self.camera.width, self.camera.height)?;
        let pixels = self.camera.width * self.camera.height;
        if self.raw.len() != pixels {
            return Err(FrameError::LengthMismatch { what: "depth".into(), len: self.raw.len(), expected: pixels });
        }
        match &self.rgb {
            Some(rgb) if rgb.len() != 3 * pixels => {
                Err(FrameError::LengthMismatch { what: "rgb".into(), len: rgb.len(), expected: 3 * pixels })
            }
            _ => Ok(()),
        }
    }

    /// The organized cloud of this frame (docs/method.md, section 1), with colour as PCL's packed `rgb` if there is any.
    pub fn deproject(&self) -> Result<OrganizedCloud, FrameError> {
        self.validate()?;
        let (rays_x, rays_y) = (self.camera.rays_x(), self.camera.rays_y());
        let mut positions = Xyz::filled(self.raw.len(), f32::NAN);
        for (v, row) in self.raw.chunks_exact(self.camera.width).enumerate() {
            for (u, &raw) in row.iter().enumerate() {
                let z = self.camera.depth_m(raw);
                positions.set(v * self.camera.width + u, [rays_x[u] * z, rays_y[v] * z, z]);
            }
        }
        let mut points = PointCloud::new(positions);
        if let Some(rgb) = &self.rgb {
            let packed = rgb.chunks_exact(3).map(|c| u32::from_be_bytes([0, c[0], c[1], c[2]]));
            points.set_attribute("rgb", packed.map(f32::from_bits).collect::<Vec<_>>());
        }
        let mut cloud = OrganizedCloud::new(self.camera.width, self.camera.height, points)?;
        cloud.camera = Some(self.camera);
        Ok(cloud)
    }
}

/// A frame of either kind, borrowed; `smooth` takes anything that converts into it.
#[derive(Debug, Clone, Copy)]
pub enum Frame<'a> {
    /// A depth image with its camera.
    Depth(&'a DepthFrame),
    /// An organized cloud.
    Cloud(&'a OrganizedCloud),
}

impl Frame<'_> {
    /// Width and height in pixels.
    pub fn shape(&self) -> (usize, usize) {
        match self {
            Self::Depth(frame) => (frame.camera.width, frame.camera.height),
            Self::Cloud(cloud) => (cloud.width(), cloud.height()),
        }
    }

    /// The camera, where it is known.
    pub fn camera(&self) -> Option<&Camera> {
        match self {
            Self::Depth(frame) => Some(&frame.camera),
            Self::Cloud(cloud) => cloud.camera.as_ref(),
        }
    }

    /// Metres between neighbouring pixels at 1 m (1/fx): known, estimated, or that of a Kinect v1. `pitches` is working
    /// room for the estimate.
    pub(crate) fn pixel_pitch_at_1m(&self, pitches: &mut Vec<f64>) -> f64 {
        self.known_pitch_at_1m(pitches).unwrap_or(1.0 / Camera::kinect_v1().fx)
    }

    /// The same, but `None` where it can only be guessed.
    pub(crate) fn known_pitch_at_1m(&self, pitches: &mut Vec<f64>) -> Option<f64> {
        match self {
            Self::Depth(frame) => Some(1.0 / frame.camera.fx),
            Self::Cloud(cloud) => cloud.estimate_pitch(pitches),
        }
    }

    pub(crate) fn validate(&self) -> Result<(), FrameError> {
        match self {
            Self::Depth(frame) => {
                frame.camera.validate()?;
                frame.validate()
            }
            // Its positions and camera are public; its shape is not.
            Self::Cloud(cloud) => {
                cloud.positions().check_len("positions", cloud.width() * cloud.height())?;
                let Some(camera) = &cloud.camera else { return Ok(()) };
                camera.validate()?;
                if (camera.width, camera.height) == (cloud.width(), cloud.height()) {
                    return Ok(());
                }
                Err(FrameError::ShapeMismatch {
                    frame_width: cloud.width(),
                    frame_height: cloud.height(),
                    width: camera.width,
                    height: camera.height,
                })
            }
        }
    }
}

impl<'a> From<&'a DepthFrame> for Frame<'a> {
    fn from(frame: &'a DepthFrame) -> Self {
        Self::Depth(frame)
    }
}

impl<'a> From<&'a OrganizedCloud> for Frame<'a> {
    fn from(cloud: &'a OrganizedCloud) -> Self {
        Self::Cloud(cloud)
    }
}
