//! Reads the lines before the points: comments, column names, and the number of points.

use std::iter::Peekable;

use super::super::{FormatResult, LengthUnit, quoted};
use super::cells::{Separator, is_comment, number_of, without_empty_end, without_mark};
use super::names::{MOST_NAMED, names_of, unit_of};
use planish_core::FormatError;

/// Maximum number of columns in a file without column names.
const MOST_UNNAMED: usize = 64;

/// The contents of the lines before the points.
#[derive(Default)]
pub(super) struct Title {
    pub(super) names: Option<Vec<String>>,
    /// The number of points that the file states. PTS files begin with it; CloudCompare writes it below the names.
    pub(super) stated: Option<usize>,
    pub(super) comments: usize,
    /// The length unit stated in the names of x, y and z.
    pub(super) unit: Option<LengthUnit>,
    /// True if the names were found in a comment. Such a comment may be prose that only resembles names.
    is_in_comment: bool,
}

impl Title {
    /// Reads the lines before the points.
    pub(super) fn read<'a>(lines: &mut Peekable<impl Iterator<Item = (usize, &'a str)>>) -> FormatResult<Self> {
        let mut title = Self::default();
        while let Some(&(_, line)) = lines.peek() {
            let heading = without_mark(line);
            let cells = without_empty_end(Separator::of(heading).cells(heading));
            let count = if let [count] = cells[..] { count.parse().ok() } else { None };
            if line.starts_with("sep=") {
                // Excel states the separator here; it is detected from the lines instead.
            } else if count.is_some() && !is_comment(line) {
                title.stated = count;
            } else if title.names.is_some() && !is_comment(line) {
                break;
            } else if let Some(names) = names_of(&cells) {
                if !is_comment(line) {
                    check_names(&names)?;
                }
                title.unit = unit_of(&cells, &names)?;
                (title.names, title.is_in_comment) = (Some(names), is_comment(line));
            } else if is_comment(line) {
                title.comments += 1;
            } else if cells.iter().take(3).all(|cell| number_of(cell).is_some()) {
                break;
            } else if cells.len() > MOST_NAMED {
                let count = cells.len();
                return Err(FormatError::Unsupported(format!(
                    "the file has {count} named columns; at most {MOST_NAMED} are supported"
                )));
            } else {
                return Err(FormatError::Malformed(format!(
                    "the first line, {}, has neither numbers nor column names with x, y and z",
                    quoted(line)
                )));
            }
            lines.next();
        }
        Ok(title)
    }

    /// Returns the number of columns, determined from the first line of points. If names in a comment do not fit this
    /// line, they are dropped.
    pub(super) fn columns(&mut self, first: Option<&str>, separator: Separator) -> FormatResult<usize> {
        let first = first.map(|line| {
            let cells = separator.cells(line);
            // An empty last cell counts if it has a name; otherwise, the line just ends with a separator.
            let is_named = self.names.as_ref().is_some_and(|names| names.len() == cells.len());
            if is_named { cells.len() } else { without_empty_end(cells).len() }
        });
        let fits = |names: &Vec<String>| first.is_none_or(|first| first == names.len()) && check_names(names).is_ok();
        if self.is_in_comment && !self.names.as_ref().is_some_and(fits) {
            (self.names, self.unit) = (None, None);
            self.comments += 1;
        }
        match (&self.names, first) {
            (Some(names), Some(first)) if names.len() != first => Err(FormatError::Malformed(format!(
                "the file has {} column names, but {first} numbers per line",
                names.len()
            ))),
            (Some(names), _) => Ok(names.len()),
            (None, Some(first @ 3..=MOST_UNNAMED)) => Ok(first),
            (None, None) if self.stated == Some(0) => Ok(3),
            (None, Some(first)) if first > MOST_UNNAMED => Err(FormatError::Malformed(format!(
                "the first line has {first} numbers but no column names; the file may lack line ends"
            ))),
            _ => Err(FormatError::Malformed("no line has three or more numbers; expected x, y and z".into())),
        }
    }

    /// Returns true if the column is x, y or z.
    pub(super) fn is_axis(&self, column: usize) -> bool {
        self.names.as_ref().map_or(column < 3, |names| super::is_axis(&names[column]))
    }
}

/// Returns an error if names are not unique.
fn check_names(names: &[String]) -> FormatResult<()> {
    let is_repeated = |(k, name): &(usize, &String)| names[..*k].contains(name);
    match names.iter().enumerate().find(is_repeated) {
        Some((_, name)) => Err(FormatError::Malformed(format!("two columns have the name {}", quoted(name)))),
        None => Ok(()),
    }
}
