//! Values of settings as front ends receive them: options, keyword arguments, ROS parameters, JSON.

use crate::error::ParamError;
use crate::sensor::SensorModel;

/// A value of a setting, in the type that the front end provides.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum SettingValue {
    /// No value: the setting is not given.
    None,
    /// A boolean.
    Bool(bool),
    /// A number.
    Number(f64),
    /// A string, which may contain a number or a boolean.
    Text(String),
    /// A list of strings.
    List(Vec<String>),
    /// An unnamed sensor.
    Sensor(SensorModel),
}

impl From<bool> for SettingValue {
    fn from(value: bool) -> Self {
        Self::Bool(value)
    }
}

impl From<f64> for SettingValue {
    fn from(value: f64) -> Self {
        Self::Number(value)
    }
}

impl From<f32> for SettingValue {
    /// Converts a number to its shortest decimal form, so that 0.03 stays 0.03.
    fn from(value: f32) -> Self {
        Self::Text(value.to_string())
    }
}

impl From<u32> for SettingValue {
    fn from(value: u32) -> Self {
        Self::Number(value.into())
    }
}

impl From<&str> for SettingValue {
    fn from(value: &str) -> Self {
        Self::Text(value.to_owned())
    }
}

impl From<String> for SettingValue {
    fn from(value: String) -> Self {
        Self::Text(value)
    }
}

impl From<Vec<String>> for SettingValue {
    fn from(value: Vec<String>) -> Self {
        Self::List(value)
    }
}

impl<T: Into<Self>> From<Option<T>> for SettingValue {
    fn from(value: Option<T>) -> Self {
        value.map_or(Self::None, Into::into)
    }
}

/// Returns the beginning of a text, for an error message.
fn beginning(text: &str) -> String {
    const MOST_LETTERS: usize = 60;
    match text.char_indices().nth(MOST_LETTERS) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text.to_owned(),
    }
}

/// Returns the beginning of a text in quotation marks, on one line.
pub(super) fn quoted(text: &str) -> String {
    format!("{:?}", beginning(text))
}

impl SettingValue {
    /// Returns the value as text; `None` if it was not given.
    pub(super) fn text(&self) -> Option<String> {
        match self {
            Self::None => None,
            Self::Bool(value) => Some(value.to_string()),
            Self::Number(value) => Some(value.to_string()),
            Self::Text(value) => Some(value.clone()),
            Self::List(values) => Some(values.join(",")),
            Self::Sensor(sensor) => Some(format!("{sensor:?}")),
        }
    }

    fn refused<T>(&self, field: &'static str, allowed: &'static str) -> Result<T, ParamError> {
        let value = match self {
            Self::Text(text) => quoted(text),
            other => beginning(&other.text().unwrap_or_default()),
        };
        Err(ParamError { field, value, allowed })
    }

    pub(super) fn named<T: Copy>(
        &self,
        field: &'static str,
        known: &[(&str, T)],
        allowed: &'static str,
    ) -> Result<Option<T>, ParamError> {
        let Some(name) = self.text() else { return Ok(None) };
        match known.iter().find(|(known, _)| *known == name) {
            Some(&(_, value)) => Ok(Some(value)),
            None => self.refused(field, allowed),
        }
    }

    pub(super) fn number(&self, field: &'static str, allowed: &'static str) -> Result<Option<f32>, ParamError> {
        match self {
            Self::None => Ok(None),
            Self::Number(value) => Ok(Some(*value as f32)),
            Self::Text(text) => match text.trim().parse() {
                Ok(value) => Ok(Some(value)),
                Err(_) => self.refused(field, allowed),
            },
            _ => self.refused(field, allowed),
        }
    }

    pub(super) fn whole(&self, field: &'static str, allowed: &'static str) -> Result<Option<u32>, ParamError> {
        let whole =
            |value: f64| (value.fract() == 0.0 && (0.0..=f64::from(u32::MAX)).contains(&value)).then_some(value as u32);
        let value = match self {
            Self::None => return Ok(None),
            Self::Number(value) => whole(*value),
            Self::Text(text) => text.trim().parse().ok(),
            _ => None,
        };
        match value {
            Some(value) => Ok(Some(value)),
            None => self.refused(field, allowed),
        }
    }

    pub(super) fn truth(&self, field: &'static str) -> Result<Option<bool>, ParamError> {
        match self {
            Self::None => Ok(None),
            Self::Bool(value) => Ok(Some(*value)),
            Self::Text(text) if text == "true" => Ok(Some(true)),
            Self::Text(text) if text == "false" => Ok(Some(false)),
            _ => self.refused(field, "true or false"),
        }
    }
}
