// Makes a publication take the same time in every cycle: it is rehearsed, idle cores do not sleep,
// and the core where the output is delivered is clear of other work
// (chainshaper/robot/clear_core.py). Readiness of chainshaper's Python node is the same, and says
// why.

#pragma once

#include <arpa/inet.h>
#include <netinet/in.h>
#include <pthread.h>
#include <semaphore.h>
#include <sys/socket.h>

#include <atomic>
#include <thread>

#include "node.hpp"

namespace chainshaper {

// Clears a core of ordinary threads: a thread of SCHED_FIFO 1 runs there while an output is
// delivered. Where SCHED_FIFO or the core is refused, it does nothing.
class ClearCore {
public:
  explicit ClearCore(std::int64_t core) {
    sem_init(&more_, 0, 0);
    thread_ = std::thread([this, core] { clear(core); });
  }

  ~ClearCore() {
    clear_until(over);
    thread_.join();
    sem_destroy(&more_);
  }

  void clear_until(std::int64_t until_ns) {
    until_ns_ = until_ns;
    sem_post(&more_);
  }

private:
  static constexpr std::int64_t over = -1;

  void clear(std::int64_t core) {
    pthread_setname_np(pthread_self(), "clear_core");
    if (!set_fifo(1) || !set_core(core)) return;
    for (;;) {
      while (sem_wait(&more_) != 0) continue;  // a signal ended the wait early
      if (until_ns_ == over) return;
      watch_until(until_ns_);
    }
  }

  sem_t more_{};  // posted with each new time
  std::atomic<std::int64_t> until_ns_{0};
  std::thread thread_;
};

class Readiness {
public:
  // The core is where the output is delivered, for `pause_ns` after it was published.
  Readiness(rclcpp::Node & node, Maybe delivery_core, std::int64_t pause_ns)
      : pause_ns_(pause_ns),
        rehearsal_(node.create_generic_publisher(  // of all shaping nodes; the underscore hides it
            "/_chainshaper_rehearsal", "std_msgs/msg/Empty", rclcpp::QoS(1))),
        empty_(serialized_empty.size()),
        to_itself_(File(socket(AF_INET, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0))),
        latency_(File(open("/dev/cpu_dma_latency", O_WRONLY | O_CLOEXEC))) {
    if (!latency_.is_open())
      RCLCPP_WARN(node.get_logger(),
                  "/dev/cpu_dma_latency: %s: idle cores sleep, and deliver less "
                  "regularly; run as root, or give the user the right to write it",
                  std::strerror(errno));
    if (delivery_core) delivery_core_.emplace(*delivery_core);
    auto & message = empty_.get_rcl_serialized_message();
    std::memcpy(message.buffer, serialized_empty.data(), serialized_empty.size());
    message.buffer_length = serialized_empty.size();
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    socklen_t length = sizeof(address);
    auto * const general = reinterpret_cast<sockaddr *>(&address);
    const int number = to_itself_.number();
    connected_ = bind(number, general, length) == 0 && getsockname(number, general, &length) == 0 &&
                 connect(number, general, length) == 0;
  }

  // Prepares a publication at that time: asks cores not to sleep, clears the core where the output
  // is delivered, and rehearses the way of a message through DDS and the network.
  void get_ready(std::int64_t release_ns) {
    ask_for(0);
    if (delivery_core_) delivery_core_->clear_until(release_ns + pause_ns_);
    for (int repetition = 0; repetition < 2; ++repetition) {  // the first loads caches
      if (monotonic_ns() > release_ns - rehearsal_ns) return;
      rehearsal_->publish(empty_);
      if (connected_ && to_itself_.is_open()) {
        std::array<std::uint8_t, serialized_empty.size()> received{};
        [[maybe_unused]] auto bytes =
            send(to_itself_.number(), serialized_empty.data(), serialized_empty.size(), 0);
        bytes = recv(to_itself_.number(), received.data(), received.size(), 0);
      }
    }
  }

  // Asks the kernel for cores that wake up within so many us; -1: they may sleep as they like.
  void ask_for(std::int32_t latency_us = -1) const {
    if (latency_.is_open()) [[maybe_unused]]
      const auto written = write(latency_.number(), &latency_us, sizeof(latency_us));
  }

private:
  static constexpr std::array<std::uint8_t, 5> serialized_empty{0, 1, 0, 0, 0};
  // No rehearsal begins later than this before a release: the first may take most of this time.
  static constexpr std::int64_t rehearsal_ns = 400'000;

  std::int64_t pause_ns_;
  std::optional<ClearCore> delivery_core_;
  rclcpp::GenericPublisher::SharedPtr rehearsal_;
  rclcpp::SerializedMessage empty_;
  File to_itself_;
  bool connected_ = false;
  File latency_;
};

}  // namespace chainshaper
