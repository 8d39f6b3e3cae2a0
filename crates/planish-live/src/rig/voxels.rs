//! Thins the points of a moment to one per voxel, smooths them, and applies the result to every point.

use glam::DVec3;
use rayon::prelude::*;

use super::fused::CAMERA_FIELD;
use super::together::Together;
use planish_core::{
    Error, Outputs, ParamError, PointCloud, Smoothed, Smoother, Status, Xyz,
    internal::{VoxelMap, Voxels, downsample},
};

/// Minimum cosine between normals of one surface (37°).
const LEAST_COSINE: f64 = 0.8;

/// A moment whose points are sorted into voxels.
pub(super) struct InVoxels {
    together: Together,
    voxels: Voxels,
    /// The centroid of each voxel's points, and the camera of the point nearest to the centroid.
    cloud: PointCloud,
    /// Result for the voxels; `None` until they are smoothed.
    smoothed: Option<Smoothed>,
}

impl InVoxels {
    pub(super) fn of(together: Together, size_m: f64) -> Result<Self, ParamError> {
        let voxels = Voxels::of(&together.cloud, size_m)?;
        let cloud = downsample(&together.cloud, &voxels);
        Ok(Self { together, voxels, cloud, smoothed: None })
    }

    /// Smooths the centroids, unless they are smoothed already. The smoother must compute normals.
    pub(super) fn smooth(&mut self, smoother: &mut Smoother) -> Result<(), Error> {
        if self.smoothed.is_none() {
            let mut smoothed = Smoothed::default();
            if !self.cloud.is_empty() {
                smoother.smooth(&self.cloud, &mut smoothed)?;
            }
            self.smoothed = Some(smoothed);
        }
        Ok(())
    }

    /// Returns the smoothed centroids, without holes, with their camera and the computed fields.
    pub(super) fn fused(self, fields: Outputs) -> PointCloud {
        let Self { mut cloud, smoothed, together, .. } = self;
        let mut smoothed = smoothed.unwrap_or_default();
        let normals = smoothed.normals.as_mut().filter(|_| fields.normals);
        if let (Some(normals), Some(field)) = (normals, cloud.attribute(CAMERA_FIELD)) {
            for i in 0..normals.len() {
                let normal = normals.vector(i);
                let point = smoothed.points.vector(i);
                if normal.dot(point - together.lens(field.values.get_f64(i) as usize)) > 0.0 {
                    normals.set(i, (-normal).as_vec3().to_array());
                }
            }
        }
        for (name, values) in smoothed.fields(fields) {
            cloud.set_attribute(name, values);
        }
        cloud.positions = smoothed.points;
        let points: Vec<usize> = (0..cloud.len()).filter(|&i| cloud.positions.is_finite(i)).collect();
        if points.len() < cloud.len() { cloud.select(&points) } else { cloud }
    }

    /// Returns each camera's points, moved onto the surface of the smoothed centroids.
    pub(super) fn given_back(&self, fields: Outputs) -> Vec<Option<Smoothed>> {
        let of_voxels = self.smoothed.as_ref().filter(|smoothed| !smoothed.points.is_empty());
        let spread = of_voxels.map(|of_voxels| self.spread(of_voxels, fields));
        self.together.given_back(&spread.unwrap_or_default())
    }

    /// Applies the result for the voxels to all points.
    fn spread(&self, of_voxels: &Smoothed, fields: Outputs) -> Smoothed {
        let surface = Surface { map: VoxelMap::of(&self.voxels), of_voxels };
        let positions = &self.together.cloud.positions;
        let on_surface = |i| surface.carry(positions.get(i));
        let carried: Vec<Carried> = (0..positions.len()).into_par_iter().map(on_surface).collect();
        let vectors = |vector: fn(&Carried) -> [f32; 3]| Xyz::par_from_fn(carried.len(), |i| vector(&carried[i]));
        let Smoothed { curvature, status, neighbours, .. } = of_voxels;
        Smoothed {
            width: positions.len(),
            height: 1,
            points: vectors(|carried| carried.point),
            normals: fields.normals.then(|| vectors(|carried| carried.normal)),
            curvature: curvature.as_ref().map(|curvature| of_own_voxel(&carried, curvature, f32::NAN)),
            status: status.as_ref().map(|status| of_own_voxel(&carried, status, Status::Hole)),
            neighbours: neighbours.as_ref().map(|neighbours| of_own_voxel(&carried, neighbours, 0)),
            ..Smoothed::default()
        }
    }
}

/// Returns, for each point, the value found for its voxel; `without` for a point without a voxel.
fn of_own_voxel<T: Copy + Send + Sync>(carried: &[Carried], found: &[T], without: T) -> Vec<T> {
    carried.par_iter().map(|carried| carried.voxel.map_or(without, |voxel| found[voxel])).collect()
}

/// The surface through the smoothed centroids.
struct Surface<'a> {
    map: VoxelMap<'a>,
    of_voxels: &'a Smoothed,
}

/// A point moved onto a [`Surface`].
struct Carried {
    /// The voxel that contains the point, if any.
    voxel: Option<usize>,
    point: [f32; 3],
    normal: [f32; 3],
}

impl Surface<'_> {
    /// Moves a point onto the surface of the voxels around it (docs/method.md, section 13).
    fn carry(&self, point: [f32; 3]) -> Carried {
        let nothing = Carried { voxel: None, point: [f32::NAN; 3], normal: [f32::NAN; 3] };
        let Some(own) = self.map.at(point) else { return nothing };
        if !self.of_voxels.points.is_finite(own) {
            return Carried { voxel: Some(own), ..nothing };
        }
        let own_normal = self.normal(own);
        let p = DVec3::from_array(point.map(f64::from));
        // The engine does not move a centroid without a normal.
        let there = |(voxel, weight): (usize, f64)| {
            let normal = self.normal(voxel);
            let cosine = normal.dot(own_normal);
            let alike = (cosine.abs() - LEAST_COSINE) / (1.0 - LEAST_COSINE);
            // Also false for a NaN.
            (alike > 0.0).then(|| (self.point(voxel), normal * cosine.signum(), weight * alike))
        };
        let mut found = [(DVec3::ZERO, DVec3::ZERO, 0.0); 8];
        let mut count = 0;
        for patch in self.map.around(point).filter_map(there) {
            found[count] = patch;
            count += 1;
        }
        let found = &found[..count];
        let normal = found.iter().map(|(_, normal, weight)| normal * weight).sum::<DVec3>().normalize_or_zero();
        if normal == DVec3::ZERO {
            return Carried { voxel: Some(own), point, normal: [f32::NAN; 3] };
        }
        // The mean of the normals at both ends is exact on spheres, since a chord meets a sphere at the same angle at
        // both ends.
        let distance = |(at, of_patch, weight): &(DVec3, DVec3, f64)| weight * (p - at).dot(0.5 * (of_patch + normal));
        let weight: f64 = found.iter().map(|(_, _, weight)| weight).sum();
        let on_surface = p - normal * (found.iter().map(distance).sum::<f64>() / weight);
        Carried { voxel: Some(own), point: on_surface.as_vec3().to_array(), normal: normal.as_vec3().to_array() }
    }

    fn point(&self, voxel: usize) -> DVec3 {
        self.of_voxels.points.vector(voxel)
    }

    /// Returns the normal of a voxel; NaN for a voxel without one.
    fn normal(&self, voxel: usize) -> DVec3 {
        let normals: Option<&Xyz> = self.of_voxels.normals.as_ref();
        normals.map_or(DVec3::NAN, |normals| normals.vector(voxel))
    }
}
