//! Writes points as lines of numbers.

use std::fmt::Write;

use super::super::columns::{columns_from_cloud, with_values};
use super::super::{CloudRef, FormatResult};
use planish_core::{Attribute, AttributeValues};

/// Number of decimals for coordinates far from the origin, which resolves 0.01 mm.
const FAR_DIGITS: usize = 5;
/// Number of decimals to which an unmoved point's coordinates are rounded, if this removes only rounding noise.
const UNMOVED_DIGITS: usize = 9;

/// Writes a coordinate far from the origin. Coordinates of unmoved points keep all digits except f64 rounding noise,
/// such as the noise from multiplying an integer of a LAS file by its scale.
fn write_far(text: &mut String, value: f64, is_unmoved: bool) -> std::fmt::Result {
    if !is_unmoved {
        return write!(text, "{value:.FAR_DIGITS$}");
    }
    let short = format!("{value:.UNMOVED_DIGITS$}");
    let is_rounding = short.parse().is_ok_and(|short: f64| (short - value).abs() <= f64::EPSILON * value.abs());
    let digits = short.trim_end_matches('0').trim_end_matches('.');
    if is_rounding { text.write_str(digits) } else { write!(text, "{value}") }
}

/// Returns the axis index of a coordinate column: 0, 1 or 2.
fn axis_of(name: &str) -> Option<usize> {
    ["x", "y", "z"].iter().position(|axis| *axis == name)
}

/// The heading before the points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Heading {
    /// The column names in a comment, if there are more columns than x, y and z.
    Comment,
    /// The number of points, as in PTS.
    Count,
    /// The column names; commas separate the cells of all lines.
    Names,
}

/// Returns the names as unique words without separators, so that no reader splits them.
fn plain_names(names: &[String]) -> Vec<String> {
    let is_part = |c: char| !(c.is_whitespace() || c.is_control() || ",;\"'#".contains(c));
    let mut plain: Vec<String> = Vec::with_capacity(names.len());
    for name in names {
        let words = name.split(|c| !is_part(c)).filter(|word| !word.is_empty()).collect::<Vec<_>>().join("_");
        let base = if words.is_empty() { "field" } else { &words };
        let numbered = (2..).map(|number| format!("{base}_{number}"));
        let unused = std::iter::once(base.to_owned()).chain(numbered).find(|word| !plain.contains(word));
        plain.extend(unused);
    }
    plain
}

/// Encodes a cloud with one line per point.
pub(crate) fn encode(cloud: CloudRef<'_>, heading: Heading) -> FormatResult<Vec<u8>> {
    let separator = if heading == Heading::Names { ',' } else { ' ' };
    let points = cloud.points();
    let columns = columns_from_cloud(points);
    let mut names = Vec::new();
    for Attribute { name, count, .. } in &columns {
        names.extend((0..*count).map(|i| if *count == 1 { name.clone() } else { format!("{name}_{i}") }));
    }
    let names = plain_names(&names);
    let mut text = String::new();
    // Writing to a string does not fail.
    let _ = match heading {
        Heading::Names => writeln!(text, "{}", names.join(",")),
        Heading::Count => writeln!(text, "{}", points.len()),
        Heading::Comment if columns.len() > 3 => writeln!(text, "# {}", names.join(" ")),
        Heading::Comment => Ok(()),
    };
    let is_far = points.origin_m != [0.0; 3];
    for i in 0..points.len() {
        let mut is_first = true;
        for Attribute { name, count, values } in &columns {
            for k in 0..*count {
                if !std::mem::take(&mut is_first) {
                    text.push(separator);
                }
                let at = i * count + k;
                // Writing to a string does not fail.
                let _ = match values {
                    AttributeValues::F64(values) if is_far && axis_of(name).is_some() => {
                        let is_unmoved = axis_of(name).is_some_and(|axis| points.is_unmoved(axis, i));
                        write_far(&mut text, values[at], is_unmoved)
                    }
                    values => with_values!(values, values => write!(text, "{}", values[at])),
                };
            }
        }
        text.push('\n');
    }
    Ok(text.into_bytes())
}
