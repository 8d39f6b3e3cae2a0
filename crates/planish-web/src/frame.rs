//! A frame of a page.

use planish::io::Contents;
use planish::{
    Camera, DepthImage, DepthView, Error, Frame, FrameError, IntoFrame, OrganizedCloud, Outputs, PointCloud, PointsView,
};
use serde_json::{Value, json};

use crate::camera::CameraGiven;

/// A frame as received from the page.
pub struct PageFrame {
    /// Contents of the frame.
    pub contents: Contents,
    /// Format of the file.
    pub format: &'static str,
}

impl PageFrame {
    /// Returns the camera: for depth it must be given; for points it is optional.
    pub(crate) fn camera(&self, given: Option<&CameraGiven>) -> Result<Option<Camera>, String> {
        match given {
            Some(given) => given.camera(self.contents.shape()).map(Some),
            None if self.contents.is_depth() => Err("depth needs its camera: fx, fy, cx and cy in pixels".to_owned()),
            None => Ok(None),
        }
    }

    /// Calls `work` with a view of the frame.
    pub(crate) fn with<T>(
        &self,
        camera: Option<&Camera>,
        work: impl FnOnce(Frame<'_>) -> Result<T, Error>,
    ) -> Result<T, String> {
        let missing = || FrameError::MissingCamera { what: "depth as an input" };
        let frame = || -> Result<Frame<'_>, FrameError> {
            match &self.contents {
                Contents::Depth(image) => DepthView::new(&image.raw, camera.ok_or_else(missing)?)?.into_frame(),
                Contents::DepthMetres { depth_m, .. } => {
                    DepthView::from_metres(depth_m, camera.ok_or_else(missing)?)?.into_frame()
                }
                Contents::Organized(cloud) => {
                    let view = PointsView::from_organized(cloud)?;
                    match camera {
                        Some(camera) => view.with_camera(camera)?,
                        None => view,
                    }
                    .into_frame()
                }
                Contents::General(cloud) => PointsView::from_cloud(cloud)?.into_frame(),
                _ => Err(missing()),
            }
        };
        frame().map_err(Error::from).and_then(work).map_err(|error| error.to_string())
    }

    /// Returns the points on their grid; `None` for an unorganized cloud, or for depth without a camera.
    pub(crate) fn organized(&self, camera: Option<&Camera>) -> Option<OrganizedCloud> {
        match &self.contents {
            Contents::Organized(cloud) => Some(cloud.clone()),
            Contents::Depth(image) => DepthView::new(&image.raw, camera?).ok()?.deproject().ok(),
            Contents::DepthMetres { depth_m, .. } => DepthView::from_metres(depth_m, camera?).ok()?.deproject().ok(),
            _ => None,
        }
    }

    /// Returns the points, organized or not; `None` for depth without a camera.
    pub(crate) fn points(&self, camera: Option<&Camera>) -> Option<PointCloud> {
        match &self.contents {
            Contents::General(cloud) => Some(cloud.clone()),
            _ => self.organized(camera).map(|cloud| cloud.points),
        }
    }

    /// Returns the outputs to compute.
    pub(crate) fn outputs(&self) -> Outputs {
        let outputs = Outputs::POINTS.with_normals(true).with_status(true);
        outputs.with_depth(matches!(self.contents, Contents::Depth(_)))
    }

    /// Describes the frame for the page.
    pub(crate) fn describe(&self) -> Value {
        let (width, height) = self.contents.shape();
        let (kind, valid) = match &self.contents {
            Contents::Depth(DepthImage { raw, .. }) => {
                ("depth", raw.iter().filter(|&&raw| raw != 0 && raw != planish::SATURATED_DEPTH).count())
            }
            Contents::DepthMetres { depth_m, .. } => {
                ("depth_metres", depth_m.iter().filter(|&&z| z > 0.0 && z.is_finite()).count())
            }
            Contents::Organized(cloud) => ("points", cloud.points.valid_points()),
            Contents::General(cloud) => ("general", cloud.valid_points()),
            _ => ("unknown", 0),
        };
        let has_colour = match &self.contents {
            Contents::Organized(cloud) => cloud.points.rgb().is_some(),
            Contents::General(cloud) => cloud.rgb().is_some(),
            _ => false,
        };
        let mut described = json!({
            "kind": kind, "width": width, "height": height, "valid": valid, "format": self.format, "has_colour": has_colour
        });
        if self.contents.is_depth() {
            // A Kinect's field of view, until the page provides a camera.
            let (focal, centre) = (525.0 * width as f64 / 640.0, [width, height].map(|n| (n as f64 - 1.0) / 2.0));
            described["assumed_camera"] =
                json!({ "fx": focal, "fy": focal, "cx": centre[0], "cy": centre[1], "depth_units_per_metre": 1000.0 });
        }
        described
    }
}
