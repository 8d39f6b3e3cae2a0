//! Points as lines of numbers: XYZ, TXT, ASC, PTS and CSV, whose columns are named by a line above them or guessed.

use std::fmt::Write;

use super::columns::{cloud_from_columns, columns_from_cloud, with_values};
use super::{CloudRef, FormatResult, ReadOptions, quoted};
use crate::cloud::{Attribute, AttributeValues, PointCloud};
use crate::error::FormatError;

/// Coordinates beyond this lose digits as f32.
const FAR_M: f64 = 1000.0;
/// A unit normal of a few digits is so long.
const UNIT: std::ops::RangeInclusive<f64> = 0.98..=1.02;
/// Digits behind the point of far coordinates: a hundredth of a millimetre.
const FAR_DIGITS: usize = 5;

fn is_separator(character: char) -> bool {
    character.is_whitespace() || character == ',' || character == ';'
}

fn words(line: &str) -> impl Iterator<Item = &str> {
    line.split(is_separator).map(|word| word.trim_matches('"')).filter(|word| !word.is_empty())
}

pub(super) fn decode(bytes: &[u8], options: &ReadOptions) -> FormatResult<PointCloud> {
    let text = std::str::from_utf8(bytes).map_err(|_| FormatError::Malformed("not text in UTF-8".into()))?;
    let mut lines = (1..).zip(text.lines()).filter(|(_, line)| words(line).next().is_some()).peekable();
    let mut names: Option<Vec<String>> = None;
    // Comments, names, and the number of points with which PTS begins.
    while let Some(&(_, line)) = lines.peek() {
        let is_comment = line.starts_with(['#', '/', '%']);
        let is_header = words(line).any(|word| word.parse::<f64>().is_err());
        let line = line.trim_start_matches(['#', '/', '%']);
        if is_comment || is_header {
            let found: Vec<String> = words(line).map(name_of).collect();
            if ["x", "y", "z"].iter().all(|axis| found.iter().any(|name| name == axis)) {
                names = Some(found);
            } else if !is_comment {
                return Err(FormatError::Malformed(format!(
                    "its first line, {}, is neither numbers nor names of columns with x, y and z",
                    quoted(line)
                )));
            }
        } else if words(line).count() > 1 {
            break;
        }
        lines.next();
    }
    let count = lines.peek().map_or(0, |(_, line)| words(line).count());
    if count < 3 {
        return Err(FormatError::Malformed("no line of three numbers or more: x, y and z".into()));
    }
    if names.as_ref().is_some_and(|names| names.len() != count) {
        names = None;
    }
    options.check(bytes.len() / (2 * count) + 1, 8 * count)?;
    let mut columns: Vec<Vec<f64>> = vec![Vec::new(); count];
    for (number, line) in lines.filter(|(_, line)| !line.starts_with(['#', '/', '%'])) {
        let mut found = 0;
        for word in words(line) {
            let value: f64 = word
                .parse()
                .map_err(|_| FormatError::Malformed(format!("line {number}: {} is no number", quoted(word))))?;
            if let Some(column) = columns.get_mut(found) {
                column.push(value);
            }
            found += 1;
        }
        if found != count {
            return Err(FormatError::Malformed(format!(
                "line {number} has {found} numbers where the first has {count}"
            )));
        }
    }
    let names = names.unwrap_or_else(|| guessed_names(&columns));
    let is_far = (0..count)
        .filter(|&i| ["x", "y", "z"].contains(&names[i].as_str()))
        .any(|i| columns[i].iter().any(|value| value.is_finite() && value.abs() > FAR_M));
    let attributes = names.into_iter().zip(columns).map(|(name, values)| {
        let is_position = ["x", "y", "z"].contains(&name.as_str());
        let is_colour = ["red", "green", "blue"].contains(&name.as_str()) && values.iter().all(|value| is_byte(*value));
        let values: AttributeValues = if is_colour {
            values.iter().map(|&value| value as u8).collect::<Vec<u8>>().into()
        } else if is_position && is_far
            || values.iter().any(|&value| f64::from(value as f32) != value && !is_position && !value.is_nan())
        {
            values.into()
        } else {
            values.iter().map(|&value| value as f32).collect::<Vec<f32>>().into()
        };
        Attribute { name, count: 1, values }
    });
    cloud_from_columns(attributes.collect())
}

/// The name of a column as other formats have it.
fn name_of(word: &str) -> String {
    let name = word.to_ascii_lowercase();
    match name.as_str() {
        "r" => "red".into(),
        "g" => "green".into(),
        "b" => "blue".into(),
        "nx" => "normal_x".into(),
        "ny" => "normal_y".into(),
        "nz" => "normal_z".into(),
        _ => name,
    }
}

fn is_byte(value: f64) -> bool {
    (0.0..=255.0).contains(&value) && value.fract() == 0.0
}

/// What the columns are likely to be, by their number and values.
fn guessed_names(columns: &[Vec<f64>]) -> Vec<String> {
    let colours = |from: usize| columns[from..from + 3].iter().flatten().all(|&value| is_byte(value));
    let normals = |from: usize| {
        let [x, y, z] = [&columns[from], &columns[from + 1], &columns[from + 2]];
        x.iter().zip(y).zip(z).all(|((x, y), z)| UNIT.contains(&(x * x + y * y + z * z).sqrt()))
    };
    let (colour, normal) = (["red", "green", "blue"], ["normal_x", "normal_y", "normal_z"]);
    let mut names = vec!["x", "y", "z"];
    while names.len() < columns.len() {
        let at = names.len();
        let left = columns.len() - at;
        if left >= 3 && !names.contains(&"red") && colours(at) {
            names.extend(colour);
        } else if left >= 3 && !names.contains(&"normal_x") && normals(at) {
            names.extend(normal);
        } else if !names.contains(&"intensity") && (left == 1 || left == 4 || left == 7) {
            names.push("intensity");
        } else {
            break;
        }
    }
    let named = names.iter().map(|name| (*name).to_owned());
    named.chain((names.len() + 1..=columns.len()).map(|number| format!("column_{number}"))).collect()
}

/// One line a point; with a line of names if `separator` is a comma.
pub(super) fn encode(cloud: CloudRef<'_>, separator: char) -> FormatResult<Vec<u8>> {
    let points = cloud.points();
    let columns = columns_from_cloud(points);
    let mut names = Vec::new();
    for Attribute { name, count, .. } in &columns {
        names.extend((0..*count).map(|i| if *count == 1 { name.clone() } else { format!("{name}_{i}") }));
    }
    let mut text = String::new();
    if separator == ',' {
        text.push_str(&names.join(","));
        text.push('\n');
    }
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
                    AttributeValues::F64(values) if ["x", "y", "z"].contains(&name.as_str()) => {
                        write!(text, "{:.FAR_DIGITS$}", values[at])
                    }
                    values => with_values!(values, values => write!(text, "{}", values[at])),
                };
            }
        }
        text.push('\n');
    }
    Ok(text.into_bytes())
}
