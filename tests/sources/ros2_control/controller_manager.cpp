#include "controller_manager.hpp"

#include <ctime>
#include <stdexcept>

static void wait_until(int64_t ns) {
  // By a clock that no sleep of the loop is on, as a device has its own; in slices, so that it is no
  // sleep of the thread that says until when.
  timespec time{ns / 1000000000, ns % 1000000000};
  if (ns) clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &time, nullptr);
}

static void compute() {
  timespec used;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &used);
  const int64_t until = used.tv_sec * 1000000000LL + used.tv_nsec + 100000;
  while (used.tv_sec * 1000000000LL + used.tv_nsec < until)
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &used);
}

#ifndef WITHOUT_NAME
const char * rclcpp::Node::get_fully_qualified_name() const { return name_.c_str(); }
#endif

namespace controller_manager {
void ControllerManager::read(const rclcpp::Time & time, const rclcpp::Duration & period) {
  times[0] = time.ns + period.ns;
  wait_until(device_ns);
  compute();
}

controller_interface::return_type ControllerManager::update(
  const rclcpp::Time & time, const rclcpp::Duration & period) {
  times[1] = time.ns + period.ns;
  used = stored;
  compute();
  return used % 2 ? controller_interface::return_type::ERROR
                  : controller_interface::return_type::OK;
}

void ControllerManager::write(const rclcpp::Time & time, const rclcpp::Duration & period) {
  times[2] = time.ns + period.ns;
  compute();
  wait_until(writing_ns);
  written = used;
  if (throws) throw std::runtime_error("the hardware is gone");
}
}  // namespace controller_manager
