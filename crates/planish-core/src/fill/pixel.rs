//! Fits the surface at one pixel of a hole to the points at the hole's rim in eight directions, and to points behind
//! them.

use rayon::prelude::*;

use super::constants::{
    DIRECTIONS, GROWTH, REACH, RIDGES, RIM_DEVIATIONS, RIM_SHARE, SAMPLES, SHADOW_CHANGE, SHADOW_MARGIN_PX, SHADOW_PX,
    SHADOW_SAMPLES, SHADOW_SHARES, SHADOW_SPACING_PX, SPACING_PX,
};
use super::distances::{Distances, NONE};
use super::image::Image;
use super::labels::Labels;
use crate::camera::solve;
use crate::frame::Colours;

/// Maximum difference between the colours of one object, in the channel that differs most.
const OTHER_COLOUR: i16 = 50;

/// The holes of a frame.
pub(super) struct Holes<'a> {
    pub(super) image: Image<'a>,
    pub(super) distances: &'a Distances,
    pub(super) most_px: usize,
    pub(super) shadow: Option<Shadow>,
    pub(super) colours: Option<Colours<'a>>,
    pub(super) sigma_m: Option<&'a [f32]>,
    /// The smallest and the largest 1/z in the frame.
    pub(super) extent: [f32; 2],
    /// 1/z of measurements that smoothing has turned into holes, 0 for other pixels.
    pub(super) lost: &'a [f32],
}

/// The shadows that near objects cast for a sensor with two views.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shadow {
    /// Baseline times focal length: the width of a shadow, in pixels, per difference of 1/z.
    pub(super) shift: f32,
    pub(super) side: Side,
}

/// The side of near objects on which their shadows fall.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Side {
    Left,
    Right,
}

/// Value in `Patch::rims` of a direction without a rim.
const NO_RIM: u32 = u32::MAX;

/// A filled pixel of a row.
#[derive(Clone)]
pub(super) struct Patch {
    pub(super) u: usize,
    /// Value of 1/z, in 1/m.
    pub(super) inverse: f64,
    /// Differences of 1/z from column to column and from row to row.
    pub(super) slopes: [f64; 2],
    pub(super) sigma_m: f64,
    /// Number of points that the surface was fitted to.
    pub(super) samples: u32,
    pub(super) rims: [u32; 8],
}

impl Patch {
    /// Returns the indices of the rim pixels that the surface was fitted to.
    pub(super) fn rims(&self) -> impl Iterator<Item = usize> + '_ {
        self.rims.iter().filter(|&&rim| rim != NO_RIM).map(|&rim| rim as usize)
    }
}

/// The first point in a direction from a pixel of a hole.
#[derive(Debug, Clone, Copy)]
struct Rim {
    direction: [isize; 2],
    steps: usize,
    pixel: usize,
    inverse: f32,
}

impl Rim {
    fn distance_px(&self) -> f64 {
        let [x, y] = self.direction;
        self.steps as f64 * ((x * x + y * y) as f64).sqrt()
    }
}

/// Weighted sums for fitting a polynomial of degree 2 to 1/z around a pixel, with coordinates in units of `scale_px`.
struct Fit {
    scale_px: f64,
    a: [[f64; 6]; 6],
    t: [f64; 6],
    samples: u32,
}

impl Fit {
    fn new(scale_px: f64) -> Self {
        Self { scale_px, a: [[0.0; 6]; 6], t: [0.0; 6], samples: 0 }
    }

    fn add(&mut self, [x, y]: [f64; 2], inverse: f64) {
        let weight = 1.0 / (x * x + y * y);
        let [x, y] = [x / self.scale_px, y / self.scale_px];
        let basis = [1.0, x, y, x * x, x * y, y * y];
        for i in 0..6 {
            let weighted = weight * basis[i];
            self.t[i] += weighted * inverse;
            // The rest follows from symmetry.
            (i..6).for_each(|j| self.a[i][j] += weighted * basis[j]);
        }
        self.samples += 1;
    }

    /// Returns the matrix of the normal equations, with the ridge added.
    fn matrix(&self) -> [[f64; 6]; 6] {
        let of_ridge = |i: usize, j: usize| if i == j { RIDGES[i] * self.a[0][0] } else { 0.0 };
        std::array::from_fn(|i| std::array::from_fn(|j| self.a[i.min(j)][i.max(j)] + of_ridge(i, j)))
    }

    fn solve(&self) -> Option<Surface> {
        Some(Surface { scale_px: self.scale_px, coefficients: solve(self.matrix(), self.t)? })
    }

    /// Returns the variance of the fit at the pixel, relative to that of a weighted mean of the samples.
    fn leverage(&self) -> f64 {
        let inverse = solve(self.matrix(), [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        inverse.map_or(f64::INFINITY, |inverse| inverse[0] * self.a[0][0])
    }
}

/// A fitted polynomial around a pixel.
struct Surface {
    scale_px: f64,
    coefficients: [f64; 6],
}

impl Surface {
    fn at(&self, [x, y]: [f64; 2]) -> f64 {
        let ([x, y], [c0, cx, cy, cxx, cxy, cyy]) = ([x / self.scale_px, y / self.scale_px], self.coefficients);
        c0 + x * (cx + x * cxx + y * cxy) + y * (cy + y * cyy)
    }
}

impl Holes<'_> {
    /// Returns the first point in a direction, `steps` steps away; `None` if it does not exist or is too far away.
    fn rim(&self, (u, v): (usize, usize), direction: [isize; 2], steps: u8) -> Option<Rim> {
        let (steps, [x, y]) = (usize::from(steps), direction);
        if steps > REACH * self.most_px || steps == usize::from(NONE) {
            return None;
        }
        let moved = |at: usize, by: isize| at.wrapping_add_signed(by * steps as isize);
        let pixel = moved(v, y) * self.image.shape.0 + moved(u, x);
        Some(Rim { direction, steps, pixel, inverse: self.image.inverse[pixel] })
    }

    /// Adds a rim point to the fit, and points behind it on the same surface.
    fn add(&self, fit: &mut Fit, (u, v): (usize, usize), rim: &Rim, samples: usize, spacing_px: isize) {
        let [x, y] = rim.direction;
        let (mut last, limit) = (rim.inverse, self.image.step_limit(rim.inverse));
        for k in 0..samples as isize {
            let steps = rim.steps as isize + k * spacing_px;
            let (u, v) = (u.wrapping_add_signed(x * steps), v.wrapping_add_signed(y * steps));
            if u >= self.image.shape.0 || v >= self.image.shape.1 {
                return;
            }
            let inverse = self.image.inverse[v * self.image.shape.0 + u];
            if inverse == 0.0 || (last - inverse).abs() > limit {
                return;
            }
            fit.add([(x * steps) as f64, (y * steps) as f64], f64::from(inverse));
            last = inverse;
        }
    }

    /// Returns the surface at a pixel of a hole; `None` if the pixel stays a hole.
    pub(super) fn fill(&self, at @ (u, v): (usize, usize), labels: &Labels) -> Option<Patch> {
        let steps = self.distances.at(v * self.image.shape.0 + u);
        let width_px = |axis: usize| match [steps[2 * axis], steps[2 * axis + 1]] {
            [NONE, _] | [_, NONE] => usize::MAX,
            [one, other] => {
                let run_px = usize::from(one) + usize::from(other) - 1;
                // Along diagonals, pixels are farther apart.
                if axis < 2 { run_px } else { (std::f64::consts::SQRT_2 * run_px as f64) as usize }
            }
        };
        let is_narrow = |axis: usize| width_px(axis) <= self.most_px;
        if !(0..4).any(is_narrow) {
            return None;
        }
        let rims: [Option<Rim>; 8] = std::array::from_fn(|k| self.rim(at, DIRECTIONS[k], steps[k]));
        let is_surrounded = rims.iter().all(Option::is_some);
        let spanned = if is_surrounded || !labels.has_step(labels.hole(at)) { self.spanned(at, &rims) } else { None };
        spanned.or_else(|| if is_narrow(0) { self.shadowed(at, &rims) } else { None })
    }

    /// Returns the surface through all rim points; `None` if they are not on one surface.
    fn spanned(&self, at: (usize, usize), rims: &[Option<Rim>; 8]) -> Option<Patch> {
        // On a plane, lines between opposite points meet at the pixel. This test rejects, without a fit, most rims
        // that span two surfaces.
        let (mut least, mut most) = (f32::INFINITY, 0.0f32);
        for axis in rims.chunks_exact(2) {
            if let [Some(one), Some(other)] = axis {
                let share = one.steps as f32 / (one.steps + other.steps) as f32;
                let inverse = one.inverse + share * (other.inverse - one.inverse);
                (least, most) = (least.min(inverse), most.max(inverse));
            }
        }
        if least < most && self.image.is_step(least, most) {
            return None;
        }
        let farthest_px = rims.iter().flatten().map(Rim::distance_px).fold(0.0, f64::max);
        let mut fit = Fit::new(farthest_px);
        rims.iter().flatten().for_each(|rim| self.add(&mut fit, at, rim, SAMPLES, SPACING_PX));
        let surface = fit.solve()?;
        let is_other = |colour: [u8; 3]| {
            let other = self.colour(at.1 * self.image.shape.0 + at.0);
            other.is_some_and(|other| difference(colour, other) > OTHER_COLOUR)
        };
        if rims.iter().flatten().all(|rim| self.colour(rim.pixel).is_some_and(is_other)) {
            return None;
        }
        self.patch(at, &surface, rims, fit.samples)
    }

    /// Returns the far surface; `None` if the pixel is not in the shadow of a near surface.
    fn shadowed(&self, at: (usize, usize), rims: &[Option<Rim>; 8]) -> Option<Patch> {
        let (shadow, right, left) = (self.shadow?, rims[0]?, rims[1]?);
        let (near, far) = match shadow.side {
            Side::Left => (right, left),
            Side::Right => (left, right),
        };
        let width_px = near.steps + far.steps - 1;
        if !self.is_shadow(shadow.shift, near.inverse, far.inverse, width_px) {
            return None;
        }
        let excess_px = (width_px as f32 - shadow.shift * (near.inverse - far.inverse)).max(0.0);
        if near.steps as f32 <= SHADOW_MARGIN_PX + excess_px {
            return None;
        }
        // Rim points on the side of the near surface may belong to any surface.
        let towards_near = near.direction[0];
        let is_other = |rim: &Rim| self.image.is_step(rim.inverse, far.inverse);
        let rims = rims.map(|rim| rim.filter(|rim| rim.direction[0] != towards_near));
        // If a third surface is farther away, either it or the far surface could continue behind the near one.
        if rims.iter().flatten().any(|rim| rim.inverse < far.inverse && is_other(rim)) {
            return None;
        }
        let of_far = rims.map(|rim| rim.filter(|rim| !is_other(rim)));
        let farthest_px = of_far.iter().flatten().map(Rim::distance_px).fold(0.0, f64::max);
        let mut fit = Fit::new(farthest_px);
        let add = |rim: &Rim| self.add(&mut fit, at, rim, SHADOW_SAMPLES, SHADOW_SPACING_PX);
        of_far.iter().flatten().for_each(add);
        let surface = fit.solve()?;
        let colours = [at.1 * self.image.shape.0 + at.0, near.pixel, far.pixel].map(|i| self.colour(i));
        if let [Some(here), Some(of_near), Some(of_far)] = colours
            && difference(of_near, of_far) > OTHER_COLOUR
            && difference(here, of_near) < difference(here, of_far)
        {
            return None;
        }
        let patch = self.patch(at, &surface, &of_far, fit.samples)?;
        let inverse = patch.inverse as f32;
        if (inverse - far.inverse).abs() > SHADOW_CHANGE * far.inverse {
            return None;
        }
        // The surface must be behind the one that casts the shadow.
        (inverse < near.inverse && self.image.is_step(inverse, near.inverse))
            .then(|| Patch { sigma_m: fit.leverage().max(1.0).sqrt() * patch.sigma_m, ..patch })
    }

    fn is_shadow(&self, shift: f32, near: f32, far: f32, width_px: usize) -> bool {
        let explained_px = shift * (near - far);
        let [least, most] = [0, 1].map(|k| SHADOW_SHARES[k] * explained_px + SHADOW_PX[k]);
        near > far && self.image.is_step(near, far) && (least..=most).contains(&(width_px as f32))
    }

    fn patch(&self, at: (usize, usize), surface: &Surface, rims: &[Option<Rim>; 8], samples: u32) -> Option<Patch> {
        let [inverse, x, y, ..] = surface.coefficients;
        let (mut squares, mut weights, mut sigma_m, mut nearest_px) = (0.0, 0.0, 0.0, f64::INFINITY);
        for rim in rims.iter().flatten() {
            let [dx, dy] = rim.direction.map(|d| d as f64 * rim.steps as f64);
            let off = surface.at([dx, dy]) - f64::from(rim.inverse);
            if off.abs() > f64::from(self.image.limit(rim.inverse, RIM_DEVIATIONS, RIM_SHARE)) {
                return None;
            }
            let (weight, z_m) = (rim.distance_px().powi(-2), f64::from(rim.inverse).recip());
            squares += weight * (off * z_m * z_m).powi(2);
            sigma_m += weight * self.sigma_m.map_or(0.0, |sigma_m| f64::from(sigma_m[rim.pixel]));
            weights += weight;
            nearest_px = nearest_px.min(rim.distance_px());
        }
        let growth = GROWTH[0] + GROWTH[1] * nearest_px;
        let sigma_m = growth * (squares / weights + (sigma_m / weights).powi(2)).sqrt();
        self.is_possible(at, inverse).then(|| Patch {
            u: at.0,
            inverse,
            slopes: [x / surface.scale_px, y / surface.scale_px],
            sigma_m,
            samples,
            rims: rims.map(|rim| rim.map_or(NO_RIM, |rim| rim.pixel as u32)),
        })
    }

    /// Returns true if a value of 1/z is within the frame's extent and contradicts no measurement that was lost in
    /// smoothing.
    pub(super) fn is_possible(&self, (u, v): (usize, usize), inverse: f64) -> bool {
        let lost = self.lost[v * self.image.shape.0 + u];
        let [least, most] = self.extent.map(f64::from);
        let is_within = ((1.0 - RIM_SHARE) * least..=(1.0 + RIM_SHARE) * most).contains(&inverse);
        // False for a NaN.
        is_within && (lost == 0.0 || !self.image.is_step(lost, inverse as f32))
    }

    fn colour(&self, i: usize) -> Option<[u8; 3]> {
        self.colours.map(|colours| colours.at(i))
    }

    /// Returns the shadows of this frame, with the side of near objects on which they fall; `None` if it has no
    /// shadows.
    pub(super) fn find_shadow(&self, shift: f64) -> Option<Shadow> {
        let (width, height) = self.image.shape;
        let shift = shift as f32;
        let of_row = |v: usize| {
            let row = &self.image.inverse[v * width..(v + 1) * width];
            let (mut votes, mut last) = ([0usize; 2], None);
            for u in (0..width).filter(|&u| row[u] > 0.0) {
                if let Some(before) = last.replace(u).filter(|before| u - before > 2) {
                    let (left, right, width_px) = (row[before], row[u], u - before - 1);
                    votes[0] += usize::from(self.is_shadow(shift, right, left, width_px)) * width_px;
                    votes[1] += usize::from(self.is_shadow(shift, left, right, width_px)) * width_px;
                }
            }
            votes
        };
        let [left, right] =
            (0..height).into_par_iter().map(of_row).reduce(|| [0; 2], |a, b| [a[0] + b[0], a[1] + b[1]]);
        let side = if left >= right { Side::Left } else { Side::Right };
        (left + right > 0).then_some(Shadow { shift, side })
    }
}

/// Returns the largest difference between the channels of two colours.
fn difference(a: [u8; 3], b: [u8; 3]) -> i16 {
    (0..3).map(|k| (i16::from(a[k]) - i16::from(b[k])).abs()).max().unwrap_or(0)
}
