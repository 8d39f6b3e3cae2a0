//! The header of a PCD file: parsed as untrusted input, and written in the order that the format prescribes.

use std::fmt::Write;

use crate::{Encoding, quoted};
use planish_core::{Attribute, AttributeValues, FormatError, MAX_PIXELS, SensorPose};

impl Encoding {
    pub(super) fn keyword(self) -> &'static str {
        match self {
            Self::Ascii => "ascii",
            Self::Binary => "binary",
            Self::BinaryCompressed => "binary_compressed",
        }
    }
}

/// Maximum size of a header in bytes; real headers have a few hundred bytes.
const MAX_HEADER_BYTES: usize = 64 * 1024;

/// The TYPE and SIZE of a field's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    I16,
    I32,
    I64,
    U8,
    U16,
    U32,
    U64,
    F32,
    F64,
}

impl Scalar {
    fn parse(kind: &str, size: &str) -> Option<Self> {
        Some(match (kind, size) {
            ("I", "1") => Self::I8,
            ("I", "2") => Self::I16,
            ("I", "4") => Self::I32,
            ("I", "8") => Self::I64,
            ("U", "1") => Self::U8,
            ("U", "2") => Self::U16,
            ("U", "4") => Self::U32,
            ("U", "8") => Self::U64,
            ("F", "4") => Self::F32,
            ("F", "8") => Self::F64,
            _ => return None,
        })
    }

    fn of(values: &AttributeValues) -> Self {
        match values {
            AttributeValues::I8(_) => Self::I8,
            AttributeValues::I16(_) => Self::I16,
            AttributeValues::I32(_) => Self::I32,
            AttributeValues::I64(_) => Self::I64,
            AttributeValues::U8(_) => Self::U8,
            AttributeValues::U16(_) => Self::U16,
            AttributeValues::U32(_) => Self::U32,
            AttributeValues::U64(_) => Self::U64,
            AttributeValues::F32(_) => Self::F32,
            AttributeValues::F64(_) => Self::F64,
        }
    }

    fn kind(self) -> char {
        match self {
            Self::I8 | Self::I16 | Self::I32 | Self::I64 => 'I',
            Self::U8 | Self::U16 | Self::U32 | Self::U64 => 'U',
            Self::F32 | Self::F64 => 'F',
        }
    }

    pub(super) fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }
}

/// An entry of FIELDS, with its SIZE, TYPE and COUNT.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Field {
    pub(super) name: String,
    pub(super) scalar: Scalar,
    pub(super) count: usize,
}

impl Field {
    pub(super) fn of(column: &Attribute) -> Result<Self, FormatError> {
        if column.name.is_empty() || column.name.contains(char::is_whitespace) {
            return Err(FormatError::Unsupported(format!(
                "the field name {:?} is empty or has spaces; rename it for PCD",
                column.name
            )));
        }
        Ok(Self { name: column.name.clone(), scalar: Scalar::of(&column.values), count: column.count })
    }

    pub(super) fn empty_column(&self) -> Attribute {
        let values = match self.scalar {
            Scalar::I8 => AttributeValues::I8(Vec::new()),
            Scalar::I16 => AttributeValues::I16(Vec::new()),
            Scalar::I32 => AttributeValues::I32(Vec::new()),
            Scalar::I64 => AttributeValues::I64(Vec::new()),
            Scalar::U8 => AttributeValues::U8(Vec::new()),
            Scalar::U16 => AttributeValues::U16(Vec::new()),
            Scalar::U32 => AttributeValues::U32(Vec::new()),
            Scalar::U64 => AttributeValues::U64(Vec::new()),
            Scalar::F32 => AttributeValues::F32(Vec::new()),
            Scalar::F64 => AttributeValues::F64(Vec::new()),
        };
        Attribute { name: self.name.clone(), count: self.count, values }
    }

    /// Returns the size of the field per point, in bytes.
    pub(super) fn bytes(&self) -> usize {
        self.count * self.scalar.size()
    }
}

/// A checked header. It describes `width * height` points, and this product does not overflow.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Header {
    pub(super) fields: Vec<Field>,
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) viewpoint: [f64; 7],
    pub(super) encoding: Encoding,
}

impl Header {
    pub(super) fn points(&self) -> usize {
        self.width * self.height
    }

    /// Returns the size of a point in a binary file, in bytes.
    pub(super) fn point_bytes(&self) -> usize {
        self.fields.iter().map(Field::bytes).sum()
    }

    /// Parses the header; returns it and the body that follows it.
    pub(super) fn parse(bytes: &[u8]) -> Result<(Self, &[u8]), FormatError> {
        let mut entries = Entries::default();
        let mut rest = bytes;
        loop {
            let end = rest.iter().take(MAX_HEADER_BYTES).position(|&byte| byte == b'\n');
            let Some(end) = end else {
                return malformed(
                    "the PCD header has no end: a line \"DATA ascii|binary|binary_compressed\" is missing",
                );
            };
            let (line, after) = (&rest[..end], &rest[end + 1..]);
            rest = after;
            if bytes.len() - rest.len() > MAX_HEADER_BYTES {
                return malformed("the PCD header is over 64 KiB long; this is not a PCD file");
            }
            // A comment may be in any encoding.
            let line = line.split(|byte| *byte == b'#').next().unwrap_or_default();
            let Ok(line) = std::str::from_utf8(line) else {
                return malformed("the PCD header is not text; this is not a PCD file");
            };
            let mut words = line.split_ascii_whitespace();
            let Some(key) = words.next() else { continue };
            let values: Vec<&str> = words.collect();
            if entries.set(key, values)? {
                return Ok((entries.check()?, rest));
            }
        }
    }

    /// Returns the header as text, up to and including the DATA line.
    pub(super) fn text(&self) -> String {
        let mut text = String::from("# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n");
        let mut line = |key: &str, values: &mut dyn Iterator<Item = String>| {
            text.push_str(key);
            for value in values {
                text.push(' ');
                text.push_str(&value);
            }
            text.push('\n');
        };
        line("FIELDS", &mut self.fields.iter().map(|field| field.name.clone()));
        line("SIZE", &mut self.fields.iter().map(|field| field.scalar.size().to_string()));
        line("TYPE", &mut self.fields.iter().map(|field| field.scalar.kind().to_string()));
        line("COUNT", &mut self.fields.iter().map(|field| field.count.to_string()));
        line("WIDTH", &mut std::iter::once(self.width.to_string()));
        line("HEIGHT", &mut std::iter::once(self.height.to_string()));
        line("VIEWPOINT", &mut self.viewpoint.iter().map(f64::to_string));
        // Writing to a String cannot fail.
        let _ = writeln!(text, "POINTS {}\nDATA {}", self.points(), self.encoding.keyword());
        text
    }
}

/// The entries of a header, before they are checked against each other.
#[derive(Default)]
struct Entries<'a> {
    fields: Vec<&'a str>,
    sizes: Vec<&'a str>,
    kinds: Vec<&'a str>,
    counts: Option<Vec<&'a str>>,
    width: Option<usize>,
    height: Option<usize>,
    points: Option<usize>,
    viewpoint: Option<[f64; 7]>,
    encoding: Encoding,
}

impl<'a> Entries<'a> {
    /// Parses one line; returns true if it is the last one, DATA.
    fn set(&mut self, key: &str, values: Vec<&'a str>) -> Result<bool, FormatError> {
        match key {
            "VERSION" => {
                // Older versions lack the line COUNT or VIEWPOINT.
                if !matches!(values[..], ["0.7" | ".7" | "0.6" | ".6" | "0.5" | ".5"]) {
                    let version = quoted(&values.join(" "));
                    return malformed(format!("unsupported PCD version {version}; expected 0.5, 0.6 or 0.7"));
                }
            }
            // Versions up to 0.5 call the fields COLUMNS.
            "FIELDS" | "COLUMNS" => self.fields = values,
            "SIZE" => self.sizes = values,
            "TYPE" => self.kinds = values,
            "COUNT" => self.counts = Some(values),
            "WIDTH" => self.width = Some(number("WIDTH", &values)?),
            "HEIGHT" => self.height = Some(number("HEIGHT", &values)?),
            "POINTS" => self.points = Some(number("POINTS", &values)?),
            "VIEWPOINT" => {
                let parsed: Option<Vec<f64>> = values.iter().map(|value| value.parse().ok()).collect();
                self.viewpoint = parsed.and_then(|values| values.try_into().ok());
                if self.viewpoint.is_none() {
                    let stated = quoted(&values.join(" "));
                    return malformed(format!("VIEWPOINT {stated} is invalid; expected 7 numbers: x y z qw qx qy qz"));
                }
            }
            "DATA" => {
                let stated = values.join(" ").to_ascii_lowercase();
                self.encoding = match stated.as_str() {
                    "ascii" => Encoding::Ascii,
                    "binary" => Encoding::Binary,
                    "binary_compressed" => Encoding::BinaryCompressed,
                    _ => {
                        return malformed(format!(
                            "unknown DATA {}; expected ascii, binary or binary_compressed",
                            quoted(&values.join(" "))
                        ));
                    }
                };
                return Ok(true);
            }
            _ => return malformed(format!("{} is not an entry of a PCD header", quoted(key))),
        }
        Ok(false)
    }

    fn check(self) -> Result<Header, FormatError> {
        let n = self.fields.len();
        if n == 0 {
            return malformed("the PCD header has no FIELDS");
        }
        let counts = self.counts.unwrap_or_else(|| vec!["1"; n]);
        for (key, len) in [("SIZE", self.sizes.len()), ("TYPE", self.kinds.len()), ("COUNT", counts.len())] {
            if len != n {
                return malformed(format!("{key} has {len} entries for {n} FIELDS"));
            }
        }
        let mut fields = Vec::with_capacity(n);
        for (i, &count) in counts.iter().enumerate() {
            let Some(scalar) = Scalar::parse(self.kinds[i], self.sizes[i]) else {
                return malformed(format!(
                    "field {} has TYPE {} and SIZE {}; expected SIZE 1, 2, 4 or 8 for I and U, 4 or 8 for F",
                    quoted(self.fields[i]),
                    quoted(self.kinds[i]),
                    quoted(self.sizes[i])
                ));
            };
            let count = number("COUNT", &[count])?;
            if count > 1 << 20 {
                return malformed(format!("field {} has COUNT {count}; expected at most 2^20", quoted(self.fields[i])));
            }
            // Skip fields without values.
            if count == 0 {
                continue;
            }
            // Padding may occur more than once.
            if self.fields[i] != "_" && self.fields[..i].contains(&self.fields[i]) {
                return malformed(format!("two FIELDS have the name {}", quoted(self.fields[i])));
            }
            fields.push(Field { name: self.fields[i].to_owned(), scalar, count });
        }
        let (width, height) = match (self.width, self.height, self.points) {
            (Some(width), Some(height), _) => (width, height),
            (Some(width), None, _) => (width, 1),
            (None, _, Some(points)) => (points, 1),
            (None, _, None) => return malformed("the PCD header has neither WIDTH nor POINTS"),
        };
        let points = width.checked_mul(height).filter(|&points| points <= MAX_PIXELS);
        let Some(points) = points else {
            return malformed(format!("{width} x {height} points exceed the limit of 2^28"));
        };
        if let Some(stated) = self.points
            && stated != points
        {
            return malformed(format!("POINTS is {stated}, but WIDTH x HEIGHT is {width} x {height} = {points}"));
        }
        let viewpoint = self.viewpoint.unwrap_or(SensorPose::IDENTITY.viewpoint());
        Ok(Header { fields, width, height, viewpoint, encoding: self.encoding })
    }
}

fn number(key: &str, values: &[&str]) -> Result<usize, FormatError> {
    match values {
        [value] => value.parse().ok(),
        _ => None,
    }
    .ok_or_else(|| {
        FormatError::Malformed(format!("{key} {} is invalid; expected one whole number", quoted(&values.join(" "))))
    })
}

fn malformed<T>(text: impl Into<String>) -> Result<T, FormatError> {
    Err(FormatError::Malformed(text.into()))
}
