// planish for PCL: smooths clouds of any registered point type, keeping every field, and replaces
// pcl::MovingLeastSquares.
//
//   planish::smooth(session, cloud, smoothed);     // frames on a grid, and clouds without one
//
//   planish::MovingLeastSquares<pcl::PointXYZ, pcl::PointNormal> mls;     // instead of pcl::MovingLeastSquares
#ifndef PLANISH_PCL_HPP
#define PLANISH_PCL_HPP

#include <pcl/pcl_base.h>
#include <pcl/point_cloud.h>
#include <pcl/point_types.h>
#include <pcl/search/search.h>

#include <cmath>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "planish.hpp"

namespace planish {
namespace detail {

template <typename PointT, typename Field>
constexpr std::size_t offset_of() {
  return pcl::traits::offset<PointT, Field>::value;
}

/// Sets the pose of the sensor, if the cloud has one.
template <typename PointT>
void set_pose(Frame &frame, const pcl::PointCloud<PointT> &cloud) {
  const auto &place = cloud.sensor_origin_;
  const auto &turn = cloud.sensor_orientation_;
  const bool is_at_origin = place.template head<3>().isZero() && turn.isApprox(Eigen::Quaternionf::Identity());
  if (!is_at_origin) frame.pose(place[0], place[1], place[2], turn.w(), turn.x(), turn.y(), turn.z());
}

/// Borrows the points of a cloud.
template <typename PointT>
Frame frame_of(const pcl::PointCloud<PointT> &cloud) {
  using namespace pcl::fields;
  const bool organized = cloud.height > 1;
  Frame frame(PLANISH_POINTS_F32, organized ? cloud.width : cloud.size(), organized ? cloud.height : 1);
  frame.data(cloud.points.data());
  frame.layout(sizeof(PointT), offset_of<PointT, x>(), offset_of<PointT, y>(), offset_of<PointT, z>());
  set_pose(frame, cloud);
  return frame;
}

template <typename Field, typename PointT>
float *field_of(pcl::PointCloud<PointT> &cloud) {
  return reinterpret_cast<float *>(reinterpret_cast<char *>(cloud.points.data()) + offset_of<PointT, Field>());
}

/// Returns the output buffers for the fields that the point type has.
template <typename PointT>
Output output_of(pcl::PointCloud<PointT> &cloud, bool normals, std::vector<float> &curvature) {
  Output output(cloud.size());
  output.points(field_of<pcl::fields::x>(cloud), sizeof(PointT));
  if constexpr (pcl::traits::has_normal<PointT>::value) {
    if (normals) output.normals(field_of<pcl::fields::normal_x>(cloud), sizeof(PointT));
  }
  if constexpr (pcl::traits::has_curvature<PointT>::value) {
    if (normals) {
      curvature.resize(cloud.size());
      output.curvature(curvature.data());
    }
  }
  return output;
}

/// Returns true if the library can copy the other fields while it writes the points. It cannot for types with normals
/// or curvature, which the copy would overwrite.
template <typename PointT>
constexpr bool copies_fields() {
  return offset_of<PointT, pcl::fields::x>() == 0 && !pcl::traits::has_normal<PointT>::value && !pcl::traits::has_curvature<PointT>::value;
}

/// Copies the header, shape and sensor pose of a cloud, and makes room for its points.
template <typename PointT>
void copy_shape(const pcl::PointCloud<PointT> &cloud, pcl::PointCloud<PointT> &to) {
  to.header = cloud.header;
  to.points.resize(cloud.size());
  to.width = cloud.width;
  to.height = cloud.height;
  to.is_dense = false;
  to.sensor_origin_ = cloud.sensor_origin_;
  to.sensor_orientation_ = cloud.sensor_orientation_;
}

template <typename PointT>
void put_curvature(pcl::PointCloud<PointT> &cloud, const std::vector<float> &curvature) {
  if constexpr (pcl::traits::has_curvature<PointT>::value) {
    for (std::size_t i = 0; i < curvature.size(); ++i) cloud.points[i].curvature = curvature[i];
  }
}

}  // namespace detail

/// Smooths a cloud, on its grid if it has one. All other fields are kept; points that become holes are NaN. Normals
/// and curvature are written if the point type has them. `smoothed` may be the same cloud. With `status`, each point
/// gets one of PLANISH_STATUS_...; the setting fill requires it.
template <typename PointT>
Checked smooth(Session &session, const pcl::PointCloud<PointT> &cloud, pcl::PointCloud<PointT> &smoothed,
               std::vector<std::uint8_t> *status = nullptr) {
  static_assert(pcl::traits::has_xyz<PointT>::value, "planish::smooth needs points with x, y and z");
  if (status) status->assign(cloud.size(), PLANISH_STATUS_HOLE);
  if (cloud.empty()) {
    if (&cloud != &smoothed) smoothed = cloud;
    return detail::checked(Result());
  }
  std::size_t width = 0, height = 0;
  Result shape(planish_output_shape(session.c(), cloud.width, cloud.height, &width, &height));
  if (shape && (width != cloud.width || height != cloud.height)) {
    shape = Result(PLANISH_SETTING, "the setting decimate changes the number of points; smooth planish::points instead");
  }
  if (!shape) return detail::checked(std::move(shape));
  if (&cloud == &smoothed) {
    const pcl::PointCloud<PointT> copy(cloud);
    return smooth(session, copy, smoothed, status);
  }
  detail::copy_shape(cloud, smoothed);
  std::vector<float> curvature;
  Output output = detail::output_of(smoothed, true, curvature);
  if (detail::copies_fields<PointT>()) {
    output.gaps_from(reinterpret_cast<const float *>(cloud.points.data()));
  } else {
    smoothed.points = cloud.points;
  }
  if (status) output.status(status->data());
  Result done = session.try_smooth(detail::frame_of(cloud), output);
  if (done) {
    detail::put_curvature(smoothed, curvature);
  } else {
    smoothed.points = cloud.points;
  }
  return detail::checked(std::move(done));
}

#ifndef PLANISH_NO_EXCEPTIONS
/// Smooths one cloud. For several clouds, use a Session.
template <typename PointT>
pcl::PointCloud<PointT> smooth(const pcl::PointCloud<PointT> &cloud, const std::string &settings = "") {
  Session session(settings);
  pcl::PointCloud<PointT> smoothed;
  smooth(session, cloud, smoothed);
  return smoothed;
}

/// A replacement for pcl::MovingLeastSquares with the same function names, neighbourhood, degree and Gaussian weights,
/// computed by planish's engine. As in PCL, points with fewer than three neighbours are omitted. planish does not
/// upsample: setUpsamplingMethod throws an exception for every method but NONE.
template <typename PointInT, typename PointOutT>
class MovingLeastSquares : public pcl::PCLBase<PointInT> {
  using Base = pcl::PCLBase<PointInT>;
  using Base::indices_;
  using Base::input_;

 public:
  using Ptr = std::shared_ptr<MovingLeastSquares>;
  using KdTreePtr = typename pcl::search::Search<PointInT>::Ptr;
  using PointCloudOut = pcl::PointCloud<PointOutT>;
  enum UpsamplingMethod { NONE, DISTINCT_CLOUD, SAMPLE_LOCAL_PLANE, RANDOM_UNIFORM_DENSITY, VOXEL_GRID_DILATION };

  MovingLeastSquares() : session_("edges=off passes=1 grid=off degree=2 ridge=1e-3") {}

  /// Sets the radius of a neighbourhood in metres.
  void setSearchRadius(double radius) {
    session_.set("radius_m", radius);
    // As in PCL, the Gaussian's bandwidth follows the radius until setSqrGaussParam is called again.
    session_.set("bandwidth_m", "");
    search_radius_ = radius;
    gauss_ = 0;
  }
  double getSearchRadius() const { return search_radius_; }
  /// Sets the degree of the surface: 0 and 1 fit a plane, 2 and 3 polynomials.
  void setPolynomialOrder(int order) {
    if (order < 0 || order > 3) refuse("setPolynomialOrder", "a degree of 0 to 3");
    order_ = order;
    session_.set("degree", order < 1 ? 1 : order);
  }
  int getPolynomialOrder() const { return order_; }
  void setComputeNormals(bool compute_normals) { compute_normals_ = compute_normals; }
  /// Sets the square of the Gaussian's bandwidth, exp(-d²/gauss).
  void setSqrGaussParam(double gauss) {
    if (!(gauss > 0)) refuse("setSqrGaussParam", "a positive number");
    session_.set("bandwidth_m", std::sqrt(gauss));
    gauss_ = gauss;
  }
  double getSqrGaussParam() const { return gauss_ > 0 ? gauss_ : search_radius_ * search_radius_; }
  /// Has no effect: planish uses an index of its own.
  void setSearchMethod(const KdTreePtr &) {}
  void setNumberOfThreads(unsigned threads) {
    if (threads > 0) session_.set("threads", static_cast<double>(threads));
  }
  void setCacheMLSResults(bool) {}
  void setUpsamplingMethod(UpsamplingMethod method) {
    if (method != NONE) refuse("setUpsamplingMethod", "NONE");
  }
  /// Sets another setting of planish, such as "neighbours" or "passes".
  template <typename Value>
  void set(const std::string &name, const Value &value) {
    session_.set(name, value);
  }

  /// Smooths the cloud. The output contains those of the selected points (setIndices) that have a surface.
  void process(PointCloudOut &result) {
    kept_.reset(new pcl::PointIndices);
    // The result may be the input.
    PointCloudOut output;
    if (!(search_radius_ > 0)) throw Error(Result(PLANISH_SETTING, "set the radius with setSearchRadius first"));
    if (!Base::initCompute()) {
      output.width = output.height = 0;
      result.swap(output);
      return;
    }
    for (const auto index : *indices_) {
      if (static_cast<std::size_t>(index) >= input_->size()) {
        Base::deinitCompute();
        throw Error(Result(PLANISH_ARGUMENT, "setIndices: index " + std::to_string(index) + " is out of range"));
      }
    }
    output.header = kept_->header = input_->header;
    output.sensor_origin_ = input_->sensor_origin_;
    output.sensor_orientation_ = input_->sensor_orientation_;
    // As in PCL, the grid is ignored.
    using namespace pcl::fields;
    Frame frame(PLANISH_POINTS_F32, input_->size(), 1);
    frame.data(input_->points.data());
    frame.layout(sizeof(PointInT), detail::offset_of<PointInT, x>(), detail::offset_of<PointInT, y>(),
                 detail::offset_of<PointInT, z>());
    detail::set_pose(frame, *input_);
    std::uint32_t outputs = PLANISH_POINTS | PLANISH_STATUS;
    if (compute_normals_) outputs |= PLANISH_NORMALS | PLANISH_CURVATURE;
    const Smoothed smoothed = session_.smooth(frame, outputs);
    output.reserve(indices_->size());
    output.is_dense = true;
    for (const auto index : *indices_) {
      const auto i = static_cast<std::size_t>(index);
      const std::uint8_t status = smoothed.status()[i];
      if (status < PLANISH_STATUS_DEGENERATE || status == PLANISH_STATUS_ISOLATED) continue;
      PointOutT point;
      pcl::copyPoint((*input_)[i], point);
      point.x = smoothed.points(0)[i];
      point.y = smoothed.points(1)[i];
      point.z = smoothed.points(2)[i];
      if constexpr (pcl::traits::has_normal<PointOutT>::value) {
        if (compute_normals_) {
          point.normal_x = smoothed.normals(0)[i];
          point.normal_y = smoothed.normals(1)[i];
          point.normal_z = smoothed.normals(2)[i];
          output.is_dense = output.is_dense && std::isfinite(point.normal_z);
        }
      }
      if constexpr (pcl::traits::has_curvature<PointOutT>::value) {
        if (compute_normals_) point.curvature = smoothed.curvature()[i];
      }
      output.push_back(point);
      kept_->indices.push_back(index);
    }
    output.width = static_cast<std::uint32_t>(output.size());
    output.height = 1;
    Base::deinitCompute();
    result.swap(output);
  }

  /// Returns the input index of each output point.
  pcl::PointIndicesPtr getCorrespondingIndices() const { return kept_; }

 private:
  [[noreturn]] static void refuse(const char *what, const char *allowed) {
    throw Error(Result(PLANISH_SETTING, std::string(what) + ": planish supports " + allowed + " only"));
  }

  Session session_;
  double search_radius_ = 0;
  double gauss_ = 0;
  int order_ = 2;
  bool compute_normals_ = false;
  pcl::PointIndicesPtr kept_;
};
#endif  // PLANISH_NO_EXCEPTIONS

}  // namespace planish

#endif  // PLANISH_PCL_HPP
