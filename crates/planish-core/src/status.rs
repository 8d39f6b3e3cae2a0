//! The status of a pixel.

use crate::threads::ONE_THREAD;

/// The status of a pixel (docs/method.md, section 7).
#[repr(u8)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[non_exhaustive]
pub enum Status {
    /// Nothing was measured: the input and the output are holes.
    #[default]
    Hole = 0,
    /// The point has fewer than 3 neighbours, is on none of the surfaces around it, or was isolated and removed on
    /// request: the output is a hole.
    TooFew = 1,
    /// The neighbours are collinear: the point is unchanged, without a normal.
    Degenerate = 2,
    /// The point was moved to a plane.
    Plane = 3,
    /// The point was moved to a polynomial of degree 2.
    Polynomial2 = 4,
    /// The point was moved to a polynomial of degree 3.
    Polynomial3 = 5,
    /// In an unorganized cloud, the point has fewer than 3 neighbours, or fewer than about a quarter of the number
    /// that its radius was chosen for (docs/method.md, section 8): it is unchanged, without a normal.
    Isolated = 6,
    /// With smoothing over time, the value of this pixel jumped, but not those around it. For one frame, the pixel
    /// keeps the value of the previous frame (docs/method.md, section 16). The normal is this frame's.
    Carried = 7,
    /// A pixel without a measurement that was filled with the surface around it (docs/method.md, section 18).
    Filled = 8,
}

impl Status {
    /// Every status, in the order of their codes.
    pub const ALL: [Self; 9] = [
        Self::Hole,
        Self::TooFew,
        Self::Degenerate,
        Self::Plane,
        Self::Polynomial2,
        Self::Polynomial3,
        Self::Isolated,
        Self::Carried,
        Self::Filled,
    ];

    /// Returns true if the output has a finite point.
    pub fn has_point(self) -> bool {
        self >= Self::Degenerate
    }

    /// Returns true if the output has a normal and a curvature.
    pub fn has_normal(self) -> bool {
        matches!(self, Self::Plane | Self::Polynomial2 | Self::Polynomial3 | Self::Carried | Self::Filled)
    }

    /// Returns the origin of the pixel's value.
    pub fn origin(self) -> Origin {
        match self {
            Self::Hole | Self::TooFew => Origin::None,
            Self::Carried => Origin::Carried,
            Self::Filled => Origin::Filled,
            _ => Origin::Measured,
        }
    }

    /// Returns the status for a code that an engine wrote.
    #[inline(always)]
    pub(crate) fn of_code(code: u8) -> Self {
        /// Every status, then holes: every 4-bit index has a status, so the code needs no check.
        const BY_CODE: [Status; 16] = {
            let mut statuses = [Status::Hole; 16];
            let mut code = 0;
            while code < Status::ALL.len() {
                statuses[code] = Status::ALL[code];
                code += 1;
            }
            statuses
        };
        // WebAssembly builds fill no holes.
        if ONE_THREAD { Self::ALL[usize::from(code & 7)] } else { BY_CODE[usize::from(code & 15)] }
    }

    /// Returns the status of a point that was moved to a polynomial of this degree.
    pub fn of_degree(degree: u32) -> Self {
        match degree {
            3 => Self::Polynomial3,
            2 => Self::Polynomial2,
            _ => Self::Plane,
        }
    }
}

/// The origin of a pixel's value.
#[repr(u8)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Origin {
    /// No value.
    None = 0,
    /// Filled with the surface around the hole.
    Filled = 1,
    /// Kept from the previous frame of a video.
    Carried = 2,
    /// Measured in this frame.
    Measured = 3,
}

impl Origin {
    /// Every origin, in the order of their codes.
    pub const ALL: [Self; 4] = [Self::None, Self::Filled, Self::Carried, Self::Measured];

    /// Returns the value for this origin in an 8-bit mask: 0 for holes, 85 filled, 170 carried, 255 measured.
    pub fn mask_value(self) -> u8 {
        85 * self as u8
    }
}

impl PartialOrd for Status {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Status {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (*self as u8).cmp(&(*other as u8))
    }
}
