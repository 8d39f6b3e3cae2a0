//! Parses YAML from untrusted files.

use serde::de::DeserializeOwned;

/// Maximum nesting depth. The parser's time grows with the square of the depth.
const DEEPEST: usize = 64;

/// Parses YAML. Deep nesting is an error. The error states what is wrong and, for syntax errors, where.
pub fn parse_yaml<T: DeserializeOwned>(text: &str) -> Result<T, String> {
    if nesting(text) > DEEPEST {
        return Err(format!("lists or objects are nested more than {DEEPEST} deep"));
    }
    serde_yaml_ng::from_str(text).map_err(|error| error.to_string())
}

/// Returns an upper bound for the nesting depth: the depth of brackets, plus the largest number of list and key marks
/// at the beginning of a line.
fn nesting(text: &str) -> usize {
    let (mut depth, mut deepest) = (0usize, 0);
    // Brackets in comments may be unbalanced, as in "[0, 1)".
    let without_comment = |line: &'_ str| line.split(" #").next().map_or(0, str::len);
    let lines = text.lines().filter(|line| !line.trim_start().starts_with('#'));
    for c in lines.flat_map(|line| line[..without_comment(line)].chars()) {
        match c {
            '[' | '{' => depth += 1,
            ']' | '}' => depth = depth.saturating_sub(1),
            _ => continue,
        }
        deepest = deepest.max(depth);
    }
    let marks = |line: &str| {
        let words = line.split(' ').take_while(|word| matches!(*word, "" | "-" | "?"));
        words.filter(|word| !word.is_empty()).count()
    };
    deepest + text.lines().map(marks).max().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::Value;

    #[test]
    fn deep_nesting_is_refused_and_usual_nesting_is_not() {
        for text in ["a: ".to_owned() + &"{a: ".repeat(100_000), "[".repeat(1000), "- ".repeat(1000), "? ".repeat(1000)]
        {
            let error = parse_yaml::<Value>(&text).unwrap_err();
            assert!(error.contains("more than 64 deep"), "{error}");
        }
        let value: Value = parse_yaml("cameras:\n  - - [1, [2, {a: 3}]]\n    - 4\n").unwrap();
        assert_eq!(value["cameras"][0][0][1][1]["a"], 3);
        let comments = "# range [0, 1)\n".repeat(100) + "b: 2 # within [0, 3)\n";
        assert_eq!(parse_yaml::<Value>(&comments).unwrap()["b"], 2);
        let indented = format!("a:\n{}- b: 1\n", " ".repeat(200));
        assert_eq!(parse_yaml::<Value>(&indented).unwrap()["a"][0]["b"], 1);
        // Brackets within text need not match.
        assert_eq!(parse_yaml::<Value>("a: ']}]}'\nb: [1]").unwrap()["b"][0], 1);
    }
}
