//! Requests from the page and their replies. `web/src/core.ts` declares the same types in TypeScript.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::camera::CameraGiven;
use planish::Settings;

/// A request from the page. Some requests are accompanied by bytes.
#[derive(Debug, Clone, Deserialize)]
#[serde(tag = "op", rename_all = "snake_case", deny_unknown_fields)]
#[non_exhaustive]
pub enum Request {
    /// Returns the version, the SIMD level, and the names of presets, settings, sensors and statuses.
    About,
    /// Continues the numbering of frames, plans and results after a restart of the module.
    Continue {
        /// The last number that was assigned before the restart.
        after: u32,
    },
    /// Reads a camera file.
    ReadCamera {
        /// Number of the frame that the camera belongs to.
        frame: u32,
        /// The camera, or the text of its file.
        camera: CameraGiven,
    },
    /// Reads a settings file.
    ReadSettings {
        /// Text of the file, JSON or YAML.
        text: String,
    },
    /// Writes settings as a file.
    WriteSettings {
        /// The settings to write.
        settings: Settings,
    },
    /// Reads a file, passed as the request's bytes.
    Open {
        /// File name; its extension determines the format if the contents do not identify it.
        name: String,
    },
    /// Opens a raw depth image, passed in the request's bytes as little-endian u16, row by row.
    Depth {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// Opens points on a grid, passed in the request's bytes row by row: x, y and z of each point in metres, as
    /// little-endian f32.
    Points {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// Simulates a frame of a Kinect v1.
    Simulate {
        /// Seed of the simulated table.
        seed: u64,
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// Smooths a frame on the CPU.
    Smooth {
        /// Number of the frame.
        frame: u32,
        /// Settings of the smoother.
        settings: Settings,
        /// Camera of the frame, required for depth.
        camera: Option<CameraGiven>,
    },
    /// Plans the smoothing of a frame with WebGPU. The reply's bytes are the data to upload.
    Plan {
        /// Number of the frame.
        frame: u32,
        /// Settings of the smoother.
        settings: Settings,
        /// Camera of the frame, required for depth.
        camera: Option<CameraGiven>,
        /// Limits of the WebGPU device: `maxComputeWorkgroupStorageSize`, the smaller of
        /// `maxStorageBufferBindingSize` and `maxBufferSize`, and `maxComputeWorkgroupsPerDimension`.
        limits: [u64; 3],
    },
    /// Reads the output of a plan's kernels, passed as the request's bytes.
    Finish {
        /// Number of the plan, which is then released.
        plan: u32,
    },
    /// Returns the arrays of a result. The reply's bytes are x, y and z of each point as f32, then of each normal,
    /// then one status byte per point.
    Arrays {
        /// Number of the result.
        result: u32,
    },
    /// Draws a frame, raw or smoothed. The reply's bytes are RGBA.
    Picture {
        /// Number of the frame.
        frame: u32,
        /// The raw frame, or a result.
        side: Side,
        /// Content of the picture.
        kind: PictureKind,
        /// Camera of the frame, required for depth.
        camera: Option<CameraGiven>,
    },
    /// Returns a coloured cloud. The reply's bytes are x, y and z of every finite point as f32, then red, green, blue
    /// and 255 of each.
    Cloud {
        /// Number of the frame.
        frame: u32,
        /// The raw frame, or a result.
        side: Side,
        /// Meaning of the colours.
        kind: PictureKind,
        /// Camera of the frame, required for depth.
        camera: Option<CameraGiven>,
    },
    /// Encodes a result as a file. The reply's bytes are the file.
    Write {
        /// Number of the result.
        result: u32,
        /// File format: `pcd`, `ply`, `npy`, `xyz`, or `png` for depth.
        format: String,
        /// Camera of the frame, required for depth.
        camera: Option<CameraGiven>,
    },
    /// Releases frames, plans and results.
    Release {
        /// Numbers of the frames, plans and results.
        ids: Vec<u32>,
    },
}

/// The raw frame, or a smoothed result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Side {
    /// The frame as measured.
    Raw,
    /// The result with this number.
    Result(u32),
}

/// Content of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum PictureKind {
    /// A relief, shaded by the normals between neighbouring pixels.
    Relief,
    /// Depth as colours.
    Depth,
    /// Normals as colours.
    Normals,
    /// The colours of the frame, or its relief if it has none.
    Colour,
}

/// The reply to a request: `{"ok": ..}` or `{"error": text}`, and bytes.
#[derive(Debug, Clone, Default, Serialize)]
#[non_exhaustive]
pub struct Reply {
    /// Result of a successful request.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ok: Option<Value>,
    /// Error message.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
    /// Bytes that accompany the reply.
    #[serde(skip)]
    pub bytes: Vec<u8>,
}
