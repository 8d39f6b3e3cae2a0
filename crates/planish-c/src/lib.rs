//! planish's C ABI. `include/planish/planish.h` is generated from these items, and states the rules for callers.
//!
//! Handles are numbers cast to pointers. They are looked up and never dereferenced, so a call with a freed handle, or
//! with one in use by another thread, returns an error.

#![allow(non_camel_case_types)]
#![deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout, clippy::print_stderr)]

mod buffers;
mod cuda;
mod error;
mod frame;
mod handles;
mod output;
mod result;
mod session;
mod smooth;

pub use cuda::{
    planish_cuda, planish_cuda_channels, planish_cuda_free, planish_cuda_new, planish_cuda_receive,
    planish_cuda_smooth, planish_cuda_submit,
};
pub use error::{
    PLANISH_ARGUMENT, PLANISH_BUSY, PLANISH_ENGINE, PLANISH_HANDLE, PLANISH_INTERNAL, PLANISH_NULL, PLANISH_OK,
    PLANISH_SETTING, PLANISH_STOPPED, planish_code, planish_last_error, planish_version,
};
pub use frame::{
    PLANISH_DEPTH_F32, PLANISH_DEPTH_U16, PLANISH_PLANES_F32, PLANISH_PLANES_F64, PLANISH_POINTS_F32,
    PLANISH_POINTS_F64, planish_camera, planish_frame,
};
pub use output::{
    PLANISH_CURVATURE, PLANISH_DEPTH, PLANISH_DEPTH_M, PLANISH_FRAMES, PLANISH_NEIGHBOURS, PLANISH_NORMALS,
    PLANISH_POINTS, PLANISH_SIGMA, PLANISH_STATUS, PLANISH_STATUS_CARRIED, PLANISH_STATUS_DEGENERATE,
    PLANISH_STATUS_FILLED, PLANISH_STATUS_HOLE, PLANISH_STATUS_ISOLATED, PLANISH_STATUS_PLANE,
    PLANISH_STATUS_POLYNOMIAL2, PLANISH_STATUS_POLYNOMIAL3, PLANISH_STATUS_TOO_FEW, planish_output,
};
pub use result::{planish_result, planish_result_free, planish_result_get, planish_view};
pub use session::{
    planish_next_event, planish_session, planish_session_engine, planish_session_free, planish_session_new,
    planish_session_restart_video, planish_session_set, planish_session_set_bool, planish_session_set_camera_pose,
    planish_session_set_number, planish_session_settings, planish_session_stop,
};
pub use smooth::{
    planish_in_flight, planish_output_shape, planish_receive, planish_smooth, planish_smooth_new, planish_submit,
};
