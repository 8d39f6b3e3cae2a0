//! Constants of the method for the f32 engines, shared by CPU and GPU; the reference defines them separately
//! (docs/method.md).

/// The smallest number of neighbours for a plane (section 7).
pub(crate) const LEAST_NEIGHBOURS: f32 = 3.0;

/// A neighbourhood whose second extent is below this share of its first (as variances) is a line (section 4).
pub(crate) const DEGENERATE_RATIO: f32 = 1e-4;
/// Lengths are measured in units of B/sqrt(log2 e), in which the weight is a power of two: exp(-x²) = 2^(-x² log2 e).
pub(crate) const SQRT_LOG2_E: f32 = 1.201_122_4;

/// The gate fades out (section 2): a neighbour at a distance d counts 0.5 + 16 (1 - d²/r²), from 0 to 1.
pub(crate) const GATE_FADE: f32 = 16.0;

/// Below this cosine of the angle of incidence a point moves less and less along its ray (section 7).
pub const GRAZING_COSINE: f32 = 0.2;
/// No point moves along its ray by more than this share of its distance (section 7).
pub(crate) const MAX_ALONG: f32 = 0.5;

/// Maximum ratio of a point's radius to the mean radius around it, in unorganized clouds (section 8).
pub(crate) const MAX_RADIUS_RATIO: f32 = 1.5;

// Section 10.

/// Larger doubt has no effect; the square of this limit fits f32 easily.
pub(crate) const MAX_DOUBT: f32 = 1e6;
/// A plane whose points count less than this together says too little; it counts wholly from one more on.
pub(crate) const MIN_TOTAL: f32 = 5.0;
/// The noise is at least this share of the radius.
pub(crate) const MIN_NOISE: f32 = 0.01;
/// Weight of a plane's squared distance from p, relative to its squared residual.
pub(crate) const DISTANCE_WEIGHT: f32 = 0.3;
/// Planes of points up to this many radii away are considered: on oblique surfaces a window reaches as far.
pub(crate) const PLANE_REACH: f32 = 2.0;
/// Distance from the surface within which neighbours count, in standard deviations of the noise.
pub(crate) const NARROW_WIDTH: f32 = 1.0;
/// Points of a block count up to this many times that width from the surface...
pub(crate) const BLOCK_WIDTH: f32 = 1.5;
/// ...with the root of at least this weight.
pub(crate) const MIN_BLOCK_WEIGHT: f32 = 0.02;
/// A plane whose points hardly determine it counts as one with more noise: by this share of the noise's variance for a
/// disc.
pub(crate) const DOUBT_WEIGHT: f32 = 0.01;
/// No camera sees a surface as steep as this; what looks like one is a row of points far apart.
pub(crate) const MIN_INCIDENCE_COSINE: f32 = 0.05;
/// Beyond this excess, the plane counts fully.
pub(crate) const COSINE_FADE: f32 = 0.01;
/// Weight of a zero displacement, relative to the surrounding planes.
pub(crate) const STAY_WEIGHT: f32 = 1e-3;
/// Additional weight of the normal of the pixel's window.
pub(crate) const OWN_NORMAL_WEIGHT: f32 = 1e-12;
/// If the planes around a point together fit no better than the first value, no plane fits; from the second on, planes
/// suffice. A plane without any residual fits by 1.
pub(crate) const FITTING: [f32; 2] = [0.6, 1.6];
/// Planes around a point count fully in how their normals turn from this nearness on.
pub(crate) const NEAR_ENOUGH: f32 = 0.05;
/// Every plane that is missing of the nine around a point counts like normals that turn by this much.
pub(crate) const MISSING_PLANE: f32 = 0.1 / 9.0;
/// If the normals of the planes around a point turn by less than the first value, planes suffice, however badly they
/// fit. From the second value on, that decides. 1 - cos of an angle.
pub(crate) const TURNING: [f32; 2] = [0.02, 0.07];
/// The ridge is at most this if no plane fits.
pub(crate) const LOW_RIDGE: f32 = 3e-4;
/// The limit with six neighbours: a polynomial of degree 2 has six coefficients, and would fit them exactly.
pub(crate) const FEWEST_RIDGE: f32 = 3e-3;
/// The polynomial of all neighbours counts fully if their variance about it is up to the first value times the noise's,
/// and not at all from the second on.
pub(crate) const CLOSE: [f32; 2] = [0.3, 0.8];
/// If the weights of the surfaces around a point sum to no more, it is on none of them.
pub(crate) const LEAST_SURFACE_WEIGHT: f32 = 1e-12;
/// Surfaces around a point count up to this many standard deviations of the noise from the point on its own surface...
pub(crate) const MEAN_WIDTH: f32 = 1.5;
/// ...and from the first cosine between their normals on, fully from the second on.
pub(crate) const ALIKE: [f32; 2] = [0.9, 0.95];
/// If less than the first share of the surfaces around a point count, only their tangent planes matter. From the second
/// share on, so does how they bend.
pub(crate) const AROUND: [f32; 2] = [0.6, 0.9];
/// Added to the certainty of surfaces where their normals are averaged, so that a normal is defined even if all are
/// uncertain.
pub(crate) const LEAST_CERTAINTY: f32 = 1e-6;
/// Points move less where the mean of the normals of the surfaces around them is shorter: where they disagree, are
/// uncertain or seen edge-on.
pub(crate) const AGREEING: f32 = 0.5;
/// If the weights of the block means around a pixel sum to less, their mean is drawn towards its point.
pub(crate) const LEAST_MEANS: f32 = 0.1;
/// If the mean of the normals of the surfaces around a point is shorter, rounding decides its direction.
pub(crate) const LEAST_NORMAL: f32 = 1e-15;
/// Weight of a zero displacement, relative to the surfaces around a point that are like its own.
pub(crate) const MEAN_STAY: f32 = 0.05;
/// If the cosine between a surface's normal and a point's ray is smaller, the surface counts in proportion to it, since
/// rounding decides which side faces the sensor...
pub(crate) const SIDE_COSINE: f32 = 0.1;
/// ...but at least this much...
pub(crate) const LEAST_SIDE: f32 = 1e-6;
/// ...and fully if the ray is shorter than this, because its direction is then only rounding.
pub(crate) const LEAST_RAY_M: f32 = 1e-4;
/// Upper bound of the exponent: a neighbour far from the surface keeps exp(-8) of its weight. Stored as a power of two.
pub(crate) const MAX_OFF_SURFACE: f32 = 8.0 * std::f32::consts::LOG2_E;

/// The variance along a plane is taken to be at least this share of the squared radius when its window's bend is
/// measured.
pub(crate) const LEAST_SPREAD: f32 = 0.01;
/// A window bends by at most this much over the radius.
pub(crate) const MOST_WINDOW_BEND: f32 = 4.0;
/// Damps the bend between planes, as a share of the squared radius.
pub(crate) const BEND_DAMPING: f32 = 0.009;
/// The bend is not estimated if the planes' weights sum to less.
pub(crate) const LEAST_BEND_WEIGHT: f32 = 1e-12;
/// If normals spread by less than this many times the noise over the radius, the surface is flat. Twice as much counts
/// fully.
pub(crate) const LEAST_TURN: f32 = 1.0;
/// The share of the normals' variance that a bend explains: none counts below the first, all from the second.
pub(crate) const BEND_EXPLAINED: [f32; 2] = [0.65, 0.85];
/// The share of the bend between planes that is also within their windows: none below the first, all from the second.
pub(crate) const BEND_SHARED: [f32; 2] = [0.2, 0.4];
/// A surface bends by at most this much over the radius.
pub(crate) const MOST_BEND: f32 = 1.2;

// Section 10 in unorganized clouds.

/// The mean of positions within this share of the radius replaces p when its distance from a plane is measured.
pub(crate) const GENERAL_MEAN_REACH: f32 = 0.4;
/// Weight of that squared distance, relative to the plane's squared residual.
pub(crate) const GENERAL_DISTANCE_WEIGHT: f32 = 0.2;
/// Planes whose normals make a smaller cosine with p's own count less and less, since it is unclear which side they
/// face.
pub(crate) const FACING_COSINE: f32 = 0.1;

/// The exponents (i, j) of the monomials a^i b^j, ordered by degree (section 5).
pub(crate) const MONOMIALS: [(usize, usize); 10] =
    [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)];

/// The weights of the monomials in the ridge, the same in every frame (section 6).
pub(crate) const RIDGE_WEIGHTS: [f32; 10] = [0.0, 1.0, 1.0, 1.0, 0.5, 1.0, 1.0, 1.0 / 3.0, 1.0 / 3.0, 1.0];

/// Number of coefficients of a polynomial of a degree in two variables: 3, 6, 10.
pub(crate) const fn coefficient_count(degree: usize) -> usize {
    (degree + 1) * (degree + 2) / 2
}

/// The median square of a normal deviate.
pub(crate) const MEDIAN_SQUARE: f64 = 0.4549;
