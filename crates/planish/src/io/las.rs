//! LAS 1.0 to 1.4, and LAZ: every field of a point is a column, extra bytes by their descriptions; all else of the file, such as its
//! coordinate system, stays with the cloud and is written back.

use std::io::Cursor;
use std::sync::Arc;

use las::{Builder, Header, Reader, Transform, Version, Vlr, Writer, point};

use super::columns::with_values;
use super::{Format, FormatResult, ReadOptions};
use crate::cloud::{Attribute, AttributeValues, PointCloud};
use crate::error::FormatError;
use crate::xyz::Xyz;

/// What a header says of extra bytes stands in records of this user and number.
const EXTRA_BYTES: (&str, u16) = ("LASF_Spec", 4);
/// Bytes of the description of an extra field.
const DESCRIPTION: usize = 192;
/// Where in it the type, the options and the name are.
const TYPE_AT: usize = 2;
const OPTIONS_AT: usize = 3;
const NAME_AT: std::ops::Range<usize> = 4..36;
/// What is left of the extra bytes where no description says what they are.
const UNDESCRIBED: &str = "extra_bytes";
/// Coordinates of files that we make are multiples of this, where they fit: finer than any scanner measures.
const SCALE_M: f64 = 1e-5;
/// The most that 32 bits hold, with room to move points.
const LARGEST_INTEGER: f64 = 2e9;

/// How a field is stored.
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
    /// Some bits of a byte: the lowest, and how many.
    Bits(u32, u32),
    /// Bytes of which nothing is known.
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

    /// By its number in the description of an extra field; the older types of two and three values count as so many.
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

    /// The number of a column's type in the description of an extra field.
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

/// A field of a point record.
#[derive(Debug, Clone, PartialEq)]
struct Field {
    name: String,
    /// Bytes from the beginning of the record.
    at: usize,
    stored: Stored,
    /// Values one after another.
    count: usize,
}

/// The fields of a point format, but for x, y and z.
fn fields(format: &point::Format) -> Vec<Field> {
    let mut fields = Vec::new();
    let mut at = 12;
    let mut add = |name: &str, stored: Stored, last_of_byte: bool| {
        fields.push(Field { name: name.to_owned(), at, stored, count: 1 });
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

/// The fields of the extra bytes, as the file describes them.
fn extra_fields(header: &Header) -> Vec<Field> {
    let format = header.point_format();
    let mut at = usize::from(format.len()) - usize::from(format.extra_bytes);
    let end = usize::from(format.len());
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
        let is_taken = |name: &str| ["x", "y", "z"].contains(&name) || fields.iter().any(|field| field.name == name);
        let name = if name.is_empty() || is_taken(&name) { format!("extra_{}", fields.len()) } else { name };
        fields.push(Field { name, at, stored, count });
        at += count * stored.size();
    }
    if at < end {
        fields.push(Field { name: UNDESCRIBED.to_owned(), at, stored: Stored::Bytes(end - at), count: 1 });
    }
    fields
}

fn is_extra_bytes(vlr: &Vlr) -> bool {
    (vlr.user_id.as_str(), vlr.record_id) == EXTRA_BYTES
}

/// LAS or LAZ, by the bit of the point format that says which.
pub(super) fn format_of(bytes: &[u8]) -> Format {
    const POINT_FORMAT_AT: usize = 104;
    match bytes.get(POINT_FORMAT_AT) {
        Some(number) if number & 0x80 != 0 => Format::Laz,
        _ => Format::Las,
    }
}

fn damaged(error: las::Error) -> FormatError {
    FormatError::Malformed(format!("damaged LAS: {}", super::brief(&error.to_string())))
}

/// What a header says that the decoder would believe.
struct Claims {
    points: u64,
    record: usize,
    /// Where extended records begin, and their number.
    extended: Option<(usize, u32)>,
}

/// Checks against the file what its header claims; `None` if it ends before that.
fn claims(bytes: &[u8]) -> Option<Claims> {
    let record = usize::from(u16::from_le_bytes(read_at(bytes, 105)?));
    let legacy = u64::from(u32::from_le_bytes(read_at(bytes, 107)?));
    if bytes[25] < 4 {
        return Some(Claims { points: legacy, record, extended: None });
    }
    let extended_at = usize::try_from(u64::from_le_bytes(read_at(bytes, 235)?)).ok()?;
    let extended = Some((extended_at, u32::from_le_bytes(read_at(bytes, 243)?)));
    let points = if legacy == 0 { u64::from_le_bytes(read_at(bytes, 247)?) } else { legacy };
    Some(Claims { points, record, extended })
}

/// Refuses chunks of points that the file cannot hold: the decoder allocates what is claimed. `None` if it is cut off.
fn check_chunks(bytes: &[u8], points: u64) -> Option<FormatResult<()>> {
    /// More points than that in a chunk are believed only of a file that has them.
    const LARGEST_CHUNK: u64 = 1 << 20;
    let u32_at = |at: usize| read_at(bytes, at).map(u32::from_le_bytes);
    let mut at = usize::from(u16::from_le_bytes(read_at(bytes, 94)?));
    // Of every record ahead of the points: 54 bytes, and as many as it says.
    for _ in 0..u32_at(100)? {
        let user = bytes.get(at.checked_add(2)?..at.checked_add(18)?)?;
        if user.starts_with(b"laszip encoded") {
            let chunk = u32_at(at + 54 + 12)?;
            if chunk != u32::MAX && u64::from(chunk) > points.max(LARGEST_CHUNK) {
                return Some(Err(FormatError::Malformed(format!("chunks of {chunk} points in a file of {points}"))));
            }
        }
        at += 54 + usize::from(u16::from_le_bytes(read_at(bytes, at + 20)?));
    }
    let table = i64::from_le_bytes(read_at(bytes, u32_at(96)? as usize)?);
    // It stands at the end where a writer could not go back.
    let at_end = || i64::from_le_bytes(read_at(bytes, bytes.len().checked_sub(8)?)?).try_into().ok();
    let table: usize = table.try_into().ok().or_else(at_end)?;
    let chunks = u32_at(table.checked_add(4)?)? as usize;
    let record = usize::from(u16::from_le_bytes(read_at(bytes, 105)?));
    // Each begins with a point as it is.
    if chunks.saturating_mul(record.max(1)) > bytes.len() {
        return Some(Err(FormatError::Malformed(format!("{chunks} chunks in {} bytes", bytes.len()))));
    }
    Some(Ok(()))
}

/// The extended records, behind the points. The library reads the first alone.
fn extended_records(bytes: &[u8], (at, count): (usize, u32)) -> Option<Vec<Vlr>> {
    let mut rest = bytes.get(at..)?;
    let mut records = Vec::new();
    for _ in 0..count {
        // Nothing is allocated for what is not there.
        let length = usize::try_from(u64::from_le_bytes(read_at(rest, 20)?)).ok()?;
        let (record, behind) = rest.split_at_checked(length.checked_add(60)?)?;
        records.push(Vlr::new(las::raw::Vlr::read_from(record, true).ok()?));
        rest = behind;
    }
    Some(records)
}

fn read_at<const N: usize>(bytes: &[u8], at: usize) -> Option<[u8; N]> {
    bytes.get(at..at.checked_add(N)?)?.try_into().ok()
}

pub(super) fn decode(bytes: &[u8], options: &ReadOptions) -> FormatResult<PointCloud> {
    let cut_off = || FormatError::Malformed("cut off".into());
    let Claims { points, record, extended } = claims(bytes).ok_or_else(cut_off)?;
    let count = usize::try_from(points).unwrap_or(usize::MAX);
    // The records, and positions and columns.
    options.check(count, 2 * record + 12)?;
    match format_of(bytes) {
        Format::Laz => check_chunks(bytes, points).ok_or_else(cut_off)??,
        _ if count.saturating_mul(record) > bytes.len() => return Err(cut_off()),
        _ => {}
    }
    let extended =
        extended.map_or(Some(Vec::new()), |extended| extended_records(bytes, extended)).ok_or_else(cut_off)?;
    let mut reader = Reader::new(Cursor::new(bytes.to_vec())).map_err(damaged)?;
    let mut builder = Builder::from(reader.header().clone());
    builder.evlrs = extended;
    let header = builder.into_header().map_err(damaged)?;
    let record = usize::from(header.point_format().len());
    let points = reader.read_all().map_err(damaged)?;
    if points.len() != count {
        return Err(FormatError::Malformed(format!("cut off: {} of {count} points", points.len())));
    }
    let raw = points.raw_bytes();
    let transforms = header.transforms();
    let usable = [transforms.x, transforms.y, transforms.z]
        .iter()
        .all(|t| t.scale.is_finite() && t.scale != 0.0 && t.offset.is_finite());
    if !usable {
        return Err(FormatError::Malformed("the header's scales and offsets are no finite numbers".into()));
    }
    let axis = |at: usize, transform: Transform| -> (Vec<f32>, f64) {
        let integers = raw
            .chunks_exact(record)
            .map(|point| i32::from_le_bytes([point[at], point[at + 1], point[at + 2], point[at + 3]]));
        let (low, high) =
            integers.clone().fold((i32::MAX, i32::MIN), |(low, high), value| (low.min(value), high.max(value)));
        // In the middle, on a whole metre, so that as few digits as possible are lost to f32.
        let middle = if low > high { 0.0 } else { transform.direct(low).midpoint(transform.direct(high)).round() };
        (integers.map(|value| (transform.direct(value) - middle) as f32).collect(), middle)
    };
    let ((x, origin_x), (y, origin_y), (z, origin_z)) =
        (axis(0, transforms.x), axis(4, transforms.y), axis(8, transforms.z));
    let mut cloud = PointCloud::new(Xyz { x, y, z });
    cloud.origin_m = [origin_x, origin_y, origin_z];
    cloud.position_columns.double = true;
    let all = fields(header.point_format()).into_iter().chain(extra_fields(&header));
    cloud.attributes = all.map(|field| decode_field(&field, raw, record)).collect();
    cloud.las_header = Some(Arc::new(header));
    Ok(cloud)
}

fn decode_field(field: &Field, raw: &[u8], record: usize) -> Attribute {
    let &Field { ref name, at, stored, count } = field;
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
    Attribute { name: name.clone(), count, values }
}

/// Encodes a cloud; without its holes, for which LAS has no place.
pub(super) fn encode(cloud: &PointCloud, compressed: bool) -> FormatResult<Vec<u8>> {
    let cannot = |error: las::Error| {
        FormatError::Unsupported(format!("no LAS of this cloud: {}", super::brief(&error.to_string())))
    };
    let kept: Vec<usize> = (0..cloud.len()).filter(|&i| cloud.positions.is_finite(i)).collect();
    // Of 8 bits; 16-bit channels are columns like any other.
    let colour = cloud.rgb();
    let channels = ["red", "green", "blue"];
    let mut builder = match &cloud.las_header {
        Some(header) => Builder::from((**header).clone()),
        None => new_builder(cloud, &kept, colour.is_some()).map_err(cannot)?,
    };
    // What says how other bytes are compressed, and the index of another order of points.
    builder.vlrs.retain(|vlr| !["laszip encoded", "copc"].contains(&vlr.user_id.as_str()));
    builder.evlrs.retain(|vlr| vlr.user_id != "copc");
    builder.point_format.is_compressed = compressed;
    let known = builder.clone().into_header().map_err(cannot)?;
    let mut all: Vec<Field> = fields(&builder.point_format).into_iter().chain(extra_fields(&known)).collect();
    // Every other column is an extra field.
    let is_colour = |name: &str| colour.is_some() && (["rgb", "rgba"].contains(&name) || channels.contains(&name));
    for attribute in cloud.attributes.iter().filter(|attribute| attribute.name != "_" && !is_colour(&attribute.name)) {
        if !all.iter().any(|field| field.name == attribute.name) {
            add_extra_field(&mut builder, &mut all, attribute)?;
        }
    }
    let header = builder.into_header().map_err(cannot)?;
    let record = usize::from(header.point_format().len());
    let mut raw = vec![0u8; record * kept.len()];

    let transforms = header.transforms();
    for (at, values, origin, transform) in [
        (0, &cloud.positions.x, cloud.origin_m[0], transforms.x),
        (4, &cloud.positions.y, cloud.origin_m[1], transforms.y),
        (8, &cloud.positions.z, cloud.origin_m[2], transforms.z),
    ] {
        for (point, &i) in raw.chunks_exact_mut(record).zip(&kept) {
            let integer = transform.inverse(origin + f64::from(values[i])).map_err(cannot)?;
            point[at..at + 4].copy_from_slice(&integer.to_le_bytes());
        }
    }
    for field in all.iter().filter(|field| !is_colour(&field.name)) {
        if let Some(attribute) = cloud.attribute(&field.name) {
            encode_field(field, attribute, &kept, &mut raw, record)?;
        }
    }
    if let Some(colour) = &colour {
        for (channel, name) in channels.into_iter().enumerate() {
            let values: Vec<u16> = colour.iter().map(|rgb| u16::from(rgb[channel]) * 257).collect();
            let attribute = Attribute { name: name.to_owned(), count: 1, values: values.into() };
            if let Some(field) = all.iter().find(|field| field.name == name) {
                encode_field(field, &attribute, &kept, &mut raw, record)?;
            }
        }
    }
    let points = las::PointDataBuilder::new().for_header(&header).build_from_bytes(raw).map_err(cannot)?;
    let mut writer = Writer::new(Cursor::new(Vec::new()), header).map_err(cannot)?;
    writer.write_points(&points).map_err(cannot)?;
    writer.close().map_err(cannot)?;
    Ok(writer.into_inner().map_err(cannot)?.into_inner())
}

/// A header for a cloud that was no LAS.
fn new_builder(cloud: &PointCloud, kept: &[usize], has_colour: bool) -> Result<Builder, las::Error> {
    let mut builder = Builder::from(Version::new(1, 4));
    let has = |name: &str| cloud.attribute(name).is_some();
    let number = match (has_colour || has("red"), has("nir")) {
        (_, true) => 8,
        (true, false) => 7,
        (false, false) => 6,
    };
    builder.point_format = point::Format::new(number)?;
    builder.generating_software = concat!("planish ", env!("CARGO_PKG_VERSION")).to_owned();
    let transform = |values: &[f32], origin: f64| {
        let largest = kept.iter().map(|&i| f64::from(values[i]).abs()).fold(0.0, f64::max);
        let mut scale = SCALE_M;
        while largest / scale > LARGEST_INTEGER {
            scale *= 10.0;
        }
        Transform { scale, offset: origin }
    };
    builder.transforms = las::Vector {
        x: transform(&cloud.positions.x, cloud.origin_m[0]),
        y: transform(&cloud.positions.y, cloud.origin_m[1]),
        z: transform(&cloud.positions.z, cloud.origin_m[2]),
    };
    Ok(builder)
}

/// Makes room for a column in the extra bytes, and describes it.
fn add_extra_field(builder: &mut Builder, all: &mut Vec<Field>, attribute: &Attribute) -> FormatResult<()> {
    let number = Stored::number_of(&attribute.values);
    let (stored, count) = match (Stored::of_extra(number, 0), attribute.count) {
        (Some((stored, _)), 1) => (stored, 1),
        _ => {
            let reason = format!("field {} has {} values a point: LAS has one", attribute.name, attribute.count);
            return Err(FormatError::Unsupported(reason));
        }
    };
    let mut description = vec![0u8; DESCRIPTION];
    description[TYPE_AT] = number;
    let name = attribute.name.as_bytes();
    if name.len() > NAME_AT.len() {
        return Err(FormatError::Unsupported(format!(
            "the name {} is longer than LAS allows (32 bytes)",
            attribute.name
        )));
    }
    description[NAME_AT.start..NAME_AT.start + name.len()].copy_from_slice(name);
    match builder.vlrs.iter_mut().rev().find(|vlr| is_extra_bytes(vlr)) {
        Some(vlr) => vlr.data.extend(description),
        None => {
            let (user_id, record_id) = EXTRA_BYTES;
            builder.vlrs.push(Vlr {
                user_id: user_id.into(),
                record_id,
                description: "extra bytes".into(),
                data: description,
            });
        }
    }
    let at = usize::from(builder.point_format.len());
    builder.point_format.extra_bytes += stored.size() as u16;
    all.push(Field { name: attribute.name.clone(), at, stored, count });
    Ok(())
}

fn encode_field(
    field: &Field,
    attribute: &Attribute,
    kept: &[usize],
    raw: &mut [u8],
    record: usize,
) -> FormatResult<()> {
    let &Field { at, stored, count, .. } = field;
    let values_a_point = if let Stored::Bytes(size) = stored { size } else { count };
    let out_of_range = || FormatError::Unsupported(format!("field {} has values that LAS has no room for", field.name));
    if attribute.count != values_a_point {
        return Err(out_of_range());
    }
    with_values!(&attribute.values, values => {
        for (point, &i) in raw.chunks_exact_mut(record).zip(kept) {
            for k in 0..values_a_point {
                let value = values[i * values_a_point + k];
                let number = value as f64;
                let slot = &mut point[at..];
                macro_rules! put {
                    ($number:ty) => {{
                        let stored = value as $number;
                        // A cast of another type may have cut it.
                        if stored as f64 != number && !number.is_nan() {
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
