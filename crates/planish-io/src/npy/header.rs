//! The header of a NumPy array: `{'descr': '<f4', 'fortran_order': False, 'shape': (480, 640), }`.

use crate::quoted;
use planish_core::FormatError;

const MAGIC: &[u8] = b"\x93NUMPY";

/// Maximum size of a header in bytes; NumPy writes about 100 bytes.
const MAX_BYTES: usize = 16 * 1024;

/// Maximum number of dimensions, the same as NumPy's limit.
const MAX_DIMENSIONS: usize = 64;

/// Alignment of the values within a file, in bytes.
const ALIGNMENT: usize = 64;

/// The element type and shape of an array.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Header {
    /// Type of the values in NumPy's notation, such as `<f4`; `records` for an array of records.
    pub(crate) descr: String,
    /// Letter for the type of the values: `b` for booleans, `i` and `u` for integers, `f` for floats, `V` for records.
    pub(crate) kind: char,
    /// Size of a value in bytes.
    pub(crate) size: usize,
    pub(super) is_big_endian: bool,
    /// True if the first index varies fastest instead of the last.
    pub(super) is_fortran: bool,
    pub(crate) shape: Vec<usize>,
    /// The fields of each record, if `kind` is `V`; otherwise empty.
    pub(super) fields: Vec<RecordField>,
}

/// A named field of a record, which contains one or several numbers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct RecordField {
    pub(super) name: String,
    pub(super) kind: char,
    /// Size of a number in bytes.
    pub(super) size: usize,
    /// Number of numbers in the field.
    pub(super) count: usize,
    pub(super) is_big_endian: bool,
}

impl RecordField {
    /// Parses a type in NumPy's notation, such as `<f4`; `None` if it is neither a number nor padding.
    fn of(name: &str, descr: &str, count: usize) -> Option<Self> {
        let (order, of_value) = match descr.as_bytes() {
            [order @ (b'<' | b'>' | b'|' | b'='), rest @ ..] => (*order, rest),
            rest => (b'|', rest),
        };
        let [kind @ (b'b' | b'i' | b'u' | b'f' | b'c' | b'V'), digits @ ..] = of_value else { return None };
        let size: usize = std::str::from_utf8(digits).ok()?.parse().ok()?;
        let kind = char::from(*kind);
        let is_number = kind != 'V' && (1..=32).contains(&size) || kind == 'V' && (1..=MAX_BYTES).contains(&size);
        is_number.then(|| Self { name: name.to_owned(), kind, size, count, is_big_endian: order == b'>' })
    }

    /// Returns the size of the field within a record, in bytes.
    pub(super) fn bytes(&self) -> usize {
        self.size * self.count
    }
}

fn damaged(expected: &str) -> FormatError {
    FormatError::Malformed(format!("damaged NPY header: expected {expected}"))
}

fn cut() -> FormatError {
    FormatError::Malformed("the file is truncated within its NPY header".into())
}

impl Header {
    /// Parses the header; returns it and the bytes that follow it.
    pub(super) fn parse(bytes: &[u8]) -> Result<(Self, &[u8]), FormatError> {
        let rest = bytes.strip_prefix(MAGIC).ok_or_else(|| damaged("\\x93NUMPY at the beginning"))?;
        let (stated, rest) = match rest {
            [1, _, a, b, rest @ ..] => (usize::from(u16::from_le_bytes([*a, *b])), rest),
            [2 | 3, _, a, b, c, d, rest @ ..] => (u32::from_le_bytes([*a, *b, *c, *d]) as usize, rest),
            [1..=3, ..] | [] => return Err(cut()),
            _ => return Err(FormatError::Unsupported("unknown NPY version; expected 1, 2 or 3".into())),
        };
        if stated > MAX_BYTES {
            let problem = format!("an NPY header of {stated} bytes is too long for an array of numbers");
            return Err(FormatError::Malformed(problem));
        }
        let (dict, data) = rest.split_at_checked(stated).ok_or_else(cut)?;
        Ok((Dict(dict).header()?, data))
    }

    /// Returns the number of values in the array; `None` if it overflows.
    pub(crate) fn len(&self) -> Option<usize> {
        self.shape.iter().try_fold(1usize, |product, &n| product.checked_mul(n))
    }

    /// Encodes a version 1 header, for a shape with few dimensions.
    pub(super) fn encode(descr: &str, shape: &[usize]) -> Vec<u8> {
        let numbers: Vec<String> = shape.iter().map(usize::to_string).collect();
        let comma = if shape.len() == 1 { "," } else { "" };
        let shape = format!("({}{comma})", numbers.join(", "));
        let mut dict = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}");
        let before = MAGIC.len() + 4;
        let padded = (before + dict.len() + 1).next_multiple_of(ALIGNMENT);
        dict.extend(std::iter::repeat_n(' ', padded - before - dict.len() - 1));
        dict.push('\n');
        let mut bytes = [MAGIC, &[1, 0]].concat();
        bytes.extend((dict.len() as u16).to_le_bytes());
        bytes.extend(dict.bytes());
        bytes
    }
}

/// The type of the values: a number, or a record of numbers.
enum Descr<'a> {
    Number(&'a str),
    Records(Vec<RecordField>),
}

/// The part of the header's dict that is not parsed yet.
struct Dict<'a>(&'a [u8]);

impl<'a> Dict<'a> {
    fn header(mut self) -> Result<Header, FormatError> {
        let (mut descr, mut is_fortran, mut shape) = (None, None, None);
        self.require(b'{')?;
        while !self.eat(b'}') {
            let key = self.text()?;
            self.require(b':')?;
            match key {
                "descr" if descr.is_none() => descr = Some(self.descr()?),
                "fortran_order" if is_fortran.is_none() => is_fortran = Some(self.boolean()?),
                "shape" if shape.is_none() => shape = Some(self.shape()?),
                _ => return Err(damaged("'descr', 'fortran_order' and 'shape', each once")),
            }
            if !self.eat(b',') {
                self.require(b'}')?;
                break;
            }
        }
        self.skip_blanks();
        let (Some(descr), Some(is_fortran), Some(shape), []) = (descr, is_fortran, shape, self.0) else {
            return Err(damaged("a dict of 'descr', 'fortran_order' and 'shape', and nothing after it"));
        };
        match descr {
            Descr::Number(descr) => {
                let field = RecordField::of("", descr, 1).filter(|field| field.kind != 'V').ok_or_else(|| {
                    let text = format!("the array has the type {}; expected integers or floats", quoted(descr));
                    FormatError::Unsupported(text)
                })?;
                let RecordField { kind, size, is_big_endian, .. } = field;
                Ok(Header { descr: descr.to_owned(), kind, size, is_big_endian, is_fortran, shape, fields: Vec::new() })
            }
            Descr::Records(fields) => {
                let size = fields.iter().map(RecordField::bytes).sum();
                let descr = "records".to_owned();
                Ok(Header { descr, kind: 'V', size, is_big_endian: false, is_fortran, shape, fields })
            }
        }
    }

    fn descr(&mut self) -> Result<Descr<'a>, FormatError> {
        if !self.eat(b'[') {
            return self.text().map(Descr::Number);
        }
        if cfg!(not(feature = "more-formats")) {
            let text = "the array has records, which need planish's feature `more-formats`";
            return Err(FormatError::Unsupported(text.into()));
        }
        let mut fields = Vec::new();
        while !self.eat(b']') {
            self.require(b'(')?;
            let name = self.text()?;
            self.require(b',')?;
            let descr = self.text()?;
            let shape = if self.eat(b',') && !self.is_at(b')') { self.shape()? } else { Vec::new() };
            self.eat(b',');
            self.require(b')')?;
            let count = shape.iter().try_fold(1usize, |product, &n| product.checked_mul(n));
            let count = count.filter(|count| (1..=MAX_BYTES).contains(count));
            let field = count.and_then(|count| RecordField::of(name, descr, count)).ok_or_else(|| {
                let text =
                    format!("field {} has the type {}; expected integers or floats", quoted(name), quoted(descr));
                FormatError::Unsupported(text)
            })?;
            fields.push(field);
            if !self.eat(b',') {
                self.require(b']')?;
                break;
            }
        }
        match fields.is_empty() {
            true => Err(damaged("a record with a field")),
            false => Ok(Descr::Records(fields)),
        }
    }

    fn is_at(&mut self, byte: u8) -> bool {
        self.skip_blanks();
        self.0.first() == Some(&byte)
    }

    fn boolean(&mut self) -> Result<bool, FormatError> {
        self.skip_blanks();
        for (word, value) in [(&b"True"[..], true), (b"False", false)] {
            if let Some(rest) = self.0.strip_prefix(word) {
                self.0 = rest;
                return Ok(value);
            }
        }
        Err(damaged("True or False"))
    }

    fn shape(&mut self) -> Result<Vec<usize>, FormatError> {
        let mut shape = Vec::new();
        self.require(b'(')?;
        while !self.eat(b')') {
            shape.push(self.number()?);
            if shape.len() > MAX_DIMENSIONS {
                return Err(damaged("a shape of at most 64 numbers"));
            }
            if !self.eat(b',') {
                self.require(b')')?;
                break;
            }
        }
        Ok(shape)
    }

    /// Parses a whole number. Python 2 appended an L to it.
    fn number(&mut self) -> Result<usize, FormatError> {
        self.skip_blanks();
        let digits = self.0.iter().take_while(|byte| byte.is_ascii_digit()).count();
        let (number, rest) = self.0.split_at(digits);
        self.0 = rest.strip_prefix(b"L").unwrap_or(rest);
        let number = std::str::from_utf8(number).ok().filter(|number| !number.is_empty());
        // Larger numbers become `usize::MAX`, which no file can contain.
        number.map(|number| number.parse().unwrap_or(usize::MAX)).ok_or_else(|| damaged("numbers in the shape"))
    }

    /// Parses a string in single or double quotes.
    fn text(&mut self) -> Result<&'a str, FormatError> {
        self.skip_blanks();
        let text = match self.0 {
            [quote @ (b'\'' | b'"'), rest @ ..] => rest.iter().position(|byte| byte == quote).map(|end| {
                self.0 = &rest[end + 1..];
                &rest[..end]
            }),
            _ => None,
        };
        text.and_then(|text| std::str::from_utf8(text).ok()).ok_or_else(|| damaged("text in quotes"))
    }

    fn require(&mut self, byte: u8) -> Result<(), FormatError> {
        if self.eat(byte) { Ok(()) } else { Err(damaged(&format!("'{}'", char::from(byte)))) }
    }

    fn eat(&mut self, byte: u8) -> bool {
        self.skip_blanks();
        let rest = self.0.strip_prefix(&[byte]);
        self.0 = rest.unwrap_or(self.0);
        rest.is_some()
    }

    fn skip_blanks(&mut self) {
        self.0 = self.0.trim_ascii_start();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(dict: &str) -> Result<Header, String> {
        Dict(dict.as_bytes()).header().map_err(|error| error.to_string())
    }

    #[test]
    fn headers_come_back_aligned_as_numpy_writes_them() {
        for (descr, shape) in [("<f4", &[480, 640, 3][..]), ("|u1", &[7]), ("<u2", &[]), ("<f8", &[123_456_789, 3])] {
            let bytes = Header::encode(descr, shape);
            assert_eq!((bytes.len() % ALIGNMENT, bytes.last()), (0, Some(&b'\n')));
            let (header, rest) = Header::parse(&bytes).unwrap();
            assert_eq!((header.descr.as_str(), &header.shape[..], rest.len()), (descr, shape, 0));
            assert!(!header.is_fortran && !header.is_big_endian);
        }
        let seven = Header::encode("|u1", &[7]);
        assert!(
            std::str::from_utf8(&seven[10..])
                .unwrap()
                .starts_with("{'descr': '|u1', 'fortran_order': False, 'shape': (7,), }")
        );
    }

    #[test]
    fn any_order_of_keys_quotes_blanks_and_the_numbers_of_python_2_are_read() {
        let header = parse("{ \"shape\" :(2L,3L),'fortran_order':True , 'descr':'>f8'}  \n").unwrap();
        assert_eq!((header.kind, header.size, &header.shape[..]), ('f', 8, &[2, 3][..]));
        assert!(header.is_fortran && header.is_big_endian);
        assert_eq!(parse("{'descr': '|b1', 'fortran_order': False, 'shape': (), }").unwrap().len(), Some(1));
    }

    #[test]
    fn what_is_no_header_of_numbers_says_what_would_be() {
        let shape = "'fortran_order': False, 'shape': (2,)";
        for (dict, said) in [
            (String::new(), "'{'"),
            ("{".into(), "quotes"),
            ("{'descr': '<f4'}".into(), "'shape'"),
            (format!("{{'descr': '<f4', {shape}}} x"), "nothing after"),
            (format!("{{'descr': '<f4', 'descr': '<f4', {shape}}}"), "each once"),
            (format!("{{'descr': '|O', {shape}}}"), "expected integers or floats"),
            (format!("{{'descr': '<f9999999', {shape}}}"), "expected integers or floats"),
            (format!("{{'descr': [('x', '|O')], {shape}}}"), "expected integers or floats"),
            (format!("{{'descr': [], {shape}}}"), "a record with a field"),
            ("{'descr': '<f4', 'fortran_order': Maybe".into(), "True or False"),
            ("{'descr': '<f4', 'fortran_order': False, 'shape': (-1,)}".into(), "numbers"),
            (format!("{{'descr': {}", "[".repeat(10_000)), "'('"),
            (format!("{{'descr': '<f4', 'shape': {}", "(".repeat(10_000)), "numbers"),
        ] {
            let error = parse(&dict).unwrap_err();
            assert!(error.contains(said), "{dict:.60}: {error}");
        }
    }
}
