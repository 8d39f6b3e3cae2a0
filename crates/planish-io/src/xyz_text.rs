//! Points as lines of numbers: XYZ, TXT, ASC, PTS and CSV, whose columns are named by a line above them or guessed.

use std::fmt::Write;

use super::columns::{EXACT_INTEGERS, cloud_from_columns, columns_from_cloud, with_values};
use super::{CloudRef, FormatResult, ReadOptions, brief, quoted};
use planish_core::{Attribute, AttributeValues, FormatError, PointCloud};

/// Coordinates beyond this lose digits as f32.
const FAR_M: f64 = 1000.0;
/// The length of a unit normal written with few digits.
const UNIT: std::ops::RangeInclusive<f64> = 0.98..=1.02;
/// Decimals of coordinates far from the origin: a hundredth of a millimetre.
const FAR_DIGITS: usize = 5;
/// Significant digits for points that have not moved.
const UNMOVED_DIGITS: usize = 9;

/// What begins a comment.
const COMMENTS: [char; 3] = ['#', '/', '%'];
/// More columns than that are named.
const MOST_UNNAMED: usize = 64;

/// Separator of the cells of a line.
#[derive(Debug, Clone, Copy)]
enum Separator {
    /// Each occurrence ends a cell, which may be empty.
    Mark(char),
    /// Any number of spaces.
    Space,
}

impl Separator {
    fn of(line: &str) -> Self {
        [';', ','].into_iter().find(|mark| line.contains(*mark)).map_or(Self::Space, Self::Mark)
    }

    fn cells(self, line: &str) -> Vec<&str> {
        let mut cells: Vec<&str> = match self {
            Self::Space => line.split_whitespace().collect(),
            Self::Mark(mark) => line.split(mark).map(|cell| cell.trim().trim_matches('"').trim()).collect(),
        };
        // A comment may follow the last cell.
        if let Some(end) = cells.iter().position(|cell| is_comment(cell)) {
            cells.truncate(end);
        }
        cells
    }

    /// Returns true if a line ends with a comment.
    fn ends_in_comment(self, line: &str) -> bool {
        match self {
            Self::Space => line.split_whitespace().any(is_comment),
            Self::Mark(mark) => line.split(mark).any(|cell| is_comment(cell.trim())),
        }
    }
}

/// Returns the cells without an empty one after the last separator.
fn without_empty_end(mut cells: Vec<&str>) -> Vec<&str> {
    if cells.last().is_some_and(|last| last.is_empty()) {
        cells.pop();
    }
    cells
}

/// Returns true if a file of no known ending is lines of numbers, by its beginning.
pub(super) fn is_likely(bytes: &[u8]) -> bool {
    const LOOKED_AT: usize = 4096;
    let mut head = &bytes[..bytes.len().min(LOOKED_AT)];
    if bytes.len() > LOOKED_AT {
        let is_end = |byte: &u8| *byte == b'\n';
        // A line that is cut may have any number of cells.
        head = &head[..head.iter().rposition(is_end).unwrap_or(0)];
        // PTS states how many points there are in all.
        let first = head.iter().position(is_end).unwrap_or(0);
        if std::str::from_utf8(&head[..first]).is_ok_and(|line| line.trim().parse::<usize>().is_ok()) {
            head = &head[first..];
        }
    }
    decode(head, &ReadOptions::default(), &mut Vec::new()).is_ok_and(|cloud| !cloud.is_empty())
}

fn is_comment(line: &str) -> bool {
    line.starts_with(COMMENTS)
}

fn number_of(cell: &str) -> Option<f64> {
    if cell.is_empty() { Some(f64::NAN) } else { cell.parse().ok() }
}

pub(super) fn decode(bytes: &[u8], options: &ReadOptions, notes: &mut Vec<String>) -> FormatResult<PointCloud> {
    let text = std::str::from_utf8(bytes).map_err(|_| {
        FormatError::Malformed(
            "not text in UTF-8: it is binary, or in another encoding such as UTF-16 or Latin-1".into(),
        )
    })?;
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let lines = (1..).zip(text.lines().map(str::trim));
    let mut lines = lines.filter(|(_, line)| !line.is_empty()).peekable();
    let mut names: Option<Vec<String>> = None;
    // Comments, names, and the number of points with which PTS begins.
    let mut stated: Option<usize> = None;
    let mut comments = 0;
    while let Some(&(_, line)) = lines.peek() {
        if names.is_some() && !is_comment(line) {
            break;
        }
        let heading = line.trim_start_matches(COMMENTS);
        let cells = Separator::of(heading).cells(heading);
        if is_comment(line) || cells.iter().any(|cell| number_of(cell).is_none()) {
            let found: Vec<String> = without_empty_end(cells).into_iter().map(name_of).collect();
            if ["x", "y", "z"].iter().all(|axis| found.iter().any(|name| name == axis)) {
                names = Some(found);
            } else if is_comment(line) {
                comments += 1;
            } else {
                return Err(FormatError::Malformed(format!(
                    "its first line, {}, is neither numbers nor names of columns with x, y and z",
                    quoted(line)
                )));
            }
        } else if let [count] = cells[..] {
            stated = count.parse().ok();
        } else {
            break;
        }
        lines.next();
    }
    let separator = lines.peek().map_or(Separator::Space, |(_, line)| Separator::of(line));
    let first = lines.peek().map(|(_, line)| {
        let cells = separator.cells(line);
        // An empty last cell may have a name; otherwise each line ends with a separator.
        if names.as_ref().is_some_and(|names| names.len() == cells.len()) {
            cells.len()
        } else {
            without_empty_end(cells).len()
        }
    });
    let count = match (&names, first) {
        (Some(names), Some(first)) if names.len() != first => {
            return Err(FormatError::Malformed(format!(
                "{} names of columns above lines of {first} numbers",
                names.len()
            )));
        }
        (Some(names), _) => names.len(),
        (None, Some(first @ 3..=MOST_UNNAMED)) => first,
        (None, None) if stated == Some(0) => 3,
        (None, Some(first)) if first > MOST_UNNAMED => {
            return Err(FormatError::Malformed(format!(
                "a line of {first} numbers without names: are its line ends missing?"
            )));
        }
        _ => return Err(FormatError::Malformed("no line of three numbers or more: x, y and z".into())),
    };
    options.check(bytes.len() / (2 * count) + 1, 8 * count)?;
    let mut columns: Vec<Vec<f64>> = vec![Vec::new(); count];
    let mut is_rounded = vec![false; count];
    for (number, line) in lines {
        if is_comment(line) {
            comments += 1;
            continue;
        }
        let mut cells = separator.cells(line);
        comments += usize::from(line.contains(COMMENTS) && separator.ends_in_comment(line));
        if cells.len() == count + 1 {
            cells = without_empty_end(cells);
        }
        if cells.len() != count {
            let found = cells.len();
            return Err(FormatError::Malformed(format!("line {number}: {found} values instead of {count}")));
        }
        for ((column, is_rounded), cell) in columns.iter_mut().zip(&mut is_rounded).zip(cells) {
            let hint = if cell.contains(',') { " (decimals need a point)" } else { "" };
            let value = number_of(cell).ok_or_else(|| {
                FormatError::Malformed(format!("line {number}: {} is not a number{hint}", quoted(cell)))
            })?;
            // Numbers with a point or an exponent are rounded by nature.
            *is_rounded |= value.abs() >= EXACT_INTEGERS as f64
                && cell.trim_start_matches(['-', '+']).bytes().all(|byte| byte.is_ascii_digit());
            column.push(value);
        }
    }
    if comments > 0 {
        notes.push(format!("{comments} {} dropped", if comments == 1 { "comment is" } else { "comments are" }));
    }
    if let Some(stated) = stated.filter(|stated| *stated > columns[0].len()) {
        let found = columns[0].len();
        return Err(FormatError::Malformed(format!("truncated: it states {stated} points, but has {found}")));
    }
    if let Some(name) = names
        .iter()
        .flatten()
        .enumerate()
        .find_map(|(i, name)| names.iter().flatten().take(i).any(|other| other == name).then_some(name))
    {
        return Err(FormatError::Malformed(format!("two columns have the name {}", quoted(name))));
    }
    let names = names.unwrap_or_else(|| guessed_names(&columns, stated.is_some()));
    for (name, _) in names.iter().zip(is_rounded).filter(|(_, is_rounded)| *is_rounded) {
        notes.push(format!("the column {} has integers beyond 2^53, which are rounded", brief(name)));
    }
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

/// Converts a column header to the field name of other formats, without its unit.
fn name_of(cell: &str) -> String {
    let name = cell.split(['[', '(']).next().unwrap_or(cell).to_ascii_lowercase();
    let name = name.split_whitespace().collect::<Vec<_>>().join("_");
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

/// Guesses the names of columns from their number and values. In a file that states its number of points, such as PTS,
/// intensity precedes colours.
fn guessed_names(columns: &[Vec<f64>], is_pts: bool) -> Vec<String> {
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
        if is_pts && at == 3 && left >= 4 && colours(4) && !normals(at) {
            names.push("intensity");
            continue;
        }
        // First normals, since those along an axis might be colours too.
        if left >= 3 && !names.contains(&"normal_x") && normals(at) {
            names.extend(normal);
        } else if left >= 3 && !names.contains(&"red") && colours(at) {
            names.extend(colour);
        } else if !names.contains(&"intensity") && (left == 1 || left == 4 || left == 7) {
            names.push("intensity");
        } else {
            break;
        }
    }
    let named = names.iter().map(|name| (*name).to_owned());
    named.chain((names.len() + 1..=columns.len()).map(|number| format!("column_{number}"))).collect()
}

/// Writes a coordinate far from the origin. An unmoved one keeps all digits, except for rounding noise of f64, as in a
/// LAS file's integer times its scale.
fn write_far(text: &mut String, value: f64, is_unmoved: bool) -> std::fmt::Result {
    if !is_unmoved {
        return write!(text, "{value:.FAR_DIGITS$}");
    }
    let short = format!("{value:.UNMOVED_DIGITS$}");
    let is_rounding = short.parse().is_ok_and(|short: f64| (short - value).abs() <= f64::EPSILON * value.abs());
    let digits = short.trim_end_matches('0').trim_end_matches('.');
    if is_rounding { text.write_str(digits) } else { write!(text, "{value}") }
}

/// Returns the axis of a coordinate column.
fn axis_of(name: &str) -> Option<usize> {
    ["x", "y", "z"].iter().position(|axis| *axis == name)
}

/// Lines before the points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Heading {
    /// The names, in a comment, if there is more than x, y and z.
    Comment,
    /// The number of points, as in PTS.
    Count,
    /// The names, with commas between all cells.
    Names,
}

/// One line a point.
pub(super) fn encode(cloud: CloudRef<'_>, heading: Heading) -> FormatResult<Vec<u8>> {
    let separator = if heading == Heading::Names { ',' } else { ' ' };
    let points = cloud.points();
    let columns = columns_from_cloud(points);
    let mut names = Vec::new();
    for Attribute { name, count, .. } in &columns {
        names.extend((0..*count).map(|i| if *count == 1 { name.clone() } else { format!("{name}_{i}") }));
    }
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
