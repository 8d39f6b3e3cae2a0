//! Builds a session, and reports doubts about its frames.

use super::{Chosen, Session, SessionEvent};
use crate::doubts::{doubt_about_lens, doubts};
use crate::engines::SmootherOptions;
use crate::fleet::FleetDevice;
use crate::frame::Frame;
use crate::sensor::SensorModel;
use crate::threads::ONE_THREAD;

impl Session {
    /// Sets whether frames come from a live source. If so, fewer frames are kept in flight, which reduces the
    /// latency.
    pub fn with_live(self, is_live: bool) -> Self {
        Self { is_live, ..self }
    }

    /// Sets whether there is only one frame or cloud. [`Engine::Auto`](crate::Engine::Auto) then uses the CPU for up
    /// to six million pixels or half a million points, since opening a GPU takes longer than smoothing them.
    pub fn with_single_frame(self, is_single: bool) -> Self {
        Self { is_single, ..self }
    }

    /// Sets whether all frames of a shape use the window of the first frame with a known resolution, which suits a
    /// video. Otherwise every frame gets its own window.
    pub fn with_kept_window(self, keeps_window: bool) -> Self {
        Self { keeps_window, ..self }
    }

    /// Sets whether the sensor estimated from the first frame is used for all frames, as in a video or a folder.
    /// Otherwise it is estimated from every frame.
    pub fn with_kept_sensor(self, keeps_sensor: bool) -> Self {
        Self { keeps_sensor, ..self }
    }

    /// Sets the sensor that was estimated from earlier frames and is used for all frames, if the settings ask for an
    /// estimate.
    pub fn with_estimated_sensor(self, sensor: Option<SensorModel>) -> Self {
        Self { estimated: sensor, keeps_sensor: self.keeps_sensor || sensor.is_some(), ..self }
    }

    /// Sets whether unorganized clouds are examined if the settings allow it [default: true]. If so, the pixel grid
    /// of a frame that was saved without it is rebuilt; for other clouds, the number of neighbours, edges and passes
    /// are chosen by noise and shape. If not, the parameters are those of
    /// [`Settings::cloud_params`](crate::Settings::cloud_params), which is faster and avoids flicker in a video.
    pub fn with_cloud_estimates(self, estimates_clouds: bool) -> Self {
        Self { estimates_clouds, ..self }
    }

    /// Sets options that settings do not cover (slots, timestamps, the instruction set). Settings override all other
    /// options.
    pub fn with_options(mut self, options: SmootherOptions) -> Self {
        self.options = match &self.chosen {
            Chosen::Settings(settings) => settings.override_options(options),
            Chosen::Params(..) => options,
        };
        self
    }

    /// Sets the devices that share the frames; they replace the settings' devices.
    pub fn with_devices(self, devices: Vec<FleetDevice>) -> Self {
        Self { devices, device: 0, ..self }
    }

    /// Sets the index of the device that smooths frames one at a time, modulo the number of devices. Use this if
    /// several sessions share a list of devices.
    pub fn with_device(self, index: usize) -> Self {
        let device = if self.devices.is_empty() { 0 } else { index % self.devices.len() };
        Self { device, ..self }
    }

    /// Adds an event for each new doubt about a frame.
    pub(super) fn doubt(&mut self, frame: Frame<'_>) {
        let camera = frame.camera().copied();
        // WebAssembly builds have no text for this doubt.
        let of_lens = (camera != self.doubted_camera && !ONE_THREAD)
            .then(|| camera.as_ref().and_then(doubt_about_lens))
            .flatten();
        self.doubted_camera = camera;
        for doubt in doubts(frame).into_iter().chain(of_lens) {
            if !self.doubts.contains(&doubt) {
                self.doubts.push(doubt);
                self.events.push(SessionEvent::Doubtful(doubt));
            }
        }
    }
}
