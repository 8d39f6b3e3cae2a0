// A component that smooths depth images in the process of the camera's node, without a second process or a copy over
// the network.
#include <memory>
#include <mutex>
#include <rclcpp/rclcpp.hpp>
#include <rclcpp_components/register_node_macro.hpp>
#include <sensor_msgs/msg/camera_info.hpp>
#include <sensor_msgs/msg/image.hpp>

#include "smooth_depth.hpp"

namespace planish_component {

class Smoother : public rclcpp::Node {
 public:
  explicit Smoother(const rclcpp::NodeOptions &options)
      : Node("planish", options), session_(declare_parameter<std::string>("settings", "preset=default")) {
    const auto qos = rclcpp::SensorDataQoS();
    publisher_ = create_publisher<sensor_msgs::msg::Image>("~/image_smoothed", qos);
    info_ = create_subscription<sensor_msgs::msg::CameraInfo>(
        "camera_info", qos, [this](sensor_msgs::msg::CameraInfo::ConstSharedPtr info) {
          const std::lock_guard<std::mutex> lock(mutex_);
          camera_ = std::move(info);
        });
    image_ = create_subscription<sensor_msgs::msg::Image>(
        "image", qos, [this](sensor_msgs::msg::Image::UniquePtr image) { smooth(std::move(image)); });
  }

 private:
  void smooth(sensor_msgs::msg::Image::UniquePtr image) {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (!camera_) return;
    const auto &p = camera_->p;
    const double intrinsics[4] = {p[0], p[5], p[2], p[6]};
    auto out = std::make_unique<sensor_msgs::msg::Image>();
    const std::string problem = smooth_depth(session_, image->encoding, image->width, image->height, image->step,
                                             image->data, intrinsics, out->data);
    if (!problem.empty()) {
      RCLCPP_WARN_THROTTLE(get_logger(), *get_clock(), 5000, "%s", problem.c_str());
      return;
    }
    out->header = image->header;
    out->height = image->height;
    out->width = image->width;
    out->encoding = image->encoding;
    out->step = static_cast<std::uint32_t>(out->data.size() / image->height);
    publisher_->publish(std::move(out));
    for (const auto &event : session_.take_events()) RCLCPP_INFO(get_logger(), "%s", event.c_str());
  }

  std::mutex mutex_;
  planish::Session session_;
  sensor_msgs::msg::CameraInfo::ConstSharedPtr camera_;
  rclcpp::Publisher<sensor_msgs::msg::Image>::SharedPtr publisher_;
  rclcpp::Subscription<sensor_msgs::msg::CameraInfo>::SharedPtr info_;
  rclcpp::Subscription<sensor_msgs::msg::Image>::SharedPtr image_;
};

}  // namespace planish_component

RCLCPP_COMPONENTS_REGISTER_NODE(planish_component::Smoother)
