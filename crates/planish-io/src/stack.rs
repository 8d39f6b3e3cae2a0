//! Files with several depth images: the pages of a TIFF file, or a NumPy array of shape [N, H, W].

use std::borrow::Cow;
use std::fs::File;
use std::io::Read;
use std::path::Path;

use super::plain::{GZIP, plain};
use super::read::decode_with;
use super::{Contents, Format, FormatResult, ReadOptions, read_bytes};
use planish_core::IoError;

/// A file with several depth images, such as the pages of a TIFF file or a NumPy array of shape [N, H, W].
///
/// The file stays in memory, so that decoding an image does not require reading the images before it.
#[derive(Debug, Clone)]
pub struct Stack {
    bytes: Vec<u8>,
    format: Format,
    images: usize,
    is_cut: bool,
    options: ReadOptions,
}

impl Stack {
    /// Reads a file. Returns `None` if the file is complete and has one image, or if its format allows only one.
    ///
    /// # Errors
    /// If the file is unreadable, exceeds the memory limit, or has a damaged header.
    pub fn open(path: &Path, options: &ReadOptions) -> Result<Option<Self>, IoError> {
        let open = || {
            if !may_have_several(path)? {
                return Ok(None);
            }
            let bytes = read_bytes(path, options)?;
            let unpacked = match plain(&bytes, options)? {
                Cow::Borrowed(_) => None,
                Cow::Owned(unpacked) => Some(unpacked),
            };
            let bytes = unpacked.unwrap_or(bytes);
            let Some((format, images, is_cut)) = images(&bytes)? else { return Ok(None) };
            Ok((images > 1 || is_cut).then_some(Self { bytes, format, images, is_cut, options: *options }))
        };
        open().map_err(IoError::at(path))
    }

    /// Returns the number of images.
    pub fn images(&self) -> usize {
        self.images
    }

    /// Returns true if the file is truncated after its last image.
    pub fn is_cut(&self) -> bool {
        self.is_cut
    }

    /// Returns the size of the file in memory, in bytes.
    pub fn bytes(&self) -> usize {
        self.bytes.len()
    }

    /// Decodes an image, counted from 1.
    ///
    /// # Errors
    /// If the image does not exist, is damaged, or exceeds the memory limit.
    pub fn image(&self, image: usize) -> FormatResult<Contents> {
        let options = self.options.with_image(Some(image));
        decode_with(&self.bytes, Some(self.format), &options).map(|(_, contents)| contents)
    }
}

/// Returns true if a file may contain several images, judging by its first bytes. All other files are then read only
/// once.
fn may_have_several(path: &Path) -> FormatResult<bool> {
    const LONGEST: u64 = 6;
    let mut start = Vec::new();
    // A path that is not a file is reported later, when it is read.
    if path.is_file() {
        File::open(path)?.take(LONGEST).read_to_end(&mut start)?;
    }
    let format = Format::of_contents(&start);
    Ok(start.starts_with(GZIP) || matches!(format, Some(Format::DepthTiff | Format::Npy)))
}

/// Returns the format of a file's uncompressed contents, the number of images, and whether images are missing at the
/// end.
fn images(bytes: &[u8]) -> FormatResult<Option<(Format, usize, bool)>> {
    match Format::of_contents(bytes) {
        #[cfg(feature = "tiff")]
        Some(format @ Format::DepthTiff) => {
            let pages = super::depth_tiff::Pages::of(bytes)?;
            Ok(Some((format, pages.offsets.len(), pages.is_cut)))
        }
        #[cfg(feature = "more-formats")]
        Some(format @ Format::Npy) => Ok(Some((format, super::npy::pages(bytes)?, false))),
        _ => Ok(None),
    }
}
