//! The passes of the steps after smoothing: those for standard errors, then those that fill holes.

use super::fill_kernels::FillPass;
use super::layout::InputKind;
use super::sigma_kernels::SigmaPass;
use crate::outputs::Outputs;

/// A pass of a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum StepPass {
    Sigma(SigmaPass),
    Fill(FillPass),
}

impl StepPass {
    /// Returns the passes of all steps for a kind of input and these outputs of the result.
    pub(super) fn of(kind: InputKind, outputs: Outputs, fills: bool) -> [Vec<Self>; 2] {
        let sigma = SigmaPass::of(kind).into_iter().filter(|_| outputs.sigma).map(Self::Sigma);
        // Frames of points are not filled on the device.
        let fill = FillPass::of(kind, outputs).filter(|_| fills && kind != InputKind::Points).map(Self::Fill);
        [sigma.collect(), fill.collect()]
    }

    pub(super) fn entry_point(self) -> &'static str {
        match self {
            Self::Sigma(pass) => pass.entry_point(),
            Self::Fill(pass) => pass.entry_point(),
        }
    }

    /// Returns the number of workgroups for a frame of the given shape, across and down.
    pub(super) fn workgroups(self, shape: (usize, usize)) -> [usize; 2] {
        match self {
            Self::Sigma(pass) => pass.workgroups(shape),
            Self::Fill(pass) => pass.workgroups(shape),
        }
    }

    /// Returns the WGSL of the pass's kernel.
    pub(super) fn wgsl(self) -> String {
        match self {
            Self::Sigma(pass) => pass.wgsl(),
            Self::Fill(pass) => pass.wgsl(),
        }
    }
}
