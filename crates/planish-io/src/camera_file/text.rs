//! Parses a camera file of any supported syntax into a JSON value.

#[cfg(feature = "more-formats")]
use serde_json::Map;
use serde_json::Value;

use super::super::yaml::parse_yaml;
use super::super::{FormatResult, brief};
use super::malformed;
#[cfg(feature = "more-formats")]
use super::value::names;

/// Parses JSON, YAML, OpenCV's XML, lines of `name = value`, or bare numbers.
pub(super) fn parse(text: &str) -> FormatResult<Value> {
    let text = text.trim();
    let not_a_camera =
        |error: &dyn std::fmt::Display| malformed(format!("not a camera file: {}", brief(&error.to_string())));
    if text.starts_with(['{', '[']) {
        return serde_json::from_str(text).or_else(|error| numbers(text).ok_or_else(|| not_a_camera(&error)));
    }
    #[cfg(feature = "more-formats")]
    if text.starts_with('<') {
        return Ok(Value::Object(xml(text)));
    }
    if let Some(numbers) = numbers(text) {
        return Ok(numbers);
    }
    // `topic echo` ends a message with the YAML document separator. OpenCV begins its files with a directive that is
    // not valid YAML, and tags its matrices.
    let lines = text.lines().filter(|line| !line.starts_with('%')).map(as_yaml);
    let yaml = lines.collect::<Vec<_>>().join("\n").replace("!!opencv-matrix", "");
    let first = yaml.trim_start().trim_start_matches("---").split("\n---").next().unwrap_or_default();
    parse_yaml(first).map_err(|error| not_a_camera(&error))
}

/// Converts a line `name = value`, which ScanNet uses, to YAML; returns other lines unchanged.
fn as_yaml(line: &str) -> String {
    let is_name = |name: &str| name.chars().all(|c| c.is_alphanumeric() || c == '_');
    match line.split_once('=') {
        Some((name, value)) if is_name(name.trim()) => format!("{}: {}", name.trim(), value.trim()),
        _ => line.to_owned(),
    }
}

/// Returns the numbers in a text, separated by spaces, brackets, commas or semicolons; `None` if it contains anything
/// else or is empty.
fn numbers(text: &str) -> Option<Value> {
    let words =
        text.split(|c: char| c.is_whitespace() || matches!(c, ',' | ';' | '[' | ']')).filter(|word| !word.is_empty());
    let numbers: Vec<f64> = words.map(|word| word.parse().ok()).collect::<Option<_>>()?;
    (!numbers.is_empty()).then(|| numbers.into())
}

/// Returns the named values in OpenCV's XML: either `<name>1</name>`, or a matrix with an element `<data>`.
#[cfg(feature = "more-formats")]
fn xml(text: &str) -> Map<String, Value> {
    let value = |name: &str| {
        // In the opening tag, the name may be followed by the type of a matrix.
        let (_, behind) =
            [format!("<{name}>"), format!("<{name} ")].iter().find_map(|tag| text.split_once(tag.as_str()))?;
        let (content, _) = behind.split_once(&format!("</{name}>"))?;
        let data = content.split_once("<data>").and_then(|(_, data)| data.split_once("</data>"));
        let content = data.map_or(content, |(data, _)| data).trim();
        let number = content.parse::<u64>().ok().filter(|_| data.is_none());
        let value = number.map(Value::from).or_else(|| numbers(content));
        // The lens model is a word.
        let word = || name.ends_with("model").then(|| Value::from(content.trim_matches('"')));
        Some((name.to_owned(), value.or_else(word)?))
    };
    names().filter_map(value).collect()
}
