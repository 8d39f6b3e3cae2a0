//! Serialization of settings as JSON or YAML: an object with the fields that are given.

use crate::threads::ONE_THREAD;
use std::fmt;

use serde::de::{Deserialize, Deserializer, Error as _, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde::ser::{Serialize, SerializeMap, Serializer};

use super::{RadiusChoice, SensorChoice, SettingValue, Settings};
use crate::sensor::SensorModel;

fn name_of<T: PartialEq>(value: T, known: &[(&'static str, T)]) -> &'static str {
    known.iter().find(|(_, known)| *known == value).map_or("", |(name, _)| *name)
}

/// The coefficients of a sensor without a name.
#[derive(serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Coefficients {
    step: [f32; 3],
    sigma: [f32; 3],
}

impl Serialize for Settings {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        macro_rules! entry {
            ($name:literal, $value:expr) => {
                if let Some(value) = $value {
                    map.serialize_entry($name, &value)?;
                }
            };
        }
        entry!("preset", self.preset.map(|preset| name_of(preset, &super::Preset::NAMED)));
        entry!("strength", self.strength);
        match self.sensor {
            Some(SensorChoice::Auto) => map.serialize_entry("sensor", "auto")?,
            Some(SensorChoice::Known(sensor)) => match sensor.name() {
                Some(name) => map.serialize_entry("sensor", name)?,
                None => {
                    let SensorModel { step, sigma } = sensor;
                    map.serialize_entry("sensor", &Coefficients { step, sigma })?;
                }
            },
            None => {}
        }
        entry!("edges", self.edges.map(super::Edges::name));
        entry!("remove_floating", self.remove_floating);
        if !ONE_THREAD {
            entry!("min_range_m", self.min_range_m);
            entry!("max_range_m", self.max_range_m);
            entry!("decimate", self.decimate);
            entry!("fill", self.fill);
        }
        entry!("remove_isolated", self.remove_isolated);
        entry!("window", self.window);
        entry!("stride", self.stride);
        entry!("average_blocks", self.average_blocks);
        match self.radius {
            Some(RadiusChoice::Sensor) => map.serialize_entry("radius_m", "sensor")?,
            Some(RadiusChoice::Metres(radius_m)) => map.serialize_entry("radius_m", &radius_m)?,
            None => {}
        }
        entry!("neighbours", self.neighbours);
        entry!("passes", self.passes);
        entry!("grid", self.grid.map(|grid| name_of(grid, &super::GridChoice::NAMED)));
        entry!("even", self.even);
        entry!("temporal", self.temporal.map(|temporal| name_of(temporal, &super::TemporalChoice::NAMED)));
        entry!("track", self.track);
        entry!("degree", self.degree);
        entry!("bandwidth_m", self.bandwidth_m);
        entry!("ridge", self.ridge);
        entry!("project", self.project.map(|project| name_of(project, &super::Project::NAMED)));
        entry!("engine", self.engine.map(crate::Engine::name));
        entry!("adapter", self.adapter.as_ref());
        entry!("devices", self.devices.as_ref());
        entry!("threads", self.threads);
        entry!("outputs", self.outputs.map(crate::Outputs::names));
        map.end()
    }
}

impl<'de> Deserialize<'de> for Settings {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Fields;
        impl<'de> Visitor<'de> for Fields {
            type Value = Settings;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("an object of settings, such as {\"preset\": \"strong\"}")
            }

            /// Reads an empty file as the default settings.
            fn visit_unit<E>(self) -> Result<Settings, E> {
                Ok(Settings::default())
            }

            fn visit_none<E>(self) -> Result<Settings, E> {
                Ok(Settings::default())
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Settings, A::Error> {
                let (mut settings, mut seen) = (Settings::default(), Vec::<String>::new());
                while let Some(name) = map.next_key::<String>()? {
                    let field = match name.as_str() {
                        "radius" => "radius_m",
                        "bandwidth" => "bandwidth_m",
                        name => name,
                    };
                    if seen.iter().any(|seen| seen == field) {
                        return Err(A::Error::custom(format!("the setting {field} is given twice")));
                    }
                    seen.push(field.to_owned());
                    settings.set(&name, map.next_value::<SettingValue>()?).map_err(A::Error::custom)?;
                }
                settings.validate().map_err(A::Error::custom)?;
                Ok(settings)
            }
        }
        deserializer.deserialize_any(Fields)
    }
}

impl<'de> Deserialize<'de> for SettingValue {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Value;
        impl<'de> Visitor<'de> for Value {
            type Value = SettingValue;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a number, a string, true, false, or a list of strings")
            }

            fn visit_bool<E>(self, value: bool) -> Result<SettingValue, E> {
                Ok(SettingValue::Bool(value))
            }

            fn visit_i64<E>(self, value: i64) -> Result<SettingValue, E> {
                Ok(SettingValue::Number(value as f64))
            }

            fn visit_u64<E>(self, value: u64) -> Result<SettingValue, E> {
                Ok(SettingValue::Number(value as f64))
            }

            fn visit_f64<E>(self, value: f64) -> Result<SettingValue, E> {
                Ok(SettingValue::Number(value))
            }

            fn visit_str<E>(self, value: &str) -> Result<SettingValue, E> {
                Ok(SettingValue::Text(value.to_owned()))
            }

            fn visit_unit<E>(self) -> Result<SettingValue, E> {
                Ok(SettingValue::None)
            }

            fn visit_none<E>(self) -> Result<SettingValue, E> {
                Ok(SettingValue::None)
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<SettingValue, A::Error> {
                let mut texts = Vec::new();
                while let Some(text) = seq.next_element()? {
                    texts.push(text);
                }
                Ok(SettingValue::List(texts))
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<SettingValue, A::Error> {
                let (mut step, mut sigma) = (None, None);
                while let Some(name) = map.next_key::<String>()? {
                    match name.as_str() {
                        "step" => step = Some(map.next_value()?),
                        "sigma" => sigma = Some(map.next_value()?),
                        _ => {
                            map.next_value::<IgnoredAny>()?;
                            return Err(A::Error::custom(format!(
                                "unknown sensor field {name:?}; expected step or sigma"
                            )));
                        }
                    }
                }
                match (step, sigma) {
                    (Some(step), Some(sigma)) => Ok(SettingValue::Sensor(SensorModel::new(step, sigma))),
                    (None, Some(sigma)) => Ok(SettingValue::Sensor(SensorModel::from_noise(sigma))),
                    _ => Err(A::Error::custom("a sensor needs sigma: three coefficients of 1, z and z² in metres")),
                }
            }
        }
        deserializer.deserialize_any(Value)
    }
}
