//! The node's parameters: declared with their defaults, checked together, changed at run time where that is possible.

use std::collections::BTreeMap;

use anyhow::{Context, Result, bail};
use planish::{Edges, Engine, Outputs, SmoothParams, SmootherOptions, Strength};
use ros2_client::ParameterValue;
use ros2_client::qos::{History, QosProfile, WhenFull};
use std::time::Duration;

/// Frames that a subscription keeps; the newest is taken.
const DEPTH: usize = 5;
/// How long a reliable publisher waits for slow subscribers before it gives a message up.
const WAIT_FOR_SUBSCRIBERS: Duration = Duration::from_millis(20);

/// A parameter: name, default, whether it may change at run time, and what it does.
pub type Declared = (&'static str, ParameterValue, bool, &'static str);

/// All parameters.
pub fn declared() -> Vec<Declared> {
    let text = |value: &str| ParameterValue::String(value.into());
    use ParameterValue::{Boolean, Double, Integer};
    vec![
        ("strength", Double(0.5), true, "How much to smooth: 0 is light, 0.5 default, 1 strong"),
        (
            "sensor",
            text("kinect1"),
            true,
            "kinect1, d415, d435, d455, azure-kinect, l515, iphone or exact: whose noise it is",
        ),
        ("keep_edges", Boolean(true), true, "Whether creases and steps are kept"),
        ("normals", Boolean(false), true, "Whether clouds have normal_x, normal_y, normal_z and curvature"),
        ("publish_points", Boolean(true), true, "Whether clouds are published (points)"),
        ("publish_depth", Boolean(false), true, "Whether depth images are published (image_smoothed)"),
        ("publish_normals", Boolean(false), true, "Whether normals are published as images of 32FC3 (normals)"),
        ("input", text("depth"), false, "depth: images on image_rect with camera_info; points: clouds on input"),
        ("image_transport", text("raw"), false, "raw, or compressedDepth: images on image_rect/compressedDepth"),
        ("qos", text("sensor_data"), false, "How input is subscribed to: sensor_data (best effort) or reliable"),
        ("publish_qos", text("reliable"), false, "How output is published: reliable or sensor_data"),
        ("engine", text("auto"), false, "auto, cpu or gpu"),
        ("threads", Integer(0), false, "Threads of the CPU engine; 0 is one a core"),
    ]
}

/// What the node takes in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Input {
    /// `sensor_msgs/Image` of depth.
    Image,
    /// `sensor_msgs/CompressedImage` of the transport compressedDepth.
    CompressedDepth,
    /// `sensor_msgs/PointCloud2`.
    Points,
}

/// The parameters, checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    pub params: SmoothParams,
    pub engine: Engine,
    pub threads: Option<usize>,
    pub input: Input,
    pub normals: bool,
    pub publish_points: bool,
    pub publish_depth: bool,
    pub publish_normals: bool,
    pub subscribe_reliably: bool,
    pub publish_reliably: bool,
}

impl Settings {
    /// Checks values by name; those that are missing have their defaults.
    pub fn of(values: &BTreeMap<String, ParameterValue>) -> Result<Self> {
        let declared = declared();
        if let Some(name) =
            values.keys().find(|name| !is_common(name) && declared.iter().all(|(known, ..)| known != name))
        {
            let known: Vec<_> = declared.iter().map(|(name, ..)| *name).collect();
            bail!("{name}: not a parameter of this node; it has {}", known.join(", "));
        }
        let get = |name: &str| -> Result<ParameterValue> {
            let default = declared.iter().find(|(known, ..)| *known == name).map(|(_, value, ..)| value.clone());
            values.get(name).cloned().or(default).with_context(|| format!("{name}: not declared"))
        };
        let text = |name: &str| match get(name)? {
            ParameterValue::String(text) => Ok(text),
            _ => bail!("{name}: a text is expected"),
        };
        let truth = |name: &str| match get(name)? {
            ParameterValue::Boolean(value) => Ok(value),
            _ => bail!("{name}: true or false is expected"),
        };
        let is_reliable = |name: &str| match text(name)?.as_str() {
            "reliable" => Ok(true),
            "sensor_data" | "best_effort" => Ok(false),
            other => bail!("{name}: {other:?} is neither sensor_data nor reliable"),
        };
        let strength = match get("strength")? {
            ParameterValue::Double(value) => value as f32,
            ParameterValue::Integer(value) => value as f32,
            _ => bail!("strength: a number from 0 to 1 is expected"),
        };
        let strength = Strength::new(strength).context("strength")?;
        let mut params = SmoothParams::for_sensor(text("sensor")?.parse()?, strength);
        if !truth("keep_edges")? {
            params.edges = Edges::Off;
        }
        params.validate()?;
        let engine = match text("engine")?.as_str() {
            "auto" => Engine::Auto,
            "cpu" => Engine::Cpu,
            "gpu" => Engine::Gpu,
            other => bail!("engine: {other:?} is none of auto, cpu, gpu"),
        };
        let threads = match get("threads")? {
            ParameterValue::Integer(0) => None,
            ParameterValue::Integer(count @ 1..=1024) => Some(count as usize),
            other => bail!("threads: {other:?} is no number from 0 to 1024"),
        };
        let input = match (text("input")?.as_str(), text("image_transport")?.as_str()) {
            ("depth", "raw") => Input::Image,
            ("depth", "compressedDepth") => Input::CompressedDepth,
            ("points", "raw") if truth("publish_depth")? => bail!("publish_depth: clouds have no depth images"),
            ("points", "raw") => Input::Points,
            ("points", _) => bail!("image_transport: is for images, and input is points"),
            ("depth", other) => bail!("image_transport: {other:?} is neither raw nor compressedDepth"),
            (other, _) => bail!("input: {other:?} is neither depth nor points"),
        };
        Ok(Self {
            params,
            engine,
            threads,
            input,
            normals: truth("normals")?,
            publish_points: truth("publish_points")?,
            publish_depth: truth("publish_depth")?,
            publish_normals: truth("publish_normals")?,
            subscribe_reliably: is_reliable("qos")?,
            publish_reliably: is_reliable("publish_qos")?,
        })
    }

    /// Whether anything is published.
    pub fn publishes(&self) -> bool {
        self.publish_points || self.publish_normals || self.publish_depth
    }

    /// What the engine is opened with.
    pub fn options(&self) -> SmootherOptions {
        let options = SmootherOptions::default().with_engine(self.engine).with_threads(self.threads);
        options.with_outputs(self.outputs())
    }

    /// The fields of clouds.
    pub fn outputs(&self) -> Outputs {
        Outputs::POINTS.with_normals(self.normals).with_curvature(self.normals)
    }

    pub fn subscription_qos(&self) -> QosProfile {
        qos(self.subscribe_reliably)
    }

    pub fn publisher_qos(&self) -> QosProfile {
        qos(self.publish_reliably)
    }
}

/// Whether every node has this parameter.
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

    fn of(values: &[(&str, ParameterValue)]) -> Result<Settings> {
        Settings::of(&values.iter().map(|(name, value)| ((*name).to_owned(), value.clone())).collect())
    }

    #[test]
    fn defaults_are_the_library_s() {
        let settings = of(&[]).unwrap();
        assert_eq!(settings.params, SmoothParams::default());
        assert_eq!((settings.input, settings.threads), (Input::Image, None));
    }

    #[test]
    fn wrong_values_are_refused_by_name() {
        let text = |value: &str| ParameterValue::String(value.into());
        for (name, value) in [
            ("strength", ParameterValue::Double(1.5)),
            ("strength", text("much")),
            ("sensor", text("d999")),
            ("keep_edges", ParameterValue::Integer(1)),
            ("threads", ParameterValue::Integer(-1)),
            ("input", text("images")),
            ("qos", text("best")),
            ("speed", ParameterValue::Integer(1)),
        ] {
            let error = format!("{:#}", of(&[(name, value)]).unwrap_err());
            assert!(error.contains(name), "{error}");
        }
        // What clouds have no use for.
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
