//! Any bytes as an LZF stream, and any bytes compressed and decompressed.
//!
//! `cargo fuzz run -s none lzf`

#![no_main]

use libfuzzer_sys::fuzz_target;
use planish::internal::lzf::{compress, decompress};

fuzz_target!(|bytes: &[u8]| {
    for size in [0, bytes.len(), 4 * bytes.len(), 1 << 20] {
        if let Ok(data) = decompress(bytes, size) {
            assert_eq!(data.len(), size);
        }
    }
    assert_eq!(decompress(&compress(bytes), bytes.len()).as_deref(), Ok(bytes));
});
