//! Column names, read from the file or guessed from the number and values of the columns.

use super::super::{FormatResult, LengthUnit, quoted};
use planish_core::FormatError;

/// Range of lengths that a unit normal may have if it is written with few digits.
const UNIT: std::ops::RangeInclusive<f64> = 0.98..=1.02;

/// Maximum number of cells in a line of column names.
pub(super) const MOST_NAMED: usize = 1000;

/// Units of length that planish cannot convert. Other words in brackets, such as PCV or 0, are not units.
const OTHER_UNITS: [&str; 16] = [
    "km",
    "kilometre",
    "kilometres",
    "kilometer",
    "kilometers",
    "dm",
    "um",
    "µm",
    "μm",
    "nm",
    "micron",
    "microns",
    "yd",
    "mi",
    "px",
    "deg",
];

/// Other names for x, y and z, used in maps and surveys, and by ParaView and CloudCompare.
const AXES: [[&str; 3]; 9] = [
    ["easting", "northing", "elevation"],
    ["easting", "northing", "height"],
    ["east", "north", "height"],
    ["east", "north", "up"],
    ["points:0", "points:1", "points:2"],
    ["points_0", "points_1", "points_2"],
    ["points_m_xyz:0", "points_m_xyz:1", "points_m_xyz:2"],
    ["coord._x", "coord._y", "coord._z"],
    ["position_x", "position_y", "position_z"],
];

/// Returns the column names in a line; `None` unless x, y and z are among them.
pub(super) fn names_of(cells: &[&str]) -> Option<Vec<String>> {
    if cells.len() > MOST_NAMED {
        return None;
    }
    let short: Vec<String> = cells.iter().map(|cell| name_of(cell)).collect();
    // Names that differ only in their brackets or capitals are kept in full.
    let is_shared = |name: &String| short.iter().filter(|other| other.eq_ignore_ascii_case(name)).count() > 1;
    let name = |(name, cell): (&String, &&str)| if is_shared(name) { in_one_word(cell) } else { name.clone() };
    let mut names: Vec<String> = short.iter().zip(cells).map(name).collect();
    // Without g and b, r is a range or a reflectance, not a colour.
    let letters = ["r", "g", "b"];
    if !letters.iter().all(|letter| cells.iter().any(|cell| cell.trim().eq_ignore_ascii_case(letter))) {
        for (name, cell) in names.iter_mut().zip(cells) {
            if letters.iter().any(|letter| cell.trim().eq_ignore_ascii_case(letter)) {
                *name = in_one_word(cell);
            }
        }
    }
    let has = |names: &[String], axes: [&str; 3]| axes.iter().all(|axis| names.iter().any(|name| name == axis));
    if !has(&names, ["x", "y", "z"]) {
        let axes = AXES.into_iter().find(|axes| has(&names, *axes))?;
        for (from, to) in axes.into_iter().zip(["x", "y", "z"]) {
            names.iter_mut().filter(|name| *name == from).for_each(|name| *name = to.to_owned());
        }
    }
    Some(names)
}

/// Returns the unit stated in brackets after the names x, y and z; `None` if it is missing or is the metre.
pub(super) fn unit_of(cells: &[&str], names: &[String]) -> FormatResult<Option<LengthUnit>> {
    let in_brackets = |cell: &str| -> FormatResult<Option<LengthUnit>> {
        let Some((_, rest)) = cell.split_once(['[', '(']) else { return Ok(None) };
        let stated = rest.trim_end_matches([']', ')']).trim().to_ascii_lowercase();
        let known = match &stated[..] {
            symbol if !crate::HAS_ROOM => return Ok(symbol.parse().ok()),
            "metre" | "metres" | "meter" | "meters" => LengthUnit::METRE,
            "millimetre" | "millimetres" | "millimeter" | "millimeters" => LengthUnit::MILLIMETRE,
            "centimetre" | "centimetres" | "centimeter" | "centimeters" => LengthUnit::CENTIMETRE,
            "inches" => LengthUnit::INCH,
            "feet" | "foot" => LengthUnit::FOOT,
            "ftus" | "us survey foot" | "us survey feet" => LengthUnit::US_SURVEY_FOOT,
            symbol => match symbol.parse() {
                Ok(unit) => unit,
                Err(_) if OTHER_UNITS.contains(&symbol) => {
                    return Err(FormatError::Unsupported(format!(
                        "x, y and z are in the unsupported unit {}; convert them to metres",
                        quoted(symbol)
                    )));
                }
                Err(_) => return Ok(None),
            },
        };
        Ok(Some(known))
    };
    let axes = cells.iter().zip(names).filter(|(_, name)| ["x", "y", "z"].contains(&name.as_str()));
    let units: Vec<Option<LengthUnit>> = axes.map(|(cell, _)| in_brackets(cell)).collect::<FormatResult<_>>()?;
    if units.windows(2).any(|pair| pair[0] != pair[1]) && units.iter().flatten().any(|unit| !unit.is_metre()) {
        return Err(FormatError::Unsupported(format!("x, y and z are in different units: {}", cells.join(", "))));
    }
    Ok(units.into_iter().flatten().find(|unit| !unit.is_metre()))
}

fn in_one_word(cell: &str) -> String {
    cell.split_whitespace().collect::<Vec<_>>().join("_")
}

/// Field names with the same meaning in every format. Capitals and units do not matter.
const KNOWN: [&str; 25] = [
    "x",
    "y",
    "z",
    "red",
    "green",
    "blue",
    "alpha",
    "rgb",
    "rgba",
    "intensity",
    "reflectance",
    "normal_x",
    "normal_y",
    "normal_z",
    "curvature",
    "confidence",
    "classification",
    "label",
    "ring",
    "time",
    "timestamp",
    "gps_time",
    "return_number",
    "number_of_returns",
    "point_source_id",
];

/// Converts a column header to the field name that other formats use. Known names lose their capitals and units.
fn name_of(cell: &str) -> String {
    let name = in_one_word(cell.split(['[', '(']).next().unwrap_or(cell)).to_ascii_lowercase();
    match name.as_str() {
        "r" => "red".into(),
        "g" => "green".into(),
        "b" => "blue".into(),
        "nx" => "normal_x".into(),
        "ny" => "normal_y".into(),
        "nz" => "normal_z".into(),
        known if KNOWN.contains(&known) || AXES.iter().flatten().any(|axis| *axis == known) => name,
        _ => in_one_word(cell),
    }
}

pub(super) fn is_byte(value: f64) -> bool {
    (0.0..=255.0).contains(&value) && value.fract() == 0.0
}

/// Returns true if the intensity is the first of four columns of bytes and not the last. The test is that the channels
/// of a colour differ less from each other than from the intensity.
fn is_intensity_first(columns: &[&[f64]]) -> bool {
    let are_bytes = |k: usize| columns[k].iter().all(|value| is_byte(*value));
    let difference = |a: usize, b: usize| columns[a].iter().zip(columns[b]).map(|(a, b)| (a - b).abs()).sum::<f64>();
    // The last column is mostly constant if it is alpha.
    let is_constant = |k: usize| columns[k].windows(2).all(|pair| pair[0] == pair[1]);
    (1..4).all(are_bytes) && !is_constant(3) && (!are_bytes(0) || difference(2, 3) < 0.5 * difference(0, 1))
}

/// Guesses column names from the number and values of the columns. If `is_pts`, the file states its number of points,
/// as PTS does, and intensity precedes colours.
pub(crate) fn guessed_names(columns: &[&[f64]], is_pts: bool) -> Vec<String> {
    let colours = |from: usize| columns[from..from + 3].iter().copied().flatten().all(|&value| is_byte(value));
    let normals = |from: usize| {
        let [x, y, z] = [columns[from], columns[from + 1], columns[from + 2]];
        x.iter().zip(y).zip(z).all(|((x, y), z)| UNIT.contains(&(x * x + y * y + z * z).sqrt()))
    };
    let (colour, normal) = (["red", "green", "blue"], ["normal_x", "normal_y", "normal_z"]);
    let mut names = vec!["x", "y", "z"];
    while names.len() < columns.len() {
        let at = names.len();
        let left = columns.len() - at;
        if is_pts && at == 3 && left >= 4 && colours(4) && !normals(at) {
            names.push("intensity");
            continue;
        }
        if at == 3 && left == 4 && is_intensity_first(&columns[3..]) && !normals(at) {
            names.push("intensity");
            continue;
        }
        // Normals are tested first, since normals along an axis could also be colours.
        if left >= 3 && !names.contains(&"normal_x") && normals(at) {
            names.extend(normal);
        } else if left >= 3 && !names.contains(&"red") && colours(at) {
            names.extend(colour);
        } else if !names.contains(&"intensity") && (left == 1 || left == 4 || left == 7) {
            names.push("intensity");
        } else {
            break;
        }
    }
    let named = names.iter().map(|name| (*name).to_owned());
    named.chain((names.len() + 1..=columns.len()).map(|number| format!("column_{number}"))).collect()
}
