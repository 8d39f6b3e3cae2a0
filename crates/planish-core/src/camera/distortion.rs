//! Lens distortion as OpenCV and ROS define it: Brown-Conrady with up to three radial terms (`plumb_bob`), or the
//! rational model with six (`rational_polynomial`).
//!
//! With x, y = X/Z, Y/Z, r² = x² + y² and the radial factor
//! q = (1 + k1 r² + k2 r⁴ + k3 r⁶)/(1 + k4 r² + k5 r⁴ + k6 r⁶), a point is seen at
//! x' = x q + 2 p1 x y + p2 (r² + 2 x²), y' = y q + p1 (r² + 2 y²) + 2 p2 x y, pixel (fx x' + cx, fy y' + cy).

use crate::error::{FrameError, ParamError};

/// Coefficients of lens distortion; all zero for an ideal lens.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Distortion {
    /// Radial coefficients k1 to k6; k4 to k6 are the denominator of the rational model.
    pub radial: [f64; 6],
    /// Tangential coefficients p1, p2.
    pub tangential: [f64; 2],
}

/// Maximum number of Newton steps to find a pixel's ray; starting from the distorted position, wide lenses need about
/// ten.
const MAX_STEPS: usize = 50;
/// Directions between the centre and a ray that are checked for a fold.
const FOLD_SAMPLES: u32 = 24;
/// Maximum residual of a ray, in focal lengths: a millionth of a pixel.
const RESIDUAL: f64 = 1e-9;

impl Distortion {
    /// A pinhole camera, or an image that was rectified.
    pub const NONE: Self = Self { radial: [0.0; 6], tangential: [0.0; 2] };

    /// Returns the coefficients in the order of OpenCV and ROS: k1, k2, p1, p2, and then k3, and then k4, k5, k6. 0, 4,
    /// 5 or 8 of them.
    pub fn from_opencv(coefficients: &[f64]) -> Option<Self> {
        let mut all = [0.0; 8];
        // OpenCV's longer vectors add thin prism and tilt terms; as zeros they mean nothing.
        let (used, rest) = coefficients.split_at(coefficients.len().min(8));
        if !matches!(used.len(), 0 | 4 | 5 | 8) || rest.iter().any(|c| *c != 0.0) {
            return None;
        }
        all[..used.len()].copy_from_slice(used);
        let [k1, k2, p1, p2, k3, k4, k5, k6] = all;
        Some(Self { radial: [k1, k2, k3, k4, k5, k6], tangential: [p1, p2] })
    }

    /// Returns the eight coefficients in the order of OpenCV and ROS.
    pub fn to_opencv(&self) -> [f64; 8] {
        let ([k1, k2, k3, k4, k5, k6], [p1, p2]) = (self.radial, self.tangential);
        [k1, k2, p1, p2, k3, k4, k5, k6]
    }

    /// Returns true if all coefficients are zero.
    pub fn is_none(&self) -> bool {
        *self == Self::NONE
    }

    pub(super) fn validate(&self) -> Result<(), FrameError> {
        if self.to_opencv().iter().all(|c| c.is_finite()) {
            return Ok(());
        }
        let value = format!("{:?}", self.to_opencv());
        Err(FrameError::BadCamera(ParamError { field: "distortion", value, allowed: "finite coefficients" }))
    }

    /// Projects the direction (x, y, 1) and returns its position and the partial derivatives [xx, xy, yy].
    pub(super) fn distort(&self, x: f64, y: f64) -> ([f64; 2], [f64; 3]) {
        let ([k1, k2, k3, k4, k5, k6], [p1, p2]) = (self.radial, self.tangential);
        let r2 = x * x + y * y;
        let (above, below) = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
        let q = above / below;
        // dq/d(r²)
        let (d_above, d_below) = (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3), k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6));
        let dq = (d_above - q * d_below) / below;
        let seen =
            [x * q + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y * q + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y];
        let xx = q + 2.0 * x * x * dq + 2.0 * p1 * y + 6.0 * p2 * x;
        let xy = 2.0 * x * y * dq + 2.0 * p1 * x + 2.0 * p2 * y;
        let yy = q + 2.0 * y * y * dq + 6.0 * p1 * y + 2.0 * p2 * x;
        (seen, [xx, xy, yy])
    }

    /// Returns the direction (x, y, 1) seen at a position, which is in focal lengths from the principal point. `None`
    /// outside the image circle, where the model is not invertible.
    pub fn undistort(&self, seen: [f64; 2]) -> Option<[f64; 2]> {
        let [mut x, mut y] = seen;
        for _ in 0..MAX_STEPS {
            let ([at_x, at_y], [xx, xy, yy]) = self.distort(x, y);
            let (error_x, error_y) = (seen[0] - at_x, seen[1] - at_y);
            let determinant = xx * yy - xy * xy;
            // A determinant that is not positive means that the image folds over itself. False for NaN.
            let is_invertible = determinant > 1e-6 && xx > 0.0;
            if !is_invertible {
                return None;
            }
            if error_x.hypot(error_y) <= RESIDUAL {
                return self.is_before_fold(x, y).then_some([x, y]);
            }
            x += (yy * error_x - xy * error_y) / determinant;
            y += (xx * error_y - xy * error_x) / determinant;
        }
        None
    }
}

impl Distortion {
    /// Fits the model with five coefficients that maps directions (x, y, 1) to observed positions, by least squares.
    /// Returns it with its largest error, in focal lengths; `None` if the pairs do not determine it.
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
        let fitted = Self { radial: [k1, k2, k3, 0.0, 0.0, 0.0], tangential: [p1, p2] };
        let distance = |&([x, y], seen): &([f64; 2], [f64; 2])| {
            let ([at_x, at_y], _) = fitted.distort(x, y);
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

impl Distortion {
    /// Returns true if the image does not fold over itself between its centre and a direction.
    fn is_before_fold(&self, x: f64, y: f64) -> bool {
        (1..FOLD_SAMPLES).all(|i| {
            let share = f64::from(i) / f64::from(FOLD_SAMPLES);
            let (_, [xx, xy, yy]) = self.distort(share * x, share * y);
            xx * yy - xy * xy > 0.0 && xx > 0.0
        })
    }
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
                let (seen, _) = distortion.distort(direction[0], direction[1]);
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
        let (seen, _) = distortion.distort(0.3, -0.2);
        let r2: f64 = 0.13;
        let q = 1.0 + 0.1 * r2 - 0.05 * r2 * r2 + 0.01 * r2 * r2 * r2;
        let x = 0.3 * q + 2.0 * 0.001 * 0.3 * -0.2 - 0.002 * (r2 + 2.0 * 0.09);
        let y = -0.2 * q + 0.001 * (r2 + 2.0 * 0.04) + 2.0 * -0.002 * 0.3 * -0.2;
        assert!((seen[0] - x).abs() < 1e-15 && (seen[1] - y).abs() < 1e-15);
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
