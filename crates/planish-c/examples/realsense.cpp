// librealsense: the processing block on frames of a software device, alone and within a frameset.
#include <librealsense2/hpp/rs_internal.hpp>
#include <planish/realsense.hpp>

#include <cmath>
#include <cstdio>
#include <random>
#include <vector>

int main() {
  const int width = 160, height = 120;
  rs2_intrinsics intrinsics = {width, height, 79.5f, 59.5f, 131.25f, 131.25f, RS2_DISTORTION_BROWN_CONRADY, {0, 0, 0, 0, 0}};
  rs2::software_device device;
  auto sensor = device.add_sensor("Depth");
  auto profile = sensor.add_video_stream({RS2_STREAM_DEPTH, 0, 1, width, height, 30, 2, RS2_FORMAT_Z16, intrinsics});
  sensor.add_read_only_option(RS2_OPTION_DEPTH_UNITS, 0.001f);
  rs2::frame_queue queue;
  sensor.open(profile);
  sensor.start(queue);

  std::mt19937 random(1);
  std::vector<std::uint16_t> raw(width * height);
  for (auto &value : raw) value = static_cast<std::uint16_t>(1497 + random() % 7);
  rs2_software_video_frame frame = {};
  frame.pixels = raw.data();
  frame.deleter = [](void *) {};
  frame.stride = 2 * width;
  frame.bpp = 2;
  frame.timestamp = 1;
  frame.domain = RS2_TIMESTAMP_DOMAIN_HARDWARE_CLOCK;
  frame.frame_number = 1;
  frame.profile = profile;
  frame.depth_units = 0.001f;
  sensor.on_video_frame(frame);

  planish::DepthSmoother smoother("engine=cpu sensor=d435");
  const rs2::depth_frame depth = queue.wait_for_frame();
  const rs2::depth_frame smoothed = smoother.process(depth);
  const auto error_mm = [&](const rs2::depth_frame &image) {
    double sum = 0;
    const auto *values = static_cast<const std::uint16_t *>(image.get_data());
    for (int i = 0; i < width * height; ++i) sum += std::pow(values[i] - 1500.0, 2);
    return std::sqrt(sum / (width * height));
  };
  std::printf("%.2f mm -> %.2f mm, frame %llu at %.3f m\n", error_mm(depth), error_mm(smoothed),
              static_cast<unsigned long long>(smoothed.get_frame_number()), smoothed.get_distance(80, 60));
  const bool is_smoother = error_mm(smoothed) < 0.5 * error_mm(depth);
  const bool is_same_kind = smoothed.get_profile().format() == RS2_FORMAT_Z16 && smoothed.get_frame_number() == 1;
  sensor.stop();
  sensor.close();
  return is_smoother && is_same_kind ? 0 : 1;
}
