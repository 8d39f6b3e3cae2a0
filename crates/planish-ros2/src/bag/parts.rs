//! Recordings in several files, as rosbag2 splits them: read as one.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use mcap::records::Record;

use super::is_recording;
use planish_core::FormatError;

/// Returns the files of a recording in their order: the file, or those of rosbag2's folder.
pub(super) fn parts_of(path: &Path) -> std::io::Result<Vec<PathBuf>> {
    if !path.join("metadata.yaml").is_file() {
        return Ok(vec![path.to_path_buf()]);
    }
    let files = std::fs::read_dir(path)?.flatten().map(|entry| entry.path());
    let mut files: Vec<PathBuf> = files.filter(|file| is_recording(file)).collect();
    files.sort_by_cached_key(|file| {
        // NAME_2 comes before NAME_10.
        let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let name = stem.trim_end_matches(|c: char| c.is_ascii_digit());
        (name.to_owned(), stem[name.len()..].parse::<u64>().ok())
    });
    Ok(files)
}

/// Numbers of schemas and channels that are the same in all files of a recording. The first file keeps its own.
#[derive(Default)]
pub(super) struct Numbers {
    /// Number of a schema by name, encoding and text.
    schemas: BTreeMap<(String, String, Vec<u8>), u16>,
    /// Number of a channel by topic, schema and encoding of its messages.
    channels: BTreeMap<(String, u16, String), u16>,
    /// Numbers in the current file.
    schema: BTreeMap<u16, u16>,
    channel: BTreeMap<u16, u16>,
    is_later: bool,
}

impl Numbers {
    /// Begins the next file.
    pub(super) fn next_file(&mut self) {
        self.schema.clear();
        self.channel.clear();
        self.is_later = true;
    }

    /// Renumbers a record; `None` for one that an earlier file had.
    pub(super) fn renumbered(&mut self, record: Record<'static>) -> Result<Option<Record<'static>>, FormatError> {
        let too_many = || FormatError::Malformed("more channels than a recording can have".into());
        Ok(Some(match record {
            Record::Header(_) if self.is_later => return Ok(None),
            Record::Schema { mut header, data } if header.id != 0 => {
                let key = (header.name.clone(), header.encoding.clone(), data.to_vec());
                let known = self.schemas.get(&key).copied();
                let number = number(known, header.id, &self.schemas, self.is_later).ok_or_else(too_many)?;
                self.schemas.entry(key).or_insert(number);
                self.schema.insert(header.id, number);
                if known.is_some() && self.is_later {
                    return Ok(None);
                }
                header.id = if self.is_later { number } else { header.id };
                Record::Schema { header, data }
            }
            Record::Channel(mut channel) => {
                if self.is_later {
                    channel.schema_id = self.schema.get(&channel.schema_id).copied().unwrap_or(0);
                }
                let key = (channel.topic.clone(), channel.schema_id, channel.message_encoding.clone());
                let known = self.channels.get(&key).copied();
                let number = number(known, channel.id, &self.channels, self.is_later).ok_or_else(too_many)?;
                self.channels.entry(key).or_insert(number);
                self.channel.insert(channel.id, number);
                if known.is_some() && self.is_later {
                    return Ok(None);
                }
                channel.id = if self.is_later { number } else { channel.id };
                Record::Channel(channel)
            }
            Record::Message { mut header, data } if self.is_later => {
                header.channel_id = self.channel.get(&header.channel_id).copied().ok_or_else(|| {
                    FormatError::Malformed(format!(
                        "damaged: a message on channel {}, which is not there",
                        header.channel_id
                    ))
                })?;
                Record::Message { header, data }
            }
            Record::Statistics(mut statistics) if self.is_later => {
                let renumbered = statistics.channel_message_counts.iter();
                let renumbered = renumbered.filter_map(|(id, count)| Some((*self.channel.get(id)?, *count)));
                statistics.channel_message_counts = renumbered.collect();
                Record::Statistics(statistics)
            }
            record => record,
        }))
    }
}

/// Returns the number of something in all files: its own in the first file; in later ones the known number or a free
/// one from the middle, where recorders and [`smooth_bag`](super::smooth_bag) have none.
fn number<K>(known: Option<u16>, own: u16, all: &BTreeMap<K, u16>, is_later: bool) -> Option<u16> {
    const FIRST_FREE: u16 = 0x8000;
    match known {
        _ if !is_later => Some(own),
        Some(known) => Some(known),
        None => (FIRST_FREE..u16::MAX).find(|id| all.values().all(|taken| taken != id)),
    }
}
