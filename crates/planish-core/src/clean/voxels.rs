//! Thinning to one point per occupied voxel.

use rayon::prelude::*;

use super::voxel_grid::Voxels;
use crate::cloud::{Attribute, AttributeValues, PointCloud};
use crate::error::ParamError;
use crate::xyz::Xyz;

/// The rule for computing a voxel's value of a field from the values of its points.
#[derive(Clone, Copy, PartialEq)]
enum Merge {
    /// The mean, in the field's own type.
    Mean,
    /// The mean of each byte of a packed colour.
    Colour,
    /// The value of the point nearest to the centroid, for labels and flags, whose mean is meaningless.
    Nearest,
}

/// Replaces the points of each voxel of `size_m` metres by their centroid. Colour, intensity, normals and floats with
/// fractions are averaged; other fields have the value of the point nearest to the centroid.
///
/// Voxels begin at multiples of their size in the cloud's frame; the resulting points are in the order of each
/// voxel's first point. Holes are dropped.
///
/// # Errors
/// If the size is not a positive number, or so small that the cloud is over 2 million voxels wide.
pub fn voxel_downsample(cloud: &PointCloud, size_m: f64) -> Result<PointCloud, ParamError> {
    Ok(downsample(cloud, &Voxels::of(cloud, size_m)?))
}

/// Reduces a cloud to one point per voxel.
pub fn downsample(cloud: &PointCloud, voxels: &Voxels) -> PointCloud {
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
            Merge::Mean => mean(attribute, voxels),
            Merge::Colour => mean_colour(attribute, voxels),
            Merge::Nearest => attribute.select(&nearest),
        })
        .collect();
    normalize(&mut merged);
    let positions = Xyz::par_from_fn(centroids.len(), |i| centroids[i]);
    PointCloud { positions, attributes: merged, ..cloud.without_points() }
}

fn nearest_to(centroid: [f32; 3], voxel: &[u32], points: &Xyz) -> usize {
    let square = |i: u32| {
        let p = points.get(i as usize);
        (0..3).map(|axis| (p[axis] - centroid[axis]).powi(2)).sum::<f32>()
    };
    voxel.iter().copied().min_by(|&a, &b| square(a).total_cmp(&square(b))).map_or(0, |i| i as usize)
}

/// Returns the mean of a voxel's points. Offsets from the first point are averaged instead of positions, which
/// preserves precision.
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
        // Text and lidar files may store labels and rings as floats, so whole numbers are not averaged.
        _ if is_float && !is_whole(&attribute.values) => Merge::Mean,
        _ => Merge::Nearest,
    }
}

/// Returns true if all values are whole numbers.
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

/// Returns the mean colour of each voxel, byte by byte.
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

/// Scales normals to unit length, since means of unit vectors are shorter.
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
