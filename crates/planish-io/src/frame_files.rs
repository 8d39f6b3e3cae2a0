//! Lists the frame files of a folder, in order.

use std::path::{Path, PathBuf};

use planish_core::{FormatError, IoError};

use super::format::Format;

/// Lists the frame files in a folder, ordered by the numbers in their names: 2.png before 10.png.
///
/// # Errors
/// If the folder cannot be listed.
pub fn frame_files(folder: &Path) -> Result<Vec<PathBuf>, IoError> {
    let at = |error| IoError { path: folder.to_path_buf(), problem: FormatError::Os(error) };
    let entries = std::fs::read_dir(folder).map_err(at)?;
    let mut files = entries.map(|entry| entry.map(|entry| entry.path())).collect::<Result<Vec<_>, _>>().map_err(at)?;
    files.retain(|path| path.is_file() && Format::is_of_frames(path));
    files.sort_by_cached_key(|path| in_order_of_numbers(path));
    Ok(files)
}

/// Returns a key that sorts file names by the numbers in them. A name that is a decimal number, such as a time, is
/// sorted by its value.
fn in_order_of_numbers(path: &Path) -> Vec<(u128, String)> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let is_digits = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    if let Some((whole, decimals)) = stem.split_once('.').filter(|(a, b)| is_digits(a) && is_digits(b)) {
        return vec![(whole.parse().unwrap_or(u128::MAX), decimals.to_owned())];
    }
    let mut parts = Vec::new();
    let mut rest = &*name;
    while !rest.is_empty() {
        let digits = rest.find(|c: char| !c.is_ascii_digit()).unwrap_or(rest.len());
        let (number, after) = rest.split_at(digits);
        let others = after.find(|c: char| c.is_ascii_digit()).unwrap_or(after.len());
        let (text, after) = after.split_at(others);
        // Numbers too large for u128 compare as equal, and are then ordered by their text.
        parts.push((
            number.parse().unwrap_or(if number.is_empty() { 0 } else { u128::MAX }),
            format!("{text}\0{number}"),
        ));
        rest = after;
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_and_times_are_in_order() {
        let sorted = |names: &[&str]| {
            let mut names: Vec<&Path> = names.iter().map(Path::new).collect();
            names.sort_by_cached_key(|path| in_order_of_numbers(path));
            names.into_iter().map(|name| name.to_string_lossy().into_owned()).collect::<Vec<_>>()
        };
        assert_eq!(sorted(&["f10.png", "f2.png", "f1.png"]), ["f1.png", "f2.png", "f10.png"]);
        assert_eq!(sorted(&["a.10.png", "a.2.png"]), ["a.2.png", "a.10.png"]);
        assert_eq!(
            sorted(&["10.15.png", "10.1.png", "9.5.png", "10.05.png"]),
            ["9.5.png", "10.05.png", "10.1.png", "10.15.png"]
        );
    }
}
