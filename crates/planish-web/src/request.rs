//! Requests of a page and their replies. `web/src/core.ts` declares the same in TypeScript.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::camera::CameraGiven;
use planish::Settings;

/// A request; some are accompanied by bytes.
#[derive(Debug, Clone, Deserialize)]
#[serde(tag = "op", rename_all = "snake_case", deny_unknown_fields)]
#[non_exhaustive]
pub enum Request {
    /// The names of presets, sensors, statuses and formats, and the version.
    About,
    /// Continues the numbering of a module that was restarted.
    Continue {
        /// The last number given out.
        after: u32,
    },
    /// Reads a camera file.
    ReadCamera {
        /// The frame that it is for.
        frame: u32,
        /// The text.
        camera: CameraGiven,
    },
    /// Reads a settings file.
    ReadSettings {
        /// JSON or YAML.
        text: String,
    },
    /// Writes settings as a file.
    WriteSettings {
        /// Which.
        settings: Settings,
    },
    /// Reads a file, whose bytes these are.
    Open {
        /// File name; its extension decides if the contents do not identify the format.
        name: String,
    },
    /// Takes raw depth: little-endian u16, row by row.
    Depth {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// Takes points on a grid: x, y and z of each as little-endian f32 in metres, row by row.
    Points {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// Simulates a frame of a Kinect v1.
    Simulate {
        /// Which table.
        seed: u64,
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// Smooths a frame on the CPU.
    Smooth {
        /// Which frame.
        frame: u32,
        /// How.
        settings: Settings,
        /// For depth: its camera.
        camera: Option<CameraGiven>,
    },
    /// Plans a frame for WebGPU. The reply's bytes are the data to upload.
    Plan {
        /// Which frame.
        frame: u32,
        /// How.
        settings: Settings,
        /// For depth: its camera.
        camera: Option<CameraGiven>,
        /// `maxComputeWorkgroupStorageSize`, the smaller of `maxStorageBufferBindingSize` and `maxBufferSize`, and
        /// `maxComputeWorkgroupsPerDimension`.
        limits: [u64; 3],
    },
    /// Reads the output of a plan's kernels, passed as the bytes.
    Finish {
        /// Which plan; it is gone afterwards.
        plan: u32,
    },
    /// The reply's bytes are the points of a result and then its normals, x, y and z of each as f32, and the status of
    /// each, a byte.
    Arrays {
        /// Which result.
        result: u32,
    },
    /// Draws a frame, raw or smoothed. The reply's bytes are RGBA.
    Picture {
        /// Which frame.
        frame: u32,
        /// Raw, or which result.
        side: Side,
        /// As what.
        kind: PictureKind,
        /// For depth: its camera.
        camera: Option<CameraGiven>,
    },
    /// The reply's bytes are x, y and z of every finite point as f32, and red, green, blue and 255 of each.
    Cloud {
        /// Which frame.
        frame: u32,
        /// Raw, or which result.
        side: Side,
        /// The colours.
        kind: PictureKind,
        /// For depth: its camera.
        camera: Option<CameraGiven>,
    },
    /// Encodes a result as a file. The reply's bytes are the file.
    Write {
        /// Which result.
        result: u32,
        /// `pcd`, `ply`, `npy`, `xyz`, or of depth `png`.
        format: String,
        /// For depth: its camera.
        camera: Option<CameraGiven>,
    },
    /// Forgets frames, plans and results.
    Release {
        /// Which.
        ids: Vec<u32>,
    },
}

/// Raw or smoothed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Side {
    /// As measured.
    Raw,
    /// The result of this number.
    Result(u32),
}

/// What a picture shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum PictureKind {
    /// Lit by the normals between neighbouring pixels.
    Relief,
    /// Depth in colours.
    Depth,
    /// Normals as colours.
    Normals,
    /// The colours of the frame; of one without, its relief.
    Colour,
}

/// The reply to a request: `{"ok": ..}` or `{"error": text}`, and bytes.
#[derive(Debug, Clone, Default, Serialize)]
#[non_exhaustive]
pub struct Reply {
    /// What was asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ok: Option<Value>,
    /// Error message.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
    /// Bytes that belong to it.
    #[serde(skip)]
    pub bytes: Vec<u8>,
}
