// ros2_control's controller manager as the tracing library sees it: the names that the compiler gives
// its functions are those of ros2_control 2.8 to 6.8, and it is a node of rclcpp.
#pragma once
#include <cstdint>
#include <mutex>
#include <string>

namespace rclcpp {
class Time {
 public:
  int64_t ns;
};
class Duration {
 public:
  int64_t ns;
};
class Node {
 public:
  explicit Node(std::string name) : name_(std::move(name)) {}
  virtual ~Node() = default;
#ifndef WITHOUT_NAME
  const char * get_fully_qualified_name() const;
#endif

 private:
  std::string name_;
};
}  // namespace rclcpp

namespace controller_interface {
enum class return_type : std::uint8_t { OK = 0, ERROR = 1 };
}

namespace controller_manager {
class ControllerManager : public rclcpp::Node {
 public:
  using rclcpp::Node::Node;
  void read(const rclcpp::Time & time, const rclcpp::Duration & period);
  controller_interface::return_type update(const rclcpp::Time & time, const rclcpp::Duration & period);
  void write(const rclcpp::Time & time, const rclcpp::Duration & period);

  std::mutex lock;         // of what a controller's subscription stores
  int64_t stored = 0;      // the stamp of its newest message
  int64_t device_ns = 0;   // read() waits until then; 0: there is nothing to wait for
  int64_t writing_ns = 0;  // write() waits until then
  int64_t used = 0;        // what update() read
  int64_t written = 0;     // what write() gave to the hardware
  int64_t times[3] = {};   // the arguments that came, of the last turn
  bool throws = false;     // write() does
};
}  // namespace controller_manager
