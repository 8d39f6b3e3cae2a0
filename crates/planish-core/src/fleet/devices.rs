//! The devices of a fleet.

use crate::devices::{AdapterKind, GpuAdapter, GpuOptions, choose};
use crate::engines::{Engine, SmootherOptions, gpu_adapters};
use crate::error::EngineError;

/// A device of a fleet.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum FleetDevice {
    /// A GPU, given by its index or any part of its name ([`GpuOptions::adapter`]).
    Gpu(String),
    /// The CPU engine, with the number of threads in the options.
    Cpu,
}

impl FleetDevice {
    /// Parses a comma-separated list of devices: GPU indices or parts of GPU names, `all` for every discrete,
    /// integrated or virtual GPU, and `cpu` for the CPU.
    ///
    /// # Errors
    /// If the list is empty, names an unknown device, or names one twice.
    pub fn parse_list(list: &str) -> Result<Vec<Self>, EngineError> {
        Self::among(&gpu_adapters(), list)
    }

    fn among(adapters: &[GpuAdapter], list: &str) -> Result<Vec<Self>, EngineError> {
        let unavailable = |reason: String| EngineError::Unavailable { engine: "gpu", reason };
        let is_real = |adapter: &&GpuAdapter| {
            matches!(adapter.kind, AdapterKind::Discrete | AdapterKind::Integrated | AdapterKind::Virtual)
        };
        let mut devices = Vec::new();
        for name in list.split(',').map(str::trim) {
            let named = match name.to_lowercase().as_str() {
                "cpu" => vec![Self::Cpu],
                "all" => {
                    // Without a GPU, this fails with the list of adapters.
                    let first = choose(adapters, None)?;
                    // Each backend lists every GPU, so only one backend counts.
                    let is_listed = |adapter: &&GpuAdapter| adapter.backend == first.backend;
                    adapters.iter().filter(is_real).filter(is_listed).map(Self::of).collect()
                }
                _ => vec![Self::of(choose(adapters, Some(name))?)],
            };
            for device in named {
                if devices.contains(&device) {
                    return Err(unavailable(format!(
                        "the device list '{list}' names {} twice; name each device once",
                        device.name(adapters)
                    )));
                }
                devices.push(device);
            }
        }
        Ok(devices)
    }

    fn of(adapter: &GpuAdapter) -> Self {
        Self::Gpu(adapter.index.to_string())
    }

    fn name(&self, adapters: &[GpuAdapter]) -> String {
        match self {
            Self::Cpu => "the CPU".to_owned(),
            Self::Gpu(wanted) => match choose(adapters, Some(wanted)) {
                Ok(adapter) => format!("{} (index {})", adapter.name, adapter.index),
                Err(_) => wanted.clone(),
            },
        }
    }

    /// Returns the options for the device's smoother: `options` with engine and adapter replaced.
    pub fn options(&self, options: &SmootherOptions) -> SmootherOptions {
        match self {
            Self::Cpu => options.clone().with_engine(Engine::Cpu),
            Self::Gpu(adapter) => {
                let gpu = GpuOptions { adapter: Some(adapter.clone()), ..options.gpu.clone() };
                options.clone().with_engine(Engine::Gpu).with_gpu(gpu)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::devices::tests::adapter;

    #[test]
    fn lists_name_devices_once_each() {
        let adapters = [
            adapter(0, "llvmpipe", AdapterKind::Software),
            adapter(1, "NVIDIA H200", AdapterKind::Discrete),
            adapter(2, "NVIDIA H200", AdapterKind::Discrete),
        ];
        let gpu = |index: usize| FleetDevice::Gpu(index.to_string());
        let of = |list| FleetDevice::among(&adapters, list);
        assert_eq!(of("all"), Ok(vec![gpu(1), gpu(2)]));
        assert_eq!(of("all,cpu"), Ok(vec![gpu(1), gpu(2), FleetDevice::Cpu]));
        assert_eq!(of("2, 1"), Ok(vec![gpu(2), gpu(1)]));
        assert_eq!(of("llvm,CPU"), Ok(vec![gpu(0), FleetDevice::Cpu]));
        for (list, said) in [
            ("", "available are 0 llvmpipe"),
            ("1,", "available are 0 llvmpipe"),
            ("3", "'3'"),
            ("all,1", "NVIDIA H200 (index 1) twice"),
            ("h200,H200", "twice"),
            ("cpu,cpu", "the CPU twice"),
        ] {
            let error = of(list).unwrap_err().to_string();
            assert!(error.contains(said), "{list}: {error}");
        }
        let error = FleetDevice::among(&adapters[..1], "all").unwrap_err().to_string();
        assert!(error.contains("no hardware GPU"), "{error}");
        assert_eq!(FleetDevice::among(&[], "cpu"), Ok(vec![FleetDevice::Cpu]));
    }
}
