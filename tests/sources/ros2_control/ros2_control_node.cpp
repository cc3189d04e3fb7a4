// A process like `ros2_control_node`: a controller's subscription stores commands that come from a
// sensor's timer, and a loop calls read(), update() and write() of the controller manager.
//
//   ros2_control_node TURNS PERIOD_US HOW
//
// HOW: "sleeps", "blocks" in read(), "blocks writing", "throws" in each tenth write(), or "busy", which
// takes two and a half periods in each tenth turn. It notes on its standard output, behind each turn:
// when read() was called, and had returned; when update() was called; when write() had returned (0: it
// threw); when the next turn was due; the stamp of the message that update() used (0: none had come).
//
// Times are ns of CLOCK_MONOTONIC. What has a lock around it is what a turn used without doubt: an
// update does not begin between the start of the subscription's callback and its storing.
#include <atomic>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <stdexcept>
#include <thread>

#include "controller_manager.hpp"
extern "C" {
#include "tracetools.h"
}

static int64_t clock_ns(clockid_t clock) {
  timespec now;
  clock_gettime(clock, &now);
  return now.tv_sec * 1000000000LL + now.tv_nsec;
}
static int64_t now() { return clock_ns(CLOCK_MONOTONIC); }
static void sleep_until(int64_t ns) {
  timespec time{ns / 1000000000, ns % 1000000000};
  clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &time, nullptr);
}

static int manager_node, controller_node, sensor_node, timer, timer_callback, subscription, reader;
static int storing, message, sensor_writer, sensor_publisher;
static const uint8_t gid[24] = {1};
static std::atomic<bool> over;

static void create(int64_t sensor_period) {
  ros_trace_rcl_init(&manager_node);
  ros_trace_rcl_node_init(&sensor_node, &sensor_node, "sensor", "/");
  ros_trace_rcl_node_init(&manager_node, &manager_node, "controller_manager", "/");
  ros_trace_rcl_node_init(&controller_node, &controller_node, "forward", "/");
  ros_trace_rmw_publisher_init(&sensor_writer, gid);
  ros_trace_rcl_publisher_init(&sensor_publisher, &sensor_node, &sensor_writer, "/commands", 7);
  ros_trace_rmw_subscription_init(&reader, gid);
  ros_trace_rcl_subscription_init(&subscription, &controller_node, &reader, "/commands", 7);
  ros_trace_rclcpp_subscription_init(&subscription, &reader);
  ros_trace_rclcpp_subscription_callback_added(&reader, &storing);
  ros_trace_rcl_timer_init(&timer, sensor_period);
  ros_trace_rclcpp_timer_callback_added(&timer, &timer_callback);
  ros_trace_rclcpp_timer_link_node(&timer, &sensor_node);
}

static void sense(controller_manager::ControllerManager & manager, int64_t period) {
  for (int64_t next = now(); !over; next += period) {
    sleep_until(next);
    ros_trace_callback_start(&timer_callback, false);
    const int64_t stamp = clock_ns(CLOCK_REALTIME);
    ros_trace_rclcpp_publish(nullptr, &message);
    ros_trace_rcl_publish(&sensor_publisher, &message);
    ros_trace_rmw_publish(&sensor_writer, &message, stamp);
    ros_trace_callback_end(&timer_callback);
    std::thread([&manager, stamp] {
      ros_trace_rmw_take(&reader, &message, stamp, true);
      ros_trace_rcl_take(&message);
      ros_trace_rclcpp_take(&message);
      const std::lock_guard<std::mutex> locked(manager.lock);
      ros_trace_callback_start(&storing, false);
      manager.stored = stamp;
      ros_trace_callback_end(&storing);
    }).join();
  }
}

extern "C" int run_node(int count, char ** words) {
  if (count != 4) return 2;
  const int turns = std::atoi(words[1]);
  const int64_t period = std::atoll(words[2]) * 1000;
  const bool blocks = !std::strcmp(words[3], "blocks"), busy = !std::strcmp(words[3], "busy");
  const bool writing = !std::strcmp(words[3], "blocks writing");
  const bool throws = !std::strcmp(words[3], "throws");
  const int64_t sensor_period = blocks ? 3 * period / 2 : 3 * period / 4;
  create(sensor_period);
  controller_manager::ControllerManager manager("/controller_manager");
  std::thread sensor(sense, std::ref(manager), sensor_period);
  std::thread loop([&] {
    int64_t next = now() + period;
    sleep_until(next);
    for (int turn = 0; turn < turns; turn++) {
      manager.device_ns = blocks ? now() + period : 0;
      manager.writing_ns = writing ? now() + period : 0;
      manager.throws = throws && turn % 10 == 9;
      const rclcpp::Time time{turn};
      const rclcpp::Duration duration{period};
      const int64_t began = now();
      manager.read(time, duration);
      const int64_t end = now();
      int64_t updated;
      {
        const std::lock_guard<std::mutex> locked(manager.lock);
        updated = now();
        const auto result = manager.update(time, duration);
        const bool failed = result != controller_interface::return_type::OK;
        if (failed != (manager.used % 2 != 0)) std::abort();
      }
      if (busy && turn % 10 == 9) {
        const int64_t until = now() + 5 * period / 2;
        while (now() < until) continue;
      }
      bool thrown = false;
      try {
        manager.write(time, duration);
      } catch (const std::runtime_error &) {
        thrown = true;
      }
      const int64_t written = now();
      for (int64_t argument : manager.times)
        if (argument != turn + period) std::abort();
      if (thrown != manager.throws) std::abort();
      next += period;
      for (int64_t noted : {began, end, updated, thrown ? 0 : written, next, manager.used})
        std::printf("%lld ", static_cast<long long>(noted));
      std::printf("turn\n");
      if (busy && next < written) next += (written - next + period - 1) / period * period;
      if (!blocks && !writing) sleep_until(next);
    }
  });
  loop.join();
  over = true;
  sensor.join();
  return 0;
}

#ifndef PLUGIN
int main(int count, char ** words) { return run_node(count, words); }
#endif
