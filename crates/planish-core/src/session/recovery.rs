//! The policy for failed GPUs, shared by sessions and rigs.

use crate::error::{EngineError, Error};

/// The next step after an error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Recovery {
    /// Open the GPU once more and smooth the frames in flight again.
    Reopen,
    /// Continue with the CPU engine.
    UseCpu,
    /// Report the error.
    Fail,
}

/// A record of GPU failures. After the first, the GPU is reopened; after the second, it is abandoned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct GpuLosses {
    has_reopened: bool,
    uses_cpu: bool,
}

impl GpuLosses {
    /// Decides how to recover from an error. `was_gpu` states whether the engine was a GPU, `was_open` whether the
    /// engine was open (a GPU that never opened was not lost), and `may_use_cpu` whether the CPU engine may replace
    /// the GPU.
    pub fn next(&mut self, error: &Error, was_gpu: bool, was_open: bool, may_use_cpu: bool) -> Recovery {
        let is_loss = matches!(error, Error::Engine(error) if !matches!(error, EngineError::Stopped));
        // While the GPU is being reopened, no engine is open.
        let is_of_gpu = (was_gpu && was_open) || self.has_reopened;
        if !is_loss || !is_of_gpu || self.uses_cpu {
            return Recovery::Fail;
        }
        if !std::mem::replace(&mut self.has_reopened, true) {
            return Recovery::Reopen;
        }
        if !may_use_cpu {
            return Recovery::Fail;
        }
        self.uses_cpu = true;
        Recovery::UseCpu
    }

    /// Returns true if the CPU engine has taken over.
    pub fn uses_cpu(&self) -> bool {
        self.uses_cpu
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lost() -> Error {
        EngineError::Lost { device: "GPU".into(), reason: "reset".into() }.into()
    }

    #[test]
    fn a_lost_gpu_is_opened_once_more_and_then_given_up() {
        let mut losses = GpuLosses::default();
        assert_eq!(losses.next(&lost(), true, true, true), Recovery::Reopen);
        assert_eq!(losses.next(&lost(), false, false, true), Recovery::UseCpu);
        assert!(losses.uses_cpu());
        assert_eq!(losses.next(&lost(), false, true, true), Recovery::Fail);
    }

    #[test]
    fn what_is_no_loss_is_reported() {
        let mut losses = GpuLosses::default();
        assert_eq!(losses.next(&lost(), true, false, true), Recovery::Fail, "it never opened");
        assert_eq!(losses.next(&lost(), false, true, true), Recovery::Fail, "the CPU engine");
        assert_eq!(losses.next(&EngineError::Stopped.into(), true, true, true), Recovery::Fail);
        assert_eq!(losses.next(&lost(), true, true, false), Recovery::Reopen);
        assert_eq!(losses.next(&lost(), true, true, false), Recovery::Fail, "a GPU asked for by name");
        assert!(!losses.uses_cpu());
    }
}
