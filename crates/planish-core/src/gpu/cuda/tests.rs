use super::nvrtc::Nvrtc;
use super::translate::{CudaSource, translate};
use super::{LIMITS, Plan};
use crate::camera::Camera;
use crate::frame::{DepthView, Frame, IntoFrame};
use crate::outputs::Outputs;
use crate::params::{Edges, FrameParams, Project, Strength};
use crate::sensor::SensorModel;

/// Returns the kernels of all degrees, edge settings, strides, projections and outputs, for both kinds of depth.
fn sources() -> Vec<(String, CudaSource)> {
    let camera = Camera::kinect_v1();
    let (raw, metres) = (vec![0u16; camera.width * camera.height], vec![0f32; camera.width * camera.height]);
    let frames: [Frame<'_>; 2] = [
        DepthView::new(&raw, &camera).unwrap().into_frame().unwrap(),
        DepthView::from_metres(&metres, &camera).unwrap().into_frame().unwrap(),
    ];
    let preset = |strength| FrameParams::for_sensor(SensorModel::REALSENSE_D435, strength);
    let (default, paper) = (preset(Strength::DEFAULT), FrameParams::paper());
    let params = [
        ("default", default),
        ("light", preset(Strength::LIGHT)),
        ("strong", preset(Strength::STRONG)),
        ("paper", paper),
        ("degree 1", paper.with_degree(1)),
        ("degree 3, edges", default.with_degree(3)),
        ("no edges", default.with_edges(Edges::Off)),
        ("along normals", default.with_project(Project::Normal)),
        ("stride 1", default.with_window(5).with_stride(1)),
    ];
    let all = Outputs { points: true, normals: true, curvature: true, depth_m: true, ..Outputs::NONE };
    let mut sources: Vec<(String, CudaSource)> = Vec::new();
    for (name, params) in params {
        for (frame, outputs) in frames.iter().flat_map(|frame| [Outputs::POINTS, all].map(|outputs| (*frame, outputs)))
        {
            let plan = Plan::new(params, outputs, frame, &LIMITS).unwrap();
            for pass in plan.passes() {
                let source = translate(&pass.wgsl).unwrap();
                if sources.iter().all(|(_, known)| *known != source) {
                    sources.push((format!("{name}, {}", pass.entry_point), source));
                }
            }
        }
    }
    sources
}

#[test]
fn kernels_become_cuda_with_their_parameters() {
    let sources = sources();
    assert!(sources.len() > 20, "{}", sources.len());
    for (name, CudaSource { text, bindings, threads }) in sources {
        assert_eq!(bindings.first(), Some(&0), "{name}: the uniform comes first");
        assert!(bindings.is_sorted() && bindings.iter().all(|&binding| binding < 5), "{name}: {bindings:?}");
        assert!(matches!(threads, [32, 4 | 8]), "{name}: {threads:?}");
        let entry = text.split("extern \"C\" __global__").nth(1).unwrap();
        assert!(entry.contains("const Batch batch") && !entry.contains("[["), "{name}: {entry}");
        assert_eq!(entry.matches("*__restrict__").count() + 1, bindings.len(), "{name}: {entry}");
        // A literal without a suffix would be a double.
        let metal = text.split("#define threadgroup").nth(1).unwrap();
        let is_double = |word: &&str| word.contains('.') && word.parse::<f64>().is_ok();
        let words = metal.split(|c: char| !(c.is_ascii_alphanumeric() || c == '.'));
        assert_eq!(words.filter(is_double).collect::<Vec<_>>(), Vec::<&str>::new(), "{name}");
    }
}

/// Runs only if CUDA's compiler is installed; the gate installs it and sets PLANISH_REQUIRE_NVRTC.
#[test]
fn kernels_compile_for_old_and_new_gpus() {
    let nvrtc = match Nvrtc::load(12, 90) {
        Ok(nvrtc) => nvrtc,
        Err(reason) if std::env::var_os("PLANISH_REQUIRE_NVRTC").is_none() => {
            assert!(reason.contains("nvidia-cuda-nvrtc") && reason.contains("CUDA_PATH"), "{reason}");
            return;
        }
        Err(reason) => panic!("{reason}"),
    };
    let elf = b"\x7fELF";
    let sources = sources();
    for (name, source) in &sources {
        let code = nvrtc.compile(&source.text, 90).unwrap_or_else(|error| panic!("{name}: {error}"));
        assert!(code.starts_with(elf) && code.len() > 1000, "{name}");
    }
    let (_, first) = &sources[0];
    assert!(nvrtc.compile(&first.text, 75).unwrap().starts_with(elf));
    // For a GPU newer than the compiler, the output is PTX for the driver.
    let ptx = nvrtc.compile(&first.text, 990).unwrap();
    assert!(String::from_utf8_lossy(&ptx).contains(".entry run") && ptx.ends_with(b"\0"));
    assert!(nvrtc.compile(&first.text, 10).unwrap_err().contains("capability 10"));
    assert!(Nvrtc::load(12, 10).err().unwrap().contains("compute capability 10"));
    assert!(nvrtc.compile("no C", 90).unwrap_err().contains("error"));
}
