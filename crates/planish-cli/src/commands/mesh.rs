//! `planish mesh`: converts a frame to a triangle mesh.

use anyhow::{Context, Result, bail};
use planish::io::{self, Contents, WRITTEN_MESHES};
use planish::mesh::{FrameMesh, mesh_of};
use planish_bench::{errln, outln};

use super::checks::{check_not_beside, check_not_input, report_notes};
use super::{check_work, organized, read_input};
use crate::args::{MeshArgs, by_option_of_error};
use crate::exit::ExitCode;

pub fn run(args: &MeshArgs) -> Result<ExitCode> {
    let MeshArgs { input, output, .. } = args;
    let extension = output.extension().and_then(|extension| extension.to_str()).map(str::to_ascii_lowercase);
    if !matches!(extension.as_deref(), Some("ply" | "obj" | "stl" | "glb")) {
        bail!("{}: unsupported mesh extension; expected {WRITTEN_MESHES}", output.display());
    }
    check_not_input(input, output, None)?;
    check_not_beside([&args.smoothing.settings, &args.camera.camera_file], output)?;
    let settings = args.smoothing.settings()?;
    let (file, camera) = read_input(input, &args.reading.read_options(), &args.camera)?;
    report_notes(input, &file.notes);
    let work = if extension.as_deref() == Some("obj") { io::Work::MeshText } else { io::Work::Mesh };
    check_work(work, &file.contents, &args.reading.read_options(), input)?;
    if let Contents::General(cloud) = &file.contents {
        bail!(
            "{}: an unorganized cloud of {} points has no pixels to connect; build its mesh with Open3D \
             (create_from_point_cloud_poisson) or MeshLab",
            input.display(),
            cloud.len()
        );
    }
    let cloud = organized(file.contents, &camera, input)?;
    let remove_floating = settings.remove_floating == Some(true);
    let made = mesh_of(cloud, settings, args.raw).map_err(by_option_of_error);
    let FrameMesh { mesh, floating, events, .. } = made.with_context(|| input.display().to_string())?;
    if remove_floating {
        errln!("{}: {floating} floating pixels became holes", input.display());
    }
    events.iter().for_each(|event| errln!("{}: {event}", input.display()));
    io::write_mesh(output, &mesh)?;
    let (vertices, triangles) = (mesh.positions.len(), mesh.triangles.len());
    outln!("{} -> {}: {vertices} vertices, {triangles} triangles", input.display(), output.display());
    Ok(ExitCode::SUCCESS)
}
