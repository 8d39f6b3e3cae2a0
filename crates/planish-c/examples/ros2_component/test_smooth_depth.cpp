// Tests the component's use of planish; the node around it needs ROS 2.
#include <cstdio>
#include <cstring>

#include "src/smooth_depth.hpp"

int main() {
  planish::Session session("engine=cpu");
  const double intrinsics[4] = {131.25, 131.25, 79.5, 59.5};
  // Each row has 170 values, the first 160 of which belong to the image.
  std::vector<std::uint16_t> rows(170 * 120);
  for (std::size_t i = 0; i < rows.size(); ++i) rows[i] = static_cast<std::uint16_t>(1500 + (i * 7919) % 7);
  std::vector<std::uint8_t> data(2 * rows.size()), smoothed;
  std::memcpy(data.data(), rows.data(), data.size());
  const std::string problem = smooth_depth(session, "16UC1", 160, 120, 340, data, intrinsics, smoothed);
  std::uint16_t middle = 0;
  if (problem.empty()) std::memcpy(&middle, &smoothed[2 * (60 * 160 + 80)], 2);
  std::printf("%s%u mm in the middle\n", problem.c_str(), middle);
  const bool is_right = problem.empty() && smoothed.size() == 2 * 160 * 120 && middle >= 1502 && middle <= 1504;
  const bool refuses = !smooth_depth(session, "rgb8", 160, 120, 480, data, intrinsics, smoothed).empty() &&
                       !smooth_depth(session, "16UC1", 160, 120, 300, data, intrinsics, smoothed).empty();
  return is_right && refuses ? 0 : 1;
}
