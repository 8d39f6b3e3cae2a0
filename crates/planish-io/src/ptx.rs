//! Leica's PTX: scans as text, each with its grid and pose. All scans become one cloud in the file's frame.

use glam::{DMat4, DVec3, DVec4};

use super::columns::cloud_from_columns;
use super::{FormatResult, ReadOptions, quoted, text_of};
use planish_core::{Attribute, AttributeValues, FormatError, PointCloud};

/// Number of lines in a scan's header: columns, rows, position, three axes, and the four rows of a matrix.
const HEADER: usize = 10;
/// Number of values per point, without and with a colour.
const COUNTS: [usize; 2] = [4, 7];
const SCAN: &str = "scan";

/// The points of all scans.
#[derive(Default)]
struct Points {
    axes: [Vec<f64>; 3],
    intensity: Vec<f32>,
    colours: [Vec<u8>; 3],
    scan: Vec<u16>,
    scanners_m: Vec<Option<[f64; 3]>>,
    /// Number of grid cells without a measurement.
    holes: usize,
    /// Number of points without a colour.
    colourless: usize,
    /// Number of colour values that a byte cannot store.
    odd_colours: usize,
}

/// The remaining lines of a file, with their line numbers.
struct Lines<'a, I: Iterator<Item = (usize, &'a str)>>(I);

impl<'a, I: Iterator<Item = (usize, &'a str)>> Lines<'a, I> {
    /// Returns the next line's number and its values.
    fn numbers(&mut self) -> FormatResult<(usize, Vec<f64>)> {
        let ended = || FormatError::Malformed("the PTX is truncated: it ends within a scan".into());
        let (number, line) = self.0.next().ok_or_else(ended)?;
        let values: Option<Vec<f64>> = line.split_whitespace().map(|word| word.parse().ok()).collect();
        match values {
            Some(values) => Ok((number, values)),
            None => Err(FormatError::Malformed(format!(
                "line {number} of the PTX has values that are not numbers: {}",
                quoted(line)
            ))),
        }
    }

    fn row<const N: usize>(&mut self) -> FormatResult<[f64; N]> {
        let (number, values) = self.numbers()?;
        let count = values.len();
        values
            .try_into()
            .map_err(|_| FormatError::Malformed(format!("line {number} of the PTX has {count} numbers instead of {N}")))
    }
}

pub(super) fn decode(bytes: &[u8], options: &ReadOptions, notes: &mut Vec<String>) -> FormatResult<PointCloud> {
    // Each point has a line of at least eight characters.
    options.check(bytes.len() / 8, 48)?;
    let text = text_of(bytes);
    let lines = (1..).zip(text.lines().map(str::trim)).filter(|(_, line)| !line.is_empty());
    let mut lines = Lines(lines.peekable());
    let mut points = Points::default();
    while lines.0.peek().is_some() {
        points.add_scan(&mut lines)?;
    }
    points.into_cloud(notes)
}

impl Points {
    fn add_scan<'a>(&mut self, lines: &mut Lines<'a, impl Iterator<Item = (usize, &'a str)>>) -> FormatResult<()> {
        let ([columns], [rows]) = (lines.row::<1>()?, lines.row::<1>()?);
        let position = lines.row::<3>()?;
        for _ in 0..3 {
            lines.row::<3>()?;
        }
        // The file's points are row vectors, to the left of the matrix, so its rows are the columns of `to_file`.
        let matrix = [lines.row::<4>()?, lines.row::<4>()?, lines.row::<4>()?, lines.row::<4>()?];
        let to_file = DMat4::from_cols_array_2d(&matrix);
        if !to_file.is_finite() || !DVec3::from(position).is_finite() {
            return Err(FormatError::Malformed("a scan's position or matrix has values that are not finite".into()));
        }
        // The translation belongs in the last row. Other programs would interpret the last column as a projection.
        if (to_file.row(3) - DVec4::W).length() > 1e-9 {
            return Err(FormatError::Unsupported(format!(
                "the last column of a scan's matrix is {:?} instead of 0, 0, 0, 1; write the translation in the last row",
                to_file.row(3).to_array()
            )));
        }
        let count = columns * rows;
        let is_whole = |number: f64| number >= 0.0 && number.fract() == 0.0;
        if !(is_whole(columns) && is_whole(rows) && count <= planish_core::MAX_PIXELS as f64) {
            return Err(FormatError::Malformed(format!(
                "a scan states an invalid size of {columns} columns and {rows} rows"
            )));
        }
        let scan = u16::try_from(self.scanners_m.len()).unwrap_or(u16::MAX);
        self.scanners_m.push(Some(position));
        for _ in 0..count as usize {
            let (number, values) = lines.numbers()?;
            if !COUNTS.contains(&values.len()) {
                let found = values.len();
                return Err(FormatError::Malformed(format!(
                    "line {number} of the PTX has {found} values; expected x, y, z, intensity, and optionally red, \
                     green, blue"
                )));
            }
            let point = DVec3::new(values[0], values[1], values[2]);
            if point == DVec3::ZERO {
                self.holes += 1;
                continue;
            }
            let point: DVec4 = to_file * point.extend(1.0);
            self.axes.iter_mut().zip(point.to_array()).for_each(|(axis, value)| axis.push(value));
            self.intensity.push(values[3] as f32);
            self.scan.push(scan);
            self.colourless += usize::from(values.len() == COUNTS[0]);
            for (channel, colours) in self.colours.iter_mut().enumerate() {
                let value = values.get(4 + channel).copied().unwrap_or_default();
                self.odd_colours += usize::from(!(0.0..=255.0).contains(&value) || value.fract() != 0.0);
                colours.push(value.round() as u8);
            }
        }
        Ok(())
    }

    fn into_cloud(self, notes: &mut Vec<String>) -> FormatResult<PointCloud> {
        let count = self.intensity.len();
        if self.scanners_m.is_empty() {
            return Err(FormatError::Malformed(format!("the PTX has fewer than the {HEADER} header lines of a scan")));
        }
        let column = |name: &str, values: AttributeValues| Attribute { name: name.into(), count: 1, values };
        let axes = ["x", "y", "z"].into_iter().zip(self.axes);
        let mut columns: Vec<Attribute> = axes.map(|(name, values)| column(name, values.into())).collect();
        columns.push(column("intensity", self.intensity.into()));
        if self.colourless < count {
            let colours = ["red", "green", "blue"].into_iter().zip(self.colours);
            columns.extend(colours.map(|(name, values)| column(name, values.into())));
            if self.odd_colours > 0 {
                notes.push(format!(
                    "{} colour values are not integers from 0 to 255; they are rounded",
                    self.odd_colours
                ));
            }
            if self.colourless > 0 {
                notes.push(format!("{} of {count} points have no colour; they are black", self.colourless));
            }
        }
        if self.scanners_m.len() > 1 {
            columns.push(column(SCAN, self.scan.into()));
        }
        if self.holes > 0 {
            notes.push(format!("{} grid cells without a measurement are dropped", self.holes));
        }
        let mut cloud = cloud_from_columns(columns)?;
        if let [Some(position)] = self.scanners_m[..] {
            cloud.pose.position_m = position;
        } else {
            cloud.set_scanners_m(self.scanners_m);
        }
        Ok(cloud)
    }
}
