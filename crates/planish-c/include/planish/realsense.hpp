// planish for librealsense: a processing block that replaces rs2::spatial_filter.
//
//   planish::DepthSmoother smoother("sensor=d435");
//   rs2::frame smoothed = smoother.process(frames.get_depth_frame());
#ifndef PLANISH_REALSENSE_HPP
#define PLANISH_REALSENSE_HPP

#include <librealsense2/rs.hpp>

#include <memory>
#include <string>
#include <vector>

#include "planish.hpp"

namespace planish {

/// Returns the camera of a depth stream. If planish does not support the distortion, the session returns an error.
inline Camera camera_of(const rs2_intrinsics &intrinsics, float metres_per_unit) {
  Camera camera(static_cast<std::size_t>(intrinsics.width), static_cast<std::size_t>(intrinsics.height), intrinsics.fx,
                intrinsics.fy, intrinsics.ppx, intrinsics.ppy);
  camera.depth_units_per_metre(1.0 / metres_per_unit);
  bool is_distorted = false;
  for (float k : intrinsics.coeffs) is_distorted |= k != 0;
  if (is_distorted && intrinsics.model != RS2_DISTORTION_NONE) {
    const std::vector<double> coefficients(intrinsics.coeffs, intrinsics.coeffs + 5);
    camera.distortion(rs2_distortion_to_string(intrinsics.model), coefficients);
  }
  return camera;
}

/// Smooths depth frames. Frames of other streams pass through unchanged, including those in framesets.
class DepthSmoother : public rs2::filter {
 public:
  explicit DepthSmoother(const std::string &settings = "")
      : DepthSmoother(std::make_shared<State>(State{Session(settings), {}})) {}

  /// Returns and removes the session's events: its automatic decisions and findings.
  std::vector<std::string> take_events() { return state_->session.take_events(); }
  /// Returns one of PLANISH_STATUS_... for each pixel of the last frame, such as PLANISH_STATUS_FILLED.
  const std::vector<std::uint8_t> &status() const { return state_->status; }

 private:
  struct State {
    Session session;
    std::vector<std::uint8_t> status;
  };

  explicit DepthSmoother(std::shared_ptr<State> state)
      : rs2::filter([state](rs2::frame frame, rs2::frame_source &source) { run(*state, frame, source); }),
        state_(std::move(state)) {}

  static rs2::frame smoothed(State &state, const rs2::depth_frame &depth, rs2::frame_source &source) {
    const auto profile = depth.get_profile().as<rs2::video_stream_profile>();
    const Camera camera = camera_of(profile.get_intrinsics(), depth.get_units());
    const int width = depth.get_width(), height = depth.get_height();
    // Bytes per pixel, and per row.
    rs2::frame out = source.allocate_video_frame(profile, depth, 2, width, height, 2 * width, RS2_EXTENSION_DEPTH_FRAME);
    const auto *raw = static_cast<const std::uint16_t *>(depth.get_data());
    auto *result = static_cast<std::uint16_t *>(const_cast<void *>(out.get_data()));
    const std::size_t stride = static_cast<std::size_t>(depth.get_stride_in_bytes());
    Output output(static_cast<std::size_t>(width) * static_cast<std::size_t>(height));
    state.status.resize(static_cast<std::size_t>(width) * static_cast<std::size_t>(height));
    state.session.smooth(planish::depth(raw, camera, stride), output.depth(result).status(state.status.data()));
    return out;
  }

  static void run(State &state, rs2::frame frame, rs2::frame_source &source) {
    auto one = [&](const rs2::frame &frame) -> rs2::frame {
      const auto depth = frame.as<rs2::depth_frame>();
      return depth ? smoothed(state, depth, source) : frame;
    };
    if (const auto frames = frame.as<rs2::frameset>()) {
      std::vector<rs2::frame> all;
      frames.foreach_rs([&](const rs2::frame &frame) { all.push_back(one(frame)); });
      source.frame_ready(source.allocate_composite_frame(all));
    } else {
      source.frame_ready(one(frame));
    }
  }

  std::shared_ptr<State> state_;
};

}  // namespace planish

#endif  // PLANISH_REALSENSE_HPP
