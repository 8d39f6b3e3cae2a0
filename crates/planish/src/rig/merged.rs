//! All points of a moment as one general cloud, and its result given back to the cameras.

use glam::DVec3;
use rayon::prelude::*;

use crate::cloud::PointCloud;
use crate::error::{Error, FrameError};
use crate::frame::Frame;
use crate::pose::RigidTransform;
use crate::smoothed::Smoothed;
use crate::smoother::Smoother;
use crate::status::Status;
use crate::xyz::Xyz;

/// A camera's points in the rig's frame.
struct InRig {
    /// Their pixels, holes left out.
    pixels: Vec<usize>,
    positions: Vec<[f32; 3]>,
    shape: (usize, usize),
    rig_from_points: RigidTransform,
    /// Where the camera stands.
    lens: DVec3,
}

/// Smooths the points of all cameras as one cloud; each camera gets its own back, on its grid and in the frame of its points.
pub(super) fn smooth(
    smoother: &mut Smoother,
    frames: &[Option<(Frame<'_>, RigidTransform)>],
    lenses: &[DVec3],
) -> Result<Vec<Option<Smoothed>>, Error> {
    let in_rig = frames.par_iter().zip(lenses).map(|(frame, &lens)| {
        frame.as_ref().map(|(frame, rig_from_points)| in_rig(*frame, *rig_from_points, lens)).transpose()
    });
    let cameras: Vec<Option<InRig>> = in_rig.collect::<Result<_, FrameError>>()?;
    let positions: Xyz = cameras.iter().flatten().flat_map(|camera| &camera.positions).copied().collect();
    let mut smoothed = Smoothed::default();
    if !positions.is_empty() {
        smoother.smooth(&PointCloud::new(positions), &mut smoothed)?;
    }
    let mut first = 0;
    let mut starts = Vec::new();
    for camera in &cameras {
        starts.push(first);
        first += camera.as_ref().map_or(0, |camera| camera.pixels.len());
    }
    let given_back = cameras.par_iter().zip(starts).map(|(camera, first)| {
        let camera = camera.as_ref()?;
        Some(camera.given_back(&smoothed, first))
    });
    Ok(given_back.collect())
}

fn in_rig(frame: Frame<'_>, rig_from_points: RigidTransform, lens: DVec3) -> Result<InRig, FrameError> {
    let shape = frame.shape();
    let point = |i: usize, point: [f64; 3]| {
        let point = DVec3::from_array(point);
        point.is_finite().then(|| (i, rig_from_points.to_cloud(point).as_vec3().to_array()))
    };
    let (pixels, positions) = match frame {
        Frame::Points(points) => (0..points.len()).filter_map(|i| point(i, points.get(i))).unzip(),
        Frame::Depth(depth) => {
            let cloud = depth.deproject()?;
            let points = cloud.points.positions.iter().enumerate();
            points.filter_map(|(i, p)| point(i, p.map(f64::from))).unzip()
        }
    };
    Ok(InRig { pixels, positions, shape, rig_from_points, lens })
}

impl InRig {
    /// What was found for the points from `first` on, in the frame that they came from; normals face the camera.
    fn given_back(&self, all: &Smoothed, first: usize) -> Smoothed {
        let (width, height) = self.shape;
        let pixels = width * height;
        let points_from_rig = self.rig_from_points.inverse();
        let mut back = Smoothed { width, height, points: Xyz::filled(pixels, f32::NAN), ..Smoothed::default() };
        back.normals = all.normals.as_ref().map(|_| Xyz::filled(pixels, f32::NAN));
        back.curvature = all.curvature.as_ref().map(|_| vec![f32::NAN; pixels]);
        back.status = all.status.as_ref().map(|_| vec![Status::Hole; pixels]);
        back.neighbours = all.neighbours.as_ref().map(|_| vec![0; pixels]);
        for (i, &pixel) in (first..).zip(&self.pixels) {
            let in_rig = DVec3::from_array(all.points.get(i).map(f64::from));
            back.points.set(pixel, points_from_rig.to_cloud(in_rig).as_vec3().to_array());
            if let (Some(normals), Some(of_all)) = (&mut back.normals, &all.normals) {
                let normal = DVec3::from_array(of_all.get(i).map(f64::from));
                let facing = if normal.dot(in_rig - self.lens) > 0.0 { -normal } else { normal };
                normals.set(pixel, (points_from_rig.rotation * facing).as_vec3().to_array());
            }
            if let (Some(curvature), Some(of_all)) = (&mut back.curvature, &all.curvature) {
                curvature[pixel] = of_all[i];
            }
            if let (Some(status), Some(of_all)) = (&mut back.status, &all.status) {
                status[pixel] = of_all[i];
            }
            if let (Some(neighbours), Some(of_all)) = (&mut back.neighbours, &all.neighbours) {
                neighbours[pixel] = of_all[i];
            }
        }
        back
    }
}
