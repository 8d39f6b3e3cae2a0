//! Notes of `planish smooth` on standard error: options without effect, and the session's decisions.

use std::path::Path;

use planish::{CloudChoice, SessionEvent};
use planish_bench::errln;

use super::Worker;
use crate::args::option_of;

impl Worker<'_> {
    /// Reports options that have no effect on unorganized clouds.
    pub(super) fn report_unused_by_clouds(&self, input: &Path) {
        let mut unused: Vec<String> = self.settings.unused_by_clouds().into_iter().map(option_of).collect();
        let given = [
            ("--camera", self.args.camera.camera.is_some() || self.args.camera.camera_file.is_some()),
            ("--depth-units-per-metre", self.args.camera.depth_units_per_metre.is_some()),
        ];
        unused.extend(given.into_iter().filter(|(_, is_given)| *is_given).map(|(name, _)| name.to_owned()));
        if !unused.is_empty() {
            let verb = if unused.len() == 1 { "has" } else { "have" };
            errln!("{}: {} {verb} no effect on unorganized clouds", input.display(), unused.join(", "));
        }
    }

    /// Prints the session's events.
    pub(super) fn report_events(&mut self, output: &Path) {
        for event in self.session.take_events() {
            match event {
                SessionEvent::SensorEstimated { .. } => {}
                SessionEvent::SensorRecognized { .. } => {
                    errln!("{}: {event} (change with --sensor, --strength or --neighbours)", output.display());
                }
                SessionEvent::NeighboursChosen(choice) => self.report_choice(output, &choice),
                SessionEvent::GridRebuilt { .. } => {
                    errln!("{}: {event} (leave it unorganized with --grid off)", output.display());
                }
                _ => errln!("{}: {event}", output.display()),
            }
        }
    }

    pub(super) fn report_choice(&self, output: &Path, choice: &CloudChoice) {
        // The noise is converted from the cloud's unit to metres, since it is printed in millimetres.
        let mut choice = *choice;
        choice.noise_m = choice.noise_m.map(|noise| noise * self.unit.metres as f32);
        errln!("{}: {choice} (change with --strength, --sensor, --neighbours or --edges)", output.display());
    }
}
