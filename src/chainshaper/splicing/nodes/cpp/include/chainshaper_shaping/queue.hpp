// The messages that wait at a gate, and which of them leave: the same as Queue in
// chainshaper/gate/decision.py, which explains it. No ROS 2 here, and no clock.

#ifndef CHAINSHAPER_SHAPING__QUEUE_HPP_
#define CHAINSHAPER_SHAPING__QUEUE_HPP_

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <deque>
#include <optional>
#include <utility>

#include "gate.hpp"

namespace chainshaper
{

// A message that has come and not left. `number` tells it from the others; `lost` counts those
// that were lost on the way between the one before it and this one (none: not known).
template<typename Message>
struct Waiting
{
  Message message;
  std::int64_t arrival_ns;
  std::optional<std::int64_t> stamp_ns;
  std::int64_t phase_ns;
  std::optional<std::int64_t> source_timestamp;
  std::optional<std::int64_t> lost;
  std::uint64_t number;
};

// What became of a message: it may leave now, or was dropped, for that reason.
template<typename Message>
struct Held
{
  Waiting<Message> waiting;
  Release release;
  std::int64_t awake_ns;
  std::optional<Dropped> dropped;
};

template<typename Message>
class Queue
{
public:
  explicit Queue(Gate gate)
  : gate(std::move(gate)), phase_ns(this->gate.phase_ns)
  {
    check(this->gate);
  }

  // A message came; the one for which there is no room any more.
  std::optional<Held<Message>> arrive(
    Message message, std::int64_t arrival_ns, std::optional<std::int64_t> stamp_ns,
    std::optional<std::int64_t> source_timestamp = {}, std::optional<std::int64_t> lost = {})
  {
    waiting.push_back(
      {std::move(message), arrival_ns, stamp_ns, phase_ns, source_timestamp, lost, number_++});
    if (gate.anchor == Anchor::stamp && stamp_ns && usable(gate, arrival_ns - *stamp_ns)) {
      phase_ns = *stamp_ns % gate.cycle_ns;
    }
    if (waiting.size() <= gate.depth) {
      return std::nullopt;
    }
    Waiting<Message> oldest = std::move(waiting.front());
    waiting.pop_front();
    const Release release = withheld(release_at(oldest, arrival_ns));
    return Held<Message>{std::move(oldest), release, arrival_ns, Dropped::overflowed};
  }

  // When the oldest message may leave, or why it never does.
  std::pair<Release, std::optional<Dropped>> decide()
  {
    const auto & oldest = waiting.front();
    const std::int64_t ready_ns = std::max(oldest.arrival_ns, free_ns);
    Release release = release_at(oldest, ready_ns);
    if (!release.at_ns) {
      return {release, Dropped::discarded};
    }
    if (!release.slot || gate.messages == Messages::all_in_order) {
      return {release, std::nullopt};
    }
    if (left_ && same_cycle(start_of(release), *left_)) {
      if (gate.messages == Messages::first) {
        return {withheld(release), Dropped::surplus};
      }
      release = release_at(oldest, std::max(ready_ns, *left_ + gate.slots.back().end));
      if (!release.at_ns) {
        return {release, Dropped::discarded};
      }
      if (!release.slot) {
        release.at_ns = ready_ns;
        return {release, std::nullopt};
      }
    }
    const std::int64_t start = start_of(release);
    if (!leaving_ || !same_cycle(start, *leaving_)) {
      leaving_ = start;
    }
    return {release, std::nullopt};
  }

  // Whether a newer message leaves for the oldest one, which was to leave like this.
  bool replaced(const Release & release, std::int64_t now_ns) const
  {
    if (gate.messages != Messages::newest || !release.slot || !leaving_) {
      return false;
    }
    return std::any_of(
      waiting.begin() + 1, waiting.end(), [&](const Waiting<Message> & newer) {
        const Release other = release_at(newer, now_ns);
        return other.slot && same_cycle(start_of(other), *leaving_);
      });
  }

  // The oldest message leaves, or is dropped; no release: it is not this gate's to decide.
  Waiting<Message> leave(const std::optional<Release> & release, std::int64_t now_ns)
  {
    free_ns = now_ns;
    if (release && release->slot) {
      left_ = leaving_;
    }
    Waiting<Message> oldest = std::move(waiting.front());
    waiting.pop_front();
    return oldest;
  }

  const Gate gate;
  std::int64_t phase_ns;
  std::deque<Waiting<Message>> waiting;
  std::deque<Change> changes;
  std::int64_t free_ns{0};  // when it is the turn of the oldest message, if it is there then

private:
  Release release_at(const Waiting<Message> & one, std::int64_t ready_ns) const
  {
    return release_of(gate, one.arrival_ns, one.stamp_ns, changes, ready_ns, one.phase_ns);
  }

  std::int64_t start_of(const Release & release) const
  {
    return release.origin_ns + release.cycles_waited * gate.cycle_ns;
  }

  // Stamps are not quite periodic: cycles are the same less than half a cycle apart.
  bool same_cycle(std::int64_t start_ns, std::int64_t other_ns) const
  {
    return 2 * std::abs(start_ns - other_ns) < gate.cycle_ns;
  }

  // The starts of the cycle that the oldest message, or another for it, leaves in, and of that in
  // which one has left.
  std::optional<std::int64_t> leaving_;
  std::optional<std::int64_t> left_;
  std::uint64_t number_{0};
};

}  // namespace chainshaper

#endif  // CHAINSHAPER_SHAPING__QUEUE_HPP_
