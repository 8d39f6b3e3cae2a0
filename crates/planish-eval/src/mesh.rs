//! Meshes of frames.

use planish_core::{Error, OrganizedCloud, Outputs, Session, SessionEvent, Settings, Smoothed};
use planish_io::TriangleMesh;

use crate::render::normals_of;

/// A mesh, and how it was made.
#[derive(Debug)]
#[non_exhaustive]
pub struct FrameMesh {
    /// The mesh.
    pub mesh: TriangleMesh,
    /// Floating pixels that became holes, with `remove_floating`.
    pub floating: usize,
    /// What the session reported.
    pub events: Vec<SessionEvent>,
}

/// Smooths a frame and connects its pixels ([`TriangleMesh::of`]); `raw` connects the points as they are.
///
/// # Errors
/// If the settings are not allowed or do not fit the frame, or the engine fails.
pub fn mesh_of(mut cloud: OrganizedCloud, mut settings: Settings, raw: bool) -> Result<FrameMesh, Error> {
    settings.check_no_video()?;
    settings.outputs = Some(Outputs::POINTS.with_normals(true));
    let removes_floating = settings.remove_floating == Some(true);
    let mut session = Session::new(settings)?.with_single_frame(true);
    let noise = session.params_for(&cloud)?.1.unwrap_or_default();
    let floating = if removes_floating { cloud.remove_floating(&noise) } else { 0 };
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
