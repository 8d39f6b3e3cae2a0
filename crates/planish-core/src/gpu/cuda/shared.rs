//! Vulkan's side of memory and semaphores that are shared with CUDA.

use std::ffi::CStr;
use std::os::fd::{FromRawFd, OwnedFd};
use std::sync::Arc;

use ash::vk;
use wgpu::hal::{api, vulkan};

use super::super::queues;
use crate::devices::GpuAdapter;

/// wgpu devices, one per queue, on a Vulkan device that exports memory and semaphores.
pub(super) struct SharingDevice {
    pub(super) devices: Vec<(wgpu::Device, wgpu::Queue)>,
    pub(super) exporter: Arc<Exporter>,
    /// Of the physical device.
    pub(super) uuid: [u8; 16],
}

/// Exports memory and semaphores of a device.
pub(super) struct Exporter {
    device: ash::Device,
    memory_fd: ash::khr::external_memory_fd::Device,
    semaphore_fd: ash::khr::external_semaphore_fd::Device,
    memory: vk::PhysicalDeviceMemoryProperties,
    /// Keeps the Vulkan device.
    _owner: wgpu::Device,
}

/// A buffer whose memory is exported once.
pub(super) struct ExportedBuffer {
    pub(super) buffer: wgpu::Buffer,
    pub(super) fd: OwnedFd,
    /// Bytes of its memory.
    pub(super) allocated: u64,
}

const MEMORY_FD: vk::ExternalMemoryHandleTypeFlags = vk::ExternalMemoryHandleTypeFlags::OPAQUE_FD;
const SEMAPHORE_FD: vk::ExternalSemaphoreHandleTypeFlags = vk::ExternalSemaphoreHandleTypeFlags::OPAQUE_FD;

/// Extensions for exporting, in addition to those of wgpu.
const EXTENSIONS: [&CStr; 4] = [
    ash::khr::external_memory::NAME,
    ash::khr::external_memory_fd::NAME,
    ash::khr::external_semaphore::NAME,
    ash::khr::external_semaphore_fd::NAME,
];

fn failed(what: &str) -> impl Fn(vk::Result) -> String + '_ {
    move |error| format!("{what}: {error}")
}

impl SharingDevice {
    /// Opens an adapter.
    pub(super) fn open(adapter: &wgpu::Adapter, chosen: &GpuAdapter) -> Result<Self, String> {
        // SAFETY: nothing of the adapter is destroyed.
        let raw_adapter = unsafe { adapter.as_hal::<api::Vulkan>() };
        let raw_adapter = raw_adapter.ok_or_else(|| format!("{} is not reached by Vulkan", chosen.name))?;
        let instance = raw_adapter.shared_instance().raw_instance();
        let physical = raw_adapter.raw_physical_device();
        // SAFETY: the physical device is one of this instance's.
        let available = unsafe { instance.enumerate_device_extension_properties(physical) };
        let available = available.map_err(failed("vkEnumerateDeviceExtensionProperties"))?;
        let has = |name: &CStr| available.iter().any(|found| found.extension_name_as_c_str() == Ok(name));
        if let Some(missing) = EXTENSIONS.iter().find(|name| !has(name)) {
            return Err(format!("the driver of {} lacks {}", chosen.name, missing.to_string_lossy()));
        }
        let devices = queues::open_with(adapter, &EXTENSIONS);
        let devices = devices.ok_or_else(|| format!("{} has no queues side by side", chosen.name))?;
        // SAFETY: nothing of the device is destroyed.
        let device = unsafe { devices[0].0.as_hal::<api::Vulkan>() }.map(|device| device.raw_device().clone());
        let device = device.ok_or("the device is not Vulkan's")?;
        let mut id = vk::PhysicalDeviceIDProperties::default();
        let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut id);
        // SAFETY: the physical device is one of this instance's.
        let memory = unsafe {
            instance.get_physical_device_properties2(physical, &mut properties);
            instance.get_physical_device_memory_properties(physical)
        };
        let exporter = Exporter {
            memory_fd: ash::khr::external_memory_fd::Device::new(instance, &device),
            semaphore_fd: ash::khr::external_semaphore_fd::Device::new(instance, &device),
            device,
            memory,
            // The wgpu devices keep the Vulkan device.
            _owner: devices[0].0.clone(),
        };
        Ok(Self { devices, exporter: Arc::new(exporter), uuid: id.device_uuid })
    }

    /// Makes a storage buffer for a queue in device memory that is exported.
    pub(super) fn buffer(&self, queue: usize, label: &'static str, bytes: u64) -> Result<ExportedBuffer, String> {
        use vk::BufferUsageFlags as Usage;
        let exporter = &self.exporter;
        let device = &exporter.device;
        let mut external = vk::ExternalMemoryBufferCreateInfo::default().handle_types(MEMORY_FD);
        let create = vk::BufferCreateInfo::default()
            .size(bytes)
            .usage(Usage::STORAGE_BUFFER | Usage::TRANSFER_DST | Usage::TRANSFER_SRC)
            .push_next(&mut external);
        // SAFETY: each object is created on this device, from complete descriptions, and destroyed by wgpu.
        unsafe {
            let buffer = device.create_buffer(&create, None).map_err(failed("vkCreateBuffer"))?;
            let required = device.get_buffer_memory_requirements(buffer);
            let local = vk::MemoryPropertyFlags::DEVICE_LOCAL;
            let is_fit = |i: &u32| {
                let kind = exporter.memory.memory_types[*i as usize];
                required.memory_type_bits & (1 << i) != 0 && kind.property_flags.contains(local)
            };
            let kind = (0..exporter.memory.memory_type_count).find(is_fit);
            let kind = kind.ok_or("no memory of the device for an exported buffer")?;
            let mut export = vk::ExportMemoryAllocateInfo::default().handle_types(MEMORY_FD);
            let mut dedicated = vk::MemoryDedicatedAllocateInfo::default().buffer(buffer);
            let allocate = vk::MemoryAllocateInfo::default()
                .allocation_size(required.size)
                .memory_type_index(kind)
                .push_next(&mut export)
                .push_next(&mut dedicated);
            let memory = device.allocate_memory(&allocate, None);
            let memory = memory.map_err(failed("vkAllocateMemory of memory to export"))?;
            device.bind_buffer_memory(buffer, memory, 0).map_err(failed("vkBindBufferMemory"))?;
            let get = vk::MemoryGetFdInfoKHR::default().memory(memory).handle_type(MEMORY_FD);
            let fd = exporter.memory_fd.get_memory_fd(&get).map_err(failed("vkGetMemoryFdKHR"))?;
            let raw = vulkan::Buffer::from_raw_managed(buffer, memory, 0, required.size);
            let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
            let descriptor =
                wgpu::BufferDescriptor { label: Some(label), size: bytes, usage, mapped_at_creation: false };
            let buffer = self.devices[queue].0.create_buffer_from_hal::<api::Vulkan>(raw, &descriptor);
            Ok(ExportedBuffer { buffer, fd: OwnedFd::from_raw_fd(fd), allocated: required.size })
        }
    }

    /// Has the next submission to a queue wait for one value, and signal another.
    pub(super) fn stage(
        &self,
        queue: usize,
        wait: (vk::Semaphore, u64),
        signal: (vk::Semaphore, u64),
    ) -> Result<(), String> {
        // SAFETY: the queue is not destroyed.
        let queue = unsafe { self.devices[queue].1.as_hal::<api::Vulkan>() }.ok_or("the queue is not Vulkan's")?;
        queue.add_wait_semaphore(wait.0, Some(wait.1), vk::PipelineStageFlags::ALL_COMMANDS);
        queue.add_signal_semaphore(signal.0, Some(signal.1));
        Ok(())
    }
}

impl Exporter {
    /// Makes a timeline semaphore that begins at 0, and a file descriptor of it.
    pub(super) fn semaphore(&self) -> Result<(vk::Semaphore, OwnedFd), String> {
        let mut export = vk::ExportSemaphoreCreateInfo::default().handle_types(SEMAPHORE_FD);
        let mut kind =
            vk::SemaphoreTypeCreateInfo::default().semaphore_type(vk::SemaphoreType::TIMELINE).initial_value(0);
        let create = vk::SemaphoreCreateInfo::default().push_next(&mut export).push_next(&mut kind);
        // SAFETY: the descriptions are complete; the semaphore is destroyed by `destroy`.
        unsafe {
            let semaphore = self.device.create_semaphore(&create, None).map_err(failed("vkCreateSemaphore"))?;
            let get = vk::SemaphoreGetFdInfoKHR::default().semaphore(semaphore).handle_type(SEMAPHORE_FD);
            let fd = self.semaphore_fd.get_semaphore_fd(&get).map_err(failed("vkGetSemaphoreFdKHR"))?;
            Ok((semaphore, OwnedFd::from_raw_fd(fd)))
        }
    }

    /// Destroys a semaphore that nothing waits for.
    pub(super) fn destroy(&self, semaphore: vk::Semaphore) {
        // SAFETY: the caller has waited for the last submission.
        unsafe { self.device.destroy_semaphore(semaphore, None) };
    }
}
