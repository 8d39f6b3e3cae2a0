//! The parameters of the node: their declaration with defaults, their common check, and changes at run time.

use std::collections::BTreeMap;

use anyhow::{Context, Result, bail};
use planish::ros::PoseKind;
use planish::{Outputs, SettingValue, Settings};
use ros2_client::ParameterValue;
use ros2_client::qos::{History, QosProfile, WhenFull};
use std::time::Duration;

/// Number of messages that a subscription or publisher keeps; the node takes the newest.
const DEPTH: usize = 5;
/// Maximum time that a reliable publisher waits for slow subscribers before it drops a message.
const WAIT_FOR_SUBSCRIBERS: Duration = Duration::from_millis(20);

/// The declared default of `strength`.
const DEFAULT_STRENGTH: f64 = 0.5;
/// The declared default of `sensor`, which is that of frames.
const DEFAULT_SENSOR: &str = "kinect1";

/// A parameter: name, default, whether it can change at run time, and its description.
pub type Declared = (&'static str, ParameterValue, bool, &'static str);

/// Returns the declarations of all parameters.
pub fn declared() -> Vec<Declared> {
    let text = |value: &str| ParameterValue::String(value.into());
    use ParameterValue::{Boolean, Double, Integer, NotSet};
    vec![
        ("preset", NotSet, true, "light, default, strong or paper, instead of strength"),
        ("strength", Double(DEFAULT_STRENGTH), true, "Strength: 0 light, 0.5 default, 1 strong"),
        (
            "sensor",
            text(DEFAULT_SENSOR),
            true,
            "kinect1, d415, d435, d455, azure-kinect, l515, iphone, exact, or auto: estimated from the first frame",
        ),
        ("edges", NotSet, true, "robust or off [default: robust for images, off for unorganized clouds]"),
        ("fill", NotSet, true, "Fill holes up to this many pixels wide, 1 to 64; status and origin flag filled pixels"),
        ("remove_isolated", NotSet, true, "Whether isolated points of unorganized clouds become holes"),
        ("window", NotSet, true, "Half-width of the window in samples, 1 to 7"),
        ("stride", NotSet, true, "Distance between samples in pixels, 1 to 8"),
        ("average_blocks", NotSet, true, "Whether samples are means of blocks of pixels"),
        ("radius_m", NotSet, true, "Radius of a neighbourhood in metres, or sensor"),
        ("neighbours", NotSet, true, "For unorganized clouds: number of neighbours, 6 to 1000, instead of a radius"),
        ("temporal", NotSet, true, "off, or steady: frames of a stationary camera are smoothed over time"),
        ("track", NotSet, true, "Whether frames are smoothed over time and the camera's motion is compensated"),
        (
            "poses",
            text("off"),
            false,
            "Poses of a moving camera, with temporal: off, tf (/tf, /tf_static), odometry (odom, /tf_static), or pose \
             or pose_with_covariance of the camera itself (pose)",
        ),
        ("fixed_frame", text(""), false, "Fixed frame, for poses [default: odom, or the root of the frames]"),
        ("degree", NotSet, true, "Degree of the surface, 1 to 3"),
        ("bandwidth_m", NotSet, true, "Bandwidth of the Gaussian weights in metres"),
        ("ridge", NotSet, true, "Ridge of the fit, 1e-3 to 100"),
        ("project", NotSet, true, "ray or normal: direction in which points move"),
        ("normals", Boolean(false), true, "Whether clouds have normal_x, normal_y, normal_z and curvature"),
        (
            "sigma",
            Boolean(false),
            true,
            "Whether clouds on a grid have sigma: the standard error of each point in metres",
        ),
        ("publish_points", Boolean(true), true, "Whether clouds are published (points)"),
        ("publish_depth", Boolean(false), true, "Whether depth images are published (image_smoothed)"),
        ("publish_normals", Boolean(false), true, "Whether normals are published as images of 32FC3 (normals)"),
        ("input", text("depth"), false, "depth: images on image_rect with camera_info; points: clouds on input"),
        ("image_transport", text("raw"), false, "raw, or compressedDepth: images on image_rect/compressedDepth"),
        ("qos", text("sensor_data"), false, "QoS of the input: sensor_data (best effort) or reliable"),
        ("publish_qos", text("reliable"), false, "QoS of the output: reliable or sensor_data"),
        ("engine", text("auto"), false, "auto, cpu, gpu or reference"),
        ("adapter", NotSet, false, "The GPU by index or part of its name; needs engine: gpu"),
        ("threads", Integer(0), false, "Threads of the CPU engine; 0 means one per core"),
    ]
}

/// Type of the input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Input {
    /// `sensor_msgs/Image` with depth.
    Image,
    /// `sensor_msgs/CompressedImage` of the transport compressedDepth.
    CompressedDepth,
    /// `sensor_msgs/PointCloud2`.
    Points,
}

/// The checked parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeSettings {
    /// The settings of the smoother; their outputs are the fields of clouds.
    pub smoothing: Settings,
    pub input: Input,
    /// Type of the messages with the poses of a moving camera; `None` if it stands still or is tracked.
    pub poses: Option<PoseKind>,
    /// The fixed frame; `None` for the default.
    pub fixed_frame: Option<String>,
    pub publish_points: bool,
    pub publish_depth: bool,
    pub publish_normals: bool,
    pub subscribe_reliably: bool,
    pub publish_reliably: bool,
}

impl NodeSettings {
    /// Checks values by name; missing ones take their defaults.
    pub fn of(values: &BTreeMap<String, ParameterValue>) -> Result<Self> {
        let declared = declared();
        if let Some(name) =
            values.keys().find(|name| !is_common(name) && declared.iter().all(|(known, ..)| known != name))
        {
            let known: Vec<_> = declared.iter().map(|(name, ..)| *name).collect();
            bail!("{name}: unknown parameter; expected one of {}", known.join(", "));
        }
        let get = |name: &str| -> Result<ParameterValue> {
            let default = declared.iter().find(|(known, ..)| *known == name).map(|(_, value, ..)| value.clone());
            values.get(name).cloned().or(default).with_context(|| format!("{name}: not declared"))
        };
        let text = |name: &str| match get(name)? {
            ParameterValue::String(text) => Ok(text),
            _ => bail!("{name}: expected a string"),
        };
        let truth = |name: &str| match get(name)? {
            ParameterValue::Boolean(value) => Ok(value),
            _ => bail!("{name}: expected true or false"),
        };
        let is_reliable = |name: &str| match text(name)?.as_str() {
            "reliable" => Ok(true),
            "sensor_data" | "best_effort" => Ok(false),
            other => bail!("{name}: {other:?} is unknown; expected sensor_data or reliable"),
        };
        let smoothing = smoothing(values, truth("normals")?, truth("sigma")?)?;
        let input = match (text("input")?.as_str(), text("image_transport")?.as_str()) {
            ("depth", "raw") => Input::Image,
            ("depth", "compressedDepth") => Input::CompressedDepth,
            ("points", "raw") if truth("publish_depth")? => bail!("publish_depth: applies only if input is depth"),
            ("points", "raw") => Input::Points,
            ("points", _) => bail!("image_transport: applies only if input is depth"),
            ("depth", other) => bail!("image_transport: {other:?} is unknown; expected raw or compressedDepth"),
            (other, _) => bail!("input: {other:?} is unknown; expected depth or points"),
        };
        match input {
            Input::Points => {
                // Clouds may have a grid, whose holes can be filled.
                let mut of_clouds = smoothing.clone();
                of_clouds.fill = None;
                of_clouds.cloud_params()?;
            }
            _ if smoothing.estimates_sensor() => {}
            _ => smoothing.frame_params().map(drop)?,
        }
        let poses = match text("poses")?.as_str() {
            // YAML reads `off` as false.
            "off" | "" => None,
            kind => Some(kind.parse::<PoseKind>()?),
        };
        let fixed_frame = Some(text("fixed_frame")?).filter(|frame| !frame.is_empty());
        match poses {
            Some(_) => smoothing.check_poses()?,
            None if fixed_frame.is_some() => bail!("fixed_frame: applies only to poses"),
            None => {}
        }
        Ok(Self {
            smoothing,
            input,
            poses,
            fixed_frame,
            publish_points: truth("publish_points")?,
            publish_depth: truth("publish_depth")?,
            publish_normals: truth("publish_normals")?,
            subscribe_reliably: is_reliable("qos")?,
            publish_reliably: is_reliable("publish_qos")?,
        })
    }

    /// Returns true if anything is published.
    pub fn publishes(&self) -> bool {
        self.publish_points || self.publish_normals || self.publish_depth
    }

    pub fn subscription_qos(&self) -> QosProfile {
        qos(self.subscribe_reliably)
    }

    pub fn publisher_qos(&self) -> QosProfile {
        qos(self.publish_reliably)
    }
}

/// Returns the settings of the smoother from the parameters.
fn smoothing(values: &BTreeMap<String, ParameterValue>, normals: bool, sigma: bool) -> Result<Settings> {
    let mut settings = Settings::default();
    let is_preset = values.get("preset").is_some_and(|value| *value != ParameterValue::NotSet);
    for (name, value) in values.iter().filter(|(name, _)| Settings::NAMES.contains(&name.as_str())) {
        let value = match value {
            // Clouds without a grid have no default sensor, and frames have this one anyway.
            ParameterValue::String(value) if name == "sensor" && value == DEFAULT_SENSOR => continue,
            // The chosen preset replaces the declared default of `strength`.
            ParameterValue::Double(value) if name == "strength" && is_preset && *value == DEFAULT_STRENGTH => continue,
            ParameterValue::Integer(0) if name == "threads" => continue,
            ParameterValue::NotSet => SettingValue::None,
            ParameterValue::Boolean(value) => (*value).into(),
            ParameterValue::Integer(value) => (*value as f64).into(),
            ParameterValue::Double(value) => (*value).into(),
            ParameterValue::String(value) => value.clone().into(),
            _ => bail!("{name}: expected a number, a string, true or false"),
        };
        settings.set(name, value)?;
    }
    settings.outputs = Some(Outputs::POINTS.with_normals(normals).with_curvature(normals).with_sigma(sigma));
    settings.validate()?;
    Ok(settings)
}

/// Returns true if every node has this parameter.
fn is_common(name: &str) -> bool {
    name == "use_sim_time" || name.starts_with("qos_overrides.")
}

fn qos(is_reliable: bool) -> QosProfile {
    let profile = QosProfile::subscription_default().history(History::KeepLast { depth: DEPTH });
    if is_reliable {
        profile.reliability_reliable(WhenFull::Wait(WAIT_FOR_SUBSCRIBERS))
    } else {
        profile.reliability_best_effort()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(values: &[(&str, ParameterValue)]) -> Result<NodeSettings> {
        NodeSettings::of(&values.iter().map(|(name, value)| ((*name).to_owned(), value.clone())).collect())
    }

    #[test]
    fn defaults_are_the_library_s() {
        let declared = declared().into_iter().map(|(name, value, ..)| (name.to_owned(), value));
        let common = declared.filter(|(name, _)| Settings::NAMES.contains(&name.as_str()));
        let smoothing = smoothing(&common.collect(), false, false).unwrap();
        assert_eq!(smoothing.cloud_params().unwrap(), planish::CloudParams::default());
        assert_eq!(smoothing.frame_params().unwrap(), planish::FrameParams::default());
        let settings = of(&[]).unwrap();
        assert_eq!(settings.smoothing.frame_params().unwrap(), planish::FrameParams::default());
        assert_eq!((settings.input, settings.smoothing.threads), (Input::Image, None));
    }

    #[test]
    fn every_setting_of_the_smoother_is_a_parameter() {
        // Settings of the smoother without a parameter: messages keep their grid and camera, and streams do not look
        // for a grid, smooth twice, or move points along the surface; devices and outputs are not the node's
        // parameters.
        let left_out = [
            "remove_floating",
            "min_range_m",
            "max_range_m",
            "decimate",
            "passes",
            "grid",
            "even",
            "devices",
            "outputs",
        ];
        for name in Settings::NAMES.into_iter().filter(|name| !left_out.contains(name)) {
            assert!(declared().iter().any(|(known, ..)| *known == name), "{name}");
        }
        let text = |value: &str| ParameterValue::String(value.into());
        let values = [("preset", text("strong")), ("strength", ParameterValue::Double(0.5)), ("edges", text("off"))];
        let params = of(&values).unwrap().smoothing.frame_params().unwrap();
        assert_eq!((params.fit.edges, params.window.nominal().half_width), (planish::Edges::Off, 3));
        // A ROS YAML file reads `edges: off` as false.
        let off = of(&[("edges", ParameterValue::Boolean(false)), ("input", text("points"))]).unwrap();
        assert_eq!(off.smoothing.cloud_params().unwrap().fit.edges, planish::Edges::Off);
    }

    #[test]
    fn wrong_values_are_refused_by_name() {
        let text = |value: &str| ParameterValue::String(value.into());
        for (name, value) in [
            ("strength", ParameterValue::Double(1.5)),
            ("strength", text("much")),
            ("sensor", text("d999")),
            ("edges", ParameterValue::Integer(1)),
            ("window", ParameterValue::Integer(9)),
            ("neighbours", ParameterValue::Integer(20)),
            ("threads", ParameterValue::Integer(-1)),
            ("input", text("images")),
            ("qos", text("best")),
            ("speed", ParameterValue::Integer(1)),
        ] {
            let error = format!("{:#}", of(&[(name, value)]).unwrap_err());
            assert!(error.contains(name), "{error}");
        }
        // Parameters that do not apply to clouds.
        let points = ("input", text("points"));
        for (name, value) in
            [("publish_depth", ParameterValue::Boolean(true)), ("image_transport", text("compressedDepth"))]
        {
            let error = format!("{:#}", of(&[points.clone(), (name, value)]).unwrap_err());
            assert!(error.contains(name), "{error}");
        }
        assert_eq!(of(&[points]).unwrap().input, Input::Points);
    }
}
