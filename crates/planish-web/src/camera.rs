//! Cameras from the requests of a page.

use planish::Camera;
use planish::io::{parse_camera, unknown_camera_key};
use serde::Deserialize;
use serde_json::Value;

/// A camera: an object with fx, fy, cx, cy and optional other fields, or the text of a camera file.
#[derive(Debug, Clone, Deserialize)]
#[serde(transparent)]
pub struct CameraGiven(Value);

impl CameraGiven {
    /// Returns the camera for images of this size.
    pub(crate) fn camera(&self, shape: (usize, usize)) -> Result<Camera, String> {
        let text = match &self.0 {
            Value::String(text) => text.clone(),
            object => {
                let text = object.to_string();
                let unknown = unknown_camera_key(&text).map_err(|error| error.to_string())?;
                // Only camera files may use the old name `depth_scale`; requests may not.
                let old = object.get("depth_scale").map(|_| "depthScale".to_owned());
                if let Some(key) = unknown.or(old) {
                    return Err(format!(
                        "unknown field {key:?} of a camera; expected fx, fy, cx, cy, depthUnitsPerMetre, width, height \
                         or distortion"
                    ));
                }
                text
            }
        };
        parse_camera(&text, Some(shape)).map_err(|error| error.to_string())
    }
}
