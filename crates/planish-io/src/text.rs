//! Points as text in PCD and PLY files: one line per point, values separated by spaces, `nan` for a missing value.

use std::fmt::{Display, Write};
use std::str::FromStr;

use super::columns::with_values;
use super::quoted;
use planish_core::{Attribute, AttributeValues, FormatError};

/// The non-blank lines of a text body, numbered from 1.
pub(super) struct Body<'a> {
    lines: Lines<'a>,
    bytes: usize,
}

#[derive(Clone)]
struct Lines<'a> {
    rest: &'a str,
    /// Number of lines before the rest.
    before: usize,
}

impl<'a> Iterator for Lines<'a> {
    type Item = (usize, &'a str);

    /// Returns the next non-blank line and its number.
    fn next(&mut self) -> Option<(usize, &'a str)> {
        while !self.rest.is_empty() {
            // Lines are short, so `str::lines` would take a third of the time to read a file.
            let end = self.rest.bytes().position(|byte| byte == b'\n');
            let (line, rest) = end.map_or((self.rest, ""), |end| (&self.rest[..end], &self.rest[end + 1..]));
            self.rest = rest;
            self.before += 1;
            if !line.trim_start().is_empty() {
                return Some((self.before, line));
            }
        }
        None
    }
}

impl<'a> Body<'a> {
    pub(super) fn new(body: &'a [u8]) -> Result<Self, FormatError> {
        let text = std::str::from_utf8(body)
            .map_err(|_| FormatError::Malformed("the header states ascii, but the points are not text".into()))?;
        Ok(Self { lines: Lines { rest: text, before: 0 }, bytes: body.len() })
    }

    /// Returns the next non-blank line and its number.
    pub(super) fn line(&mut self) -> Option<(usize, &'a str)> {
        self.lines.next()
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
            let after = std::mem::replace(&mut self.lines, before.clone());
            truncate(columns, &lengths);
            // librealsense writes the values of one point on several lines.
            if self.read_words(columns, points, values).is_none() {
                self.lines = after;
                return read;
            }
        }
        check_coordinates(before, columns, &lengths)
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
                push(&mut columns.get_mut(*slots.get(words % values)?)?.values, word)?;
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
            push(&mut column.values, word).ok_or_else(|| not_a_value(word, column))?;
        }
    }
    if words.next().is_some() { Err(format!("more than {values} values")) } else { Ok(()) }
}

fn not_a_value(word: &str, column: &Attribute) -> String {
    format!("{} is not a value of field {}", quoted(word), quoted(&column.name))
}

/// Returns an error if a coordinate in these lines, such as 1e39, was too large for its column and became infinite; an
/// infinite coordinate would count as a hole. `lengths` are the lengths of the columns before reading.
fn check_coordinates(lines: Lines<'_>, columns: &[Attribute], lengths: &[usize]) -> Result<(), FormatError> {
    let is_axis = |column: &Attribute| matches!(&*column.name, "x" | "y" | "z" | "X" | "Y" | "Z");
    let has_infinite = |(column, length): (&Attribute, &usize)| match &column.values {
        AttributeValues::F32(values) => values[*length..].iter().any(|value| value.is_infinite()),
        AttributeValues::F64(values) => values[*length..].iter().any(|value| value.is_infinite()),
        _ => false,
    };
    if !crate::HAS_ROOM || !columns.iter().zip(lengths).any(|found| is_axis(found.0) && has_infinite(found)) {
        return Ok(());
    }
    // Check the words of infinite coordinates, because `inf` is a hole and not an error.
    let slots: Vec<(usize, usize)> =
        columns.iter().enumerate().flat_map(|(k, column)| (0..column.count).map(move |at| (k, at))).collect();
    let words = lines.flat_map(|(number, line)| line.split_ascii_whitespace().map(move |word| (number, word)));
    for (i, (number, word)) in words.enumerate() {
        let (k, at) = slots[i % slots.len()];
        let index = lengths[k] + i / slots.len() * columns[k].count + at;
        if index >= columns[k].values.len() {
            break;
        }
        let is_number = word.contains(|c: char| c.is_ascii_digit());
        if is_number && is_axis(&columns[k]) && columns[k].values.get_f64(index).is_infinite() {
            let problem = not_a_value(word, &columns[k]);
            return Err(FormatError::Malformed(format!("line {number} of the points: {problem}")));
        }
    }
    Ok(())
}

/// Parses a word and appends its value; `None` if the word is not of the column's type.
fn push(values: &mut AttributeValues, word: &str) -> Option<()> {
    if push_plain(values, word).is_some() {
        return Some(());
    }
    // Microsoft's C runtime writes NaN as -nan(ind) or 1.#QNAN, and some programs write integers as 255.0.
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
    // Writing to a String cannot fail. PCL reads only "nan" as NaN.
    let mut write = |value: &dyn Display| {
        let _ = write!(text, "{value}");
    };
    match values {
        AttributeValues::F32(values) if values[i].is_nan() => write(&"nan"),
        AttributeValues::F64(values) if values[i].is_nan() => write(&"nan"),
        values => with_values!(values, values => write(&values[i])),
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::panic)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Vec<f32>, String> {
        let column = |name: &str| Attribute { name: name.into(), count: 1, values: Vec::<f32>::new().into() };
        let mut columns = [column("x"), column("y"), column("z"), column("curvature")];
        Body::new(text.as_bytes()).unwrap().read(&mut columns, 2).map_err(|error| error.to_string())?;
        let value = |i: usize| columns.iter().map(move |column| column.values.get_f64(i) as f32);
        Ok((0..2).flat_map(value).collect())
    }

    #[test]
    fn too_large_coordinates_are_errors_and_infinite_ones_holes() {
        for separator in [" ", "\n"] {
            let values = ["1", "-2", "3", "1e39", "inf", "5", "-inf", "8"];
            assert_eq!(
                read(&values.join(separator)).unwrap(),
                [1.0, -2.0, 3.0, f32::INFINITY, f32::INFINITY, 5.0, f32::NEG_INFINITY, 8.0]
            );
        }
        for (text, problem) in [
            ("1 2 3 4\n\n5 6 -1e39 8\n", "line 3 of the points: \"-1e39\" is not a value of field \"z\""),
            ("1\n2\n3\n4\n5\n7e50\n7\n8\n", "line 6 of the points: \"7e50\" is not a value of field \"y\""),
            ("1 2 3 4\r\n5 6 1.2.3 8", "line 2 of the points: \"1.2.3\" is not a value of field \"z\""),
        ] {
            let error = read(text).unwrap_err();
            assert_eq!(error, problem, "{text}");
        }
    }
}
