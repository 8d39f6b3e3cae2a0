//! The command line of a ROS 2 node: `--ros-args -r from:=to -p name:=value --params-file FILE`.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, bail};
use planish::io::{ReadOptions, internal::parse_yaml, read_bytes};
use ros2_client::ParameterValue;
use serde_yaml_ng::Value;

/// Default name of the node.
pub const NODE_NAME: &str = "planish";

/// Parsed command line.
#[derive(Debug, Clone, PartialEq)]
pub struct Arguments {
    /// The node's namespace, which begins with a slash.
    pub namespace: String,
    /// The node's name.
    pub node: String,
    /// Topic remapping rules: old and new names.
    remappings: Vec<(String, String)>,
    /// Values of parameters; later ones win.
    pub parameters: BTreeMap<String, ParameterValue>,
}

/// Maximum size of a parameter file in bytes.
const MOST_BYTES: u64 = 16 << 20;

fn yaml(text: &str) -> Result<Value> {
    parse_yaml(text).map_err(anyhow::Error::msg)
}

impl Arguments {
    /// Parses the arguments after the program's name.
    pub fn parse(arguments: impl IntoIterator<Item = String>) -> Result<Self> {
        let mut parsed =
            Self { namespace: "/".into(), node: NODE_NAME.into(), remappings: Vec::new(), parameters: BTreeMap::new() };
        let mut arguments = arguments.into_iter();
        let (mut of_ros, mut files, mut set) = (false, Vec::new(), Vec::new());
        while let Some(argument) = arguments.next() {
            let mut value =
                |what: &str| arguments.next().with_context(|| format!("{argument}: expected {what} after it"));
            match argument.as_str() {
                "--ros-args" => of_ros = true,
                "--" if of_ros => of_ros = false,
                "-r" | "--remap" if of_ros => parsed.remap(&value("FROM:=TO")?)?,
                "-p" | "--param" if of_ros => set.push(value("NAME:=VALUE")?),
                "--params-file" if of_ros => files.push(value("a file")?),
                // Accepted and ignored, since launch files pass them.
                "--log-level" | "--log-config-file" | "-e" | "--enclave" if of_ros => drop(value("a value")?),
                "--enable-rosout-logs"
                | "--disable-rosout-logs"
                | "--enable-stdout-logs"
                | "--disable-stdout-logs"
                | "--enable-external-lib-logs"
                | "--disable-external-lib-logs" => {}
                other => bail!("{other}: unknown argument; see `planish-ros --help`"),
            }
        }
        // The node's name is known only now; rules and files refer to it.
        let own = format!("{}:", parsed.node);
        for (from, _) in &mut parsed.remappings {
            if let Some(topic) = from.strip_prefix(&own) {
                *from = topic.to_owned();
            }
        }
        // Removes the rules for other nodes. Topic names contain no colon.
        parsed.remappings.retain(|(from, _)| !from.contains(':'));
        for file in files {
            parsed.read_file(Path::new(&file))?;
        }
        for assignment in set {
            let (name, value) =
                assignment.split_once(":=").with_context(|| format!("-p {assignment}: expected NAME:=VALUE"))?;
            let value: Value = yaml(value).with_context(|| format!("-p {assignment}"))?;
            // A parameter may be meant for only one of several nodes.
            let (node, name) = name.split_once(':').unwrap_or((&parsed.node, name));
            if node == parsed.node {
                let value = parameter(&value).with_context(|| format!("-p {assignment}"))?;
                parsed.parameters.insert(name.to_owned(), value);
            }
        }
        Ok(parsed)
    }

    fn remap(&mut self, rule: &str) -> Result<()> {
        let (from, to) = rule.split_once(":=").with_context(|| format!("-r {rule}: expected FROM:=TO"))?;
        match from {
            "__ns" if to.starts_with('/') => self.namespace = to.to_owned(),
            "__ns" => bail!("-r {rule}: a namespace must begin with a slash"),
            "__node" | "__name" => self.node = to.to_owned(),
            from => self.remappings.push((from.to_owned(), to.to_owned())),
        }
        Ok(())
    }

    /// Returns the full name of a topic, after remapping: relative names are in the node's namespace, `~` is the node
    /// itself.
    pub fn topic(&self, name: &str) -> String {
        let full = self.absolute(name);
        let of_rule = |(from, to): &(String, String)| (self.absolute(from) == full).then(|| self.absolute(to));
        self.remappings.iter().find_map(of_rule).unwrap_or(full)
    }

    fn absolute(&self, name: &str) -> String {
        let namespace = self.namespace.trim_end_matches('/');
        match (name.strip_prefix("~/"), name.starts_with('/')) {
            (_, true) => name.to_owned(),
            (Some(private), false) => format!("{namespace}/{}/{private}", self.node),
            (None, false) => format!("{namespace}/{name}"),
        }
    }

    /// Reads the parameters of this node from a file: those under its name, its full name, or patterns with `*` and
    /// `**`.
    fn read_file(&mut self, path: &Path) -> Result<()> {
        let of_file = || path.display().to_string();
        let options = ReadOptions::default().with_max_memory_bytes(MOST_BYTES);
        let text = String::from_utf8(read_bytes(path, &options).with_context(of_file)?).with_context(of_file)?;
        let file = yaml(&text).with_context(of_file)?;
        if !matches!(file, Value::Mapping(_)) {
            bail!("{}: expected a node's name with ros__parameters", path.display());
        }
        self.read_nodes(&file, "").with_context(|| path.display().to_string())
    }

    /// Reads the entries under a name: parameters, or further parts of the name.
    fn read_nodes(&mut self, entries: &Value, name: &str) -> Result<()> {
        let Value::Mapping(entries) = entries else { bail!("{name} has no ros__parameters") };
        for (key, entry) in entries {
            let key = key.as_str().context("expected a node's name")?;
            if key != "ros__parameters" {
                self.read_nodes(entry, &format!("{}/{}", name.trim_end_matches('/'), key.trim_start_matches('/')))?;
                continue;
            }
            let Value::Mapping(parameters) = entry else { bail!("{name}: ros__parameters must map names to values") };
            for (parameter_name, value) in parameters {
                let parameter_name = parameter_name.as_str().context("expected a parameter's name")?;
                // Parameters of other nodes and of middleware may have any value.
                if self.is_meant(name) && parameter_name != "qos_overrides" {
                    let value = parameter(value).with_context(|| parameter_name.to_owned())?;
                    self.parameters.insert(parameter_name.to_owned(), value);
                }
            }
        }
        Ok(())
    }

    /// Returns true if a name in a file matches this node: `*` matches any part, `**` any number of parts. A bare name
    /// matches the node in any namespace.
    fn is_meant(&self, name: &str) -> bool {
        fn matches(pattern: &[&str], parts: &[&str]) -> bool {
            match (pattern, parts) {
                ([], []) => true,
                (["**", rest @ ..], parts) => (0..=parts.len()).any(|skipped| matches(rest, &parts[skipped..])),
                ([first, rest @ ..], [part, parts @ ..]) => (*first == "*" || first == part) && matches(rest, parts),
                _ => false,
            }
        }
        fn parts(name: &str) -> Vec<&str> {
            name.split('/').filter(|part| !part.is_empty()).collect()
        }
        let full = format!("{}/{}", self.namespace, self.node);
        let pattern = parts(name);
        pattern == [self.node.as_str()] || matches(&pattern, &parts(&full))
    }
}

fn parameter(value: &Value) -> Result<ParameterValue> {
    Ok(match value {
        Value::Bool(value) => ParameterValue::Boolean(*value),
        Value::String(value) => ParameterValue::String(value.clone()),
        Value::Number(value) => match (value.as_i64(), value.as_f64()) {
            (Some(value), _) => ParameterValue::Integer(value),
            (None, Some(value)) => ParameterValue::Double(value),
            (None, None) => bail!("{value}: the number is out of range"),
        },
        _ => bail!("expected true, false, a number or a string"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(line: &str) -> Result<Arguments> {
        Arguments::parse(line.split_whitespace().map(str::to_owned))
    }

    #[test]
    fn topics_are_remapped_as_rcl_does() {
        let arguments = parse(
            "--ros-args -r __ns:=/arm -r __node:=wrist -r image_rect:=/camera/depth/image_rect_raw -r points:=~/cloud",
        )
        .unwrap();
        assert_eq!(arguments.topic("image_rect"), "/camera/depth/image_rect_raw");
        assert_eq!(arguments.topic("points"), "/arm/wrist/cloud");
        assert_eq!(arguments.topic("camera_info"), "/arm/camera_info");
        assert_eq!(arguments.topic("/diagnostics"), "/diagnostics");
        assert_eq!(parse("").unwrap().topic("points"), "/points");
        let arguments = parse("--ros-args -r planish:points:=/mine -r other:points:=/theirs").unwrap();
        assert_eq!(arguments.topic("points"), "/mine");
    }

    #[test]
    fn parameters_of_the_command_line_win_over_those_of_files() {
        let folder = std::env::temp_dir().join(format!("planish-ros-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let file = folder.join("params.yaml");
        // Parameters of other nodes and their middleware may have any value.
        let text = "/**:\n  ros__parameters:\n    strength: 0.25\n    sensor: d435\n    qos_overrides: {/tf: {depth: \
                    1}}\n\
                    other:\n  ros__parameters:\n    sensor: l515\n    roi: [1, 2]\n    nothing:\n";
        std::fs::write(&file, text).unwrap();
        let nested = folder.join("nested.yaml");
        let text = "arm:\n  planish:\n    ros__parameters:\n      strength: 0.75\n/leg/**:\n  ros__parameters:\n    \
                    strength: 0.0\n/*/planish:\n  \
                    ros__parameters:\n    sensor: d455\n";
        std::fs::write(&nested, text).unwrap();
        let arguments = parse(&format!("--ros-args -r __ns:=/arm --params-file {}", nested.display())).unwrap();
        assert_eq!(arguments.parameters["strength"], ParameterValue::Double(0.75));
        assert_eq!(arguments.parameters["sensor"], ParameterValue::String("d455".into()));
        let arguments =
            parse(&format!("--ros-args -p strength:=1 --params-file {} -p other:sensor:=d415", file.display()))
                .unwrap();
        assert_eq!(arguments.parameters["strength"], ParameterValue::Integer(1));
        assert_eq!(arguments.parameters["sensor"], ParameterValue::String("d435".into()));
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn what_is_not_understood_is_named() {
        for (line, text) in [
            ("--ros-args -r", "FROM:=TO"),
            ("--ros-args -r a", "FROM:=TO"),
            ("--ros-args -p strength", "NAME:=VALUE"),
            ("--fast", "--fast"),
            ("--ros-args -r __ns:=arm", "slash"),
            ("--ros-args --params-file /nowhere.yaml", "/nowhere.yaml"),
            ("--ros-args -p strength:=[1,2]", "strength"),
        ] {
            let error = format!("{:#}", parse(line).unwrap_err());
            assert!(error.contains(text), "{line}: {error}");
        }
    }
}
