// A shaping node without ROS 2, as `output_process.py` is in Python: its turns in C++.

#include <arpa/inet.h>
#include <netinet/in.h>
#include <sched.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cstdint>
#include <cstring>
#include <iostream>
#include <string>

#include "chainshaper_shaping/handover.hpp"

void publish(char word, std::int64_t number) {
  char record[9];
  record[0] = word;
  std::memcpy(record + 1, &number, 8);
  if (write(1, record, sizeof(record)) != sizeof(record)) std::_Exit(1);
}

chainshaper::Outcome<int> outcome(std::optional<chainshaper::Dropped> dropped,
                                  chainshaper::Maybe lost, bool late, std::int64_t latency_ns) {
  chainshaper::Outcome<int> made{};
  made.release.dropped = dropped;
  made.waiting.lost = lost;
  made.waiting.arrival_ns = latency_ns;
  if (late) made.release.overrun = chainshaper::Policy::wait;
  return made;
}

// In place of a gate: writes what it is asked for.
struct Asked {
  struct Queue {
    chainshaper::Gate gate;
    std::int64_t moved_ns{77};

    void set_phase(std::int64_t phase_ns, std::int64_t) { std::cout << phase_ns; }
    void switch_mode(std::size_t mode, std::int64_t) { std::cout << ' ' << gate.modes[mode]; }
    void move_slots(std::int64_t by_ns, std::int64_t) { moved_ns = by_ns; }
  } queue;
  std::function<void(const chainshaper::Release &)> on_decision;
  std::function<void()> follow;
};

// The folder of pages, "shaping", "starting" or "counting", the page's name, the port to listen at, how long to
// hold (ns).
int main(int, char ** argv) {
  chainshaper::Turn turn(argv[3], "/t5", {argv[1]});
  if (std::string(argv[2]) == "starting") {
    Asked asked;
    asked.queue.gate.modes = {"city", "highway"};
    asked.queue.gate.cycle_ns = 2;
    turn.go_on(asked);
    return 0;
  }
  if (std::string(argv[2]) == "counting") {
    constexpr auto reasons = static_cast<std::int64_t>(chainshaper::dropped_names.size());
    for (std::int64_t number = 0; number < reasons; ++number)
      for (std::int64_t i = 0; i <= number; ++i)
        turn.count(outcome(static_cast<chainshaper::Dropped>(number), number, number % 2 == 1,
                           number));
    Asked::Queue queue;
    turn.follow(queue);
    turn.count(outcome({}, {}, false, queue.moved_ns));
    return 0;
  }
  const int inbox = socket(AF_INET, SOCK_DGRAM, 0);
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  address.sin_port = htons(static_cast<std::uint16_t>(std::stoi(argv[4])));
  if (bind(inbox, reinterpret_cast<sockaddr *>(&address), sizeof(address)) != 0) return 1;
  sched_param lowest{};  // else who receives may run before it has noted what it did
  lowest.sched_priority = 1;
  sched_setscheduler(0, SCHED_FIFO, &lowest);
  publish('R', getpid());
  std::int64_t number = 0;
  while (recv(inbox, &number, 8, 0) == 8) {
    if (!turn.take(number)) continue;
    const std::int64_t until = chainshaper::monotonic_ns() + std::stoll(argv[5]);
    turn.hold(until, 0);
    chainshaper::sleep_until(until);
    if (!turn.was_bypassed(number)) {
      publish('S', number);
      turn.done(number);
    }
  }
}
