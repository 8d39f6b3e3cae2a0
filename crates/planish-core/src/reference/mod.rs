//! The reference engine: a literal implementation of docs/method.md in f64, written for readability. It is the oracle
//! for the fast engines, so it shares no inner loops and no constants with them and is never optimised.
//!
//! One file per stage: [`blocks`] and [`window`] (section 2), [`radius`] (3), [`plane`] (4), [`polynomial`] and
//! [`solve`] (5, 6), [`project`] (7), [`edges`], [`bend`] and [`cells`] (10). Unorganized clouds have their own radii
//! and neighbours ([`general`], 8) and edges ([`general_edges`], 10). All stages compute in the sensor's frame (11);
//! results are rotated back at the end.

mod bend;
mod blocks;
mod cells;
mod edges;
mod general;
mod general_edges;
mod plane;
mod polynomial;
mod project;
mod radius;
mod solve;
pub(crate) mod temporal;
mod window;

use std::sync::Arc;

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use crate::error::{EngineError, Error};
use crate::frame::{Frame, FrameGeometry};
use crate::outputs::SmoothedMut;
use crate::params::{Edges, EngineParams};
use crate::progress::Progress;
use crate::smoothing_engine::{AdmittedFrame, ImmediateEngine};
use crate::status::Status;
use crate::threads::Threads;
use plane::Plane;
use project::Projected;
use window::{Grid, Neighbour};

/// The reference's result for one point, in the sensor's frame.
#[derive(Debug, Clone, Copy)]
struct PointResult {
    /// Displacement from the measured to the smoothed point; NaN for a hole.
    displacement: DVec3,
    /// Ratio of the depth at which the point's ray meets the surface to the measured depth; NaN for a hole.
    depth_scale: f64,
    normal: DVec3,
    curvature: f64,
    status: Status,
    neighbours: u32,
}

impl PointResult {
    fn hole() -> Self {
        let (displacement, normal) = (DVec3::NAN, DVec3::NAN);
        Self { displacement, depth_scale: f64::NAN, normal, curvature: f64::NAN, status: Status::Hole, neighbours: 0 }
    }

    /// Returns the result of a point that is left unchanged because it has too few neighbours.
    fn kept(self) -> Self {
        Self { displacement: DVec3::ZERO, depth_scale: 1.0, status: Status::Isolated, ..self }
    }
}

/// The surface of a point, relative to the point. Section numbers are those of docs/method.md.
#[derive(Debug, Clone, Copy)]
struct Surface {
    /// Number of neighbours in the point's own window.
    neighbours: u32,
    /// The plane; `None` if the neighbours are too few or lie on a line.
    plane: Option<Plane>,
    /// Distance from the plane within which a neighbour counts (section 10).
    width_m: f64,
    /// Bend tensor, in 1/m (section 10).
    bend: DMat3,
    /// Sum of the principal curvatures in the point's window, in 1/m (section 10).
    window_bend: f64,
    /// Degree to which no plane around the point fits, from 0 to 1 (section 10).
    no_plane_fits: f64,
    /// Certainty of the surface, from 0 (no plane near the point fits it) to 1 (section 10).
    certainty: f64,
}

impl Surface {
    /// Returns the surface of a point from its own neighbours, given as offsets from the point (docs/method.md,
    /// section 4).
    fn own(offsets: &[DVec3], radius_m: f64, ray: DVec3) -> Self {
        let plane = if offsets.len() < 3 { None } else { plane::fit(offsets, radius_m, ray) };
        let neighbours = offsets.len() as u32;
        let (width_m, bend, window_bend, no_plane_fits) = (f64::INFINITY, DMat3::ZERO, 0.0, 0.0);
        Self { neighbours, plane, width_m, bend, window_bend, no_plane_fits, certainty: 0.0 }
    }
}

fn offsets_of(neighbours: &[Neighbour]) -> Vec<DVec3> {
    neighbours.iter().map(|neighbour| neighbour.offset).collect()
}

/// Smooths one point over its surface (docs/method.md, sections 5 to 7).
fn smooth_point(
    p: DVec3,
    sensor: DVec3,
    offsets: &[DVec3],
    radius_m: f64,
    params: &EngineParams,
    surface: &Surface,
    on_ray: bool,
) -> PointResult {
    let &Surface { neighbours, ref plane, .. } = surface;
    if neighbours < 3 {
        return PointResult { status: Status::TooFew, neighbours, ..PointResult::hole() };
    }
    let Some(plane) = plane else {
        return PointResult {
            displacement: DVec3::ZERO,
            depth_scale: 1.0,
            status: Status::Degenerate,
            neighbours,
            ..PointResult::hole()
        };
    };
    let bandwidth_m = params.bandwidth_m.map_or(radius_m, f64::from);
    let polynomial = polynomial::over(surface, plane, offsets, radius_m, bandwidth_m, params);
    let Projected { displacement, normal, status, depth_scale } =
        project::project(p, sensor, plane, polynomial.as_ref(), radius_m, on_ray);
    PointResult { displacement, depth_scale, normal, curvature: plane.curvature, status, neighbours }
}

/// The reference engine.
pub(crate) struct Reference {
    params: EngineParams,
    threads: Threads,
    progress: Arc<Progress>,
}

impl ImmediateEngine for Reference {
    fn smooth(&mut self, frame: &AdmittedFrame<'_>, out: SmoothedMut<'_>) -> Result<(), Error> {
        let (points, results) = self.results(frame)?;
        store(frame, &points, &results, out);
        Ok(())
    }

    fn progress(&self) -> Option<Arc<Progress>> {
        Some(Arc::clone(&self.progress))
    }
}

impl Reference {
    pub(crate) fn open(params: EngineParams, threads: Option<usize>) -> Result<Self, EngineError> {
        Ok(Self { params, threads: Threads::open(threads)?, progress: Arc::default() })
    }

    /// Returns the points as measured, in the cloud's frame, and their results, in the sensor's frame.
    fn results(&self, frame: &AdmittedFrame<'_>) -> Result<(Vec<DVec3>, Vec<PointResult>), Error> {
        let points: Vec<DVec3> = match frame.frame {
            Frame::Depth(depth) => {
                let cloud = depth.deproject()?;
                cloud.positions().iter().map(|p| DVec3::from_array(p.map(f64::from))).collect()
            }
            Frame::Points(points) => (0..points.len()).map(|i| points.point(i)).collect(),
        };
        let results = match frame.frame.grid() {
            None => {
                let cloud = match frame.frame {
                    Frame::Points(view) => general::Cloud {
                        points: &points,
                        extent_m: view.extent_m(),
                        least_neighbours: self.params.least_neighbours(&view),
                    },
                    // Depth frames are always on a grid.
                    Frame::Depth(_) => general::Cloud { points: &points, extent_m: None, least_neighbours: 0 },
                };
                general::smooth(&self.params, &self.threads, &cloud, &frame.geometry, &self.progress)?
            }
            Some((width, height)) => {
                let points = match frame.geometry.cloud_from_sensor {
                    None => points.clone(),
                    Some(transform) => points.iter().map(|&p| transform.to_sensor(p)).collect(),
                };
                // Progress counts only the fit, which takes by far the longest.
                let (columns, rows) = self.params.cells_of((width, height));
                self.progress.begin(columns * rows);
                self.smooth_grid(&Grid { points, width, height }, &frame.geometry)
            }
        };
        Ok((points, results))
    }

    /// Smooths a grid of points in the sensor's frame.
    fn smooth_grid(&self, pixels: &Grid, geometry: &FrameGeometry) -> Vec<PointResult> {
        let params = &self.params;
        let grid = &pixels.cells(params.cell_px());
        let noise_m = |p: DVec3| edges::noise_m(&params.sensor, geometry.range_m(p), self.radius_m(geometry, p));
        let means = params.averages_blocks().then(|| {
            let mean = |p, cell| p + blocks::mean_offset(pixels, cell, p, params, geometry, None);
            self.samples(grid, mean)
        });
        let samples = means.as_ref().unwrap_or(grid);
        let own = |p, cell| {
            let radius_m = self.radius_m(geometry, p);
            let neighbours = self.neighbours(samples, geometry, p, cell);
            let surface = Surface::own(&offsets_of(&neighbours), radius_m, p);
            let bends = |plane| bend::of_window(&neighbours, &plane, radius_m, params);
            Some(Surface { window_bend: surface.plane.map_or(0.0, bends), ..surface })
        };
        let mut surfaces = self.for_each_pixel(grid, None, own);
        if params.edges != Edges::Off {
            let first_planes = edges::FirstPlanes { grid, surfaces: &surfaces, params, noise_m: &noise_m };
            let surface = |p: DVec3, (u, v): (usize, usize)| {
                let mean_offset = samples.points[v * grid.width + u] - p;
                first_planes.surface((u, v), p, mean_offset, self.radius_m(geometry, p))
            };
            surfaces = self.for_each_pixel(grid, None, surface);
        }
        let surface_of = |(u, v): (usize, usize)| surfaces[v * grid.width + u];
        let on_surfaces = (means.is_some() && params.edges == Edges::Robust).then(|| {
            let mean = |p, cell| p + blocks::mean_offset(pixels, cell, p, params, geometry, surface_of(cell).as_ref());
            self.samples(grid, mean)
        });
        let samples = on_surfaces.as_ref().unwrap_or(samples);
        let on_ray = geometry.is_on_rays(params.project);
        // The points of cells move along the normals of their planes.
        let moves_on_ray = on_ray && params.cell_px() == 1;
        let smooth = |p, cell| {
            let Some(surface) = surface_of(cell) else { return PointResult::hole() };
            let offsets = offsets_of(&self.neighbours(samples, geometry, p, cell));
            self.progress.add(1);
            smooth_point(p, DVec3::ZERO, &offsets, self.radius_m(geometry, p), params, &surface, moves_on_ray)
        };
        let results = self.for_each_pixel(grid, PointResult::hole(), smooth);
        if params.cell_px() == 1 {
            return results;
        }
        let (means, surfaces) = (means.as_ref(), &surfaces[..]);
        let surfaces = cells::CellSurfaces { cells: grid, means, surfaces, results: &results, on_ray };
        let on_surfaces = |p, pixel| {
            let (radius_m, block_gate_m) = (self.radius_m(geometry, p), blocks::gate_m(params, geometry, p));
            surfaces.result(pixel, &cells::Point { p, radius_m, noise_m: noise_m(p), block_gate_m })
        };
        self.for_each_pixel(pixels, PointResult::hole(), on_surfaces)
    }

    fn radius_m(&self, geometry: &FrameGeometry, p: DVec3) -> f64 {
        radius::radius_m(&self.params, geometry, p)
    }

    /// Returns the neighbours of a cell's point p.
    fn neighbours(&self, samples: &Grid, geometry: &FrameGeometry, p: DVec3, cell: (usize, usize)) -> Vec<Neighbour> {
        window::neighbours(samples, cell, p, &self.params, self.radius_m(geometry, p))
    }

    /// Returns a grid with the value of `mean` for every valid point and its cell.
    fn samples(&self, grid: &Grid, mean: impl Fn(DVec3, (usize, usize)) -> DVec3 + Sync) -> Grid {
        Grid { points: self.for_each_pixel(grid, DVec3::NAN, mean), width: grid.width, height: grid.height }
    }

    /// Applies `work` to every valid point and its pixel or cell. The result of each hole is `hole`.
    fn for_each_pixel<T: Clone + Send + Sync>(
        &self,
        grid: &Grid,
        hole: T,
        work: impl Fn(DVec3, (usize, usize)) -> T + Sync,
    ) -> Vec<T> {
        let row = |v: usize| {
            let pixel = |u: usize| grid.point(u, v).map_or_else(|| hole.clone(), |p| work(p, (u, v)));
            (0..grid.width).map(pixel).collect::<Vec<_>>()
        };
        let rows: Vec<_> = self.threads.install(|| (0..grid.height).into_par_iter().map(row).collect());
        rows.into_iter().flatten().collect()
    }
}

/// Rotates the results back into the cloud's frame, as displacements of the measured points, and rounds them to f32
/// into the available buffers.
fn store(frame: &AdmittedFrame<'_>, points: &[DVec3], results: &[PointResult], mut out: SmoothedMut<'_>) {
    let rotation = frame.geometry.cloud_from_sensor.map(|transform| transform.rotation);
    let turned = |vector: DVec3| rotation.map_or(vector, |rotation| rotation * vector);
    let to_f32 = |vector: DVec3| vector.to_array().map(|value| value as f32);
    for (i, result) in results.iter().enumerate() {
        if let Some(points_out) = &mut out.points {
            points_out.set(i, to_f32(points[i] + turned(result.displacement)));
        }
        if let Some(normals) = &mut out.normals {
            normals.set(i, to_f32(turned(result.normal)));
        }
        if let Some(curvature) = &mut out.curvature {
            curvature[i] = result.curvature as f32;
        }
        if let Some(status) = &mut out.status {
            status[i] = result.status;
        }
        if let Some(neighbours) = &mut out.neighbours {
            neighbours[i] = result.neighbours;
        }
        let in_sensor = frame.geometry.cloud_from_sensor.map_or(points[i], |t| t.to_sensor(points[i]));
        let depth_m = (in_sensor.z * result.depth_scale) as f32;
        if let (Some(depth), Some(camera)) = (&mut out.depth, frame.frame.camera()) {
            depth[i] = camera.raw_depth(depth_m);
        }
        if let Some(depths_m) = &mut out.depth_m {
            depths_m[i] = depth_m;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Camera;
    use crate::frame::{GeometryScratch, IntoFrame, PointsView};
    use crate::params::{CloudParams, FrameParams};
    use crate::pose::SensorPose;
    use crate::testing::{DepthNoise, Pose, Scene, simulated};

    /// Returns a noisy frame of 96x72 points.
    fn noisy_points(scene: (Scene, Pose)) -> Vec<[f64; 3]> {
        let camera = Camera::new((96, 72), [78.75; 2], [47.5, 35.5]);
        let frame = simulated(scene, DepthNoise::default(), camera, 2);
        frame.deproject().unwrap().positions().iter().map(|p| p.map(f64::from)).collect()
    }

    /// docs/method.md, section 11: moving a cloud together with its pose moves the result in the same way. Tested in
    /// f64, with and without a grid.
    #[test]
    fn a_rigid_motion_moves_the_result_to_a_nanometre() {
        let own = noisy_points(Scene::room(2));
        let settings = [
            (EngineParams::from(FrameParams::paper().with_radius_m(0.15)), true),
            (FrameParams::default().with_stride(1).into(), true),
            (FrameParams::default().with_stride(2).into(), true),
            (CloudParams::paper().with_radius_m(0.15).into(), false),
        ];
        let viewpoints = [
            [0.1, 0.0, 0.6, 0.5, -0.5, 0.5, -0.5],
            [-2.0, 31.0, 4.0, 0.0, 1.0, 0.0, 0.0],
            [3.0, -1.0, 2.0, 0.1, 0.7, -0.5, 0.5],
        ];
        for (params, on_grid) in settings {
            let engine = Reference::open(params, None).unwrap();
            let results = |points: &[[f64; 3]], pose: SensorPose| {
                let view = PointsView::from_rows_f64(points).unwrap();
                let view = if on_grid { view.with_grid(96, 72).unwrap() } else { view };
                let frame = view.with_pose(pose).unwrap().into_frame().unwrap();
                let geometry = FrameGeometry::of(frame, true, &mut GeometryScratch::default());
                let rotation = geometry.cloud_from_sensor.map_or(glam::DMat3::IDENTITY, |t| t.rotation);
                (engine.results(&AdmittedFrame::new(frame, geometry)).unwrap(), rotation)
            };
            let ((_, expected), _) = results(&own, SensorPose::IDENTITY);
            assert!(expected.iter().filter(|result| result.status.has_normal()).count() > 3000);
            for viewpoint in viewpoints {
                let length = viewpoint[3..].iter().map(|c| c * c).sum::<f64>().sqrt();
                let mut unit = viewpoint;
                unit[3..].iter_mut().for_each(|c| *c /= length);
                let pose = SensorPose::from_viewpoint(unit);
                let transform = pose.transform().unwrap();
                let moved: Vec<[f64; 3]> = own
                    .iter()
                    .map(|&p| (transform.rotation * DVec3::from_array(p) + transform.translation).to_array())
                    .collect();
                let ((points, found), rotation) = results(&moved, pose);
                let mut differing = 0;
                for (i, (found, expected)) in found.iter().zip(&expected).enumerate() {
                    if found.status != expected.status || found.neighbours != expected.neighbours {
                        differing += 1;
                        continue;
                    }
                    if !found.status.has_point() {
                        continue;
                    }
                    // Compares with the moved result of the original cloud.
                    let found_m = points[i] + rotation * found.displacement;
                    let own_m = DVec3::from_array(own[i]) + expected.displacement;
                    let off_m = (found_m - (transform.rotation * own_m + transform.translation)).length();
                    assert!(off_m < 1e-9, "{viewpoint:?}, point {i}: {off_m:e}");
                }
                assert!(differing <= 1, "{viewpoint:?}: {differing}");
            }
        }
    }

    /// docs/method.md, section 6: the result does not depend on the in-plane axes, which a roll of the sensor's frame
    /// rotates.
    #[test]
    fn turned_in_plane_axes_change_nothing() {
        let points = noisy_points(Scene::tabletop(5));
        for (window, degree, radius_m) in [(3, 3, 0.03), (7, 3, 0.05), (3, 2, 0.08), (2, 3, 0.3)] {
            let params = FrameParams::paper().with_window(window).with_degree(degree).with_radius_m(radius_m).into();
            let engine = Reference::open(params, None).unwrap();
            let results = |roll_rad: f64| {
                let (sin, cos) = (roll_rad / 2.0).sin_cos();
                let pose = SensorPose { position_m: [0.0; 3], orientation: [cos, 0.0, 0.0, sin] };
                let view = PointsView::from_rows_f64(&points).unwrap().with_grid(96, 72).unwrap();
                let frame = view.with_pose(pose).unwrap().into_frame().unwrap();
                let transform = pose.transform().unwrap();
                let rule = crate::frame::RangeRule::Depth { pitch_at_1m: None };
                let geometry = FrameGeometry { cloud_from_sensor: Some(transform), rule };
                let (_, results) = engine.results(&AdmittedFrame::new(frame, geometry)).unwrap();
                results.into_iter().map(move |result| (result.status, transform.rotation * result.displacement))
            };
            let expected: Vec<_> = results(1e-3).collect();
            for roll_rad in [0.4, 1.2, 2.9] {
                let (mut largest_m, mut found) = (0.0, 0);
                for ((status, displacement), (own_status, own)) in results(roll_rad).zip(&expected) {
                    if status == *own_status && status.has_normal() {
                        largest_m = f64::max(largest_m, (displacement - *own).length());
                        found += 1;
                    }
                }
                assert!(largest_m < 1e-9 && found > 1000, "{window} {degree} {radius_m}: {largest_m:e}, {found}");
            }
        }
    }
}
