//! Reads and writes LAS 1.0 to 1.4 and LAZ; LAS 1.5 is read as LAS 1.4. Every field of a point becomes a column, and so
//! do extra bytes. Everything else in the file, such as its coordinate system, is stored with the cloud and written
//! back.

mod errors;
mod fields;
mod repair;
mod stream;
mod validate;
mod writer;

use std::io::Cursor;
use std::sync::Arc;

use las::{Builder, Header, Reader, Transform, Version, Vlr, point};

use super::format::las_or_laz;
use super::length_unit::{HEIGHT_UNIT, LINEAR_UNIT, LengthUnit, height_unit_of_wkt, unit_of_geo_keys, unit_of_wkt};
use super::{Format, FormatResult, ReadOptions};
use crate::guarded::guarded;
use planish_core::{Attribute, AttributeValues, CoordinateSteps, FormatError, PointCloud, Precision, Provenance, Xyz};
pub(crate) use stream::LasReader;
use writer::LasWriter;

use errors::{cannot, damaged, unreadable};
use fields::{Field, add_extra_field, decode_field, describe_rest, encode_field, extra_fields, fields_of};
use repair::{Overlaid, Repaired, WithHead};
use validate::{Claims, FileBytes, check_chunks, check_header, claims, extended_records};

/// Resolution of coordinates in new files in metres, if all coordinates fit. It is finer than the resolution of any
/// scanner.
const SCALE_M: f64 = 1e-5;
/// Maximum number of points in the sample from which the median position is taken.
const SAMPLE: usize = 1000;
/// Maximum coordinate in new files, in steps. It leaves room within 32 bits for points to move.
const LARGEST_INTEGER: f64 = 2e9;

/// Byte offset of the number of variable-length records in the header.
const RECORDS_AT: usize = 100;
/// Minimum size of a variable-length record in bytes.
const LEAST_RECORD: usize = 54;
/// Minimum size of an extended variable-length record in bytes.
const LEAST_EXTENDED_RECORD: usize = 60;
/// Maximum number of variable-length records; each takes half a kilobyte of memory.
const MOST_RECORDS: usize = 1 << 16;

pub(super) fn decode(bytes: &[u8], options: &ReadOptions, notes: &mut Vec<String>) -> FormatResult<PointCloud> {
    let Checked { points, record, extended, repaired } = Checked::of(bytes, las_or_laz(bytes))?;
    // Memory for the records, positions and columns.
    options.check(points, 2 * record + 12)?;
    let identity = identity_of(&repaired.head);
    // The LAZ decoder trusts its input: on damaged points it may divide by zero.
    let decoded = guarded(|| {
        let mut reader = Reader::new(WithHead::new(repaired.head, Cursor::new(bytes.to_vec()))?)?;
        let mut builder = Builder::from(reader.header().clone());
        builder.evlrs = extended;
        Ok((builder.into_header()?, reader.read_all()?))
    });
    let (header, found) = decoded.ok_or_else(unreadable)?.map_err(damaged)?;
    if found.len() != points {
        return Err(FormatError::Malformed(format!(
            "the file is truncated: it has {} of {points} points",
            found.len()
        )));
    }
    notes.extend(repaired.notes);
    notes.extend(note_on_heights(&header));
    cloud_of(Arc::new(FileHeader { header, identity }), found.raw_bytes())
}

/// Contents of a header that has been checked against the file.
struct Checked {
    points: usize,
    /// Size of a point record in bytes.
    record: usize,
    extended: Vec<Vlr>,
    repaired: Repaired,
}

impl Checked {
    fn of(bytes: &(impl FileBytes + ?Sized), format: Format) -> FormatResult<Self> {
        let size = bytes.size();
        if bytes.read(0, 4).is_none_or(|head| head != b"LASF") {
            return Err(FormatError::Malformed("not a LAS or LAZ file (missing LASF signature)".into()));
        }
        let short_header =
            || FormatError::Malformed(format!("the file is truncated: {size} bytes are less than a LAS header"));
        check_header(bytes).ok_or_else(short_header)??;
        let records = validate::read_at(bytes, RECORDS_AT).map_or(0, u32::from_le_bytes) as usize;
        if records.min(size / LEAST_RECORD) > MOST_RECORDS {
            let text =
                format!("the header states {records} variable-length records; at most {MOST_RECORDS} are supported");
            return Err(FormatError::Unsupported(text));
        }
        let repaired = Repaired::read(bytes).ok_or_else(short_header)??;
        let bytes = &Overlaid { head: &repaired.head, file: bytes };
        let Claims { points, record, extended } = claims(bytes).ok_or_else(short_header)?;
        let count = usize::try_from(points).unwrap_or(usize::MAX);
        let points_at = validate::read_at(bytes, repair::POINTS_AT).map_or(0, u32::from_le_bytes) as usize;
        let cut_off = || {
            let claimed = format!(
                "the header states {points} points of {record} bytes at byte {points_at}, but the file has {size} bytes"
            );
            FormatError::Malformed(format!("the file is truncated: {claimed}"))
        };
        match format {
            Format::Laz => check_chunks(bytes, points).ok_or_else(cut_off)??,
            _ if count.saturating_mul(record) > size.saturating_sub(points_at) => return Err(cut_off()),
            _ => {}
        }
        if let Some((at, count)) = extended
            && (count as usize).min(size.saturating_sub(at) / LEAST_EXTENDED_RECORD) > MOST_RECORDS
        {
            let text = format!("the header states {count} extended records; at most {MOST_RECORDS} are supported");
            return Err(FormatError::Unsupported(text));
        }
        let extended = extended.map_or(Vec::new(), |extended| extended_records(bytes, extended));
        Ok(Self { points: count, record, extended, repaired })
    }
}

/// Returns an error if scales and offsets do not yield usable coordinates.
fn check_transforms(header: &Header) -> FormatResult<()> {
    let las::Vector { x, y, z } = *header.transforms();
    let is_usable = |t: &Transform| {
        t.scale != 0.0 && [i32::MIN, i32::MAX].iter().all(|&end| t.direct(end).abs() < f64::from(f32::MAX))
    };
    match [x, y, z].iter().all(is_usable) {
        true => Ok(()),
        false => Err(FormatError::Malformed(
            "the header's scales and offsets are invalid (zero, not finite, or far too large)".into(),
        )),
    }
}

/// Decodes the point records of a file into a cloud.
fn cloud_of(of_file: Arc<FileHeader>, raw: &[u8]) -> FormatResult<PointCloud> {
    let header = &of_file.header;
    check_transforms(header)?;
    let record = usize::from(header.point_format().len());
    let transforms = *header.transforms();
    let axis = |at: usize, transform: Transform| -> (Vec<f32>, f64, Vec<f64>) {
        let integers = raw
            .chunks_exact(record)
            .map(|point| i32::from_le_bytes([point[at], point[at + 1], point[at + 2], point[at + 3]]));
        let (low, high) =
            integers.clone().fold((i32::MAX, i32::MIN), |(low, high), value| (low.min(value), high.max(value)));
        // The origin is the median point, rounded to whole metres: f32 is most precise near it, and stray points do
        // not move it.
        let step = (raw.len() / record).div_ceil(SAMPLE).max(1);
        let mut sample: Vec<i32> = integers.clone().step_by(step).collect();
        sample.sort_unstable();
        let middle = sample.get(sample.len() / 2).map_or(0.0, |&integer| transform.direct(integer).round());
        let values: Vec<f32> = integers.clone().map(|value| (transform.direct(value) - middle) as f32).collect();
        // Check whether f32 is too coarse for the file's integers.
        let widest = (transform.direct(high) - middle).abs().max((transform.direct(low) - middle).abs());
        let exact = if f64::from(f32::EPSILON) * widest > 0.25 * transform.scale.abs() {
            integers.map(|value| transform.direct(value)).collect()
        } else {
            Vec::new()
        };
        (values, middle, exact)
    };
    let [(x, origin_x, exact_x), (y, origin_y, exact_y), (z, origin_z, exact_z)] =
        [(0, transforms.x), (4, transforms.y), (8, transforms.z)].map(|(at, transform)| axis(at, transform));
    let mut cloud = PointCloud::new(Xyz::from_arrays([x, y, z])?);
    cloud.origin_m = [origin_x, origin_y, origin_z];
    cloud.keep_exact([exact_x, exact_y, exact_z]);
    let steps = |transform: Transform| CoordinateSteps { step_m: transform.scale, offset_m: transform.offset };
    cloud.steps = Some([steps(transforms.x), steps(transforms.y), steps(transforms.z)]);
    cloud.position_columns.precision = Precision::F64;
    let all = fields_of(header.point_format()).into_iter().chain(extra_fields(header));
    cloud.attributes = all.map(|field| decode_field(&field, raw, record)).collect();
    cloud.provenance = Provenance::new(LasHeader(of_file));
    Ok(cloud)
}

/// The header of a file: coordinate system, scales, offsets and extra bytes.
#[derive(Debug, PartialEq)]
pub(crate) struct FileHeader {
    pub(crate) header: Header,
    /// The raw header bytes that name the system and program that wrote the file, the day and the year. They are kept
    /// because the las crate loses text in encodings other than UTF-8, and a year without a day.
    identity: Identity,
}

type Identity = [u8; repair::IDENTITY.end - repair::IDENTITY.start];

fn identity_of(head: &[u8]) -> Identity {
    head.get(repair::IDENTITY).and_then(|bytes| bytes.try_into().ok()).unwrap_or([0; _])
}

/// The header of the LAS file that a cloud was read from.
#[derive(Debug, PartialEq)]
struct LasHeader(Arc<FileHeader>);

/// Encodes a cloud without its holes, which LAS cannot represent.
pub(super) fn encode(cloud: &PointCloud, compressed: bool) -> FormatResult<Vec<u8>> {
    let kept: Vec<usize> = (0..cloud.len()).filter(|&i| cloud.positions.is_finite(i)).collect();
    let records = Records::new(cloud, &kept, compressed)?;
    let raw = records.encode(cloud, &kept)?;
    let mut writer = LasWriter::new(Cursor::new(Vec::new()), records.header, records.identity)?;
    writer.write(raw)?;
    Ok(writer.finish()?.into_inner())
}

/// Returns true if a cloud was read from LAS or LAZ.
pub(super) fn has_header(cloud: &PointCloud) -> bool {
    cloud.provenance.get::<LasHeader>().is_some()
}

/// Returns the length unit of the coordinate system of a cloud that was read from LAS or LAZ.
pub(super) fn length_unit(cloud: &PointCloud) -> Option<LengthUnit> {
    let LasHeader(of_file) = cloud.provenance.get()?;
    units(&of_file.header)[0]
}

/// Returns the units of x and y, and of z, as far as the header states them.
fn units(header: &Header) -> [Option<LengthUnit>; 2] {
    const PROJECTION: &str = "LASF_Projection";
    const WKT: u16 = 2112;
    const GEO_KEYS: u16 = 34735;
    let record = |id: u16| {
        let found = header.all_vlrs().find(|vlr| vlr.user_id == PROJECTION && vlr.record_id == id);
        found.map(|vlr| &vlr.data[..]).unwrap_or_default()
    };
    let (wkt, geo_keys) = (String::from_utf8_lossy(record(WKT)), record(GEO_KEYS));
    [
        unit_of_wkt(&wkt).or_else(|| unit_of_geo_keys(geo_keys, LINEAR_UNIT)),
        height_unit_of_wkt(&wkt).or_else(|| unit_of_geo_keys(geo_keys, HEIGHT_UNIT)),
    ]
}

/// Returns a note if the header states another unit for z than for x and y.
fn note_on_heights(header: &Header) -> Option<String> {
    let [Some(plan), Some(height)] = units(header) else { return None };
    (plan != height).then(|| {
        format!("x and y are in {plan}, but z is in {height}; planish expects one unit: convert z, or x and y")
    })
}

/// Largest return number that headers before LAS 1.4 can count.
const MOST_RETURNS: u8 = 5;

/// The colour channels of a record.
const CHANNELS: [&str; 3] = ["red", "green", "blue"];

/// Converts the points of a cloud to records.
pub(crate) struct Records {
    header: Header,
    fields: Vec<Field>,
    /// The identity of the file that the cloud was read from.
    identity: Option<Identity>,
}

impl Records {
    /// Creates an encoder for the `kept` points of clouds that have the columns of `cloud`.
    fn new(cloud: &PointCloud, kept: &[usize], compressed: bool) -> FormatResult<Self> {
        let has_colour = cloud.rgb().is_some();
        let of_file = cloud.provenance.get::<LasHeader>().map(|LasHeader(of_file)| of_file);
        let mut builder = match of_file {
            Some(of_file) => Builder::from(of_file.header.clone()),
            None => {
                let builder = new_builder(cloud, kept, has_colour).map_err(cannot)?;
                check_steps(&builder, cloud, kept)?;
                builder
            }
        };
        // Drop records that describe the old compression, and the COPC index.
        builder.vlrs.retain(|vlr| !["laszip encoded", "copc"].contains(&vlr.user_id.as_str()));
        builder.evlrs.retain(|vlr| vlr.user_id != "copc");
        builder.point_format.is_compressed = compressed;
        if let Some(AttributeValues::U8(returns)) = cloud.attribute("return_number").map(|returns| &returns.values)
            && returns.iter().any(|&number| number > MOST_RETURNS)
        {
            Self::count_all_returns(&mut builder);
        }
        let known = builder.clone().into_header().map_err(cannot)?;
        let mut fields: Vec<Field> = fields_of(&builder.point_format).into_iter().chain(extra_fields(&known)).collect();
        // Every other column becomes an extra field.
        let mut rest_is_described = false;
        let attributes = cloud.attributes.iter().filter(|attribute| attribute.name != "_");
        for attribute in attributes.filter(|attribute| !(has_colour && is_colour(&attribute.name))) {
            if !fields.iter().any(|field| field.name == attribute.name) {
                if !std::mem::replace(&mut rest_is_described, true) {
                    describe_rest(&mut builder, &fields)?;
                }
                add_extra_field(&mut builder, &mut fields, attribute)?;
            }
        }
        let identity = of_file.map(|of_file| of_file.identity);
        Ok(Self { header: builder.into_header().map_err(cannot)?, fields, identity })
    }

    /// Raises the version to at least 1.4, whose headers count the points of every return.
    fn count_all_returns(builder: &mut Builder) {
        if builder.version < Version::new(1, 4) {
            builder.version = Version::new(1, 4);
        }
    }

    /// Returns the records with the version raised to at least 1.4, for files with points beyond the fifth return.
    fn with_all_returns(self) -> FormatResult<Self> {
        let mut builder = Builder::from(self.header.clone());
        Self::count_all_returns(&mut builder);
        Ok(Self { header: builder.into_header().map_err(cannot)?, ..self })
    }

    /// Returns the size of a point record in bytes.
    fn len(&self) -> usize {
        usize::from(self.header.point_format().len())
    }

    /// Returns the records of the kept points, one after another.
    fn encode(&self, cloud: &PointCloud, kept: &[usize]) -> FormatResult<Vec<u8>> {
        let record = self.len();
        let mut raw = vec![0u8; record * kept.len()];
        let transforms = self.header.transforms();
        for (axis, transform) in [transforms.x, transforms.y, transforms.z].into_iter().enumerate() {
            let at = 4 * axis;
            for (point, &i) in raw.chunks_exact_mut(record).zip(kept) {
                let integer = transform.inverse(cloud.coordinate(axis, i)).map_err(cannot)?;
                point[at..at + 4].copy_from_slice(&integer.to_le_bytes());
            }
        }
        // Only 8-bit colours are converted here; 16-bit channels are ordinary columns.
        let colour = cloud.rgb();
        for field in self.fields.iter().filter(|field| colour.is_none() || !is_colour(&field.name)) {
            if let Some(attribute) = cloud.attribute(&field.name) {
                encode_field(field, attribute, kept, &mut raw, record)?;
            }
        }
        for (channel, name) in CHANNELS.into_iter().enumerate() {
            let (Some(colour), Some(field)) = (&colour, self.fields.iter().find(|field| field.name == name)) else {
                continue;
            };
            let values: Vec<u16> = colour.iter().map(|rgb| u16::from(rgb[channel]) * 257).collect();
            let attribute = Attribute { name: name.to_owned(), count: 1, values: values.into() };
            encode_field(field, &attribute, kept, &mut raw, record)?;
        }
        Ok(raw)
    }
}

fn is_colour(name: &str) -> bool {
    ["rgb", "rgba"].contains(&name) || CHANNELS.contains(&name)
}

/// Returns an error if 32-bit steps would round coordinates by more than half a millimetre.
fn check_steps(builder: &Builder, cloud: &PointCloud, kept: &[usize]) -> FormatResult<()> {
    /// Maximum coordinate step that rounds by at most half a millimetre, in metres.
    const FINE_M: f64 = 1e-3;
    let las::Vector { x, y, z } = builder.transforms;
    for (axis, Transform { scale, offset }) in [x, y, z].into_iter().enumerate() {
        let is_moved = |&i: &usize| {
            let steps = (cloud.coordinate(axis, i) - offset) / scale;
            (steps - steps.round()).abs() * scale > 0.5 * FINE_M
        };
        if scale > FINE_M && kept.iter().any(is_moved) {
            let name = ["x", "y", "z"][axis];
            return Err(FormatError::Unsupported(format!(
                "LAS stores coordinates in 32 bits, so {name} would be rounded to steps of {scale} m; remove points \
                 far from all others with `planish clean --crop`, or write another format"
            )));
        }
    }
    Ok(())
}

/// Returns a header for a cloud that was not read from LAS.
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
        // Small clouds get a step of a millionth of their size, rounded down to a power of ten.
        let small = 10f64.powf((largest * 1e-6).log10().floor());
        let mut scale = if small > 0.0 { SCALE_M.min(small) } else { SCALE_M };
        while largest / scale > LARGEST_INTEGER {
            scale *= 10.0;
        }
        Transform { scale, offset: origin }
    };
    builder.transforms = las::Vector {
        x: transform(cloud.positions.x(), cloud.origin_m[0]),
        y: transform(cloud.positions.y(), cloud.origin_m[1]),
        z: transform(cloud.positions.z(), cloud.origin_m[2]),
    };
    Ok(builder)
}
