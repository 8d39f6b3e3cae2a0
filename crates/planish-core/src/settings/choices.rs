//! Named values of settings.

use crate::sensor::SensorModel;

/// A named set of all parameters; individual settings override it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum Preset {
    /// [`crate::Strength::LIGHT`], for small objects.
    Light,
    /// [`crate::Strength::DEFAULT`], recommended.
    #[default]
    Default,
    /// [`crate::Strength::STRONG`], for walls, floors and far ranges.
    Strong,
    /// The setting of the 2011 report: window 3, stride 1, 3 cm, degree 3.
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
    /// Estimated from the first frame.
    Auto,
    /// A known sensor model.
    Known(SensorModel),
}

/// A radius given by the user.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum RadiusChoice {
    /// A radius that grows with distance like the sensor's noise; for frames on a grid.
    Sensor,
    /// One radius for every point, in metres.
    Metres(f32),
}

/// Reconstruction of the pixel grid that a frame lost as an unorganized cloud.
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

/// Smoothing over time of the frames of a video.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum TemporalChoice {
    /// No smoothing over time: each frame on its own.
    #[default]
    Off,
    /// [`crate::TemporalParams::STEADY`]: for a camera at rest.
    Steady,
}

impl TemporalChoice {
    /// All choices with their names.
    pub const NAMED: [(&'static str, Self); 2] = [("off", Self::Off), ("steady", Self::Steady)];
}
