//! Describes the topics of a ROS 2 recording.

use std::path::Path;

use anyhow::Result;
use planish::bag::Survey;
use planish::io::printable_line;
use planish_bench::outln;
use serde::Serialize;

use crate::args::InfoArgs;
use crate::exit::ExitCode;

#[derive(Serialize)]
struct Info<'a> {
    format: &'static str,
    /// Total number of messages on all topics.
    messages: Option<u64>,
    compression: Option<&'a str>,
    topics: Vec<TopicInfo<'a>>,
    /// Topics with messages of other types.
    other_topics: Vec<OtherInfo<'a>>,
}

#[derive(Serialize)]
struct OtherInfo<'a> {
    topic: &'a str,
    #[serde(rename = "type")]
    type_name: &'a str,
    messages: Option<u64>,
}

/// A topic with images, clouds or cameras.
#[derive(Serialize)]
struct TopicInfo<'a> {
    topic: &'a str,
    #[serde(rename = "type")]
    type_name: &'a str,
    messages: Option<u64>,
    encoding: &'a str,
    frame_id: &'a str,
    is_depth: bool,
}

pub fn show(args: &InfoArgs, file: &Path) -> Result<ExitCode> {
    let survey = Survey::of(file, &args.reading.read_options())?;
    let topics = survey.topics.iter().map(|topic| TopicInfo {
        topic: &topic.name,
        type_name: &topic.type_name,
        messages: topic.messages,
        encoding: &topic.encoding,
        frame_id: &topic.frame_id,
        is_depth: topic.is_depth,
    });
    let others = survey.others.iter().map(|topic| OtherInfo {
        topic: &topic.name,
        type_name: &topic.type_name,
        messages: topic.messages,
    });
    let info = Info {
        format: "MCAP",
        messages: survey.messages,
        compression: survey.compression.as_deref(),
        topics: topics.collect(),
        other_topics: others.collect(),
    };
    if args.json {
        outln!("{}", serde_json::to_string(&info)?);
        return Ok(ExitCode::SUCCESS);
    }
    let print_topic = |text: &str| outln!("  {}", printable_line(text));
    let count = |messages: Option<u64>| messages.map_or("? messages".to_owned(), |count| format!("{count} messages"));
    let compression = match info.compression {
        None => "",
        Some("") => ", not compressed",
        Some(name) => &format!(", compressed by {}", printable_line(name)),
    };
    outln!("{}: MCAP, {}{compression}", file.display(), count(info.messages));
    for topic in &info.topics {
        let TopicInfo { topic, type_name, messages, encoding, frame_id, .. } = topic;
        print_topic(&format!("{topic}: {} of {type_name}, {encoding}, frame {frame_id:?}", count(*messages)));
    }
    for OtherInfo { topic, type_name, messages } in &info.other_topics {
        let type_name = if type_name.is_empty() { "an unknown type" } else { type_name };
        print_topic(&format!("{topic}: {} of {type_name}", count(*messages)));
    }
    if info.topics.is_empty() {
        outln!("  no images, clouds or cameras in ROS 2 messages (CDR)");
    }
    Ok(ExitCode::SUCCESS)
}
