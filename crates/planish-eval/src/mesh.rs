//! Triangle meshes made from frames.

use planish_core::{Error, OrganizedCloud, Outputs, Params, SensorModel, Session, SessionEvent, Settings, Smoothed};
use planish_io::TriangleMesh;

use crate::render::normals_of;

/// A mesh made from a frame, and a report on its preparation.
#[derive(Debug)]
#[non_exhaustive]
pub struct FrameMesh {
    /// The mesh.
    pub mesh: TriangleMesh,
    /// Number of floating pixels that became holes, with `remove_floating`.
    pub floating: usize,
    /// Events that the smoothing session reported.
    pub events: Vec<SessionEvent>,
}

/// Smooths a frame and connects its pixels into triangles ([`TriangleMesh::of`]). If `raw`, connects the measured
/// points instead.
///
/// # Errors
/// If the settings are invalid or do not fit the frame, or the engine fails.
pub fn mesh_of(mut cloud: OrganizedCloud, mut settings: Settings, raw: bool) -> Result<FrameMesh, Error> {
    settings.check_no_video()?;
    settings.outputs = Some(Outputs::POINTS.with_normals(true));
    let steps = settings.preparation();
    let mut session = Session::new(settings)?.with_single_frame(true);
    let noise = match session.params_for(&cloud)?.0 {
        Params::Frame(params) => params.sensor,
        Params::Cloud(_) => SensorModel::default(),
    };
    let floating = steps.cloud(&mut cloud, &noise)?.floating;
    let normals = if raw {
        normals_of(&cloud)
    } else {
        let mut smoothed = Smoothed::default();
        session.smooth(&cloud, &mut smoothed)?;
        cloud.points.positions = std::mem::take(&mut smoothed.points);
        smoothed.normals.take().unwrap_or_default()
    };
    let mesh = TriangleMesh::of(&cloud, &normals, noise)?;
    Ok(FrameMesh { mesh, floating, events: session.take_events() })
}
