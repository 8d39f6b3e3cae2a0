// OpenCV: depth images in cv::Mat, in place and as part of a larger image.
#include <planish/eigen.hpp>
#include <planish/opencv.hpp>

#include <cmath>
#include <cstdio>

namespace {
int failures = 0;
void expect(bool is_true, const char *what) {
  if (is_true) return;
  std::printf("FAILED: %s\n", what);
  ++failures;
}

double spread(const cv::Mat &image) {
  cv::Mat floats, mean, deviation;
  image.convertTo(floats, CV_64F);
  cv::meanStdDev(floats, mean, deviation);
  return deviation.at<double>(0);
}
}  // namespace

int main() {
  cv::Mat depth(120, 160, CV_16UC1);
  cv::RNG random(1);
  random.fill(depth, cv::RNG::NORMAL, 1500, 3);
  planish::Camera camera(160, 120, 131.25, 131.25, 79.5, 59.5);
  planish::Session session("engine=cpu");

  cv::Mat smoothed;
  planish::smooth(session, depth, camera, smoothed);
  std::printf("raw units: spread %.2f -> %.2f\n", spread(depth), spread(smoothed));
  expect(smoothed.type() == CV_16UC1 && spread(smoothed) < 0.5 * spread(depth), "raw depth is smoother");

  cv::Mat in_place = depth.clone();
  const void *before = in_place.data;
  planish::smooth(session, in_place, camera, in_place);
  expect(in_place.data == before && cv::norm(in_place, smoothed, cv::NORM_INF) == 0, "the in-place result is the same");

  cv::Mat metres;
  depth.convertTo(metres, CV_32F, 1e-3);
  cv::Mat large(130, 170, CV_32FC1, cv::Scalar(7));
  metres.copyTo(large(cv::Rect(5, 5, 160, 120)));
  cv::Mat part = large(cv::Rect(5, 5, 160, 120));
  planish::smooth(session, part, camera, part);
  expect(large.at<float>(0, 0) == 7 && std::abs(large.at<float>(65, 85) - 1.5f) < 0.01f, "part of a larger image");
  expect(spread(part) < 0.5e-3 * spread(depth), "depth in metres is smoother");

  Eigen::Matrix3Xd points(3, 160 * 120);
  for (int i = 0; i < 160 * 120; ++i) {
    const double z = 1e-3 * depth.at<std::uint16_t>(i / 160, i % 160);
    points.col(i) << (i % 160 - 79.5) / 131.25 * z, (i / 160 - 59.5) / 131.25 * z, z;
  }
  Eigen::Matrix3Xf of_eigen;
  planish::smooth(session, points, of_eigen, 120);
  expect(std::abs(1e3f * of_eigen(2, 9000) - smoothed.at<std::uint16_t>(9000 / 160, 9000 % 160)) <= 1.0f, "Eigen");

  cv::Mat bytes(120, 160, CV_8UC1, cv::Scalar(1));
  try {
    planish::smooth(session, bytes, camera, smoothed);
    expect(false, "bytes are refused");
  } catch (const planish::Error &error) {
    std::printf("refused: %s\n", error.what());
  }
  return failures != 0;
}
