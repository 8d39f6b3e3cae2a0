// PCL's MovingLeastSquares on a PCD file: prints the median time of some runs in milliseconds, and the points that are left.
//
// usage: pcl_mls FILE RADIUS_M DEGREE THREADS RUNS

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <vector>

#include <pcl/filters/filter.h>
#include <pcl/io/pcd_io.h>
#include <pcl/point_types.h>
#include <pcl/search/kdtree.h>
#include <pcl/surface/mls.h>

int main(int argc, char** argv) {
  if (argc != 6) {
    std::fprintf(stderr, "usage: pcl_mls FILE RADIUS_M DEGREE THREADS RUNS\n");
    return 2;
  }
  pcl::PointCloud<pcl::PointXYZ>::Ptr cloud(new pcl::PointCloud<pcl::PointXYZ>);
  if (pcl::io::loadPCDFile(argv[1], *cloud) != 0) return 2;
  std::vector<int> kept;
  pcl::removeNaNFromPointCloud(*cloud, *cloud, kept);

  std::vector<double> times;
  std::size_t points = 0;
  for (int run = 0; run < std::atoi(argv[5]); ++run) {
    pcl::PointCloud<pcl::PointNormal> smoothed;
    pcl::MovingLeastSquares<pcl::PointXYZ, pcl::PointNormal> mls;
    pcl::search::KdTree<pcl::PointXYZ>::Ptr tree(new pcl::search::KdTree<pcl::PointXYZ>);
    const auto start = std::chrono::steady_clock::now();
    mls.setInputCloud(cloud);
    mls.setSearchMethod(tree);
    mls.setComputeNormals(true);
    mls.setSearchRadius(std::atof(argv[2]));
    mls.setPolynomialOrder(std::atoi(argv[3]));
    mls.setNumberOfThreads(std::atoi(argv[4]));
    mls.process(smoothed);
    const std::chrono::duration<double, std::milli> elapsed = std::chrono::steady_clock::now() - start;
    times.push_back(elapsed.count());
    points = smoothed.size();
  }
  std::sort(times.begin(), times.end());
  std::printf("%.3f %zu\n", times[times.size() / 2], points);
  return 0;
}
