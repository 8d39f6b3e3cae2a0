//! Compiles the kernels of the steps after smoothing.

use std::collections::HashSet;

use super::device::GpuDevice;
use super::layout::InputKind;
use super::slot::{Dispatch, SlotUse};
use super::step_kernels::StepPass;
use crate::error::EngineError;
use crate::outputs::Outputs;
use crate::smoothing_engine::DeviceSteps;
use crate::threads::on_a_thread_each;

/// Returns the kernels of the steps of a slot's frames: those for standard errors, then those for holes.
pub(super) fn step_kernels(
    gpu: &GpuDevice,
    used_for: &SlotUse,
    bounds_checks: bool,
) -> Result<[Vec<Dispatch>; 2], EngineError> {
    let layout = &used_for.layout;
    let shape = (layout.width, layout.height);
    let kernel = |pass: &StepPass| Ok((gpu.step_kernel(*pass, bounds_checks)?, pass.workgroups(shape)));
    let [sigma, fill] = StepPass::of(layout.kind, layout.outputs, used_for.fill_px.is_some());
    let of_step = |passes: Vec<StepPass>| passes.iter().map(kernel).collect::<Result<Vec<_>, EngineError>>();
    Ok([of_step(sigma)?, of_step(fill)?])
}

/// Compiles the kernels of the steps for all kinds of input in parallel.
pub(super) fn compile_steps(
    gpu: &GpuDevice,
    steps: &DeviceSteps,
    outputs: Outputs,
    bounds_checks: bool,
) -> Result<(), EngineError> {
    let passes = InputKind::ALL.into_iter().flat_map(|kind| StepPass::of(kind, outputs, steps.fill_px.is_some()));
    let passes: HashSet<StepPass> = passes.flatten().collect();
    let compiled = on_a_thread_each(passes, |pass| gpu.step_kernel(pass, bounds_checks).map(drop));
    let failed = || Err(gpu.failed("a kernel could not be compiled"));
    compiled.into_iter().try_for_each(|result| result.unwrap_or_else(|_| failed()))
}
