//! Decompression of chunks without C code: zstd by ruzstd, LZ4 by lz4_flex.
//!
//! Both decompress whatever part of a chunk has been read, so that every message before the end of a truncated
//! recording can be read.

use std::io::Read;

use mcap::sans_io::LinearReader;
use mcap::sans_io::decompressor::{DecompressResult, Decompressor};
use mcap::{McapError, McapResult};
use ruzstd::decoding::FrameDecoder;

/// Registers decompressors for all compression formats that MCAP defines.
pub(super) fn register(reader: &mut LinearReader) -> McapResult<()> {
    reader.add_decompressor(Zstd::default())?;
    reader.add_decompressor(Lz4::default())
}

/// Magic number of skippable frames in both formats; its last four bits are arbitrary.
const SKIPPABLE: u32 = 0x184D_2A50;
/// Size in bytes of the header of a skippable frame: its magic number and its length.
const SKIPPABLE_HEADER: usize = 8;
/// Maximum size of the header of a zstd frame in bytes.
const LONGEST_ZSTD_HEADER: usize = 18;

const NOTHING: DecompressResult = DecompressResult { consumed: 0, wrote: 0 };

fn damaged(error: impl std::fmt::Display) -> McapError {
    McapError::DecompressionError(error.to_string())
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(*bytes.get(at..)?.first_chunk()?))
}

/// Returns the length in bytes of a skippable frame that begins here, if any.
fn skippable(src: &[u8]) -> Option<usize> {
    let is_skippable = u32_at(src, 0)? & !0xF == SKIPPABLE;
    is_skippable.then(|| u32_at(src, 4).map(|length| SKIPPABLE_HEADER + length as usize))?
}

/// Returns the first block of a zstd frame, with its header and the four bytes after it, which may be a checksum.
fn first_block(src: &[u8]) -> &[u8] {
    let Some(&[a, b, c]) = src.first_chunk() else { return src };
    let header = u32::from_le_bytes([a, b, c, 0]);
    // A block of one repeated byte stores that byte once.
    let stored = if (header >> 1) & 3 == 1 { 1 } else { (header >> 3) as usize };
    &src[..src.len().min(3 + stored + 4)]
}

/// A decompressor of zstd frames, one after another.
#[derive(Default)]
struct Zstd {
    /// The current frame.
    frame: Option<Box<FrameDecoder>>,
    /// Number of bytes of a skippable frame that are still to be skipped.
    skipping: usize,
}

impl Decompressor for Zstd {
    fn next_read_size(&self) -> usize {
        0
    }

    fn decompress(&mut self, src: &[u8], dst: &mut [u8]) -> McapResult<DecompressResult> {
        if self.skipping > 0 {
            let consumed = src.len().min(self.skipping);
            self.skipping -= consumed;
            return Ok(DecompressResult { consumed, wrote: 0 });
        }
        let mut frame = match self.frame.take() {
            Some(frame) => frame,
            None if src.is_empty() => return Ok(NOTHING),
            None => {
                if let Some(length) = skippable(src) {
                    self.skipping = length;
                    return self.decompress(src, dst);
                }
                let (mut frame, mut rest) = (Box::new(FrameDecoder::new()), src);
                // The decoder needs the whole header.
                return match frame.init(&mut rest) {
                    Ok(()) => {
                        self.frame = Some(frame);
                        Ok(DecompressResult { consumed: src.len() - rest.len(), wrote: 0 })
                    }
                    Err(_) if src.len() < LONGEST_ZSTD_HEADER => Ok(NOTHING),
                    Err(error) => Err(damaged(error)),
                };
            }
        };
        // The decoder decodes all blocks that it is given, and 4 bytes may encode a block of 128 KiB.
        let is_enough = !dst.is_empty() && frame.can_collect() >= dst.len();
        let (consumed, wrote) = if is_enough {
            (0, frame.read(dst).map_err(damaged)?)
        } else {
            frame.decode_from_to(first_block(src), dst).map_err(damaged)?
        };
        // The decoder also counts the four bytes of a checksum that have not been read yet.
        let consumed = if consumed > src.len() { 0 } else { consumed };
        if !frame.is_finished() || frame.can_collect() > 0 {
            self.frame = Some(frame);
        }
        Ok(DecompressResult { consumed, wrote })
    }

    fn reset(&mut self) -> McapResult<()> {
        *self = Self::default();
        Ok(())
    }

    fn name(&self) -> &'static str {
        "zstd"
    }
}

/// A decompressor of LZ4 frames, one after another. lz4_flex decompresses their blocks; its own frame decoder needs a
/// blocking reader.
#[derive(Default)]
struct Lz4 {
    frame: Option<Lz4Frame>,
    /// The last block, and up to 64 KiB before it, which the next block may refer to.
    window: Vec<u8>,
    /// The offset in `window` of the first byte not yet returned.
    unread: usize,
    skipping: usize,
}

/// The header of a frame.
#[derive(Clone, Copy)]
struct Lz4Frame {
    largest_block: usize,
    has_block_checksums: bool,
    has_checksum: bool,
}

impl Lz4Frame {
    const MAGIC: u32 = 0x184D_2204;
    /// Maximum distance in bytes that a block may refer back.
    const WINDOW: usize = 64 << 10;

    /// Reads the header of a frame; returns it with its length in bytes, or `None` if it is incomplete.
    fn read(src: &[u8]) -> McapResult<Option<(Self, usize)>> {
        let (Some(magic), Some(&[flags, sizes])) = (u32_at(src, 0), src.get(4..6).and_then(|two| two.first_chunk()))
        else {
            return Ok(None);
        };
        if magic != Self::MAGIC || flags >> 6 != 1 {
            return Err(damaged("not an LZ4 frame"));
        }
        let largest_block = match sizes >> 4 & 7 {
            size @ 4..=7 => 1 << (8 + 2 * size),
            _ => return Err(damaged("the LZ4 frame has an invalid block size")),
        };
        if flags & 1 != 0 {
            return Err(damaged("LZ4 frames with a dictionary are not supported"));
        }
        let (has_content_size, has_block_checksums, has_checksum) = (flags & 8 != 0, flags & 16 != 0, flags & 4 != 0);
        let length = 6 + if has_content_size { 8 } else { 0 } + 1;
        let header = Self { largest_block, has_block_checksums, has_checksum };
        Ok((src.len() >= length).then_some((header, length)))
    }
}

impl Lz4 {
    /// Copies decompressed bytes to `dst`; returns their number.
    fn hand_out(&mut self, dst: &mut [u8]) -> usize {
        let mut unread = &self.window[self.unread..];
        let wrote = unread.read(dst).unwrap_or(0);
        self.unread += wrote;
        wrote
    }

    /// Decompresses the block at the beginning of `src`; returns its length in bytes, or `None` if it is incomplete.
    fn block(&mut self, frame: Lz4Frame, src: &[u8]) -> McapResult<Option<usize>> {
        const UNCOMPRESSED: u32 = 1 << 31;
        let Some(size) = u32_at(src, 0) else { return Ok(None) };
        if size == 0 {
            let length = 4 + if frame.has_checksum { 4 } else { 0 };
            if src.len() < length {
                return Ok(None);
            }
            self.frame = None;
            return Ok(Some(length));
        }
        let stored = (size & !UNCOMPRESSED) as usize;
        if stored > frame.largest_block {
            return Err(damaged("an LZ4 block is larger than its frame allows"));
        }
        let length = 4 + stored + if frame.has_block_checksums { 4 } else { 0 };
        if src.len() < length {
            return Ok(None);
        }
        let block = &src[4..4 + stored];
        self.window.drain(..self.window.len().saturating_sub(Lz4Frame::WINDOW));
        self.unread = self.window.len();
        if size & UNCOMPRESSED != 0 {
            self.window.extend_from_slice(block);
            return Ok(Some(length));
        }
        let before = self.window.len();
        self.window.resize(before + frame.largest_block, 0);
        let (dictionary, into) = self.window.split_at_mut(before);
        let wrote = lz4_flex::block::decompress_into_with_dict(block, into, dictionary).map_err(damaged)?;
        self.window.truncate(before + wrote);
        Ok(Some(length))
    }
}

impl Decompressor for Lz4 {
    fn next_read_size(&self) -> usize {
        0
    }

    fn decompress(&mut self, src: &[u8], dst: &mut [u8]) -> McapResult<DecompressResult> {
        if self.skipping > 0 {
            let consumed = src.len().min(self.skipping);
            self.skipping -= consumed;
            return Ok(DecompressResult { consumed, wrote: 0 });
        }
        if self.unread < self.window.len() {
            return Ok(DecompressResult { consumed: 0, wrote: self.hand_out(dst) });
        }
        let Some(frame) = self.frame else {
            if let Some(length) = skippable(src) {
                self.skipping = length;
                return self.decompress(src, dst);
            }
            let Some((frame, consumed)) = Lz4Frame::read(src)? else { return Ok(NOTHING) };
            *self = Self { frame: Some(frame), ..Self::default() };
            return Ok(DecompressResult { consumed, wrote: 0 });
        };
        let Some(consumed) = self.block(frame, src)? else { return Ok(NOTHING) };
        Ok(DecompressResult { consumed, wrote: self.hand_out(dst) })
    }

    fn reset(&mut self) -> McapResult<()> {
        *self = Self::default();
        Ok(())
    }

    fn name(&self) -> &'static str {
        "lz4"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_zstd_bomb_is_decompressed_step_by_step() {
        const BLOCKS: usize = 1000;
        const BLOCK_BYTES: usize = 128 << 10;
        // A frame without size or checksum and with a window of 128 KiB, and blocks that each repeat a zero.
        let mut src = vec![0x28, 0xB5, 0x2F, 0xFD, 0, 7 << 3];
        for i in 1..=BLOCKS {
            let header = (BLOCK_BYTES as u32) << 3 | 1 << 1 | u32::from(i == BLOCKS);
            src.extend(&header.to_le_bytes()[..3]);
            src.push(0);
        }
        let (mut zstd, mut dst, mut rest, mut total) = (Zstd::default(), vec![1; 64 << 10], &src[..], 0);
        loop {
            let DecompressResult { consumed, wrote } = zstd.decompress(rest, &mut dst).unwrap();
            assert!(dst[..wrote].iter().all(|&byte| byte == 0));
            (rest, total) = (&rest[consumed..], total + wrote);
            let Some(frame) = &zstd.frame else { break };
            assert!(frame.can_collect() <= 4 * BLOCK_BYTES, "{} bytes are in memory", frame.can_collect());
        }
        assert_eq!((total, rest.len()), (BLOCKS * BLOCK_BYTES, 0));
    }
}
