//! What this machine computes with: its GPU adapters, how to open one, and what [`Engine::Auto`] takes.

use std::ops::AddAssign;
use std::time::Duration;

use serde::Serialize;

use crate::cpu::SimdLevel;
use crate::error::EngineError;
use crate::smoother::Engine;

/// What kind of device an adapter is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum AdapterKind {
    /// A graphics card.
    Discrete,
    /// A GPU beside the CPU's cores, with the same memory.
    Integrated,
    /// A GPU lent to a virtual machine.
    Virtual,
    /// The CPU pretending to be a GPU, as lavapipe does: for tests. `Auto` never takes it.
    Software,
    /// The driver does not say.
    Other,
}

/// A GPU adapter of this machine.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct GpuAdapter {
    /// Its number, by which it can be asked for.
    pub index: usize,
    /// Its name, by any part of which it can be asked for.
    pub name: String,
    /// What kind of device it is.
    pub kind: AdapterKind,
    /// The interface it is reached by: vulkan, metal, dx12.
    pub backend: String,
    /// The driver's name and version.
    pub driver: String,
}

/// How frames get to the GPU and results back.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Transfer {
    /// The faster one of this device, as far as is known.
    #[default]
    Auto,
    /// Copied to the device's memory, computed there, and copied back.
    Staged,
    /// The kernel reads and writes the host's memory itself.
    Direct,
}

/// How to open the GPU engine. The default is right for everything but tests and measurements.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GpuOptions {
    /// The adapter by its index (a number is nothing else) or any part of its name, small letters as capitals; `None` is the first real GPU. A
    /// software adapter is only taken by this. [`Engine::Auto`] does not look at it.
    pub adapter: Option<String>,
    /// How many frames may be in flight: submitted and not received. At least 1; 3 keep a GPU busy. The engines of the CPU
    /// keep to it too.
    pub slots: usize,
    /// Whether each frame's times on the device are taken; see [`SmoothedView::timings`](crate::SmoothedView::timings). The CPU
    /// engine takes its own by the same.
    pub timestamps: bool,
    /// Whether the shader checks every access to memory against its bounds.
    pub bounds_checks: bool,
    /// How frames get there and results back.
    pub transfer: Transfer,
}

impl Default for GpuOptions {
    /// The first real GPU, 3 slots, no time stamps; bounds are checked in debug builds.
    fn default() -> Self {
        Self {
            adapter: None,
            slots: 3,
            timestamps: false,
            bounds_checks: cfg!(debug_assertions),
            transfer: Transfer::Auto,
        }
    }
}

/// Where the time of one frame or batch went: on a GPU's device, or in the CPU engine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FrameTimings {
    /// Copying the input to the device's memory, next to nothing where the kernel reads the host's; on the CPU copying or
    /// deprojecting it into the planes that the kernel reads.
    pub upload: Duration,
    /// The kernel, with where edges are kept the pass before it.
    pub kernel: Duration,
    /// Copying the result to the host's memory; next to nothing where the kernel writes it there. On the CPU making depth from
    /// the points and leaving out what is not wanted; nothing where points are wanted and depth is not.
    pub readback: Duration,
}

impl AddAssign for FrameTimings {
    fn add_assign(&mut self, more: Self) {
        self.upload += more.upload;
        self.kernel += more.kernel;
        self.readback += more.readback;
    }
}

/// The GPU adapters of this machine in the order of their indices. Empty without drivers, or in a build without the feature
/// `gpu`.
pub fn gpu_adapters() -> Vec<GpuAdapter> {
    #[cfg(feature = "gpu")]
    return crate::gpu::adapters();
    #[cfg(not(feature = "gpu"))]
    Vec::new()
}

/// Destroys every GPU device that this process has open, as a reset of the driver does: for tests of what comes after.
#[doc(hidden)]
#[cfg(feature = "gpu")]
pub fn lose_gpu_devices() {
    crate::gpu::lose_devices();
}

/// The engine that [`Engine::Auto`] takes among these adapters, and why: a real GPU if there is one, else the CPU.
pub fn auto_choice(adapters: &[GpuAdapter]) -> (Engine, String) {
    if let Some(adapter) = real_gpu(adapters) {
        return (Engine::Gpu, format!("{} is a GPU", adapter.name));
    }
    let simd = SimdLevel::best().name();
    let reason = match adapters {
        _ if cfg!(not(feature = "gpu")) => "this build has no GPU engine".to_owned(),
        [] => "no GPU adapter was found".to_owned(),
        [only] => format!("the only adapter, {}, is no GPU", only.name),
        _ => "none of the adapters is a GPU".to_owned(),
    };
    (Engine::Cpu, format!("{reason}; the CPU has {simd}"))
}

fn real_gpu(adapters: &[GpuAdapter]) -> Option<&GpuAdapter> {
    let of = |kind| adapters.iter().find(|adapter| adapter.kind == kind);
    of(AdapterKind::Discrete).or_else(|| of(AdapterKind::Integrated)).or_else(|| of(AdapterKind::Virtual))
}

/// The adapter that is asked for by index or name, or the first real GPU.
#[cfg_attr(not(feature = "gpu"), allow(dead_code))]
pub(crate) fn choose<'a>(adapters: &'a [GpuAdapter], wanted: Option<&str>) -> Result<&'a GpuAdapter, EngineError> {
    let unavailable = |reason: String| EngineError::Unavailable { engine: "gpu", reason };
    if adapters.is_empty() {
        return Err(unavailable(
            "no adapter was found: it needs a GPU with a driver for Vulkan, Metal or DirectX 12 (on Linux the loader \
             libvulkan.so.1 too)"
                .to_owned(),
        ));
    }
    let names = || adapters.iter().map(|a| format!("{} {}", a.index, a.name)).collect::<Vec<_>>().join(", ");
    match wanted {
        None => real_gpu(adapters).ok_or_else(|| {
            unavailable(format!("there is no real GPU; a software adapter is only taken by name ({})", names()))
        }),
        Some(wanted) => {
            let lower = wanted.to_lowercase();
            // A number is an index and nothing else: many names have numbers in them.
            let found = match wanted.parse::<usize>() {
                Ok(index) => adapters.get(index),
                Err(_) if wanted.is_empty() => None,
                Err(_) => adapters.iter().find(|a| a.name.to_lowercase().contains(&lower)),
            };
            found.ok_or_else(|| {
                unavailable(format!("no adapter has the index or, in its name, '{wanted}'; there are {}", names()))
            })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_add_up_stage_by_stage() {
        let times = |ms: [u64; 3]| {
            let [upload, kernel, readback] = ms.map(Duration::from_millis);
            FrameTimings { upload, kernel, readback }
        };
        let mut sum = times([1, 20, 300]);
        sum += times([4, 50, 600]);
        assert_eq!(sum, times([5, 70, 900]));
    }

    fn adapter(index: usize, name: &str, kind: AdapterKind) -> GpuAdapter {
        GpuAdapter { index, name: name.into(), kind, backend: "vulkan".into(), driver: "1".into() }
    }

    #[test]
    fn auto_takes_a_real_gpu_and_never_software() {
        let software = adapter(0, "llvmpipe", AdapterKind::Software);
        let integrated = adapter(1, "Radeon 780M", AdapterKind::Integrated);
        let discrete = adapter(2, "NVIDIA H200", AdapterKind::Discrete);
        let all = [software.clone(), integrated.clone(), discrete.clone()];
        assert_eq!(choose(&all, None), Ok(&discrete));
        assert_eq!(choose(&all[..2], None), Ok(&integrated));
        assert!(choose(&all[..1], None).unwrap_err().to_string().contains("0 llvmpipe"));
        assert_eq!(auto_choice(&all).0, Engine::Gpu);
        let (engine, reason) = auto_choice(&all[..1]);
        assert_eq!(engine, Engine::Cpu);
        assert!(!cfg!(feature = "gpu") || reason.contains("llvmpipe"), "{reason}");
        assert_eq!(auto_choice(&[]).0, Engine::Cpu);
    }

    #[test]
    fn adapters_are_found_by_index_and_by_part_of_their_name() {
        let all =
            [adapter(0, "llvmpipe (LLVM 15)", AdapterKind::Software), adapter(1, "NVIDIA H200", AdapterKind::Discrete)];
        assert_eq!(choose(&all, Some("0")), Ok(&all[0]));
        assert_eq!(choose(&all, Some("LLVMPIPE")), Ok(&all[0]));
        assert_eq!(choose(&all, Some("h200")), Ok(&all[1]));
        assert!(choose(&all, Some("15")).is_err() && choose(&all, Some("")).is_err());
        let error = choose(&all, Some("radeon")).unwrap_err().to_string();
        assert!(error.contains("radeon") && error.contains("1 NVIDIA H200"), "{error}");
        assert!(choose(&[], Some("0")).unwrap_err().to_string().contains("libvulkan"));
    }
}
