//! Opens wgpu devices with their queues: one queue, or several on which frames in flight overlap.
//!
//! A queue runs submissions in order, and wgpu puts barriers between the passes of a frame. Each pass then waits for
//! all passes of the previous frame, the last of which waits for the bus. On separate queues frames overlap: on an
//! H100, three queues sustain 1.3 times the frames of one. wgpu gives a device one queue. With Vulkan, wgpu accepts a
//! device created by the caller, so several wgpu devices are created on one Vulkan device, each with one of its queues.
//! Separate Vulkan devices, or processes, would not help: the GPU alternates between them.

/// Opens the adapter with the one queue that wgpu chooses.
pub(super) fn open_one(adapter: &wgpu::Adapter) -> Result<(wgpu::Device, wgpu::Queue), wgpu::RequestDeviceError> {
    pollster::block_on(adapter.request_device(&descriptor(adapter)))
}

/// Opens the adapter with several queues. Returns `None` if it lacks queues that are known to run concurrently, or
/// if the driver rejects the request.
#[cfg(target_vendor = "apple")]
pub(super) fn open_several(_: &wgpu::Adapter) -> Option<Vec<(wgpu::Device, wgpu::Queue)>> {
    None
}

#[cfg(not(target_vendor = "apple"))]
pub(super) use vulkan::open_several;

fn descriptor(adapter: &wgpu::Adapter) -> wgpu::DeviceDescriptor<'static> {
    let useful = wgpu::Features::TIMESTAMP_QUERY
        | wgpu::Features::TIMESTAMP_QUERY_INSIDE_ENCODERS
        | wgpu::Features::MAPPABLE_PRIMARY_BUFFERS;
    wgpu::DeviceDescriptor {
        label: Some("planish"),
        required_features: adapter.features() & useful,
        required_limits: adapter.limits(),
        ..Default::default()
    }
}

#[cfg(not(target_vendor = "apple"))]
mod vulkan {
    use std::sync::Arc;

    use ash::vk;
    use wgpu::hal::{DropCallback, api, vulkan};

    /// Maximum number of queues to use.
    const QUEUES: usize = 3;

    /// Queue priorities; all are equal.
    static PRIORITIES: [f32; QUEUES] = [1.0; QUEUES];

    /// Opens the adapter with several queues. Returns `None` if it lacks queues that are known to run concurrently,
    /// or if the driver rejects the request.
    pub(crate) fn open_several(adapter: &wgpu::Adapter) -> Option<Vec<(wgpu::Device, wgpu::Queue)>> {
        // SAFETY: no part of the adapter is destroyed.
        let raw_adapter = unsafe { adapter.as_hal::<api::Vulkan>() }?;
        let (family, available) = compute_family(&raw_adapter)?;
        let queues = available.min(QUEUES);
        if queues < 2 {
            return None;
        }
        let descriptor = super::descriptor(adapter);
        let (features, limits) = (descriptor.required_features, &descriptor.required_limits);
        let add_queues: Box<vulkan::CreateDeviceCallback> = Box::new(|device| {
            let added = vk::DeviceQueueCreateInfo::default().queue_family_index(family);
            device.queue_create_infos.push(added.queue_priorities(&PRIORITIES[..queues]));
        });
        // SAFETY: features and limits are the adapter's. The callback adds existing queues, of a different family
        // from wgpu's graphics queue.
        let owner =
            unsafe { raw_adapter.open_with_callback(features, limits, &descriptor.memory_hints, Some(add_queues)) };
        // Owns the Vulkan device, which is destroyed with the last wgpu device. The queue that `owner` has is not
        // used.
        let owner = Arc::new(owner.ok()?);
        let extensions = raw_adapter.required_device_extensions(features);
        let open = |index: u32| {
            let kept = Arc::clone(&owner);
            let drop_owner: DropCallback = Box::new(move || drop(kept));
            // SAFETY: the device was created from this adapter with these features, their extensions, and this queue,
            // which has no other user. It lives until wgpu calls the callback, after its last use of the device.
            let opened = unsafe {
                raw_adapter.device_from_raw(
                    owner.device.raw_device().clone(),
                    Some(drop_owner),
                    &extensions,
                    features,
                    limits,
                    &descriptor.memory_hints,
                    family,
                    index,
                )
            };
            // SAFETY: the device was created from this adapter with the features of the descriptor.
            unsafe { adapter.create_device_from_hal(opened.ok()?, &descriptor) }.ok()
        };
        (0..queues as u32).map(open).collect()
    }

    /// Returns a queue family that supports compute but not graphics, and its number of queues. On GPUs with several
    /// such queues, they run concurrently.
    fn compute_family(adapter: &vulkan::Adapter) -> Option<(u32, usize)> {
        let instance = adapter.shared_instance().raw_instance();
        // SAFETY: the physical device is one of this instance's.
        let families = unsafe { instance.get_physical_device_queue_family_properties(adapter.raw_physical_device()) };
        let is_for_computing = |family: &vk::QueueFamilyProperties| {
            family.queue_flags.contains(vk::QueueFlags::COMPUTE)
                && !family.queue_flags.contains(vk::QueueFlags::GRAPHICS)
                && family.timestamp_valid_bits > 0
        };
        let (family, found) = (0..).zip(&families).find(|(_, family)| is_for_computing(family))?;
        Some((family, found.queue_count as usize))
    }
}
