//! The names of columns: those that a file gives them, or guessed from their number and values.

/// The length of a unit normal written with few digits.
const UNIT: std::ops::RangeInclusive<f64> = 0.98..=1.02;

/// Other names of x, y and z: maps and surveys, ParaView, CloudCompare.
const AXES: [[&str; 3]; 7] = [
    ["easting", "northing", "elevation"],
    ["easting", "northing", "height"],
    ["east", "north", "height"],
    ["east", "north", "up"],
    ["points:0", "points:1", "points:2"],
    ["coord._x", "coord._y", "coord._z"],
    ["position_x", "position_y", "position_z"],
];

/// Returns the names of the columns of a line, if it has x, y and z among them.
pub(super) fn names_of(cells: &[&str]) -> Option<Vec<String>> {
    let full: Vec<String> = cells.iter().map(|cell| in_one_word(cell)).collect();
    let short: Vec<String> = cells.iter().map(|cell| name_of(cell)).collect();
    // Without its unit in brackets, a name may be that of another column too.
    let is_shared = |name: &String| short.iter().filter(|other| *other == name).count() > 1;
    let mut names: Vec<String> =
        short.iter().zip(full).map(|(name, full)| if is_shared(name) { full } else { name.clone() }).collect();
    let has = |names: &[String], axes: [&str; 3]| axes.iter().all(|axis| names.iter().any(|name| name == axis));
    if !has(&names, ["x", "y", "z"]) {
        let axes = AXES.into_iter().find(|axes| has(&names, *axes))?;
        for (from, to) in axes.into_iter().zip(["x", "y", "z"]) {
            names.iter_mut().filter(|name| *name == from).for_each(|name| *name = to.to_owned());
        }
    }
    Some(names)
}

fn in_one_word(cell: &str) -> String {
    cell.to_ascii_lowercase().split_whitespace().collect::<Vec<_>>().join("_")
}

/// Converts a column header to the field name of other formats, without its unit.
fn name_of(cell: &str) -> String {
    let name = in_one_word(cell.split(['[', '(']).next().unwrap_or(cell));
    match name.as_str() {
        "r" => "red".into(),
        "g" => "green".into(),
        "b" => "blue".into(),
        "nx" => "normal_x".into(),
        "ny" => "normal_y".into(),
        "nz" => "normal_z".into(),
        _ => name,
    }
}

pub(super) fn is_byte(value: f64) -> bool {
    (0.0..=255.0).contains(&value) && value.fract() == 0.0
}

/// Guesses the names of columns from their number and values. In a file that states its number of points, such as PTS,
/// intensity precedes colours.
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
        // First normals, since those along an axis might be colours too.
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
