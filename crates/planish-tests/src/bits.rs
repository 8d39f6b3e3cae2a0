//! Bitwise comparison of results; all NaN are equal.

use planish::{Smoothed, Xyz};

/// Returns a result as numbers: its shape, the bits of its points, and the length (`u32::MAX` if absent) and bits of
/// depth, depth_m, normals, curvature, status and neighbours.
pub fn bits(smoothed: &Smoothed) -> Vec<u32> {
    let Smoothed { width, height, points, depth, depth_m, normals, curvature, status, neighbours, .. } = smoothed;
    let mut all = vec![*width as u32, *height as u32];
    all.extend(of_points(points));
    let mut field = |len: Option<usize>, values: &mut dyn Iterator<Item = u32>| {
        all.push(len.map_or(u32::MAX, |len| len as u32));
        all.extend(values);
    };
    field(depth.as_ref().map(Vec::len), &mut depth.iter().flatten().map(|&raw| u32::from(raw)));
    field(depth_m.as_ref().map(Vec::len), &mut depth_m.iter().flatten().map(bits_of));
    field(normals.as_ref().map(Xyz::len), &mut normals.iter().flat_map(of_points));
    field(curvature.as_ref().map(Vec::len), &mut curvature.iter().flatten().map(bits_of));
    field(status.as_ref().map(Vec::len), &mut status.iter().flatten().map(|&status| status as u32));
    field(neighbours.as_ref().map(Vec::len), &mut neighbours.iter().flatten().copied());
    all
}

/// Returns the bits of all x, then of all y and all z.
pub fn of_points(points: &Xyz) -> Vec<u32> {
    points.as_slices().into_iter().flatten().map(bits_of).collect()
}

fn bits_of(value: &f32) -> u32 {
    if value.is_nan() { f32::NAN.to_bits() } else { value.to_bits() }
}
