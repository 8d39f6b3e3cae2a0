// planish for OpenCV: depth images in cv::Mat.
#ifndef PLANISH_OPENCV_HPP
#define PLANISH_OPENCV_HPP

#include <opencv2/core.hpp>

#include "planish.hpp"

namespace planish {

/// Borrows a depth image: CV_16UC1 in the camera's units, or CV_32FC1 in metres.
inline Result frame_of(const cv::Mat &depth, const Camera &camera, Frame &frame) {
  const bool is_raw = depth.type() == CV_16UC1;
  if (depth.dims != 2 || !(is_raw || depth.type() == CV_32FC1)) {
    return Result(PLANISH_ARGUMENT, "a depth image is a cv::Mat of CV_16UC1 or CV_32FC1");
  }
  const auto width = static_cast<std::size_t>(depth.cols), height = static_cast<std::size_t>(depth.rows);
  frame = Frame(is_raw ? PLANISH_DEPTH_U16 : PLANISH_DEPTH_F32, width, height);
  frame.data(depth.data).row_stride(depth.step[0]).camera(camera);
  return Result();
}

/// Smooths a depth image into another of the same type. `smoothed` may be the same image. With `status`, each pixel
/// gets one of PLANISH_STATUS_... in CV_8UC1; the setting fill requires it.
inline Checked smooth(Session &session, const cv::Mat &depth, const Camera &camera, cv::Mat &smoothed,
                      cv::Mat *status = nullptr) {
  // In place, the input must be copied, since it is read while the output is written.
  const cv::Mat input = depth.data == smoothed.data && depth.data ? depth.clone() : depth;
  Frame frame(PLANISH_DEPTH_U16, 0, 0);
  Result done = frame_of(input, camera, frame);
  if (!done) return detail::checked(std::move(done));
  std::size_t width = 0, height = 0;
  done = Result(planish_output_shape(session.c(), frame.width(), frame.height(), &width, &height));
  if (!done) return detail::checked(std::move(done));
  const int rows = static_cast<int>(height), cols = static_cast<int>(width);
  // The output buffer must be contiguous, so a result that is part of a larger image is written through a temporary
  // image.
  cv::Mat result = smoothed;
  if (result.type() != input.type() || result.rows != rows || result.cols != cols || !result.isContinuous()) {
    result = cv::Mat(rows, cols, input.type());
  }
  Output output(width * height);
  if (input.type() == CV_16UC1) {
    output.depth(result.ptr<std::uint16_t>());
  } else {
    output.depth_m(result.ptr<float>());
  }
  if (status) {
    *status = cv::Mat(rows, cols, CV_8UC1);
    output.status(status->ptr<std::uint8_t>());
  }
  done = session.try_smooth(frame, output);
  if (done && result.data != smoothed.data) {
    if (smoothed.type() == result.type() && smoothed.size() == result.size()) {
      result.copyTo(smoothed);
    } else {
      smoothed = result;
    }
  }
  return detail::checked(std::move(done));
}

}  // namespace planish

#endif  // PLANISH_OPENCV_HPP
