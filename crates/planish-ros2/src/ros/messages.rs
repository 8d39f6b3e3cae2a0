//! ROS messages of the packages `std_msgs` and `sensor_msgs`. Their fields must stay in the order of the ROS
//! definitions, since CDR serializes them in this order.

use std::fmt;
use std::marker::PhantomData;

use serde::de::{Error, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};

/// Reads a list of at most 1000 elements. The limit exists because an element takes more bytes in memory than in a
/// message.
pub(crate) fn few<'de, D: Deserializer<'de>, T: Deserialize<'de>>(deserializer: D) -> Result<Vec<T>, D::Error> {
    const MOST: usize = 1000;
    struct Few<T>(PhantomData<T>);
    impl<'de, T: Deserialize<'de>> Visitor<'de> for Few<T> {
        type Value = Vec<T>;

        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            write!(f, "a list of at most {MOST} elements")
        }

        fn visit_seq<A: SeqAccess<'de>>(self, mut elements: A) -> Result<Vec<T>, A::Error> {
            let mut few = Vec::new();
            while let Some(element) = elements.next_element()? {
                if few.len() == MOST {
                    return Err(A::Error::custom(format!("a list has more than {MOST} elements")));
                }
                few.push(element);
            }
            Ok(few)
        }
    }
    deserializer.deserialize_seq(Few(PhantomData))
}

/// `builtin_interfaces/Time`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Time {
    /// Seconds.
    pub sec: i32,
    /// Nanoseconds, less than 1e9.
    pub nanosec: u32,
}

impl Time {
    /// Returns the time in seconds, with a resolution of about 0.2 µs for a recent date.
    pub fn seconds(self) -> f64 {
        f64::from(self.sec) + 1e-9 * f64::from(self.nanosec)
    }

    /// Creates a time from seconds since the epoch, rounded to microseconds, which is about the resolution of `f64`
    /// for a recent date. Returns `None` for times before the epoch, or after the last representable one, early in
    /// 2038.
    pub fn from_seconds(seconds: f64) -> Option<Self> {
        let is_held = (0.0..f64::from(i32::MAX) + 0.999_999).contains(&seconds);
        is_held.then(|| Self::from_nanoseconds(1000 * (1e6 * seconds).round() as u64))
    }

    /// Creates a time from nanoseconds since the epoch, clamped to the latest representable time.
    pub fn from_nanoseconds(nanoseconds: u64) -> Self {
        match i32::try_from(nanoseconds / 1_000_000_000) {
            Ok(sec) => Self { sec, nanosec: (nanoseconds % 1_000_000_000) as u32 },
            Err(_) => Self { sec: i32::MAX, nanosec: 999_999_999 },
        }
    }

    /// Returns the nanoseconds since the epoch; 0 for negative times.
    pub fn nanoseconds(self) -> u64 {
        u64::try_from(self.sec).map_or(0, |sec| 1_000_000_000 * sec + u64::from(self.nanosec))
    }
}

/// `std_msgs/Header`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Header {
    /// Time at which the data were acquired.
    pub stamp: Time,
    /// Coordinate frame of the data.
    pub frame_id: String,
}

/// `sensor_msgs/Image`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Image {
    /// Stamp and optical frame.
    pub header: Header,
    /// Number of rows.
    pub height: u32,
    /// Number of columns.
    pub width: u32,
    /// Encoding of the pixels: 16UC1 (millimetres) or 32FC1 (metres) for depth.
    pub encoding: String,
    /// Whether samples are big-endian.
    pub is_bigendian: u8,
    /// Bytes from one row to the next.
    pub step: u32,
    /// The pixels, `step * height` bytes.
    #[serde(with = "serde_bytes")]
    pub data: Vec<u8>,
}

/// `sensor_msgs/CompressedImage`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct CompressedImage {
    /// Stamp and optical frame.
    pub header: Header,
    /// Format of the data: `16UC1; compressedDepth png` or `32FC1; compressedDepth png` for depth.
    pub format: String,
    /// The compressed image; for depth, 12 bytes of parameters precede it.
    #[serde(with = "serde_bytes")]
    pub data: Vec<u8>,
}

/// `sensor_msgs/RegionOfInterest`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct RegionOfInterest {
    /// First column.
    pub x_offset: u32,
    /// First row.
    pub y_offset: u32,
    /// Number of rows; 0 for all.
    pub height: u32,
    /// Number of columns; 0 for all.
    pub width: u32,
    /// Whether the region refers to the rectified image.
    pub do_rectify: bool,
}

/// `sensor_msgs/CameraInfo`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct CameraInfo {
    /// Stamp and optical frame of the corresponding image.
    pub header: Header,
    /// Number of rows of the calibrated images.
    pub height: u32,
    /// Number of columns of the calibrated images.
    pub width: u32,
    /// Distortion model: `plumb_bob`, `rational_polynomial`, `equidistant`, or empty.
    pub distortion_model: String,
    /// Distortion coefficients.
    pub d: Vec<f64>,
    /// Intrinsics of the raw image, row by row: fx, 0, cx, 0, fy, cy, 0, 0, 1.
    pub k: [f64; 9],
    /// Rotation that rectifies the image, row by row.
    pub r: [f64; 9],
    /// Projection of the rectified image, row by row: fx, 0, cx, Tx, 0, fy, cy, Ty, 0, 0, 1, 0.
    pub p: [f64; 12],
    /// Number of columns combined into one; 0 and 1 mean none.
    pub binning_x: u32,
    /// Number of rows combined into one; 0 and 1 mean none.
    pub binning_y: u32,
    /// The region of the full image that was sent.
    pub roi: RegionOfInterest,
}

/// `sensor_msgs/PointField`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct PointField {
    /// Name, such as `x` or `rgb`.
    pub name: String,
    /// Offset in bytes from the beginning of a point.
    pub offset: u32,
    /// Type number, 1 to 8: i8, u8, i16, u16, i32, u32, f32, f64.
    pub datatype: u8,
    /// Number of values per point.
    pub count: u32,
}

/// `sensor_msgs/PointCloud2`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct PointCloud2 {
    /// Stamp and frame of the points.
    pub header: Header,
    /// Number of rows; 1 for a cloud without a grid.
    pub height: u32,
    /// Number of columns, or of points in a cloud without a grid.
    pub width: u32,
    /// Fields of each point.
    #[serde(deserialize_with = "few")]
    pub fields: Vec<PointField>,
    /// Whether values are big-endian.
    pub is_bigendian: bool,
    /// Bytes from one point to the next.
    pub point_step: u32,
    /// Bytes from one row to the next.
    pub row_step: u32,
    /// The points, `row_step * height` bytes.
    #[serde(with = "serde_bytes")]
    pub data: Vec<u8>,
    /// Whether all points are finite.
    pub is_dense: bool,
}
