// planish for Eigen: points as the columns of a matrix with three rows.
#ifndef PLANISH_EIGEN_HPP
#define PLANISH_EIGEN_HPP

#include <Eigen/Core>
#include <type_traits>

#include "planish.hpp"

namespace planish {

/// Points whose columns may have gaps between them.
template <typename Scalar>
using PointsMap = Eigen::Ref<const Eigen::Matrix<Scalar, 3, Eigen::Dynamic>, 0, Eigen::OuterStride<>>;

/// Borrows points, one per column. If `height` is above 1, the points form a grid, row by row.
template <typename Scalar>
Frame frame_of(const PointsMap<Scalar> &points, std::size_t height = 1) {
  static_assert(std::is_same<Scalar, float>::value || std::is_same<Scalar, double>::value, "float or double");
  const auto count = static_cast<std::size_t>(points.cols());
  const std::uint32_t kind = std::is_same<Scalar, float>::value ? PLANISH_POINTS_F32 : PLANISH_POINTS_F64;
  Frame frame(kind, height > 1 ? count / height : count, height);
  const std::size_t stride = sizeof(Scalar) * static_cast<std::size_t>(points.outerStride());
  return frame.data(points.data()).layout(stride, 0, sizeof(Scalar), 2 * sizeof(Scalar));
}

/// Smooths points into the columns of another matrix.
template <typename Derived>
Checked smooth(Session &session, const Eigen::MatrixBase<Derived> &points, Eigen::Matrix3Xf &smoothed,
               std::size_t height = 1) {
  using Scalar = typename Derived::Scalar;
  if (points.cols() == 0) {
    smoothed.resize(3, 0);
    return detail::checked(Result());
  }
  if (height == 0 || static_cast<std::size_t>(points.cols()) % height != 0) {
    return detail::checked(Result(PLANISH_ARGUMENT, "the number of points is not a multiple of the height of the grid"));
  }
  const PointsMap<Scalar> map(points.derived());
  Eigen::Matrix3Xf result(3, points.cols());
  Output output(static_cast<std::size_t>(points.cols()));
  output.points(result.data());
  Result done = session.try_smooth(frame_of<Scalar>(map, height), output);
  if (done) smoothed.swap(result);
  return detail::checked(std::move(done));
}

}  // namespace planish

#endif  // PLANISH_EIGEN_HPP
