//! Comparison of two clouds or depth images: distances, holes, fields.

use glam::DVec3;
use planish_core::internal::NeighbourSearch;
use planish_core::{Error, ParamError, PointCloud, SATURATED_DEPTH};
use planish_io::{Contents, LengthUnit, RgbImage};
use rayon::prelude::*;
use serde::Serialize;

/// The method by which points of two inputs are matched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Matching {
    /// By index: pixel with pixel, point with point.
    Index,
    /// Each point with the nearest point of the other input.
    Nearest,
}

/// The differences between two inputs.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[non_exhaustive]
pub struct Comparison {
    /// The method by which the points were matched.
    pub matching: Matching,
    /// The unit of all distances: `m`, or `raw` for depth images whose unit is unknown.
    pub unit: &'static str,
    /// Number of valid points (those that are not holes) in each input.
    pub valid: [usize; 2],
    /// Number of pixels or points that are valid only in the first input, and only in the second; 0 for
    /// [`Matching::Nearest`].
    pub only_in: [usize; 2],
    /// Distances from each point of the first input to its match.
    pub distances: Distances,
    /// Distances from each point of the second input to its match; `None` for [`Matching::Index`].
    pub back: Option<Distances>,
    /// Fields missing in one input, or with different values.
    pub fields: Vec<FieldDifference>,
}

/// Statistics of distances, in [`Comparison::unit`]; NaN (null in JSON) if there are none.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[non_exhaustive]
pub struct Distances {
    /// Number of matched points.
    pub count: usize,
    /// Number of matched points with a distance of 0.
    pub equal: usize,
    /// Mean.
    pub mean: f64,
    /// Root of the mean square.
    pub rms: f64,
    /// Median.
    pub median: f64,
    /// 95th percentile.
    pub p95: f64,
    /// Maximum.
    pub max: f64,
}

/// A field that differs.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[non_exhaustive]
pub struct FieldDifference {
    /// Name of the field.
    pub name: String,
    /// True for each of the two inputs that has the field.
    pub is_in: [bool; 2],
    /// Number of differing values and the largest difference; only for points matched by index.
    pub differing: Option<(usize, f64)>,
}

impl Comparison {
    /// Returns true if no distance exceeds `max`, no pixel is a hole in one input only, and either both inputs have
    /// points or neither has.
    pub fn is_within(&self, max: f64) -> bool {
        let is_close = |distances: &Distances| distances.count == 0 || distances.max <= max;
        let is_one_empty = (self.valid[0] == 0) != (self.valid[1] == 0);
        self.only_in == [0; 2] && !is_one_empty && is_close(&self.distances) && self.back.as_ref().is_none_or(is_close)
    }
}

/// Compares two inputs: by index if they have the same grid or the same number of points, and by nearest points
/// otherwise or on request. Raw depth is compared in raw units.
///
/// # Errors
/// If only one input is a depth image, depth images differ in shape or unit, or a cloud has too many points.
pub fn compare(a: &Contents, b: &Contents, nearest: bool) -> Result<Comparison, Error> {
    if let (Some(a), Some(b)) = (depths(a), depths(b)) {
        check_shapes(&a, &b)?;
        if a.unit != b.unit {
            return Err(mismatch(
                "depth in metres and raw depth",
                "both must have the same unit; give the camera to compare them as points",
            ));
        }
        let only = |a: &[f64], b: &[f64]| a.iter().zip(b).filter(|(a, b)| a.is_finite() && !b.is_finite()).count();
        let differences = a.values.iter().zip(&b.values).map(|(a, b)| (a - b).abs());
        let valid = [&a, &b].map(|image| image.values.iter().filter(|value| value.is_finite()).count());
        return Ok(Comparison {
            matching: Matching::Index,
            unit: a.unit,
            valid,
            only_in: [only(&a.values, &b.values), only(&b.values, &a.values)],
            distances: Distances::of(differences.filter(|distance| distance.is_finite()).collect()),
            back: None,
            fields: Vec::new(),
        });
    }
    let (Some((a, shape_a)), Some((b, shape_b))) = (points(a), points(b)) else {
        return Err(mismatch(
            "a depth image and a cloud",
            "both must be of the same kind; give the camera of the image to compare points",
        ));
    };
    let (points_a, points_b) = (positions(a), positions(b));
    let valid = [&points_a, &points_b].map(|points| points.iter().filter(|point| point.is_finite()).count());
    if shape_a != shape_b || nearest {
        let to = |from: &[DVec3], to: &[DVec3]| -> Result<Distances, Error> {
            let search = NeighbourSearch::new(to)?;
            let distance = |point: &DVec3| Some((*point - to[*search.nearest(*point, 1).first()?]).length());
            let found: Vec<Option<f64>> = from.par_iter().filter(|point| point.is_finite()).map(distance).collect();
            Ok(Distances::of(found.into_iter().flatten().collect()))
        };
        return Ok(Comparison {
            matching: Matching::Nearest,
            unit: "m",
            valid,
            only_in: [0; 2],
            distances: to(&points_a, &points_b)?,
            back: Some(to(&points_b, &points_a)?),
            fields: fields(a, b, false),
        });
    }
    let only = |a: &[DVec3], b: &[DVec3]| a.iter().zip(b).filter(|(a, b)| a.is_finite() && !b.is_finite()).count();
    let differences = points_a.iter().zip(&points_b).map(|(a, b)| (*a - *b).length());
    Ok(Comparison {
        matching: Matching::Index,
        unit: "m",
        valid,
        only_in: [only(&points_a, &points_b), only(&points_b, &points_a)],
        distances: Distances::of(differences.filter(|distance| distance.is_finite()).collect()),
        back: None,
        fields: fields(a, b, true),
    })
}

/// Draws the distances between two inputs on the same grid. Colours range from black for equal pixels, over blue and
/// green, to red for `full_scale`; pixels are white if both inputs have a hole and grey if one has. Returns `None`
/// without a common grid.
pub fn difference_map(a: &Contents, b: &Contents, full_scale: f64) -> Option<RgbImage> {
    const HOLE: [u8; 3] = [255; 3];
    const ONE_HOLE: [u8; 3] = [160; 3];
    let (width, height) = a.shape();
    if (width, height) != b.shape() || height < 2 {
        return None;
    }
    let distances: Vec<(f64, bool)> = match (depths(a), depths(b)) {
        (Some(a), Some(b)) => {
            let of = |(a, b): (&f64, &f64)| ((a - b).abs(), a.is_finite() || b.is_finite());
            a.values.iter().zip(&b.values).map(of).collect()
        }
        _ => {
            let (a, b) = (positions(points(a)?.0), positions(points(b)?.0));
            a.iter().zip(&b).map(|(a, b)| ((*a - *b).length(), a.is_finite() || b.is_finite())).collect()
        }
    };
    let colour = |(distance, is_point): &(f64, bool)| match (distance.is_finite(), is_point) {
        (true, _) => heat((distance / full_scale).min(1.0)),
        (false, true) => ONE_HOLE,
        (false, false) => HOLE,
    };
    Some(RgbImage { width, height, rgb: distances.iter().flat_map(colour).collect() })
}

/// Returns the heat map colour for `share`, 0 to 1: black, blue, green, yellow, red.
fn heat(share: f64) -> [u8; 3] {
    const STOPS: [[f64; 3]; 5] =
        [[0.0, 0.0, 0.0], [30.0, 60.0, 200.0], [30.0, 170.0, 90.0], [245.0, 200.0, 40.0], [215.0, 30.0, 30.0]];
    let at = share * (STOPS.len() - 1) as f64;
    let below = (at as usize).min(STOPS.len() - 2);
    let t = at - below as f64;
    [0, 1, 2].map(|channel| (STOPS[below][channel] * (1.0 - t) + STOPS[below + 1][channel] * t) as u8)
}

/// Depth values in `unit`; NaN for holes.
struct Depths {
    values: Vec<f64>,
    shape: (usize, usize),
    unit: &'static str,
}

fn depths(contents: &Contents) -> Option<Depths> {
    let shape = contents.shape();
    match contents {
        Contents::Depth(image) => {
            let value = |&raw: &u16| if raw == 0 || raw == SATURATED_DEPTH { f64::NAN } else { raw.into() };
            Some(Depths { values: image.raw.iter().map(value).collect(), shape, unit: "raw" })
        }
        Contents::DepthMetres { depth_m, .. } => {
            let value = |&depth_m: &f32| if depth_m > 0.0 { depth_m.into() } else { f64::NAN };
            Some(Depths { values: depth_m.iter().map(value).collect(), shape, unit: "m" })
        }
        _ => None,
    }
}

fn points(contents: &Contents) -> Option<(&PointCloud, (usize, usize))> {
    match contents {
        Contents::Organized(cloud) => Some((&cloud.points, contents.shape())),
        Contents::General(cloud) => Some((cloud, contents.shape())),
        _ => None,
    }
}

/// Returns the points in metres.
fn positions(cloud: &PointCloud) -> Vec<DVec3> {
    let unit = LengthUnit::of_cloud(cloud);
    let of = |i: usize| unit.metres * DVec3::from_array([0, 1, 2].map(|axis| cloud.coordinate(axis, i)));
    (0..cloud.len()).map(of).collect()
}

fn check_shapes(a: &Depths, b: &Depths) -> Result<(), Error> {
    let ((width, height), (other_width, other_height)) = (a.shape, b.shape);
    if a.shape == b.shape {
        return Ok(());
    }
    let found = format!("depth images of {width}x{height} and {other_width}x{other_height}");
    Err(mismatch(&found, "both must have the same size; give the camera to compare them as clouds"))
}

fn mismatch(found: &str, allowed: &'static str) -> Error {
    ParamError { field: "inputs", value: found.to_owned(), allowed }.into()
}

fn fields(a: &PointCloud, b: &PointCloud, by_index: bool) -> Vec<FieldDifference> {
    let mut names: Vec<&str> = a.attributes.iter().map(|field| field.name.as_str()).collect();
    names.extend(b.attributes.iter().map(|field| field.name.as_str()).filter(|name| a.attribute(name).is_none()));
    names.retain(|name| *name != "_");
    let difference = |name: &str| {
        let (of_a, of_b) = (a.attribute(name), b.attribute(name));
        let is_in = [of_a.is_some(), of_b.is_some()];
        let both = of_a.zip(of_b).filter(|_| by_index);
        let differing = both.filter(|(a, b)| a.values.len() == b.values.len()).map(|(a, b)| {
            let differences = (0..a.values.len()).map(|i| {
                let (a, b) = (a.values.get_f64(i), b.values.get_f64(i));
                // NaN marks a hole, and counts as equal to NaN.
                if a == b || (a.is_nan() && b.is_nan()) { 0.0 } else { (a - b).abs() }
            });
            differences
                .filter(|&difference| difference != 0.0)
                .fold((0, 0.0f64), |(count, most), difference| (count + 1, most.max(difference)))
        });
        let is_different = is_in != [true; 2] || differing.is_some_and(|(count, _)| count > 0);
        is_different.then(|| FieldDifference { name: name.to_owned(), is_in, differing })
    };
    names.into_iter().filter_map(difference).collect()
}

impl Distances {
    fn of(mut distances: Vec<f64>) -> Self {
        distances.sort_by(f64::total_cmp);
        let count = distances.len();
        let mean = |values: &mut dyn Iterator<Item = f64>| values.sum::<f64>() / count as f64;
        let quantile = |q: f64| match count {
            0 => f64::NAN,
            count => distances[((q * count as f64).ceil() as usize).clamp(1, count) - 1],
        };
        Self {
            count,
            equal: distances.iter().filter(|&&distance| distance == 0.0).count(),
            mean: mean(&mut distances.iter().copied()),
            rms: mean(&mut distances.iter().map(|distance| distance * distance)).sqrt(),
            median: quantile(0.5),
            p95: quantile(0.95),
            max: quantile(1.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_core::{DepthImage, OrganizedCloud};

    fn depth(raw: [u16; 6]) -> Contents {
        Contents::Depth(DepthImage { width: 3, height: 2, raw: raw.to_vec() })
    }

    fn cloud(points: &[[f32; 3]]) -> PointCloud {
        PointCloud::new(points.iter().copied().collect())
    }

    #[test]
    fn depth_images_differ_in_raw_units_and_holes() {
        let found = compare(&depth([0, 5, 10, 10, 65535, 3]), &depth([7, 0, 12, 10, 0, 3]), false).unwrap();
        assert_eq!((found.unit, found.valid, found.only_in), ("raw", [4, 4], [1, 1]));
        assert_eq!((found.distances.count, found.distances.equal, found.distances.max), (3, 2, 2.0));
        assert!((found.distances.rms - (4.0f64 / 3.0).sqrt()).abs() < 1e-12 && found.distances.median == 0.0);
        assert!(!found.is_within(5.0));
        assert!(compare(&depth([1; 6]), &depth([1; 6]), false).unwrap().is_within(0.0));
    }

    #[test]
    fn clouds_are_compared_point_by_point_or_by_the_nearest() {
        let mut a = cloud(&[[0.0; 3], [1.0, 0.0, 0.0], [f32::NAN; 3]]);
        let mut b = cloud(&[[0.0, 0.0, 0.5], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]);
        a.set_attribute("label", vec![1u8, 2, 3]);
        b.set_attribute("label", vec![1u8, 2, 7]);
        b.set_attribute("intensity", vec![0.0f32; 3]);
        let (a, b) = (Contents::General(a), Contents::General(b));
        let found = compare(&a, &b, false).unwrap();
        assert_eq!((found.matching, found.only_in, found.distances.max), (Matching::Index, [0, 1], 0.5));
        assert_eq!(found.fields.len(), 2);
        assert_eq!((found.fields[0].differing, found.fields[1].is_in), (Some((1, 4.0)), [false, true]));
        let found = compare(&a, &b, true).unwrap();
        assert_eq!((found.distances.max, found.back.unwrap().max), (0.5, 1.0));
        // An empty cloud is not within any distance of a cloud with points.
        let none = Contents::General(cloud(&[[f32::NAN; 3]; 2]));
        assert!(
            !compare(&a, &none, false).unwrap().is_within(1e9) && compare(&none, &none, true).unwrap().is_within(0.0)
        );
        // Inputs with different numbers of points.
        let more = Contents::General(cloud(&[[0.0; 3]; 5]));
        assert_eq!(compare(&a, &more, false).unwrap().matching, Matching::Nearest);
        assert!(compare(&a, &depth([1; 6]), false).is_err());
    }

    #[test]
    fn maps_show_holes_and_scale() {
        let points = |z: f32| cloud(&[[0.0, 0.0, z], [f32::NAN; 3], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]);
        let organized = |z| Contents::Organized(OrganizedCloud::new(2, 2, points(z)).unwrap());
        let map = difference_map(&organized(1.0), &organized(1.1), 0.1).unwrap();
        assert_eq!(map.rgb[..9], [215, 30, 30, 255, 255, 255, 0, 0, 0]);
        assert!(difference_map(&Contents::General(points(1.0)), &organized(1.0), 0.1).is_none());
    }
}
