//! One point for each voxel that has any.

use std::ops::Range;

use rayon::prelude::*;

use crate::cloud::{Attribute, AttributeValues, PointCloud};
use crate::error::ParamError;
use crate::neighbours::Bounds;
use crate::xyz::Xyz;

/// Voxels along an axis, as 21 bits count them.
const MOST_ALONG_AXIS: f64 = (1u32 << 21) as f64;

/// What the points of a voxel make of a field.
#[derive(Clone, Copy, PartialEq)]
enum Merge {
    /// The mean, in the field's own type.
    Mean,
    /// The mean of each byte of a packed colour.
    Colour,
    /// The value of the point nearest the centroid: means of labels and flags mean nothing.
    Nearest,
}

/// Puts one point into each voxel of `size_m` metres that has any: their centroid, with the means of fields that have one (colour,
/// intensity, normals, floats with fractions) and otherwise the field of the point nearest the centroid.
///
/// Voxels begin at multiples of their size in the cloud's frame; results come in the order of the first point of each. Holes are
/// left out.
///
/// # Errors
/// If the size is no positive number, or so small that the cloud is over 2 million voxels wide.
pub fn voxel_downsample(cloud: &PointCloud, size_m: f64) -> Result<PointCloud, ParamError> {
    let refuse = |allowed| Err(ParamError { field: "voxel", value: size_m.to_string(), allowed });
    if !(size_m > 0.0 && size_m.is_finite()) {
        return refuse("a size in metres above 0");
    }
    let voxels = match Voxels::of(cloud, size_m) {
        Some(voxels) => voxels,
        None => return refuse("a size in metres of which the cloud is at most 2 million wide"),
    };
    let centroids: Vec<[f32; 3]> = voxels.iter().map(|voxel| centroid(&cloud.positions, voxel)).collect();
    let ways: Vec<Merge> = cloud.attributes.iter().map(how_to_merge).collect();
    let nearest: Vec<usize> = match ways.contains(&Merge::Nearest) {
        true => {
            let points = &cloud.positions;
            voxels.iter().zip(&centroids).map(|(voxel, &centroid)| nearest_to(centroid, voxel, points)).collect()
        }
        false => Vec::new(),
    };
    let mut merged: Vec<Attribute> = cloud
        .attributes
        .iter()
        .zip(ways)
        .map(|(attribute, way)| match way {
            Merge::Mean => mean(attribute, &voxels),
            Merge::Colour => mean_colour(attribute, &voxels),
            Merge::Nearest => attribute.select(&nearest),
        })
        .collect();
    normalize(&mut merged);
    Ok(PointCloud { positions: Xyz::from_iter(centroids), attributes: merged, ..cloud.without_points() })
}

/// The points of each voxel.
struct Voxels {
    /// The points' indices, voxel by voxel; in ascending order within one.
    points: Vec<u32>,
    /// Where in `points` each voxel is, by its first point.
    places: Vec<Range<usize>>,
}

impl Voxels {
    /// `None` if there are too many along an axis.
    fn of(cloud: &PointCloud, size_m: f64) -> Option<Self> {
        let points = &cloud.positions;
        let valid: Vec<u32> = (0..cloud.len()).filter(|&i| points.is_finite(i)).map(|i| i as u32).collect();
        let bounds = valid
            .par_iter()
            .fold(|| Bounds::EMPTY, |bounds, &i| bounds.union(Bounds::of_point(points.get(i as usize))))
            .reduce(|| Bounds::EMPTY, Bounds::union);
        let along = |axis: usize, value: f32| (cloud.origin_m[axis] + f64::from(value)) / size_m;
        // The voxel of a coordinate grows with it.
        let first: [f64; 3] = std::array::from_fn(|axis| along(axis, bounds.low[axis]).floor());
        let last = |axis: usize| along(axis, bounds.high[axis]).floor() - first[axis];
        if (0..3).any(|axis| last(axis) >= MOST_ALONG_AXIS) {
            return None;
        }
        let bits = |most: u64| u64::BITS - most.leading_zeros();
        let bits_along: [u32; 3] = std::array::from_fn(|axis| bits(last(axis) as u64));
        let index_bits = bits(cloud.len() as u64);
        let key = |i: u32| {
            let p = points.get(i as usize);
            // Not below the first voxel, where a cast rounds down.
            (0..3).fold(0u64, |key, axis| (key << bits_along[axis]) | (along(axis, p[axis]) - first[axis]) as u64)
        };
        // One word, where it holds both the voxel and the point, sorts twice as fast as two.
        let voxels = if bits_along.iter().sum::<u32>() + index_bits <= u64::BITS {
            let mut keys: Vec<u64> = valid.par_iter().map(|&i| (key(i) << index_bits) | u64::from(i)).collect();
            keys.par_sort_unstable();
            let indices = (1u64 << index_bits) - 1;
            Self::of_sorted(&keys, |key| key >> index_bits, |key| (key & indices) as u32)
        } else {
            let mut keys: Vec<(u64, u32)> = valid.par_iter().map(|&i| (key(i), i)).collect();
            keys.par_sort_unstable();
            Self::of_sorted(&keys, |key| key.0, |key| key.1)
        };
        Some(voxels)
    }

    fn of_sorted<T: Copy>(keys: &[T], voxel: impl Fn(T) -> u64, point: impl Fn(T) -> u32) -> Self {
        let points: Vec<u32> = keys.iter().map(|&key| point(key)).collect();
        let mut end = 0;
        let mut places: Vec<Range<usize>> = keys
            .chunk_by(|&a, &b| voxel(a) == voxel(b))
            .map(|chunk| {
                let start = end;
                end += chunk.len();
                start..end
            })
            .collect();
        places.par_sort_unstable_by_key(|place| points[place.start]);
        Self { points, places }
    }

    /// The points of each, in parallel.
    fn iter(&self) -> impl IndexedParallelIterator<Item = &[u32]> {
        self.places.par_iter().map(|place| &self.points[place.clone()])
    }
}

fn nearest_to(centroid: [f32; 3], voxel: &[u32], points: &Xyz) -> usize {
    let square = |i: u32| {
        let p = points.get(i as usize);
        (0..3).map(|axis| (p[axis] - centroid[axis]).powi(2)).sum::<f32>()
    };
    voxel.iter().copied().min_by(|&a, &b| square(a).total_cmp(&square(b))).map_or(0, |i| i as usize)
}

/// Of offsets from the first point, so that it is as exact as the points.
fn centroid(positions: &Xyz, voxel: &[u32]) -> [f32; 3] {
    let first = positions.get(voxel[0] as usize).map(f64::from);
    let mut sum = [0.0; 3];
    for &i in voxel {
        let p = positions.get(i as usize);
        (0..3).for_each(|axis| sum[axis] += f64::from(p[axis]) - first[axis]);
    }
    std::array::from_fn(|axis| (first[axis] + sum[axis] / voxel.len() as f64) as f32)
}

fn how_to_merge(attribute: &Attribute) -> Merge {
    let is_float = matches!(attribute.values, AttributeValues::F32(_) | AttributeValues::F64(_));
    match attribute.name.to_ascii_lowercase().as_str() {
        "rgb" | "rgba" if crate::colour::packed(attribute).is_some() => Merge::Colour,
        "red" | "green" | "blue" | "alpha" | "intensity" | "i" | "nir" => Merge::Mean,
        "normal_x" | "normal_y" | "normal_z" | "nx" | "ny" | "nz" if is_float => Merge::Mean,
        // Text and lidar files hold labels and rings as floats too.
        _ if is_float && !is_whole(&attribute.values) => Merge::Mean,
        _ => Merge::Nearest,
    }
}

/// Whether all values are whole numbers.
fn is_whole(values: &AttributeValues) -> bool {
    (0..values.len()).all(|i| values.get_f64(i).fract() == 0.0)
}

fn mean(attribute: &Attribute, voxels: &Voxels) -> Attribute {
    let count = attribute.count;
    let means = voxels.iter().flat_map_iter(|voxel| {
        (0..count).map(move |k| {
            let sum: f64 = voxel.iter().map(|&i| attribute.values.get_f64(count * i as usize + k)).sum();
            sum / voxel.len() as f64
        })
    });
    let values = attribute.values.of_f64(means.collect());
    Attribute { name: attribute.name.clone(), count, values }
}

/// The mean of each byte.
fn mean_colour(attribute: &Attribute, voxels: &Voxels) -> Attribute {
    let packed = crate::colour::packed(attribute).unwrap_or_default();
    let mean = |voxel: &[u32]| {
        let channel = |shift: u32| {
            let sum: u64 = voxel.iter().map(|&i| u64::from((packed[i as usize] >> shift) & 0xff)).sum();
            ((sum as f64 / voxel.len() as f64).round() as u32) << shift
        };
        channel(24) | channel(16) | channel(8) | channel(0)
    };
    let bits: Vec<u32> = voxels.iter().map(mean).collect();
    let values = match &attribute.values {
        AttributeValues::F32(_) => bits.into_iter().map(f32::from_bits).collect::<Vec<_>>().into(),
        AttributeValues::I32(_) => bits.into_iter().map(|bits| bits as i32).collect::<Vec<_>>().into(),
        _ => bits.into(),
    };
    Attribute { name: attribute.name.clone(), count: attribute.count, values }
}

/// Means of unit vectors are shorter: gives them their length again.
fn normalize(attributes: &mut [Attribute]) {
    for names in [["normal_x", "normal_y", "normal_z"], ["nx", "ny", "nz"]] {
        let place = |name: &str| attributes.iter().position(|attribute| attribute.name == name && attribute.count == 1);
        let [Some(x), Some(y), Some(z)] = names.map(place) else { continue };
        let points = attributes[x].values.len();
        let component = |k: usize| (0..points).map(|i| attributes[k].values.get_f64(i)).collect::<Vec<f64>>();
        let mut components = [x, y, z].map(component);
        for i in 0..points {
            let length = components.iter().map(|values| values[i] * values[i]).sum::<f64>().sqrt();
            if length > 0.0 {
                components.iter_mut().for_each(|values| values[i] /= length);
            }
        }
        for (k, values) in [x, y, z].into_iter().zip(components) {
            attributes[k].values = attributes[k].values.of_f64(values);
        }
    }
}
