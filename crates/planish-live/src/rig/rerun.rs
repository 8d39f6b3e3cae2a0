//! A Rerun sink for rigs [feature `rerun`]: poses and views of the cameras, each camera's points, and the fused
//! cloud.

use std::path::Path;

use glam::DVec3;
use rerun::blueprint::{
    Blueprint, BlueprintActivation, BlueprintPanel, Horizontal, SelectionPanel, Spatial3DView, TimePanel,
    components::PanelState,
};
use rerun::{Pinhole, Points3D, Quaternion, Transform3D, ViewCoordinates};

use super::picture::{axes, colour_of};
use super::{Rig, RigFrame, RigSink};
use crate::{rig::fused::CAMERA_FIELD, stream::Recording};
use planish_core::{AttributeValues, Error, IntoFrame, PointCloud};

/// Radius of a drawn point, in metres.
const POINT_M: f32 = 0.0015;
/// Distance in metres between the lens and the drawn view of a camera.
const FRUSTUM_M: f32 = 0.15;

/// A sink that shows every moment of a rig in Rerun. The outputs must include points. A moment of four 640x480
/// cameras takes about 35 MB.
pub struct RigRerunSink {
    recording: Recording,
    /// For each camera, whether its intrinsics have been logged.
    has_view: Vec<bool>,
}

impl RigRerunSink {
    /// Starts the viewer, the program `rerun` (version 0.36), and shows moments in it.
    pub fn spawn(rig: &Rig) -> Result<Self, Error> {
        Self::start(Recording::spawn()?, rig)
    }

    /// Writes a file for Rerun's viewer, named `FILE.partial` until it is closed.
    pub fn save(file: &Path, rig: &Rig) -> Result<Self, Error> {
        Self::start(Recording::save(file)?, rig)
    }

    fn start(recording: Recording, rig: &Rig) -> Result<Self, Error> {
        let [.., up] = axes(rig);
        recording.with(|to| to.log_static("rig", &coordinates(up)))?;
        for camera in &rig.cameras {
            let ([w, x, y, z], at) = (camera.pose.orientation, camera.pose.position_m);
            let turn = Quaternion::from_xyzw([x, y, z, w].map(|part| part as f32));
            let place = Transform3D::from_translation_rotation(at.map(|metres| metres as f32), turn);
            recording.with(|to| to.log_static(format!("rig/cameras/{}", camera.name), &place))?;
        }
        recording.with(|to| layout().send(to, BlueprintActivation::default()))?;
        Ok(Self { recording, has_view: vec![false; rig.cameras.len()] })
    }
}

impl RigSink for RigRerunSink {
    fn name(&self) -> String {
        self.recording.name.clone()
    }

    fn write(&mut self, frame: &RigFrame) -> Result<(), Error> {
        let recording = &self.recording;
        recording.set_time(frame.index, Some(frame.time_s));
        let fused = frame.fused()?;
        for (i, (placed, of_camera)) in frame.rig.cameras.iter().zip(&frame.cameras).enumerate() {
            if let (Some(of_camera), false) = (of_camera, self.has_view[i]) {
                let source = of_camera.source.into_frame()?;
                if let Some(camera) = source.camera().copied().or(placed.camera) {
                    let (width, height) = source.shape();
                    let view = Pinhole::from_focal_length_and_resolution(
                        [camera.fx as f32, camera.fy as f32],
                        [width as f32, height as f32],
                    );
                    let view = view
                        .with_principal_point([camera.cx as f32 + 0.5, camera.cy as f32 + 0.5])
                        .with_image_plane_distance(FRUSTUM_M)
                        .with_color(colour_of(i));
                    recording.with(|to| to.log_static(format!("rig/cameras/{}", placed.name), &view))?;
                    self.has_view[i] = true;
                }
            }
            let its = points_of(fused, i);
            let points = Points3D::new(its.iter().map(|&point| at(fused, point)));
            let points = points.with_colors([colour_of(i)]).with_radii([POINT_M]);
            recording.with(|to| to.log(format!("rig/each/{}", placed.name), &points))?;
        }
        let colours = fused.shown_rgb().unwrap_or_else(|| {
            let of_point = |camera: Option<&u8>| colour_of(camera.copied().unwrap_or(0).into());
            (0..fused.len()).map(|i| of_point(cameras_of(fused).get(i))).collect()
        });
        let points = Points3D::new((0..fused.len()).map(|i| at(fused, i))).with_colors(colours).with_radii([POINT_M]);
        recording.with(|to| to.log("rig/fused", &points))?;
        Ok(recording.flush()?)
    }

    fn close(&mut self) -> Result<(), Error> {
        self.recording.close()
    }
}

fn cameras_of(fused: &PointCloud) -> &[u8] {
    match fused.attribute(CAMERA_FIELD).map(|field| &field.values) {
        Some(AttributeValues::U8(cameras)) => cameras,
        _ => &[],
    }
}

/// Returns the indices of a camera's points.
fn points_of(fused: &PointCloud, camera: usize) -> Vec<usize> {
    let cameras = cameras_of(fused);
    (0..cameras.len()).filter(|&i| usize::from(cameras[i]) == camera).collect()
}

/// Returns a point in the rig's frame.
fn at(fused: &PointCloud, i: usize) -> [f32; 3] {
    let (p, origin) = (fused.positions.get(i), fused.origin_m);
    [0, 1, 2].map(|axis| (f64::from(p[axis]) + origin[axis]) as f32)
}

/// Returns the view coordinates for this up direction.
fn coordinates(up: DVec3) -> ViewCoordinates {
    match up.to_array() {
        [x, ..] if x > 0.5 => ViewCoordinates::RIGHT_HAND_X_UP(),
        [x, ..] if x < -0.5 => ViewCoordinates::RIGHT_HAND_X_DOWN(),
        [_, y, _] if y > 0.5 => ViewCoordinates::RIGHT_HAND_Y_UP(),
        [_, y, _] if y < -0.5 => ViewCoordinates::RIGHT_HAND_Y_DOWN(),
        [.., z] if z < 0.0 => ViewCoordinates::RIGHT_HAND_Z_DOWN(),
        _ => ViewCoordinates::RIGHT_HAND_Z_UP(),
    }
}

/// Returns a layout with each camera's points next to the fused cloud, both with the cameras.
fn layout() -> Blueprint {
    let view = |name: &str, clouds: &str| {
        Spatial3DView::new(name).with_origin("rig").with_contents(["rig/cameras/**", clouds]).into()
    };
    Blueprint::new(Horizontal::new([view("each camera", "rig/each/**"), view("fused", "rig/fused")]))
        .with_blueprint_panel(BlueprintPanel::from_state(PanelState::Collapsed))
        .with_selection_panel(SelectionPanel::from_state(PanelState::Collapsed))
        .with_time_panel(TimePanel::new().with_state(PanelState::Collapsed).with_timeline("frame"))
}
