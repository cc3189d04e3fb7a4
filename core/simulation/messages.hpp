// Messages under way, and the queues in which they wait. A message is in one queue at a time.

#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <optional>

#include "simulation/description.hpp"

namespace chainshaper::simulation {

struct Entity;
struct Publisher;

// What a message carries, and the callback that takes it passes on in its own messages.
struct Carried {
  Nanoseconds source{0};                   // its source timestamp
  Nanoseconds origin{0};                   // the stamp of its header
  std::optional<Nanoseconds> chain_start;  // when its chain began; none: it is not on the chain
  std::size_t instance{0};                 // of the chain, counted from 0
  std::optional<std::int64_t> mode;        // that it announces
  Nanoseconds arrival{0};                  // when it came into the history of its reader
};

struct Message {
  Message * next{nullptr};  // in its queue, or among the unused messages
  Entity * entity{nullptr};
  Publisher * publisher{nullptr};
  std::int64_t address{0};
  Carried carried;
};

// Owns all messages. Messages that are given back are used again, so even a long run allocates no
// more than were ever under way at the same time.
class MessagePool {
public:
  Message & take() {
    ++in_use_;
    if (unused_ == nullptr) return messages_.emplace_back();
    Message & message = *unused_;
    unused_ = message.next;
    return message;
  }

  void give_back(Message & message) {
    --in_use_;
    message.next = unused_;
    unused_ = &message;
  }

  std::size_t in_use() const { return in_use_; }

private:
  std::deque<Message> messages_;  // a deque, which never moves them
  Message * unused_{nullptr};
  std::size_t in_use_{0};
};

class MessageQueue {
public:
  std::size_t size() const { return size_; }

  // The queue must not be empty.
  Message & oldest() const { return *oldest_; }

  void append(Message & message) {
    message.next = nullptr;
    (size_ == 0 ? oldest_ : newest_->next) = &message;
    newest_ = &message;
    ++size_;
  }

  // The queue must not be empty.
  Message & take_oldest() {
    Message & message = *oldest_;
    oldest_ = message.next;
    --size_;
    return message;
  }

private:
  Message * oldest_{nullptr};
  Message * newest_{nullptr};
  std::size_t size_{0};
};

}  // namespace chainshaper::simulation
