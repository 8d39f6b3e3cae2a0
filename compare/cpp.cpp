// Times planish in C++, PCL, and planish's engine alone in one process: cpp FILE.pcd RADIUS_M THREADS RUNS
//
// Prints median times. For unorganized clouds, compares pcl::MovingLeastSquares with planish::MovingLeastSquares on the
// same finite points; PCL uses search::KdTree, its fastest search for clouds without a grid. For organized clouds,
// compares planish::smooth of a pcl::PointCloud<PointXYZRGB> with the engine alone, on points and results without gaps,
// in alternating runs.

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

#include <pcl/filters/filter.h>
#include <pcl/io/pcd_io.h>
#include <pcl/search/kdtree.h>
#include <pcl/surface/mls.h>
#include <planish/pcl.hpp>

namespace {

template <typename Function>
double ms(Function &&function) {
  const auto start = std::chrono::steady_clock::now();
  function();
  return std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start).count();
}

double median(std::vector<double> values) {
  std::sort(values.begin(), values.end());
  return values[values.size() / 2];
}

template <typename Mls>
void set_up(Mls &mls, const pcl::PointCloud<pcl::PointXYZ>::Ptr &cloud, double radius, int degree, int threads) {
  mls.setInputCloud(cloud);
  mls.setSearchMethod(pcl::search::KdTree<pcl::PointXYZ>::Ptr(new pcl::search::KdTree<pcl::PointXYZ>));
  mls.setSearchRadius(radius);
  mls.setPolynomialOrder(degree);
  mls.setComputeNormals(true);
  mls.setNumberOfThreads(static_cast<unsigned>(threads));
}

}  // namespace

int main(int argc, char **argv) {
  if (argc != 5) {
    std::fprintf(stderr, "usage: cpp FILE.pcd RADIUS_M THREADS RUNS\n");
    return 2;
  }
  const double radius = std::atof(argv[2]);
  const int threads = std::atoi(argv[3]), runs = std::atoi(argv[4]);
  pcl::PointCloud<pcl::PointXYZRGB> organized;
  if (pcl::io::loadPCDFile(argv[1], organized) != 0) return 2;
  pcl::PointCloud<pcl::PointXYZ>::Ptr points(new pcl::PointCloud<pcl::PointXYZ>);
  for (const auto &point : organized) {
    if (point.getVector3fMap().allFinite()) points->push_back({point.x, point.y, point.z});
  }

  for (int degree : {1, 2}) {
    pcl::MovingLeastSquares<pcl::PointXYZ, pcl::PointNormal> theirs;
    planish::MovingLeastSquares<pcl::PointXYZ, pcl::PointNormal> ours;
    set_up(theirs, points, radius, degree, threads);
    set_up(ours, points, radius, degree, threads);
    ours.set("engine", "cpu");
    pcl::PointCloud<pcl::PointNormal> of_pcl, of_planish;
    ours.process(of_planish);
    std::vector<double> pcl_ms, planish_ms;
    for (int run = 0; run < std::max(1, runs / 10); ++run) pcl_ms.push_back(ms([&] { theirs.process(of_pcl); }));
    for (int run = 0; run < runs; ++run) planish_ms.push_back(ms([&] { ours.process(of_planish); }));
    std::printf("unorganized, %zu points, degree %d: PCL %.0f ms, planish %.1f ms: %.1f times; %zu and %zu points left\n",
                points->size(), degree, median(pcl_ms), median(planish_ms), median(pcl_ms) / median(planish_ms), of_pcl.size(),
                of_planish.size());
  }

  planish::Session session("engine=cpu threads=" + std::to_string(threads));
  pcl::PointCloud<pcl::PointXYZRGB> smoothed;
  std::vector<float> tight, result(3 * organized.size());
  for (const auto &point : organized) tight.insert(tight.end(), {point.x, point.y, point.z});
  const planish::Frame frame = planish::points(tight.data(), organized.width, organized.height);
  std::vector<double> whole_ms, engine_ms;
  for (int run = -3; run < runs; ++run) {
    const double whole = ms([&] { planish::smooth(session, organized, smoothed); });
    const double engine = ms([&] { session.smooth(frame, planish::Output(organized.size()).points(result.data())); });
    if (run < 0) continue;
    whole_ms.push_back(whole);
    engine_ms.push_back(engine);
  }
  std::printf("PointXYZRGB %ux%u in and out: %.2f ms, the engine alone %.2f ms: %.3f\n", organized.width, organized.height,
              median(whole_ms), median(engine_ms), median(whole_ms) / median(engine_ms));
}
