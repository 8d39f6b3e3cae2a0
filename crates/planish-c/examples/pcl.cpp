// PCL: an organized cloud with colours, and the class that replaces pcl::MovingLeastSquares, compared with PCL's.
#include <pcl/common/io.h>
#include <pcl/search/kdtree.h>
#include <pcl/surface/mls.h>
#include <planish/pcl.hpp>

#include <cmath>
#include <cstring>
#include <cstdio>
#include <random>

namespace {

/// Returns a wall of 160x120 points in a Kinect's field of view, with noise of 3 mm; every tenth pixel is a hole.
pcl::PointCloud<pcl::PointXYZRGBNormal> wall() {
  std::mt19937 random(1);
  std::normal_distribution<float> noise(0.0f, 0.003f);
  pcl::PointCloud<pcl::PointXYZRGBNormal> cloud(160, 120);
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    const float u = (static_cast<float>(i % 160) - 79.5f) / 131.25f, v = (static_cast<float>(i / 160) - 59.5f) / 131.25f;
    const float z = i % 10 == 3 ? NAN : 1.5f + noise(random);
    auto &point = cloud.points[i];
    point.x = u * z;
    point.y = v * z;
    point.z = z;
    point.r = static_cast<std::uint8_t>(i);
  }
  cloud.is_dense = false;
  return cloud;
}

template <typename PointT>
double error_mm(const pcl::PointCloud<PointT> &cloud) {
  double sum = 0;
  std::size_t count = 0;
  for (const auto &point : cloud) {
    if (!std::isfinite(point.z)) continue;
    sum += std::pow(1e3 * (point.z - 1.5), 2);
    ++count;
  }
  return std::sqrt(sum / static_cast<double>(count));
}

template <template <typename, typename> class Mls>
pcl::PointCloud<pcl::PointNormal> with(const pcl::PointCloud<pcl::PointXYZ>::ConstPtr &cloud, const pcl::IndicesPtr &indices,
                                       pcl::PointIndices &from) {
  Mls<pcl::PointXYZ, pcl::PointNormal> mls;
  mls.setInputCloud(cloud);
  mls.setIndices(indices);
  mls.setSearchMethod(pcl::search::KdTree<pcl::PointXYZ>::Ptr(new pcl::search::KdTree<pcl::PointXYZ>));
  mls.setSearchRadius(0.05);
  mls.setPolynomialOrder(2);
  mls.setComputeNormals(true);
  pcl::PointCloud<pcl::PointNormal> smoothed;
  mls.process(smoothed);
  from = *mls.getCorrespondingIndices();
  return smoothed;
}

int failures = 0;
void expect(bool is_true, const char *what) {
  if (is_true) return;
  std::printf("FAILED: %s\n", what);
  ++failures;
}

}  // namespace

int main() {
  const auto cloud = wall();
  planish::Session session("engine=cpu");
  pcl::PointCloud<pcl::PointXYZRGBNormal> smoothed;
  planish::smooth(session, cloud, smoothed);
  std::printf("organized: %.2f mm -> %.2f mm\n", error_mm(cloud), error_mm(smoothed));
  expect(smoothed.width == 160 && smoothed.height == 120, "the grid is kept");
  expect(error_mm(smoothed) < 0.5 * error_mm(cloud), "the wall is smoother");
  expect(smoothed.points[4].r == 4 && std::isnan(smoothed.points[3].z), "colours and holes are kept");
  expect(smoothed.points[9000].normal_z < -0.9f && smoothed.points[9000].curvature < 0.05f, "normals face the sensor");
  pcl::PointCloud<pcl::PointXYZRGB> coloured, of_coloured(3, 1);
  pcl::copyPointCloud(cloud, coloured);
  planish::smooth(session, coloured, of_coloured);
  bool equal = of_coloured.width == 160 && of_coloured.size() == cloud.size();
  for (std::size_t i = 0; equal && i < cloud.size(); ++i) {
    equal = of_coloured.points[i].rgba == cloud.points[i].rgba && std::memcmp(&of_coloured.points[i].x, &smoothed.points[i].x, 12) == 0;
  }
  expect(equal, "types without normals give the same points, with their colours");
  auto in_place = cloud;
  planish::smooth(session, in_place, in_place);
  expect(in_place.points[9000].z == smoothed.points[9000].z, "the in-place result is the same");

  pcl::PointCloud<pcl::PointXYZ>::Ptr points(new pcl::PointCloud<pcl::PointXYZ>);
  for (const auto &point : cloud) {
    if (std::isfinite(point.z)) points->push_back({point.x, point.y, point.z});
  }
  points->push_back({9.0f, 9.0f, 9.0f});
  pcl::IndicesPtr indices(new pcl::Indices);
  for (int i = 0; i < static_cast<int>(points->size()); i += 3) indices->push_back(i);
  indices->push_back(static_cast<int>(points->size()) - 1);
  pcl::PointIndices of_pcl, of_planish;
  const auto theirs = with<pcl::MovingLeastSquares>(points, indices, of_pcl);
  const auto ours = with<planish::MovingLeastSquares>(points, indices, of_planish);
  expect(of_pcl.indices == of_planish.indices, "the same points have a surface");
  double farthest = 0, squares = 0;
  for (std::size_t i = 0; i < ours.size() && i < theirs.size(); ++i) {
    const double distance = (ours[i].getVector3fMap() - theirs[i].getVector3fMap()).norm();
    farthest = std::max(farthest, distance);
    squares += distance * distance;
  }
  std::printf("unorganized: %zu points, %.4f mm from PCL's on average (RMS), at most %.3f mm\n", ours.size(),
              1e3 * std::sqrt(squares / static_cast<double>(ours.size())), 1e3 * farthest);
  expect(farthest < 1e-3, "within a millimetre of PCL's");
  try {
    planish::MovingLeastSquares<pcl::PointXYZ, pcl::PointXYZ>().setPolynomialOrder(7);
    expect(false, "a degree of 7 is refused");
  } catch (const planish::Error &error) {
    expect(error.code() == PLANISH_SETTING, "an invalid degree is a setting error");
  }
  return failures != 0;
}
