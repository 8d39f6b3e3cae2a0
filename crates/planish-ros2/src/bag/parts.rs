//! Recordings that rosbag2 split into several files, which are read as one.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use mcap::records::{Channel, Record};

use super::is_named_mcap;
use planish_core::FormatError;
use planish_io::ReadOptions;
use planish_io::internal::quoted;

/// Returns the files of a recording in order: the file itself, or the files that the metadata of a rosbag2 folder
/// lists. If it lists none, returns all .mcap files of the folder.
///
/// # Errors
/// If a listed file is missing.
pub(super) fn parts_of(path: &Path) -> Result<Vec<PathBuf>, FormatError> {
    /// Maximum size of a recording's metadata in bytes.
    const LARGEST_METADATA: u64 = 16 << 20;
    let file = path.join("metadata.yaml");
    if !file.is_file() {
        return Ok(vec![path.to_path_buf()]);
    }
    let metadata = planish_io::read_bytes(&file, &ReadOptions::default().with_max_memory_bytes(LARGEST_METADATA));
    let metadata = metadata.map_err(|error| match error {
        FormatError::TooLarge { .. } => FormatError::Malformed("its metadata.yaml is larger than 16 MiB".into()),
        error => FormatError::Malformed(format!("its metadata.yaml: {error}")),
    })?;
    let metadata = String::from_utf8_lossy(&metadata);
    let mut seen = BTreeSet::new();
    let names = listed(&metadata).into_iter().filter(|name| seen.insert(name.clone()));
    let files: Vec<PathBuf> = names.map(|name| path.join(name)).collect();
    if let Some(missing) = files.iter().find(|file| !file.is_file()) {
        let name = quoted(&missing.display().to_string());
        return Err(FormatError::Malformed(format!("its metadata.yaml lists {name}, which does not exist")));
    }
    if !files.is_empty() {
        return Ok(files);
    }
    // Some programs list no files.
    let files = std::fs::read_dir(path)?.flatten().map(|entry| entry.path());
    let mut files: Vec<PathBuf> = files.filter(|file| is_named_mcap(file) && file.is_file()).collect();
    files.sort_by_cached_key(|file| {
        // NAME_2 comes before NAME_10.
        let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let name = stem.trim_end_matches(|c: char| c.is_ascii_digit());
        (name.to_owned(), stem[name.len()..].parse::<u64>().ok())
    });
    Ok(files)
}

/// Returns the names of the files under `relative_file_paths`, without the folder that old versions of rosbag2 put
/// before them.
fn listed(metadata: &str) -> Vec<String> {
    let mut lines = metadata.lines().map(str::trim);
    if !lines.any(|line| line == "relative_file_paths:") {
        return Vec::new();
    }
    let names = lines.map_while(|line| line.strip_prefix("- "));
    let names = names.map(|name| name.trim().trim_matches(['"', '\'']));
    names.filter_map(|name| Some(Path::new(name).file_name()?.to_str()?.to_owned())).collect()
}

/// Number of copies of the schemas and channels of a recording in memory: here, in the reader's records, in the writer,
/// and in the summary at the end of a recording.
pub(super) const DEFINITION_COPIES: usize = 4;

/// Returns the memory for a channel in bytes.
pub(super) fn bytes_of_channel(channel: &Channel) -> usize {
    /// Memory for an entry of the metadata besides its text.
    const ENTRY: usize = 100;
    let metadata: usize = channel.metadata.iter().map(|(name, value)| name.len() + value.len() + ENTRY).sum();
    channel.topic.len() + channel.message_encoding.len() + metadata
}

/// A numbering of schemas and channels shared by all files of a recording. The first file keeps its own numbers.
#[derive(Default)]
pub(super) struct Numbers {
    /// Number of a schema by name, encoding and text.
    schemas: BTreeMap<(String, String, Vec<u8>), u16>,
    /// Number of a channel by topic, schema and encoding of its messages.
    channels: BTreeMap<(String, u16, String), u16>,
    /// Numbers in use by schemas or channels.
    used: BTreeSet<u16>,
    /// Shared number of each schema, by its number in the current file.
    schema: BTreeMap<u16, u16>,
    /// Shared number of each channel, by its number in the current file.
    channel: BTreeMap<u16, u16>,
    is_later: bool,
    /// Bytes of all schemas and channels. These stay in memory, and are written again at the end of a recording.
    definitions: usize,
    /// Number from which the search for a free number continues.
    next_free: u16,
}

impl Numbers {
    /// Begins the next file.
    pub(super) fn next_file(&mut self) {
        self.schema.clear();
        self.channel.clear();
        self.is_later = true;
    }

    /// Returns the shared number of a schema or channel: its own number in the first file; in later files, the known
    /// number or a free one from the middle of the range, where neither recorders nor
    /// [`smooth_bag`](super::smooth_bag) allocate numbers. Returns `None` if no number is free.
    fn number(&mut self, known: Option<u16>, own: u16) -> Option<u16> {
        const FIRST_FREE: u16 = 0x8000;
        let number = match known {
            _ if !self.is_later => own,
            Some(known) => known,
            None => {
                let free = |id: &u16| !self.used.contains(id);
                let number = (self.next_free.max(FIRST_FREE)..u16::MAX).find(free)?;
                self.next_free = number + 1;
                number
            }
        };
        self.used.insert(number);
        Some(number)
    }

    /// Adds the size of a schema or channel to the total, which must stay within the memory limit.
    fn count(&mut self, bytes: usize, options: &ReadOptions) -> Result<(), FormatError> {
        self.definitions += bytes;
        options.check(self.definitions, DEFINITION_COPIES)
    }

    /// Renumbers a record; returns `None` for a record that an earlier file already had.
    ///
    /// # Errors
    /// If there are too many schemas and channels for their numbers or for the memory limit.
    pub(super) fn renumbered(
        &mut self,
        record: Record<'static>,
        options: &ReadOptions,
    ) -> Result<Option<Record<'static>>, FormatError> {
        let too_many = || FormatError::Malformed("too many channels for one recording".into());
        Ok(Some(match record {
            Record::Header(_) if self.is_later => return Ok(None),
            Record::Schema { mut header, data } if header.id != 0 => {
                let key = (header.name.clone(), header.encoding.clone(), data.to_vec());
                let known = self.schemas.get(&key).copied();
                // Recorders repeat definitions in each chunk.
                if known.is_none() || !self.schema.contains_key(&header.id) {
                    self.count(data.len() + header.name.len() + header.encoding.len(), options)?;
                }
                let number = self.number(known, header.id).ok_or_else(too_many)?;
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
                if known.is_none() || !self.channel.contains_key(&channel.id) {
                    self.count(bytes_of_channel(&channel), options)?;
                }
                let number = self.number(known, channel.id).ok_or_else(too_many)?;
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
                        "damaged: a message refers to channel {}, which does not exist",
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
