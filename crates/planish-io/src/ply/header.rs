//! The header of a PLY file. Names may be any text without white space, because CloudCompare writes such names.

use std::borrow::Cow;

use super::super::{brief, text_of};
use super::common::malformed;
use crate::FormatResult;
use planish_core::{AttributeValues, FormatError};

/// Maximum size of a header in bytes; real headers have a few hundred bytes.
pub(super) const MAX_BYTES: usize = 64 * 1024;

/// The encoding of the values after the header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Storage {
    Ascii,
    LittleEndian,
    BigEndian,
}

impl Storage {
    const NAMES: [(Self, &'static str); 3] =
        [(Self::Ascii, "ascii"), (Self::LittleEndian, "binary_little_endian"), (Self::BigEndian, "binary_big_endian")];

    pub(super) fn name(self) -> &'static str {
        Self::NAMES.iter().find(|(storage, _)| *storage == self).map_or("", |(_, name)| name)
    }
}

/// The type of a single number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    /// Each type with its two names; the first name is written.
    const NAMES: [(Self, [&'static str; 2]); 8] = [
        (Self::I8, ["char", "int8"]),
        (Self::U8, ["uchar", "uint8"]),
        (Self::I16, ["short", "int16"]),
        (Self::U16, ["ushort", "uint16"]),
        (Self::I32, ["int", "int32"]),
        (Self::U32, ["uint", "uint32"]),
        (Self::F32, ["float", "float32"]),
        (Self::F64, ["double", "float64"]),
    ];

    fn of_name(name: &str) -> Option<Self> {
        Self::NAMES.iter().find(|(_, names)| names.contains(&name)).map(|(scalar, _)| *scalar)
    }

    pub(super) fn name(self) -> &'static str {
        Self::NAMES.iter().find(|(scalar, _)| *scalar == self).map_or("", |(_, [name, _])| name)
    }

    /// Returns the type in which a column's values are written; 64-bit integers are written as double.
    pub(super) fn of_values(values: &AttributeValues) -> Self {
        match values {
            AttributeValues::I8(_) => Self::I8,
            AttributeValues::U8(_) => Self::U8,
            AttributeValues::I16(_) => Self::I16,
            AttributeValues::U16(_) => Self::U16,
            AttributeValues::I32(_) => Self::I32,
            AttributeValues::U32(_) => Self::U32,
            AttributeValues::F32(_) => Self::F32,
            AttributeValues::F64(_) | AttributeValues::I64(_) | AttributeValues::U64(_) => Self::F64,
        }
    }

    /// Returns an empty column of this type.
    pub(super) fn empty(self) -> AttributeValues {
        match self {
            Self::I8 => AttributeValues::I8(Vec::new()),
            Self::U8 => AttributeValues::U8(Vec::new()),
            Self::I16 => AttributeValues::I16(Vec::new()),
            Self::U16 => AttributeValues::U16(Vec::new()),
            Self::I32 => AttributeValues::I32(Vec::new()),
            Self::U32 => AttributeValues::U32(Vec::new()),
            Self::F32 => AttributeValues::F32(Vec::new()),
            Self::F64 => AttributeValues::F64(Vec::new()),
        }
    }

    pub(super) fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// Converts a little-endian value of this type to f64; `None` if `bytes` has the wrong length.
    pub(super) fn number(self, bytes: &[u8]) -> Option<f64> {
        fn value<const N: usize>(bytes: &[u8]) -> Option<[u8; N]> {
            bytes.try_into().ok()
        }
        Some(match self {
            Self::I8 => i8::from_le_bytes(value(bytes)?).into(),
            Self::U8 => u8::from_le_bytes(value(bytes)?).into(),
            Self::I16 => i16::from_le_bytes(value(bytes)?).into(),
            Self::U16 => u16::from_le_bytes(value(bytes)?).into(),
            Self::I32 => i32::from_le_bytes(value(bytes)?).into(),
            Self::U32 => u32::from_le_bytes(value(bytes)?).into(),
            Self::F32 => f32::from_le_bytes(value(bytes)?).into(),
            Self::F64 => f64::from_le_bytes(value(bytes)?),
        })
    }
}

/// The type of a property: a number, or a list of numbers preceded by their count.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Scalar(Scalar),
    List { count: Scalar, item: Scalar },
}

#[derive(Debug, Clone)]
pub(super) struct Property {
    pub(super) name: String,
    pub(super) kind: Kind,
}

#[derive(Debug, Clone)]
pub(super) struct Element {
    pub(super) name: String,
    pub(super) count: usize,
    pub(super) properties: Vec<Property>,
}

impl Element {
    /// Returns true if a property is a list.
    pub(super) fn has_lists(&self) -> bool {
        self.properties.iter().any(|property| matches!(property.kind, Kind::List { .. }))
    }
}

/// The contents of a header.
#[derive(Debug, Clone)]
pub(super) struct Header {
    pub(super) storage: Storage,
    pub(super) elements: Vec<Element>,
    pub(super) comments: Vec<String>,
    pub(super) obj_infos: Vec<String>,
}

impl Header {
    /// Parses the header at the beginning of a file; returns it and its size in bytes.
    pub(super) fn read(bytes: &[u8]) -> FormatResult<(Self, usize)> {
        let mut header = Self { storage: Storage::Ascii, elements: vec![], comments: vec![], obj_infos: vec![] };
        let mut has_format = false;
        for (number, line, end) in lines(bytes) {
            let line = text_of(line);
            let mut words = line.split_ascii_whitespace();
            let keyword = words.next().unwrap_or_default();
            let rest = line.trim_start().get(keyword.len()..).unwrap_or_default().trim();
            let read = match keyword {
                "ply" if number == 1 && rest.is_empty() => Ok(()),
                _ if number == 1 => Err("expected \"ply\" as the first line".to_owned()),
                "end_header" if has_format => return header.checked(end),
                "end_header" => Err("expected a format line before it".to_owned()),
                "" => Ok(()),
                "comment" => {
                    header.comments.push(rest.to_owned());
                    Ok(())
                }
                "obj_info" => {
                    header.obj_infos.push(rest.to_owned());
                    Ok(())
                }
                "format" => storage(rest).map(|storage| {
                    header.storage = storage;
                    has_format = true;
                }),
                "element" => element(rest).map(|element| header.elements.push(element)),
                "property" => property(rest).and_then(|property| match header.elements.last_mut() {
                    Some(element) => {
                        element.properties.push(property);
                        Ok(())
                    }
                    None => Err("expected an element line before it".to_owned()),
                }),
                _ => {
                    Err("unknown keyword; expected format, comment, obj_info, element, property, end_header".to_owned())
                }
            };
            read.map_err(|problem| {
                FormatError::Malformed(format!("line {number} of the PLY header, \"{}\": {problem}", brief(&line)))
            })?;
        }
        malformed("the PLY header has no end: a line \"end_header\" is missing in its first 64 KiB")
    }

    /// Returns the header and its size, or an error if names are repeated or an element has no properties.
    fn checked(self, bytes: usize) -> FormatResult<(Self, usize)> {
        for (k, element) in self.elements.iter().enumerate() {
            if self.elements[..k].iter().any(|other| other.name == element.name) {
                return malformed(format!("two elements of the PLY have the same name, \"{}\"", brief(&element.name)));
            }
            let names = element.properties.iter().map(|property| &property.name).enumerate();
            let repeated =
                |(i, name): &(usize, &String)| element.properties[..*i].iter().any(|other| other.name == **name);
            if let Some((_, name)) = names.clone().find(repeated) {
                return malformed(format!(
                    "two properties of element \"{}\" have the same name, \"{}\"",
                    brief(&element.name),
                    brief(name)
                ));
            }
            if element.properties.is_empty() && (element.count > 0 || element.name == "vertex") {
                return malformed(format!("element \"{}\" has no properties", brief(&element.name)));
            }
        }
        Ok((self, bytes))
    }

    pub(super) fn element(&self, name: &str) -> Option<&Element> {
        self.elements.iter().find(|element| element.name == name)
    }

    /// Encodes the header as text.
    pub(super) fn to_text(&self) -> String {
        let mut text = format!("ply\nformat {} 1.0\n", self.storage.name());
        let mut line = |line: String| {
            text.push_str(&line);
            text.push('\n');
        };
        self.comments.iter().for_each(|comment| line(format!("comment {comment}")));
        self.obj_infos.iter().for_each(|info| line(format!("obj_info {info}")));
        for Element { name, count, properties } in &self.elements {
            line(format!("element {name} {count}"));
            for Property { name, kind } in properties {
                line(match kind {
                    Kind::Scalar(scalar) => format!("property {} {name}", scalar.name()),
                    Kind::List { count, item } => format!("property list {} {} {name}", count.name(), item.name()),
                });
            }
        }
        line("end_header".to_owned());
        text
    }
}

/// Iterates over the lines of a header: their numbers from 1, their bytes, and the offset of the next line. The first
/// line determines the line ending.
fn lines(bytes: &[u8]) -> impl Iterator<Item = (usize, &[u8], usize)> {
    let bytes = &bytes[..bytes.len().min(MAX_BYTES)];
    let first = bytes.iter().position(|byte| matches!(byte, b'\n' | b'\r'));
    let is_old_mac = first.is_some_and(|at| bytes[at] == b'\r' && bytes.get(at + 1) != Some(&b'\n'));
    let end = if is_old_mac { b'\r' } else { b'\n' };
    let mut at = 0;
    (1..).map_while(move |number| {
        let length = bytes[at..].iter().position(|byte| *byte == end)?;
        let line = &bytes[at..at + length];
        at += length + 1;
        Some((number, line, at))
    })
}

fn storage(words: &str) -> Result<Storage, String> {
    let words: Vec<&str> = words.split_ascii_whitespace().collect();
    let found = words.first().and_then(|word| Storage::NAMES.iter().find(|(_, name)| name == word));
    match (found, &words[..]) {
        (Some((storage, _)), [_, version]) if *version == "1.0" => Ok(*storage),
        _ => Err("expected the format ascii, binary_little_endian or binary_big_endian, and version 1.0".to_owned()),
    }
}

fn element(words: &str) -> Result<Element, String> {
    let Some((name, count)) = words.split_once(|c: char| c.is_ascii_whitespace()) else {
        return Err("expected a name and a number of elements".to_owned());
    };
    match count.trim().parse() {
        Ok(count) => Ok(Element { name: name.to_owned(), count, properties: Vec::new() }),
        Err(_) => Err(format!("{} is not a number of elements", super::quoted(count.trim()))),
    }
}

fn property(words: &str) -> Result<Property, String> {
    let scalar = |name: &str| {
        let types = || Scalar::NAMES.iter().flat_map(|(_, names)| *names).collect::<Vec<_>>().join(", ");
        Scalar::of_name(name)
            .ok_or_else(|| format!("{} is not a PLY type; expected one of {}", super::quoted(name), types()))
    };
    let words: Vec<&str> = words.split_ascii_whitespace().collect();
    let (kind, name) = match words[..] {
        ["list", count, item, name] => (Kind::List { count: scalar(count)?, item: scalar(item)? }, name),
        [kind, name] => (Kind::Scalar(scalar(kind)?), name),
        _ => return Err("expected a type and a name without white space".to_owned()),
    };
    if matches!(kind, Kind::List { count: Scalar::F32 | Scalar::F64, .. }) {
        return Err("the count of a list must be an integer type".to_owned());
    }
    Ok(Property { name: name.to_owned(), kind })
}

/// Returns the storage that a header states.
pub(super) fn stated_storage(bytes: &[u8]) -> Option<Storage> {
    lines(bytes).find_map(|(_, line, _)| {
        let line: Cow<'_, str> = text_of(line);
        storage(line.trim().strip_prefix("format ")?).ok()
    })
}
