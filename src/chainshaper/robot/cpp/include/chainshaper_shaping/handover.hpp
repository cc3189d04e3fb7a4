// Agrees with the standby which of the two publishes a shaped output: the shaping node's side.
// `handover.py` (`Turn`) explains what they agree on, and why. Both use the same page: numbers of 8
// bytes, rings of such numbers, and the output's name. No ROS 2 here.

#pragma once

#include <signal.h>
#include <sys/stat.h>

#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <memory>

#include "guest.hpp"
#include "shaper.hpp"

namespace chainshaper {

// A change of a gate's schedule that another process has asked for.
struct Change {
  std::int64_t from_ns;
  std::int64_t kind;  // schema::new_phase or schema::new_move
  std::int64_t value;

  // Returns whether the time is one: a damaged page may have any number, and the sum of this time
  // and a cycle must not overflow.
  bool is_sound() const {
    return 0 <= from_ns && from_ns <= std::numeric_limits<std::int64_t>::max() / 4;
  }
};

// The page of an output. Its file is read and written, never mapped: SIGBUS ends a process that
// maps a file which another process cuts short, or for which the disk has no room. Numbers that are
// not there read as 0.
class Page {
public:
  // Throws if there is no page and none is to be made, or if it is not this user's.
  Page(const std::string & folder, const std::string & name, const std::string & topic, bool make)
      : path_(folder + "/" + name) {
    const int flags = O_RDWR | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK | (make ? O_CREAT : 0);
    file_ = File(open(path_.c_str(), flags, 0600));
    if (!file_.is_open()) throw std::runtime_error(path_ + ": " + std::strerror(errno));
    if (!S_ISREG(file_.identity().st_mode) || file_.identity().st_uid != geteuid())
      throw std::runtime_error(path_ + ": not a file of this user");
    // A page that has no room on its disk is of no use to others.
    if (const int refused = posix_fallocate(file_.number(), 0, size))
      throw std::runtime_error(path_ + ": " + std::strerror(refused));
    std::array<char, schema::topic_bytes> text{};
    std::memcpy(text.data(), topic.data(), std::min<std::size_t>(topic.size(), text.size()));
    write_at(8 * schema::topic, text.data(), text.size());
  }

  std::int64_t get(std::size_t place) const {
    std::int64_t value = 0;
    read_at(place, &value, 1);
    return value;
  }

  void set(std::size_t place, std::int64_t value) {
    write_at(8 * static_cast<off_t>(place), &value, sizeof(value));
  }

  void add(std::size_t place, std::int64_t more = 1) { set(place, get(place) + more); }

  // Takes a right (a byte of the file); returns false if another process has it.
  bool lock(off_t byte) {
    struct flock wanted = region(byte);
    return file_.is_open() && fcntl(file_.number(), F_OFD_SETLK, &wanted) == 0;
  }

  // Returns whether another process has a right.
  bool is_locked(off_t byte) const {
    struct flock asked = region(byte);
    return file_.is_open() && fcntl(file_.number(), F_OFD_GETLK, &asked) == 0 &&
           asked.l_type != F_UNLCK;
  }

  // Returns whether other processes find this page, and whole.
  bool is_current() const { return file_.is_open() && file_.is_at(path_, size); }

  // Returns the changes of the gate's schedule behind the first `since` that are still there.
  std::vector<Change> asked(std::int64_t since) const {
    const auto last = get(Field::asked);
    std::vector<Change> changes;
    if (last <= since || last < 0) return changes;
    std::array<std::int64_t, 3 * schema::changes> numbers{};
    read_at(schema::asked, numbers.data(), numbers.size());
    const auto first = std::max({since, last - schema::changes, std::int64_t{0}});
    for (auto number = first; number < last; ++number) {
      const auto place = 3 * static_cast<std::size_t>(number % schema::changes);
      changes.push_back({numbers[place], numbers[place + 1], numbers[place + 2]});
    }
    return changes;
  }

  // Puts a number into a ring, and counts it in the field `count`.
  void note(std::size_t count, std::int64_t ring, std::int64_t value) {
    // A damaged page may have any count, so a place is always taken modulo the ring's length.
    const auto number = static_cast<std::uint64_t>(get(count));
    const auto place = static_cast<std::int64_t>(number % std::uint64_t{schema::ring});
    set(static_cast<std::size_t>(ring + place), value);
    set(count, static_cast<std::int64_t>(number + 1));
  }

  // Returns the latest numbers of a ring, ascending.
  std::vector<std::int64_t> noted(std::size_t ring) const {
    std::vector<std::int64_t> numbers(schema::ring);
    read_at(ring, numbers.data(), numbers.size());
    std::sort(numbers.begin(), numbers.end());
    return numbers;
  }

private:
  static constexpr off_t size = 8 * schema::topic + schema::topic_bytes;

  static struct flock region(off_t byte) { return {F_WRLCK, SEEK_SET, byte, 1, 0}; }

  void read_at(std::size_t place, std::int64_t * numbers, std::size_t count) const {
    const auto at = 8 * static_cast<off_t>(place);
    if (!file_.is_open() || pread(file_.number(), numbers, 8 * count, at) < 0)
      std::fill(numbers, numbers + count, 0);
  }

  // A number that cannot be written is missing; shaping goes on.
  void write_at(off_t at, const void * content, std::size_t bytes) {
    if (file_.is_open()) [[maybe_unused]]
      const auto written = pwrite(file_.number(), content, bytes, at);
  }

  std::string path_;
  File file_;
};

// Returns the folders that pages may be in: root's, a login session's, any user's.
inline std::vector<std::string> page_folders() {
  const char * const session = geteuid() == 0 ? "/run" : std::getenv("XDG_RUNTIME_DIR");
  std::vector<std::string> folders{"/dev/shm/chainshaper-" + std::to_string(geteuid())};
  if (session != nullptr && *session != '\0')
    folders.insert(folders.begin(), std::string(session) + "/chainshaper/outputs");
  return folders;
}

// Checks that a folder is this user's alone; makes it first if asked to. Throws if it is not.
inline void check_private(const std::string & folder, bool make) {
  if (make) {
    mkdir(folder.substr(0, folder.rfind('/')).c_str(), 0755);
    mkdir(folder.c_str(), 0700);
  }
  struct stat state{};
  if (lstat(folder.c_str(), &state) != 0)
    throw std::runtime_error(folder + ": " + std::strerror(errno));
  if (!S_ISDIR(state.st_mode) || state.st_uid != geteuid() || (state.st_mode & 077) != 0)
    throw std::runtime_error(folder + ": it is not a folder of this user alone (mode 0700)");
}

// Opens the page of an output in the first folder that has one, or else makes it. Throws if no
// folder is this user's alone, or the file is not.
inline std::unique_ptr<Page> open_page(const std::string & name, const std::string & topic,
                                       const std::vector<std::string> & folders) {
  // ROS 2 itself refuses a domain that is no number.
  const char * const domain = std::getenv("ROS_DOMAIN_ID");
  const auto number = domain == nullptr ? 0 : std::strtol(domain, nullptr, 10);
  const auto file = name + "." + std::to_string(number) + ".v" + std::to_string(schema::version);
  std::string problem = "no folder";
  for (const bool make : {false, true}) {
    for (const auto & folder : folders) {
      try {
        check_private(folder, make);
        return std::make_unique<Page>(folder, file, topic, make);
      } catch (const std::runtime_error & error) {
        problem = error.what();
      }
    }
  }
  throw std::runtime_error(problem);
}

// Decides whether it is this node's turn to publish a message, which its source timestamp names.
class Turn {
public:
  Turn(std::string name, std::string topic, std::vector<std::string> folders = page_folders(),
       bool in_process = false)
      : name_(std::move(name)),
        topic_(std::move(topic)),
        folders_(std::move(folders)),
        in_process_(in_process) {
    page_ = opened();
    const auto now = monotonic_ns();
    if (now - page_->get(Field::started_ns) > schema::at_once_ns)
      page_->set(Field::failed_starts, 0);
    page_->set(Field::started_ns, now);
    page_->add(Field::starts);
    page_->add(Field::failed_starts);
  }

  bool has_standby() const { return page_->is_locked(schema::standing_by); }

  // Returns how many starts before this one have failed at once.
  std::int64_t failed_before() const { return page_->get(Field::failed_starts) - 1; }

  // Returns how long the node waits before it starts (s): twice as long after each further failure.
  double wait_s() const {
    const auto failed = std::min<std::int64_t>(failed_before() - schema::back_off_after, 10);
    return failed < 0 ? 0.0 : std::min(10.0, std::ldexp(0.5, static_cast<int>(failed)));
  }

  // Gives a gate the phase and the mode of the gate before it in the same launch. From now on the
  // page shows each of its decisions, and changes its schedule.
  template <typename Shaper>
  void go_on(Shaper & shaper) {
    auto & queue = shaper.queue;
    const auto & gate = queue.gate;
    shaper.follow = [this, &queue] { follow(queue); };
    shaper.on_decision = [this, cycle_ns = gate.cycle_ns](const Release & release) {
      hold(release.at_ns, modulo(release.origin_ns, cycle_ns), release.mode);
    };
    if (page_->get(Field::phase_known) != 0)  // from now on, not the next cycle
      queue.set_phase(page_->get(Field::phase_ns), monotonic_ns() - gate.cycle_ns);
    const auto mode = static_cast<std::size_t>(page_->get(Field::mode));  // from 1; 0: none
    if (mode > 0 && mode <= gate.modes.size()) queue.switch_mode(mode - 1, 0);
  }

  // Begins with a message; returns false if it is not this node's, because the standby or another
  // shaping node deals with it.
  bool take(std::int64_t key) {
    if (!in_force_ && !come_into_force(key)) return false;
    page_->set(Field::until_ns, monotonic_ns());
    page_->add(Field::taken);
    return !was_bypassed(key);
  }

  // Says on the page until when the node may have a message, and what the gate's cycles are.
  void hold(Maybe until_ns, std::int64_t phase_ns, std::optional<std::size_t> mode = std::nullopt) {
    page_->set(Field::mode, mode ? static_cast<std::int64_t>(*mode) + 1 : 0);
    if (until_ns) page_->set(Field::until_ns, *until_ns);
    page_->set(Field::phase_ns, phase_ns);
    page_->set(Field::phase_known, 1);
  }

  // Returns whether the standby has dealt with a message.
  bool was_bypassed(std::int64_t key) {
    const auto count = page_->get(Field::bypassed);
    if (count != seen_) {
      // Messages that the standby is about to publish come first.
      const auto give_up = monotonic_ns() + schema::give_up_ns;
      while (page_->is_locked(schema::passing) && monotonic_ns() < give_up)
        sleep_until(monotonic_ns() + 100'000);
      bypassed_ = page_->noted(schema::bypassed);
      // The ring has lost some: whatever is older than its oldest counts as dealt with.
      if (seen_ >= 0 && count - seen_ > schema::ring) oldest_ = bypassed_.front();
      seen_ = count;
    }
    if (key >= oldest_ && !std::binary_search(bypassed_.begin(), bypassed_.end(), key)) {
      oldest_ = 0;  // later messages are newer, even if the clock is set back
      return false;
    }
    page_->add(Field::taken);  // tells the standby that this node does not hang
    return true;
  }

  // Returns whether the standby has dealt with this message, which waits behind the one that the
  // node is about to publish: that one would come after it. To be called after `was_bypassed`.
  bool is_overtaken_by(std::int64_t key) const {
    return std::binary_search(bypassed_.begin(), bypassed_.end(), key);
  }

  // Notes that a message was published. Where the page is no longer the one that others find, the
  // node opens it again.
  void done(std::int64_t key) {
    drop(key);
    page_->set(Field::until_ns, monotonic_ns());
    page_->set(Field::failed_starts, 0);
    if (page_->is_current()) return;
    auto next = opened_again();
    if (!next) return;
    for (const auto released : page_->noted(schema::released))  // a standby may be behind
      next->note(Field::released, schema::released, released);
    page_ = std::move(next);
    in_force_ = false;
    seen_ = -1;
    oldest_ = 0;
  }

  // Notes that the node has dealt with a message.
  void drop(std::int64_t key) { page_->note(Field::released, schema::released, key); }

  // Takes over what was asked for since the last call into the schedules of a gate; slots go back
  // to the planned ones where the process that had them moved has ended.
  template <typename Queue>
  void follow(Queue & queue) {
    auto changes = std::exchange(moves_before_, {});
    const auto asked = page_->get(Field::asked);
    if (asked != asked_) {
      const auto since = page_->asked(asked_);
      changes.insert(changes.end(), since.begin(), since.end());
      asked_ = asked;
    }
    const auto is_move = [](const Change & change) { return change.kind == schema::new_move; };
    has_moved_ = has_moved_ || std::any_of(changes.begin(), changes.end(), is_move);
    const bool is_following = has_moved_ && page_->is_locked(schema::moving);
    for (const Change & change : changes) {
      if (!change.is_sound()) continue;
      if (change.kind == schema::new_phase) queue.set_phase(change.value, change.from_ns);
      if (is_move(change) && is_following) queue.move_slots(change.value, change.from_ns);
    }
    if (has_moved_ && !is_following) {
      queue.move_slots(0, monotonic_ns());
      has_moved_ = false;
    }
  }

  // Counts on the page what became of a message.
  template <typename Message>
  void count(const Outcome<Message> & outcome) {
    const auto & [message, release, awake_ns] = outcome;
    const auto & reason = release.dropped;  // the page counts each, in their order
    page_->note(Field::measured, schema::measured, message.arrival_ns - release.origin_ns);
    page_->add(reason ? Field::replaced + static_cast<std::size_t>(*reason) : Field::published);
    page_->add(Field::lost_by_dds, message.lost.value_or(0));
    page_->add(Field::late, release.overrun ? 1 : 0);
  }

private:
  // Opens the page for this node, and clears what belongs to another launch.
  std::unique_ptr<Page> opened() {
    auto page = open_page(name_, topic_, folders_);
    const auto parent = getppid();
    const auto idle_ns = std::abs(monotonic_ns() - page->get(Field::until_ns));
    if (parent != page->get(Field::parent) || idle_ns > schema::at_once_ns) {
      page->set(Field::mode, 0);  // mode and phase are another launch's
      page->set(Field::phase_known, 0);
      if (!page->is_locked(schema::publishing)) {  // else the counts are, which goes on
        page->set(Field::starts, 0);
        for (std::size_t count = Field::published; count <= Field::late; ++count)
          page->set(count, 0);
      }
    }
    page->set(Field::parent, parent);
    page->set(Field::in_process, in_process_ ? 1 : 0);
    // A phase that was asked for before is that of another gate; a move is in force for as long as
    // its process lives.
    asked_ = page->get(Field::asked);
    moves_before_.clear();
    for (const Change & change : page->asked(0))
      if (change.kind == schema::new_move) moves_before_.push_back(change);
    return page;
  }

  // Opens the page for this node; null: no folder has room for one. The node then stays with the
  // page that it has, which no other process finds.
  std::unique_ptr<Page> opened_again() {
    try {
      return opened();
    } catch (const std::runtime_error &) {
      return nullptr;
    }
  }

  // Takes the right to publish, from this message on; returns false if another shaping node has it.
  bool come_into_force(std::int64_t key) {
    const auto give_up = monotonic_ns() + schema::give_up_ns;
    while (!(in_force_ = page_->lock(schema::publishing))) {
      const auto holder = page_->get(Field::holder);
      if (holder > 0 && holder != getpid() && kill(static_cast<pid_t>(holder), 0) == 0)
        return false;  // another shaping node is in force
      // The standby was stopped (SIGSTOP) while it published, and has the right still.
      gave_up_ = gave_up_ || monotonic_ns() > give_up;
      if (gave_up_) break;
      sleep_until(monotonic_ns() + 1'000'000);
    }
    gave_up_ = gave_up_ && !in_force_;
    page_->set(Field::until_ns, monotonic_ns());
    page_->set(Field::first, key);
    page_->set(Field::holder, getpid());
    // The standby still deals with the messages before this node's first one.
    const bool listening = page_->get(Field::listening) > 0 && !gave_up_;
    while (listening && has_standby() && monotonic_ns() < give_up &&
           page_->get(Field::acknowledged) != key && !place_of(page_->noted(schema::bypassed), key))
      sleep_until(monotonic_ns() + 200'000);
    return true;
  }

  std::string name_;
  std::string topic_;
  std::vector<std::string> folders_;
  bool in_process_;
  std::unique_ptr<Page> page_;
  bool in_force_{false};
  bool gave_up_{false};
  bool has_moved_{false};             // slots are where another process has asked for
  std::int64_t asked_{0};             // changes that had been asked for at the last look
  std::vector<Change> moves_before_;  // that were asked for before this gate opened the page
  std::int64_t seen_{-1};   // messages the standby had dealt with at the last look; -1: no look yet
  std::int64_t oldest_{0};  // it has dealt with all messages before this one
  std::vector<std::int64_t> bypassed_;  // the latest ones it has dealt with, ascending
};

}  // namespace chainshaper
