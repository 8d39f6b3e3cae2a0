//! Constants of the method for the f32 engines, shared by CPU and GPU. The reference defines its own copies. Sections
//! and equation numbers refer to docs/method.md.

/// Minimum number of neighbours for a plane (docs/method.md, section 2).
pub(crate) const LEAST_NEIGHBOURS: f32 = 3.0;

/// Maximum ratio l1/l2 (second-largest to largest variance) at which a neighbourhood counts as a line (docs/method.md,
/// section 4).
pub(crate) const DEGENERATE_RATIO: f32 = 1e-4;
/// sqrt(log2 e). Lengths are measured in units of B/sqrt(log2 e), where B is the bandwidth, so that the weight is a
/// power of two: exp(-x²) = 2^(-x² log2 e).
pub(crate) const SQRT_LOG2_E: f32 = 1.201_122_4;

/// Steepness of the gate's fade (docs/method.md, equation 2.1): a neighbour at distance d has the weight 0.5 + 16 (1 -
/// d²/r²), clamped to the range from 0 to 1.
pub(crate) const GATE_FADE: f32 = 16.0;

/// Cosine of the angle of incidence below which a point moves less and less along its ray (docs/method.md, section
/// 7).
pub const GRAZING_COSINE: f32 = 0.2;
/// Maximum displacement of a point along its ray, as a share of its distance from the sensor (docs/method.md, section
/// 7).
pub(crate) const MAX_ALONG: f32 = 0.5;

/// Maximum ratio of a point's radius to the mean radius around it, in unorganized clouds (docs/method.md, section 8).
pub(crate) const MAX_RADIUS_RATIO: f32 = 1.5;

// Keeping edges (docs/method.md, section 10).

/// Maximum doubt of a plane, l2/(l1 - l0). Larger values have no further effect; the square of this limit fits f32.
pub(crate) const MAX_DOUBT: f32 = 1e6;
/// Sum of the gate weights of a plane's points up to which the plane does not count (docs/method.md, equation 10.2).
/// With a sum larger by 1, the plane counts fully.
pub(crate) const MIN_TOTAL: f32 = 5.0;
/// Minimum standard deviation of the noise, as a share of the radius.
pub(crate) const MIN_NOISE: f32 = 0.01;
/// Weight of the squared distance between a plane and a point, relative to the residual variance of the plane's own
/// points (docs/method.md, equation 10.6).
pub(crate) const DISTANCE_WEIGHT: f32 = 0.3;
/// Distance in radii up to which the planes of other points are considered, because windows reach that far on oblique
/// surfaces.
pub(crate) const PLANE_REACH: f32 = 2.0;
/// Width of the neighbours' weight as a function of their distance from the surface, in standard deviations of the
/// noise (docs/method.md, equation 10.10).
pub(crate) const NARROW_WIDTH: f32 = 1.0;
/// Distance from the surface beyond which points of a block have only the minimum weight, as a multiple of
/// [`NARROW_WIDTH`] (docs/method.md, equation 10.9).
pub(crate) const BLOCK_WIDTH: f32 = 1.5;
/// Square root of the minimum weight of a block's points (docs/method.md, equation 10.9).
pub(crate) const MIN_BLOCK_WEIGHT: f32 = 0.02;
/// Variance added to a plane per unit of its doubt, l2/(l1 - l0): as a share of the noise variance for frames
/// (docs/method.md, equation 10.6), of the plane's own variance for unorganized clouds (10.22). A disc has a doubt of
/// 1.
pub(crate) const DOUBT_WEIGHT: f32 = 0.01;
/// Cosine of the angle of incidence up to which a plane does not count (docs/method.md, equation 10.2). No camera sees
/// a surface this oblique; such points are a row across a large step.
pub(crate) const MIN_INCIDENCE_COSINE: f32 = 0.05;
/// Excess of the cosine of incidence over [`MIN_INCIDENCE_COSINE`] from which a plane counts fully.
pub(crate) const COSINE_FADE: f32 = 0.01;
/// Weight of a zero displacement in the mean over the planes around a point, where a perfectly fitting plane has weight
/// 1 (docs/method.md, equation 10.8). Also the weight of a point's own normal in the mean over surfaces (10.21).
pub(crate) const STAY_WEIGHT: f32 = 1e-3;
/// Weight of the normal of a point's own window, which defines a normal where no plane is near (docs/method.md,
/// equation 10.8).
pub(crate) const OWN_NORMAL_WEIGHT: f32 = 1e-12;
/// Sum of the fits of the planes around a point, where a plane without residual adds 1 (F in docs/method.md, equation
/// 10.17). Up to the first value, no plane is considered to fit; from the second value on, the planes suffice.
pub(crate) const FITTING: [f32; 2] = [0.6, 1.6];
/// Gate weight from which a plane around a point counts fully in the turning of the normals (docs/method.md, equation
/// 10.17).
pub(crate) const NEAR_ENOUGH: f32 = 0.05;
/// Increase of the turning of the normals (T in docs/method.md, equation 10.17) for each missing plane of the nine
/// around a point.
pub(crate) const MISSING_PLANE: f32 = 0.1 / 9.0;
/// Turning of the normals of the planes around a point, as 1 - cos of an angle (T in docs/method.md, equation 10.17).
/// Up to the first value, the planes suffice, however badly they fit; from the second value on, only their fit
/// decides.
pub(crate) const TURNING: [f32; 2] = [0.02, 0.07];
/// Maximum ridge of the second fit, which is used where no plane fits (docs/method.md, section 10, step 7).
pub(crate) const LOW_RIDGE: f32 = 3e-4;
/// Maximum ridge of the second fit if the point has six neighbours, which the six coefficients of a polynomial of
/// degree 2 would fit exactly (docs/method.md, section 10, step 7).
pub(crate) const FEWEST_RIDGE: f32 = 3e-3;
/// Variance of all neighbours around the polynomial of the second fit, relative to the noise variance
/// (docs/method.md, equation 10.18). Up to the first value, the second fit counts fully; from the second value on,
/// not at all.
pub(crate) const CLOSE: [f32; 2] = [0.3, 0.8];
/// Sum of the weights of the surfaces around a point up to which the point is on none of them (docs/method.md,
/// equation 10.20).
pub(crate) const LEAST_SURFACE_WEIGHT: f32 = 1e-12;
/// Distance, in standard deviations of the noise, from which another surface does not count for a point that was moved
/// onto its own surface (docs/method.md, equation 10.21).
pub(crate) const MEAN_WIDTH: f32 = 1.5;
/// Cosine between the normals of a point's own surface and another one (docs/method.md, equation 10.21). Up to the
/// first value, the other surface does not count; from the second value on, it counts fully.
pub(crate) const ALIKE: [f32; 2] = [0.9, 0.95];
/// Share of the surfaces around a point that count (W/4 in docs/method.md, equation 10.21). Up to the first value,
/// only their tangent planes matter; from the second value on, their bend counts fully.
pub(crate) const AROUND: [f32; 2] = [0.6, 0.9];
/// Value added to the certainty of surfaces whose normals are averaged, so that a normal is defined even if all
/// surfaces are uncertain (docs/method.md, equation 10.20).
pub(crate) const LEAST_CERTAINTY: f32 = 1e-6;
/// Length of the mean normal of the surfaces around a point below which the point moves less, because the surfaces
/// disagree, are uncertain or are seen edge-on (A in docs/method.md, equation 10.20).
pub(crate) const AGREEING: f32 = 0.5;
/// Sum of the weights of the block means around a pixel below which their mean is drawn towards the pixel's own point
/// (docs/method.md, equation 10.19).
pub(crate) const LEAST_MEANS: f32 = 0.1;
/// Length of the mean normal of the surfaces around a point below which rounding decides its direction
/// (docs/method.md, equation 10.20).
pub(crate) const LEAST_NORMAL: f32 = 1e-15;
/// Weight of a zero displacement in the mean over the surfaces that are like a point's own (docs/method.md, equation
/// 10.21).
pub(crate) const MEAN_STAY: f32 = 0.05;
/// Cosine between a surface's normal and a point's ray below which the surface counts in proportion to the cosine,
/// because rounding decides which side faces the sensor (y in docs/method.md, equation 10.20).
pub(crate) const SIDE_COSINE: f32 = 0.1;
/// Minimum absolute value of the factor y for surfaces seen edge-on (docs/method.md, equation 10.20).
pub(crate) const LEAST_SIDE: f32 = 1e-6;
/// Length of a point's ray in metres below which surfaces count fully at any angle, because the ray's direction is
/// only rounding (docs/method.md, equation 10.20).
pub(crate) const LEAST_RAY_M: f32 = 1e-4;
/// Maximum exponent, as a power of two, of the weight by distance from the surface (docs/method.md, equation 10.10):
/// a neighbour far from the surface keeps exp(-8) of its weight.
pub(crate) const MAX_OFF_SURFACE: f32 = 8.0 * std::f32::consts::LOG2_E;

/// Minimum variance along a plane, as a share of the squared radius, by which the bend of its window is divided
/// (docs/method.md, equation 10.13).
pub(crate) const LEAST_SPREAD: f32 = 0.01;
/// Maximum bend of a window, in units of 1/radius (docs/method.md, equation 10.13).
pub(crate) const MOST_WINDOW_BEND: f32 = 4.0;
/// Damping of the bend between planes, as a share of the squared radius (docs/method.md, equation 10.11).
pub(crate) const BEND_DAMPING: f32 = 0.009;
/// Sum of the planes' weights up to which the bend is not estimated (docs/method.md, equation 10.14).
pub(crate) const LEAST_BEND_WEIGHT: f32 = 1e-12;
/// Spread of the normals up to which a surface counts as flat, in units of noise/radius (docs/method.md, equation
/// 10.14). At twice this spread, the bend counts fully.
pub(crate) const LEAST_TURN: f32 = 1.0;
/// Share of the normals' variance that the bend explains (docs/method.md, equation 10.14). Up to the first value, the
/// bend does not count; from the second value on, it counts fully.
pub(crate) const BEND_EXPLAINED: [f32; 2] = [0.65, 0.85];
/// Share of the bend between planes that is also measured within their windows (docs/method.md, equation 10.14). Up
/// to the first value, the bend does not count; from the second value on, it counts fully.
pub(crate) const BEND_SHARED: [f32; 2] = [0.2, 0.4];
/// Maximum bend of a surface, in units of 1/radius (docs/method.md, equation 10.14).
pub(crate) const MOST_BEND: f32 = 1.2;

// Keeping edges in unorganized clouds (docs/method.md, section 10).

/// Reach, as a share of the radius, of the mean position around a point. The distance of planes is measured from this
/// mean instead of from the point (docs/method.md, equation 10.24).
pub(crate) const GENERAL_MEAN_REACH: f32 = 0.4;
/// Weight of the squared distance between a plane and the mean position around a point, relative to the squared
/// residual of the plane, in unorganized clouds (docs/method.md, equation 10.24).
pub(crate) const GENERAL_DISTANCE_WEIGHT: f32 = 0.2;
/// Cosine between the normal of a plane and a point's own normal below which the plane counts less and less, because
/// it is unclear which side the plane faces (docs/method.md, equation 10.25).
pub(crate) const FACING_COSINE: f32 = 0.1;

/// The exponents (i, j) of the monomials a^i b^j, ordered by degree (docs/method.md, section 5).
pub(crate) const MONOMIALS: [(usize, usize); 10] =
    [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)];

/// Weights of the monomials in the ridge, which make it independent of the choice of in-plane axes (docs/method.md,
/// section 6).
pub(crate) const RIDGE_WEIGHTS: [f32; 10] = [0.0, 1.0, 1.0, 1.0, 0.5, 1.0, 1.0, 1.0 / 3.0, 1.0 / 3.0, 1.0];

/// Returns the number of coefficients of a polynomial of this degree in two variables: 3, 6 or 10.
pub(crate) const fn coefficient_count(degree: usize) -> usize {
    (degree + 1) * (degree + 2) / 2
}

/// Median of the square of a standard normal variable.
pub(crate) const MEDIAN_SQUARE: f64 = 0.4549;
