//! ROS 2 messages of depth, clouds and cameras, and their conversion, shared by MCAP recordings and the node.
//!
//! [`from_cdr`] and [`to_cdr`] read and write these messages as ROS 2 does, byte for byte. [`MessageSmoother`]
//! smooths the data of one message after another and returns messages of the same type.

mod camera;
mod cdr;
mod cloud;
mod cloud_fields;
mod depth;
mod messages;
mod normals;
mod pose_buffer;
mod rvl;
mod smoother;
mod transforms;

pub use camera::{camera_info_topic, is_rectified};
pub use cdr::{from_cdr, to_cdr};
pub use depth::{DepthMessage, DepthPixels};
#[cfg(feature = "mcap")]
pub(crate) use messages::few;
pub use messages::{CameraInfo, CompressedImage, Header, Image, PointCloud2, PointField, RegionOfInterest, Time};
pub use pose_buffer::{PoseBuffer, PoseKind};
pub use smoother::{MessageError, MessageSmoother};
pub use transforms::{Odometry, PoseStamped, TfMessage, TransformError, TransformStamped, Transforms};
