//! Reads and writes lidar scans stored as plain f32: KITTI's `.bin` files with x, y, z and intensity, nuScenes'
//! `.pcd.bin` files with an additional ring, and other `.bin` files with colours.
//!
//! The files have no header. The number of columns is detected from the values unless the options state it.

use super::write::check_f32;
use super::xyz_text::guessed_names;
use super::{CloudRef, FormatResult, ReadOptions};
use planish_core::{Attribute, AttributeValues, FormatError, PointCloud, Provenance};

const FIELDS: [&str; 2] = ["intensity", "ring"];
/// The supported numbers of columns.
const COLUMNS: std::ops::RangeInclusive<usize> = 3..=16;
/// Maximum number of values from which the number of columns is detected.
const SAMPLE: usize = 1 << 16;

/// The columns of a file after x, y and z.
#[derive(Debug, PartialEq)]
struct Columns {
    names: Vec<String>,
    /// The factor by which stored colours were multiplied to get bytes: 255 or 1.
    colour_scale: f64,
}

pub(super) fn decode(
    bytes: &[u8],
    has_ring: bool,
    options: &ReadOptions,
    notes: &mut Vec<String>,
) -> FormatResult<PointCloud> {
    if !bytes.len().is_multiple_of(4) {
        return Err(FormatError::Malformed(format!(
            "{} bytes are not a multiple of 4; a lidar's .bin contains 4-byte floats",
            bytes.len()
        )));
    }
    let sample = Sample::of(bytes);
    if options.columns.is_none() && !sample.is_of_floats() {
        return Err(FormatError::Malformed(
            "the values do not look like a lidar's positions in metres; state the number of columns of a lidar's .bin, \
             or save raw depth as PNG, TIFF or .npy"
                .into(),
        ));
    }
    let count = match options.columns {
        Some(count) if COLUMNS.contains(&count) => count,
        Some(count) => {
            return Err(FormatError::Unsupported(format!(
                "{count} columns are unsupported; expected 3 (x, y, z) to 16"
            )));
        }
        None if has_ring => 5,
        None => sample.columns(bytes.len() / 4).ok_or_else(|| {
            FormatError::Unsupported(
                "the number of columns is ambiguous; state it, for example 4 for KITTI or 5 for nuScenes".into(),
            )
        })?,
    };
    let record = 4 * count;
    if !bytes.len().is_multiple_of(record) {
        return Err(FormatError::Malformed(format!(
            "{} bytes do not divide into points of {count} 4-byte floats; the lidar's .bin is truncated or has \
             another layout",
            bytes.len()
        )));
    }
    // Memory for the columns, and for f64 copies of the columns whose names are guessed.
    options.check(bytes.len(), 4)?;
    let column = |k: usize| -> Vec<f32> {
        let value =
            |point: &[u8]| f32::from_le_bytes([point[4 * k], point[4 * k + 1], point[4 * k + 2], point[4 * k + 3]]);
        bytes.chunks_exact(record).map(value).collect()
    };
    let [x, y, z] = [0, 1, 2].map(column);
    let mut cloud = PointCloud::new(planish_core::Xyz::from_arrays([x, y, z])?);
    let mut rest: Vec<Vec<f32>> = (3..count).map(column).collect();
    let colour_scale =
        if count == 6 && rest.iter().flatten().all(|value| is_share_of_bytes(*value)) { 255.0 } else { 1.0 };
    rest.iter_mut().flatten().filter(|_| colour_scale != 1.0).for_each(|value| *value = (255.0 * *value).round());
    let names = names_of(&rest, has_ring);
    for (name, values) in names.iter().zip(rest) {
        let values: AttributeValues = match is_colour(name) {
            true => values.iter().map(|value| *value as u8).collect::<Vec<u8>>().into(),
            false => values.into(),
        };
        cloud.attributes.push(Attribute { name: name.clone(), count: 1, values });
    }
    if options.columns.is_none() && !has_ring {
        notes.push(format!("its {count} columns are read as x y z {}", names.join(" ")).trim_end().to_owned());
    }
    cloud.provenance = Provenance::new(Columns { names, colour_scale });
    Ok(cloud)
}

/// Returns true if the value is a byte divided by 255, which is how SUN RGB-D stores colours.
fn is_share_of_bytes(value: f32) -> bool {
    (0.0..=1.0).contains(&value) && (255.0 * value - (255.0 * value).round()).abs() < 1e-3
}

fn is_colour(name: &str) -> bool {
    ["red", "green", "blue"].contains(&name)
}

/// Returns the names of the columns after x, y and z.
fn names_of(rest: &[Vec<f32>], has_ring: bool) -> Vec<String> {
    let is_ring = |values: &Vec<f32>| values.iter().all(|value| value.fract() == 0.0);
    match rest {
        [_, ring] if has_ring || is_ring(ring) => FIELDS.map(str::to_owned).to_vec(),
        _ => {
            let columns: Vec<Vec<f64>> =
                rest.iter().map(|values| values.iter().map(|&v| f64::from(v)).collect()).collect();
            let columns: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
            guessed_names(&[&[&[][..]; 3], &columns[..]].concat(), false).split_off(3)
        }
    }
}

/// The first values of a file, at most [`SAMPLE`].
struct Sample(Vec<f32>);

impl Sample {
    fn of(bytes: &[u8]) -> Self {
        let (values, _) = bytes.as_chunks::<4>();
        Self(values.iter().take(SAMPLE).map(|bytes| f32::from_le_bytes(*bytes)).collect())
    }

    /// Returns true if most values are numbers of a plausible size for coordinates. If many are NaN, too large or too
    /// small, the file has another type.
    fn is_of_floats(&self) -> bool {
        let numbers: Vec<f32> = self.0.iter().copied().filter(|value| !value.is_nan()).collect();
        let is_length = |value: &&f32| **value == 0.0 || (1e-6..1e9).contains(&value.abs());
        let lengths = numbers.iter().filter(is_length).count();
        2 * numbers.len() >= self.0.len()
            && 10 * lengths >= 9 * numbers.len()
            && numbers.iter().any(|value| *value != 0.0)
    }

    /// Returns the number of columns of a file with `values` values; `None` if it is ambiguous.
    fn columns(&self, values: usize) -> Option<usize> {
        // Smaller differences occur by chance, especially with few values.
        let tolerance = 0.03 + (self.0.len() as f64).sqrt().recip();
        let shares: Vec<(usize, f64)> = (3..=8).map(|lag| (lag, self.similar(lag))).collect();
        let best = shares.iter().map(|(_, share)| *share).fold(0.0, f64::max);
        let fits = |columns: &usize| {
            let is_best = shares.iter().any(|&(lag, share)| lag == *columns && share >= best - tolerance);
            is_best && values.is_multiple_of(*columns) && self.fits(*columns)
        };
        let mut fitting = (3..=6).filter(fits);
        fitting.next().filter(|_| fitting.next().is_none())
    }

    /// Returns the fraction of values that resemble the value `lag` positions later: both are integers or neither is,
    /// and both have the same binary exponent.
    fn similar(&self, lag: usize) -> f64 {
        let kind = |value: f32| {
            (value.fract() == 0.0, if value == 0.0 { i32::MIN } else { value.abs().log2().floor() as i32 })
        };
        let pairs = || self.0.iter().zip(self.0.iter().skip(lag));
        let same = pairs().filter(|(a, b)| kind(**a) == kind(**b)).count();
        same as f64 / pairs().count().max(1) as f64
    }

    /// Returns true if the values after x, y and z are plausible for a file with `columns` columns.
    fn fits(&self, columns: usize) -> bool {
        let column = |k: usize| self.0.chunks_exact(columns).map(move |point| point[k]);
        let all = |range: std::ops::Range<usize>, test: fn(f32) -> bool| range.into_iter().all(|k| column(k).all(test));
        let is_byte = |value: f32| (0.0..=255.0).contains(&value) && value.fract() == 0.0;
        match columns {
            3 => true,
            4 => all(3..4, |value| value >= 0.0),
            5 => all(3..4, |value| value >= 0.0) && all(4..5, |value| value >= -1.0 && value.fract() == 0.0),
            _ => all(3..6, is_byte) || all(3..6, is_share_of_bytes) || self.has_normals(),
        }
    }

    /// Returns true if columns 4 to 6 of a file with six columns are unit vectors.
    fn has_normals(&self) -> bool {
        let is_unit = |p: &[f32]| ((p[3] * p[3] + p[4] * p[4] + p[5] * p[5]).sqrt() - 1.0).abs() < 0.02;
        self.0.chunks_exact(6).all(is_unit)
    }
}

/// Encodes x, y and z, followed by the same columns as in the `.bin` file that the cloud was read from. For clouds
/// from other files, the columns are the intensity and, if `has_ring`, the ring. Missing fields become 0.
pub(super) fn encode(cloud: CloudRef<'_>, has_ring: bool) -> FormatResult<Vec<u8>> {
    let points = cloud.points();
    let own = points.provenance.get::<Columns>().filter(|_| !has_ring);
    let fields = own.map_or_else(
        || FIELDS[..if has_ring { 2 } else { 1 }].iter().map(|&name| name.to_owned()).collect(),
        |own| own.names.clone(),
    );
    let colour_scale = own.map_or(1.0, |own| own.colour_scale);
    let other = points.attributes.iter().find(|attribute| !fields.contains(&attribute.name));
    if let Some(Attribute { name, .. }) = other {
        return Err(FormatError::Unsupported(format!(
            "a lidar's .bin stores x, y, z{}{}, but the cloud has the field {name}; write .pcd, .ply or .las",
            if fields.is_empty() { "" } else { " and " },
            fields.join(", ")
        )));
    }
    check_f32(points.origin_m, points.positions.iter())?;
    let values: Vec<Option<&AttributeValues>> =
        fields.iter().map(|name| points.attribute(name).map(|attribute| &attribute.values)).collect();
    let mut bytes = Vec::with_capacity(points.len() * 4 * (3 + fields.len()));
    for (i, p) in points.positions.iter().enumerate() {
        let position = (0..3).map(|axis| (points.origin_m[axis] + f64::from(p[axis])) as f32);
        let rest = values.iter().zip(&fields).map(|(values, name)| {
            let value = values.map_or(0.0, |values| values.get_f64(i));
            (if is_colour(name) { value / colour_scale } else { value }) as f32
        });
        position.chain(rest).for_each(|value| bytes.extend_from_slice(&value.to_le_bytes()));
    }
    if !bytes.is_empty() && !Sample::of(&bytes).is_of_floats() {
        let reason =
            "a lidar's .bin with these values would not be recognized, since it has no header; write .pcd or .ply";
        return Err(FormatError::Unsupported(reason.into()));
    }
    Ok(bytes)
}
