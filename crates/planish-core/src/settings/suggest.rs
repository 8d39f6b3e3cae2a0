//! Suggestions for misspelt names.

/// Maximum number of edits between a misspelt name and the intended one.
const MAX_EDITS: usize = 2;

/// Returns the name that `given` is most likely meant to be; `None` if no name is close.
pub(super) fn closest<'a>(given: &str, names: &[&'a str]) -> Option<&'a str> {
    let by_distance = names.iter().map(|name| (edits(given, name), *name));
    by_distance.min().filter(|(edits, name)| *edits <= MAX_EDITS && 2 * edits < name.len()).map(|(_, name)| name)
}

/// Returns the Levenshtein distance: the number of letters to insert, remove or replace.
fn edits(a: &str, b: &str) -> usize {
    let mut row: Vec<usize> = (0..=b.chars().count()).collect();
    for (i, x) in a.chars().enumerate() {
        let mut diagonal = std::mem::replace(&mut row[0], i + 1);
        for (j, y) in b.chars().enumerate() {
            let replaced = diagonal + usize::from(x != y);
            diagonal = row[j + 1];
            row[j + 1] = replaced.min(row[j] + 1).min(diagonal + 1);
        }
    }
    row[row.len() - 1]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn misspelt_names_are_recognized_and_others_are_not() {
        let names = ["strength", "stride", "sensor", "edges", "ridge"];
        let cases = [
            ("strenght", "strength"),
            ("Stride", "stride"),
            ("senor", "sensor"),
            ("edge", "edges"),
            ("rigde", "ridge"),
        ];
        for (given, expected) in cases {
            assert_eq!(closest(given, &names), Some(expected), "{given}");
        }
        for given in ["colour", "", "x", "smoothness"] {
            assert_eq!(closest(given, &names), None, "{given}");
        }
        assert_eq!(edits("kitten", "sitting"), 3);
    }
}
