//! The encoding of .pcd and .ply files.

use std::path::Path;

use anyhow::{Result, bail};
use clap::ValueEnum;
use planish::Precision;
use planish::io::Encoding;

use super::OUTPUT;

#[derive(clap::Args)]
pub struct EncodingArgs {
    /// Encoding of a .pcd or .ply file, and precision of its coordinates, such as compressed,f64 [default: the input's]
    ///
    /// Coordinates in .pcd files have 4 bytes (f32) unless they exceed 1000 m, because PCL reads 8-byte coordinates
    /// (f64) as zeros.
    #[arg(long, value_enum, value_name = "ENCODING", value_delimiter = ',', hide_short_help = true, help_heading = OUTPUT)]
    pub encoding: Vec<EncodingArg>,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
pub enum EncodingArg {
    Ascii,
    Binary,
    Compressed,
    F32,
    F64,
}

impl EncodingArgs {
    pub fn is_given(&self) -> bool {
        !self.encoding.is_empty()
    }

    /// Returns an error if the output's format cannot be written or does not support the requested encoding, or if
    /// requested encodings contradict each other.
    pub fn check(&self, output: &Path) -> Result<()> {
        let is_precision = |encoding: &&EncodingArg| matches!(encoding, EncodingArg::F32 | EncodingArg::F64);
        let precisions = self.encoding.iter().filter(is_precision).count();
        if precisions > 1 || self.encoding.len() - precisions > 1 {
            bail!("--encoding: conflicting values; choose one of ascii, binary and compressed, and one of f32 and f64");
        }
        crate::commands::check_output(output, self.is_given())
    }

    /// Returns the requested encoding.
    pub fn encoding(&self) -> Option<Encoding> {
        self.encoding.iter().find_map(|encoding| match encoding {
            EncodingArg::Ascii => Some(Encoding::Ascii),
            EncodingArg::Binary => Some(Encoding::Binary),
            EncodingArg::Compressed => Some(Encoding::BinaryCompressed),
            EncodingArg::F32 | EncodingArg::F64 => None,
        })
    }

    /// Returns the requested precision of coordinates.
    pub fn precision(&self) -> Option<Precision> {
        self.encoding.iter().find_map(|encoding| match encoding {
            EncodingArg::F32 => Some(Precision::F32),
            EncodingArg::F64 => Some(Precision::F64),
            _ => None,
        })
    }
}
