//! GPU adapters, the choice among them, and the options of the GPU engine.

use crate::error::EngineError;

/// The kind of an adapter's device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize), serde(rename_all = "lowercase"))]
#[non_exhaustive]
pub enum AdapterKind {
    /// A graphics card.
    Discrete,
    /// A GPU that shares memory with the CPU.
    Integrated,
    /// A GPU assigned to a virtual machine.
    Virtual,
    /// A GPU emulated on the CPU, such as lavapipe, for tests. `Auto` never chooses it.
    Software,
    /// A kind that the driver does not report.
    Other,
}

/// A GPU adapter of this machine.
#[derive(Debug, Clone, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct GpuAdapter {
    /// The adapter's index, by which it can be selected.
    pub index: usize,
    /// The adapter's name. Any part of the name selects the adapter.
    pub name: String,
    /// The kind of device.
    pub kind: AdapterKind,
    /// The graphics API: vulkan, metal or dx12.
    pub backend: String,
    /// The driver's name and version.
    pub driver: String,
}

/// The method by which frames are transferred to the GPU, and results back.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum Transfer {
    /// The faster method for this device, as far as is known.
    #[default]
    Auto,
    /// Frames are copied to the device's memory, and results back.
    Staged,
    /// Kernels read frames from, and write results to, the host's memory.
    Direct,
}

/// Options of the GPU engine. The defaults suit everything except tests and measurements.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct GpuOptions {
    /// The adapter's index or any part of its name, case-insensitive; `None` for a real GPU, preferably a discrete
    /// one. A software adapter can only be selected here. `Engine::Auto` ignores this option.
    pub adapter: Option<String>,
    /// Maximum number of frames in flight, submitted and not yet received; at least 1. To keep a GPU busy, 3 suffice if
    /// results are read in place, 6 if they are copied out. The limit applies to the other engines too.
    pub slots: usize,
    /// True to measure each frame's times on the device; see [`SmoothedView::timings`](crate::SmoothedView::timings).
    /// Overlapping frames in flight each take longer than a single frame. The CPU engine measures its times as well.
    pub timestamps: bool,
    /// True if shaders check the bounds of every memory access.
    pub bounds_checks: bool,
    /// The transfer of frames to the device and of results back.
    pub transfer: Transfer,
    /// Maximum number of points of an unorganized cloud on the device at once; `None` for the device's limit. Larger
    /// clouds are smoothed in overlapping parts, which takes longer. If neighbourhoods are too large for such parts,
    /// smoothing returns [`EngineError::Crowded`](crate::EngineError::Crowded).
    pub points_at_once: Option<usize>,
}

impl GpuOptions {
    /// Sets the adapter by its index or a part of its name; `None` for a real GPU, preferably a discrete one.
    pub fn with_adapter(self, adapter: impl Into<Option<String>>) -> Self {
        Self { adapter: adapter.into(), ..self }
    }

    /// Sets the maximum number of frames in flight.
    pub fn with_slots(self, slots: usize) -> Self {
        Self { slots, ..self }
    }

    /// Sets whether each frame's times are measured.
    pub fn with_timestamps(self, timestamps: bool) -> Self {
        Self { timestamps, ..self }
    }

    /// Sets whether shaders check the bounds of every memory access.
    pub fn with_bounds_checks(self, bounds_checks: bool) -> Self {
        Self { bounds_checks, ..self }
    }

    /// Sets the transfer of frames to the device and of results back.
    pub fn with_transfer(self, transfer: Transfer) -> Self {
        Self { transfer, ..self }
    }

    /// Sets the maximum number of points of an unorganized cloud on the device at once; `None` for the device's
    /// limit.
    pub fn with_points_at_once(self, points_at_once: Option<usize>) -> Self {
        Self { points_at_once, ..self }
    }
}

impl Default for GpuOptions {
    /// Returns options for a real GPU, 6 slots and no timestamps. Debug builds check bounds.
    fn default() -> Self {
        Self {
            adapter: None,
            slots: 6,
            timestamps: false,
            bounds_checks: cfg!(debug_assertions),
            transfer: Transfer::Auto,
            points_at_once: None,
        }
    }
}

/// Returns the default GPU: the first discrete one, otherwise the first integrated one, otherwise the first virtual
/// one.
pub(crate) fn real_gpu(adapters: &[GpuAdapter]) -> Option<&GpuAdapter> {
    let of = |kind| adapters.iter().find(|adapter| adapter.kind == kind);
    of(AdapterKind::Discrete).or_else(|| of(AdapterKind::Integrated)).or_else(|| of(AdapterKind::Virtual))
}

/// Returns the adapter with this index or part of its name; the default GPU if `wanted` is `None`.
pub(crate) fn choose<'a>(adapters: &'a [GpuAdapter], wanted: Option<&str>) -> Result<&'a GpuAdapter, EngineError> {
    let unavailable = |reason: String| EngineError::Unavailable { engine: "gpu", reason };
    if adapters.is_empty() {
        return Err(unavailable(
            "no adapter was found; install a GPU driver for Vulkan, Metal or DirectX 12 (on Linux also the loader \
             libvulkan.so.1)"
                .to_owned(),
        ));
    }
    let names = || adapters.iter().map(|a| format!("{} {}", a.index, a.name)).collect::<Vec<_>>().join(", ");
    match wanted {
        None => real_gpu(adapters).ok_or_else(|| {
            unavailable(format!("no hardware GPU was found; select a software adapter by name ({})", names()))
        }),
        Some(wanted) => {
            let names_alone: Vec<&str> = adapters.iter().map(|adapter| adapter.name.as_str()).collect();
            let found = find(&names_alone, wanted).map(|index| &adapters[index]);
            found.ok_or_else(|| {
                unavailable(format!("no adapter has the index or name '{wanted}'; available are {}", names()))
            })
        }
    }
}

/// Returns the position in `names` of the device with this index or part of its name, case-insensitive. A number is
/// always an index, because many names contain numbers.
pub(crate) fn find(names: &[impl AsRef<str>], wanted: &str) -> Option<usize> {
    let lower = wanted.to_lowercase();
    match wanted.parse::<usize>() {
        Ok(index) => (index < names.len()).then_some(index),
        Err(_) if wanted.is_empty() => None,
        Err(_) => names.iter().position(|name| name.as_ref().to_lowercase().contains(&lower)),
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn adapter(index: usize, name: &str, kind: AdapterKind) -> GpuAdapter {
        GpuAdapter { index, name: name.into(), kind, backend: "vulkan".into(), driver: "1".into() }
    }

    #[test]
    fn the_first_real_gpu_is_taken_and_software_only_by_name() {
        let software = adapter(0, "llvmpipe", AdapterKind::Software);
        let integrated = adapter(1, "Radeon 780M", AdapterKind::Integrated);
        let discrete = adapter(2, "NVIDIA H200", AdapterKind::Discrete);
        let all = [software.clone(), integrated.clone(), discrete.clone()];
        assert_eq!(choose(&all, None), Ok(&discrete));
        assert_eq!(choose(&all[..2], None), Ok(&integrated));
        assert!(choose(&all[..1], None).unwrap_err().to_string().contains("0 llvmpipe"));
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
