//! Prints the reports as a table, and plots the error over z.

use std::path::Path;

use anyhow::{Context, Result};
use planish::evaluate::CurveReport;
use planish::io::write_whole;
use planish_bench::{out, outln};
use plotters::prelude::{ChartBuilder, Circle, IntoDrawingArea, LineSeries, RGBColor, SVGBackend, WHITE};
use plotters::series::PointSeries;

use super::Row;

/// Prints the reports of all methods, one column per method.
pub(super) fn print(rows: &[Row]) {
    let line = |name: &str, value: &dyn Fn(&Row) -> String| {
        out!("  {name:<44}");
        for row in rows {
            out!("{:>12}", value(row));
        }
        outln!();
    };
    line("", &|row| row.name.rsplit('/').next().unwrap_or_default().to_owned());
    outln!("flat surfaces");
    for (k, range) in rows[0].report.ranges.iter().enumerate() {
        let span = format!("{:.1} to {:.1} m", range.near_m, range.far_m);
        line(&format!("{span}: distance to the truth, RMS, mm"), &|r| format!("{:.2}", r.report.ranges[k].rmse_mm));
        line("  its mean, depth steps", &|r| format!("{:+.3}", r.report.ranges[k].bias_steps));
        line("  normal, mean error", &|r| format!("{:.1}°", r.report.ranges[k].normal_mean_deg));
        line("  normal, median error", &|r| format!("{:.1}°", r.report.ranges[k].normal_median_deg));
        line("  normals within 10°", &|r| percent(r.report.ranges[k].normal_under_10_deg));
        line("  facets of adjacent pixels, mean error", &|r| format!("{:.1}°", r.report.ranges[k].facet_mean_deg));
        line("  95 % of them within", &|r| format!("{:.1}°", r.report.ranges[k].facet_95_deg));
    }
    for (k, angle) in rows[0].report.angles.iter().enumerate() {
        let span = format!("seen at {:.0} to {:.0}°", angle.from_deg, angle.to_deg);
        line(&format!("{span}: RMS, depth steps"), &|r| format!("{:.2}", r.report.angles[k].rmse_steps));
        line("  normal, mean error", &|r| format!("{:.1}°", r.report.angles[k].normal_mean_deg));
        line("  facets, mean error", &|r| format!("{:.1}°", r.report.angles[k].facet_mean_deg));
    }
    line("facets off by over 30°, 0.5 to 2.5 m", &|r| percent(r.report.speck_share));
    line("second difference of z in a row, over z², 1e-3/m", &|r| format!("{:.3}", r.report.lattice));
    outln!("edges");
    line("within 3 px of a step: distance, mean, mm", &|r| format!("{:.2}", r.report.edge_mean_mm));
    line("  floating between two surfaces", &|r| percent(r.report.flying_share));
    line("90° edge at 1 m: error of its angle", &|r| format!("{:.1}°", r.report.crease_deg));
    line("  normals within 6 px of it, mean error", &|r| format!("{:.1}°", r.report.crease_normal_deg));
    outln!("shapes");
    line("sphere, radius", &|r| format!("{:+.2} %", 100.0 * r.report.sphere_radius_bias));
    line("cylinder, radius", &|r| format!("{:+.2} %", 100.0 * r.report.cylinder_radius_bias));
    outln!("curved surfaces: distance to the truth, RMS; its mean; facets, mean error");
    for curve in &rows[0].report.curves {
        let size = match curve.radius_m {
            radius_m if radius_m.is_finite() => format!(" of {:.1} cm", 100.0 * radius_m),
            _ => String::new(),
        };
        // A method may have lost a surface.
        let same = |r: &Row| {
            let is_same = |other: &&CurveReport| {
                (other.name, other.radius_m, other.range_m) == (curve.name, curve.radius_m, curve.range_m)
            };
            r.report.curves.iter().find(is_same).cloned()
        };
        let value = |r: &Row, of: fn(&CurveReport) -> String| same(r).map_or("-".to_owned(), |curve| of(&curve));
        line(&format!("{}{size} at {:.1} m: RMS, mm", curve.name, curve.range_m), &|r| {
            value(r, |c| format!("{:.2}", c.rmse_mm))
        });
        line("  mean, mm", &|r| value(r, |c| format!("{:+.2}", c.bias_mm)));
        line("  facets", &|r| value(r, |c| format!("{:.1}°", c.facet_mean_deg)));
    }
    outln!("pixels");
    line("measured, but lost", &|r| percent(r.report.lost_share));
    line("  of which on a surface, not floating", &|r| percent(r.report.lost_true_share));
    line("floating pixels, removed of all", &|r| percent(r.report.floating_removed));
    line("  lost pixels that floated", &|r| percent(r.report.removed_floating));
    line("invented: present without a measurement", &|r| r.report.invented.to_string());
    if let Some(calibration) = rows.iter().find_map(|row| row.calibration.as_ref()) {
        outln!("stated standard errors (sigma): points within one, within two");
        for (k, range) in calibration.iter().enumerate() {
            let span = match range.near_m.is_finite() {
                true => format!("{:.1} to {:.1} m", range.near_m, range.far_m),
                false => "within 3 px of a step".to_owned(),
            };
            line(&span, &|row| {
                let of_row = row.calibration.as_ref().map(|calibration| calibration[k]);
                of_row.map_or("-".to_owned(), |of| {
                    format!("{:.0}, {:.0} %", 100.0 * of.within_one, 100.0 * of.within_two)
                })
            });
        }
    }
    let or_dash = |value: Option<f64>, digits: usize| value.map_or("-".to_owned(), |v| format!("{v:.digits$}"));
    line("jitter of a static scene, RMS, mm", &|r| or_dash(r.jitter_mm, 2));
    line("time per frame, ms", &|r| or_dash(r.frame_ms, 1));
}

pub(super) fn percent(share: f64) -> String {
    format!("{:.2} %", 100.0 * share)
}

/// Draws the RMS error over z, one line per method.
pub(super) fn draw_error_over_z(file: &Path, rows: &[Row]) -> Result<()> {
    const COLOURS: [RGBColor; 4] =
        [RGBColor(150, 150, 150), RGBColor(200, 120, 30), RGBColor(20, 90, 180), RGBColor(0, 0, 0)];
    let curves = rows.iter().map(|row| &row.report.over_z);
    let most = curves.flatten().map(|&(_, rmse_mm)| rmse_mm).fold(1.0, f64::max);
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (800, 500)).into_drawing_area();
        area.fill(&WHITE)?;
        let mut chart = ChartBuilder::on(&area)
            .margin(12)
            .caption("Distance to the true surface, RMS", ("sans-serif", 20))
            .x_label_area_size(40)
            .y_label_area_size(55)
            .build_cartesian_2d(0.4..4.4, 0.0..1.05 * most)?;
        chart.configure_mesh().x_desc("z, m").y_desc("mm").draw()?;
        for (row, colour) in rows.iter().zip(COLOURS) {
            let curve = &row.report.over_z;
            chart.draw_series(LineSeries::new(curve.iter().copied(), &colour))?;
            let dots: PointSeries<_, _, Circle<_, _>, _> = PointSeries::new(curve.iter().copied(), 3, colour);
            chart
                .draw_series(dots)?
                .label(row.name.clone())
                .legend(move |at| Circle::new((at.0 + 10, at.1), 4, colour));
        }
        chart.configure_series_labels().border_style(RGBColor(200, 200, 200)).background_style(WHITE).draw()?;
        area.present()?;
    }
    write_whole(file, svg.as_bytes()).with_context(|| file.display().to_string())
}
