//! Named values of settings.

use crate::sensor::SensorModel;

/// A named set of all parameters; individual settings override it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum Preset {
    /// Parameters of [`crate::Strength::LIGHT`], for small objects.
    Light,
    /// Parameters of [`crate::Strength::DEFAULT`], recommended.
    #[default]
    Default,
    /// Parameters of [`crate::Strength::STRONG`], for walls, floors and far ranges.
    Strong,
    /// The parameters of the 2011 report: half-width 3, stride 1, radius 3 cm, degree 3.
    Paper,
}

impl Preset {
    /// All presets with their names.
    pub const NAMED: [(&'static str, Self); 4] =
        [("light", Self::Light), ("default", Self::Default), ("strong", Self::Strong), ("paper", Self::Paper)];
}

/// The sensor that took the frames.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum SensorChoice {
    /// A sensor model that is estimated from the frames.
    Auto,
    /// A known sensor model.
    Known(SensorModel),
}

/// A radius given by the user.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum RadiusChoice {
    /// A radius that grows with the range, to cover the window and the sensor's depth steps; for frames on a grid.
    Sensor,
    /// One radius for every point, in metres.
    Metres(f32),
}

/// Reconstruction of a frame's pixel grid from an unorganized cloud.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum GridChoice {
    /// An unorganized cloud whose points lie on the pixels of a camera is smoothed as a frame.
    #[default]
    Auto,
    /// Unorganized clouds stay unorganized.
    Off,
}

impl GridChoice {
    /// All choices with their names.
    pub const NAMED: [(&'static str, Self); 2] = [("auto", Self::Auto), ("off", Self::Off)];
}

/// Smoothing of video frames over time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum TemporalChoice {
    /// No smoothing over time: each frame is smoothed on its own.
    #[default]
    Off,
    /// [`crate::TemporalParams::STEADY`], for a camera that is stationary or whose motion is known or tracked.
    Steady,
}

impl TemporalChoice {
    /// All choices with their names.
    pub const NAMED: [(&'static str, Self); 2] = [("off", Self::Off), ("steady", Self::Steady)];
}
