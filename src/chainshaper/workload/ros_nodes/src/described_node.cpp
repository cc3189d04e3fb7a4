// One node of the described application: described_node NAME SEED START_NS true|false
//
// Timers expire first at START_NS of CLOCK_MONOTONIC and their phase, late ones whole periods
// later. With `true` threads get the described cores and SCHED_FIFO priorities.
#include <sched.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <chrono>
#include <cstdio>
#include <cstring>
#include <deque>
#include <filesystem>
#include <fstream>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "application.hpp"
#if __has_include("message_filters/subscriber.hpp")
#include "message_filters/subscriber.hpp"
#else
#include "message_filters/subscriber.h"
#endif
#include "rclcpp/rclcpp.hpp"
#include "sensor_msgs/msg/compressed_image.hpp"
#include "std_msgs/msg/string.hpp"

using Data = sensor_msgs::msg::CompressedImage;  // a header and bytes
using Filter = message_filters::Subscriber<Data>;
using Stamp = builtin_interfaces::msg::Time;
using Text = std_msgs::msg::String;

std::int64_t used_ns() { return clock_ns(CLOCK_THREAD_CPUTIME_ID); }

rclcpp::QoS quality(const Topic & topic, bool lasting = false) {
  rclcpp::QoS qos{topic.depth};
  if (lasting && topic.lifespan_ns > 0)
    qos.lifespan(rclcpp::Duration::from_nanoseconds(topic.lifespan_ns));
  return topic.reliable ? qos.reliable() : qos.best_effort();
}

void require(bool done, const std::string & what) {
  if (!done) {
    throw std::runtime_error{what + " is refused (" + std::strerror(errno) +
                             "): permit it, or launch with scheduling:=false"};
  }
}

void stay_on(pid_t thread, const std::vector<int> & wanted) {
  std::vector<cpu_set_t> cores(8);  // of 1024 each
  std::string said = "core";
  for (const int core : wanted) {
    CPU_SET_S(core, cores.size() * sizeof(cpu_set_t), cores.data());
    said += " " + std::to_string(core);
  }
  require(sched_setaffinity(thread, cores.size() * sizeof(cpu_set_t), cores.data()) == 0, said);
}

std::vector<int> cores_in_turn;  // for threads of the executor, each at its first callback

void take_core() {
  static std::atomic<std::size_t> next{0};
  thread_local bool taken = false;
  if (taken || cores_in_turn.empty()) return;
  taken = true;
  stay_on(0, {cores_in_turn[next++ % cores_in_turn.size()]});
}

// What a callback does: spend its time, pass a stamp on to all its topics, and spend what it takes
// afterwards. Several threads may at once, for callbacks of a reentrant group.
class Work {
public:
  Work(rclcpp::Node & node, const Callback & described, ExecutionTimes times,
       ExecutionTimes afterwards)
      : times_{std::move(times)},
        afterwards_{std::move(afterwards)},
        announces_{described.announces} {
    for (const auto & topic : described.outputs) {
      if (announces_.empty()) {
        outputs_.push_back(node.create_publisher<Data>(topic.name, quality(topic, true)));
        messages_.emplace_back().data.resize(topic.payload);
      } else {  // the one topic of modes, also for who comes later
        modes_ = node.create_publisher<Text>(topic.name, quality(topic, true).transient_local());
      }
    }
  }

  void run(const Stamp & stamp, std::int64_t since_ns) {
    take_core();
    std::unique_lock<std::mutex> alone{mutex_};
    const auto cpu_ns = times_.next(), afterwards_ns = afterwards_.next();
    auto messages = messages_;
    Text mode;
    if (modes_) mode.data = announces_[turn_++ % announces_.size()];
    alone.unlock();
    for (auto & message : messages) message.header.stamp = stamp;
    spend(cpu_ns, since_ns);
    for (std::size_t i = 0; i < outputs_.size(); ++i) outputs_[i]->publish(messages[i]);
    if (modes_) modes_->publish(mode);
    spend(afterwards_ns, used_ns());
  }

private:
  ExecutionTimes times_, afterwards_;
  std::vector<std::string> announces_;
  std::vector<rclcpp::Publisher<Data>::SharedPtr> outputs_;
  std::vector<Data> messages_;
  rclcpp::Publisher<Text>::SharedPtr modes_;
  std::size_t turn_{0};
  std::mutex mutex_;
};

// `subscribe` takes another type of QoS from Kilted on; a template, for only one of them compiles.
template <typename F>
void subscribe(F & filter, rclcpp::Node * node, const Topic & input,
               const rclcpp::SubscriptionOptions & options) {
  if constexpr (std::is_constructible_v<F, rclcpp::Node *, std::string, rclcpp::QoS>)
    filter.subscribe(node, input.name, quality(input), options);
  else
    filter.subscribe(node, input.name, quality(input).get_rmw_qos_profile(), options);
}

// Works for a set of the oldest message of every input, with the stamp of the first input's; with a
// trigger, for each message of that input, with the newest of the others, which are kept.
class Synchroniser {
public:
  Synchroniser(rclcpp::Node * node, const std::vector<Topic> & inputs, int trigger,
               std::shared_ptr<Work> work, const rclcpp::SubscriptionOptions & options)
      : inputs_{inputs}, trigger_{trigger}, waiting_(inputs.size()), work_{std::move(work)} {
    for (std::size_t i = 0; i < inputs.size(); ++i) {
      filters_.push_back(std::make_unique<Filter>());
      filters_[i]->registerCallback(std::function<void(const Data::ConstSharedPtr &)>(
          [this, i](const Data::ConstSharedPtr & message) { add(i, message->header.stamp); }));
      subscribe(*filters_[i], node, inputs[i], options);
    }
  }

private:
  void add(std::size_t i, const Stamp & stamp) {
    const auto since_ns = used_ns();
    std::unique_lock<std::mutex> alone{mutex_};
    waiting_[i].push_back(stamp);
    if (waiting_[i].size() > inputs_[i].depth) waiting_[i].pop_front();
    const bool all_there = std::none_of(waiting_.begin(), waiting_.end(),
                                        [](const auto & stamps) { return stamps.empty(); });
    std::optional<Stamp> first;  // of a set
    if (trigger_ >= 0) {
      const auto trigger = static_cast<std::size_t>(trigger_);
      if (all_there && i == trigger) first = waiting_[0].back();
      waiting_[trigger].clear();
    } else if (all_there) {
      first = waiting_[0].front();
      for (auto & stamps : waiting_) stamps.pop_front();
    }
    alone.unlock();
    if (first) work_->run(*first, since_ns);
  }

  std::vector<Topic> inputs_;
  int trigger_;
  std::vector<std::deque<Stamp>> waiting_;
  std::shared_ptr<Work> work_;
  std::vector<std::unique_ptr<Filter>> filters_;
  std::mutex mutex_;
};

using Timer = std::pair<std::int64_t, rclcpp::TimerBase::SharedPtr>;  // when it is armed

class DescribedNode : public rclcpp::Node {
public:
  DescribedNode(const Described & described, std::uint64_t seed, std::int64_t start_ns)
      : Node{described.name.substr(described.name.rfind('/') + 1),
             described.name.substr(0, described.name.rfind('/'))} {
    const auto number = static_cast<std::uint32_t>(&described - application.data());
    std::uint32_t index = 0;
    for (const auto & callback : described.callbacks) {
      constexpr std::uint32_t first_after = 1 << 16;  // as in the live workload and the simulator
      ExecutionTimes times{callback.execution, seed, number, index};
      ExecutionTimes afterwards{callback.afterwards, seed, number, first_after + index++};
      const auto work =
          std::make_shared<Work>(*this, callback, std::move(times), std::move(afterwards));
      rclcpp::SubscriptionOptions options;
      options.callback_group = group_of(callback);
      const auto & inputs = callback.inputs;
      if (callback.period_ns > 0) {
        add_timer(callback, work, start_ns);
      } else if (inputs.size() > 1) {
        synchronisers_.push_back(
            std::make_unique<Synchroniser>(this, inputs, callback.trigger, work, options));
      } else {
        const auto run = [work](const Data & message) {
          work->run(message.header.stamp, used_ns());
        };
        const auto qos = quality(inputs[0]);
        subscriptions_.push_back(create_subscription<Data>(inputs[0].name, qos, run, options));
      }
    }
  }

  // Let every timer begin when it is due; what arrives before is worked on.
  void start(rclcpp::Executor & executor) {
    std::sort(timers_.begin(), timers_.end());
    for (const auto & [armed_ns, timer] : timers_) {
      while (rclcpp::ok() && clock_ns(CLOCK_MONOTONIC) < armed_ns)
        executor.spin_once(std::chrono::nanoseconds{armed_ns - clock_ns(CLOCK_MONOTONIC)});
      timer->reset();
    }
  }

private:
  rclcpp::CallbackGroup::SharedPtr group_of(const Callback & callback) {
    using Type = rclcpp::CallbackGroupType;
    if (callback.group.empty()) return nullptr;
    auto & group = groups_[callback.group];
    if (!group)
      group = create_callback_group(callback.reentrant ? Type::Reentrant : Type::MutuallyExclusive);
    return group;
  }

  void add_timer(const Callback & callback, std::shared_ptr<Work> work, std::int64_t start_ns) {
    const auto period_ns = callback.period_ns, now = clock_ns(CLOCK_MONOTONIC);
    const auto run = [work] {
      const auto since_ns = used_ns(), wall_ns = clock_ns(CLOCK_REALTIME);
      work->run(rclcpp::Time{wall_ns}, since_ns);
    };
    const auto timer =
        create_wall_timer(std::chrono::nanoseconds{period_ns}, run, group_of(callback));
    timer->cancel();  // it expires first a period after it was armed
    const auto armed_ns = start_ns + callback.phase_ns - period_ns;
    const auto missed = armed_ns < now ? (now - armed_ns) / period_ns + 1 : 0;
    timers_.emplace_back(armed_ns + missed * period_ns, timer);
  }

  std::map<std::string, rclcpp::CallbackGroup::SharedPtr> groups_;
  std::vector<Timer> timers_;
  std::vector<rclcpp::SubscriptionBase::SharedPtr> subscriptions_;
  std::vector<std::unique_ptr<Synchroniser>> synchronisers_;
};

// This thread is the executor, from which its others inherit; the rest are those of DDS. LTTng's
// stay as they are.
void schedule(const Described & described) {
  for (const auto & task : std::filesystem::directory_iterator{"/proc/self/task"}) {
    std::string name;
    std::ifstream{task.path() / "comm"} >> name;
    if (name.find("-ust") != std::string::npos) continue;
    const pid_t thread = std::stoi(task.path().filename());
    const bool executes = thread == getpid();
    const Threads & wanted = executes ? described.executor : described.dds;
    sched_param parameters{};
    parameters.sched_priority = wanted.priority;
    require(sched_setscheduler(thread, SCHED_FIFO, &parameters) == 0, "SCHED_FIFO");
    // Several share their cores at first: behind one that computes, none could get to a callback.
    const bool several = executes && described.cores.size() > 1;
    stay_on(thread, several ? described.cores : std::vector<int>{wanted.core});
  }
  cores_in_turn = described.cores;
}

int main(int argc, char ** argv) {
  const auto words = rclcpp::init_and_remove_ros_arguments(argc, argv);
  for (const auto & described : application) {
    if (words.size() != 5 || words[1] != described.name) continue;
    try {
      const auto start_ns = std::stoll(words[3]);
      const auto node = std::make_shared<DescribedNode>(described, std::stoull(words[2]), start_ns);
      if (words[4] == "true") schedule(described);
      using namespace rclcpp::executors;
      std::unique_ptr<rclcpp::Executor> executor;
      if (const auto threads = described.cores.size(); threads > 1)
        executor = std::make_unique<MultiThreadedExecutor>(rclcpp::ExecutorOptions{}, threads);
      else
        executor = std::make_unique<SingleThreadedExecutor>();
      executor->add_node(node);
      node->start(*executor);
      executor->spin();
    } catch (const std::exception & error) {
      std::fprintf(stderr, "%s: %s\n", words[1].c_str(), error.what());
      return 1;
    }
    rclcpp::shutdown();
    return 0;
  }
  std::fprintf(stderr, "usage: described_node NAME SEED START_NS true|false\n");
  return 2;
}
