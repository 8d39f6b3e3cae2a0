// planish for C++17: sessions, frames and buffers over the C functions of planish.h. No other library is needed.
//
//   #include <planish/planish.hpp>
//
//   planish::Session session("preset=default sensor=d435");
//   planish::Camera camera(640, 480, 615.0, 615.0, 319.5, 239.5);
//   std::vector<float> points(3 * 640 * 480);
//   session.smooth(planish::depth(raw.data(), camera), planish::Output(640 * 480).points(points.data()));
//
// Errors are exceptions of type planish::Error. With -fno-exceptions, or PLANISH_NO_EXCEPTIONS defined, functions
// return a planish::Result instead, which callers must check. Functions whose names begin with try_ always return a
// Result.
#ifndef PLANISH_HPP
#define PLANISH_HPP

#include <cstddef>
#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "planish.h"

#if !defined(PLANISH_NO_EXCEPTIONS) && !defined(__cpp_exceptions)
#define PLANISH_NO_EXCEPTIONS
#endif
#ifndef PLANISH_NO_EXCEPTIONS
#include <stdexcept>
#endif

namespace planish {

/// The outcome of a call: a code from planish.h, and the error message.
class [[nodiscard]] Result {
 public:
  Result() = default;
  /// Stores the code that a C function returned, and the message if it is an error.
  explicit Result(planish_code code) : code_(code), text_(code == PLANISH_OK ? "" : planish_last_error()) {}
  Result(planish_code code, std::string text) : code_(code), text_(std::move(text)) {}

  /// Returns true if the call succeeded.
  explicit operator bool() const { return code_ == PLANISH_OK; }
  planish_code code() const { return code_; }
  const std::string &text() const { return text_; }

 private:
  planish_code code_ = PLANISH_OK;
  std::string text_;
};

#ifdef PLANISH_NO_EXCEPTIONS
using Checked = Result;
namespace detail {
inline Result checked(Result result) { return result; }
}  // namespace detail
#else
/// The error of a failed call.
class Error : public std::runtime_error {
 public:
  explicit Error(const Result &result) : std::runtime_error(result.text()), code_(result.code()) {}
  planish_code code() const { return code_; }

 private:
  planish_code code_;
};
using Checked = void;
namespace detail {
inline void checked(const Result &result) {
  if (!result) throw Error(result);
}
}  // namespace detail
#endif

/// A pinhole camera. It owns its text and coefficients.
class Camera {
 public:
  Camera(std::size_t width, std::size_t height, double fx, double fy, double cx, double cy) {
    values_.size = sizeof values_;
    values_.width = width;
    values_.height = height;
    values_.fx = fx;
    values_.fy = fy;
    values_.cx = cx;
    values_.cy = cy;
  }

  /// Sets the number of depth units per metre [default: 1000, for millimetres].
  Camera &depth_units_per_metre(double units) {
    values_.depth_units_per_metre = units;
    return *this;
  }

  /// Sets the lens distortion. `model` is the name of the distortion model in ROS, OpenCV or Kalibr.
  Camera &distortion(std::string model, std::vector<double> coefficients) {
    model_ = std::move(model);
    distortion_ = std::move(coefficients);
    return *this;
  }

  std::size_t width() const { return values_.width; }
  std::size_t height() const { return values_.height; }

  /// Returns the camera for C. It is valid until this object changes or is destroyed.
  planish_camera c() const {
    planish_camera camera = values_;
    if (!distortion_.empty() || !model_.empty()) {
      camera.distortion_model = model_.c_str();
      camera.distortion = distortion_.data();
      camera.distortion_count = distortion_.size();
    }
    return camera;
  }

 private:
  planish_camera values_ = {};
  std::string model_;
  std::vector<double> distortion_;
};

/// A depth image or points in the caller's memory, which is borrowed until the call returns.
class Frame {
 public:
  Frame(std::uint32_t kind, std::size_t width, std::size_t height) {
    frame_.size = sizeof frame_;
    frame_.kind = kind;
    frame_.width = width;
    frame_.height = height;
  }

  Frame &data(const void *data) {
    frame_.data = data;
    return *this;
  }
  /// Sets the distance between rows in bytes.
  Frame &row_stride(std::size_t bytes) {
    frame_.row_stride = bytes;
    return *this;
  }
  /// Sets the distance between points, and the offsets of x, y and z within a point, in bytes.
  Frame &layout(std::size_t point_stride, std::size_t x, std::size_t y, std::size_t z) {
    frame_.point_stride = point_stride;
    frame_.offsets[0] = x;
    frame_.offsets[1] = y;
    frame_.offsets[2] = z;
    return *this;
  }
  Frame &planes(const void *x, const void *y, const void *z) {
    frame_.planes[0] = x;
    frame_.planes[1] = y;
    frame_.planes[2] = z;
    return *this;
  }
  /// Sets the camera of a depth image, or of points on a grid.
  Frame &camera(const Camera &camera) {
    camera_ = {camera};
    return *this;
  }
  /// Sets the pose of the sensor in the frame of the points: position in metres, and orientation as a quaternion.
  Frame &pose(double x, double y, double z, double qw, double qx, double qy, double qz) {
    pose_ = {x, y, z, qw, qx, qy, qz};
    return *this;
  }
  /// Sets an origin near the points, to which results are relative.
  Frame &origin_m(double x, double y, double z) {
    origin_m_ = {x, y, z};
    return *this;
  }
  /// Sets the colours of a depth image: red, green and blue of each pixel.
  Frame &rgb(const std::uint8_t *rgb) {
    frame_.rgb = rgb;
    return *this;
  }

  std::size_t width() const { return frame_.width; }
  std::size_t height() const { return frame_.height; }

  /// Calls a function with the frame for C.
  template <typename Function>
  auto with_c(Function &&function) const {
    planish_frame frame = frame_;
    planish_camera camera = {};
    if (!camera_.empty()) {
      camera = camera_.front().c();
      frame.camera = &camera;
    }
    if (!pose_.empty()) frame.pose = pose_.data();
    if (!origin_m_.empty()) frame.origin_m = origin_m_.data();
    return function(&frame);
  }

 private:
  planish_frame frame_ = {};
  // Empty, or one camera.
  std::vector<Camera> camera_;
  std::vector<double> pose_;
  std::vector<double> origin_m_;
};

/// Returns a frame of depth in the camera's units; 0 and 65535 are holes. `row_stride` is in bytes, 0 for rows
/// without gaps.
inline Frame depth(const std::uint16_t *raw, const Camera &camera, std::size_t row_stride = 0) {
  return Frame(PLANISH_DEPTH_U16, camera.width(), camera.height()).data(raw).row_stride(row_stride).camera(camera);
}

/// Returns a frame of depth in metres; values that are not finite or not positive are holes.
inline Frame depth(const float *depth_m, const Camera &camera, std::size_t row_stride = 0) {
  return Frame(PLANISH_DEPTH_F32, camera.width(), camera.height()).data(depth_m).row_stride(row_stride).camera(camera);
}

/// Returns a frame of interleaved x, y and z, row by row; a height of 1 means points without a grid.
inline Frame points(const float *xyz, std::size_t width, std::size_t height = 1) {
  return Frame(PLANISH_POINTS_F32, width, height).data(xyz);
}
inline Frame points(const double *xyz, std::size_t width, std::size_t height = 1) {
  return Frame(PLANISH_POINTS_F64, width, height).data(xyz);
}

/// The caller's buffers for results, each with room for `count` items.
class Output {
 public:
  explicit Output(std::size_t count) {
    output_.size = sizeof output_;
    output_.count = count;
  }

  /// Sets the buffer for x, y and z. Points are `stride` bytes apart; 0 means no gaps.
  Output &points(float *points, std::size_t stride = 0) {
    output_.points = points;
    output_.points_stride = stride;
    return *this;
  }
  /// Copies the bytes after each point, up to the next one, from other structs with the same stride; `first` is their
  /// first point. Both arrays must have room for `count` structs that begin with a point.
  Output &gaps_from(const float *first) {
    output_.gaps_from = first;
    return *this;
  }
  Output &normals(float *normals, std::size_t stride = 0) {
    output_.normals = normals;
    output_.normals_stride = stride;
    return *this;
  }
  Output &curvature(float *curvature) {
    output_.curvature = curvature;
    return *this;
  }
  /// Sets the buffer for one of PLANISH_STATUS_... per item.
  Output &status(std::uint8_t *status) {
    output_.status = status;
    return *this;
  }
  Output &neighbours(std::uint32_t *neighbours) {
    output_.neighbours = neighbours;
    return *this;
  }
  Output &depth(std::uint16_t *depth) {
    output_.depth = depth;
    return *this;
  }
  Output &depth_m(float *depth_m) {
    output_.depth_m = depth_m;
    return *this;
  }
  Output &frames(float *frames) {
    output_.frames = frames;
    return *this;
  }
  Output &sigma(float *sigma) {
    output_.sigma = sigma;
    return *this;
  }

  const planish_output *c() const { return &output_; }

 private:
  planish_output output_ = {};
};

/// Contiguous values of a result, valid as long as the result lives.
template <typename T>
class Span {
 public:
  Span() = default;
  Span(const T *data, std::size_t size) : data_(data), size_(data ? size : 0) {}
  const T *data() const { return data_; }
  std::size_t size() const { return size_; }
  bool empty() const { return size_ == 0; }
  const T *begin() const { return data_; }
  const T *end() const { return data_ + size_; }
  const T &operator[](std::size_t i) const { return data_[i]; }

 private:
  const T *data_ = nullptr;
  std::size_t size_ = 0;
};

/// A result in the library's memory.
class Smoothed {
 public:
  Smoothed() = default;
  explicit Smoothed(planish_result *result) : result_(result) {
    // A new result always has a view.
    (void)planish_result_get(result_, &view_);
  }
  Smoothed(Smoothed &&other) noexcept { swap(other); }
  Smoothed &operator=(Smoothed &&other) noexcept {
    swap(other);
    return *this;
  }
  Smoothed(const Smoothed &) = delete;
  Smoothed &operator=(const Smoothed &) = delete;
  ~Smoothed() { (void)planish_result_free(result_); }

  std::size_t width() const { return view_.width; }
  std::size_t height() const { return view_.height; }
  std::size_t size() const { return view_.width * view_.height; }
  /// Returns x, y or z (axis 0, 1, 2) of the points.
  Span<float> points(int axis) const { return {view_.points[axis], size()}; }
  Span<float> normals(int axis) const { return {view_.normals[axis], size()}; }
  Span<float> curvature() const { return {view_.curvature, size()}; }
  Span<std::uint8_t> status() const { return {view_.status, size()}; }
  Span<std::uint32_t> neighbours() const { return {view_.neighbours, size()}; }
  Span<std::uint16_t> depth() const { return {view_.depth, size()}; }
  Span<float> depth_m() const { return {view_.depth_m, size()}; }
  Span<float> frames() const { return {view_.frames, size()}; }
  Span<float> sigma() const { return {view_.sigma, size()}; }

 private:
  void swap(Smoothed &other) {
    std::swap(result_, other.result_);
    std::swap(view_, other.view_);
  }

  planish_result *result_ = nullptr;
  planish_view view_ = {};
};

/// An engine that stays open for frames of any shape. Use it in one thread at a time.
class Session {
 public:
  /// Opens a session. Settings are words such as "preset=strong engine=cpu", or a JSON object. Without exceptions,
  /// check error().
  explicit Session(const std::string &settings = "") {
    error_ = Result(planish_session_new(settings.c_str(), &session_));
#ifndef PLANISH_NO_EXCEPTIONS
    detail::checked(error_);
#endif
  }
  Session(Session &&other) noexcept { swap(other); }
  Session &operator=(Session &&other) noexcept {
    swap(other);
    return *this;
  }
  Session(const Session &) = delete;
  Session &operator=(const Session &) = delete;
  ~Session() { (void)planish_session_free(session_); }

  /// Returns the error of the constructor.
  const Result &error() const { return error_; }

  /// Sets a setting by its name; an empty value restores the default.
  Checked set(const std::string &name, const std::string &value) {
    return detail::checked(Result(planish_session_set(session_, name.c_str(), value.c_str())));
  }
  Checked set(const std::string &name, const char *value) { return set(name, std::string(value)); }
  Checked set(const std::string &name, double value) {
    return detail::checked(Result(planish_session_set_number(session_, name.c_str(), value)));
  }
  Checked set(const std::string &name, int value) { return set(name, static_cast<double>(value)); }
  Checked set(const std::string &name, bool value) {
    return detail::checked(Result(planish_session_set_bool(session_, name.c_str(), value)));
  }

  /// Smooths a frame into the caller's buffers.
  Result try_smooth(const Frame &frame, const Output &output) {
    return frame.with_c([&](const planish_frame *c) { return Result(planish_smooth(session_, c, output.c())); });
  }
  Checked smooth(const Frame &frame, const Output &output) { return detail::checked(try_smooth(frame, output)); }

  /// Smooths a frame into a result in the library's memory; `outputs` is a sum of PLANISH_POINTS, PLANISH_NORMALS and
  /// so on.
  Result try_smooth(const Frame &frame, std::uint32_t outputs, Smoothed &smoothed) {
    return frame.with_c([&](const planish_frame *c) {
      planish_result *result = nullptr;
      Result done(planish_smooth_new(session_, c, outputs, &result));
      if (done) smoothed = Smoothed(result);
      return done;
    });
  }
#ifndef PLANISH_NO_EXCEPTIONS
  Smoothed smooth(const Frame &frame, std::uint32_t outputs = PLANISH_POINTS) {
    Smoothed smoothed;
    detail::checked(try_smooth(frame, outputs, smoothed));
    return smoothed;
  }
#endif

  /// Submits a frame; its result is received later, in the same order.
  Checked submit(const Frame &frame, std::uint32_t outputs) {
    return detail::checked(frame.with_c([&](const planish_frame *c) {
      return Result(planish_submit(session_, c, outputs));
    }));
  }
  /// Waits for the oldest frame in flight; `received` is false if no frame is in flight.
  Checked receive(const Output &output, bool &received) {
    return detail::checked(Result(planish_receive(session_, output.c(), &received)));
  }
  std::size_t in_flight() const { return flights().first; }
  std::size_t max_in_flight() const { return flights().second; }

  /// Stops another thread's smoothing of an unorganized cloud with this session.
  void stop() const { (void)planish_session_stop(session_); }
  /// Forgets all previous frames of the video.
  Checked restart_video() { return detail::checked(Result(planish_session_restart_video(session_))); }
  /// Sets the pose of the camera for the next frame of a video, in the world: x, y, z, then a quaternion w, x, y, z;
  /// null if the pose is unknown.
  Checked set_camera_pose(const double *pose) {
    return detail::checked(Result(planish_session_set_camera_pose(session_, pose)));
  }

  /// Returns the settings as JSON.
  std::string settings() const { return text(planish_session_settings); }
  /// Returns the name of the open engine, such as "cpu" or "gpu: NVIDIA H100".
  std::string engine() const { return text(planish_session_engine); }
  /// Returns and removes the session's events: its automatic decisions and findings, one sentence each.
  std::vector<std::string> take_events() {
    std::vector<std::string> events;
    for (;;) {
      std::size_t length = 0;
      if (planish_next_event(session_, nullptr, 0, &length) != PLANISH_OK || length == 0) return events;
      std::string event(length + 1, '\0');
      if (planish_next_event(session_, &event[0], event.size(), &length) != PLANISH_OK) return events;
      event.resize(length);
      events.push_back(std::move(event));
    }
  }

  /// Returns the C handle of the session.
  planish_session *c() const { return session_; }

 private:
  void swap(Session &other) {
    std::swap(session_, other.session_);
    std::swap(error_, other.error_);
  }

  std::pair<std::size_t, std::size_t> flights() const {
    std::pair<std::size_t, std::size_t> flights;
    (void)planish_in_flight(session_, &flights.first, &flights.second);
    return flights;
  }

  template <typename Function>
  std::string text(Function function) const {
    std::size_t length = 0;
    if (function(session_, nullptr, 0, &length) != PLANISH_OK) return "";
    std::string text(length + 1, '\0');
    if (function(session_, &text[0], text.size(), &length) != PLANISH_OK) return "";
    text.resize(length);
    return text;
  }

  planish_session *session_ = nullptr;
  Result error_;
};

/// Returns the version of the library.
inline std::string version() { return planish_version(); }

}  // namespace planish

#endif  // PLANISH_HPP
