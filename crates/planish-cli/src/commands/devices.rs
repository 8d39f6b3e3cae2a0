//! `planish devices`: lists the engines of this machine and the choice of `auto`.

use crate::exit::ExitCode;
use std::thread::available_parallelism;

use anyhow::Result;
use planish::{AdapterKind, Engine, FrameParams, GpuAdapter, SimdLevel, Smoother, gpu_adapters};
use planish_bench::outln;
use serde::Serialize;

use crate::args::DevicesArgs;

#[derive(Serialize)]
struct Devices {
    cpu: Cpu,
    gpus: Vec<GpuAdapter>,
    auto: Auto,
}

#[derive(Serialize)]
struct Cpu {
    threads: usize,
    /// The instruction set in use.
    simd: &'static str,
    /// All instruction sets that both the machine and the build support.
    simd_levels: Vec<&'static str>,
}

#[derive(Serialize)]
struct Auto {
    engine: &'static str,
    reason: String,
}

pub fn run(args: &DevicesArgs) -> Result<ExitCode> {
    let gpus = gpu_adapters();
    // A listed GPU may still fail to open.
    let smoother = Smoother::open(FrameParams::default(), Engine::Auto, (640, 480))?;
    let devices = Devices {
        cpu: Cpu {
            threads: available_parallelism().map_or(1, usize::from),
            simd: SimdLevel::best().name(),
            simd_levels: SimdLevel::available().map(SimdLevel::name).collect(),
        },
        gpus,
        auto: Auto {
            engine: smoother.engine().name(),
            reason: smoother.chosen_because().map(ToString::to_string).unwrap_or_default(),
        },
    };
    if args.json {
        outln!("{}", serde_json::to_string(&devices)?);
    } else {
        print_text(&devices);
    }
    Ok(ExitCode::SUCCESS)
}

fn print_text(Devices { cpu, gpus, auto }: &Devices) {
    outln!("cpu    {} of {}; {} threads", cpu.simd, cpu.simd_levels.join(", "), cpu.threads);
    for GpuAdapter { index, name, kind, backend, driver, .. } in gpus {
        let kind = match kind {
            AdapterKind::Discrete => "discrete GPU",
            AdapterKind::Integrated => "integrated GPU",
            AdapterKind::Virtual => "virtual GPU",
            AdapterKind::Software => "software, only used if selected",
            _ => "unknown kind, only used if selected",
        };
        outln!("gpu {index}  {name}; {kind}; {backend}, {driver}");
    }
    if cfg!(not(feature = "gpu")) {
        outln!("gpu    not in this build (feature gpu)");
    } else if gpus.is_empty() {
        outln!("gpu    none found; install a driver for Vulkan, Metal or DirectX 12 (on Linux also libvulkan.so.1)");
    }
    outln!("auto   selects {}: {}", auto.engine, auto.reason);
}
