//! Settings files in JSON or YAML, shared by all front ends.

use std::path::Path;

use super::yaml::parse_yaml;
use super::{FormatResult, ReadOptions, brief};
use planish_core::{FormatError, IoError, Settings};

/// Maximum size of a settings file in bytes.
const MAX_BYTES: u64 = 1 << 20;

/// Length in bytes above which an error message is shortened. Long messages quote the file.
const LONGEST: usize = 1000;

/// Maximum number of brackets, which real settings never reach.
const MOST_BRACKETS: usize = 100;

/// Reads settings from a JSON or YAML file: an object with fields of [`Settings`].
///
/// # Errors
/// If the file cannot be read, has an unknown field, or has a value outside its range.
pub fn read_settings(path: &Path) -> Result<Settings, IoError> {
    let read = || {
        let bytes = super::read_bytes(path, &ReadOptions::default().with_max_memory_bytes(MAX_BYTES))?;
        let text = String::from_utf8(bytes)
            .map_err(|_| FormatError::Malformed("the file is not text; expected settings as JSON or YAML".into()))?;
        parse_settings(&text)
    };
    read().map_err(IoError::at(path))
}

/// Parses settings from JSON or YAML.
///
/// # Errors
/// If the text is not valid JSON or YAML, has an unknown field, or has a value outside its range.
pub fn parse_settings(text: &str) -> FormatResult<Settings> {
    let text = text.trim_start_matches('\u{feff}');
    // The YAML parser's time grows with the square of the nesting depth.
    if text.matches(['{', '[']).count() > MOST_BRACKETS {
        return Err(FormatError::Malformed(format!("settings: more than {MOST_BRACKETS} brackets")));
    }
    // JSON is not always valid YAML: it may be indented with tabs.
    let parsed = match text.trim_start().chars().next() {
        Some('{') => serde_json::from_str(text).map_err(|error| error.to_string()),
        _ => parse_yaml(text),
    };
    parsed.map_err(|error| {
        FormatError::Malformed(format!("settings: {}", if error.len() > LONGEST { brief(&error) } else { error }))
    })
}

/// Returns settings as JSON, with only the fields that are set.
pub fn settings_to_json(settings: &Settings) -> String {
    serde_json::to_string_pretty(settings).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_and_yaml_are_the_same_settings() {
        let expected: Settings =
            "preset=strong edges=off radius_m=0.03 outputs=points+normals threads=2".parse().unwrap();
        let json = "{\t\"preset\": \"strong\", \"edges\": \"off\", \"radius\": 0.03, \"outputs\": [\"points\", \
                    \"normals\"], \"threads\": 2}";
        assert_eq!(parse_settings(json).unwrap(), expected);
        let yaml =
            "# a wall\npreset: strong\nedges: off\nradius_m: 0.03\noutputs:\n  - points\n  - normals\nthreads: 2\n";
        assert_eq!(parse_settings(yaml).unwrap(), expected);
        assert_eq!(parse_settings(&settings_to_json(&expected)).unwrap(), expected);
        assert_eq!(parse_settings("").unwrap(), Settings::default());
    }

    #[test]
    fn errors_name_the_file_the_field_and_what_is_allowed() {
        for (text, expected) in [
            ("{\"window\": 9}", "window = 9 is not allowed: 1 to 7"),
            ("strenght: 0.5", "\"strenght\" (did you mean strength?) is not allowed: preset, strength"),
            ("strength: much", "strength = \"much\" is not allowed: 0 (light) to 1 (strong)"),
            ("[1, 2]", "an object of settings"),
            ("preset: light\nstrength: 0.2", "set either preset or strength"),
            (&"[".repeat(100_000), "more than 100 brackets"),
        ] {
            let error = parse_settings(text).unwrap_err().to_string();
            assert!(error.contains(expected), "{text}: {error}");
        }
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("mine.yaml");
        std::fs::write(&file, "degree: 7").unwrap();
        let error = read_settings(&file).unwrap_err().to_string();
        assert!(error.contains("mine.yaml") && error.contains("degree = 7"), "{error}");
    }
}
