// Times PCL's outlier filters and voxel grid: FRAME.pcd RADIUS_M VOXEL_M. Prints one line per operation and search
// method: operation, median time of 5 runs in ms, number of remaining points, search method (empty for the voxel grid).
#include <pcl/filters/filter.h>
#include <pcl/filters/radius_outlier_removal.h>
#include <pcl/filters/statistical_outlier_removal.h>
#include <pcl/filters/voxel_grid.h>
#include <pcl/io/pcd_io.h>
#include <pcl/point_types.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <vector>

using Point = pcl::PointXYZRGB;
using Cloud = pcl::PointCloud<Point>;

template <class Filter>
void report(const char *name, const char *way, Filter filter) {
  std::vector<double> times_ms;
  Cloud out;
  for (int run = 0; run < 5; ++run) {
    const auto start = std::chrono::steady_clock::now();
    filter(out);
    const std::chrono::duration<double, std::milli> time = std::chrono::steady_clock::now() - start;
    times_ms.push_back(time.count());
  }
  std::sort(times_ms.begin(), times_ms.end());
  std::printf("%s %.2f %zu %s\n", name, times_ms[2], out.size(), way);
}

int main(int argc, char **argv) {
  if (argc != 4) return 2;
  Cloud::Ptr organized(new Cloud), cloud(new Cloud);
  if (pcl::io::loadPCDFile(argv[1], *organized) != 0) return 1;
  pcl::IndicesPtr finite(new pcl::Indices);
  pcl::removeNaNFromPointCloud(*organized, *cloud, *finite);
  const double radius = std::atof(argv[2]), voxel = std::atof(argv[3]);
  // The filters search the pixels of an organized cloud directly, and other clouds with a k-d tree.
  const auto outliers = [&](const char *way, const Cloud::Ptr &input, const pcl::IndicesPtr &indices) {
    report("statistical", way, [&](Cloud &out) {
      pcl::StatisticalOutlierRemoval<Point> filter;
      filter.setInputCloud(input);
      if (indices) filter.setIndices(indices);
      filter.setMeanK(20);
      filter.setStddevMulThresh(2.0);
      filter.filter(out);
    });
    report("radius", way, [&](Cloud &out) {
      pcl::RadiusOutlierRemoval<Point> filter;
      filter.setInputCloud(input);
      if (indices) filter.setIndices(indices);
      filter.setRadiusSearch(radius);
      filter.setMinNeighborsInRadius(5);
      filter.filter(out);
    });
  };
  outliers("k-d tree", cloud, nullptr);
  if (organized->isOrganized()) outliers("organized", organized, finite);
  report("voxel", "", [&](Cloud &out) {
    pcl::VoxelGrid<Point> filter;
    filter.setInputCloud(cloud);
    filter.setLeafSize(voxel, voxel, voxel);
    filter.filter(out);
  });
}
