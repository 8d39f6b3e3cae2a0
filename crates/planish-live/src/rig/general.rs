//! The smoother for the points of all cameras as one cloud.

use std::sync::{Arc, Mutex, PoisonError};

use planish_core::{CloudParams, Error, FleetDevice, Outputs, Progress, Smoother, SmootherOptions};

/// The smoother for the points of all cameras as one cloud.
pub(super) struct General {
    params: CloudParams,
    /// Voxel size in metres for thinning; `None` keeps all points.
    voxel_m: Option<f64>,
    smoother: Option<Smoother>,
    stopper: Stopper,
}

/// A handle with which another thread cancels the smoothing of all points as one cloud, which takes seconds for
/// millions of points.
#[derive(Clone, Default)]
pub(super) struct Stopper(Arc<Mutex<Option<Arc<Progress>>>>);

impl Stopper {
    /// Cancels the running work, which returns [`EngineError::Stopped`](planish_core::EngineError::Stopped); does
    /// nothing if no work is running.
    pub(super) fn stop(&self) {
        if let Some(progress) = &*self.0.lock().unwrap_or_else(PoisonError::into_inner) {
            progress.stop();
        }
    }

    fn watch(&self, smoother: &Smoother) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = smoother.progress();
    }
}

impl General {
    pub(super) fn new(params: CloudParams) -> Self {
        Self { params, voxel_m: None, smoother: None, stopper: Stopper::default() }
    }

    pub(super) fn with_voxel_m(self, voxel_m: Option<f64>) -> Self {
        Self { voxel_m, ..self }
    }

    pub(super) fn voxel_m(&self) -> Option<f64> {
        self.voxel_m
    }

    pub(super) fn stopper(&self) -> Stopper {
        self.stopper.clone()
    }

    pub(super) fn close(&mut self) {
        self.smoother = None;
    }

    /// Opens the engine if it is closed, on `device` or, without one, on the options' device.
    pub(super) fn open(
        &mut self,
        options: &SmootherOptions,
        outputs: Outputs,
        device: Option<&FleetDevice>,
    ) -> Result<&mut Smoother, Error> {
        Ok(match &mut self.smoother {
            Some(smoother) => smoother,
            empty => {
                let options = device.map_or_else(|| options.clone(), |device| device.options(options));
                // Moving points onto the voxels' tangent planes needs points and normals.
                let with_normals = outputs.with_points(true).with_normals(true);
                let outputs = if self.voxel_m.is_some() { with_normals } else { outputs };
                let smoother = Smoother::open_clouds(self.params, &options.with_outputs(outputs))?;
                self.stopper.watch(&smoother);
                empty.insert(smoother)
            }
        })
    }
}
