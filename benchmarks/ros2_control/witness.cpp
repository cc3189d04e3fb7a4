// Hardware that notes for each turn of ros2_control when write() was called, with which command.
//
// It is the ground truth of the benchmark: a command is the instant (CLOCK_MONOTONIC, ns) at which
// its chain began, so what a note has is an age that nothing of chainshaper has measured. Where the
// description says so, read() blocks until the next tick of the hardware's own clock.

// Some headers of hardware_interface use these two without including them, so they come first.
// clang-format off
#include <cxxabi.h>
#include "rclcpp/rclcpp.hpp"
// clang-format on

#include <cerrno>
#include <cstdint>
#include <cstdlib>
#include <ctime>
#include <fstream>
#include <string>
#include <vector>

#include "hardware_interface/system_interface.hpp"
#include "pluginlib/class_list_macros.hpp"

namespace chainshaper_benchmark {

using hardware_interface::CallbackReturn;
using hardware_interface::return_type;

class Witness : public hardware_interface::SystemInterface {
public:
  CallbackReturn on_init(
      const hardware_interface::HardwareComponentInterfaceParams & params) override {
    const auto result = SystemInterface::on_init(params);
    const auto & given = info_.hardware_parameters;
    if (const auto tick = given.find("tick_ns"); tick != given.end())
      tick_ns_ = std::stoll(tick->second);
    position_ = info_.joints.at(0).name + "/position";
    notes_.reserve(kMostNotes);
    return result;
  }

  CallbackReturn on_activate(const rclcpp_lifecycle::State &) override {
    set_state(position_, 0.0);
    set_command(position_, 0.0);
    next_ns_ = now_ns() + tick_ns_;
    return CallbackReturn::SUCCESS;
  }

  // The notes are written where no turn can be delayed by it any more.
  CallbackReturn on_deactivate(const rclcpp_lifecycle::State &) override {
    const char * folder = std::getenv("WITNESS_NOTES");
    if (folder != nullptr && !notes_.empty()) {
      const std::string name = std::to_string(notes_.front().write_ns) + ".notes";
      std::ofstream file(std::string(folder) + "/" + name, std::ios::binary);
      file.write(reinterpret_cast<const char *>(notes_.data()),
                 static_cast<std::streamsize>(notes_.size() * sizeof(Note)));
    }
    notes_.clear();
    return CallbackReturn::SUCCESS;
  }

  return_type read(const rclcpp::Time &, const rclcpp::Duration &) override {
    if (tick_ns_ == 0) return return_type::OK;
    const timespec until{next_ns_ / kSecond, next_ns_ % kSecond};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, nullptr) == EINTR) {
    }
    // A tick that has passed meanwhile is lost, as a cycle of a field bus is.
    const std::int64_t late = now_ns() - next_ns_;
    next_ns_ += tick_ns_ * (1 + late / tick_ns_);
    return return_type::OK;
  }

  return_type write(const rclcpp::Time &, const rclcpp::Duration &) override {
    if (notes_.size() < kMostNotes) {
      const auto began = static_cast<std::int64_t>(get_command(position_));
      notes_.push_back({now_ns(), began});
    }
    return return_type::OK;
  }

private:
  struct Note {
    std::int64_t write_ns;
    std::int64_t began_ns;
  };

  static constexpr std::int64_t kSecond = 1'000'000'000;
  static constexpr std::size_t kMostNotes = 4'000'000;  // more than an hour at 1 kHz

  static std::int64_t now_ns() {
    timespec now{};
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * kSecond + now.tv_nsec;
  }

  std::int64_t tick_ns_ = 0;
  std::int64_t next_ns_ = 0;
  std::string position_;
  std::vector<Note> notes_;
};

}  // namespace chainshaper_benchmark

PLUGINLIB_EXPORT_CLASS(chainshaper_benchmark::Witness, hardware_interface::SystemInterface)
