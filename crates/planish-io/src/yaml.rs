//! Parses YAML from untrusted files.

use serde::de::DeserializeOwned;

/// Maximum number of opening brackets, and of list and key marks at the beginning of a line. They bound the nesting
/// depth. The parser's time grows with the square of the depth; a depth of 10,000 takes half a second. Closing brackets
/// are not subtracted, because they may be quoted.
const MOST_MARKS: usize = 10_000;

/// Parses YAML. Deep nesting is an error. The error states what is wrong and, for syntax errors, where.
pub fn parse_yaml<T: DeserializeOwned>(text: &str) -> Result<T, String> {
    let marks = |line: &str| line.split(' ').take_while(|word| matches!(*word, "" | "-" | "?")).count();
    let marks = text.lines().map(marks).max().unwrap_or(0);
    if text.matches(['[', '{']).count().max(marks) > MOST_MARKS {
        return Err("too many brackets or nested lists".to_owned());
    }
    serde_yaml_ng::from_str(text).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::Value;

    #[test]
    fn deep_nesting_is_refused_and_usual_nesting_is_not() {
        // Quoted brackets close nothing, and the second text looks like a comment.
        let quoted = "{a: ']', b: ".repeat(20_000);
        let commented = "' # ': ".to_owned() + &"{a: ".repeat(20_000);
        for text in [quoted, commented, "[".repeat(20_000), "- ".repeat(20_000), "? ".repeat(20_000)] {
            let error = parse_yaml::<Value>(&text).unwrap_err();
            assert!(error.contains("too many brackets"), "{error}");
        }
        let value: Value = parse_yaml("cameras:\n  - - [1, [2, {a: 3}]]\n    - 4\n").unwrap();
        assert_eq!(value["cameras"][0][0][1][1]["a"], 3);
        let comments = "# range [0, 1)\n".repeat(100) + "b: 2 # within [0, 3)\n";
        assert_eq!(parse_yaml::<Value>(&comments).unwrap()["b"], 2);
        let indented = format!("a:\n{}- b: 1\n", " ".repeat(200));
        assert_eq!(parse_yaml::<Value>(&indented).unwrap()["a"][0]["b"], 1);
    }
}
