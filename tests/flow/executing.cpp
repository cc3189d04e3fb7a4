// A process whose callbacks note which origin each of their instances handled, on which thread and
// when; messages carry the number of their origin in `frame_id`:
//
//   executing LOG EXECUTOR line|join PERIOD_MS LEAST_MS MOST_MS compute|sleep
//   executing LOG EXECUTOR stage PERIOD_MS LEAST_MS MOST_MS compute|sleep CALLBACK INPUT|- OUTPUT
//   executing LOG EXECUTOR sink
//   executing LOG EXECUTOR known   (exit code 1: this rclcpp has no such executor)
//
// line: a timer → /begun → /worked → /done; the second callback is in a reentrant group, the others
// in one of their own; the last works for a tenth of the time. join: the timer publishes /left and /right, and the callback that gets the
// second message of an origin works and publishes /done, without the lock of its sets. stage: one
// callback of a line, a timer without an input.
#include <sys/syscall.h>
#include <unistd.h>

#include <cstdlib>
#include <ctime>
#include <fstream>
#include <iostream>
#include <memory>
#include <mutex>
#include <random>
#include <set>
#include <string>
#include <thread>
#include <vector>

#include "geometry_msgs/msg/point_stamped.hpp"
#include "rclcpp/experimental/executors/events_executor/events_executor.hpp"
#include "rclcpp/rclcpp.hpp"
#include "rclcpp/version.h"
#if RCLCPP_VERSION_GTE(32, 0, 0)  // Lyrical
#include "rclcpp/executors/events_cbg_executor/events_cbg_executor.hpp"
#endif

using Message = geometry_msgs::msg::PointStamped;
using Group = rclcpp::CallbackGroup::SharedPtr;
using rclcpp::experimental::executors::EventsExecutor;
using rclcpp::experimental::executors::SimpleEventsQueue;

long long now_ns(clockid_t clock) {
  timespec now;
  clock_gettime(clock, &now);
  return now.tv_sec * 1'000'000'000LL + now.tv_nsec;
}

// One line an instance: callback, thread, origin, began, just before and behind publishing.
struct Notes {
  explicit Notes(const std::string& file) : out{file} {}
  void add(const char* callback, const std::string& origin, long long began, long long before, long long behind) {
    const std::lock_guard<std::mutex> alone{mutex};
    out << callback << " " << syscall(SYS_gettid) << " " << origin << " " << began << " " << before << " " << behind
        << std::endl;  // at once: a process that dies as it ends has noted all
  }
  std::ofstream out;
  std::mutex mutex;
};

class Worker : public rclcpp::Node {
 public:
  Worker(const std::vector<std::string>& words, Notes& notes) : Node("worker"), notes_(notes) {
    const bool apart = words[2] == "groups";
    for (const auto type : {rclcpp::CallbackGroupType::MutuallyExclusive, rclcpp::CallbackGroupType::Reentrant,
                            rclcpp::CallbackGroupType::MutuallyExclusive}) {
      groups.push_back(create_callback_group(type, !apart));
    }
    if (words[3] == "sink") {
      subscribe("sink", "/done", groups[0], {});
      return;
    }
    time_ms_ = std::uniform_real_distribution<double>(std::stod(words[5]), std::stod(words[6]));
    sleeps_ = words[7] == "sleep";
    const bool line = words[3] == "line", stage = words[3] == "stage";
    if (stage && words[9] != "-") {
      name_ = words[8];
      subscribe(name_.c_str(), words[9].c_str(), groups[0], publishers({words[10]}));
      return;
    }
    const auto outputs = line ? publishers({"/begun"}) : publishers(stage ? Topics{words[10]} : Topics{"/left", "/right"});
    timer_ = create_wall_timer(std::chrono::milliseconds(std::stoi(words[4])), [this, outputs] {
      Message begun;
      const auto began = now_ns(CLOCK_MONOTONIC);
      begun.header.stamp = now();
      begun.header.frame_id = std::to_string(origin_++);
      publish("timer", begun, began, outputs);
    }, groups[0]);
    if (line) {
      subscribe("work", "/begun", groups[1], publishers({"/worked"}));
      subscribe("last", "/worked", groups[2], publishers({"/done"}));
    } else if (!stage) {
      const auto done = publishers({"/done"});
      subscribe("left", "/left", groups[1], done, true);
      subscribe("right", "/right", groups[1], done, true);
    }
  }
  std::vector<Group> groups;

 private:
  using Outputs = std::vector<rclcpp::Publisher<Message>::SharedPtr>;
  using Topics = std::vector<std::string>;

  Outputs publishers(const Topics& topics) {
    Outputs found;
    for (const auto& topic : topics) found.push_back(create_publisher<Message>(topic, 50));
    return found;
  }

  void subscribe(const char* name, const char* topic, const Group& group, const Outputs& outputs, bool joins = false) {
    rclcpp::SubscriptionOptions options;
    options.callback_group = group;
    inputs_.push_back(create_subscription<Message>(topic, 50, [this, name, outputs, joins](const Message& message) {
      const auto began = now_ns(CLOCK_MONOTONIC);
      if (joins) {
        const std::lock_guard<std::mutex> alone{mutex_};
        if (waiting_.insert(message.header.frame_id).second) {
          notes_.add(name, message.header.frame_id, began, 0, 0);
          return;
        }
        waiting_.erase(message.header.frame_id);
      }
      publish(name, message, began, outputs);
    }, options));
  }

  void publish(const char* name, const Message& message, long long began, const Outputs& outputs) {
    if (outputs.size() == 1) spend(name == std::string{"last"} ? 0.1 : 1);
    const auto before = now_ns(CLOCK_MONOTONIC);
    for (const auto& output : outputs) output->publish(message);
    notes_.add(name, message.header.frame_id, began, before, now_ns(CLOCK_MONOTONIC));
  }

  void spend(double share) {
    thread_local std::mt19937 random{std::random_device{}()};
    auto time = time_ms_;
    const auto ns = static_cast<long long>(share * time(random) * 1e6);
    if (sleeps_) {
      std::this_thread::sleep_for(std::chrono::nanoseconds(ns));
      return;
    }
    const auto end = now_ns(CLOCK_THREAD_CPUTIME_ID) + ns;
    while (now_ns(CLOCK_THREAD_CPUTIME_ID) < end) {
    }
  }

  Notes& notes_;
  std::uniform_real_distribution<double> time_ms_;
  bool sleeps_ = false;
  std::string name_;
  int origin_ = 0;
  std::mutex mutex_;
  std::set<std::string> waiting_;
  rclcpp::TimerBase::SharedPtr timer_;
  std::vector<rclcpp::SubscriptionBase::SharedPtr> inputs_;
};

std::unique_ptr<rclcpp::Executor> executor_of(const std::string& name) {
  const rclcpp::ExecutorOptions usual;
  if (name == "single") return std::make_unique<rclcpp::executors::SingleThreadedExecutor>();
  if (name == "multi") return std::make_unique<rclcpp::executors::MultiThreadedExecutor>(usual, 4);
  if (name == "events") return std::make_unique<EventsExecutor>();
#if RCLCPP_VERSION_GTE(32, 0, 0)
  if (name == "cbg") return std::make_unique<rclcpp::executors::EventsCBGExecutor>(usual, 3);
  if (name == "events-timers")
    return std::make_unique<EventsExecutor>(usual, std::make_unique<SimpleEventsQueue>(), true);
#else
  if (name == "static") return std::make_unique<rclcpp::executors::StaticSingleThreadedExecutor>();
  if (name == "events-timers") return std::make_unique<EventsExecutor>(std::make_unique<SimpleEventsQueue>(), true);
#endif
  std::cerr << "this rclcpp has no executor " << name << std::endl;
  std::exit(1);
}

int main(int argc, char** argv) {
  const auto words = rclcpp::init_and_remove_ros_arguments(argc, argv);
  if (words[3] == "known") {
    if (words[2] != "groups") executor_of(words[2]);
    return 0;
  }
  Notes notes{words[1]};
  const auto node = std::make_shared<Worker>(words, notes);
  std::vector<std::unique_ptr<rclcpp::Executor>> executors;
  if (words[2] == "groups") {  // each with an executor and a thread of its own
    std::vector<std::thread> threads;
    for (const auto& group : node->groups) {
      executors.push_back(executor_of("single"));
      executors.back()->add_callback_group(group, node->get_node_base_interface());
      threads.emplace_back([executor = executors.back().get()] { executor->spin(); });
    }
    for (auto& thread : threads) thread.join();
  } else {
    executors.push_back(executor_of(words[2]));
    executors.back()->add_node(node);
    executors.back()->spin();
  }
  rclcpp::shutdown();
}
