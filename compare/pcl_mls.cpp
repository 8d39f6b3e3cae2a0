// Runs PCL's MovingLeastSquares on a PCD file. Prints the median time of the runs in milliseconds, and the number of
// remaining points.
//
// usage: pcl_mls FILE organized|kdtree RADIUS_M DEGREE THREADS RUNS [OUTPUT.pcd]
//
// organized: smooths the finite points with search::OrganizedNeighbor on the grid, PCL's fastest search for these.
// kdtree: smooths the finite points with search::KdTree; the time does not include copying these points.
// With an output, the result and its normals are put back on the grid of the input, by the indices that PCL keeps. Use
// one thread then, because with several, the order of PCL's points does not match its indices.

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <string>
#include <vector>

#include <pcl/filters/filter.h>
#include <pcl/io/pcd_io.h>
#include <pcl/point_types.h>
#include <pcl/search/kdtree.h>
#include <pcl/search/organized.h>
#include <pcl/surface/mls.h>

int main(int argc, char** argv) {
  if (argc != 7 && argc != 8) {
    std::fprintf(stderr, "usage: pcl_mls FILE organized|kdtree RADIUS_M DEGREE THREADS RUNS [OUTPUT.pcd]\n");
    return 2;
  }
  const bool organized = std::string(argv[2]) == "organized";
  pcl::PointCloud<pcl::PointXYZ>::Ptr cloud(new pcl::PointCloud<pcl::PointXYZ>);
  if (pcl::io::loadPCDFile(argv[1], *cloud) != 0) return 2;
  const std::size_t width = cloud->width, height = cloud->height;
  // The pixels of the finite points.
  pcl::IndicesPtr finite(new pcl::Indices);
  if (organized) {
    for (std::size_t i = 0; i < cloud->size(); ++i)
      if ((*cloud)[i].getVector3fMap().allFinite()) finite->push_back(static_cast<int>(i));
  } else {
    pcl::removeNaNFromPointCloud(*cloud, *cloud, *finite);
  }

  std::vector<double> times;
  std::size_t points = 0;
  for (int run = 0; run < std::atoi(argv[6]); ++run) {
    pcl::PointCloud<pcl::PointNormal> smoothed;
    pcl::MovingLeastSquares<pcl::PointXYZ, pcl::PointNormal> mls;
    const auto start = std::chrono::steady_clock::now();
    mls.setInputCloud(cloud);
    if (organized) {
      mls.setIndices(finite);
      mls.setSearchMethod(pcl::search::OrganizedNeighbor<pcl::PointXYZ>::Ptr(new pcl::search::OrganizedNeighbor<pcl::PointXYZ>));
    } else {
      mls.setSearchMethod(pcl::search::KdTree<pcl::PointXYZ>::Ptr(new pcl::search::KdTree<pcl::PointXYZ>));
    }
    mls.setComputeNormals(true);
    mls.setSearchRadius(std::atof(argv[3]));
    mls.setPolynomialOrder(std::atoi(argv[4]));
    mls.setNumberOfThreads(std::atoi(argv[5]));
    mls.process(smoothed);
    const std::chrono::duration<double, std::milli> elapsed = std::chrono::steady_clock::now() - start;
    times.push_back(elapsed.count());
    points = smoothed.size();
    if (run > 0 || argc != 8) continue;

    const float nan = std::numeric_limits<float>::quiet_NaN();
    pcl::PointNormal hole;
    hole.x = hole.y = hole.z = hole.normal_x = hole.normal_y = hole.normal_z = hole.curvature = nan;
    pcl::PointCloud<pcl::PointNormal> grid(width, height, hole);
    const auto& indices = mls.getCorrespondingIndices()->indices;
    for (std::size_t i = 0; i < smoothed.size(); ++i) {
      pcl::PointNormal point = smoothed[i];
      // PCL does not define the sign of the normal, so turn it towards the camera.
      if (point.getNormalVector3fMap().dot(point.getVector3fMap()) > 0) point.getNormalVector3fMap() *= -1;
      grid[organized ? indices[i] : (*finite)[indices[i]]] = point;
    }
    if (pcl::io::savePCDFileBinary(argv[7], grid) != 0) return 2;
  }
  std::sort(times.begin(), times.end());
  std::printf("%.3f %zu\n", times[times.size() / 2], points);
  return 0;
}
