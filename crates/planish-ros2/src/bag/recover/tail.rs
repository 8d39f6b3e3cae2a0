//! The records that are appended to a recording to complete it.

use std::collections::BTreeMap;
use std::io::Cursor;

use binrw::BinWrite;
use mcap::McapError;
use mcap::records::{ChunkHeader, ChunkIndex, DataEnd, Footer, MessageIndex, MessageIndexEntry, Statistics, op};

use super::super::{MAGIC, of_mcap};
use super::{RECORD_HEADER, Scan};
use planish_core::FormatError;

impl Scan {
    /// Returns the bytes to append at `at`: missing indices, messages of a chunk that was cut, and the summary.
    pub(super) fn tail(&self, at: u64) -> Result<Vec<u8>, FormatError> {
        let mut tail = Vec::new();
        let mut chunks = self.chunks.clone();
        if let (Some(chunk), false) = (chunks.last_mut(), self.missing.is_empty()) {
            index_messages(&mut tail, at, &self.missing, chunk)?;
        }
        if let Some(contents) = &self.salvaged {
            let start = at + tail.len() as u64;
            let (first, last) = contents.times.unwrap_or_default();
            let size = contents.bytes.len() as u64;
            let header = ChunkHeader {
                message_start_time: first,
                message_end_time: last,
                uncompressed_size: size,
                uncompressed_crc: 0,
                compression: String::new(),
                compressed_size: size,
            };
            let mut data = encoded(&header)?;
            data.extend_from_slice(&contents.bytes);
            record(&mut tail, op::CHUNK, &data);
            let mut index = ChunkIndex {
                message_start_time: first,
                message_end_time: last,
                chunk_start_offset: start,
                chunk_length: RECORD_HEADER + data.len() as u64,
                message_index_offsets: BTreeMap::new(),
                message_index_length: 0,
                compression: String::new(),
                compressed_size: size,
                uncompressed_size: size,
            };
            index_messages(&mut tail, at, &contents.index, &mut index)?;
            chunks.push(index);
        }
        record(&mut tail, op::DATA_END, &encoded(&DataEnd { data_section_crc: 0 })?);

        let summary_start = at + tail.len() as u64;
        for (header, text) in self.schemas.values() {
            let mut data = encoded(header)?;
            data.extend((text.len() as u32).to_le_bytes());
            data.extend(text);
            record(&mut tail, op::SCHEMA, &data);
        }
        for channel in self.channels.values() {
            record(&mut tail, op::CHANNEL, &encoded(channel)?);
        }
        let (first, last) = self.times.unwrap_or_default();
        let statistics = Statistics {
            message_count: self.counts.values().sum(),
            schema_count: self.schemas.len() as u16,
            channel_count: self.channels.len() as u32,
            attachment_count: self.attachments,
            metadata_count: self.metadata,
            chunk_count: chunks.len() as u32,
            message_start_time: first,
            message_end_time: last,
            channel_message_counts: self.counts.clone(),
        };
        record(&mut tail, op::STATISTICS, &encoded(&statistics)?);
        for chunk in &chunks {
            record(&mut tail, op::CHUNK_INDEX, &encoded(chunk)?);
        }
        // 0 means that there are no summary offset records, and no checksum.
        record(&mut tail, op::FOOTER, &encoded(&Footer { summary_start, summary_offset_start: 0, summary_crc: 0 })?);
        tail.extend(MAGIC);
        Ok(tail)
    }
}

/// Appends the message indices of a chunk to `to`, which begins at the offset `at` of the file.
fn index_messages(
    to: &mut Vec<u8>,
    at: u64,
    messages: &BTreeMap<u16, Vec<MessageIndexEntry>>,
    chunk: &mut ChunkIndex,
) -> Result<(), FormatError> {
    for (&channel_id, records) in messages {
        let before = to.len();
        chunk.message_index_offsets.insert(channel_id, at + before as u64);
        record(to, op::MESSAGE_INDEX, &encoded(&MessageIndex { channel_id, records: records.clone() })?);
        chunk.message_index_length += (to.len() - before) as u64;
    }
    Ok(())
}

fn encoded<T: for<'a> BinWrite<Args<'a> = ()>>(value: &T) -> Result<Vec<u8>, FormatError> {
    let mut bytes = Cursor::new(Vec::new());
    value.write_le(&mut bytes).map_err(|error| of_mcap(McapError::Parse(error)))?;
    Ok(bytes.into_inner())
}

pub(super) fn record(to: &mut Vec<u8>, opcode: u8, data: &[u8]) {
    to.push(opcode);
    to.extend((data.len() as u64).to_le_bytes());
    to.extend(data);
}
