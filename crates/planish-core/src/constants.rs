//! Constants of the method for the f32 engines, shared by CPU and GPU; the reference defines them separately
//! (docs/method.md).

/// Minimum number of neighbours for a plane (section 2).
pub(crate) const LEAST_NEIGHBOURS: f32 = 3.0;

/// Ratio l1/l2 of a neighbourhood's second to its first variance up to which it is a line (section 4).
pub(crate) const DEGENERATE_RATIO: f32 = 1e-4;
/// sqrt(log2 e). Lengths are measured in units of B/sqrt(log2 e), in which the weight is a power of two: exp(-x²) =
/// 2^(-x² log2 e).
pub(crate) const SQRT_LOG2_E: f32 = 1.201_122_4;

/// Steepness of the gate's fade (section 2): a neighbour at distance d counts 0.5 + 16 (1 - d²/r²), clamped to 0 to 1.
pub(crate) const GATE_FADE: f32 = 16.0;

/// Cosine of the angle of incidence below which a point moves less and less along its ray (section 7).
pub const GRAZING_COSINE: f32 = 0.2;
/// Maximum displacement of a point along its ray, as a share of its distance from the sensor (section 7).
pub(crate) const MAX_ALONG: f32 = 0.5;

/// Maximum ratio of a point's radius to the mean radius around it, in unorganized clouds (section 8).
pub(crate) const MAX_RADIUS_RATIO: f32 = 1.5;

// Section 10.

/// Maximum doubt of a plane, l2/(l1 - l0). Larger doubt has no further effect; the square of this limit fits f32.
pub(crate) const MAX_DOUBT: f32 = 1e6;
/// Sum of the gate weights of a plane's points up to which the plane does not count (10.2). At 1 more it counts fully.
pub(crate) const MIN_TOTAL: f32 = 5.0;
/// Minimum noise, as a share of the radius.
pub(crate) const MIN_NOISE: f32 = 0.01;
/// Weight of a plane's squared distance from p, relative to its squared residual.
pub(crate) const DISTANCE_WEIGHT: f32 = 0.3;
/// Distance up to which the planes of other points are considered, in radii. On oblique surfaces, windows reach as far.
pub(crate) const PLANE_REACH: f32 = 2.0;
/// Width of the neighbours' weight by distance from the surface, in standard deviations of the noise (10.10).
pub(crate) const NARROW_WIDTH: f32 = 1.0;
/// Distance from the surface beyond which points of a block have only the minimum weight (10.9), as a multiple of
/// [`NARROW_WIDTH`].
pub(crate) const BLOCK_WIDTH: f32 = 1.5;
/// Square root of the minimum weight of a block's points (10.9).
pub(crate) const MIN_BLOCK_WEIGHT: f32 = 0.02;
/// Variance added to a plane per unit of its doubt, l2/(l1 - l0), as a share of the noise variance (10.6), or of the
/// plane's own variance in unorganized clouds (10.22). A disc has a doubt of 1.
pub(crate) const DOUBT_WEIGHT: f32 = 0.01;
/// Cosine of the angle of incidence up to which a plane does not count (10.2). No camera sees such a steep surface; it
/// is a row of points far apart.
pub(crate) const MIN_INCIDENCE_COSINE: f32 = 0.05;
/// Excess of the cosine over [`MIN_INCIDENCE_COSINE`] from which a plane counts fully.
pub(crate) const COSINE_FADE: f32 = 0.01;
/// Weight of a zero displacement, relative to the surrounding planes.
pub(crate) const STAY_WEIGHT: f32 = 1e-3;
/// Additional weight of the normal of the pixel's window.
pub(crate) const OWN_NORMAL_WEIGHT: f32 = 1e-12;
/// Sum of the fits of the planes around a point, F in (10.17): up to the first value no plane fits, from the second on
/// planes suffice. A plane without residual adds 1.
pub(crate) const FITTING: [f32; 2] = [0.6, 1.6];
/// Gate weight from which a plane around a point counts fully in the turning of the normals (10.17).
pub(crate) const NEAR_ENOUGH: f32 = 0.05;
/// Increase of the turning of the normals, T in (10.17), for each missing plane of the nine around a point.
pub(crate) const MISSING_PLANE: f32 = 0.1 / 9.0;
/// Turning of the normals of the planes around a point, T in (10.17), as 1 - cos of an angle: up to the first value
/// planes suffice, however badly they fit; from the second on only their fit decides.
pub(crate) const TURNING: [f32; 2] = [0.02, 0.07];
/// Maximum ridge if no plane fits.
pub(crate) const LOW_RIDGE: f32 = 3e-4;
/// Maximum ridge if no plane fits and there are six neighbours, which the six coefficients of a polynomial of degree 2
/// would fit exactly.
pub(crate) const FEWEST_RIDGE: f32 = 3e-3;
/// Variance of all neighbours about their polynomial, relative to the noise variance (10.18): up to the first value the
/// polynomial counts fully, from the second on not at all.
pub(crate) const CLOSE: [f32; 2] = [0.3, 0.8];
/// Sum of the weights of the surfaces around a point up to which the point is on none of them (10.20).
pub(crate) const LEAST_SURFACE_WEIGHT: f32 = 1e-12;
/// Maximum distance of a point, moved onto its own surface, from another surface that counts, in standard deviations of
/// the noise (10.21).
pub(crate) const MEAN_WIDTH: f32 = 1.5;
/// Cosine between the normals of a point's own and another surface (10.21): up to the first value the other surface
/// does not count, from the second on it counts fully.
pub(crate) const ALIKE: [f32; 2] = [0.9, 0.95];
/// Share of the surfaces around a point that count, W/4 in (10.21): up to the first value only their tangent planes
/// matter, from the second on their bend counts fully.
pub(crate) const AROUND: [f32; 2] = [0.6, 0.9];
/// Value added to the certainty of surfaces whose normals are averaged, so that a normal is defined even if all are
/// uncertain.
pub(crate) const LEAST_CERTAINTY: f32 = 1e-6;
/// Length of the mean normal of the surfaces around a point below which the point moves less, A in (10.20): the
/// surfaces disagree, are uncertain or are seen edge-on.
pub(crate) const AGREEING: f32 = 0.5;
/// Sum of the weights of the block means around a pixel below which their mean is drawn towards the pixel's point
/// (10.19).
pub(crate) const LEAST_MEANS: f32 = 0.1;
/// Length of the mean normal of the surfaces around a point below which rounding decides its direction (10.20).
pub(crate) const LEAST_NORMAL: f32 = 1e-15;
/// Weight of a zero displacement, relative to the surfaces around a point that are like its own.
pub(crate) const MEAN_STAY: f32 = 0.05;
/// Cosine between a surface's normal and a point's ray below which the surface counts in proportion to the cosine, y in
/// (10.20), because rounding decides which side faces the sensor.
pub(crate) const SIDE_COSINE: f32 = 0.1;
/// Minimum absolute value of the factor y in (10.20), for surfaces seen edge-on.
pub(crate) const LEAST_SIDE: f32 = 1e-6;
/// Length of a point's ray in metres below which surfaces count fully at any angle (10.20), because the ray's direction
/// is only rounding.
pub(crate) const LEAST_RAY_M: f32 = 1e-4;
/// Maximum exponent of the weight by distance from the surface (10.10), as a power of two: a neighbour far from the
/// surface keeps exp(-8) of its weight.
pub(crate) const MAX_OFF_SURFACE: f32 = 8.0 * std::f32::consts::LOG2_E;

/// Minimum variance along a plane in measuring its window's bend, as a share of the squared radius (10.13).
pub(crate) const LEAST_SPREAD: f32 = 0.01;
/// Maximum bend of a window, in units of 1/radius (10.13).
pub(crate) const MOST_WINDOW_BEND: f32 = 4.0;
/// Damping of the bend between planes, as a share of the squared radius (10.11).
pub(crate) const BEND_DAMPING: f32 = 0.009;
/// Sum of the planes' weights up to which the bend is not estimated (10.14).
pub(crate) const LEAST_BEND_WEIGHT: f32 = 1e-12;
/// Spread of the normals up to which a surface is flat, in units of noise/radius (10.14). At twice this spread, the
/// bend counts fully.
pub(crate) const LEAST_TURN: f32 = 1.0;
/// Share of the normals' variance that the bend explains (10.14): up to the first value the bend does not count, from
/// the second on it counts fully.
pub(crate) const BEND_EXPLAINED: [f32; 2] = [0.65, 0.85];
/// Share of the bend between planes that is also within their windows (10.14): up to the first value the bend does not
/// count, from the second on it counts fully.
pub(crate) const BEND_SHARED: [f32; 2] = [0.2, 0.4];
/// Maximum bend of a surface, in units of 1/radius (10.14).
pub(crate) const MOST_BEND: f32 = 1.2;

// Section 10 in unorganized clouds.

/// Reach of the mean of positions that replaces p in measuring its distance from planes, as a share of the radius
/// (10.24).
pub(crate) const GENERAL_MEAN_REACH: f32 = 0.4;
/// Weight of a plane's squared distance from the mean of positions around p, relative to its squared residual (10.24).
pub(crate) const GENERAL_DISTANCE_WEIGHT: f32 = 0.2;
/// Cosine between a plane's normal and p's own below which the plane counts less and less, because it is unclear which
/// side the plane faces (10.25).
pub(crate) const FACING_COSINE: f32 = 0.1;

/// The exponents (i, j) of the monomials a^i b^j, ordered by degree (section 5).
pub(crate) const MONOMIALS: [(usize, usize); 10] =
    [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)];

/// Weights of the monomials in the ridge, which do not depend on the choice of in-plane axes (section 6).
pub(crate) const RIDGE_WEIGHTS: [f32; 10] = [0.0, 1.0, 1.0, 1.0, 0.5, 1.0, 1.0, 1.0 / 3.0, 1.0 / 3.0, 1.0];

/// Number of coefficients of a polynomial of a degree in two variables: 3, 6, 10.
pub(crate) const fn coefficient_count(degree: usize) -> usize {
    (degree + 1) * (degree + 2) / 2
}

/// Median of the square of a standard normal variable.
pub(crate) const MEDIAN_SQUARE: f64 = 0.4549;
