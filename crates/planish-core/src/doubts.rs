//! Checks for implausible inputs: a wrong depth unit, the camera of another image.

use std::fmt;

use crate::camera::Camera;
use crate::frame::{Frame, PointsView, RangeRule};
use crate::threads::ONE_THREAD;

/// Maximum plausible median depth of a depth camera's frame, in metres.
const FARTHEST_M: f32 = 20.0;
/// Minimum plausible median depth of a depth camera's frame, in metres.
const NEAREST_M: f32 = 0.1;

/// Plausible coordinates of the principal point, as shares of the width and height of the image.
const MIDDLE: std::ops::RangeInclusive<f64> = 0.3..=0.7;

/// Relative difference below which two lengths count as equal; allows for half a pixel and for rounding.
const SAME: f64 = 0.02;

/// Plausible focal lengths in image widths: fields of view from 150 to 3 degrees.
const FOCAL_LENGTHS: std::ops::RangeInclusive<f64> = 0.13..=20.0;

/// Maximum number of sampled points.
const SAMPLE: usize = 4096;

/// An implausible property of a frame or its camera. [`Display`](fmt::Display) formats it as one line for the user.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Doubt {
    /// Less than one depth unit per metre: probably the inverse of the intended number.
    UnitsPerMetre {
        /// The stated number of units per metre.
        units: f64,
    },
    /// Most points are nearer or farther than any depth camera can measure.
    Range {
        /// The median depth in metres.
        median_m: f32,
        /// Number of raw depth units per metre; `None` for depth or points in metres.
        units: Option<f64>,
    },
    /// The focal length is half the size of the image: focal length and principal point were probably swapped.
    Swapped {
        /// The camera.
        camera: Camera,
    },
    /// The principal point is far from the middle of the image.
    PrincipalPoint {
        /// The camera.
        camera: Camera,
    },
    /// The field of view is wider or narrower than any depth camera's.
    FocalLength {
        /// The camera.
        camera: Camera,
    },
    /// Coordinates of a cloud are too large for f32's precision.
    Coarse {
        /// The difference between adjacent f32 values at the affected coordinates, in metres.
        step_m: f32,
        /// The distance between neighbouring points at the affected coordinates, in metres.
        spacing_m: f32,
        /// The share of points with affected coordinates, 0 to 1.
        share: f32,
    },
    /// Pixels are lost because the lens model has no ray for them.
    Lens {
        /// The share of lost pixels, 0 to 1.
        lost: f32,
    },
}

/// Returns a doubt about a camera's lens model if the model loses more than 1 % of the pixels.
pub fn doubt_about_lens(camera: &Camera) -> Option<Doubt> {
    /// Share of pixels that a lens may lose at the corners without a warning.
    const FEW: f32 = 0.01;
    let lost = camera.lost_to_lens();
    (lost > FEW).then_some(Doubt::Lens { lost })
}

/// Returns doubts about a frame. For an unorganized cloud, only the precision of f32 is checked, since the cloud may
/// come from any scanner. The camera's lens model is checked by [`doubt_about_lens`] instead.
pub fn doubts(frame: Frame<'_>) -> Vec<Doubt> {
    // WebAssembly builds omit this check.
    let coarse = match frame {
        Frame::Points(points) if !ONE_THREAD => about_resolution(&points),
        _ => None,
    };
    if coarse.is_some() || frame.grid().is_none() {
        return coarse.into_iter().collect();
    }
    let units = match frame {
        Frame::Depth(depth) => (!depth.is_metres()).then_some(depth.camera().depth_units_per_metre),
        Frame::Points(_) => None,
    };
    let mut found = Vec::new();
    if let Some(units) = units.filter(|&units| units < 1.0) {
        found.push(Doubt::UnitsPerMetre { units });
    } else if let Some(median_m) = median_m(frame)
        && !(NEAREST_M..=FARTHEST_M).contains(&median_m)
    {
        found.push(Doubt::Range { median_m, units });
    }
    found.extend(frame.camera().and_then(of_camera));
    found
}

/// Returns a doubt if f32 rounds coordinates too coarsely for the distances between neighbours. Tests a sample of
/// points that are far from the origin.
pub(crate) fn about_resolution(points: &PointsView<'_>) -> Option<Doubt> {
    /// Step of f32, in metres, that is always fine enough, because no sensor is more precise at a distance of a
    /// kilometre.
    const FINE_M: f32 = 1e-4;
    /// Ratio of a step of f32 to the distance between neighbours above which the step is too coarse.
    const SHARE_OF_DISTANCE: f64 = 0.1;
    /// Share of points whose coordinates may be too coarse without a warning.
    const FEW: f32 = 0.01;
    /// Rank of the neighbour that determines the spacing; not the nearest, which may be a duplicate.
    const NEIGHBOUR: usize = 4;
    /// Maximum number of points whose neighbours are searched.
    const LOOKED_AT: usize = 32;
    /// Maximum number of points among which neighbours are searched.
    const AMONG: usize = 200_000;
    let step_of = |[x, y, z]: [f64; 3]| f32::EPSILON * x.abs().max(y.abs()).max(z.abs()) as f32;
    let is_valid = |point: &[f64; 3]| point.iter().all(|value| value.is_finite());

    let stride = points.len().div_ceil(SAMPLE).max(1);
    let sample = || (0..points.len()).step_by(stride).map(|i| points.get_exact(i)).filter(is_valid);
    let far: Vec<[f64; 3]> = sample().filter(|&point| step_of(point) > FINE_M).collect();
    let far_share = far.len() as f32 / sample().count() as f32;
    if far.is_empty() || far_share <= FEW {
        return None;
    }
    let looked_at: Vec<[f64; 3]> = far.iter().step_by(far.len().div_ceil(LOOKED_AT)).copied().collect();
    let stride = points.len().div_ceil(AMONG);
    // If only every `stride`-th point of a surface is kept, neighbours are farther apart by this factor.
    let sparser = (stride as f64).sqrt();
    let spacing_m = |of: &[f64; 3]| {
        let squares = (0..points.len()).step_by(stride).map(|i| {
            let other = points.get_exact(i);
            (0..3).map(|axis| (other[axis] - of[axis]).powi(2)).sum::<f64>()
        });
        let mut nearest = [f64::INFINITY; NEIGHBOUR];
        for square in squares.filter(|&square| square > 0.0) {
            if square < nearest[NEIGHBOUR - 1] {
                nearest[NEIGHBOUR - 1] = square;
                nearest.sort_by(f64::total_cmp);
            }
        }
        (nearest[NEIGHBOUR - 1] / NEIGHBOUR as f64).sqrt() / sparser
    };
    let is_coarse = |(step_m, spacing_m): &(f32, f64)| f64::from(*step_m) > SHARE_OF_DISTANCE * spacing_m;
    let found = looked_at.iter().map(|point| (step_of(*point), spacing_m(point)));
    let coarse: Vec<(f32, f64)> = found.filter(is_coarse).collect();
    let share = far_share * coarse.len() as f32 / looked_at.len() as f32;
    let (step_m, spacing_m) = *coarse.get(coarse.len() / 2)?;
    (share > FEW).then_some(Doubt::Coarse { step_m, spacing_m: spacing_m as f32, share })
}

fn of_camera(camera: &Camera) -> Option<Doubt> {
    let Camera { fx, fy, cx, cy, .. } = *camera;
    let (width, height) = (camera.width as f64, camera.height as f64);
    // A principal point far from the middle shows that the intrinsics are for another image size.
    if !MIDDLE.contains(&((cx + 0.5) / width)) || !MIDDLE.contains(&((cy + 0.5) / height)) {
        let is_half = |focal: f64, size: f64| (2.0 * focal / size - 1.0).abs() < SAME;
        let is_swapped = is_half(fx, width) && is_half(fy, height) && (cx / cy - 1.0).abs() < SAME;
        let (swapped, other) = (Doubt::Swapped { camera: *camera }, Doubt::PrincipalPoint { camera: *camera });
        return Some(if is_swapped { swapped } else { other });
    }
    (!FOCAL_LENGTHS.contains(&(fx / width))).then_some(Doubt::FocalLength { camera: *camera })
}

/// Returns the median depth of a camera's frame in metres; `None` without points, and for frames of sensors other
/// than cameras.
fn median_m(frame: Frame<'_>) -> Option<f32> {
    let (width, height) = frame.shape();
    let step = (width * height).div_ceil(SAMPLE).max(1);
    let mut depths_m: Vec<f32> = match frame {
        Frame::Depth(depth) => (0..width * height).step_by(step).map(|i| depth.depth_m(i % width, i / width)).collect(),
        Frame::Points(points) => {
            // Lidars measure hundreds of metres.
            if !points.pose().is_identity() || !matches!(points.range_rule(), RangeRule::Depth { pitch_at_1m: Some(_) })
            {
                return None;
            }
            (0..width * height).step_by(step).map(|i| points.get(i)[2] as f32).collect()
        }
    };
    depths_m.retain(|depth_m| depth_m.is_finite() && *depth_m > 0.0);
    depths_m.sort_by(f32::total_cmp);
    depths_m.get(depths_m.len() / 2).copied()
}

impl fmt::Display for Doubt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if ONE_THREAD {
            return Ok(());
        }
        match self {
            Self::UnitsPerMetre { units } => write!(
                f,
                "{units} depth units per metre are implausible; expected the number of units in a metre (1000 for \
                 millimetres), the inverse of librealsense's depth scale"
            ),
            Self::Range { median_m, units: Some(units) } => write!(
                f,
                "most depths are about {median_m} m at {units} depth units per metre, which no depth camera measures; \
                 check the depth unit"
            ),
            Self::Range { median_m, units: None } => write!(
                f,
                "most points are {median_m} m away, which no depth camera measures; they may be in millimetres, or \
                 come from a disparity image"
            ),
            Self::Swapped { camera: Camera { fx, fy, cx, cy, .. } } => write!(
                f,
                "the focal length {fx}, {fy} is half the image size; fx, fy and cx, cy may be swapped: try \
                 {cx},{cy},{fx},{fy}"
            ),
            Self::PrincipalPoint { camera: Camera { width, height, cx, cy, .. } } => write!(
                f,
                "the principal point {cx}, {cy} is far from the centre of the {width}x{height} image; the camera may \
                 belong to images of another size"
            ),
            Self::FocalLength { camera: Camera { width, height, fx, .. } } => {
                write!(f, "a focal length of {fx} pixels is unusual for an image of {width}x{height}; check its unit")
            }
            Self::Coarse { step_m, spacing_m, share } => write!(
                f,
                "{:.0} % of the points have coordinates too large for f32, which rounds them to {step_m:.1e} m, but \
                 neighbours are {spacing_m:.1e} m apart; remove stray points with `planish clean --crop`, or save \
                 distant parts as separate files",
                100.0 * share
            ),
            Self::Lens { lost } => write!(
                f,
                "{:.0} % of the pixels are holes, since the lens model folds or reaches beyond 86 degrees there; check \
                 the distortion coefficients",
                100.0 * lost
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Distortion;
    use crate::cloud::PointCloud;
    use crate::frame::{DepthView, IntoFrame};
    use crate::xyz::Xyz;

    fn of(raw: u16, camera: Camera) -> Vec<Doubt> {
        let raw = vec![raw; camera.width * camera.height];
        doubts(DepthView::new(&raw, &camera).unwrap().into_frame().unwrap())
    }

    #[test]
    fn an_organized_cloud_in_two_distant_parts_is_doubtful() {
        let of = |offset_m: f32| {
            let points: Xyz = (0..1600)
                .map(|i| [0.01 * (i % 40) as f32, if i < 600 { offset_m } else { 0.0 }, 0.01 * (i / 40) as f32])
                .collect();
            let cloud = crate::OrganizedCloud::new(40, 40, PointCloud::new(points)).unwrap();
            doubts((&cloud).into_frame().unwrap()).iter().any(|doubt| matches!(doubt, Doubt::Coarse { .. }))
        };
        assert!(of(5.4e6) && !of(50.0));
    }

    #[test]
    fn a_lens_that_shows_nothing_is_doubtful() {
        let kinect = Camera::kinect_v1();
        assert_eq!(doubt_about_lens(&kinect), None);
        let of = |coefficients: &[f64]| {
            doubt_about_lens(&kinect.with_distortion(Distortion::from_opencv(coefficients).unwrap()))
        };
        assert_eq!(of(&[0.1, -0.2, 0.001, 0.002, 0.05]), None);
        // Folds at 0.37 focal lengths; half the width is 0.61.
        let Some(Doubt::Lens { lost }) = of(&[-0.9, 0.0, 0.0, 0.0]) else { panic!("no doubt") };
        assert!((0.3..0.9).contains(&lost), "{lost}");
    }

    #[test]
    fn points_too_far_for_f32_are_doubtful_and_strays_are_not() {
        let plane = |from: f32, count: usize| -> Vec<[f32; 3]> {
            (0..count).map(|i| [from + 0.01 * (i % 100) as f32, 0.01 * (i / 100) as f32, 1.0]).collect()
        };
        let of = |points: &[[f32; 3]]| doubts(PointsView::from_rows(points).unwrap().into_frame().unwrap());
        assert_eq!(of(&plane(0.0, 5000)), []);
        // Points 10 mm apart, with f32 steps of 0.12 mm, then of 8 mm.
        assert_eq!(of(&plane(1e3, 5000)), []);
        let Some(Doubt::Coarse { step_m, spacing_m, share }) = of(&plane(65_600.0, 5000)).pop() else { panic!("fine") };
        assert!((0.007..0.009).contains(&step_m) && spacing_m < 0.02 && share > 0.9, "{step_m} {spacing_m} {share}");
        let both = [plane(0.0, 5000), plane(1e5, 500)].concat();
        assert!(matches!(of(&both)[..], [Doubt::Coarse { share, .. }] if (0.05..0.15).contains(&share)));
        // Coincident strays, and points far from each other.
        let strays = [plane(0.0, 5000), vec![[-5e6, -5e6, -100.0]; 100]].concat();
        assert_eq!(of(&strays), []);
        let sparse: Vec<[f32; 3]> = (0..200).map(|i| [1e5 + 50.0 * i as f32, 7.0 * i as f32, 0.0]).collect();
        assert_eq!(of(&sparse), []);
        // In f32, all points of the second plane have the same position.
        let mut two = PointCloud::new(Xyz::from([plane(0.0, 2500), vec![[1e7; 3]; 2500]].concat()));
        assert_eq!(doubts(PointsView::from_cloud(&two).unwrap().into_frame().unwrap()), []);
        let exact = |axis: usize| {
            let second = |[x, y, _]: [f32; 3]| 1e7 + f64::from([x, y, 0.0][axis]);
            let first = plane(0.0, 2500).into_iter().map(|point| f64::from(point[axis]));
            first.chain(plane(0.0, 2500).into_iter().map(second)).collect()
        };
        two.keep_exact([exact(0), exact(1), exact(2)]);
        let found = doubts(PointsView::from_cloud(&two).unwrap().into_frame().unwrap());
        assert!(matches!(found[..], [Doubt::Coarse { share, .. }] if (0.4..0.6).contains(&share)), "{found:?}");
        // Duplicates one f32 step apart do not count as spacing.
        let once = plane(2048.0, 5000);
        let again = once.iter().map(|&[x, y, z]| [x, y, z + 1e-4]);
        let twice: Vec<[f32; 3]> = again.chain(once.iter().copied()).collect();
        assert_eq!(of(&twice), []);
        assert_eq!(of(&[]), []);
    }

    #[test]
    fn cameras_of_other_images_and_wrong_units_are_doubtful_and_others_are_not() {
        let kinect = Camera::kinect_v1();
        assert_eq!(of(1500, kinect), []);
        assert_eq!(of(0, kinect), []);
        assert!(matches!(of(1500, kinect.with_depth_units_per_metre(0.001))[..], [Doubt::UnitsPerMetre { .. }]));
        assert!(matches!(of(1500, kinect.with_depth_units_per_metre(1e5))[..], [Doubt::Range { units: Some(_), .. }]));
        assert!(matches!(of(1500, kinect.with_depth_units_per_metre(10.0))[..], [Doubt::Range { .. }]));
        let camera = |fx, fy, cx, cy| Camera::new((640, 480), [fx, fy], [cx, cy]);
        assert!(matches!(of(1500, camera(319.5, 239.5, 525.0, 525.0))[..], [Doubt::Swapped { .. }]));
        assert!(matches!(of(1500, camera(525.0, 525.0, 159.5, 119.5))[..], [Doubt::PrincipalPoint { .. }]));
        assert!(matches!(of(1500, camera(0.00525, 0.00525, 319.5, 239.5))[..], [Doubt::FocalLength { .. }]));
        // A real wide-angle camera, and one with an odd principal point.
        assert_eq!(of(1500, camera(252.0, 252.0, 330.0, 240.0)), []);
        // Simulated square images of 90 degrees.
        assert_eq!(of(1500, Camera::new((512, 512), [256.0; 2], [256.0; 2])), []);
        let metres = vec![1090.0f32; 640 * 480];
        let frame = DepthView::from_metres(&metres, &kinect).unwrap().into_frame().unwrap();
        let found = doubts(frame);
        assert!(
            matches!(found[..], [Doubt::Range { units: None, .. }]) && found[0].to_string().contains("millimetres")
        );
    }
}
