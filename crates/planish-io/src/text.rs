//! Points as text in PCD and PLY files: one line per point, values separated by spaces, `nan` for a missing value.

use std::fmt::{Display, Write};
use std::str::{FromStr, Lines};

use super::columns::with_values;
use super::quoted;
use planish_core::{Attribute, AttributeValues, FormatError};

/// The non-blank lines of a text body, numbered from 1.
pub(super) struct Body<'a> {
    lines: std::iter::Enumerate<Lines<'a>>,
    bytes: usize,
}

impl<'a> Body<'a> {
    pub(super) fn new(body: &'a [u8]) -> Result<Self, FormatError> {
        let text = std::str::from_utf8(body)
            .map_err(|_| FormatError::Malformed("the header states ascii, but the points are not text".into()))?;
        Ok(Self { lines: text.lines().enumerate(), bytes: body.len() })
    }

    /// Returns the next non-blank line.
    pub(super) fn line(&mut self) -> Option<(usize, &'a str)> {
        self.lines.find(|(_, line)| !line.trim().is_empty()).map(|(index, line)| (index + 1, line))
    }

    /// Reads `points` points, and appends their values to the columns.
    pub(super) fn read(&mut self, columns: &mut [Attribute], points: usize) -> Result<(), FormatError> {
        let values: usize = columns.iter().map(|column| column.count).sum();
        // The shortest value takes two bytes: a digit and a separator.
        if values.checked_mul(2 * points).is_none_or(|shortest| shortest > self.bytes + 1) {
            return Err(FormatError::Malformed(format!(
                "the file is truncated: its header states {points} points of {values} values, but {} bytes follow",
                self.bytes
            )));
        }
        let (before, lengths) = (self.lines.clone(), lengths(columns));
        let read = self.read_lines(columns, points, values);
        if read.is_err() {
            let after = std::mem::replace(&mut self.lines, before);
            truncate(columns, &lengths);
            // librealsense writes the values of one point on several lines.
            if self.read_words(columns, points, values).is_none() {
                self.lines = after;
                return read;
            }
        }
        Ok(())
    }

    fn read_lines(&mut self, columns: &mut [Attribute], points: usize, values: usize) -> Result<(), FormatError> {
        for point in 0..points {
            let Some((number, line)) = self.line() else {
                return Err(FormatError::Malformed(format!(
                    "the file is truncated: its header states {points} points, but {point} follow"
                )));
            };
            read_line(columns, values, line)
                .map_err(|problem| FormatError::Malformed(format!("line {number} of the points: {problem}")))?;
        }
        Ok(())
    }

    /// Reads points that span several lines each, or that share lines. Returns `None` if a value is missing or
    /// unreadable.
    fn read_words(&mut self, columns: &mut [Attribute], points: usize, values: usize) -> Option<()> {
        let slots: Vec<usize> = columns.iter().enumerate().flat_map(|(k, column)| vec![k; column.count]).collect();
        let mut words = 0;
        while words < points * values {
            let (_, line) = self.line()?;
            let (before, left) = (words, values - words % values);
            for word in line.split_ascii_whitespace() {
                push_to(columns.get_mut(*slots.get(words % values)?)?, word)?;
                words += 1;
            }
            // Either a point spans several lines, or a line has several points. Otherwise, a value is missing or
            // superfluous.
            let found = words - before;
            let is_regular =
                if left == values { found < values || found.is_multiple_of(values) } else { found <= left };
            if !is_regular {
                return None;
            }
        }
        (words == points * values).then_some(())
    }
}

/// Returns the number of values in each column.
fn lengths(columns: &[Attribute]) -> Vec<usize> {
    columns.iter().map(|column| with_values!(&column.values, values => values.len())).collect()
}

fn truncate(columns: &mut [Attribute], lengths: &[usize]) {
    for (column, length) in columns.iter_mut().zip(lengths) {
        with_values!(&mut column.values, values => values.truncate(*length));
    }
}

fn read_line(columns: &mut [Attribute], values: usize, line: &str) -> Result<(), String> {
    let mut words = line.split_ascii_whitespace();
    for column in columns {
        for _ in 0..column.count {
            let word = words.next().ok_or_else(|| format!("fewer than {values} values"))?;
            push_to(column, word)
                .ok_or_else(|| format!("{} is not a value of field {}", quoted(word), quoted(&column.name)))?;
        }
    }
    if words.next().is_some() { Err(format!("more than {values} values")) } else { Ok(()) }
}

/// Appends a value to a column; `None` if the word is not of its type, or if a coordinate such as 1e39 is too large for
/// it and would become a hole.
fn push_to(column: &mut Attribute, word: &str) -> Option<()> {
    push(&mut column.values, word)?;
    let is_infinite = column.values.get_f64(column.values.len() - 1).is_infinite();
    let is_axis = || matches!(&*column.name, "x" | "y" | "z" | "X" | "Y" | "Z");
    (!is_infinite || !word.contains(|c: char| c.is_ascii_digit()) || !is_axis()).then_some(())
}

/// Parses a word and appends its value; `None` if the word is not of the column's type.
fn push(values: &mut AttributeValues, word: &str) -> Option<()> {
    if push_plain(values, word).is_some() {
        return Some(());
    }
    // Microsoft's compiler writes NaN as -nan(ind) or 1.#QNAN, and some programs write integers as 255.0.
    let is_nan = ["nan(", "#QNAN", "#IND"].iter().any(|mark| word.contains(mark));
    match (word.split_once('.'), is_nan) {
        (_, true) => push_plain(values, "nan"),
        (Some((whole, decimals)), _) if decimals.bytes().all(|byte| byte == b'0') => push_plain(values, whole),
        _ => None,
    }
}

fn push_plain(values: &mut AttributeValues, word: &str) -> Option<()> {
    fn parsed<T: FromStr>(values: &mut Vec<T>, word: &str) -> Option<()> {
        values.push(word.parse().ok()?);
        Some(())
    }
    with_values!(values, values => parsed(values, word))
}

/// Writes one line per point. Every float is written as the shortest text that parses to the same bits.
pub(super) fn write(columns: &[Attribute], points: usize, bytes: &mut Vec<u8>) {
    let mut text = String::new();
    for point in 0..points {
        let mut separator = "";
        for column in columns {
            for value in 0..column.count {
                text.push_str(separator);
                separator = " ";
                write_value(&mut text, &column.values, point * column.count + value);
            }
        }
        text.push('\n');
    }
    bytes.extend_from_slice(text.as_bytes());
}

fn write_value(text: &mut String, values: &AttributeValues, i: usize) {
    // Writing to a String cannot fail. PCL reads NaN as "nan" only.
    let mut write = |value: &dyn Display| {
        let _ = write!(text, "{value}");
    };
    match values {
        AttributeValues::F32(values) if values[i].is_nan() => write(&"nan"),
        AttributeValues::F64(values) if values[i].is_nan() => write(&"nan"),
        values => with_values!(values, values => write(&values[i])),
    }
}
