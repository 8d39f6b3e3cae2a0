//! Reads and writes points as lines of numbers: XYZ, TXT, ASC, PTS and CSV. Column names come from a line above the
//! points, or are guessed.

mod cells;
mod names;
mod title;
mod write;

use cells::{Separator, is_comment, number_of};
pub(super) use names::guessed_names;
use names::is_byte;
use title::Title;
pub(super) use write::{Heading, encode};

use super::columns::{EXACT_INTEGERS, cloud_from_columns};
use super::{FormatResult, ReadOptions, brief, quoted, text_of};
use planish_core::{Attribute, AttributeValues, FormatError, PointCloud};

/// Coordinate, in metres, above which coordinates are stored as f64, because f32 loses digits.
const FAR_M: f64 = 1000.0;

/// Returns true if the beginning of a file consists of lines of numbers; used if the extension is unknown.
pub(super) fn is_likely(bytes: &[u8]) -> bool {
    const LOOKED_AT: usize = 4096;
    let mut head = &bytes[..bytes.len().min(LOOKED_AT)];
    if bytes.len() > LOOKED_AT {
        let is_end = |byte: &u8| *byte == b'\n';
        // The last line may be incomplete, so it is dropped.
        head = &head[..head.iter().rposition(is_end).unwrap_or(0)];
        // PTS begins with the total number of points, which is more than the beginning contains.
        let first = head.iter().position(is_end).unwrap_or(0);
        if std::str::from_utf8(&head[..first]).is_ok_and(|line| line.trim().parse::<usize>().is_ok()) {
            head = &head[first..];
        }
    }
    decode(head, &ReadOptions::default(), &mut Vec::new()).is_ok_and(|cloud| !cloud.is_empty())
}

/// The values read for a column.
#[derive(Default)]
struct Column {
    values: Vec<f64>,
    /// True if an integer could not be represented exactly.
    is_rounded: bool,
    /// True if the column contains words instead of numbers.
    is_text: bool,
}

impl Column {
    fn push(&mut self, cell: &str, number: usize, is_needed: bool) -> FormatResult<()> {
        if self.is_text {
            return Ok(());
        }
        // A coordinate that is too large must not become a hole.
        let is_too_large =
            |value: &f64| is_needed && value.is_infinite() && cell.contains(|c: char| c.is_ascii_digit());
        let Some(value) = number_of(cell).filter(|value| !is_too_large(value)) else {
            // Only missing values preceded this word, so this is a column of words.
            if self.values.iter().all(|value| value.is_nan()) && !is_needed {
                self.is_text = true;
                return Ok(());
            }
            return Err(FormatError::Malformed(format!("line {number}: {} is not a number", quoted(cell))));
        };
        // Only integers are checked: numbers with a decimal point or an exponent are rounded anyway.
        self.is_rounded |= value.abs() >= EXACT_INTEGERS as f64
            && cell.trim_start_matches(['-', '+']).bytes().all(|byte| byte.is_ascii_digit());
        self.values.push(value);
        Ok(())
    }

    /// Returns the values in the narrowest type that represents them: u8 for colours, otherwise f32 or f64.
    fn typed(self, name: &str, is_far: bool) -> AttributeValues {
        let Self { values, .. } = self;
        let is_colour = is_colour(name) && values.iter().all(|value| is_byte(*value));
        let is_exact = |value: &f64| f64::from(*value as f32) == *value || value.is_nan();
        if is_colour {
            values.iter().map(|&value| value as u8).collect::<Vec<u8>>().into()
        } else if is_axis(name) && is_far || !is_axis(name) && !values.iter().all(is_exact) {
            values.into()
        } else {
            values.iter().map(|&value| value as f32).collect::<Vec<f32>>().into()
        }
    }
}

fn is_axis(name: &str) -> bool {
    ["x", "y", "z"].contains(&name)
}

fn is_colour(name: &str) -> bool {
    ["red", "green", "blue"].contains(&name)
}

pub(super) fn decode(bytes: &[u8], options: &ReadOptions, notes: &mut Vec<String>) -> FormatResult<PointCloud> {
    if bytes.contains(&0) {
        return Err(FormatError::Malformed("the file is binary; expected lines of numbers".into()));
    }
    let text = text_of(bytes);
    // In files from classic Mac OS, lines end with a carriage return only.
    let text = if text.contains('\n') { text } else { text.replace('\r', "\n").into() };
    let lines = (1..).zip(text.lines().map(str::trim));
    let mut lines = lines.filter(|(_, line)| !line.is_empty()).peekable();
    let mut title = Title::read(&mut lines)?;
    let first = lines.peek().map(|(_, line)| *line);
    let separator = first.map_or(Separator::Space, Separator::of);
    let count = title.columns(first, separator)?;
    let line_ends = text.bytes().filter(|byte| *byte == b'\n').count();
    options.check(line_ends + 1, 8 * count + 12)?;
    let mut columns: Vec<Column> = (0..count).map(|_| Column::default()).collect();
    if let Some(first) = first {
        let is_text = |k: usize, cell: &str| !title.is_axis(k) && number_of(cell).is_none();
        let cells = separator.cells(first);
        columns.iter_mut().zip(cells).enumerate().for_each(|(k, (column, cell))| column.is_text = is_text(k, cell));
    }
    let (mut points, mut has_decimal_commas) = (0usize, false);
    for (number, line) in lines {
        if is_comment(line) {
            title.comments += 1;
            continue;
        }
        let cells = separator.cells(line);
        title.comments += usize::from(separator.ends_in_comment(line));
        let found = cells.len();
        if !(found == count || found == count + 1 && cells[count].is_empty()) {
            return Err(FormatError::Malformed(format!("line {number} has {found} values instead of {count}")));
        }
        points += 1;
        has_decimal_commas |= cells.iter().any(|cell| cell.contains(','));
        for (k, (column, cell)) in columns.iter_mut().zip(cells).enumerate() {
            column.push(cell, number, title.is_axis(k))?;
        }
    }
    if has_decimal_commas {
        notes.push("commas are read as decimal points".into());
    }
    let Title { names, stated, comments, unit, .. } = title;
    if comments > 0 {
        notes.push(format!("{comments} {} dropped", if comments == 1 { "comment is" } else { "comments are" }));
    }
    if let Some(stated) = stated.filter(|stated| *stated > points) {
        return Err(FormatError::Malformed(format!(
            "the file is truncated: it states {stated} points, but has {points}"
        )));
    }
    let words: Vec<String> = (0..count)
        .filter(|&k| columns[k].is_text)
        .map(|k| names.as_ref().map_or_else(|| format!("column {}", k + 1), |names| brief(&names[k])))
        .collect();
    if !words.is_empty() {
        notes.push(format!("columns with words instead of numbers are dropped: {}", words.join(", ")));
    }
    let names = names.map(|names| names.into_iter().zip(&columns).filter(|(_, column)| !column.is_text));
    let names: Option<Vec<String>> = names.map(|names| names.map(|(name, _)| name).collect());
    columns.retain(|column| !column.is_text);
    let names = names.unwrap_or_else(|| {
        let values: Vec<&[f64]> = columns.iter().map(|column| &column.values[..]).collect();
        guessed_names(&values, stated.is_some())
    });
    for (name, _) in names.iter().zip(&columns).filter(|(_, column)| column.is_rounded) {
        notes.push(format!("the column {} has integers beyond 2^53, which are rounded", brief(name)));
    }
    if let Some(unit) = unit.filter(|unit| options.unit != Some(*unit)) {
        if options.unit.is_some() {
            return Err(FormatError::Unsupported(format!(
                "the given unit contradicts the unit in the column names, {}; give no unit",
                unit.symbol
            )));
        }
        let axes = names.iter().zip(&mut columns).filter(|(name, _)| is_axis(name));
        axes.for_each(|(_, column)| column.values.iter_mut().for_each(|value| *value *= unit.metres));
        notes.push(format!("the column names state the unit; lengths in {} are converted to metres", unit.symbol));
    }
    let mut axes = names.iter().zip(&columns).filter(|(name, _)| is_axis(name));
    let is_far = axes.any(|(_, column)| column.values.iter().any(|value| value.is_finite() && value.abs() > FAR_M));
    let attributes = names.into_iter().zip(columns).map(|(name, column)| {
        let values = column.typed(&name, is_far);
        Attribute { name, count: 1, values }
    });
    cloud_from_columns(attributes.collect())
}
