//! Settings from Python's keyword arguments.

use planish::{ParamError, SensorModel, SettingValue, Settings};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict};

use crate::errors::param;

/// Converts a dictionary of keyword arguments to settings; `None` leaves a setting unset.
pub fn from_dict(given: &Bound<'_, PyDict>) -> PyResult<Settings> {
    let mut settings = Settings::default();
    for (key, value) in given.iter() {
        let key: String = key.extract()?;
        // An unknown keyword is a TypeError in Python.
        let refused = |error: ParamError| match error.field {
            "settings" => PyTypeError::new_err(error.to_string()),
            _ => param(error),
        };
        settings.set(&key, value_of(&key, &value)?).map_err(refused)?;
    }
    settings.validate().map_err(param)?;
    Ok(settings)
}

fn value_of(key: &str, value: &Bound<'_, PyAny>) -> PyResult<SettingValue> {
    if value.is_none() {
        return Ok(SettingValue::None);
    }
    if value.is_instance_of::<PyBool>() {
        return Ok(value.extract::<bool>()?.into());
    }
    if let Ok(text) = value.extract::<String>() {
        return Ok(text.into());
    }
    if let Ok(number) = value.extract::<f64>() {
        return Ok(number.into());
    }
    if let Ok(sensor) = value.cast::<PyDict>() {
        let coefficients = |name: &str| sensor.get_item(name)?.map(|value| value.extract::<[f32; 3]>()).transpose();
        return match (coefficients("step")?, coefficients("sigma")?) {
            (Some(step), Some(sigma)) => Ok(SettingValue::Sensor(SensorModel::new(step, sigma))),
            (None, Some(sigma)) => Ok(SettingValue::Sensor(SensorModel::from_noise(sigma))),
            _ => Err(PyTypeError::new_err(format!("{key}: a sensor needs sigma: three coefficients of 1, z and z²"))),
        };
    }
    let texts =
        value.try_iter().and_then(|items| items.map(|item| item?.extract::<String>()).collect::<PyResult<Vec<_>>>());
    texts.map(SettingValue::List).map_err(|_| {
        PyTypeError::new_err(format!("{key}: expected a number, a string, True, False or a list of strings"))
    })
}

/// Returns the settings as Python's keyword arguments.
pub fn to_dict<'py>(py: Python<'py>, settings: &Settings) -> PyResult<Bound<'py, PyDict>> {
    let json = planish::io::settings_to_json(settings);
    let parsed = py.import("json")?.call_method1("loads", (json,))?;
    Ok(parsed.cast_into::<PyDict>()?)
}

/// Returns the sensor with this name.
pub fn sensor_named(name: &str) -> PyResult<SensorModel> {
    name.parse().map_err(param)
}
