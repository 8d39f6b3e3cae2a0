//! The parameters for each frame, from settings, estimates and the session's state.

use super::event::{CloudChoice, SessionEvent};
use super::{Chosen, Session};
use crate::error::Error;
use crate::frame::{Frame, FrameGeometry};
use crate::params::{EngineParams, FrameParams, Params};
use crate::sensor::SensorModel;
use crate::settings::{SensorChoice, Settings};

impl Session {
    /// Returns the parameters for a frame, and the sensor whose noise model the steps before smoothing use. The sensor
    /// is `None` if no such step is set. Estimates values that the settings do not give, and reports each new estimate
    /// as an event.
    pub(super) fn resolve(&mut self, frame: Frame<'_>) -> Result<(Params, Option<SensorModel>), Error> {
        if let Some(params) = self.is_first {
            return Ok((params.into(), None));
        }
        let (width, height) = frame.shape();
        let known_choice = self.cloud_choice.take();
        match &self.chosen {
            Chosen::Params(params, _) if frame.grid().is_some() => Ok(((*params).into(), None)),
            Chosen::Params(_, params) => Ok(((*params).into(), None)),
            Chosen::Settings(settings) if settings.estimates_sensor() && frame.grid().is_some() => {
                let mut settings = Settings::clone(settings);
                // The noise model of a video must not change.
                let keeps_sensor = self.keeps_sensor || settings.temporal_params().is_some();
                let kept = self.estimated.filter(|_| keeps_sensor);
                settings.sensor = kept.map(SensorChoice::Known).or(settings.sensor);
                let resolved = settings.resolve(frame)?;
                if let Params::Frame(params) = resolved.params
                    && self.estimated != Some(params.sensor)
                {
                    self.estimated = Some(params.sensor);
                    self.events.push(SessionEvent::SensorEstimated { sensor: params.sensor });
                }
                Ok((resolved.params, resolved.preparation_sensor))
            }
            Chosen::Settings(settings) if frame.grid().is_none() && settings.chooses_neighbours() => {
                if !self.estimates_clouds {
                    return Ok((settings.cloud_params()?.into(), None));
                }
                let is_known = self.is_prepared && self.known_points == width * height;
                if let Some(params) = self.cloud_params.filter(|_| is_known) {
                    self.cloud_choice = known_choice;
                    return Ok((params.into(), None));
                }
                let resolved = settings.resolve_on(frame, self.options.threads)?;
                (self.cloud_estimate, self.known_points) = (resolved.cloud_estimate, width * height);
                // The estimate is reused if an engine fails and another takes over.
                self.is_prepared = true;
                if let Params::Cloud(params) = &resolved.params {
                    self.cloud_params = Some(*params);
                    self.events
                        .extend(resolved.recognized_sensor.map(|sensor| SessionEvent::SensorRecognized { sensor }));
                    let passes = if resolved.first_pass.is_some() { 2 } else { 1 };
                    self.cloud_choice = CloudChoice::of(params, passes, resolved.cloud_estimate);
                    self.events.extend(self.cloud_choice.map(SessionEvent::NeighboursChosen));
                }
                Ok((resolved.params, None))
            }
            Chosen::Settings(settings) => {
                let resolved = settings.resolve(frame)?;
                Ok((resolved.params, resolved.preparation_sensor))
            }
        }
    }

    /// Returns the engine's parameters with the window size for a frame.
    pub(super) fn with_window(
        &mut self,
        engine_params: EngineParams,
        params: Params,
        frame: Frame<'_>,
        geometry: &FrameGeometry,
    ) -> EngineParams {
        let (Params::Frame(FrameParams { window, .. }), Some(shape)) = (params, frame.grid()) else {
            return engine_params;
        };
        let kept = self.kept_window.filter(|(of_shape, _)| self.keeps_window && *of_shape == shape);
        let size = match kept {
            Some((_, size)) => Some(size),
            None => geometry.rule.known_pitch_at_1m().filter(|_| window.is_auto()).map(|pitch| window.at_pitch(pitch)),
        };
        if let Some(size) = size {
            self.kept_window = Some((shape, size));
        }
        engine_params.with_size(size.unwrap_or(window.nominal()))
    }
}
