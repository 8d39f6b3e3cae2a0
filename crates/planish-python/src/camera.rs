//! The camera of depth images.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::PathBuf;

use planish::io::CameraFile;
use planish::{Camera, Distortion};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::errors::{frame, to_py, warn};

#[pyclass(frozen, eq, name = "Camera", module = "planish")]
#[derive(Clone, Copy, PartialEq)]
pub struct PyCamera(pub Camera);

/// Arguments from which pickle recreates a camera.
type Arguments = (usize, usize, f64, f64, f64, f64, f64, Vec<f64>, &'static str);

#[pymethods]
impl PyCamera {
    #[new]
    #[pyo3(signature = (width, height, fx, fy, cx=None, cy=None, depth_units_per_metre=1000.0, distortion=None, distortion_model=""))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        width: usize,
        height: usize,
        fx: f64,
        fy: f64,
        cx: Option<f64>,
        cy: Option<f64>,
        depth_units_per_metre: f64,
        distortion: Option<Vec<f64>>,
        distortion_model: &str,
    ) -> PyResult<Self> {
        let middle = |pixels: usize| (pixels as f64 - 1.0) / 2.0;
        let principal = [cx.unwrap_or_else(|| middle(width)), cy.unwrap_or_else(|| middle(height))];
        let mut camera = Camera::new((width, height), [fx, fy], principal);
        camera.depth_units_per_metre = depth_units_per_metre;
        if let Some(coefficients) = distortion {
            camera.distortion = Distortion::of_model(distortion_model, &coefficients)
                .map_err(|error| PyValueError::new_err(format!("distortion: {error}")))?;
        }
        camera.validate().map_err(frame)?;
        Ok(Self(camera))
    }

    #[staticmethod]
    fn kinect_v1() -> Self {
        Self(Camera::kinect_v1())
    }

    #[staticmethod]
    #[pyo3(signature = (path, shape=None))]
    fn read(py: Python<'_>, path: PathBuf, shape: Option<(usize, usize)>) -> PyResult<Self> {
        let shape = shape.map(|(height, width)| (width, height));
        let CameraFile { camera, notes, .. } = planish::io::read_camera_file(&path, shape).map_err(to_py)?;
        warn(py, &path, &notes, 1)?;
        if camera.width == 0 || camera.height == 0 {
            return Err(PyValueError::new_err(format!(
                "{}: the file does not state the image size; give shape=(height, width)",
                path.display()
            )));
        }
        Ok(Self(camera))
    }

    #[getter]
    fn width(&self) -> usize {
        self.0.width
    }

    #[getter]
    fn height(&self) -> usize {
        self.0.height
    }

    #[getter]
    fn fx(&self) -> f64 {
        self.0.fx
    }

    #[getter]
    fn fy(&self) -> f64 {
        self.0.fy
    }

    #[getter]
    fn cx(&self) -> f64 {
        self.0.cx
    }

    #[getter]
    fn cy(&self) -> f64 {
        self.0.cy
    }

    #[getter]
    fn depth_units_per_metre(&self) -> f64 {
        self.0.depth_units_per_metre
    }

    #[getter]
    fn distortion(&self) -> Vec<f64> {
        if self.0.distortion.is_none() { Vec::new() } else { self.0.distortion.coefficients() }
    }

    #[getter]
    fn distortion_model(&self) -> &'static str {
        self.0.distortion.model()
    }

    fn __repr__(&self) -> String {
        let Camera { width, height, fx, fy, cx, cy, depth_units_per_metre: units, .. } = self.0;
        let mut text = format!("Camera({width}, {height}, {fx:?}, {fy:?}, {cx:?}, {cy:?}");
        if units != 1000.0 {
            text += &format!(", depth_units_per_metre={units:?}");
        }
        if !self.0.distortion.is_none() {
            text += &format!(", distortion={:?}", self.distortion());
            if self.distortion_model() == "equidistant" {
                text += ", distortion_model=\"equidistant\"";
            }
        }
        text + ")"
    }

    fn __hash__(&self) -> u64 {
        let mut hasher = DefaultHasher::new();
        self.__repr__().hash(&mut hasher);
        hasher.finish()
    }

    fn __getnewargs__(&self) -> Arguments {
        let Camera { width, height, fx, fy, cx, cy, depth_units_per_metre, .. } = self.0;
        let distortion = if self.0.distortion.is_none() { vec![0.0; 4] } else { self.distortion() };
        (width, height, fx, fy, cx, cy, depth_units_per_metre, distortion, self.distortion_model())
    }
}
