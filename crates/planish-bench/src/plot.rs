//! Plots of measurements, and linear fits.

use anyhow::{Result, bail};
use plotters::coord::Shift;
use plotters::coord::ranged1d::{AsRangedCoord, ValueFormatter};
use plotters::prelude::{
    BLACK, ChartBuilder, Circle, Color, DrawingArea, IntoDrawingArea, IntoLogRange, LineSeries, PathElement, RGBColor,
    Ranged, Rectangle, SVGBackend, Text, WHITE,
};

const COLOURS: [RGBColor; 8] = [
    RGBColor(20, 90, 180),
    RGBColor(200, 80, 30),
    RGBColor(40, 140, 60),
    RGBColor(130, 60, 160),
    RGBColor(90, 90, 90),
    RGBColor(190, 150, 20),
    RGBColor(20, 150, 160),
    RGBColor(180, 40, 90),
];
const WIDTH_PX: u32 = 900;
/// Height of each line's name below the plot, in pixels.
const NAME_PX: u32 = 20;
/// Height of a bar with its margin, in pixels.
const BAR_PX: u32 = 22;
/// Width of the column with the names of bars, in pixels.
const BAR_NAMES_PX: u32 = 380;

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// Returns an SVG line plot. Both axes start at 0, each point has a mark, and the names of the lines are below the
/// plot.
pub fn lines(title: &str, x: &str, y: &str, lines: &[(String, Vec<(f64, f64)>)]) -> Result<String> {
    const PLOT_PX: u32 = 420;
    let largest = |of: fn(&(f64, f64)) -> f64| lines.iter().flat_map(|(_, points)| points).map(of).fold(0.0, f64::max);
    let (right, high) = (largest(|point| point.0), largest(|point| point.1));
    if !(right > 0.0 && high > 0.0) {
        bail!("{title}: nothing to plot");
    }
    let mut svg = String::new();
    {
        let height = PLOT_PX + NAME_PX * lines.len() as u32 + 10;
        let area = SVGBackend::with_string(&mut svg, (WIDTH_PX, height)).into_drawing_area();
        area.fill(&WHITE)?;
        let (plot, names) = area.split_vertically(PLOT_PX);
        let mut chart = ChartBuilder::on(&plot)
            .margin(12)
            .caption(title, ("sans-serif", 18))
            .x_label_area_size(38)
            .y_label_area_size(60)
            .build_cartesian_2d(0.0..1.03 * right, 0.0..1.08 * high)?;
        chart.configure_mesh().max_light_lines(1).x_desc(x).y_desc(y).draw()?;
        for (i, ((name, points), colour)) in lines.iter().zip(COLOURS.iter().cycle()).enumerate() {
            chart.draw_series(LineSeries::new(points.iter().copied(), colour.stroke_width(2)))?;
            chart.draw_series(points.iter().map(|&point| Circle::new(point, 3, colour.filled())))?;
            let top = (NAME_PX * i as u32) as i32;
            names.draw(&Rectangle::new([(72, top + 6), (90, top + 10)], colour.filled()))?;
            names.draw(&Text::new(name.clone(), (98, top), ("sans-serif", 13)))?;
        }
        area.present()?;
    }
    Ok(svg)
}

/// The scale of a bar chart's axis.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    FromZero,
    /// Logarithmic axis.
    Logarithmic,
}

/// Returns an SVG bar chart with one bar per entry of `rows`, labelled with its value. `marks` are the positions of
/// vertical lines across all bars.
pub fn bars(title: &str, x: &str, scale: Scale, rows: &[(String, f64)], marks: &[f64]) -> Result<String> {
    let values = || rows.iter().map(|row| row.1).chain(marks.iter().copied());
    let (low, high) = values().fold((f64::INFINITY, 0.0), |(low, high), value| (value.min(low), value.max(high)));
    if !(high > 0.0 && high.is_finite()) {
        bail!("{title}: nothing to plot");
    }
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (WIDTH_PX, BAR_PX * rows.len() as u32 + 110)).into_drawing_area();
        area.fill(&WHITE)?;
        match scale {
            Scale::FromZero => draw_bars(&area, title, x, 0.0..1.15 * high, 0.0, rows, marks)?,
            Scale::Logarithmic => {
                let left = 0.5 * low.max(1e-6 * high);
                draw_bars(&area, title, x, (left..4.0 * high).log_scale(), left, rows, marks)?;
            }
        }
        area.present()?;
    }
    Ok(svg)
}

fn draw_bars<X>(
    area: &Area<'_>,
    title: &str,
    x: &str,
    across: X,
    left: f64,
    rows: &[(String, f64)],
    marks: &[f64],
) -> Result<()>
where
    X: AsRangedCoord<Value = f64>,
    X::CoordDescType: Ranged<ValueType = f64> + ValueFormatter<f64>,
{
    let bottom = rows.len() as f64;
    let mut chart = ChartBuilder::on(area)
        .margin(12)
        .caption(title, ("sans-serif", 18))
        .x_label_area_size(38)
        .y_label_area_size(BAR_NAMES_PX)
        .build_cartesian_2d(across, bottom..0.0)?;
    chart.configure_mesh().disable_y_mesh().disable_y_axis().max_light_lines(1).x_desc(x).draw()?;
    let small = ("sans-serif", 13);
    for (i, (name, value)) in rows.iter().enumerate() {
        let (top, below) = (i as f64 + 0.15, i as f64 + 0.85);
        chart.draw_series([Rectangle::new([(left, top), (value.max(left), below)], COLOURS[0].filled())])?;
        let (_, name_y) = chart.backend_coord(&(left, top));
        area.draw(&Text::new(name.clone(), (14, name_y), small))?;
        let (end_x, end_y) = chart.backend_coord(&(value.max(left), top));
        area.draw(&Text::new(short(*value), (end_x + 6, end_y), small))?;
    }
    for &mark in marks {
        chart.draw_series([PathElement::new(vec![(mark, 0.0), (mark, bottom)], COLOURS[1].stroke_width(2))])?;
    }
    // The axis is drawn last, over the ends of the bars.
    chart.draw_series([PathElement::new(vec![(left, 0.0), (left, bottom)], BLACK)])?;
    Ok(())
}

/// Formats a value for a plot, with about three digits.
fn short(value: f64) -> String {
    let digits = match value {
        _ if value < 1.0 => 3,
        _ if value < 10.0 => 2,
        _ => usize::from(value < 100.0),
    };
    format!("{value:.digits$}")
}

/// Returns the straight line through points by least squares: intercept, slope, and the share of the variance that it
/// explains (R²).
pub fn line_through(points: &[(f64, f64)]) -> (f64, f64, f64) {
    let n = points.len() as f64;
    let (mean_x, mean_y) = (points.iter().map(|p| p.0).sum::<f64>() / n, points.iter().map(|p| p.1).sum::<f64>() / n);
    let sum = |f: &dyn Fn(f64, f64) -> f64| points.iter().map(|p| f(p.0 - mean_x, p.1 - mean_y)).sum::<f64>();
    let (xx, xy, yy) = (sum(&|x, _| x * x), sum(&|x, y| x * y), sum(&|_, y| y * y));
    let slope = xy / xx;
    (mean_y - slope * mean_x, slope, xy * xy / (xx * yy))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plots_have_every_name_and_refuse_what_has_no_value() {
        let rows = vec![("slow".to_owned(), 1.0), ("fast".to_owned(), 2000.0)];
        for scale in [Scale::FromZero, Scale::Logarithmic] {
            let svg = bars("Times", "times", scale, &rows, &[30.0]).unwrap();
            for text in ["Times", "slow", "fast", "2000", "</svg>"] {
                assert!(svg.contains(text), "{text}");
            }
            assert!(bars("Times", "times", scale, &[], &[]).is_err());
        }
        let svg = lines("Times", "candidates", "ms", &[("one".to_owned(), vec![(9.0, 1.0), (25.0, 2.0)])]).unwrap();
        assert!(svg.contains("one") && svg.contains("candidates") && svg.contains("</svg>"));
        assert!(lines("Times", "candidates", "ms", &[("none".to_owned(), Vec::new())]).is_err());
    }

    #[test]
    fn a_line_is_found_and_its_fit_told() {
        let line: Vec<_> = [9.0, 25.0, 49.0, 81.0].map(|x| (x, 2.0 + 0.5 * x)).into();
        let (intercept, slope, fit) = line_through(&line);
        assert!((intercept - 2.0).abs() < 1e-9 && (slope - 0.5).abs() < 1e-12 && (fit - 1.0).abs() < 1e-12);
        let bent: Vec<_> = line.iter().map(|&(x, _)| (x, x * x)).collect();
        assert!(line_through(&bent).2 < 0.99);
    }
}
