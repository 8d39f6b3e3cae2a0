//! Reads files as bytes, and checks memory limits.

use std::fs;
use std::io::Read;
use std::path::Path;

use super::{Contents, LengthUnit};
use planish_core::{FormatError, Frame};

/// The path that means standard input.
const STANDARD_INPUT: &str = "-";

pub(crate) type FormatResult<T> = Result<T, FormatError>;

/// Options for reading files.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct ReadOptions {
    /// Memory limit in bytes [default: 2 GiB]. A larger file is rejected before it is read. A file is also rejected
    /// before it is decoded if its decompressed contents plus its columns or pixels would exceed the limit.
    pub max_memory_bytes: u64,
    /// The length unit of points and floating-point depth in files that state no unit [default: metre]. Lengths are
    /// converted to metres.
    pub unit: Option<LengthUnit>,
    /// Number of units per metre of floating-point depth, as an alternative to `unit`.
    pub depth_units_per_metre: Option<f64>,
    /// The number of columns in a lidar's `.bin` file; by default, detected from the values.
    pub columns: Option<usize>,
    /// Number of the image to read, in a TIFF file with several pages or a NumPy array of shape [N, H, W], counted from
    /// 1 [default: 1].
    pub image: Option<usize>,
}

/// An operation to check against the memory limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Work {
    /// Writing points as binary PCD or PLY.
    Convert,
    /// Writing points in another format, encoded in memory first.
    Encode,
    /// Drawing a frame.
    Render,
    /// Drawing an unorganized cloud.
    RenderCloud,
    /// Connecting points to form triangles.
    Mesh,
    /// Connecting points to form triangles, and writing them as text.
    MeshText,
    /// Describing a frame and its sensor.
    Describe,
    /// Removing outliers, cropping or thinning.
    Clean,
    /// Comparing two clouds.
    Compare,
    /// Comparing two depth images of the same size.
    CompareDepth,
    /// Smoothing by any engine.
    Smooth,
    /// Smoothing in a stream or for a recording, while other frames are read and written.
    Stream,
    /// Smoothing and measuring the result.
    Evaluate,
    /// Smoothing by several engines, with timing.
    Bench,
    /// Smoothing up to 32 copies of a frame, with timing.
    BenchCopies,
    /// Merging clouds; the points of all clouds are counted.
    Merge,
    /// Reducing the size of a depth image, cutting its range or removing floating pixels, before smoothing.
    Prepare,
}

/// Returns the number of pixels of a grid, including the engines' margin. In a grid one pixel wide, most pixels belong
/// to the margin.
fn padded_pixels(width: usize, height: usize) -> usize {
    const MARGIN: usize = 8;
    (width + 2 * MARGIN).saturating_mul(height + 2 * MARGIN)
}

/// Peak number of copies of a cloud's fields in memory: the file's bytes, columns, results, encoded results. Measured
/// with LAS fields written as PLY.
const FIELD_COPIES: usize = 4;

impl Work {
    /// Returns the peak memory per point in bytes, including the file's contents. Fields other than positions are not
    /// included. Measured with 36 million pixels of depth, clouds with four million points, and streams that save every
    /// field.
    const fn bytes_per_point(self) -> usize {
        match self {
            Self::Convert => 56,
            Self::Encode => 100,
            Self::Render => 28,
            Self::RenderCloud => 70,
            Self::Mesh => 165,
            Self::MeshText => 270,
            Self::Describe => 64,
            Self::Clean => 100,
            Self::Compare => 110,
            Self::CompareDepth => 30,
            Self::Smooth => 240,
            Self::Stream => 480,
            Self::Evaluate => 240,
            Self::Bench => 760,
            Self::BenchCopies => 1900,
            Self::Merge => 110,
            Self::Prepare => 10,
        }
    }
}

impl Default for ReadOptions {
    fn default() -> Self {
        Self { max_memory_bytes: 2 << 30, unit: None, depth_units_per_metre: None, columns: None, image: None }
    }
}

impl ReadOptions {
    /// Sets the memory limit in bytes.
    pub const fn with_max_memory_bytes(self, max_memory_bytes: u64) -> Self {
        Self { max_memory_bytes, ..self }
    }

    /// Sets the unit of lengths.
    pub const fn with_unit(self, unit: Option<LengthUnit>) -> Self {
        Self { unit, ..self }
    }

    /// Sets the depth units per metre of floating-point depth.
    pub const fn with_depth_units_per_metre(self, depth_units_per_metre: Option<f64>) -> Self {
        Self { depth_units_per_metre, ..self }
    }

    /// Sets the number of columns in a lidar's `.bin` file.
    pub const fn with_columns(self, columns: Option<usize>) -> Self {
        Self { columns, ..self }
    }

    /// Sets the number of the image to read, counted from 1, in a file with several images.
    pub const fn with_image(self, image: Option<usize>) -> Self {
        Self { image, ..self }
    }

    /// Returns the index of the image to read in a file with `images` images, and adds a note about the others.
    ///
    /// # Errors
    /// If the file has fewer images.
    #[cfg_attr(not(any(feature = "more-formats", feature = "tiff")), allow(dead_code))]
    pub(crate) fn image_of(&self, images: usize, notes: &mut Vec<String>) -> FormatResult<usize> {
        let image = self.image.unwrap_or(1);
        match image.checked_sub(1) {
            Some(index) if index < images => {
                if images > 1 {
                    notes.push(format!("the file has {images} images; only image {image} is read"));
                }
                Ok(index)
            }
            _ => {
                let has = if images == 1 { "one image" } else { &format!("{images} images") };
                Err(FormatError::Unsupported(format!("there is no image {image}: the file has {has}, counted from 1")))
            }
        }
    }

    /// Returns an error, before the work begins, if work on `points` points would need more memory than the limit.
    /// `field_bytes` is [`PointCloud::field_bytes_per_point`](planish_core::PointCloud::field_bytes_per_point).
    pub fn check_work(&self, work: Work, points: usize, field_bytes: usize) -> FormatResult<()> {
        self.check(points, work.bytes_per_point() + FIELD_COPIES * field_bytes)
    }

    /// Returns an error, before the work begins, if work on `contents` would need more memory than the limit.
    pub fn check_work_on(&self, work: Work, contents: &Contents) -> FormatResult<()> {
        let is_grid = !matches!(contents, Contents::General(_));
        self.check_work_on_shape(work, contents.shape(), is_grid, contents.field_bytes_per_point())
    }

    /// Returns an error, before the work begins, if work on `frame` would need more memory than the limit.
    /// `field_bytes` is as in [`check_work`](Self::check_work).
    pub fn check_work_on_frame(&self, work: Work, frame: Frame<'_>, field_bytes: usize) -> FormatResult<()> {
        self.check_work_on_shape(work, frame.shape(), frame.grid().is_some(), field_bytes)
    }

    fn check_work_on_shape(
        &self,
        work: Work,
        (width, height): (usize, usize),
        is_grid: bool,
        field_bytes: usize,
    ) -> FormatResult<()> {
        let is_smoothed = matches!(
            work,
            Work::Smooth
                | Work::Stream
                | Work::Evaluate
                | Work::Bench
                | Work::BenchCopies
                | Work::Mesh
                | Work::MeshText
        );
        let points = if is_grid && is_smoothed { padded_pixels(width, height) } else { width.saturating_mul(height) };
        self.check_work(work, points, field_bytes)
    }

    /// Calls `decode` with the memory limit reduced by `used` bytes. Errors state the full limit.
    pub fn beside<T>(&self, used: usize, decode: impl FnOnce(&Self) -> FormatResult<T>) -> FormatResult<T> {
        let used = used as u64;
        let left = self.with_max_memory_bytes(self.max_memory_bytes.saturating_sub(used));
        decode(&left).map_err(|error| match error {
            FormatError::TooLarge { needed, .. } => {
                FormatError::TooLarge { needed: needed.saturating_add(used), allowed: self.max_memory_bytes }
            }
            error => error,
        })
    }

    /// Returns an error if `count` items of `bytes_each` bytes exceed the limit.
    pub fn check(&self, count: usize, bytes_each: usize) -> FormatResult<()> {
        let (needed, allowed) = (count as u64 as u128 * bytes_each as u128, self.max_memory_bytes);
        if needed <= u128::from(allowed) {
            return Ok(());
        }
        Err(FormatError::TooLarge { needed: u64::try_from(needed).unwrap_or(u64::MAX), allowed })
    }
}

/// Reads the bytes of a regular file, or of standard input if the path is `-`.
pub fn read_bytes(path: &Path, options: &ReadOptions) -> FormatResult<Vec<u8>> {
    let most = options.max_memory_bytes;
    let mut bytes = Vec::new();
    if path == Path::new(STANDARD_INPUT) {
        std::io::stdin().lock().take(most.saturating_add(1)).read_to_end(&mut bytes)?;
        options.check(bytes.len(), 1)?;
        return Ok(bytes);
    }
    // Query the metadata before opening the file, since opening a pipe waits for its other end.
    let metadata = fs::metadata(path)?;
    if metadata.is_dir() {
        return Err(FormatError::Unsupported("the path is a folder; expected a file".into()));
    }
    if !metadata.is_file() {
        return Err(FormatError::Unsupported(
            "the path is a pipe or a device; expected a regular file, or - for standard input".into(),
        ));
    }
    options.check(usize::try_from(metadata.len()).unwrap_or(usize::MAX), 1)?;
    fs::File::open(path)?.take(most).read_to_end(&mut bytes)?;
    Ok(bytes)
}
