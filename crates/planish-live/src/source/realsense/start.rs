//! Starts a pipeline on the requested device in the requested mode, with colour if available.

use std::ffi::{CString, c_int};

use super::api::{DeviceName, FORMAT_RGB8, FORMAT_Z16, Functions, Owned, STREAM_COLOR, STREAM_DEPTH};
use super::input::RealSenseInput;
use crate::source::{Alignment, StreamMode};
use planish_core::DeviceError;

/// Returns an error that lists the connected devices if the requested device is missing.
pub(super) fn check_device(devices: &[DeviceName], serial: Option<&str>) -> Result<(), DeviceError> {
    let help = "check its cable (USB 3) and your permissions (librealsense's udev rules); name a recording \
                realsense:FILE.bag or FILE.db3";
    let is_there = match serial {
        None => !devices.is_empty(),
        Some(serial) => devices.iter().any(|device| device.serial == serial),
    };
    if is_there {
        return Ok(());
    }
    let found: Vec<String> = devices.iter().map(|device| format!("{} ({})", device.serial, device.name)).collect();
    let what = match (serial, found.is_empty()) {
        (None, _) => "no RealSense camera found".to_owned(),
        (Some(serial), true) => format!("no RealSense camera with serial number {serial}: none found"),
        (Some(serial), false) => format!("no RealSense camera with serial number {serial}: found {}", found.join(", ")),
    };
    Err(DeviceError::NotFound { what, help })
}

/// Requirements on colour images.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Colour {
    AtRateOfDepth,
    AtAnyRate,
    None,
}

/// A running pipeline.
pub(super) struct Started {
    pub(super) device: Owned,
    pub(super) profile: Owned,
    pub(super) colour: Colour,
}

/// Starts a pipeline with colour at the rate of depth. If that fails, tries colour at any rate, then no colour unless
/// it was requested.
pub(super) fn start(
    library: &Functions,
    pipeline: &Owned,
    input: &RealSenseInput,
    alignment: Option<Alignment>,
    mode: Option<StreamMode>,
) -> Result<Started, DeviceError> {
    let attempts: &[Colour] = match alignment {
        Some(Alignment::None) => &[Colour::None],
        Some(_) => &[Colour::AtRateOfDepth, Colour::AtAnyRate],
        None => &[Colour::AtRateOfDepth, Colour::AtAnyRate, Colour::None],
    };
    let resolve = |colour: Colour| -> Result<(Owned, Owned, Colour), DeviceError> {
        let config = configure(library, input, mode, colour)?;
        let what = &asked_for(mode, colour != Colour::None);
        // SAFETY: the objects outlive the call.
        let call = |f: &Functions, e| unsafe { (f.config_resolve)(config.get(), pipeline.get(), e) };
        let profile = library.create(what, library.delete_pipeline_profile, call)?;
        Ok((config, profile, colour))
    };
    let mut resolved = resolve(attempts[0]);
    for &colour in &attempts[1..] {
        if resolved.is_err() {
            // Keeps the first error, which is about the requested mode.
            resolved = resolve(colour).or(resolved);
        }
    }
    let (config, profile, colour) = resolved?;
    let what = &asked_for(mode, colour != Colour::None);
    // SAFETY: the objects outlive the calls.
    unsafe {
        let device = |f: &Functions, e| (f.pipeline_profile_get_device)(profile.get(), e);
        let device = library.create(what, library.delete_device, device)?;
        if matches!(input, RealSenseInput::Recording(_)) {
            // Plays as fast as frames are taken, without loss. Set before the start, so that no frame is lost.
            library.call(what, |f, e| (f.playback_device_set_real_time)(device.get(), 0, e))?;
        }
        let start = |f: &Functions, e| (f.pipeline_start_with_config)(pipeline.get(), config.get(), e);
        let profile = library.create(what, library.delete_pipeline_profile, start)?;
        Ok(Started { device, profile, colour })
    }
}

fn configure(
    library: &Functions,
    input: &RealSenseInput,
    mode: Option<StreamMode>,
    colour: Colour,
) -> Result<Owned, DeviceError> {
    let what = "the camera cannot be set up";
    let c_text = |text: &str| {
        CString::new(text).map_err(|_| DeviceError::Failed { what: format!("{text:?}: the name contains a zero byte") })
    };
    // 0 leaves the choice to the library.
    let number = |value: usize| c_int::try_from(value).unwrap_or(c_int::MAX);
    let (width, height) = mode.map_or((0, 0), |mode| (number(mode.width), number(mode.height)));
    let fps = mode.and_then(|mode| mode.fps).map_or(0, |fps| c_int::try_from(fps).unwrap_or(c_int::MAX));
    // SAFETY: the objects and texts outlive the calls; the library copies the texts.
    unsafe {
        let config = library.create(what, library.delete_config, |f, e| (f.create_config)(e))?;
        match input {
            RealSenseInput::Any => {}
            RealSenseInput::Serial(serial) => {
                let serial = c_text(serial)?;
                library.call(what, |f, e| (f.config_enable_device)(config.get(), serial.as_ptr(), e))?;
            }
            RealSenseInput::Recording(file) => {
                let file = c_text(&file.to_string_lossy())?;
                let repeats = 0;
                library.call(what, |f, e| {
                    (f.config_enable_device_from_file_repeat_option)(config.get(), file.as_ptr(), repeats, e);
                })?;
            }
        }
        let enable = |stream, width, height, format, fps| {
            library.call(what, |f, e| {
                (f.config_enable_stream)(config.get(), stream, -1, width, height, format, fps, e);
            })
        };
        enable(STREAM_DEPTH, width, height, FORMAT_Z16, fps)?;
        match colour {
            Colour::AtRateOfDepth => enable(STREAM_COLOR, 0, 0, FORMAT_RGB8, fps)?,
            Colour::AtAnyRate => enable(STREAM_COLOR, 0, 0, FORMAT_RGB8, 0)?,
            Colour::None => {}
        }
        Ok(config)
    }
}

/// Describes a failed request, for error messages.
fn asked_for(mode: Option<StreamMode>, colour: bool) -> String {
    let colour = if colour { " with colour" } else { "" };
    match mode {
        Some(mode) => {
            format!("the camera does not start with depth of {mode}{colour}; rs-enumerate-devices lists its modes")
        }
        None => format!("the camera does not start with depth{colour}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_that_is_not_there_is_refused_with_those_that_are() {
        let devices = [("Intel RealSense D435", "827112070000"), ("Intel RealSense D455", "123622270000")]
            .map(|(name, serial)| DeviceName { name: name.into(), serial: serial.into() });
        assert!(check_device(&devices, None).is_ok() && check_device(&devices, Some("123622270000")).is_ok());
        let text = |result: Result<(), DeviceError>| result.unwrap_err().to_string();
        let other = text(check_device(&devices, Some("1")));
        assert!(other.contains("number 1: found 827112070000 (Intel RealSense D435), 123622270000"), "{other}");
        assert!(text(check_device(&[], None)).contains("no RealSense camera found"));
        assert!(text(check_device(&[], Some("1"))).contains("none found"));
    }
}
