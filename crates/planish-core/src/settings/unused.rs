//! Settings without effect on a kind of input, which front ends report.

use super::{Preset, Settings, TemporalChoice};
use crate::params::Project;

impl Settings {
    /// Returns the names of the given settings that have no effect on unorganized clouds.
    pub fn unused_by_clouds(&self) -> Vec<&'static str> {
        let mut unused = self.unused_without_pixels();
        let has_sensor = self.sensor_of_clouds().is_some();
        // Points move along rays if the sensor is known, otherwise along normals.
        let idle = if has_sensor { Project::Normal } else { Project::Ray };
        unused.extend(Some("project").filter(|_| self.project == Some(idle)));
        let may_have_sensor = has_sensor || (self.estimates_sensor() && self.chooses_neighbours());
        unused.extend(Some("sensor").filter(|_| self.sensor.is_some() && !may_have_sensor));
        if !self.chooses_neighbours() && !has_sensor {
            unused.extend(self.given_preset_or_strength());
        }
        unused
    }

    /// Same as [`unused_by_clouds`](Self::unused_by_clouds), for clouds whose known spacing determines the radius.
    pub fn unused_by_clouds_of_known_spacing(&self) -> Vec<&'static str> {
        let mut unused = self.unused_without_pixels();
        unused.extend(Some("project").filter(|_| self.project == Some(Project::Ray)));
        unused.extend(Some("sensor").filter(|_| self.sensor.is_some()));
        unused.extend(self.given_preset_or_strength());
        unused.extend(Some("even").filter(|_| self.spaces_evenly()));
        unused
    }

    fn unused_without_pixels(&self) -> Vec<&'static str> {
        let given = [
            ("window", self.window.is_some()),
            ("stride", self.stride.is_some()),
            ("average_blocks", self.average_blocks.is_some()),
            ("temporal", self.temporal == Some(TemporalChoice::Steady)),
            ("track", self.tracks_camera()),
        ];
        given.into_iter().filter(|(_, is_given)| *is_given).map(|(name, _)| name).collect()
    }

    fn given_preset_or_strength(&self) -> impl Iterator<Item = &'static str> {
        let has_preset = !matches!(self.preset, None | Some(Preset::Paper));
        let given = [("preset", has_preset), ("strength", self.strength.is_some())];
        given.into_iter().filter(|(_, is_given)| *is_given).map(|(name, _)| name)
    }

    /// Returns the names of the given settings that have no effect on frames.
    pub fn unused_by_frames(&self) -> Vec<&'static str> {
        let given = [
            ("remove_isolated", self.remove_isolated == Some(true)),
            ("passes", self.passes.is_some()),
            ("even", self.spaces_evenly()),
        ];
        given.into_iter().filter(|(_, is_given)| *is_given).map(|(name, _)| name).collect()
    }
}
