//! Plans for the usual settings, as files for review and for hosts without this module.

use planish::webgpu::{Plan, WebGpuLimits};
use planish::{Camera, DepthFrame, Error, FrameParams, Outputs};
use serde_json::json;

/// Limits that most current GPUs support, with 32 KiB of workgroup memory.
const LIMITS: WebGpuLimits = WebGpuLimits::new(32 << 10, 128 << 20, 65_535);

/// Plans the smoothing of 640x480 depth images to points, normals, status and depth, with the default and paper
/// presets. Returns the names and contents of the files.
///
/// `NAME.json` contains the [`Plan`] without its kernels, which are in `NAME-INDEX-ENTRY_POINT.wgsl` in the order of
/// their passes. A kernel shared with an earlier plan is referenced, not written again.
///
/// # Errors
/// If a frame cannot be planned.
pub fn usual_plans() -> Result<Vec<(String, String)>, Error> {
    let camera = Camera::kinect_v1();
    let frame = DepthFrame::new(camera, vec![1000; camera.width * camera.height])?;
    let outputs = Outputs::POINTS.with_normals(true).with_status(true).with_depth(true);
    let mut files: Vec<(String, String)> = Vec::new();
    for (name, params) in [("default", FrameParams::default()), ("paper", FrameParams::paper())] {
        let plan = Plan::new(params, outputs, &frame, &LIMITS)?;
        let mut passes = Vec::new();
        for (i, pass) in plan.passes().into_iter().enumerate() {
            let known = files.iter().find(|(_, text)| *text == pass.wgsl).map(|(file, _)| file.clone());
            let file = known.unwrap_or_else(|| {
                let file = format!("{name}-{i}-{}.wgsl", pass.entry_point);
                files.push((file.clone(), pass.wgsl));
                file
            });
            passes.push(json!({ "wgsl": file, "entry_point": pass.entry_point, "workgroups": pass.workgroups }));
        }
        let described = json!({
            "frame": { "kind": "depth", "width": camera.width, "height": camera.height },
            "outputs": ["points", "normals", "status", "depth"],
            "bindings": ["uniform", "read-only-storage", "storage", "storage", "storage"],
            "uniform": plan.uniform(), "output_bytes": plan.output_bytes(), "kept_bytes": plan.kept_bytes(),
            "passes": passes,
        });
        files.push((format!("{name}.json"), format!("{described:#}\n")));
    }
    Ok(files)
}
