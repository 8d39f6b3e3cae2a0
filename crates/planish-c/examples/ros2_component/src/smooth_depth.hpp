// The part of the component that does not need ROS: it smooths a depth image in 16UC1 or 32FC1, as in sensor_msgs.
#ifndef SMOOTH_DEPTH_HPP
#define SMOOTH_DEPTH_HPP

#include <planish/planish.hpp>

#include <string>
#include <vector>

/// Smooths the data of an image message. `intrinsics` are fx, fy, cx, cy. Returns an error message, or an empty string.
inline std::string smooth_depth(planish::Session &session, const std::string &encoding, std::size_t width,
                                std::size_t height, std::size_t step, const std::vector<std::uint8_t> &data,
                                const double (&intrinsics)[4], std::vector<std::uint8_t> &smoothed) {
  const bool is_raw = encoding == "16UC1" || encoding == "mono16";
  if (!is_raw && encoding != "32FC1") return "unsupported encoding " + encoding + "; expected 16UC1 or 32FC1";
  const std::size_t bytes = is_raw ? 2 : 4;
  if (step < bytes * width || data.size() < step * height) return "the image data is shorter than its size requires";
  const planish::Camera camera(width, height, intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]);
  planish::Frame frame(is_raw ? PLANISH_DEPTH_U16 : PLANISH_DEPTH_F32, width, height);
  frame.data(data.data()).row_stride(step).camera(camera);
  smoothed.resize(bytes * width * height);
  planish::Output output(width * height);
  // A vector's memory is aligned for every type.
  if (is_raw) {
    output.depth(reinterpret_cast<std::uint16_t *>(smoothed.data()));
  } else {
    output.depth_m(reinterpret_cast<float *>(smoothed.data()));
  }
  return session.try_smooth(frame, output).text();
}

#endif  // SMOOTH_DEPTH_HPP
