//! The origin of results: machine, build and command.

use std::fs;
use std::process::Command;

use crate::Options;
use planish::{SimdLevel, gpu_adapters};
use serde::Serialize;

/// Everything that results depend on, except the frames.
#[derive(Serialize)]
pub struct Origin {
    pub version: &'static str,
    pub rustc: &'static str,
    /// The command line.
    pub command: String,
    pub cpu: String,
    pub threads: usize,
    pub simd: &'static str,
    pub memory_gib: Option<f64>,
    pub system: String,
    /// Name, backend and driver of each GPU.
    pub gpus: Vec<String>,
}

impl Origin {
    pub fn here(options: &Options) -> Self {
        // Record only the program's name: its path on this machine is private.
        let arguments = std::env::args_os().skip(1).map(|argument| argument.to_string_lossy().into_owned());
        let quoted = arguments.map(|text| if text.contains(char::is_whitespace) { format!("'{text}'") } else { text });
        let command = std::iter::once("planish".to_owned()).chain(quoted).collect::<Vec<_>>().join(" ");
        let system = line_after("/etc/os-release", "PRETTY_NAME=").map(|name| name.trim_matches('"').to_owned());
        let memory_kib = line_after("/proc/meminfo", "MemTotal:");
        let memory_kib = memory_kib.and_then(|text| text.split_whitespace().next()?.parse::<f64>().ok());
        Self {
            version: options.version,
            rustc: options.rustc,
            command,
            cpu: cpu(),
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            simd: SimdLevel::best().name(),
            memory_gib: memory_kib.map(|kib| kib / f64::from(1 << 20)),
            system: system.unwrap_or_else(|| std::env::consts::OS.to_owned()),
            gpus: gpu_adapters()
                .into_iter()
                .map(|gpu| format!("{} ({}, {})", gpu.name, gpu.backend, gpu.driver))
                .collect(),
        }
    }

    pub fn markdown(&self) -> String {
        let Self { version, rustc, command, cpu, threads, simd, memory_gib, system, gpus } = self;
        let memory = memory_gib.map_or(String::new(), |gib| format!(", {gib:.0} GiB"));
        let gpus = if gpus.is_empty() { "none".to_owned() } else { gpus.join("; ") };
        format!(
            "`{command}`\n\nCPU: {cpu}, {threads} threads, {simd}{memory}; {system}. GPU: {gpus}. planish {version}, \
             {rustc}. Each engine is timed only after its points, computed by the same calls, agree with the f64 \
             reference.\n"
        )
    }
}

/// Returns the processor's name as the system reports it, with family and model if known.
fn cpu() -> String {
    let of =
        |key: &str| line_after("/proc/cpuinfo", key).map(|value| value.trim_start_matches([' ', '\t', ':']).to_owned());
    let by_macos = || {
        let output = Command::new("sysctl").args(["-n", "machdep.cpu.brand_string"]).output().ok()?;
        let name = String::from_utf8_lossy(&output.stdout).trim().to_owned();
        (!name.is_empty()).then_some(name)
    };
    match (of("model name"), of("cpu family"), of("model\t")) {
        (Some(name), Some(family), Some(model)) => format!("{name} (family {family}, model {model})"),
        (Some(name), ..) => name,
        _ if cfg!(target_os = "macos") => by_macos().unwrap_or_else(|| std::env::consts::ARCH.to_owned()),
        // Windows sets this variable.
        _ => std::env::var("PROCESSOR_IDENTIFIER").unwrap_or_else(|_| std::env::consts::ARCH.to_owned()),
    }
}

/// Returns the rest of the first line of a file that starts with `key`.
fn line_after(file: &str, key: &str) -> Option<String> {
    let text = fs::read_to_string(file).ok()?;
    text.lines().find_map(|line| line.strip_prefix(key)).map(|rest| rest.trim().to_owned())
}
