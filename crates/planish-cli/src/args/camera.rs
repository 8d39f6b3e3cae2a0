//! The camera of a depth image.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use planish::Camera;

#[derive(clap::Args)]
pub struct CameraArgs {
    /// Intrinsics of the depth camera in pixels
    #[arg(long, value_name = "FX,FY,CX,CY", conflicts_with = "camera_file")]
    pub camera: Option<Intrinsics>,
    /// Intrinsics as JSON: fx, fy, cx, cy, or Open3D's intrinsic_matrix
    #[arg(long, value_name = "FILE.json")]
    pub camera_file: Option<PathBuf>,
    /// Depth units in a metre: 1000 for millimetres, 5000 for TUM and ICL-NUIM
    #[arg(long, value_name = "UNITS_PER_METRE")]
    pub depth_scale: Option<f64>,
}

impl CameraArgs {
    /// The camera for frames of this shape; `None` if the user gave none.
    pub fn camera(&self, (width, height): (usize, usize)) -> Result<Option<Camera>> {
        let mut camera = match (&self.camera, &self.camera_file) {
            (Some(Intrinsics([fx, fy, cx, cy])), _) => {
                Camera { width, height, fx: *fx, fy: *fy, cx: *cx, cy: *cy, ..Camera::kinect_v1() }
            }
            (None, Some(file)) => read_camera(file, (width, height))?,
            (None, None) => return Ok(None),
        };
        if let Some(scale) = self.depth_scale {
            camera.depth_units_per_metre = scale;
        }
        camera.validate()?;
        Ok(Some(camera))
    }

    /// The camera for frames whose shape is not known yet: 0x0 where it was not said.
    pub fn camera_of_any_shape(&self) -> Result<Option<Camera>> {
        let mut camera = match (&self.camera, &self.camera_file) {
            (Some(Intrinsics([fx, fy, cx, cy])), _) => {
                Camera { width: 0, height: 0, fx: *fx, fy: *fy, cx: *cx, cy: *cy, ..Camera::kinect_v1() }
            }
            (None, Some(file)) => {
                let text = fs::read_to_string(file).with_context(|| file.display().to_string())?;
                Camera::from_json_of_any_shape(&text).with_context(|| file.display().to_string())?
            }
            (None, None) => return Ok(None),
        };
        if let Some(scale) = self.depth_scale {
            camera.depth_units_per_metre = scale;
        }
        // Whatever the shape is to be, the rest must describe a camera.
        Camera { width: camera.width.max(1), height: camera.height.max(1), ..camera }.validate()?;
        Ok(Some(camera))
    }

    /// The camera, which a depth image cannot do without.
    pub fn required(&self, shape: (usize, usize), file: &Path) -> Result<Camera> {
        let (width, height) = shape;
        self.camera(shape)?.with_context(|| {
            format!(
                "{}: a depth image of {width}x{height} needs its camera: add --camera FX,FY,CX,CY or --camera-file \
                 FILE.json, and --depth-scale if a unit is not a millimetre (Kinect v1: --camera 525,525,319.5,239.5)",
                file.display()
            )
        })
    }
}

/// fx, fy, cx, cy in pixels.
#[derive(Clone, Copy)]
pub struct Intrinsics([f64; 4]);

impl std::str::FromStr for Intrinsics {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers: Option<Vec<f64>> = text.split(',').map(|number| number.trim().parse().ok()).collect();
        numbers.and_then(|numbers| numbers.try_into().ok()).map(Self).ok_or_else(|| "4 numbers: FX,FY,CX,CY".to_owned())
    }
}

fn read_camera(file: &Path, shape: (usize, usize)) -> Result<Camera> {
    let text = fs::read_to_string(file).with_context(|| file.display().to_string())?;
    Camera::from_json(&text, shape).with_context(|| file.display().to_string())
}
