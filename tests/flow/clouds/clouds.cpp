// A chain that hands on one point cloud of 4 MB: Source -> /raw -> Filter -> /points -> Sink. The
// filter writes the addresses of the message and of its data into it; the sink compares them with
// what it gets, and says with how many large allocations of the process each message came.

#include <dlfcn.h>
#include <time.h>

#include <cinttypes>
#include <memory>
#include <random>
#include <string>

#include "rclcpp/rclcpp.hpp"
#include "rclcpp_components/register_node_macro.hpp"
#include "sensor_msgs/msg/point_cloud2.hpp"

namespace clouds {

using Cloud = sensor_msgs::msg::PointCloud2;

std::string addresses(const Cloud & cloud) {
  char text[64];
  std::snprintf(text, sizeof(text), "%p %p", static_cast<const void *>(&cloud),
                static_cast<const void *>(cloud.data.data()));
  return text;
}

void compute(double milliseconds) {
  timespec now{};
  const auto used = [&] {
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return now.tv_sec * 1e3 + now.tv_nsec / 1e6;
  };
  const double until = used() + milliseconds;
  while (used() < until) continue;
}

class Source : public rclcpp::Node {
public:
  explicit Source(const rclcpp::NodeOptions & options) : Node("source", options) {
    publisher_ = create_publisher<Cloud>("raw", 5);
    timer_ = create_wall_timer(std::chrono::milliseconds(100), [this] {
      auto cloud = std::make_unique<Cloud>();
      cloud->header.stamp = now();
      cloud->data.resize(4'000'000);
      publisher_->publish(std::move(cloud));
    });
  }

private:
  rclcpp::Publisher<Cloud>::SharedPtr publisher_;
  rclcpp::TimerBase::SharedPtr timer_;
};

class Filter : public rclcpp::Node {
public:
  explicit Filter(const rclcpp::NodeOptions & options) : Node("filter", options) {
    publisher_ = create_publisher<Cloud>("points", 5);
    subscription_ = create_subscription<Cloud>("raw", 5, [this](std::unique_ptr<Cloud> cloud) {
      compute(milliseconds_(random_));
      cloud->header.frame_id = addresses(*cloud);
      publisher_->publish(std::move(cloud));
    });
  }

private:
  std::mt19937 random_{1};
  std::uniform_real_distribution<> milliseconds_{5.0, 25.0};
  rclcpp::Publisher<Cloud>::SharedPtr publisher_;
  rclcpp::Subscription<Cloud>::SharedPtr subscription_;
};

class Sink : public rclcpp::Node {
public:
  explicit Sink(const rclcpp::NodeOptions & options) : Node("sink", options) {
    const auto large = reinterpret_cast<std::uint64_t (*)()>(dlsym(RTLD_DEFAULT, "large"));
    subscription_ = create_subscription<Cloud>(
        "points", 5, [this, large](std::unique_ptr<Cloud> cloud) {
          const bool same = cloud->header.frame_id == addresses(*cloud);
          std::printf("cloud %s, %" PRIu64 " large allocations\n", same ? "same" : "copied",
                      large == nullptr ? 0 : large());
          std::fflush(stdout);
        });
  }

private:
  rclcpp::Subscription<Cloud>::SharedPtr subscription_;
};

}  // namespace clouds

RCLCPP_COMPONENTS_REGISTER_NODE(clouds::Source)
RCLCPP_COMPONENTS_REGISTER_NODE(clouds::Filter)
RCLCPP_COMPONENTS_REGISTER_NODE(clouds::Sink)
