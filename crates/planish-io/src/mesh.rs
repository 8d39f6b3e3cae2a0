//! Reads the vertices of meshes (OBJ, OFF and STL) as unorganized clouds. Faces are dropped, and none of these formats
//! can be written from a cloud.

use std::collections::HashSet;

use super::columns::cloud_from_columns;
use super::{FormatResult, ReadOptions, quoted, text_of};
use planish_core::{Attribute, FormatError, PointCloud, Precision};

/// Reads the vertices (lines `v x y z`) of a Wavefront OBJ, with optional colours.
pub(super) fn decode_obj(bytes: &[u8], options: &ReadOptions, notes: &mut Vec<String>) -> FormatResult<PointCloud> {
    let text = text_of(bytes);
    let lines = (1..).zip(text.lines()).filter_map(|(number, line)| {
        let line = line.split('#').next().unwrap_or_default().trim();
        line.strip_prefix("v").filter(|rest| rest.starts_with([' ', '\t'])).map(|rest| (number, rest))
    });
    options.check(lines.clone().count(), 8 * 6 + 12)?;
    let mut columns: [Vec<f64>; 6] = Default::default();
    let mut colourless = 0;
    for (number, line) in lines {
        let values: Option<Vec<f64>> = line.split_whitespace().map(|cell| cell.parse().ok()).collect();
        let values = values.filter(|values| [3, 4, 6, 7].contains(&values.len())).ok_or_else(|| {
            FormatError::Malformed(format!(
                "line {number}: {} is not a vertex (v x y z, optionally followed by r g b or w)",
                quoted(line)
            ))
        })?;
        // A fourth or seventh number is a weight.
        let has_colour = values.len() >= 6;
        colourless += usize::from(!has_colour);
        for (k, column) in columns.iter_mut().enumerate() {
            column.push(if k < 3 || has_colour { values[k] } else { 0.0 });
        }
    }
    let count = columns[0].len();
    let [x, y, z, red, green, blue] = columns;
    let mut all = vec![column("x", x), column("y", y), column("z", z)];
    if colourless < count {
        if colourless > 0 {
            notes.push(format!("{colourless} of {count} vertices have no colour; they are black"));
        }
        let channels = || [&red, &green, &blue].into_iter().flatten();
        let is_share = channels().all(|value| value.is_nan() || (0.0..=1.0).contains(value));
        let scale = if is_share { 255.0 } else { 1.0 };
        match channels().filter(|value| value.is_nan()).count() {
            0 => {}
            missing => notes.push(format!("{missing} colour values are missing; they become 0")),
        }
        match channels().filter(|value| !value.is_nan() && !(0.0..=255.0).contains(*value)).count() {
            beyond if beyond == 0 || !crate::HAS_ROOM => {}
            beyond => notes.push(format!("{beyond} colour values are not within 0 to 255; they are clipped")),
        }
        for (name, values) in [("red", red), ("green", green), ("blue", blue)] {
            let values: Vec<u8> = values.into_iter().map(|value| (scale * value).round() as u8).collect();
            all.push(Attribute { name: name.into(), count: 1, values: values.into() });
        }
    }
    with_points(all, "OBJ")
}

/// Reads the vertices of an OFF, with optional normals and colours.
#[cfg(feature = "more-formats")]
pub(super) fn decode_off(bytes: &[u8], options: &ReadOptions, notes: &mut Vec<String>) -> FormatResult<PointCloud> {
    let text = text_of(bytes);
    let without_comment = |line| str::split(line, '#').next().unwrap_or_default().trim();
    let mut lines = (1..).zip(text.lines().map(without_comment)).filter(|(_, line)| !line.is_empty());
    let mut first = lines.next().map_or("", |(_, line)| line).split_whitespace();
    let kind = first.next().unwrap_or_default();
    let (Some((prefix, behind)), false) = (kind.split_once("OFF"), kind.contains("4OFF") || kind.contains("nOFF"))
    else {
        return Err(FormatError::Unsupported(format!(
            "unsupported OFF header {}; expected OFF, NOFF, COFF or CNOFF",
            quoted(kind)
        )));
    };
    // The first line may also contain the numbers of vertices, faces and edges.
    let of_first = [behind].into_iter().chain(first).find(|word| !word.is_empty());
    let counts = of_first.or_else(|| lines.next().map(|(_, line)| line)).unwrap_or_default();
    let count = counts.split_whitespace().next().and_then(|count| count.parse::<usize>().ok()).ok_or_else(|| {
        FormatError::Malformed(format!(
            "expected the numbers of vertices, faces and edges, but found {}",
            quoted(counts)
        ))
    })?;
    if count > bytes.len() {
        return Err(FormatError::Malformed(format!(
            "the file is truncated: it states {count} vertices, but has {} bytes",
            bytes.len()
        )));
    }
    options.check(count, 8 * 10 + 12)?;
    let has_normals = prefix.contains('N');
    let mut names = vec!["x", "y", "z"];
    names.extend(if has_normals { &["normal_x", "normal_y", "normal_z"][..] } else { &[] });
    names.extend(if prefix.contains('C') { &["red", "green", "blue"][..] } else { &[] });
    let mut columns: Vec<Vec<f64>> = vec![Vec::new(); names.len()];
    // Colours range from 0 to 1 or from 0 to 255. Alpha, which may follow, can have the other range.
    let (mut largest, mut largest_alpha, mut has_fraction, mut beyond) = (0.0f64, 0.0f64, false, 0);
    for _ in 0..count {
        let (number, line) = lines.next().ok_or_else(|| {
            FormatError::Malformed(format!(
                "the file is truncated: it states {count} vertices, but has {}",
                columns[0].len()
            ))
        })?;
        let values: Option<Vec<f64>> = line.split_whitespace().map(|word| word.parse().ok()).collect();
        let values = values.filter(|values| values.len() >= names.len()).ok_or_else(|| {
            FormatError::Malformed(format!(
                "line {number}: {} is not a vertex of {} numbers",
                quoted(line),
                names.len()
            ))
        })?;
        let first_colour = 3 + 3 * usize::from(has_normals);
        for value in &values[first_colour.min(names.len())..names.len()] {
            largest = largest.max(*value);
            has_fraction |= value.fract() != 0.0;
            beyond += usize::from(!(0.0..=255.0).contains(value));
        }
        largest_alpha = values[names.len()..].iter().copied().fold(largest_alpha, f64::max);
        columns.iter_mut().zip(values).for_each(|(column, value)| column.push(value));
    }
    if beyond > 0 {
        notes.push(format!("{beyond} colour values are not within 0 to 255; they are clipped"));
    }
    let is_share = largest <= 1.0 && (has_fraction || largest_alpha <= 1.0);
    let scale = if is_share { 255.0 } else { 1.0 };
    let typed = |(name, values): (&str, Vec<f64>)| match name {
        "red" | "green" | "blue" => {
            let values: Vec<u8> = values.into_iter().map(|value| (scale * value).round() as u8).collect();
            Attribute { name: name.into(), count: 1, values: values.into() }
        }
        "x" | "y" | "z" => column(name, values),
        _ => {
            let values: Vec<f32> = values.into_iter().map(|value| value as f32).collect();
            Attribute { name: name.into(), count: 1, values: values.into() }
        }
    };
    with_points(names.into_iter().zip(columns).map(typed).collect(), "OFF")
}

/// Reads the corners of the triangles in an STL file; each distinct position becomes one point.
pub(super) fn decode_stl(bytes: &[u8], options: &ReadOptions) -> FormatResult<PointCloud> {
    const HEADER: usize = 84;
    const TRIANGLE: usize = 50;
    let stated =
        bytes.get(80..HEADER).map(|count| u32::from_le_bytes([count[0], count[1], count[2], count[3]]) as usize);
    let is_binary = stated.is_some_and(|count| Some(bytes.len()) == count.checked_mul(TRIANGLE).map(|n| n + HEADER));
    let distinct: Vec<[f64; 3]> = if is_binary {
        options.check(stated.unwrap_or(0), 3 * 80)?;
        let corner = |triangle: &[u8], k: usize| -> [f64; 3] {
            let at = 12 * (k + 1);
            std::array::from_fn(|axis| {
                f64::from(f32::from_le_bytes(std::array::from_fn(|i| triangle[at + 4 * axis + i])))
            })
        };
        let triangles = bytes[HEADER..].chunks_exact(TRIANGLE);
        distinct(triangles.flat_map(|triangle| (0..3).map(move |k| Ok(corner(triangle, k)))))?
    } else if bytes.starts_with(b"solid") {
        let text = text_of(bytes);
        let lines = (1..).zip(text.lines().map(str::trim)).filter_map(|(number, line)| {
            let (word, rest) = line.split_at_checked("vertex".len())?;
            word.eq_ignore_ascii_case("vertex").then_some((number, rest))
        });
        options.check(lines.clone().count(), 80)?;
        distinct(lines.map(|(number, line)| {
            let values: Option<Vec<f64>> = line.split_whitespace().map(|cell| cell.parse().ok()).collect();
            let values = values.and_then(|values| <[f64; 3]>::try_from(values).ok());
            // Numbers beyond the range of f64 are parsed as infinite.
            let has_word = || line.contains(['i', 'I']);
            let values = values.filter(|values| values.iter().all(|value| !value.is_infinite()) || has_word());
            let text = || format!("line {number}: a vertex needs three numbers of at most 3.4e38");
            values.ok_or_else(|| FormatError::Malformed(text()))
        }))?
    } else {
        let triangles = stated.unwrap_or(0);
        return Err(FormatError::Malformed(format!(
            "not an STL file: it does not begin with \"solid\", and {triangles} triangles do not match {} bytes",
            bytes.len()
        )));
    };
    if distinct.is_empty() {
        return Err(FormatError::Malformed("the STL has no triangles".into()));
    }
    let axis = |axis: usize| distinct.iter().map(|corner| corner[axis]).collect();
    with_points(vec![column("x", axis(0)), column("y", axis(1)), column("z", axis(2))], "STL")
}

/// Returns each corner once, in the order of the first occurrences.
fn distinct(corners: impl Iterator<Item = FormatResult<[f64; 3]>>) -> FormatResult<Vec<[f64; 3]>> {
    let (mut seen, mut distinct) = (HashSet::new(), Vec::new());
    for corner in corners {
        let corner = corner?;
        if seen.insert(corner.map(|value| (value + 0.0).to_bits())) {
            distinct.push(corner);
        }
    }
    Ok(distinct)
}

/// Returns a column with one value per point.
fn column(name: &str, values: Vec<f64>) -> Attribute {
    Attribute { name: name.into(), count: 1, values: values.into() }
}

fn with_points(columns: Vec<Attribute>, name: &str) -> FormatResult<PointCloud> {
    if columns[0].values.is_empty() {
        return Err(FormatError::Malformed(format!("the {name} has no vertices")));
    }
    let mut cloud = cloud_from_columns(columns)?;
    // Text files do not state a type. Coordinates near the origin do not need f64.
    cloud.position_columns.precision = Precision::AsNeeded;
    Ok(cloud)
}
