//! Lens distortion as OpenCV and ROS define it: Brown-Conrady with up to three radial terms (`plumb_bob`), or the
//! rational model with six (`rational_polynomial`).
//!
//! With x, y = X/Z, Y/Z, r² = x² + y² and the radial factor
//! q = (1 + k1 r² + k2 r⁴ + k3 r⁶)/(1 + k4 r² + k5 r⁴ + k6 r⁶), a point is seen at
//! x' = x q + 2 p1 x y + p2 (r² + 2 x²), y' = y q + p1 (r² + 2 y²) + 2 p2 x y, pixel (fx x' + cx, fy y' + cy).
//!
//! A fisheye follows Kannala and Brandt (OpenCV's `fisheye`, ROS's `equidistant`): the angle a = atan r from the axis
//! is seen at a distance of a (1 + k1 a² + k2 a⁴ + k3 a⁶ + k4 a⁸) focal lengths.

use crate::error::{FormatError, FrameError, ParamError};

/// Lens distortion.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Distortion {
    /// Brown-Conrady, or rational; all coefficients are zero for an ideal lens.
    Rational {
        /// Radial coefficients k1 to k6; k4 to k6 are the denominator of the rational model.
        radial: [f64; 6],
        /// Tangential coefficients p1, p2.
        tangential: [f64; 2],
    },
    /// Kannala-Brandt with k1 to k4; all are zero for an ideal equidistant fisheye.
    Equidistant([f64; 4]),
}

/// Maximum number of Newton steps to find a pixel's ray; starting from the distorted position, wide lenses need about
/// ten.
const MAX_STEPS: usize = 50;
/// Number of steps, from the centre outwards, in which the image is checked for a fold.
const FOLD_SAMPLES: u32 = 24;
/// Maximum residual of a ray in focal lengths; at a focal length of 1000 pixels, a millionth of a pixel.
const RESIDUAL: f64 = 1e-9;
/// Largest angle between the axis and a ray, in radians: 86 degrees, since x/z grows without limit towards 90
/// degrees.
const WIDEST: f64 = 1.5;

/// Names that other programs give to lenses without distortion.
const PINHOLE: [&str; 4] = ["none", "pinhole", "simple_pinhole", "rectified"];
/// Names that other programs give to models with OpenCV's coefficients.
const RATIONAL: [&str; 8] =
    ["", "opencv", "full_opencv", "plumb_bob", "rational_polynomial", "radtan", "radial-tangential", "brown_conrady"];
/// Names that other programs give to the model of Kannala and Brandt.
const EQUIDISTANT: [&str; 8] = [
    "equidistant",
    "equi",
    "fisheye",
    "opencv_fisheye",
    "kannala_brandt",
    "kannala_brandt4",
    "kannalabrandt8",
    "kannala-brandt",
];

impl Distortion {
    /// No distortion: a pinhole camera, or a rectified image.
    pub const NONE: Self = Self::Rational { radial: [0.0; 6], tangential: [0.0; 2] };

    /// Creates a distortion from coefficients in the order of OpenCV and ROS: k1, k2, p1, p2, k3, k4, k5, k6. `None`
    /// unless there are 0, 4, 5 or 8 of them; further coefficients must be 0.
    pub fn from_opencv(coefficients: &[f64]) -> Option<Self> {
        let mut all = [0.0; 8];
        // OpenCV's longer vectors add thin prism and tilt terms, which have no effect if they are 0.
        let (used, rest) = coefficients.split_at(coefficients.len().min(8));
        if !matches!(used.len(), 0 | 4 | 5 | 8) || rest.iter().any(|c| *c != 0.0) {
            return None;
        }
        all[..used.len()].copy_from_slice(used);
        let [k1, k2, p1, p2, k3, k4, k5, k6] = all;
        Some(Self::Rational { radial: [k1, k2, k3, k4, k5, k6], tangential: [p1, p2] })
    }

    /// Creates the distortion of a model from its coefficients and its case-insensitive name in ROS, OpenCV, Kalibr,
    /// COLMAP, librealsense or ORB-SLAM. An empty name is OpenCV's model.
    ///
    /// # Errors
    /// If the model is unknown, or the number of coefficients does not fit the model.
    pub fn of_model(model: &str, coefficients: &[f64]) -> Result<Self, FormatError> {
        let lower_case = model.to_ascii_lowercase();
        let name = lower_case.strip_prefix("distortion.").unwrap_or(&lower_case);
        let are_zero = coefficients.iter().all(|coefficient| *coefficient == 0.0);
        let wrong_count = |supported: &str| {
            let count = coefficients.len();
            FormatError::Malformed(format!("{count} distortion coefficients are not supported; expected {supported}"))
        };
        if PINHOLE.contains(&name) {
            return Ok(Self::NONE);
        }
        if EQUIDISTANT.contains(&name) {
            // librealsense has a fifth coefficient, which is 0.
            let four = coefficients.split_first_chunk::<4>().filter(|(_, rest)| rest.iter().all(|k| *k == 0.0));
            let four = four.map(|(four, _)| Self::Equidistant(*four));
            return four.ok_or_else(|| wrong_count("4 for a fisheye lens (k1 k2 k3 k4)"));
        }
        if RATIONAL.contains(&name) {
            let known = if are_zero { Some(Self::NONE) } else { Self::from_opencv(coefficients) };
            return known.ok_or_else(|| wrong_count("4 (k1 k2 p1 p2), 5 (and k3) or 8 (and k4 k5 k6)"));
        }
        // With zero coefficients, these models have no distortion either.
        if are_zero && name.ends_with("brown_conrady") {
            return Ok(Self::NONE);
        }
        let shown: String = model.chars().take(40).collect();
        Err(FormatError::Unsupported(format!(
            "unsupported distortion model {shown:?}; expected plumb_bob, rational_polynomial or equidistant, or \
             rectify the images first"
        )))
    }

    /// Returns the model's name in ROS.
    pub fn model(&self) -> &'static str {
        match self {
            Self::Rational { radial: [_, _, _, 0.0, 0.0, 0.0], .. } => "plumb_bob",
            Self::Rational { .. } => "rational_polynomial",
            Self::Equidistant(_) => "equidistant",
        }
    }

    /// Returns the coefficients in the order of OpenCV and ROS: 5 or 8, or 4 for a fisheye.
    pub fn coefficients(&self) -> Vec<f64> {
        match *self {
            Self::Rational { radial: [k1, k2, k3, k4, k5, k6], tangential: [p1, p2] } => {
                let all = [k1, k2, p1, p2, k3, k4, k5, k6];
                all[..if self.model() == "plumb_bob" { 5 } else { 8 }].to_vec()
            }
            Self::Equidistant(all) => all.to_vec(),
        }
    }

    /// Returns true if the model is OpenCV's and all coefficients are zero.
    pub fn is_none(&self) -> bool {
        *self == Self::NONE
    }

    pub(super) fn validate(&self) -> Result<(), FrameError> {
        // The check runs for every frame, so it avoids allocating a list of the coefficients.
        let are_finite = match self {
            Self::Rational { radial, tangential } => radial.iter().chain(tangential).all(|c| c.is_finite()),
            Self::Equidistant(all) => all.iter().all(|c| c.is_finite()),
        };
        if are_finite {
            return Ok(());
        }
        let value = format!("{:?}", self.coefficients());
        Err(FrameError::BadCamera(ParamError { field: "distortion", value, allowed: "finite coefficients" }))
    }

    /// Returns the image position of the direction (x, y, 1), in focal lengths from the principal point.
    pub(super) fn distort(&self, x: f64, y: f64) -> [f64; 2] {
        match self {
            Self::Rational { radial, tangential } => rational(radial, tangential, [x, y]).0,
            Self::Equidistant(k) => {
                let radius = x.hypot(y);
                let (seen, _) = equidistant(k, radius.atan());
                let scale = if radius > 0.0 { seen / radius } else { 1.0 };
                [scale * x, scale * y]
            }
        }
    }

    /// Returns x and y of the direction (x, y, 1) that is seen at an image position, given in focal lengths from the
    /// principal point. `None` outside the image circle, where the model is not invertible.
    pub fn undistort(&self, seen: [f64; 2]) -> Option<[f64; 2]> {
        match self {
            Self::Rational { radial, tangential } => undistort_rational(radial, tangential, seen),
            Self::Equidistant(k) => {
                let radius = seen[0].hypot(seen[1]);
                let tangent = angle_seen_at(k, radius)?.tan();
                let scale = if radius > 0.0 { tangent / radius } else { 1.0 };
                Some(seen.map(|value| scale * value))
            }
        }
    }
}

/// Projects the direction (x, y, 1) by the rational model. Returns the image position in focal lengths, and its
/// partial derivatives [xx, xy, yy].
fn rational(radial: &[f64; 6], tangential: &[f64; 2], [x, y]: [f64; 2]) -> ([f64; 2], [f64; 3]) {
    let ([k1, k2, k3, k4, k5, k6], [p1, p2]) = (*radial, *tangential);
    let r2 = x * x + y * y;
    let (above, below) = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
    let q = above / below;
    // dq/d(r²)
    let (d_above, d_below) = (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3), k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6));
    let dq = (d_above - q * d_below) / below;
    let seen = [x * q + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y * q + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y];
    let xx = q + 2.0 * x * x * dq + 2.0 * p1 * y + 6.0 * p2 * x;
    let xy = 2.0 * x * y * dq + 2.0 * p1 * x + 2.0 * p2 * y;
    let yy = q + 2.0 * y * y * dq + 6.0 * p1 * y + 2.0 * p2 * x;
    (seen, [xx, xy, yy])
}

fn undistort_rational(radial: &[f64; 6], tangential: &[f64; 2], seen: [f64; 2]) -> Option<[f64; 2]> {
    // A determinant that is not positive means that the image folds over itself. False for NaN.
    let is_invertible = |[xx, xy, yy]: [f64; 3], least: f64| xx * yy - xy * xy > least && xx > 0.0;
    let is_before_fold = |[x, y]: [f64; 2]| {
        (1..FOLD_SAMPLES).all(|i| {
            let share = f64::from(i) / f64::from(FOLD_SAMPLES);
            is_invertible(rational(radial, tangential, [share * x, share * y]).1, 0.0)
        })
    };
    let [mut x, mut y] = seen;
    for _ in 0..MAX_STEPS {
        let ([at_x, at_y], slopes @ [xx, xy, yy]) = rational(radial, tangential, [x, y]);
        if !is_invertible(slopes, 1e-6) {
            return None;
        }
        let (error_x, error_y) = (seen[0] - at_x, seen[1] - at_y);
        if error_x.hypot(error_y) <= RESIDUAL {
            return is_before_fold([x, y]).then_some([x, y]);
        }
        let determinant = xx * yy - xy * xy;
        x += (yy * error_x - xy * error_y) / determinant;
        y += (xx * error_y - xy * error_x) / determinant;
    }
    None
}

/// Returns the distance from the principal point at which an angle from the axis is seen, in focal lengths, and its
/// derivative.
fn equidistant([k1, k2, k3, k4]: &[f64; 4], angle: f64) -> (f64, f64) {
    let a2 = angle * angle;
    let seen = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))));
    (seen, 1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4))))
}

/// Returns the angle in radians that is seen at a distance from the principal point, in focal lengths; `None` beyond
/// [`WIDEST`] and where the image folds over itself.
fn angle_seen_at(k: &[f64; 4], radius: f64) -> Option<f64> {
    // Up to the fold or the widest angle, the radius grows with the angle, so the angle is unique. Newton's method
    // finds it, with bisection as a fallback.
    let grows = |i: &u32| equidistant(k, WIDEST * f64::from(*i) / f64::from(FOLD_SAMPLES)).1 > 0.0;
    let growing = (1..=FOLD_SAMPLES).take_while(grows).last().unwrap_or(0);
    let mut bounds = [0.0, WIDEST * f64::from(growing) / f64::from(FOLD_SAMPLES)];
    // False for a NaN.
    let is_within = equidistant(k, bounds[1]).0 >= radius;
    if !is_within {
        return None;
    }
    let mut angle = radius.min(bounds[1]);
    for _ in 0..MAX_STEPS {
        let (seen, slope) = equidistant(k, angle);
        if (seen - radius).abs() <= RESIDUAL {
            return Some(angle);
        }
        bounds[usize::from(seen > radius)] = angle;
        let next = angle - (seen - radius) / slope;
        let is_between = next > bounds[0] && next < bounds[1];
        angle = if is_between { next } else { (bounds[0] + bounds[1]) / 2.0 };
    }
    None
}

impl Distortion {
    /// Fits the model with five coefficients to pairs of a direction (x, y, 1) and its observed position, by least
    /// squares. Returns the model and its largest error in focal lengths; `None` if the pairs do not determine the
    /// model.
    pub fn fit(pairs: &[([f64; 2], [f64; 2])]) -> Option<(Self, f64)> {
        // The model is linear in k1, k2, k3, p1, p2.
        let (mut a, mut t) = ([[0.0; 5]; 5], [0.0; 5]);
        for &([x, y], seen) in pairs {
            let r2 = x * x + y * y;
            let (r4, r6) = (r2 * r2, r2 * r2 * r2);
            let rows = [
                ([x * r2, x * r4, x * r6, 2.0 * x * y, r2 + 2.0 * x * x], seen[0] - x),
                ([y * r2, y * r4, y * r6, r2 + 2.0 * y * y, 2.0 * x * y], seen[1] - y),
            ];
            for (row, distance) in rows {
                for i in 0..5 {
                    t[i] += row[i] * distance;
                    (0..5).for_each(|j| a[i][j] += row[i] * row[j]);
                }
            }
        }
        let [k1, k2, k3, p1, p2] = solve(a, t)?;
        let fitted = Self::Rational { radial: [k1, k2, k3, 0.0, 0.0, 0.0], tangential: [p1, p2] };
        let distance = |&([x, y], seen): &([f64; 2], [f64; 2])| {
            let [at_x, at_y] = fitted.distort(x, y);
            (at_x - seen[0]).hypot(at_y - seen[1])
        };
        Some((fitted, pairs.iter().map(distance).fold(0.0, f64::max)))
    }
}

/// Solves A c = t for a symmetric positive A by elimination; `None` if A is singular.
pub(crate) fn solve<const N: usize>(mut a: [[f64; N]; N], mut t: [f64; N]) -> Option<[f64; N]> {
    for i in 0..N {
        // False for a NaN.
        let is_positive = a[i][i] > 0.0;
        if !is_positive {
            return None;
        }
        for j in i + 1..N {
            let share = a[j][i] / a[i][i];
            (i..N).for_each(|k| a[j][k] -= share * a[i][k]);
            t[j] -= share * t[i];
        }
    }
    for i in (0..N).rev() {
        let above: f64 = (i + 1..N).map(|k| a[i][k] * t[k]).sum();
        t[i] = (t[i] - above) / a[i][i];
    }
    Some(t)
}

impl Default for Distortion {
    fn default() -> Self {
        Self::NONE
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_survive_distortion_and_back_with_both_models() {
        // Coefficients of a RealSense colour camera and of an Azure Kinect's depth camera.
        let brown_conrady = Distortion::from_opencv(&[0.159, -0.491, -3.5e-4, 1.4e-4, 0.444]).unwrap();
        let rational = Distortion::from_opencv(&[5.34, 3.61, -1.2e-4, 9.2e-5, 0.186, 5.67, 5.33, 0.97]).unwrap();
        for distortion in [brown_conrady, rational, Distortion::NONE] {
            for i in 0..121 {
                let direction = [0.12 * f64::from(i % 11 - 5), 0.09 * f64::from(i / 11 - 5)];
                let seen = distortion.distort(direction[0], direction[1]);
                let found = distortion.undistort(seen).unwrap();
                let error = (found[0] - direction[0]).hypot(found[1] - direction[1]);
                assert!(error < 1e-8, "{distortion:?} {direction:?} {found:?}");
            }
        }
    }

    #[test]
    fn the_formula_is_opencvs() {
        // cv2.projectPoints([[0.3, -0.2, 1]], 0, 0, I, d) with d = (0.1, -0.05, 0.001, -0.002, 0.01).
        let distortion = Distortion::from_opencv(&[0.1, -0.05, 0.001, -0.002, 0.01]).unwrap();
        let seen = distortion.distort(0.3, -0.2);
        let r2: f64 = 0.13;
        let q = 1.0 + 0.1 * r2 - 0.05 * r2 * r2 + 0.01 * r2 * r2 * r2;
        let x = 0.3 * q + 2.0 * 0.001 * 0.3 * -0.2 - 0.002 * (r2 + 2.0 * 0.09);
        let y = -0.2 * q + 0.001 * (r2 + 2.0 * 0.04) + 2.0 * -0.002 * 0.3 * -0.2;
        assert!((seen[0] - x).abs() < 1e-15 && (seen[1] - y).abs() < 1e-15);
    }

    #[test]
    fn a_fisheye_is_opencvs_and_is_inverted_up_to_86_degrees() {
        // cv2.fisheye.distortPoints([[0.5, -0.2]], I, d).
        let fisheye = Distortion::of_model("equidistant", &[-0.013, 0.021, -0.0089, 0.0013]).unwrap();
        let [x, y] = fisheye.distort(0.5, -0.2);
        let angle = 0.5f64.hypot(0.2).atan();
        let a2 = angle * angle;
        let radius = angle * (1.0 - 0.013 * a2 + 0.021 * a2.powi(2) - 0.0089 * a2.powi(3) + 0.0013 * a2.powi(4));
        assert!((x.hypot(y) - radius).abs() < 1e-15 && (x / y + 2.5).abs() < 1e-14);
        let ideal = Distortion::Equidistant([0.0; 4]);
        for lens in [fisheye, ideal] {
            for degrees in 0..86 {
                let tangent = f64::from(degrees).to_radians().tan();
                let direction = [0.6 * tangent, -0.8 * tangent];
                let found = lens.undistort(lens.distort(direction[0], direction[1])).unwrap();
                let error = (found[0] - direction[0]).hypot(found[1] - direction[1]);
                assert!(error < 1e-6 * (1.0 + tangent * tangent), "{degrees}: {found:?}");
            }
            assert_eq!(lens.undistort([2.0, 0.0]), None);
        }
        // Folds at an angle of 0.58.
        let folding = Distortion::Equidistant([-1.0, 0.0, 0.0, 0.0]);
        assert!(folding.undistort([0.3, 0.0]).is_some());
        assert_eq!(folding.undistort([0.5, 0.0]), None);
        assert_eq!(folding.undistort([f64::NAN, 0.0]), None);
    }

    #[test]
    fn models_are_known_by_their_names_elsewhere() {
        let five = [0.1, -0.2, 0.001, 0.002, 0.0];
        for (name, coefficients, model) in [
            ("plumb_bob", &five[..], "plumb_bob"),
            ("radtan", &five[..4], "plumb_bob"),
            ("distortion.brown_conrady", &five, "plumb_bob"),
            ("", &[], "plumb_bob"),
            ("rational_polynomial", &[0.1, 0.0, 0.0, 0.0, 0.0, 0.3, 0.0, 0.0], "rational_polynomial"),
            ("KannalaBrandt8", &five[..4], "equidistant"),
            ("OPENCV_FISHEYE", &[0.0; 4], "equidistant"),
            ("distortion.inverse_brown_conrady", &[0.0; 5], "plumb_bob"),
        ] {
            assert_eq!(Distortion::of_model(name, coefficients).unwrap().model(), model, "{name}");
        }
        for (name, coefficients, problem) in [
            ("plumb_bob", &five[..3], "3 distortion coefficients"),
            ("equidistant", &five[..3], "4 for a fisheye"),
            ("equidistant", &[0.1, 0.0, 0.0, 0.0, 0.1], "4 for a fisheye"),
            ("ftheta", &five, "rectify"),
            ("distortion.inverse_brown_conrady", &five, "rectify"),
        ] {
            let error = Distortion::of_model(name, coefficients).unwrap_err().to_string();
            assert!(error.contains(problem), "{error}");
        }
    }

    #[test]
    fn what_the_lens_does_not_show_has_no_direction() {
        // With k1 = -0.4 the image folds over at r² = 1/(3 * 0.4).
        let barrel = Distortion::from_opencv(&[-0.4, 0.0, 0.0, 0.0]).unwrap();
        assert!(barrel.undistort([0.3, 0.3]).is_some());
        assert_eq!(barrel.undistort([2.0, 2.0]), None);
        // Newton's method may jump over the fold, at r = 1.04 here, to the next branch.
        let folding = Distortion::from_opencv(&[-0.4, 0.05, 0.0, 0.0]).unwrap();
        for i in 0..200 {
            let found = folding.undistort([0.02 * f64::from(i), 0.0]);
            assert!(found.is_none_or(|[x, _]| x < 1.04), "{i}: {found:?}");
        }
        assert_eq!(Distortion::from_opencv(&[0.1; 3]), None);
        assert!(Distortion::from_opencv(&[0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]).is_some());
    }
}
