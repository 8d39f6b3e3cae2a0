//! Message definitions as stored in a recording: the definition of the message, then those of its parts.

/// Encoding of the message definitions.
pub(super) const SCHEMA_ENCODING: &str = "ros2msg";
/// Encoding of the messages.
pub(super) const MESSAGE_ENCODING: &str = "cdr";
/// MCAP profile of ROS 2 recordings.
pub(super) const PROFILE: &str = "ros2";

pub(super) const IMAGE_TYPE: &str = "sensor_msgs/msg/Image";
pub(super) const COMPRESSED_TYPE: &str = "sensor_msgs/msg/CompressedImage";
pub(super) const CAMERA_INFO_TYPE: &str = "sensor_msgs/msg/CameraInfo";
pub(super) const CLOUD_TYPE: &str = "sensor_msgs/msg/PointCloud2";

macro_rules! with_header {
    ($own:literal) => {
        concat!(
            $own,
            "================================================================================\n",
            "MSG: std_msgs/Header\n",
            "builtin_interfaces/Time stamp\n",
            "string frame_id\n",
            "================================================================================\n",
            "MSG: builtin_interfaces/Time\n",
            "int32 sec\n",
            "uint32 nanosec\n",
        )
    };
}

pub(super) const IMAGE: &str = with_header!(
    "std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
"
);

pub(super) const CAMERA_INFO: &str = with_header!(
    "std_msgs/Header header
uint32 height
uint32 width
string distortion_model
float64[] d
float64[9] k
float64[9] r
float64[12] p
uint32 binning_x
uint32 binning_y
RegionOfInterest roi
================================================================================
MSG: sensor_msgs/RegionOfInterest
uint32 x_offset
uint32 y_offset
uint32 height
uint32 width
bool do_rectify
"
);

pub(super) const CLOUD: &str = with_header!(
    "std_msgs/Header header
uint32 height
uint32 width
PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
================================================================================
MSG: sensor_msgs/PointField
uint8 INT8=1
uint8 UINT8=2
uint8 INT16=3
uint8 UINT16=4
uint8 INT32=5
uint8 UINT32=6
uint8 FLOAT32=7
uint8 FLOAT64=8
string name
uint32 offset
uint8 datatype
uint32 count
"
);
