//! `planish devices`: what this machine computes with, and what `auto` takes.

use std::process::ExitCode;
use std::thread::available_parallelism;

use anyhow::Result;
use planish::{AdapterKind, GpuAdapter, SimdLevel, auto_choice, gpu_adapters};
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
    /// The instruction set that is taken.
    simd: &'static str,
    /// All that the machine has and the build knows.
    simd_levels: Vec<&'static str>,
}

#[derive(Serialize)]
struct Auto {
    engine: &'static str,
    reason: String,
}

pub fn run(args: &DevicesArgs) -> Result<ExitCode> {
    let gpus = gpu_adapters();
    let (engine, reason) = auto_choice(&gpus);
    let devices = Devices {
        cpu: Cpu {
            threads: available_parallelism().map_or(1, usize::from),
            simd: SimdLevel::best().name(),
            simd_levels: SimdLevel::available().map(SimdLevel::name).collect(),
        },
        gpus,
        auto: Auto { engine: engine.name(), reason },
    };
    if args.json {
        println!("{}", serde_json::to_string(&devices)?);
    } else {
        print_text(&devices);
    }
    Ok(ExitCode::SUCCESS)
}

fn print_text(Devices { cpu, gpus, auto }: &Devices) {
    println!("cpu    {} of {}; {} threads", cpu.simd, cpu.simd_levels.join(", "), cpu.threads);
    for GpuAdapter { index, name, kind, backend, driver } in gpus {
        let kind = match kind {
            AdapterKind::Discrete => "discrete GPU",
            AdapterKind::Integrated => "integrated GPU",
            AdapterKind::Virtual => "virtual GPU",
            AdapterKind::Software => "software, only taken by name",
            AdapterKind::Other => "of unknown kind, only taken by name",
        };
        println!("gpu {index}  {name}; {kind}; {backend}, {driver}");
    }
    if gpus.is_empty() {
        println!("gpu    none found: it needs a driver for Vulkan, Metal or DirectX 12 (on Linux libvulkan.so.1 too)");
    }
    println!("auto   takes {}: {}", auto.engine, auto.reason);
}
