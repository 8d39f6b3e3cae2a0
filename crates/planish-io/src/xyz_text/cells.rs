//! Splits lines into cells, and parses the numbers in them.

/// Characters that begin a comment.
const COMMENTS: [char; 3] = ['#', '/', '%'];
/// Words that mean a missing number, in lower case; `nan` is parsed as a number.
const MISSING: [&str; 6] = ["", "na", "n/a", "null", "none", "-"];

/// The separator between the cells of a line.
#[derive(Debug, Clone, Copy)]
pub(super) enum Separator {
    /// A single character: each occurrence ends a cell, which may be empty.
    Mark(char),
    /// White space of any length.
    Space,
}

impl Separator {
    pub(super) fn of(line: &str) -> Self {
        // A comment at the end of the line may contain other separators.
        let line = line.split(" #").next().unwrap_or_default();
        // Names separated by tabs may contain spaces.
        if line.contains('\t') && line.split('\t').any(|cell| cell.trim().contains(' ')) {
            return Self::Mark('\t');
        }
        let has_decimal_commas = || {
            let words: Vec<&str> = line.split_whitespace().collect();
            words.len() >= 3 && words.iter().all(|word| number_of(word).is_some())
        };
        match (line.contains(';'), line.contains(',')) {
            (true, _) => Self::Mark(';'),
            (false, true) if !has_decimal_commas() => Self::Mark(','),
            _ => Self::Space,
        }
    }

    pub(super) fn cells(self, line: &str) -> Vec<&str> {
        let (mut cells, is_comment): (Vec<&str>, fn(&str) -> bool) = match self {
            Self::Space => (line.split_whitespace().collect(), is_comment),
            Self::Mark(mark) => {
                let mut is_quoted = false;
                let is_end = |c: char| {
                    is_quoted ^= c == '"';
                    c == mark && !is_quoted
                };
                (line.split(is_end).map(|cell| cell.trim().trim_matches('"').trim()).collect(), is_comment_in_cell)
            }
        };
        // A comment may follow the last cell.
        if let Some(end) = cells.iter().position(|cell| is_comment(cell)) {
            cells.truncate(end);
        }
        cells
    }

    /// Returns true if a line ends with a comment.
    pub(super) fn ends_in_comment(self, line: &str) -> bool {
        line.contains(COMMENTS)
            && match self {
                Self::Space => line.split_whitespace().any(is_comment),
                Self::Mark(mark) => line.split(mark).any(|cell| is_comment_in_cell(cell.trim())),
            }
    }
}

/// Removes an empty cell after the last separator.
pub(super) fn without_empty_end(mut cells: Vec<&str>) -> Vec<&str> {
    if cells.last().is_some_and(|last| last.is_empty()) {
        cells.pop();
    }
    cells
}

pub(super) fn is_comment(line: &str) -> bool {
    line.starts_with(COMMENTS)
}

/// Returns true for a cell that is a comment, not a colour such as #ff0000.
fn is_comment_in_cell(cell: &str) -> bool {
    cell == "#" || ["# ", "// ", "% "].iter().any(|mark| cell.starts_with(mark))
}

/// Returns a comment without its mark.
pub(super) fn without_mark(line: &str) -> &str {
    line.trim_start_matches(COMMENTS)
}

/// Returns the number in a cell, which may have a decimal comma; NaN for a word that means a missing number, `None`
/// for other words.
pub(super) fn number_of(cell: &str) -> Option<f64> {
    let with_comma = || {
        let (whole, decimals) = cell.split_once(',')?;
        let are_digits = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
        let has_decimals = decimals.starts_with(|c: char| c.is_ascii_digit());
        if has_decimals && are_digits(whole.trim_start_matches(['-', '+'])) {
            format!("{whole}.{decimals}").parse().ok()
        } else {
            None
        }
    };
    let missing = || MISSING.iter().any(|word| cell.eq_ignore_ascii_case(word)).then_some(f64::NAN);
    cell.parse().ok().or_else(with_comma).or_else(missing)
}
