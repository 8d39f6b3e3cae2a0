//! Settings and cameras as a page gives them.

use planish::{
    Camera, Edges, Frame, OrganizedCloud, ParamError, Project, Radius, SensorModel, SmoothParams, Strength,
    io::{parse_camera, unknown_camera_key},
};
use serde::Deserialize;
use serde_json::Value;

/// Settings; what is missing is the preset's. The names are those of the command's options.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[non_exhaustive]
pub struct Settings {
    /// `light`, `default`, `strong` or `paper`.
    pub preset: Option<String>,
    /// 0 (light) to 1 (strong), instead of a preset.
    pub strength: Option<f32>,
    /// The name of a sensor, or `auto`, which estimates it from the frame.
    pub sensor: Option<String>,
    /// `robust` or `off`.
    pub edges: Option<String>,
    /// Half width of the window in samples, 1 to 7.
    pub window: Option<u32>,
    /// Pixels between samples, 1 to 8.
    pub stride: Option<u32>,
    /// Whether samples are means of blocks of pixels.
    pub average_blocks: Option<bool>,
    /// A fixed radius in metres.
    pub radius: Option<f32>,
    /// Of general clouds, how many neighbours.
    pub neighbours: Option<u32>,
    /// Highest degree of the polynomial, 1 to 3.
    pub degree: Option<u32>,
    /// Ridge of the fit, 1e-3 to 100.
    pub ridge: Option<f32>,
    /// `ray` or `normal`.
    pub project: Option<String>,
}

fn one_of<T: Copy>(field: &str, name: &str, known: &[(&str, T)]) -> Result<T, String> {
    known.iter().find(|(known, _)| *known == name).map(|&(_, value)| value).ok_or_else(|| {
        let names: Vec<&str> = known.iter().map(|&(name, _)| name).collect();
        format!("{field} = {name:?} is not allowed: {}", names.join(", "))
    })
}

impl Settings {
    /// The parameters for a frame; a sensor is estimated from `cloud`.
    pub(crate) fn params(
        &self,
        frame: Frame<'_>,
        cloud: impl FnOnce() -> Option<OrganizedCloud>,
    ) -> Result<SmoothParams, String> {
        let text = |error: ParamError| error.to_string();
        let is_general = frame.grid().is_none();
        let sensor = match self.sensor.as_deref() {
            None => SensorModel::KINECT_V1,
            Some("auto") => cloud()
                .as_ref()
                .and_then(SensorModel::estimate)
                .ok_or("sensor = auto: too few depths to estimate a sensor from; name one, as kinect1")?,
            Some(name) => one_of("sensor", name, &SensorModel::NAMED)?,
        };
        let preset = self.preset.as_deref().unwrap_or("default");
        let presets = [("light", Some(Strength::LIGHT)), ("default", Some(Strength::DEFAULT))];
        let presets = [&presets[..], &[("strong", Some(Strength::STRONG)), ("paper", None)]].concat();
        let strength = match self.strength {
            Some(_) if self.preset.is_some() => return Err("give a preset or a strength, not both".to_owned()),
            Some(strength) => Some(Strength::new(strength).map_err(text)?),
            None => one_of("preset", preset, &presets)?,
        };
        let mut params = match strength {
            None => SmoothParams::paper(),
            Some(_) if is_general => SmoothParams::general(),
            Some(strength) => SmoothParams::for_sensor(sensor, strength),
        };
        params.sensor = sensor;
        params.window = self.window.unwrap_or(params.window);
        params.stride = self.stride.unwrap_or(params.stride);
        params.average_blocks = self.average_blocks.unwrap_or(params.average_blocks);
        params.degree = self.degree.unwrap_or(params.degree);
        params.ridge = self.ridge.unwrap_or(params.ridge);
        if let Some(radius_m) = self.radius {
            params.radius = Radius::Fixed { radius_m };
        }
        if let Some(count) = self.neighbours {
            params.radius = Radius::Neighbours { count };
        }
        if let Some(name) = &self.edges {
            params.edges = one_of("edges", name, &[("robust", Edges::Robust), ("off", Edges::Off)])?;
        }
        if let Some(name) = &self.project {
            params.project = one_of("project", name, &[("ray", Project::Ray), ("normal", Project::Normal)])?;
        }
        params.validate().map_err(text)?;
        let follows_resolution = self.window.is_none() && self.stride.is_none() && strength.is_some();
        Ok(if follows_resolution && !is_general { params.at_resolution_of(frame) } else { params })
    }
}

/// A camera: an object with fx, fy, cx, cy and more, or the text of a camera file.
#[derive(Debug, Clone, Deserialize)]
#[serde(transparent)]
pub struct CameraGiven(Value);

impl CameraGiven {
    /// The camera for images of this size.
    pub(crate) fn camera(&self, shape: (usize, usize)) -> Result<Camera, String> {
        let text = match &self.0 {
            Value::String(text) => text.clone(),
            object => {
                let text = object.to_string();
                if let Some(key) = unknown_camera_key(&text).map_err(|error| error.to_string())? {
                    return Err(format!(
                        "a camera has no {key:?}: it has fx, fy, cx, cy, depth_scale, width, height and distortion"
                    ));
                }
                text
            }
        };
        parse_camera(&text, Some(shape)).map_err(|error| error.to_string())
    }
}
