//! Depth images: `Image` in 16UC1, mono16 and 32FC1, and `CompressedImage` of the transport `compressedDepth`.
//!
//! 16-bit depth is in millimetres, with 0 for holes; floating-point depth is in metres, with non-finite values for
//! holes (REP 118). A compressedDepth image begins with 12 bytes: a format, and the parameters A and B of the
//! quantization q = A/z + B of floating-point depth. A 16-bit PNG or RVL data follow.

use super::{CompressedImage, Header, Image, rvl};
use planish_core::{DepthImage, FormatError, validate_shape};
use planish_io::{ReadOptions, internal::decode_depth_png, internal::encode_depth_png, internal::quoted};

/// Size in bytes of the format, A and B before a compressed depth image.
const CONFIGURATION_BYTES: usize = 12;

/// A depth image extracted from its message.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum DepthPixels {
    /// Millimetres; 0 and 65535 are holes.
    Millimetres(DepthImage),
    /// Metres; values that are not finite or not positive are holes.
    Metres {
        /// Number of columns.
        width: usize,
        /// Number of rows.
        height: usize,
        /// Depth in metres, row by row.
        depth_m: Vec<f32>,
    },
}

impl DepthPixels {
    /// Returns width and height in pixels.
    pub fn shape(&self) -> (usize, usize) {
        match self {
            Self::Millimetres(image) => (image.width, image.height),
            Self::Metres { width, height, .. } => (*width, *height),
        }
    }
}

/// A depth image message, which can be copied with other depth.
#[derive(Debug, Clone, PartialEq)]
pub enum DepthMessage {
    /// An uncompressed image.
    Image(Image),
    /// An image compressed by the transport `compressedDepth`.
    Compressed(CompressedImage),
}

impl DepthMessage {
    /// Returns the header: timestamp and coordinate frame.
    pub fn header(&self) -> &Header {
        match self {
            Self::Image(image) => &image.header,
            Self::Compressed(image) => &image.header,
        }
    }

    /// Extracts the depth.
    ///
    /// # Errors
    /// If the encoding is not a depth encoding, or the data contradict it.
    pub fn pixels(&self, options: &ReadOptions) -> Result<DepthPixels, FormatError> {
        match self {
            Self::Image(image) => image_pixels(image, options),
            Self::Compressed(image) => compressed_pixels(image, options),
        }
    }

    /// Returns a copy of the message with other depth of the same type and shape.
    pub fn with_pixels(&self, pixels: &DepthPixels) -> Result<Self, FormatError> {
        match self {
            Self::Image(image) => Ok(Self::Image(with_image_pixels(image, pixels))),
            Self::Compressed(image) => Ok(Self::Compressed(with_compressed_pixels(image, pixels)?)),
        }
    }
}

impl Image {
    /// Creates a depth image in millimetres (16UC1) or metres (32FC1).
    pub fn of_depth(header: Header, pixels: &DepthPixels) -> Self {
        let (width, height) = pixels.shape();
        let (encoding, bytes) = match pixels {
            DepthPixels::Millimetres(_) => ("16UC1", 2),
            DepthPixels::Metres { .. } => ("32FC1", 4),
        };
        Self {
            header,
            height: height as u32,
            width: width as u32,
            encoding: encoding.into(),
            is_bigendian: 0,
            step: (bytes * width) as u32,
            data: row_bytes(pixels, false),
        }
    }

    /// Returns true if the encoding is 16UC1 or 32FC1; mono16 does not count, since it may be an infrared image.
    pub fn is_depth(&self) -> bool {
        matches!(self.encoding.as_str(), "16UC1" | "32FC1")
    }
}

/// Returns the bytes of an image's rows, without padding between them.
fn row_bytes(pixels: &DepthPixels, is_bigendian: bool) -> Vec<u8> {
    match (pixels, is_bigendian) {
        (DepthPixels::Millimetres(image), false) => image.raw.iter().flat_map(|raw| raw.to_le_bytes()).collect(),
        (DepthPixels::Millimetres(image), true) => image.raw.iter().flat_map(|raw| raw.to_be_bytes()).collect(),
        (DepthPixels::Metres { depth_m, .. }, false) => depth_m.iter().flat_map(|z| z.to_le_bytes()).collect(),
        (DepthPixels::Metres { depth_m, .. }, true) => depth_m.iter().flat_map(|z| z.to_be_bytes()).collect(),
    }
}

fn image_pixels(image: &Image, options: &ReadOptions) -> Result<DepthPixels, FormatError> {
    let (width, height, step) = (image.width as usize, image.height as usize, image.step as usize);
    validate_shape(width, height)?;
    let bytes = match image.encoding.as_str() {
        "16UC1" | "mono16" => 2,
        "32FC1" => 4,
        other => {
            return Err(FormatError::Unsupported(format!(
                "unsupported image encoding {}; depth must be 16UC1 (millimetres) or 32FC1 (metres)",
                quoted(other)
            )));
        }
    };
    let (row, needed) = (bytes * width, step as u64 * (height as u64 - 1) + (bytes * width) as u64);
    if step < row || (image.data.len() as u64) < needed {
        return Err(FormatError::Malformed(format!(
            "an image of {width}x{height} in {} has {} bytes with {step} per row; expected at least {needed} with \
             {row} per row",
            image.encoding,
            image.data.len()
        )));
    }
    options.check(width * height, bytes)?;
    let rows = image.data.chunks(step).take(height).map(|bytes| &bytes[..row]);
    let is_bigendian = image.is_bigendian != 0;
    Ok(if bytes == 2 {
        let value = if is_bigendian { u16::from_be_bytes } else { u16::from_le_bytes };
        let raw = rows.flat_map(|row| row.as_chunks::<2>().0).map(|&bytes| value(bytes)).collect();
        DepthPixels::Millimetres(DepthImage { width, height, raw })
    } else {
        let value = if is_bigendian { f32::from_be_bytes } else { f32::from_le_bytes };
        let depth_m = rows.flat_map(|row| row.as_chunks::<4>().0).map(|&bytes| value(bytes)).collect();
        DepthPixels::Metres { width, height, depth_m }
    })
}

/// Returns a copy of an image with other pixels. Padding at the end of its rows is unchanged.
fn with_image_pixels(image: &Image, pixels: &DepthPixels) -> Image {
    let bytes = row_bytes(pixels, image.is_bigendian != 0);
    let row = bytes.len() / pixels.shape().1.max(1);
    let mut data = image.data.clone();
    for (to, from) in data.chunks_mut(image.step.max(1) as usize).zip(bytes.chunks(row.max(1))) {
        let len = to.len().min(from.len());
        to[..len].copy_from_slice(&from[..len]);
    }
    Image { data, ..image.clone() }
}

/// Compression of the 16-bit integers in a compressed depth image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Code {
    Png,
    Rvl,
}

impl Code {
    fn decode(self, bytes: &[u8], options: &ReadOptions) -> Result<DepthImage, FormatError> {
        match self {
            Self::Png => decode_depth_png(bytes, options),
            Self::Rvl => rvl::decode(bytes, options),
        }
    }

    fn encode(self, image: &DepthImage) -> Result<Vec<u8>, FormatError> {
        match self {
            Self::Png => encode_depth_png(image),
            Self::Rvl => Ok(rvl::encode(image)),
        }
    }
}

/// The parameters of a compressed depth image, and its encoded pixels.
struct Compressed<'a> {
    is_metres: bool,
    configuration: &'a [u8; CONFIGURATION_BYTES],
    quantization: [f32; 2],
    code: Code,
    bytes: &'a [u8],
}

impl<'a> Compressed<'a> {
    fn of(image: &'a CompressedImage) -> Result<Self, FormatError> {
        let (encoding, transport) = image.format.split_once(';').unwrap_or((&image.format, ""));
        let code = match transport.trim() {
            "compressedDepth" | "compressedDepth png" => Code::Png,
            "compressedDepth rvl" => Code::Rvl,
            transport if transport.starts_with("compressedDepth") => {
                return Err(FormatError::Unsupported(format!(
                    "unsupported depth format {}; only compressedDepth with PNG or RVL is supported (set the parameter \
                     `format` of the transport to png)",
                    quoted(&image.format)
                )));
            }
            _ => return Err(not_compressed_depth(image)),
        };
        let is_metres = match encoding.trim() {
            "16UC1" | "mono16" => false,
            "32FC1" => true,
            _ => return Err(not_compressed_depth(image)),
        };
        let Some((configuration, bytes)) = image.data.split_first_chunk::<CONFIGURATION_BYTES>() else {
            let bytes = image.data.len();
            return Err(FormatError::Malformed(format!(
                "the compressed depth image has only {bytes} bytes and lacks its header"
            )));
        };
        let [_, _, _, _, a @ ..] = *configuration;
        let [a0, a1, a2, a3, b0, b1, b2, b3] = a;
        let quantization = [f32::from_le_bytes([a0, a1, a2, a3]), f32::from_le_bytes([b0, b1, b2, b3])];
        Ok(Self { is_metres, configuration, quantization, code, bytes })
    }
}

fn not_compressed_depth(image: &CompressedImage) -> FormatError {
    FormatError::Unsupported(format!(
        "unsupported image format {}; expected compressed depth (16UC1 or 32FC1; compressedDepth png or rvl)",
        quoted(&image.format)
    ))
}

fn compressed_pixels(image: &CompressedImage, options: &ReadOptions) -> Result<DepthPixels, FormatError> {
    let compressed = Compressed::of(image)?;
    let image = compressed.code.decode(compressed.bytes, options)?;
    if !compressed.is_metres {
        return Ok(DepthPixels::Millimetres(image));
    }
    let [a, b] = compressed.quantization;
    let metres = |&q: &u16| if q == 0 { f32::NAN } else { a / (f32::from(q) - b) };
    let depth_m = image.raw.iter().map(metres).collect();
    Ok(DepthPixels::Metres { width: image.width, height: image.height, depth_m })
}

fn with_compressed_pixels(message: &CompressedImage, pixels: &DepthPixels) -> Result<CompressedImage, FormatError> {
    let compressed = Compressed::of(message)?;
    let [a, b] = compressed.quantization;
    let code = match pixels {
        DepthPixels::Millimetres(image) => compressed.code.encode(image)?,
        DepthPixels::Metres { width, height, depth_m } => {
            let quantized = |&z: &f32| {
                let q = (a / z + b).round();
                // False for holes, which are NaN.
                if z > 0.0 && q >= 1.0 && q <= f32::from(u16::MAX) { q as u16 } else { 0 }
            };
            let raw = depth_m.iter().map(quantized).collect();
            compressed.code.encode(&DepthImage { width: *width, height: *height, raw })?
        }
    };
    let data = [&compressed.configuration[..], &code].concat();
    Ok(CompressedImage { data, ..message.clone() })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options() -> ReadOptions {
        ReadOptions::default().with_max_memory_bytes(1 << 20)
    }

    fn millimetres() -> DepthPixels {
        DepthPixels::Millimetres(DepthImage { width: 3, height: 2, raw: vec![1, 0, 1500, 65535, 4000, 258] })
    }

    fn metres() -> DepthPixels {
        DepthPixels::Metres { width: 3, height: 2, depth_m: vec![1.0, 0.5, 1.5, 2.0, 4.0, 8.0] }
    }

    #[test]
    fn pixels_come_back_from_images_of_either_byte_order_with_padded_rows() {
        for pixels in [millimetres(), metres()] {
            for is_bigendian in [0, 1] {
                let image = Image::of_depth(Header::default(), &pixels);
                let row = image.step as usize;
                let swapped = row_bytes(&pixels, is_bigendian != 0);
                // Four bytes of padding after each row.
                let data: Vec<u8> = swapped.chunks(row).flat_map(|row| [row, &[9; 4]].concat()).collect();
                let padded = Image { data, step: image.step + 4, is_bigendian, ..image };
                let message = DepthMessage::Image(padded.clone());
                assert_eq!(message.pixels(&options()).unwrap(), pixels);
                assert_eq!(message.with_pixels(&pixels).unwrap(), message);
                // The last row may lack its padding.
                let cut = Image { data: padded.data[..2 * row + 4].to_vec(), ..padded.clone() };
                assert_eq!(DepthMessage::Image(cut).pixels(&options()).unwrap(), pixels);
                let short = Image { data: padded.data[..2 * row + 3].to_vec(), ..padded };
                assert!(DepthMessage::Image(short).pixels(&options()).is_err());
            }
        }
    }

    #[test]
    fn compressed_depth_comes_back_as_its_format_says() {
        let empty = |format: &str, [a, b]: [f32; 2]| {
            let data = [&[0; 4][..], &a.to_le_bytes(), &b.to_le_bytes()].concat();
            DepthMessage::Compressed(CompressedImage { format: format.into(), data, ..CompressedImage::default() })
        };
        for format in ["16UC1; compressedDepth png", "16UC1; compressedDepth rvl"] {
            let message = empty(format, [0.0; 2]).with_pixels(&millimetres()).unwrap();
            assert_eq!(message.pixels(&options()).unwrap(), millimetres());
        }
        // The transport's defaults: depth_quantization 100, depth_max 10.
        let (a, b) = (100.0 * 101.0, 1.0 - 100.0 * 101.0 / 10.0);
        let message = empty("32FC1; compressedDepth", [a, b]).with_pixels(&metres()).unwrap();
        let (DepthPixels::Metres { depth_m, .. }, DepthPixels::Metres { depth_m: expected, .. }) =
            (message.pixels(&options()).unwrap(), metres())
        else {
            panic!("metres");
        };
        for (z, expected) in depth_m.iter().zip(expected) {
            assert!((z - expected).abs() < expected * expected / a, "{z} {expected}");
        }
        for (format, text) in
            [("16UC1; compressedDepth jxl", "png"), ("rgb8; jpeg compressed bgr8", "expected compressed depth")]
        {
            let error = empty(format, [0.0; 2]).pixels(&options()).unwrap_err().to_string();
            assert!(error.contains(text), "{error}");
        }
    }

    #[test]
    fn images_that_are_no_depth_or_lie_about_their_size_are_refused() {
        let image = Image::of_depth(Header::default(), &millimetres());
        let refused = |image: Image| DepthMessage::Image(image).pixels(&options()).unwrap_err().to_string();
        assert!(refused(Image { encoding: "rgb8".into(), ..image.clone() }).contains("16UC1"));
        assert!(refused(Image { step: 5, ..image.clone() }).contains("6 per row"));
        assert!(refused(Image { height: u32::MAX, ..image.clone() }).contains("pixels"));
        assert!(refused(Image { width: 0, ..image }).contains("0x2"));
    }
}
