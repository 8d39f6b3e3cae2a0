//! One point for each voxel that has any.

use rayon::prelude::*;

use crate::cloud::{Attribute, AttributeValues, PointCloud};
use crate::error::ParamError;
use crate::xyz::Xyz;

/// Voxels along an axis, as 21 bits count them.
const MOST_ALONG_AXIS: f64 = (1u32 << 21) as f64;

/// What the points of a voxel make of a field.
enum Merge {
    /// The mean, in the field's own type.
    Mean,
    /// The mean of three vectors' components, at unit length.
    Direction,
    /// The mean of each byte of a packed colour.
    Colour,
    /// The value of the point nearest the centroid: means of labels and flags mean nothing.
    Nearest,
}

/// Puts one point into each voxel of `size_m` metres that has any: their centroid, with the means of fields that have one (colour,
/// intensity, normals, all floats) and otherwise the field of the point nearest the centroid.
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
    let valid: Vec<u32> = (0..cloud.len()).filter(|&i| cloud.positions.is_finite(i)).map(|i| i as u32).collect();
    let coordinate = |axis: usize, value: f32| (cloud.origin_m[axis] + f64::from(value)) / size_m;
    // The cell of a coordinate grows with it.
    let bounds_of = |bounds: [[f32; 3]; 2], &i: &u32| {
        let p = cloud.positions.get(i as usize);
        [0, 1]
            .map(|side| std::array::from_fn(|axis| [bounds[0][axis].min(p[axis]), bounds[1][axis].max(p[axis])][side]))
    };
    let union = |a: [[f32; 3]; 2], b: [[f32; 3]; 2]| {
        [std::array::from_fn(|k| a[0][k].min(b[0][k])), std::array::from_fn(|k| a[1][k].max(b[1][k]))]
    };
    let empty = || [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]];
    let [low, high] = valid.par_iter().fold(empty, bounds_of).reduce(empty, union);
    let first: [f64; 3] = std::array::from_fn(|axis| coordinate(axis, low[axis]).floor());
    if (0..3).any(|axis| coordinate(axis, high[axis]).floor() - first[axis] >= MOST_ALONG_AXIS) {
        return refuse("a size in metres of which the cloud is at most 2 million wide");
    }
    let key = |i: u32| {
        let p = cloud.positions.get(i as usize);
        // Not below the first cell, where a cast rounds down.
        (0..3).fold(0u64, |key, axis| (key << 21) | (coordinate(axis, p[axis]) - first[axis]) as u64)
    };
    let mut keys: Vec<(u64, u32)> = valid.par_iter().map(|&i| (key(i), i)).collect();
    keys.par_sort_unstable();
    let mut voxels: Vec<&[(u64, u32)]> = keys.chunk_by(|a, b| a.0 == b.0).collect();
    voxels.par_sort_unstable_by_key(|voxel| voxel[0].1);

    let centroids: Vec<[f32; 3]> = voxels.par_iter().map(|voxel| centroid(&cloud.positions, voxel)).collect();
    let nearest: Vec<u32> = voxels
        .par_iter()
        .zip(&centroids)
        .map(|(voxel, centroid)| {
            let square = |i: u32| {
                let p = cloud.positions.get(i as usize);
                (0..3).map(|axis| (p[axis] - centroid[axis]).powi(2)).sum::<f32>()
            };
            let by_distance = |a: &&(u64, u32), b: &&(u64, u32)| square(a.1).total_cmp(&square(b.1));
            voxel.iter().min_by(by_distance).map_or(0, |found| found.1)
        })
        .collect();
    let mut merged: Vec<Attribute> =
        cloud.attributes.iter().map(|attribute| merge(attribute, &voxels, &nearest)).collect();
    normalize(&mut merged);
    Ok(PointCloud { positions: Xyz::from_iter(centroids), attributes: merged, ..cloud.without_points() })
}

/// Of offsets from the first point, so that it is as exact as the points.
fn centroid(positions: &Xyz, voxel: &[(u64, u32)]) -> [f32; 3] {
    let first = positions.get(voxel[0].1 as usize).map(f64::from);
    let mut sum = [0.0; 3];
    for &(_, i) in voxel {
        let p = positions.get(i as usize);
        (0..3).for_each(|axis| sum[axis] += f64::from(p[axis]) - first[axis]);
    }
    std::array::from_fn(|axis| (first[axis] + sum[axis] / voxel.len() as f64) as f32)
}

fn how_to_merge(attribute: &Attribute) -> Merge {
    let is_float = matches!(attribute.values, AttributeValues::F32(_) | AttributeValues::F64(_));
    match attribute.name.to_ascii_lowercase().as_str() {
        "rgb" | "rgba" if attribute.values.scalar_size() == 4 => Merge::Colour,
        "normal_x" | "normal_y" | "normal_z" | "nx" | "ny" | "nz" if is_float => Merge::Direction,
        "red" | "green" | "blue" | "alpha" | "intensity" | "i" | "nir" => Merge::Mean,
        _ if is_float => Merge::Mean,
        _ => Merge::Nearest,
    }
}

fn merge(attribute: &Attribute, voxels: &[&[(u64, u32)]], nearest: &[u32]) -> Attribute {
    let count = attribute.count;
    let places = || nearest.iter().map(|&i| i as usize).collect::<Vec<_>>();
    if matches!(how_to_merge(attribute), Merge::Nearest) {
        return attribute.select(&places());
    }
    if let (Merge::Colour, Some(packed)) = (how_to_merge(attribute), crate::colour::packed(attribute)) {
        let mean = |voxel: &&[(u64, u32)]| {
            let channel = |shift: u32| {
                let sum: u64 = voxel.iter().map(|&(_, i)| u64::from((packed[i as usize] >> shift) & 0xff)).sum();
                ((sum as f64 / voxel.len() as f64).round() as u32) << shift
            };
            channel(24) | channel(16) | channel(8) | channel(0)
        };
        let bits: Vec<u32> = voxels.par_iter().map(mean).collect();
        let values = match &attribute.values {
            AttributeValues::F32(_) => bits.into_iter().map(f32::from_bits).collect::<Vec<_>>().into(),
            AttributeValues::I32(_) => bits.into_iter().map(|bits| bits as i32).collect::<Vec<_>>().into(),
            _ => bits.into(),
        };
        return Attribute { name: attribute.name.clone(), count, values };
    }
    let means = voxels.par_iter().flat_map_iter(|voxel| {
        (0..count).map(move |k| {
            let sum: f64 = voxel.iter().map(|&(_, i)| attribute.values.get_f64(count * i as usize + k)).sum();
            sum / voxel.len() as f64
        })
    });
    let values = attribute.values.of_f64(means.collect());
    Attribute { name: attribute.name.clone(), count, values }
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
