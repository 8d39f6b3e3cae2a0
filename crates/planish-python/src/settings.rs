//! What a smoother is opened with, from Python's keyword arguments.

use planish::{
    Edges, Engine, Frame, GpuOptions, OrganizedCloud, Outputs, Project, Radius, SensorModel, SmoothParams,
    SmootherOptions, Strength,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::errors::param;

/// A sensor: known, or to be estimated from the frame.
#[derive(Clone, Copy)]
enum Sensor {
    Known(SensorModel),
    Auto,
}

/// All settings; what is not given comes from the preset.
#[derive(Clone, Default)]
pub struct Settings {
    preset: Option<String>,
    strength: Option<f32>,
    sensor: Option<Sensor>,
    window: Option<u32>,
    stride: Option<u32>,
    average_blocks: Option<bool>,
    radius: Option<Radius>,
    degree: Option<u32>,
    bandwidth_m: Option<f32>,
    ridge: Option<f32>,
    project: Option<Project>,
    edges: Option<Edges>,
    remove_isolated: bool,
    engine: Engine,
    adapter: Option<String>,
    threads: Option<usize>,
}

/// One of some names.
fn named<T: Copy>(what: &str, name: &str, known: &[(&str, T)]) -> PyResult<T> {
    known.iter().find(|(known, _)| *known == name).map(|&(_, value)| value).ok_or_else(|| {
        let names: Vec<String> = known.iter().map(|(name, _)| format!("{name:?}")).collect();
        PyValueError::new_err(format!("{what} = {name:?} is not allowed: {}", names.join(", ")))
    })
}

/// The sensor of a name.
pub fn sensor_named(name: &str) -> PyResult<SensorModel> {
    named("sensor", name, &SensorModel::NAMED)
}

impl Settings {
    /// Reads every item of the dictionary; `None` is what is not given.
    pub fn from_dict(given: &Bound<'_, PyDict>) -> PyResult<Self> {
        let mut settings = Self::default();
        for (key, value) in given.iter().filter(|(_, value)| !value.is_none()) {
            let key: String = key.extract()?;
            settings.set(&key, &value).map_err(|error| named_in(given.py(), error, &key))?;
        }
        if settings.preset.is_some() && settings.strength.is_some() {
            return Err(PyValueError::new_err("preset and strength are two ways to say the same: give one"));
        }
        // Refused here rather than with the first frame.
        settings.params(None, false)?.validate().map_err(param)?;
        settings.params(None, true)?.validate().map_err(param)?;
        Ok(settings)
    }

    fn set(&mut self, key: &str, value: &Bound<'_, PyAny>) -> PyResult<()> {
        let text = || value.extract::<String>();
        match key {
            "preset" => {
                let name = text()?;
                named("preset", &name, &["light", "default", "strong", "paper"].map(|name| (name, ())))?;
                self.preset = Some(name);
            }
            "strength" => self.strength = Some(value.extract()?),
            "sensor" => {
                let name = text()?;
                let known = SensorModel::NAMED.map(|(name, model)| (name, Sensor::Known(model)));
                self.sensor = Some(named("sensor", &name, &[&known[..], &[("auto", Sensor::Auto)]].concat())?);
            }
            "window" => self.window = Some(value.extract()?),
            "stride" => self.stride = Some(value.extract()?),
            "average_blocks" => self.average_blocks = Some(value.extract()?),
            "radius" if value.extract::<&str>().is_ok() => {
                self.radius = Some(named("radius", &text()?, &[("sensor", Radius::Sensor)])?);
            }
            "radius" => self.radius = Some(Radius::Fixed { radius_m: value.extract()? }),
            "neighbours" => self.radius = Some(Radius::Neighbours { count: value.extract()? }),
            "degree" => self.degree = Some(value.extract()?),
            "bandwidth" => self.bandwidth_m = Some(value.extract()?),
            "ridge" => self.ridge = Some(value.extract()?),
            "project" => {
                let known = [("ray", Project::Ray), ("normal", Project::Normal)];
                self.project = Some(named("project", &text()?, &known)?);
            }
            "edges" => {
                self.edges = Some(named("edges", &text()?, &[("off", Edges::Off), ("robust", Edges::Robust)])?);
            }
            "remove_isolated" => self.remove_isolated = value.extract()?,
            "engine" => {
                let known = Engine::ALL.map(|engine| (engine.name(), engine));
                self.engine = named("engine", &text()?, &[&known[..], &[("auto", Engine::Auto)]].concat())?;
            }
            "adapter" => self.adapter = Some(value.str()?.extract()?),
            "threads" => self.threads = Some(value.extract()?),
            _ => return Err(PyTypeError::new_err(format!("there is no setting {key:?}"))),
        }
        Ok(())
    }

    /// The parameters for a frame, whose resolution they follow; `cloud` is what a sensor is estimated from.
    pub fn params_for(&self, frame: Frame<'_>, cloud: Option<&OrganizedCloud>) -> PyResult<SmoothParams> {
        let params = self.params(cloud, frame.grid().is_none())?;
        Ok(if self.follows_resolution() { params.at_resolution_of(frame) } else { params })
    }

    /// Whether windows and strides follow the resolution of frames.
    pub fn follows_resolution(&self) -> bool {
        self.window.is_none() && self.stride.is_none() && self.preset.as_deref() != Some("paper")
    }

    /// The parameters for frames on a grid before one is there.
    pub fn fixed_params(&self) -> PyResult<SmoothParams> {
        self.params(None, false)
    }

    fn params(&self, cloud: Option<&OrganizedCloud>, is_general: bool) -> PyResult<SmoothParams> {
        let sensor = match (self.sensor, cloud) {
            (None, _) | (Some(Sensor::Auto), None) => SensorModel::KINECT_V1,
            (Some(Sensor::Known(model)), _) => model,
            (Some(Sensor::Auto), Some(cloud)) => SensorModel::estimate(cloud).ok_or_else(|| {
                PyValueError::new_err(
                    "sensor = \"auto\": too few depths to estimate a sensor from; name one, as \"kinect1\"",
                )
            })?,
        };
        let mut params = match (self.strength, self.preset.as_deref(), is_general) {
            (_, Some("paper"), _) => SmoothParams::paper(),
            (_, _, true) => SmoothParams::general(),
            (Some(strength), ..) => SmoothParams::for_sensor(sensor, Strength::new(strength).map_err(param)?),
            (None, Some("light"), _) => SmoothParams::for_sensor(sensor, Strength::LIGHT),
            (None, Some("strong"), _) => SmoothParams::for_sensor(sensor, Strength::STRONG),
            (None, ..) => SmoothParams::for_sensor(sensor, Strength::DEFAULT),
        };
        params.sensor = sensor;
        params.window = self.window.unwrap_or(params.window);
        params.stride = self.stride.unwrap_or(params.stride);
        params.average_blocks = self.average_blocks.unwrap_or(params.average_blocks);
        params.radius = self.radius.unwrap_or(params.radius);
        params.degree = self.degree.unwrap_or(params.degree);
        params.bandwidth_m = self.bandwidth_m.or(params.bandwidth_m);
        params.ridge = self.ridge.unwrap_or(params.ridge);
        params.project = self.project.unwrap_or(params.project);
        params.edges = self.edges.unwrap_or(params.edges);
        params.remove_isolated = self.remove_isolated;
        Ok(params)
    }

    /// The sensor, where it is known; else a Kinect v1.
    pub fn known_sensor(&self) -> SensorModel {
        match self.sensor {
            Some(Sensor::Known(model)) => model,
            None | Some(Sensor::Auto) => SensorModel::KINECT_V1,
        }
    }

    /// Whether a sensor is to be estimated.
    pub fn needs_estimate(&self) -> bool {
        matches!(self.sensor, Some(Sensor::Auto))
    }

    pub fn engine(&self) -> Engine {
        self.engine
    }

    pub fn options(&self, outputs: Outputs) -> SmootherOptions {
        let gpu = GpuOptions::default().with_adapter(self.adapter.clone());
        SmootherOptions::new(self.engine, outputs).with_threads(self.threads).with_gpu(gpu)
    }
}

/// The same error with the setting's name, where Python could not convert a value.
fn named_in(py: Python<'_>, error: PyErr, key: &str) -> PyErr {
    let text = error.value(py).to_string();
    if error.is_instance_of::<PyTypeError>(py) && !text.contains("there is no setting") {
        return PyTypeError::new_err(format!("{key}: {text}"));
    }
    if error.is_instance_of::<pyo3::exceptions::PyOverflowError>(py) {
        return PyValueError::new_err(format!("{key}: {text}"));
    }
    error
}
