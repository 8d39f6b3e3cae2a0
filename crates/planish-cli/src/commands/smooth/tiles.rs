//! Smoothing of files larger than memory.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use anyhow::Result;
use planish::tiles::{self, TileOptions};
use planish::{CloudChoice, CloudRadius, Progress};
use planish_bench::errln;

use super::super::checks::refuse_unit;
use super::super::checks::report_notes;
use super::super::ms_since;
use super::memory::NeedsMemory;
use super::progress::with_progress;
use super::report::{Report, StatusCounts, report_assumed_sensor, summarize};
use super::{LOST_SHARE_TOLD, Worker};

impl Worker<'_> {
    /// Smooths a LAS, LAZ or PLY file in tiles if it exceeds the memory limit; otherwise returns `None`.
    pub(super) fn smooth_in_tiles(&mut self, input: &Path, output: &Path) -> Result<Option<Report>> {
        let allowed = self.read_options().max_memory_bytes;
        if !tiles::are_tiled(input, output) || tiles::bytes_in_memory(input).is_none_or(|needed| needed <= allowed) {
            return Ok(None);
        }
        refuse_unit(&self.args.reading, input)?;
        if self.beside > 1 {
            return Err(NeedsMemory(format!(
                "{}: too large for one of several workers; smoothed alone",
                input.display()
            ))
            .into());
        }
        self.general_params(input)?;
        self.report_unused_by_clouds(input);
        errln!("{}: larger than --max-memory; smoothed in tiles", input.display());
        let smoother = self.settings.options().with_outputs(self.outputs().with_status(true));
        if self.args.repeat > 1 {
            errln!("{}: --repeat has no effect on a file smoothed in tiles", input.display());
        }
        let options = TileOptions::new(self.settings.clone(), smoother, allowed)
            .with_fields(self.outputs())
            .with_pose(self.pose)
            .with_encoding(self.args.encoding.encoding());
        let progress = Arc::new(Progress::default());
        let start = Instant::now();
        let report =
            with_progress(Some(Arc::clone(&progress)), || tiles::smooth_tiles(input, output, &options, &progress))?;
        report_notes(input, &report.notes);
        let choice = CloudChoice::of(&report.params, 1, report.cloud_estimate);
        let choice = choice.filter(|_| self.settings.chooses_neighbours());
        if let Some(choice) = &choice {
            self.report_choice(output, choice);
        }
        if self.outputs().normals && self.pose.is_none() && !report.has_pose {
            report_assumed_sensor(input, report.assumed_sensor_m);
        }
        if report.reaching_beyond > 0 {
            errln!(
                "{}: {} of {} points are so isolated that their neighbours are outside their tile; with more memory \
                 their results may differ slightly",
                output.display(),
                report.reaching_beyond,
                report.points
            );
        }
        let status = StatusCounts::of(report.status_counts);
        let cause = match report.params.radius {
            CloudRadius::Neighbours { .. } | CloudRadius::Sensor { .. } => {
                "they are far from denser parts of the cloud, or are floating pixels"
            }
            _ => "the radius is below the spacing of the points",
        };
        for (count, became) in [(status.too_few, "became holes"), (status.isolated, "were left unchanged")] {
            if count as f64 > LOST_SHARE_TOLD * report.points as f64 {
                errln!(
                    "{}: {count} of {} points {became}: they have too few neighbours. Probably {cause}",
                    output.display(),
                    report.points
                );
            }
        }
        Ok(Some(Report {
            input: input.to_path_buf(),
            output: output.to_path_buf(),
            engine: report.engine.name(),
            adapter: None,
            engine_reason: None,
            width: report.points,
            height: 1,
            points_in: report.points,
            points_lost: status.too_few,
            status,
            tiles: Some(report.tiles),
            cloud: choice,
            rebuilt_grid: None,
            read_ms: 0.0,
            smooth_ms: summarize(vec![ms_since(start)]),
            write_ms: 0.0,
        }))
    }
}
