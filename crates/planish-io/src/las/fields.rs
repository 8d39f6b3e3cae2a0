//! The fields of a point record: their offsets, their storage types, and their columns in a cloud.

use las::{Builder, Header, Vlr, point};

use super::super::FormatResult;
use super::super::columns::{EXACT_INTEGERS, with_values};
use super::super::quoted;
use planish_core::{Attribute, AttributeValues, FormatError};

/// User ID and record ID of the variable-length records that describe extra bytes.
const EXTRA_BYTES: (&str, u16) = ("LASF_Spec", 4);
/// Size of the description of an extra field in bytes.
const DESCRIPTION: usize = 192;
/// Byte offset of the type number in a description.
const TYPE_AT: usize = 2;
/// Byte offset of the options in a description.
const OPTIONS_AT: usize = 3;
/// Byte range of the name in a description.
const NAME_AT: std::ops::Range<usize> = 4..36;
/// Byte offset of the scales in a description, which has room for three.
const SCALES_AT: usize = 112;
/// Byte offset of the offsets in a description, which has room for three.
const OFFSETS_AT: usize = 136;
/// Option bit that marks the scales as present.
const HAS_SCALE: u8 = 8;
/// Option bit that marks the offsets as present.
const HAS_OFFSET: u8 = 16;
/// Name of the column for extra bytes without a description.
const UNDESCRIBED: &str = "extra_bytes";

/// The storage type of a field.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stored {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
    /// A bit range of a byte: its lowest bit, and its number of bits.
    Bits(u32, u32),
    /// Undescribed bytes, with their number.
    Bytes(usize),
}

impl Stored {
    fn size(self) -> usize {
        match self {
            Self::U8 | Self::I8 | Self::Bits(..) => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
            Self::Bytes(count) => count,
        }
    }

    /// Returns the storage type and the number of values of an extra field. The number is 2 or 3 for the deprecated
    /// types. Returns `None` for an invalid type number.
    fn of_extra(number: u8, options: u8) -> Option<(Self, usize)> {
        const SCALARS: [Stored; 10] = [
            Stored::U8,
            Stored::I8,
            Stored::U16,
            Stored::I16,
            Stored::U32,
            Stored::I32,
            Stored::U64,
            Stored::I64,
            Stored::F32,
            Stored::F64,
        ];
        match usize::from(number) {
            0 if options == 0 => None,
            0 => Some((Self::Bytes(options.into()), 1)),
            number @ 1..=30 => Some((SCALARS[(number - 1) % 10], (number - 1) / 10 + 1)),
            _ => None,
        }
    }

    /// Returns the type number that describes a column stored as an extra field.
    fn number_of(values: &AttributeValues) -> u8 {
        match values {
            AttributeValues::U8(_) => 1,
            AttributeValues::I8(_) => 2,
            AttributeValues::U16(_) => 3,
            AttributeValues::I16(_) => 4,
            AttributeValues::U32(_) => 5,
            AttributeValues::I32(_) => 6,
            AttributeValues::U64(_) => 7,
            AttributeValues::I64(_) => 8,
            AttributeValues::F32(_) => 9,
            AttributeValues::F64(_) => 10,
        }
    }
}

impl Stored {
    /// Returns true if the column has this storage type.
    fn is_type_of(self, values: &AttributeValues) -> bool {
        Self::of_extra(Self::number_of(values), 0).is_some_and(|(own, _)| own == self)
    }
}

/// A field of a point record.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Field {
    pub(super) name: String,
    /// Offset in the point record, in bytes.
    at: usize,
    stored: Stored,
    /// Number of consecutive values per point.
    count: usize,
    /// Scale and offset for each value, if the file states them.
    scales: Option<[Scale; 3]>,
}

/// The scale and offset of a stored integer, whose value is integer * scale + offset.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Scale {
    scale: f64,
    offset: f64,
}

impl Scale {
    /// Reads the scales and offsets of an extra field; `None` if they are missing or invalid.
    fn of_extra(description: &[u8], stored: Stored) -> Option<[Self; 3]> {
        let options = description[OPTIONS_AT];
        let is_integer = !matches!(stored, Stored::F32 | Stored::F64 | Stored::Bytes(_));
        if options & (HAS_SCALE | HAS_OFFSET) == 0 || !is_integer {
            return None;
        }
        let number = |has: u8, at: usize, k: usize, without: f64| {
            let bytes = std::array::from_fn(|byte| description[at + 8 * k + byte]);
            if options & has == 0 { without } else { f64::from_le_bytes(bytes) }
        };
        let of_value =
            |k| Self { scale: number(HAS_SCALE, SCALES_AT, k, 1.0), offset: number(HAS_OFFSET, OFFSETS_AT, k, 0.0) };
        let all = [0, 1, 2].map(of_value);
        let is_useful = |of: &Self| of.scale.is_normal() && of.offset.is_finite();
        // Entries for absent values may be zero.
        is_useful(&all[0]).then(|| all.map(|of| if is_useful(&of) { of } else { all[0] }))
    }

    fn number(&self, stored: f64) -> f64 {
        // For 53506 and a scale of 0.01, dividing by 100 gives 535.06, but multiplying by 0.01 gives
        // 535.0600000000001.
        let inverse = (1.0 / self.scale).round();
        let is_inverse = inverse.abs() >= 1.0 && inverse.is_finite() && 1.0 / inverse == self.scale;
        self.offset + if is_inverse { stored / inverse } else { stored * self.scale }
    }

    fn stored(&self, number: f64) -> f64 {
        ((number - self.offset) / self.scale).round()
    }
}

/// Returns the fields of a point format, except x, y and z.
pub(super) fn fields_of(format: &point::Format) -> Vec<Field> {
    let mut fields = Vec::new();
    let mut at = 12;
    let mut add = |name: &str, stored: Stored, last_of_byte: bool| {
        fields.push(Field { name: name.to_owned(), at, stored, count: 1, scales: None });
        if last_of_byte {
            at += stored.size();
        }
    };
    add("intensity", Stored::U16, true);
    if format.is_extended {
        add("return_number", Stored::Bits(0, 4), false);
        add("number_of_returns", Stored::Bits(4, 4), true);
        for (bit, name) in ["synthetic", "key_point", "withheld", "overlap"].into_iter().enumerate() {
            add(name, Stored::Bits(bit as u32, 1), false);
        }
        add("scanner_channel", Stored::Bits(4, 2), false);
        add("scan_direction_flag", Stored::Bits(6, 1), false);
        add("edge_of_flight_line", Stored::Bits(7, 1), true);
        add("classification", Stored::U8, true);
        add("user_data", Stored::U8, true);
        add("scan_angle", Stored::I16, true);
    } else {
        add("return_number", Stored::Bits(0, 3), false);
        add("number_of_returns", Stored::Bits(3, 3), false);
        add("scan_direction_flag", Stored::Bits(6, 1), false);
        add("edge_of_flight_line", Stored::Bits(7, 1), true);
        add("classification", Stored::Bits(0, 5), false);
        for (bit, name) in ["synthetic", "key_point", "withheld"].into_iter().enumerate() {
            add(name, Stored::Bits(bit as u32 + 5, 1), bit == 2);
        }
        add("scan_angle_rank", Stored::I8, true);
        add("user_data", Stored::U8, true);
    }
    add("point_source_id", Stored::U16, true);
    if format.has_gps_time {
        add("gps_time", Stored::F64, true);
    }
    if format.has_color {
        for name in ["red", "green", "blue"] {
            add(name, Stored::U16, true);
        }
    }
    if format.has_nir {
        add("nir", Stored::U16, true);
    }
    if format.has_waveform {
        add("wavepacket", Stored::Bytes(29), true);
    }
    fields
}

/// Returns the fields of the extra bytes, as the file describes them.
pub(super) fn extra_fields(header: &Header) -> Vec<Field> {
    let format = header.point_format();
    let mut at = usize::from(format.len()) - usize::from(format.extra_bytes);
    let end = usize::from(format.len());
    let standard = fields_of(format);
    let mut fields: Vec<Field> = Vec::new();
    let records = header.all_vlrs().filter(|vlr| is_extra_bytes(vlr));
    for description in records.flat_map(|vlr| vlr.data.chunks_exact(DESCRIPTION)) {
        let Some((stored, count)) = Stored::of_extra(description[TYPE_AT], description[OPTIONS_AT]) else { break };
        if at + count * stored.size() > end {
            break;
        }
        let name = &description[NAME_AT];
        let name = &name[..name.iter().position(|&byte| byte == 0).unwrap_or(name.len())];
        let name: String = String::from_utf8_lossy(name).split_whitespace().collect::<Vec<_>>().join("_");
        let is_taken = |name: &str| {
            name.is_empty()
                || ["x", "y", "z", UNDESCRIBED].contains(&name)
                || standard.iter().chain(&fields).any(|field| field.name == name)
        };
        let numbered = (0..).map(|number| format!("extra_{number}"));
        // There are infinitely many numbered names, so a free one is always found.
        let name = [name].into_iter().chain(numbered).find(|name| !is_taken(name)).unwrap_or_default();
        fields.push(Field { name, at, stored, count, scales: Scale::of_extra(description, stored) });
        at += count * stored.size();
    }
    if at < end {
        let stored = Stored::Bytes(end - at);
        fields.push(Field { name: UNDESCRIBED.to_owned(), at, stored, count: 1, scales: None });
    }
    fields
}

fn is_extra_bytes(vlr: &Vlr) -> bool {
    (vlr.user_id.as_str(), vlr.record_id) == EXTRA_BYTES
}

pub(super) fn decode_field(field: &Field, raw: &[u8], record: usize) -> Attribute {
    let &Field { ref name, at, stored, count, scales } = field;
    let size = stored.size();
    let values = raw.chunks_exact(record).flat_map(move |point| point[at..at + count * size].chunks_exact(size));
    macro_rules! numbers {
        ($number:ty) => {
            values
                .map(|bytes| <$number>::from_le_bytes(std::array::from_fn(|i| bytes[i])))
                .collect::<Vec<$number>>()
                .into()
        };
    }
    let (count, values) = match stored {
        Stored::U8 => (count, numbers!(u8)),
        Stored::I8 => (count, numbers!(i8)),
        Stored::U16 => (count, numbers!(u16)),
        Stored::I16 => (count, numbers!(i16)),
        Stored::U32 => (count, numbers!(u32)),
        Stored::I32 => (count, numbers!(i32)),
        Stored::U64 => (count, numbers!(u64)),
        Stored::I64 => (count, numbers!(i64)),
        Stored::F32 => (count, numbers!(f32)),
        Stored::F64 => (count, numbers!(f64)),
        Stored::Bits(lowest, bits) => {
            (1, values.map(|bytes| bytes[0] >> lowest & ((1 << bits) - 1)).collect::<Vec<u8>>().into())
        }
        Stored::Bytes(size) => (size, values.flatten().copied().collect::<Vec<u8>>().into()),
    };
    let values = scales.and_then(|scales| scaled(&values, &scales[..count])).unwrap_or(values);
    Attribute { name: name.clone(), count, values }
}

/// Applies scales and offsets to integers; `None` if a result would not convert back to its integer.
fn scaled(values: &AttributeValues, scales: &[Scale]) -> Option<AttributeValues> {
    let number = |i: usize| {
        let (stored, scale) = (values.get_f64(i), scales[i % scales.len()]);
        let number = scale.number(stored);
        (stored.abs() < EXACT_INTEGERS as f64 && scale.stored(number) == stored).then_some(number)
    };
    (0..values.len()).map(number).collect::<Option<Vec<f64>>>().map(Into::into)
}

/// Describes the extra bytes that have no description, so that descriptions of added fields can follow.
pub(super) fn describe_rest(builder: &mut Builder, all: &[Field]) -> FormatResult<()> {
    let Some(Field { at, stored, .. }) = all.iter().find(|field| field.name == UNDESCRIBED) else { return Ok(()) };
    let described = all.iter().filter(|field| field.at >= usize::from(base_len(builder)) && field.at < *at).count();
    let records = builder.vlrs.iter().chain(&builder.evlrs).filter(|vlr| is_extra_bytes(vlr));
    let descriptions: usize = records.map(|vlr| vlr.data.len() / DESCRIPTION).sum();
    match u8::try_from(stored.size()) {
        Ok(size) if descriptions == described => {
            push_description(builder, UNDESCRIBED, 0, size);
            Ok(())
        }
        _ => Err(FormatError::Unsupported(
            "fields cannot be added after extra bytes without a description; write another format, such as .ply".into(),
        )),
    }
}

/// Returns the size of a point record in bytes, without its extra bytes.
fn base_len(builder: &Builder) -> u16 {
    builder.point_format.len() - builder.point_format.extra_bytes
}

/// Appends a description to the last variable-length record of descriptions, or to a new record.
fn push_description(builder: &mut Builder, name: &str, number: u8, options: u8) {
    let mut description = vec![0u8; DESCRIPTION];
    (description[TYPE_AT], description[OPTIONS_AT]) = (number, options);
    description[NAME_AT.start..NAME_AT.start + name.len()].copy_from_slice(name.as_bytes());
    let Builder { vlrs, evlrs, .. } = builder;
    match vlrs.iter_mut().chain(evlrs).rev().find(|vlr| is_extra_bytes(vlr)) {
        Some(vlr) => vlr.data.extend(description),
        None => {
            let (user_id, record_id) = EXTRA_BYTES;
            let vlr = Vlr { user_id: user_id.into(), record_id, description: "extra bytes".into(), data: description };
            builder.vlrs.push(vlr);
        }
    }
}

/// Adds a column to the extra bytes, with its description.
pub(super) fn add_extra_field(builder: &mut Builder, all: &mut Vec<Field>, attribute: &Attribute) -> FormatResult<()> {
    let number = Stored::number_of(&attribute.values);
    let (stored, count) = match (Stored::of_extra(number, 0), attribute.count) {
        (Some((stored, _)), 1) => (stored, 1),
        _ => {
            let reason =
                format!("field {} has {} values per point, but LAS stores one", attribute.name, attribute.count);
            return Err(FormatError::Unsupported(reason));
        }
    };
    if attribute.name.len() > NAME_AT.len() {
        let reason = format!("the name {} is longer than LAS allows (32 bytes)", quoted(&attribute.name));
        return Err(FormatError::Unsupported(reason));
    }
    let too_long = || {
        FormatError::Unsupported(
            "the fields do not fit into a LAS record of at most 65,535 bytes; write another format, such as .ply"
                .into(),
        )
    };
    builder.point_format.len().checked_add(stored.size() as u16).ok_or_else(too_long)?;
    push_description(builder, &attribute.name, number, 0);
    let at = usize::from(builder.point_format.len());
    builder.point_format.extra_bytes += stored.size() as u16;
    all.push(Field { name: attribute.name.clone(), at, stored, count, scales: None });
    Ok(())
}

// The macro expands to the same code for all types, so some casts have no effect for one of them.
#[allow(clippy::unnecessary_cast)]
pub(super) fn encode_field(
    field: &Field,
    attribute: &Attribute,
    kept: &[usize],
    raw: &mut [u8],
    record: usize,
) -> FormatResult<()> {
    let &Field { at, stored, count, scales, .. } = field;
    let values_a_point = if let Stored::Bytes(size) = stored { size } else { count };
    let out_of_range = || {
        FormatError::Unsupported(format!(
            "field {} has values that the LAS field of this name cannot store (negative, too large, or not integers); \
             rename the field",
            field.name
        ))
    };
    if attribute.count != values_a_point {
        return Err(out_of_range());
    }
    // Values that have the stored type were read without scaling, because scaled numbers would not have been exact.
    let unscaled = scales.filter(|_| !stored.is_type_of(&attribute.values)).map(|scales| {
        let of_value = |i: usize| scales[i % count].stored(attribute.values.get_f64(i));
        AttributeValues::F64((0..attribute.values.len()).map(of_value).collect())
    });
    with_values!(unscaled.as_ref().unwrap_or(&attribute.values), values => {
        for (point, &i) in raw.chunks_exact_mut(record).zip(kept) {
            for k in 0..values_a_point {
                let value = values[i * values_a_point + k];
                let number = value as f64;
                let slot = &mut point[at..];
                macro_rules! put {
                    ($number:ty) => {{
                        let stored = value as $number;
                        // The cast changes values that the type cannot represent.
                        if stored as f64 != number && !(number.is_nan() && stored as f64 != 0.0) {
                            return Err(out_of_range());
                        }
                        let size = size_of::<$number>();
                        slot[k * size..(k + 1) * size].copy_from_slice(&stored.to_le_bytes());
                    }};
                }
                match stored {
                    Stored::U8 | Stored::Bytes(_) => put!(u8),
                    Stored::I8 => put!(i8),
                    Stored::U16 => put!(u16),
                    Stored::I16 => put!(i16),
                    Stored::U32 => put!(u32),
                    Stored::I32 => put!(i32),
                    Stored::U64 => put!(u64),
                    Stored::I64 => put!(i64),
                    Stored::F32 => put!(f32),
                    Stored::F64 => put!(f64),
                    Stored::Bits(lowest, bits) => {
                        let bits_of_value = value as u8;
                        if f64::from(bits_of_value) != number || bits_of_value >> bits != 0 {
                            return Err(out_of_range());
                        }
                        slot[0] |= bits_of_value << lowest;
                    }
                }
            }
        }
    });
    Ok(())
}
