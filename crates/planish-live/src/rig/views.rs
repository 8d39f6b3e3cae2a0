//! Smoothing by views: the points of all cameras, as range images from each camera's position.
//!
//! Each camera's grid is a view, and so is the grid of every added viewpoint. The front of a pixel is its own sample
//! or, without one, the nearest point of another camera that falls into it. Other cameras' samples in the pixel
//! belong to the same surface if they face the view and are within registration error and noise of the front. The
//! view consists of the means of these samples, weighted by the inverse squared noise, and is smoothed as a frame of
//! its camera. Every point then moves along its ray to the tangent planes of the pixels that it contributed to; its
//! result is their mean, weighted by the squared cosine of incidence. A surface that is doubled by pose errors thus
//! becomes one.

use glam::DVec3;
use rayon::prelude::*;

use super::facing::{PIXELS_OF_A_TASK, normals};
use planish_core::{
    Camera, Frame, FrameError, Outputs, PointsView, SensorModel, Smoothed, Status, Xyz,
    internal::{GRAZING_COSINE, RigidTransform},
};

/// Maximum difference between two cameras' samples of one surface, in standard deviations of their combined noise.
const DEVIATIONS: f64 = 3.0;

/// Minimum cosine of incidence of a surface that faces a view (80°).
const FACING_COSINE: f64 = 0.17;

/// Maximum depth difference between samples in adjacent pixels of a facing surface, in pixel widths: two pixels at a
/// slope of 80°.
const STEEPEST_PX: f32 = 2.0 * 5.67;

/// Minimum cosine between normals of one smooth surface (30°).
const SAME_SURFACE_COSINE: f64 = 0.866;
/// Maximum distance of one smooth surface from its extended tangent plane, in metres.
const SAME_SURFACE_M: f64 = 0.003;

/// Pixel index of a sample that falls into no pixel, or does not belong to the front of its pixel.
const NOWHERE: u32 = u32::MAX;

/// A camera's measurements, in the camera's coordinate frame.
pub(super) struct Measured {
    pub(super) camera: Camera,
    pub(super) points: Xyz,
    /// Normals that face the camera, where the orientation of the surface can be estimated.
    normals: Xyz,
    sensor: SensorModel,
    rig_from_camera: RigidTransform,
    /// Transform of points from the camera's frame into the frame of the input.
    points_from_camera: RigidTransform,
    /// True for an added viewpoint without a camera: all pixels are holes.
    is_added: bool,
}

/// The points of all cameras, seen from the position of one of them.
pub(super) struct View {
    points: Xyz,
    shape: (usize, usize),
    /// For each camera, the pixel in which each of its samples was counted; `None` for the view's own camera and
    /// cameras without samples.
    counted: Vec<Option<Vec<u32>>>,
}

impl Measured {
    pub(super) fn of(
        frame: Frame<'_>,
        camera: Option<Camera>,
        sensor: SensorModel,
        rig_from_camera: RigidTransform,
    ) -> Result<Self, FrameError> {
        let shape = frame.shape();
        let camera = frame.camera().copied().or_else(|| camera.map(|camera| crate::source::with_shape(camera, shape)));
        let camera = camera.filter(|camera| camera.check_shape(shape).is_ok());
        let camera = camera.ok_or(FrameError::MissingCamera { what: "a rig smoothed by views" })?;
        let (points, points_from_camera) = match frame {
            Frame::Depth(depth) => (depth.deproject()?.points.positions, RigidTransform::IDENTITY),
            Frame::Points(points) => {
                let points_from_camera =
                    RigidTransform::shift(points.origin_m()).inverse().after(points.pose().transform()?);
                let camera_from_points = points_from_camera.inverse();
                let in_camera = |i| camera_from_points.to_cloud(DVec3::from_array(points.get(i))).as_vec3().to_array();
                ((0..points.len()).map(in_camera).collect(), points_from_camera)
            }
        };
        let normals = normals(&points, shape, &sensor);
        Ok(Self { camera, points, normals, sensor, rig_from_camera, points_from_camera, is_added: false })
    }

    /// Creates the empty measurements of a viewpoint without a camera.
    pub(super) fn nothing(camera: Camera, sensor: SensorModel, rig_from_camera: RigidTransform) -> Self {
        let holes = Xyz::filled(camera.width * camera.height, f32::NAN);
        let points_from_camera = RigidTransform::IDENTITY;
        let normals = Xyz::default();
        Self { camera, points: holes, normals, sensor, rig_from_camera, points_from_camera, is_added: true }
    }

    fn shape(&self) -> (usize, usize) {
        (self.camera.width, self.camera.height)
    }

    /// Returns the view of all cameras' points from this camera. Pose errors may separate two cameras' surfaces by up
    /// to `registration_m` metres.
    pub(super) fn view(&self, index: usize, all: &[Option<Self>], registration_m: f64) -> View {
        let (width, height) = self.shape();
        let landings: Vec<Option<Landings>> = all
            .iter()
            .enumerate()
            .map(|(i, other)| other.as_ref().filter(|of| i != index && !of.is_added).map(|of| self.landings(of)))
            .collect();
        let front_m = self.front_m(&landings);
        let own_weight = |i: usize| weight(self.sensor.sigma_m(self.points.z()[i].into()));
        let mut sums: Vec<[f64; 4]> = (0..width * height)
            .map(|i| match self.points.is_finite(i) {
                true => with_weight(self.points.get(i), own_weight(i)),
                false => [0.0; 4],
            })
            .collect();
        let mut counted = Vec::with_capacity(all.len());
        for (landings, other) in landings.into_iter().zip(all) {
            let (Some(mut landings), Some(other)) = (landings, other) else {
                counted.push(None);
                continue;
            };
            for (i, (pixel, point)) in landings.pixels.iter_mut().zip(&landings.points).enumerate() {
                if *pixel == NOWHERE {
                    continue;
                }
                let at = *pixel as usize;
                let sigma_m = other.sensor.sigma_m(other.points.z()[i].into());
                let noise_m = DEVIATIONS * sigma_m.hypot(self.sensor.sigma_m(front_m[at].into()));
                if f64::from((point[2] - front_m[at]).abs()) > registration_m + noise_m {
                    *pixel = NOWHERE;
                    continue;
                }
                let added = with_weight(*point, weight(sigma_m));
                sums[at].iter_mut().zip(added).for_each(|(sum, added)| *sum += added);
            }
            counted.push(Some(landings.pixels));
        }
        if self.is_added {
            leave_to_their_camera(&mut counted, (width, height));
        }
        let mean = |&[x, y, z, weight]: &[f64; 4]| [x, y, z].map(|sum| (sum / weight) as f32);
        View { points: sums.iter().map(mean).collect(), shape: (width, height), counted }
    }

    /// Returns the depth in metres of each pixel's front: this camera's sample or, without one, the nearest point of
    /// another camera.
    fn front_m(&self, landings: &[Option<Landings>]) -> Vec<f32> {
        let mut front_m = self.points.z().to_vec();
        for (pixel, point) in landings.iter().flatten().flat_map(Landings::iter) {
            if !self.points.z()[pixel].is_finite() {
                front_m[pixel] = front_m[pixel].min(point[2]);
            }
        }
        if !self.is_added {
            return front_m;
        }
        // From a viewpoint without a camera, hidden surfaces would be visible through the gaps between samples. A
        // point is hidden if it is so far behind the front of an adjacent pixel that no surface facing the view
        // reaches both.
        let (width, height) = self.shape();
        let deeper = 1.0 + STEEPEST_PX / self.camera.fx.min(self.camera.fy) as f32;
        let screened = |i: usize| {
            let around = beside(i, (width, height));
            around.fold(front_m[i], |front, at| front.min(deeper * front_m[at]))
        };
        (0..width * height).into_par_iter().with_min_len(PIXELS_OF_A_TASK).map(screened).collect()
    }

    /// Projects the samples of another camera into this camera's grid.
    fn landings(&self, other: &Self) -> Landings {
        let here_from_other = self.rig_from_camera.inverse().after(other.rig_from_camera);
        let landing = |i: usize| {
            let none = (NOWHERE, [f32::NAN; 3]);
            if !other.normals.is_finite(i) {
                return none;
            }
            let point = here_from_other.to_cloud(other.points.vector(i));
            let normal = here_from_other.rotation * other.normals.vector(i);
            if normal.dot(point) > -FACING_COSINE * point.length() {
                return none;
            }
            let pixel = self.camera.pixel_of(point.to_array());
            pixel.map_or(none, |pixel| (pixel as u32, point.as_vec3().to_array()))
        };
        let all = (0..other.points.len()).into_par_iter().with_min_len(PIXELS_OF_A_TASK);
        let (pixels, points) = all.map(landing).unzip();
        Landings { pixels, points }
    }

    /// Moves this camera's points onto the smoothed views.
    pub(super) fn carried_back(
        &self,
        index: usize,
        all: &[Option<Self>],
        views: &[Option<(View, Smoothed)>],
        outputs: Outputs,
    ) -> Option<Smoothed> {
        let (_, own) = views[index].as_ref()?;
        let own_normals = own.normals.as_ref()?;
        let (width, height) = self.shape();
        let others: Vec<Seen<'_>> =
            views.iter().zip(all).filter_map(|(view, of)| self.seen_in(index, view.as_ref()?, of.as_ref()?)).collect();
        let moved = |i: usize| {
            if !self.points.is_finite(i) || !own.points.is_finite(i) {
                return ([f32::NAN; 3], [f32::NAN; 3]);
            }
            let ray = as_dvec(self.points.get(i)).normalize();
            let (own_point, own_normal) = (as_dvec(own.points.get(i)), as_dvec(own_normals.get(i)));
            let mut sum = Blend::default();
            sum.add(ray, own_point, own_normal, ray);
            others.iter().for_each(|other| other.add_to(&mut sum, i, ray, own_normal));
            let (point, normal) = sum.mean(own_point, own_normal);
            (point.as_vec3().to_array(), normal.as_vec3().to_array())
        };
        let all = (0..width * height).into_par_iter().with_min_len(PIXELS_OF_A_TASK);
        let moved: Vec<([f32; 3], [f32; 3])> = all.map(moved).collect();
        let points = moved.iter().map(|(point, _)| *point).collect();
        let normals = moved.iter().map(|(_, normal)| *normal).collect();
        let back = Smoothed { width, height, points, ..Smoothed::default() };
        self.finish(back, own, normals, outputs)
    }

    /// Returns this camera's samples in another camera's view.
    fn seen_in<'a>(&self, index: usize, (view, smoothed): &'a (View, Smoothed), of: &'a Self) -> Option<Seen<'a>> {
        let pixels = view.counted[index].as_ref()?;
        let normals = smoothed.normals.as_ref()?;
        let here_from_view = self.rig_from_camera.inverse().after(of.rig_from_camera);
        let view_from_here = here_from_view.inverse();
        Some(Seen { pixels, points: &smoothed.points, normals, camera: &of.camera, here_from_view, view_from_here })
    }

    /// Adds the requested outputs, and transforms points into the frame of the input.
    fn finish(&self, mut back: Smoothed, own: &Smoothed, normals: Xyz, outputs: Outputs) -> Option<Smoothed> {
        let is_hole = |i: usize| !back.points.is_finite(i);
        back.status = own.status.as_ref().map(|status| {
            let of_pixel = |(i, &status): (usize, &Status)| match status {
                // A hole that other cameras filled in the view is not a point of this camera.
                _ if !self.points.is_finite(i) => Status::Hole,
                status => status,
            };
            status.iter().enumerate().map(of_pixel).collect()
        });
        let where_there = |values: &Vec<f32>| {
            values.iter().enumerate().map(|(i, &value)| if is_hole(i) { f32::NAN } else { value }).collect()
        };
        back.curvature = own.curvature.as_ref().map(where_there);
        back.neighbours = own.neighbours.clone();
        let depth_m: Vec<f32> = back.points.z().to_vec();
        back.depth = outputs.depth.then(|| depth_m.iter().map(|&depth_m| self.camera.raw_depth(depth_m)).collect());
        back.depth_m = outputs.depth_m.then_some(depth_m);
        back.normals = outputs.normals.then_some(normals);
        let RigidTransform { rotation, .. } = self.points_from_camera;
        if !self.points_from_camera.is_identity() {
            let move_point = |p: [f32; 3]| self.points_from_camera.to_cloud(as_dvec(p)).as_vec3().to_array();
            back.points = back.points.iter().map(move_point).collect();
            let turn = |normals: Xyz| normals.iter().map(|n| (rotation * as_dvec(n)).as_vec3().to_array()).collect();
            back.normals = back.normals.map(turn);
        }
        Some(back)
    }
}

fn as_dvec(vector: [f32; 3]) -> DVec3 {
    DVec3::from_array(vector.map(f64::from))
}

impl View {
    /// Returns the view as a frame of its camera.
    pub(super) fn frame<'a>(&'a self, of: &'a Measured) -> Result<Frame<'a>, FrameError> {
        let [x, y, z] = self.points.as_slices();
        let (width, height) = self.shape;
        Ok(Frame::Points(PointsView::from_planes(x, y, z)?.with_grid(width, height)?.with_camera(&of.camera)?))
    }
}

/// Drops samples in pixels around which only one camera was counted: a viewpoint without a camera adds nothing there
/// to what that camera sees.
fn leave_to_their_camera(counted: &mut [Option<Vec<u32>>], shape: (usize, usize)) {
    const SEVERAL: u16 = u16::MAX;
    let mut seen_by = vec![None; shape.0 * shape.1];
    for (i, counted) in (0u16..).zip(&*counted) {
        for &pixel in counted.iter().flatten().filter(|pixel| **pixel != NOWHERE) {
            let by = &mut seen_by[pixel as usize];
            *by = if by.is_none_or(|by| by == i) { Some(i) } else { Some(SEVERAL) };
        }
    }
    for (i, counted) in (0u16..).zip(counted) {
        let Some(counted) = counted else { continue };
        let is_shared = |pixel: u32| beside(pixel as usize, shape).any(|at| seen_by[at].is_some_and(|by| by != i));
        let pixels = counted.par_iter_mut().with_min_len(PIXELS_OF_A_TASK);
        pixels.filter(|pixel| **pixel != NOWHERE && !is_shared(**pixel)).for_each(|pixel| *pixel = NOWHERE);
    }
}

/// Returns a pixel and its neighbours.
fn beside(pixel: usize, (width, height): (usize, usize)) -> impl Iterator<Item = usize> {
    let (u, v) = (pixel % width, pixel / width);
    let columns = u.saturating_sub(1)..(u + 2).min(width);
    (v.saturating_sub(1)..(v + 2).min(height)).flat_map(move |v| columns.clone().map(move |u| v * width + u))
}

/// The pixels of a view into which another camera's samples fall, and these samples in the view's frame.
struct Landings {
    pixels: Vec<u32>,
    points: Vec<[f32; 3]>,
}

impl Landings {
    fn iter(&self) -> impl Iterator<Item = (usize, [f32; 3])> + '_ {
        let all = self.pixels.iter().zip(&self.points);
        all.filter(|(pixel, _)| **pixel != NOWHERE).map(|(pixel, point)| (*pixel as usize, *point))
    }
}

/// A camera's samples in another camera's view.
struct Seen<'a> {
    /// The pixel in which each sample was counted.
    pixels: &'a [u32],
    points: &'a Xyz,
    normals: &'a Xyz,
    /// The view's camera.
    camera: &'a Camera,
    here_from_view: RigidTransform,
    view_from_here: RigidTransform,
}

impl Seen<'_> {
    fn add_to(&self, sum: &mut Blend, i: usize, ray: DVec3, own_normal: DVec3) {
        let pixel = self.pixels[i];
        if pixel == NOWHERE || !self.normals.is_finite(pixel as usize) {
            return;
        }
        let Tangent { point, normal } = self.tangent(pixel as usize);
        // In the view's frame, the sample's camera is off the origin, and its ray has another direction.
        let (lens, ray_in_view) = (self.view_from_here.translation, self.view_from_here.rotation * ray);
        let along = ray_in_view.dot(normal);
        if along.abs() <= f64::from(GRAZING_COSINE) {
            return;
        }
        // Noise has moved the sample along its ray, and thus into a different pixel from the one where the ray meets
        // the surface.
        let met = lens + (point - lens).dot(normal) / along * ray_in_view;
        let Tangent { point, normal } = self.surface_at(met, normal).unwrap_or(Tangent { point, normal });
        let turn = self.here_from_view.rotation;
        if (turn * normal).dot(own_normal) < SAME_SURFACE_COSINE {
            return;
        }
        sum.add(ray, self.here_from_view.to_cloud(point), turn * normal, turn * point.normalize());
    }

    fn tangent(&self, pixel: usize) -> Tangent {
        Tangent { point: as_dvec(self.points.get(pixel)), normal: as_dvec(self.normals.get(pixel)) }
    }

    /// Interpolates the surface at a point close to it from the four surrounding pixels; `None` next to edges.
    fn surface_at(&self, point: DVec3, normal: DVec3) -> Option<Tangent> {
        let [u, v] = self.camera.project(point.to_array())?;
        let (left, top) = (u.floor(), v.floor());
        let is_inside =
            left >= 0.0 && top >= 0.0 && left + 1.0 < self.camera.width as f64 && top + 1.0 < self.camera.height as f64;
        if !is_inside {
            return None;
        }
        let (across, down) = (u - left, v - top);
        let first = top as usize * self.camera.width + left as usize;
        let corners = [(0, 0), (1, 0), (0, 1), (1, 1)];
        let mut mean = Tangent { point: DVec3::ZERO, normal: DVec3::ZERO };
        for (du, dv) in corners {
            let pixel = first + du + dv * self.camera.width;
            let weight = if du == 1 { across } else { 1.0 - across } * if dv == 1 { down } else { 1.0 - down };
            let corner = self.tangent(pixel);
            // False for holes.
            let is_same = corner.normal.dot(normal) > SAME_SURFACE_COSINE;
            if !is_same {
                return None;
            }
            mean.point += weight * corner.point;
            mean.normal += weight * corner.normal;
        }
        let off_m = (mean.point - point).dot(normal).abs();
        (off_m < SAME_SURFACE_M).then(|| Tangent { normal: mean.normal.normalize(), ..mean })
    }
}

/// A point of a surface with its normal.
#[derive(Clone, Copy)]
struct Tangent {
    point: DVec3,
    normal: DVec3,
}

/// Mean of several views' estimates of a point: its position along the ray, and the normal.
#[derive(Default)]
struct Blend {
    distance: f64,
    ray: DVec3,
    normal: DVec3,
    weight: f64,
}

impl Blend {
    /// Adds a view's tangent plane unless the ray grazes it, since a grazed plane does not determine the point.
    fn add(&mut self, ray: DVec3, point: DVec3, normal: DVec3, ray_of_view: DVec3) {
        let along = ray.dot(normal);
        // Also false for a NaN.
        if along.abs() > f64::from(GRAZING_COSINE) {
            let cosine = ray_of_view.dot(normal);
            let weight = cosine * cosine;
            self.ray = ray;
            self.distance += weight * point.dot(normal) / along;
            self.normal += weight * normal;
            self.weight += weight;
        }
    }

    fn mean(&self, point: DVec3, normal: DVec3) -> (DVec3, DVec3) {
        if self.weight > 0.0 {
            (self.distance / self.weight * self.ray, self.normal.normalize())
        } else {
            (point, normal)
        }
    }
}

/// Returns the inverse squared noise; noise below 0.1 mm counts as 0.1 mm.
fn weight(sigma_m: f64) -> f64 {
    const LEAST_SIGMA_M: f64 = 1e-4;
    1.0 / sigma_m.max(LEAST_SIGMA_M).powi(2)
}

fn with_weight(point: [f32; 3], weight: f64) -> [f64; 4] {
    let [x, y, z] = point.map(|coordinate| weight * f64::from(coordinate));
    [x, y, z, weight]
}

#[cfg(test)]
mod tests;
