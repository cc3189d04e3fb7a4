// The tracer in front of ROS 2: `LD_PRELOAD` loads it into a node, in front of libtracetools. A call
// of `ros_trace_<event>(…)` arrives here first: it is recorded in shared memory, then passed on to
// the function behind ours, so that LTTng and uprobes go on working.
//
// The memory is a memfd: the kernel frees it when the last process that has it ends, however that
// happens. A recorder that attaches to a running node finds it by its name. Where CHAINSHAPER_TRACE
// names a socket, the memory is sent there as soon as it is made.
//
//     header | objects, appended by all threads | ring of thread 0 | ring of thread 1 | …
//
// * Events of creation, which say what handles in other events are, are appended to the objects, and
//   are never overwritten.
// * All other events go to the ring of their thread, in place of its oldest record. A thread takes a
//   ring at its first event, and gives it back when it ends. `written` counts the records, so a reader
//   sees how many were overwritten before it read them.
// * No thread waits, and no memory is allocated after a thread's first event. Events without room are
//   counted as dropped.
//
// We are a guest in the robot's process: whatever fails here, the node goes on as without us.
//
// * A thread never waits for another: where two threads make the memory at once, the second memory is
//   thrown away. (A waiting SCHED_FIFO thread could keep the core from the ordinary thread that it
//   waits for.)
// * Memory is claimed before it is written: where the kernel has none left, a write would be a SIGBUS.
// * A limit on file sizes (`ulimit -f`) would send SIGXFSZ when our memory is made: the signal is
//   blocked meanwhile.
// * A child process has a memory of its own, or none, whichever system call made it. A descriptor
//   is closed only while it is still that of our file, since a node may close all descriptors and
//   use their numbers again.
//
// A loop that is no callback (a control loop in a thread of its own) is seen by how its thread sleeps:
// we stand in front of the functions by which threads sleep for a time (`SLEEPS`). Sleeps are recorded
// of threads that publish outside callbacks, and of loops that the user named in CHAINSHAPER_LOOPS.
// All others pass by two comparisons. The sleeps of such a loop can be moved: another process asks for
// it in the ring of the thread (`struct request`).
//
// The loop of ros2_control is known by name: we stand in front of the three functions of its controller
// manager that the loop calls in each turn.
//
// Times are ns of CLOCK_MONOTONIC. Values are a function's arguments as they are in registers (of a
// bool only the lowest byte counts). Calls of services have trace points from Kilted on only; so we
// record them where librcl calls rmw.
//
// Upstream: `tracetools/tracetools.h` of ros2_tracing, tags 4.1.1 to 8.10.1: all arguments are
// integers or pointers, at most five, so functions of all versions can be called in the same way.
// rmw, `rmw/types.h` and `rmw/rmw.h`, Humble to Rolling: `rmw_service_info_t`, `rmw_request_id_t`.
// ros2_control, `controller_manager/controller_manager.hpp`, 2.8.0 (Humble) to 6.8.0.
#define _GNU_SOURCE
#undef _FORTIFY_SOURCE  // with it headers define some of the functions that we stand in front of
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <link.h>
#include <poll.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/timerfd.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include "events.h"  // made when this is built, by events_header.py

#define NAME "chainshaper-trace"
#define RINGS 64u
#define RING_RECORDS (1u << 14)  // 0.8 s of 20,000 events a second, of each thread
#define OBJECT_RECORDS (1u << 15)
#define LONGEST_TEXT 4096u
#define TEXT_BYTES 40u  // in one record
#define MOST_NESTED 8u  // callbacks, one within the other, of which it is known where they began
#define STEPS 8u  // so many steps of a loop from sleep to sleep show whether it has instants of its own
enum { TEXT = 1, LIBRARY = 2, FIRST_EVENT = 3 };

struct record {
  uint64_t time;
  uint32_t tid;
  uint16_t cpu;
  _Atomic uint16_t event;  // 0: not written yet
  uint64_t values[6];      // of a text: 16 × its length + the argument's place, then its bytes
};

// What another process asks of the loop of a thread: to wake up by `move` later than it would by
// itself. It writes at any time, and may be killed in the midst of it: the request counts once `check`
// is right. From `until` on nobody asks any more, and the loop goes back to its own instants.
struct request {
  _Atomic uint64_t number;  // increases with each; 0: there is none
  _Atomic uint64_t tid;     // of the thread, since a ring goes from a thread that ends to another
  _Atomic uint64_t move;    // ns; shorter than the period
  _Atomic uint64_t period;  // of the loop (ns)
  _Atomic uint64_t until;   // ns of CLOCK_MONOTONIC; 0: for ever
  _Atomic uint64_t check;   // all of them combined, and CHECK
};
#define CHECK UINT64_C(0x6d6f76656c6f6f70)

struct ring {
  _Atomic uint64_t written;
  _Atomic uint32_t taken;  // by the thread of this id; 0: by none
  uint32_t unused;
  struct request asked;
};

struct memory {
  uint32_t magic, format, pid, rings, ring_records, object_records;
  _Atomic uint64_t objects;  // object records that threads have claimed; may exceed OBJECT_RECORDS
  _Atomic uint64_t dropped;  // events for which there was no room
  uint64_t clock;             // the time namespace whose CLOCK_MONOTONIC times are of; 0: not known
  uint64_t unused[2];
  struct ring ring[RINGS];
  struct record object[OBJECT_RECORDS];
  struct record records[RINGS][RING_RECORDS];
};
_Static_assert(sizeof(struct record) == 64 && sizeof(struct ring) == 64, "a cache line each");

static _Atomic(struct memory *) memory;
static _Atomic bool refused;  // the memory cannot be had: no event of this process is traced
static int descriptor = -1;
static struct stat identity;  // of the file behind it
static pthread_key_t at_end;
static bool has_key;
static _Atomic bool has_named_node;  // a node whose loop is named was created in this process
#define MANAGERS 16u
static _Atomic uintptr_t managers[MANAGERS];  // controller managers that were called; 0: none yet
// In a page that the kernel fills with zeros in a child process: 1 while `memory` is this process's.
static volatile uint32_t *memory_is_ours = &(volatile uint32_t){1};
struct rseq_area {  // struct rseq of <linux/rseq.h>, which older systems do not have
  uint32_t cpu_id_start, cpu_id;
  volatile uint64_t section;
};
#ifndef MADV_POPULATE_WRITE
#define MADV_POPULATE_WRITE 23  // Linux 5.14
#endif
#ifndef MADV_WIPEONFORK
#define MADV_WIPEONFORK 18
#endif
static __thread struct {
  struct ring *ring;
  struct record *records;
  uint32_t tid;
  struct rseq_area *rseq;  // NULL: we cannot see whether the thread has left its core
  uint64_t used;           // CPU time, as read from the kernel
  uint64_t used_at;        // when it was read
  uint64_t last_used;      // CPU time in the latest record
  bool calls_timer;        // it is in rcl_timer_call
  bool publishes;          // it has published outside callbacks
  bool is_named;           // the user named it as a loop
  bool sleeps;             // it is in a function that we stand in front of, of which the sleep is recorded
  unsigned callbacks;      // that run in it, one within the other
  struct {                 // the first MOST_NESTED of them
    uint64_t handle;
    uintptr_t frame;  // of the stack, where it was announced
  } callback[MOST_NESTED];
  uint16_t latest;  // event
  // Of the loop, from the first request to move it on.
  struct {
    uint64_t number;          // of the request that it follows; 0: it follows none
    uint64_t period;          // ns, as all here
    uint64_t move;            // that was asked for
    uint64_t wanted;          // until when it wanted to sleep the last time, by itself
    uint64_t kept;            // what is added to each sleep, since its own instants do not move
    int64_t tried;            // of what was added to the last sleep, that which is to show what follows
    int64_t added;            // to the last sleep
    int64_t steps[STEPS];     // from one wanted instant to the next, the latest ones
    unsigned seen;            // how many steps there were
    unsigned against;         // signs that what is kept changes the loop's rate
    enum { UNKNOWN, OWN_INSTANTS, FOLLOWS } counts;
    bool interrupted;         // its last sleep, of which it gets the rest
    bool given_back;          // nobody asks any more, or its rate would change
  } loop;
} thread;

static inline uint64_t now(clockid_t clock) {
  struct timespec time;
  clock_gettime(clock, &time);
  return (uint64_t)time.tv_sec * 1000000000u + (uint64_t)time.tv_nsec;
}

// The CPU time of the thread, without a system call as long as the thread stays on its core: then the
// time that has passed since the last system call is CPU time.
//
// Whether it has stayed shows a pointer of the thread to a restartable sequence (rseq(2)). The kernel
// resets it when it takes the core away while the thread is outside of the sequence, and ours is
// empty, so the thread is always outside. Some kernels do not reset the pointer of a thread that waits
// in a system call: `find_rseq` tries this once in each process, and does without the pointer there.
//
// The kernel's clock leaves out interrupts and stolen time. It is read again after SURELY_USED, so
// that no more than this is wrong. The clock and its instant are read one after the other; where an
// interrupt separates them by more than READ_AT_ONCE, the pair serves for one event only, since the
// error would be in all events that follow.
#define SURELY_USED 200000u   // ns
#define READ_AT_ONCE 4000u    // ns
#if defined(__x86_64__)
#define SIGNATURE 0x53053053u
#define THREAD_POINTER(to) __asm__("mov %%fs:0, %0" : "=r"(to))
#elif defined(__aarch64__)
#define SIGNATURE 0xd428bc00u
#define THREAD_POINTER(to) (to = __builtin_thread_pointer())
#else
#define SIGNATURE 0u
#define THREAD_POINTER(to) (to = NULL)
#endif
static const uint32_t nowhere[2] = {SIGNATURE};  // the kernel wants it in front of an abort's address
static struct {
  uint32_t version, flags;
  uint64_t start, size, abort;
} no_section __attribute__((aligned(32)));
static _Atomic ptrdiff_t rseq_offset;  // of the area from the thread pointer; 0: do without it

static struct rseq_area *rseq_at(ptrdiff_t offset) {
  char *thread_pointer = NULL;
  THREAD_POINTER(thread_pointer);
  struct rseq_area *area = (struct rseq_area *)(void *)(thread_pointer + offset);
  return thread_pointer && offset && (int32_t)area->cpu_id >= 0 ? area : NULL;
}

static void find_rseq(void) {
  const ptrdiff_t *offset = dlsym(RTLD_DEFAULT, "__rseq_offset");  // glibc 2.35 and later
  const unsigned *size = dlsym(RTLD_DEFAULT, "__rseq_size");
  no_section.start = (uintptr_t)nowhere;
  no_section.abort = (uintptr_t)&nowhere[1];
  ptrdiff_t usable = offset && size && *size ? *offset : 0;
  struct rseq_area *rseq = rseq_at(usable);
  for (int try = 0; rseq && try < 3; try++) {
    rseq->section = (uintptr_t)&no_section;
    // By its number: we stand in front of nanosleep ourselves, which would record it as the node's.
    syscall(SYS_clock_nanosleep, CLOCK_MONOTONIC, 0, &(struct timespec){0, 1}, NULL);
    if (rseq->section) usable = 0;
  }
  rseq_offset = usable;  // in one write: another thread may be here too, and comes to the same result
}

static uint64_t thread_time(uint64_t time) {
  uint64_t used = thread.used + (time - thread.used_at);
  bool stayed = thread.rseq && thread.rseq->section == (uintptr_t)&no_section;
  if (!stayed || time - thread.used_at >= SURELY_USED) {
    uint64_t before = now(CLOCK_MONOTONIC);
    if (thread.rseq) thread.rseq->section = (uintptr_t)&no_section;
    used = thread.used = now(CLOCK_THREAD_CPUTIME_ID);
    thread.used_at = now(CLOCK_MONOTONIC);
    if (thread.rseq && thread.used_at - before > READ_AT_ONCE) thread.rseq->section = 0;
  }
  if (used > thread.last_used) thread.last_used = used;
  return thread.last_used;
}

static void stamp(struct record *record, uint64_t time) {
  record->time = time;
  record->tid = thread.tid;
  record->cpu = (uint16_t)sched_getcpu();
}

// Send the memory to the recorder that listens on a socket, if there is one.
static void send_memory(const char *name) {
  struct sockaddr_un address = {.sun_family = AF_UNIX};
  size_t length = strlen(name);
  int peer = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
  if (peer < 0) return;
  if (length >= sizeof address.sun_path) length = sizeof address.sun_path - 1;  // nothing listens there
  memcpy(address.sun_path + 1, name, length);  // an abstract name: it leaves no file behind
  socklen_t size = (socklen_t)(offsetof(struct sockaddr_un, sun_path) + 1 + length);
  if (connect(peer, (struct sockaddr *)&address, size) == 0) {
    union {
      struct cmsghdr header;
      char room[CMSG_SPACE(sizeof(int))];
    } control = {.header = {CMSG_LEN(sizeof(int)), SOL_SOCKET, SCM_RIGHTS}};
    memcpy(CMSG_DATA(&control.header), &descriptor, sizeof(int));
    // The recorder gets the program's name, too: this process may have ended before it looks.
    char program[16] = "";
    prctl(PR_GET_NAME, program);
    struct iovec content = {.iov_base = program, .iov_len = sizeof program};
    struct msghdr message = {.msg_iov = &content, .msg_iovlen = 1, .msg_control = &control,
                             .msg_controllen = sizeof control.room};
    sendmsg(peer, &message, MSG_NOSIGNAL);
  }
  close(peer);
}

// The function of this name in the libraries behind ours; NULL: there is none. What Python loads for
// a node is not in the scope that RTLD_NEXT searches; but librcl needs all of it, so its scope has it.
static void *function_behind(const char *name) {
  void *address = dlsym(RTLD_NEXT, name);
  if (address) return address;
  void *rcl = dlopen("librcl.so", RTLD_LAZY | RTLD_NOLOAD);
  return rcl ? dlsym(rcl, name) : NULL;
}

static void append(uint16_t event, const uint64_t *values, unsigned texts);

// Have the kernel give the pages of an area now, so that writing to it later cannot fail. Return
// false if it has none left. Before Linux 5.14 there is no such request: pages come when written to.
static bool claim(void *area, size_t size) {
  return madvise(area, size, MADV_POPULATE_WRITE) == 0 || errno == EINVAL;
}

// Make a file in memory of that size; return its descriptor, or -1. A limit on the size of files holds
// for it, too, and sends SIGXFSZ, which would end the node: it is blocked here, and removed if it came.
static int new_file(size_t size) {
  sigset_t too_large, before, pending;
  sigemptyset(&too_large);
  sigaddset(&too_large, SIGXFSZ);
  if (pthread_sigmask(SIG_BLOCK, &too_large, &before)) return -1;
  sigpending(&pending);
  int file = memfd_create(NAME, MFD_CLOEXEC | MFD_ALLOW_SEALING);
  bool failed = file >= 0 && ftruncate(file, (off_t)size);
  if (failed && errno == EFBIG && !sigismember(&pending, SIGXFSZ))
    while (sigtimedwait(&too_large, NULL, &(struct timespec){0, 0}) < 0 && errno == EINTR) continue;
  pthread_sigmask(SIG_SETMASK, &before, NULL);
  // Its size never changes: a recorder that has it mapped relies on that.
  failed = failed || (file >= 0 && fcntl(file, F_ADD_SEALS, F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_SEAL));
  if (!failed) return file;
  close(file);
  return -1;
}

// Map the memory's file, with room for all but the rings' records; NULL: there is none.
static struct memory *mapped(int file) {
  void *area = mmap(NULL, sizeof(struct memory), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
  if (area == MAP_FAILED) return NULL;
  if (claim(area, offsetof(struct memory, records))) return area;
  munmap(area, sizeof(struct memory));
  return NULL;
}

// Fill the header, but for `magic`, which says that all is there.
static void begin(struct memory *made) {
  made->format = FORMAT;
  made->pid = (uint32_t)getpid();
  made->rings = RINGS;
  made->ring_records = RING_RECORDS;
  made->object_records = OBJECT_RECORDS;
  struct stat clock;
  if (stat("/proc/self/ns/time", &clock) == 0) made->clock = clock.st_ino;
}

// Close the memory's descriptor, unless the node has closed it and the number is another file's now.
static void close_file(void) {
  struct stat now_there;
  bool is_ours = descriptor >= 0 && fstat(descriptor, &now_there) == 0 &&
                 now_there.st_dev == identity.st_dev && now_there.st_ino == identity.st_ino;
  if (is_ours) close(descriptor);
  descriptor = -1;
}

// Called when a thread ends. If it emits events after this, it takes a ring again, and this is called
// once more.
static void give_back(void *ring) {
  thread.ring = NULL;
  if (*memory_is_ours) ((struct ring *)ring)->taken = 0;
}

// Called in a child process, which has its parent's memory mapped; its own is made at its first event.
static void in_child(void) {
  *memory_is_ours = 1;
  close_file();
  if (memory) munmap(memory, sizeof(struct memory));
  memory = NULL;
  refused = has_named_node = false;
  for (unsigned place = 0; place < MANAGERS; place++) managers[place] = 0;
  if (has_key) pthread_setspecific(at_end, NULL);
  memset(&thread, 0, sizeof thread);
}

// Called when the library is loaded. fork() calls `in_child`. A child that was made otherwise (by a
// bare system call, or `_Fork`) sees at its first event that the kernel has emptied the page.
__attribute__((constructor)) static void prepare(void) {
  has_key = pthread_key_create(&at_end, give_back) == 0;
  long size = sysconf(_SC_PAGESIZE);
  uint32_t *page = mmap(NULL, (size_t)size, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
  if (page == MAP_FAILED) return;
  *page = 1;
  if (madvise(page, (size_t)size, MADV_WIPEONFORK) == 0) memory_is_ours = page;
  pthread_atfork(NULL, NULL, in_child);
}

// Make the memory of this process, and send it to a recorder that waits; false: there is no memory.
static bool make_memory(void) {
  int file = new_file(sizeof(struct memory));
  struct memory *made = file < 0 ? NULL : mapped(file), *none = NULL;
  if (made) {
    find_rseq();
    begin(made);
  }
  if (!made || !atomic_compare_exchange_strong(&memory, &none, made)) {
    if (made) munmap(made, sizeof(struct memory));
    if (file >= 0) close(file);
    refused = !memory;
    return memory;  // of another thread, which was faster; or there is none
  }
  // A recorder that attaches takes the first memory with this number, so a memory that is thrown away
  // never gets it.
  atomic_thread_fence(memory_order_release);
  *(volatile uint32_t *)&made->magic = 0x63687368;
  fstat(file, &identity);
  descriptor = file;
  Dl_info behind;
  void *function = function_behind("ros_trace_callback_start");
  thread.tid = (uint32_t)syscall(SYS_gettid);
  if (function && dladdr(function, &behind) && behind.dli_fname)
    append(LIBRARY, (uint64_t[6]){(uintptr_t)behind.dli_fname}, 1);
  const char *reader = getenv("CHAINSHAPER_TRACE");
  if (reader) send_memory(reader);
  return true;
}

// Whether the process has its memory; makes it at the first call.
static bool is_ready(void) {
  if (__builtin_expect(!*memory_is_ours, 0)) in_child();
  if (memory) return true;
  if (refused) return false;
  int before = errno;
  bool made = make_memory();
  errno = before;
  return made;
}

// Take a free ring for this thread; false: there is none (the event is counted), or no memory.
static bool has_ring(void) {
  if (!is_ready()) return false;
  thread.tid = (uint32_t)syscall(SYS_gettid);
  thread.rseq = rseq_at(rseq_offset);
  struct memory *all = memory;
  for (unsigned number = 0; number < RINGS; number++) {
    uint32_t none = 0;
    if (!atomic_compare_exchange_strong(&all->ring[number].taken, &none, thread.tid)) continue;
    int before = errno;
    bool has_room = claim(all->records[number], sizeof all->records[number]);
    errno = before;
    if (!has_room) {
      all->ring[number].taken = 0;
      break;
    }
    thread.records = all->records[number];
    thread.ring = &all->ring[number];
    if (has_key) pthread_setspecific(at_end, thread.ring);
    return true;
  }
  atomic_fetch_add(&all->dropped, 1);
  return false;
}

// Write an event into the thread's ring. `time` 0: now. `timed`: values[2] is the thread's CPU time.
static inline __attribute__((always_inline)) void write_record(
  uint16_t event, uint64_t time, unsigned count, const uint64_t *values, bool timed) {
  bool is_known = thread.ring && *memory_is_ours;
  if (__builtin_expect(!is_known, 0) && !has_ring()) return;
  uint64_t number = atomic_load_explicit(&thread.ring->written, memory_order_relaxed);
  struct record *record = &thread.records[number & (RING_RECORDS - 1)];
  // A reader that sees any part of this record also sees the count of the records before it. From that
  // count it knows that the oldest record, in whose place this one comes, may be overwritten.
  atomic_thread_fence(memory_order_release);
  if (!time) time = now(CLOCK_MONOTONIC);
  stamp(record, time);
  atomic_store_explicit(&record->event, event, memory_order_relaxed);
  for (unsigned place = 0; place < count; place++) record->values[place] = values[place];
  if (timed) record->values[2] = thread_time(time);
  atomic_store_explicit(&thread.ring->written, number + 1, memory_order_release);
}

// Append an event of creation, and right behind it records with its texts. `texts`: the places of
// arguments that are texts, as bits.
static void append(uint16_t event, const uint64_t *values, unsigned texts) {
  struct memory *all = memory;
  size_t length[5];
  unsigned wanted = 1;
  for (unsigned place = 0; place < 5; place++) {
    const char *text = (const char *)(uintptr_t)(texts >> place & 1 ? values[place] : 0);
    length[place] = text ? strnlen(text, LONGEST_TEXT) : 0;
    if (texts >> place & 1) wanted += 1 + (unsigned)(length[place] / TEXT_BYTES);
  }
  uint64_t at = atomic_fetch_add(&all->objects, wanted);
  if (at + wanted > OBJECT_RECORDS) {
    atomic_fetch_add(&all->dropped, 1);
    return;
  }
  uint64_t time = now(CLOCK_MONOTONIC);
  struct record *record = &all->object[at];
  memcpy(record->values, values, sizeof record->values);
  stamp(record, time);
  for (unsigned place = 0; place < 5; place++)
    for (size_t done = 0; texts >> place & 1 && done <= length[place]; done += TEXT_BYTES) {
      size_t left = length[place] - done;
      struct record *next = ++record;
      next->values[0] = 16 * length[place] + place;
      if (left)
        memcpy(&next->values[1], (const char *)(uintptr_t)values[place] + done,
               left < TEXT_BYTES ? left : TEXT_BYTES);
      stamp(next, time);
      atomic_store_explicit(&next->event, TEXT, memory_order_release);
    }
  atomic_store_explicit(&all->object[at].event, event, memory_order_release);
}

static void create(uint16_t event, unsigned texts, unsigned gid, uint64_t *values) {
  if (!thread.tid) thread.tid = (uint32_t)syscall(SYS_gettid);
  if (!is_ready()) return;
  if (gid && values[gid]) memcpy(&values[gid], (const void *)(uintptr_t)values[gid], 16);
  append(event, values, texts);
}

// A record's number is its event's place in ALL_EVENTS (`events.h`), from FIRST_EVENT on.
#define NUMBER(name, ...) number_##name,
enum { before_first = FIRST_EVENT - 1, ALL_EVENTS(NUMBER, NUMBER, NUMBER) };

// The names of loops that the user gave, of nodes (with a slash) and threads, each with a comma behind.
#define LOOPS "CHAINSHAPER_LOOPS"
#define THREAD_NAME 16u  // of the kernel, with the 0 at its end
static char loops[4096];
static bool names_threads;

__attribute__((constructor)) static void read_loops(void) {
  const char *given = getenv(LOOPS);
  size_t length = given ? strnlen(given, sizeof loops) : 0;
  if (!length || length + 2 > sizeof loops) return;
  memcpy(loops, given, length);
  loops[length] = ',';
  for (size_t at = 0; at < length; at++)
    names_threads = names_threads || (loops[at] != '/' && (at == 0 || loops[at - 1] == ','));
}

static bool is_named(const char *name, size_t length) {
  for (const char *at = loops; *at; at = strchr(at, ',') + 1)
    if (length && strncmp(at, name, length) == 0 && at[length] == ',') return true;
  return false;
}

static void created_node(const char *name, const char *space) {
  char full[512];
  if (!*loops || !name || !space) return;
  size_t before = strnlen(space, sizeof full), length = strnlen(name, sizeof full);
  if (before && space[before - 1] == '/') before--;
  if (before + length + 2 > sizeof full) return;
  memcpy(full, space, before);
  full[before] = '/';
  memcpy(&full[before + 1], name, length);
  full[before + 1 + length] = 0;
  if (!is_named(full, before + 1 + length)) return;
  has_named_node = true;
  create(number_loop_named, 1, 0, (uint64_t[6]){(uintptr_t)full, 0});
}

// Publishers of topics that every node has for itself, by their handles: a thread that only writes to
// the log is no loop. Of two with one place the later one counts.
static _Atomic uint64_t internal_publishers[1024];
#define PLACE(handle) (&internal_publishers[((handle) >> 4) % 1024])

static void created_publisher(uint64_t handle, const char *topic) {
  bool internal = topic && (!strcmp(topic, "/rosout") || !strcmp(topic, "/parameter_events"));
  if (internal || *PLACE(handle) == handle) *PLACE(handle) = internal ? handle : 0;
}

static void meet_python(void);

static void note_creation(unsigned event, const uint64_t *values) {
  if (event == number_rcl_init) meet_python();
  if (event == number_rcl_node_init)
    created_node((const char *)(uintptr_t)values[2], (const char *)(uintptr_t)values[3]);
  if (event == number_rcl_publisher_init)
    created_publisher(values[0], (const char *)(uintptr_t)values[3]);
}

// Callbacks whose end is never announced (they threw an exception, which a loop around its executor
// caught) would count for ever as running. What runs inside a callback lies deeper on the stack than
// the call that announced it, at lower addresses: so of whatever is called from further up, or from
// where another one is announced now, it is known that they are over.
#define HERE ((uintptr_t)__builtin_frame_address(0))

static inline void forget_over(uintptr_t frame) {
  while (thread.callbacks && thread.callbacks <= MOST_NESTED &&
         thread.callback[thread.callbacks - 1].frame < frame)
    thread.callbacks--;
}

static inline void began_callback(uint64_t handle, uintptr_t frame) {
  forget_over(frame + 1);
  if (thread.callbacks < MOST_NESTED) {
    thread.callback[thread.callbacks].handle = handle;
    thread.callback[thread.callbacks].frame = frame;
  }
  thread.callbacks++;
}

static inline void ended_callback(uint64_t handle) {
  if (thread.callbacks > MOST_NESTED) {
    thread.callbacks--;
    return;
  }
  for (unsigned place = thread.callbacks; place-- > 0;)
    if (thread.callback[place].handle == handle) {
      thread.callbacks = place;
      return;
    }
}

// From its first publication outside callbacks on a thread's sleeps are recorded.
static inline __attribute__((always_inline)) void note(unsigned event, uint64_t handle) {
  if (event == number_callback_start) began_callback(handle, HERE);
  if (event == number_callback_end) ended_callback(handle);
  bool publishes = event == number_rcl_publish || event == number_rclcpp_intra_publish;
  if (!publishes || thread.publishes || *PLACE(handle) == handle) return;
  if (thread.callbacks) forget_over(HERE);
  if (thread.callbacks) return;
  thread.publishes = true;
  write_record(number_thread_wake, 0, 1, (uint64_t[6]){0}, true);
}

#define ARGUMENTS uint64_t a, uint64_t b, uint64_t c, uint64_t d, uint64_t e
typedef void (*function)(ARGUMENTS);
typedef bool (*question)(void);

// The functions of an event: `ros_trace_<event>`; and since tracetools 6 `ros_trace_do_<event>`, which
// callers call if `ros_trace_enabled_<event>` returns true. Ours always does, since callers compute a
// callback's name only then; so whether the function behind is enabled is asked here. The function
// behind is looked up at the first call; it does no harm if several threads do so at once.
#define HOOK(name, write) \
  void ros_trace_##name(ARGUMENTS) { \
    static _Atomic(function) behind; \
    static _Atomic bool looked_up; \
    write; \
    if (!looked_up) { \
      behind = (function)function_behind("ros_trace_" #name); \
      looked_up = true; \
    } \
    if (behind) behind(a, b, c, d, e); \
  } \
  void ros_trace_do_##name(ARGUMENTS) { \
    write; \
    function behind = (function)function_behind("ros_trace_do_" #name); \
    question enabled = (question)function_behind("ros_trace_enabled_" #name); \
    if (behind && enabled && enabled()) behind(a, b, c, d, e); \
  } \
  bool ros_trace_enabled_##name(void) { return true; }

#define EVENT_HOOK(name, count, timed) \
  HOOK(name, thread.latest = number_##name; note(number_##name, a); \
       write_record(number_##name, 0, count, ((uint64_t[6]){a, b, c, d, e}), timed))
#define CREATION_HOOK(name, texts, gid) \
  HOOK(name, create(number_##name, texts, gid, (uint64_t[6]){a, b, c, d, e}); \
       note_creation(number_##name, (uint64_t[6]){a, b, c, d, e}))
#define NO_HOOK(name)
ALL_EVENTS(EVENT_HOOK, CREATION_HOOK, NO_HOOK)

#include "in_python.h"

struct request_id {
  uint8_t writer[16];
  int64_t number;
};

struct service_info {
  int64_t sent, received;
  struct request_id id;
};

static void write_call(uint16_t event, uint64_t time, const void *handle, const void *message,
                       const struct request_id *id, int64_t sent) {
  uint64_t values[6] = {(uintptr_t)handle, (uintptr_t)message, [5] = (uint64_t)sent};
  memcpy(&values[2], id, sizeof *id);
  write_record(event, time, 6, values, false);
}

#define BEHIND(name, ...) \
  static int (*_Atomic behind)(__VA_ARGS__); \
  if (!behind) behind = (int (*)(__VA_ARGS__))function_behind(#name)

int rmw_send_request(const void *client, const void *request, int64_t *number) {
  BEHIND(rmw_send_request, const void *, const void *, int64_t *);
  uint64_t began = now(CLOCK_MONOTONIC);  // it may be taken before its number is known
  int result = behind(client, request, number);
  if (result == 0)
    write_call(number_rmw_send_request, began, client, request,
               &(struct request_id){.number = *number}, 0);
  return result;
}

int rmw_send_response(const void *service, struct request_id *id, void *response) {
  BEHIND(rmw_send_response, const void *, struct request_id *, void *);
  write_call(number_rmw_send_response, 0, service, response, id, 0);
  return behind(service, id, response);
}

#define TAKE(name) \
  int name(const void *handle, struct service_info *info, void *message, bool *taken) { \
    BEHIND(name, const void *, struct service_info *, void *, bool *); \
    int result = behind(handle, info, message, taken); \
    if (result == 0 && *taken) \
      write_call(number_##name, 0, handle, message, &info->id, info->sent); \
    return result; \
  }
TAKE(rmw_take_request)
TAKE(rmw_take_response)

// From Lyrical on rmw_fastrtps_cpp takes messages with a field `uint8[]` in a way that has no event
// (`take_buffer_aware`); the time stamp is the first field of `rmw_message_info_t`.
int rmw_take_with_info(const void *subscription, void *message, bool *taken, int64_t *info,
                       void *allocation) {
  BEHIND(rmw_take_with_info, const void *, void *, bool *, int64_t *, void *);
  thread.latest = 0;
  int result = behind(subscription, message, taken, info, allocation);
  if (result == 0 && *taken && thread.latest != number_rmw_take)
    ros_trace_rmw_take((uintptr_t)subscription, (uintptr_t)message, (uint64_t)*info, true, 0);
  return result;
}

// Calls of timers: ros2_tracing has no event for them. Since Jazzy the first of these functions may
// call the second: it is one call then.
#define TIMER_CALL(name) \
  int name(uint64_t timer, uint64_t information) { \
    BEHIND(name, uint64_t, uint64_t); \
    bool outer = !thread.calls_timer; \
    thread.calls_timer = true; \
    int result = behind(timer, information); \
    if (!outer) return result; \
    thread.calls_timer = false; \
    if (!result) write_record(number_rcl_timer_call, 0, 1, (uint64_t[6]){timer}, false); \
    return result; \
  }
TIMER_CALL(rcl_timer_call)
TIMER_CALL(rcl_timer_call_with_info)

// How threads sleep. `until` is 0 where the call does not say it.
#define CALL_NUMBER(name) sleeps_by_##name,
enum { SLEEPING_CALLS(CALL_NUMBER) };
#define NO_SLEEP UINT64_MAX

#define FOR_EVER UINT64_MAX
#define LONGEST_SLEEP 4000000000  // s: the times of events have no room for much more

// Times that a program gives may be anything: the kernel refuses some, and that is the program's to
// see. Whoever calls these keeps errno, which an unknown clock sets.
static uint64_t in(uint64_t duration) {
  if (duration == FOR_EVER) return 0;
  return duration ? now(CLOCK_MONOTONIC) + duration : NO_SLEEP;
}

// A duration of `of_second` parts of a second beside whole ones; 0 if it is none.
static uint64_t duration(int64_t seconds, int64_t parts, int64_t of_second) {
  if (seconds < 0 || parts < 0 || parts >= of_second) return 0;
  if (seconds > LONGEST_SLEEP) return FOR_EVER;
  return (uint64_t)seconds * 1000000000u + (uint64_t)(parts * (1000000000 / of_second));
}

static uint64_t in_milliseconds(int time) {
  return time < 0 ? 0 : in((uint64_t)time * 1000000u);
}

static uint64_t in_time(const struct timespec *time) {
  return time ? in(duration(time->tv_sec, time->tv_nsec, 1000000000)) : 0;
}

static uint64_t in_timeval(const struct timeval *time) {
  if (!time) return 0;
  // The C library carries microseconds over, however many there are.
  return time->tv_usec < 0 ? NO_SLEEP
                           : in(duration(time->tv_sec + time->tv_usec / 1000000,
                                         time->tv_usec % 1000000, 1000000));
}

static uint64_t at(clockid_t clock, const struct timespec *time) {
  struct timespec there;
  uint64_t until = time ? duration(time->tv_sec, time->tv_nsec, 1000000000) : 0;
  if (!until || clock_gettime(clock, &there)) return NO_SLEEP;
  if (until == FOR_EVER) return 0;
  if (clock == CLOCK_MONOTONIC) return until;
  uint64_t passed = (uint64_t)there.tv_sec * 1000000000u + (uint64_t)there.tv_nsec;
  uint64_t here = now(CLOCK_MONOTONIC);
  return here + until > passed ? here + until - passed : 1;  // 1: before this machine started
}

// A condition variable does not say by which clock it waits. The wall clock shows decades, the other
// one the time since the machine started.
static uint64_t at_either(const struct timespec *time) {
  struct timespec wall;
  clock_gettime(CLOCK_REALTIME, &wall);
  return at(time && time->tv_sec > wall.tv_sec / 2 ? CLOCK_REALTIME : CLOCK_MONOTONIC, time);
}

// Whether the sleeps of this thread are recorded. Of the other threads of a process whose node is
// named, only those count that can do nothing but sleep: executors wait as well.
static bool is_followed(int call, uintptr_t frame) {
  if (!memory || !*memory_is_ours || thread.sleeps) return false;
  if (thread.callbacks) forget_over(frame);
  if (thread.callbacks) return false;
  if (thread.publishes || thread.is_named) return true;
  if (names_threads) {
    char name[THREAD_NAME] = "";
    prctl(PR_GET_NAME, name);
    thread.is_named = is_named(name, strnlen(name, THREAD_NAME));
    if (thread.is_named) create(number_loop_named, 1, 0, (uint64_t[6]){(uintptr_t)name, 1});
  }
  bool for_a_time =
    call == sleeps_by_clock_nanosleep || call == sleeps_by_nanosleep || call == sleeps_by_timerfd;
  return thread.is_named || (has_named_node && for_a_time);
}

static bool begin_sleep(int call, uint64_t until) {
  if (until == NO_SLEEP) return false;
  write_record(number_thread_sleep, 0, 2, (uint64_t[6]){until, (uint64_t)call}, true);
  return thread.sleeps = true;
}

static void end_sleep(int call) {
  int before = errno;
  thread.sleeps = false;
  write_record(number_thread_wake, 0, 1, (uint64_t[6]){(uint64_t)call}, true);
  errno = before;
}

// How a loop is moved. What is asked for, and where the loop counts from, decide what is added:
//
// * Loops that sleep until instants of their own (`sleep_until(next); next += period`, `rclcpp::Rate`)
//   do not move when one sleep is longer: it is added to each.
// * Where the next sleep follows from when the last one ended (`sleep_for`, the timer of a timerfd that
//   is set anew), it is added to one sleep.
//
// To know which, one sleep is made longer, and the loop looked at: whether the instants until which it
// wants to sleep have come as they did before. That shows only where they came regularly.
//
// What is added goes back at once where it changes the loop's rate: a loop that checks for overruns
// leaves out instances where too little time is left for its work.
enum { ASKED, KEPT, FOLLOWED, RATE_CHANGED, OVER };  // places in LOOP_MOVES
#define EXACT INT64_C(20000)     // ns: steps of a loop with its own instants differ by no more
#define PLAIN (4 * EXACT)       // a move by more shows where the loop counts from
#define SHORTEN 16              // a sleep is made shorter by no more than this part of the period
#define MOST_AGAINST 12u         // three signs in turn that the loop follows, six of instances left out
#define LONGEST_PERIOD 10000000000u
#define SHORTEST_PERIOD 10000u

static void note_move(int64_t added, unsigned why) {
  uint64_t values[6] = {thread.loop.number, thread.loop.move, (uint64_t)added, thread.loop.kept, why};
  write_record(number_loop_moved, 0, 5, values, false);
}

// How far a time is from whole periods of the loop, between half a period less and more.
static int64_t off_by(int64_t time) {
  int64_t period = (int64_t)thread.loop.period, rest = time % period;
  if (rest < 0) rest += period;
  return rest > period / 2 ? rest - period : rest;
}

static int64_t size_of(int64_t time) { return time < 0 ? -time : time; }

static bool has_exact_steps(void) {
  unsigned exact = 0;
  for (unsigned place = 0; place < STEPS; place++)
    exact += size_of(off_by(thread.loop.steps[place])) <= EXACT;
  return exact >= STEPS - 2;
}

// The request for this thread's loop; false: there is none, or it is being written.
static bool read_request(struct request *asked) {
  struct request *there = &thread.ring->asked;
  asked->number = there->number;
  asked->tid = there->tid;
  asked->move = there->move;
  asked->period = there->period;
  asked->until = there->until;
  uint64_t check = asked->number ^ asked->tid ^ asked->move ^ asked->period ^ asked->until ^ CHECK;
  return check == there->check && asked->number && asked->tid == thread.tid &&
         asked->period >= SHORTEST_PERIOD && asked->period <= LONGEST_PERIOD &&
         asked->move < asked->period;
}

// See what the sleep that was made longer has shown, or whether what is kept changes the rate.
static void see_step(int64_t step) {
  int64_t off = off_by(step), tried = off_by(thread.loop.tried);
  if (thread.loop.tried) {
    bool stays = size_of(off) < size_of(off - tried);
    thread.loop.counts = stays ? OWN_INSTANTS : FOLLOWS;
    thread.loop.kept = stays ? thread.loop.move : 0;
    thread.loop.tried = 0;
    note_move(0, stays ? KEPT : FOLLOWED);
    return;
  }
  if (!thread.loop.kept) return;
  int64_t kept = off_by((int64_t)thread.loop.kept);
  bool follows = size_of(off) > EXACT && size_of(off - kept) < size_of(off);
  bool leaves_out = step > (int64_t)(thread.loop.period + thread.loop.period / 2);
  if (follows || leaves_out)
    thread.loop.against += follows ? 4 : 2;
  else if (thread.loop.against)
    thread.loop.against--;
  if (thread.loop.against < MOST_AGAINST) return;
  int64_t back = -(int64_t)thread.loop.kept;
  thread.loop.against = 0;
  thread.loop.kept = 0;
  thread.loop.given_back = !follows;
  if (follows) thread.loop.counts = FOLLOWS;
  note_move(back, follows ? FOLLOWED : RATE_CHANGED);
}

// Begin to follow a request; return what is added to this sleep beside what is kept.
static int64_t follow(const struct request *asked) {
  uint64_t before = thread.loop.number ? thread.loop.move : 0;
  int64_t period = (int64_t)asked->period, change = (int64_t)asked->move - (int64_t)before;
  thread.loop.number = asked->number;
  thread.loop.move = asked->move;
  thread.loop.given_back = false;
  thread.loop.against = 0;
  if (thread.loop.counts == UNKNOWN && !has_exact_steps()) thread.loop.counts = FOLLOWS;
  bool is_plain = size_of(off_by(change)) >= PLAIN;
  if (thread.loop.counts == OWN_INSTANTS || (thread.loop.counts == UNKNOWN && !is_plain)) {
    thread.loop.kept = asked->move;
    note_move(change, KEPT);
    return 0;
  }
  if (change < -period / SHORTEN) change += period;
  if (change > period - period / SHORTEN) change -= period;
  if (thread.loop.counts == UNKNOWN) thread.loop.tried = change;
  note_move(change, thread.loop.counts == UNKNOWN ? ASKED : FOLLOWED);
  return change;
}

// What is added to the sleep of a loop that wants to sleep until then. `is_rest`: it may be what is
// left of a sleep that was interrupted.
static int64_t added_to(uint64_t wanted, bool is_rest) {
  struct request asked;
  if (!thread.ring || !*memory_is_ours) return 0;
  if (__builtin_expect(!thread.ring->asked.number, 1) && !thread.loop.number) return 0;
  bool goes_on = thread.loop.interrupted && is_rest;
  thread.loop.interrupted = false;
  if (goes_on) return 0;
  bool is_there = read_request(&asked);
  if (is_there) thread.loop.period = asked.period;
  if (!thread.loop.period) return 0;
  int64_t step = (int64_t)(wanted - thread.loop.wanted);
  bool again = thread.loop.wanted && size_of(step) < (int64_t)(thread.loop.period / 16);
  if (again) return thread.loop.added;  // until the same instant
  if (thread.loop.wanted) {
    thread.loop.steps[thread.loop.seen++ % STEPS] = step;
    see_step(step);
  }
  thread.loop.wanted = wanted;
  bool is_over = is_there && asked.until && now(CLOCK_MONOTONIC) > asked.until;
  int64_t added = 0;
  if (is_over && thread.loop.number && !thread.loop.given_back) {
    int64_t back = -(int64_t)thread.loop.kept;
    thread.loop.kept = thread.loop.move = 0;
    thread.loop.given_back = true;
    note_move(back, OVER);
  } else if (is_there && !is_over && asked.number != thread.loop.number &&
             thread.loop.seen >= STEPS) {
    added = follow(&asked);
  }
  return thread.loop.added = (int64_t)thread.loop.kept + added;
}

static struct timespec plus(const struct timespec *time, int64_t added) {
  int64_t rest = time->tv_nsec + added % 1000000000;
  struct timespec sum = {time->tv_sec + added / 1000000000 + rest / 1000000000, rest % 1000000000};
  if (sum.tv_nsec >= 0) return sum;
  sum.tv_nsec += 1000000000;
  sum.tv_sec--;
  return sum;
}

// Begin a sleep that may be moved: `time` becomes `moved` then. No sleep becomes one for no time.
static bool begin_movable(int call, uint64_t until, bool is_rest, const struct timespec **time,
                          struct timespec *moved) {
  if (until == NO_SLEEP) return false;
  int64_t added = until ? added_to(until, is_rest) : 0;
  if (added) {
    *moved = plus(*time, added);
    if (moved->tv_sec < 0) *moved = (struct timespec){0, 0};
    *time = moved;
  }
  return begin_sleep(call, until + (uint64_t)added);
}

// `behind_NAME`: the function of the C library behind ours. It is looked up when ours is loaded: these
// may be called in a signal's handler, where looking up is not allowed. Only what is called still
// earlier, by a library that is loaded before ours, looks it up itself. A program that looks for a
// function that its C library does not have finds ours, and is told that the kernel lacks it.
// NOLINTBEGIN(bugprone-macro-parentheses): in brackets a type, or a list of parameters, is none.
#define LIBC(type, name, parameters) \
  static type(*_Atomic behind_##name) parameters; \
  __attribute__((constructor)) static void find_##name(void) { \
    behind_##name = (type(*) parameters)dlsym(RTLD_NEXT, #name); \
  }
// NOLINTEND(bugprone-macro-parentheses)
#define IS_MISSING(name) (!behind_##name && (find_##name(), !behind_##name))

// Whether a sleep is recorded. What the call finds in errno is what the program left there.
#define BEGINS(call, until) ({ \
    int before = errno; \
    bool begins = is_followed(call, HERE) && begin_sleep(call, until); \
    errno = before; \
    begins; \
  })

#define SLEEPS(type, name, parameters, arguments, call, until, missing) \
  LIBC(type, name, parameters) \
  type name parameters { \
    if (IS_MISSING(name)) return missing; \
    bool recorded = BEGINS(sleeps_by_##call, until); \
    type result = behind_##name arguments; \
    if (recorded) end_sleep(sleeps_by_##call); \
    return result; \
  }
#define FAILS (errno = ENOSYS, -1)
typedef const struct timespec *time_of;

// Whether a sleep is recorded; `time` is another one then if the loop is moved.
#define BEGINS_MOVABLE(call, until, is_rest, moved) ({ \
    int before = errno; \
    bool begins = is_followed(call, HERE) && begin_movable(call, until, is_rest, &time, moved); \
    errno = before; \
    begins; \
  })

LIBC(int, clock_nanosleep, (clockid_t clock, int flags, time_of time, struct timespec *rest))
int clock_nanosleep(clockid_t clock, int flags, time_of time, struct timespec *rest) {
  if (IS_MISSING(clock_nanosleep)) return ENOSYS;
  const int call = sleeps_by_clock_nanosleep;
  const bool is_absolute = flags & TIMER_ABSTIME;
  struct timespec moved;
  bool recorded = BEGINS_MOVABLE(call, is_absolute ? at(clock, time) : in_time(time), !is_absolute,
                                 &moved);
  int result = behind_clock_nanosleep(clock, flags, time, rest);
  if (recorded) thread.loop.interrupted = result == EINTR && !is_absolute && rest;
  if (recorded) end_sleep(call);
  return result;
}

LIBC(int, nanosleep, (time_of time, struct timespec *rest))
int nanosleep(time_of time, struct timespec *rest) {
  if (IS_MISSING(nanosleep)) return FAILS;
  struct timespec moved;
  bool recorded = BEGINS_MOVABLE(sleeps_by_nanosleep, in_time(time), true, &moved);
  int result = behind_nanosleep(time, rest);
  if (recorded) thread.loop.interrupted = result && errno == EINTR && rest;
  if (recorded) end_sleep(sleeps_by_nanosleep);
  return result;
}

LIBC(int, usleep, (useconds_t time))
int usleep(useconds_t microseconds) {
  if (IS_MISSING(usleep)) return FAILS;
  struct timespec moved, given = {microseconds / 1000000, microseconds % 1000000 * 1000L};
  time_of time = &given;
  bool recorded = BEGINS_MOVABLE(sleeps_by_nanosleep, in_time(time), true, &moved);
  if (time == &moved)
    microseconds = (useconds_t)(moved.tv_sec * 1000000 + moved.tv_nsec / 1000);
  int result = behind_usleep(microseconds);
  if (recorded) end_sleep(sleeps_by_nanosleep);
  return result;
}

LIBC(int, pthread_cond_clockwait,
     (pthread_cond_t *condition, pthread_mutex_t *mutex, clockid_t clock, time_of time))
int pthread_cond_clockwait(pthread_cond_t *condition, pthread_mutex_t *mutex, clockid_t clock,
                           time_of time) {
  if (IS_MISSING(pthread_cond_clockwait)) return ENOSYS;
  const int call = sleeps_by_pthread_cond_clockwait;
  struct timespec moved;
  bool recorded = BEGINS_MOVABLE(call, at(clock, time), false, &moved);
  int result = behind_pthread_cond_clockwait(condition, mutex, clock, time);
  if (recorded) end_sleep(call);
  return result;
}

SLEEPS(unsigned, sleep, (unsigned time), (time), nanosleep, in((uint64_t)time * 1000000000u),
       time)
SLEEPS(int, poll, (struct pollfd *files, nfds_t count, int time), (files, count, time), poll,
       in_milliseconds(time), FAILS)
SLEEPS(int, ppoll, (struct pollfd *files, nfds_t count, time_of time, const sigset_t *signals),
       (files, count, time, signals), poll, in_time(time), FAILS)
SLEEPS(int, epoll_wait, (int file, struct epoll_event *events, int count, int time),
       (file, events, count, time), epoll_wait, in_milliseconds(time), FAILS)
SLEEPS(int, epoll_pwait,
       (int file, struct epoll_event *events, int count, int time, const sigset_t *signals),
       (file, events, count, time, signals), epoll_wait, in_milliseconds(time), FAILS)
SLEEPS(int, epoll_pwait2,
       (int file, struct epoll_event *events, int count, time_of time, const sigset_t *signals),
       (file, events, count, time, signals), epoll_wait, in_time(time), FAILS)
SLEEPS(int, select, (int count, fd_set *in_, fd_set *out, fd_set *errors, struct timeval *time),
       (count, in_, out, errors, time), select,
       in_timeval(time), FAILS)
SLEEPS(int, pselect,
       (int count, fd_set *in_, fd_set *out, fd_set *errors, time_of time, const sigset_t *signals),
       (count, in_, out, errors, time, signals), select, in_time(time), FAILS)

// Where the interpreter of Python lies in memory: its threads wait by a condition variable for the
// interpreter's lock, which is no sleep of theirs.
static struct {
  _Atomic bool known;
  uintptr_t begin, end;
} interpreter;

static int look_for_interpreter(struct dl_phdr_info *object, size_t size, void *function) {
  uintptr_t begin = UINTPTR_MAX, end = 0;
  (void)size;
  for (unsigned part = 0; part < object->dlpi_phnum; part++) {
    if (object->dlpi_phdr[part].p_type != PT_LOAD) continue;
    uintptr_t from = object->dlpi_addr + object->dlpi_phdr[part].p_vaddr;
    if (from < begin) begin = from;
    if (from + object->dlpi_phdr[part].p_memsz > end) end = from + object->dlpi_phdr[part].p_memsz;
  }
  if ((uintptr_t)function < begin || (uintptr_t)function >= end) return 0;
  interpreter.begin = begin;
  interpreter.end = end;
  return 1;
}

static bool is_of_interpreter(const void *caller) {
  if (!interpreter.known) {
    void *function = dlsym(RTLD_DEFAULT, "PyEval_SaveThread");
    if (function) dl_iterate_phdr(look_for_interpreter, function);
    interpreter.known = true;
  }
  return (uintptr_t)caller >= interpreter.begin && (uintptr_t)caller < interpreter.end;
}

static int (*_Atomic behind_pthread_cond_timedwait)(pthread_cond_t *, pthread_mutex_t *, time_of);

__attribute__((constructor)) static void find_pthread_cond_timedwait(void) {
  // On x86 there are two versions, and dlsym may find the one for programs from before 2003.
  void *function = dlvsym(RTLD_NEXT, "pthread_cond_timedwait", "GLIBC_2.3.2");
  if (!function) function = dlsym(RTLD_NEXT, "pthread_cond_timedwait");
  behind_pthread_cond_timedwait = (int (*)(pthread_cond_t *, pthread_mutex_t *, time_of))function;
}

int pthread_cond_timedwait(pthread_cond_t *condition, pthread_mutex_t *mutex, time_of time) {
  if (IS_MISSING(pthread_cond_timedwait)) return ENOSYS;
  const int call = sleeps_by_pthread_cond_timedwait;
  const void *caller = __builtin_return_address(0);
  struct timespec moved;
  bool recorded = BEGINS_MOVABLE(call, is_of_interpreter(caller) ? NO_SLEEP : at_either(time), false,
                                 &moved);
  int result = behind_pthread_cond_timedwait(condition, mutex, time);
  if (recorded) end_sleep(call);
  return result;
}

// A thread that waits without a time is paced by whoever signals the condition.
static int (*_Atomic behind_pthread_cond_wait)(pthread_cond_t *, pthread_mutex_t *);

__attribute__((constructor)) static void find_pthread_cond_wait(void) {
  void *function = dlvsym(RTLD_NEXT, "pthread_cond_wait", "GLIBC_2.3.2");  // as above
  if (!function) function = dlsym(RTLD_NEXT, "pthread_cond_wait");
  behind_pthread_cond_wait = (int (*)(pthread_cond_t *, pthread_mutex_t *))function;
}

int pthread_cond_wait(pthread_cond_t *condition, pthread_mutex_t *mutex) {
  if (IS_MISSING(pthread_cond_wait)) return ENOSYS;
  const int call = sleeps_by_pthread_cond_wait;
  const void *caller = __builtin_return_address(0);
  bool recorded = BEGINS(call, is_of_interpreter(caller) ? NO_SLEEP : 0);
  int result = behind_pthread_cond_wait(condition, mutex);
  if (recorded) end_sleep(call);
  return result;
}

// Files of timers, as bits; a bit stays when its file is closed, so the kernel is asked as well.
static _Atomic uint64_t timer_files[64];

LIBC(int, timerfd_create, (int clock, int flags))
int timerfd_create(int clock, int flags) {
  if (IS_MISSING(timerfd_create)) return FAILS;
  int file = behind_timerfd_create(clock, flags);
  if (file >= 0 && file < 64 * 64) timer_files[file / 64] |= UINT64_C(1) << file % 64;
  return file;
}

// Whether reading a file sleeps until a timer expires.
static bool is_timer(int file) {
  if (file < 0 || file >= 64 * 64 || !(timer_files[file / 64] >> file % 64 & 1)) return false;
  struct itimerspec left;
  int before = errno;
  bool sleeps = !(fcntl(file, F_GETFL) & O_NONBLOCK) && timerfd_gettime(file, &left) == 0;
  errno = before;
  return sleeps;
}

// Set a timer later whose loop is to be moved. One that has expired already is left alone: setting it
// would take the expiry away.
static void move_timer(int file) {
  struct pollfd expired = {.fd = file, .events = POLLIN};
  struct itimerspec left;
  int before = errno;
  bool waits = behind_poll && behind_poll(&expired, 1, 0) == 0 && timerfd_gettime(file, &left) == 0;
  uint64_t until = waits ? in(duration(left.it_value.tv_sec, left.it_value.tv_nsec, 1000000000)) : 0;
  int64_t added = until && until != NO_SLEEP ? added_to(until, false) : 0;
  if (added) {
    left.it_value = plus(&left.it_value, added);
    bool is_left = left.it_value.tv_sec > 0 || (!left.it_value.tv_sec && left.it_value.tv_nsec > 0);
    if (is_left) timerfd_settime(file, 0, &left, NULL);
  }
  errno = before;
}

LIBC(ssize_t, read, (int file, void *buffer, size_t size))
ssize_t read(int file, void *buffer, size_t size) {
  if (IS_MISSING(read)) return FAILS;
  const int call = sleeps_by_timerfd;
  bool recorded = is_timer(file) && BEGINS(call, 0);
  if (recorded && thread.ring && thread.ring->asked.number) move_timer(file);
  ssize_t result = behind_read(file, buffer, size);
  if (recorded) end_sleep(call);
  return result;
}

// An executor waits for work. Whatever the middleware waits by is no sleep of its own then.
struct duration {  // rmw_time_t
  uint64_t seconds, nanoseconds;
};

static uint64_t until_work(const struct duration *time) {
  if (!time || time->seconds > LONGEST_SLEEP) return 0;  // for ever
  return in(time->seconds * 1000000000u + time->nanoseconds);
}

int rmw_wait(void *subscriptions, void *conditions, void *services, void *clients, void *events,
             void *set, const struct duration *time) {
  BEHIND(rmw_wait, void *, void *, void *, void *, void *, void *, const struct duration *);
  bool recorded =
    (thread.publishes || thread.is_named) && BEGINS(sleeps_by_rmw_wait, until_work(time));
  int result = behind(subscriptions, conditions, services, clients, events, set, time);
  if (recorded) end_sleep(sleeps_by_rmw_wait);
  return result;
}

// The functions of ros2_control's controller manager, by their names as the compiler has them:
// `read`, `update` and `write` of `controller_manager::ControllerManager`, with a `const rclcpp::Time &`
// and a `const rclcpp::Duration &`. `update` returns an enumeration of a byte, the others nothing:
// the register goes through as it is. They may throw: this file is compiled so that exceptions pass.
#define OF_MANAGER(name) _ZN18controller_manager17ControllerManager##name##ERKN6rclcpp4TimeERKNS1_8DurationE
#define NAME_OF_NODE "_ZNK6rclcpp4Node24get_fully_qualified_nameEv"
#define TEXT_OF(name) #name
#define AS_TEXT(name) TEXT_OF(name)

// The function of this name behind ours, for a caller that linked it. A plugin's libraries (Gazebo's)
// are not in the scope that RTLD_NEXT searches, but in that of the plugin, which calls.
static void *function_of_caller(const char *name, const void *caller) {
  void *address = dlsym(RTLD_NEXT, name);
  Dl_info plugin;
  if (address || !dladdr(caller, &plugin) || !plugin.dli_fname) return address;
  void *library = dlopen(plugin.dli_fname, RTLD_LAZY | RTLD_NOLOAD);
  return library ? dlsym(library, name) : NULL;
}

// At the first call of a manager: say which node it is. A controller manager is a `rclcpp::Node`.
// From here on the sleeps of its thread are recorded, too: until when it wanted to sleep.
static void meet_manager(uintptr_t manager, const void *caller) {
  thread.is_named = true;
  for (unsigned place = 0; place < MANAGERS; place++) {
    uintptr_t known = 0;
    if (managers[place] == manager) return;
    if (!atomic_compare_exchange_strong(&managers[place], &known, manager)) {
      if (known == manager) return;
      continue;
    }
    const char *(*name_of)(uintptr_t) =
      (const char *(*)(uintptr_t))function_of_caller(NAME_OF_NODE, caller);
    const char *name = name_of ? name_of(manager) : NULL;
    create(number_controller_manager_found, 2, 0, (uint64_t[6]){manager, (uintptr_t)name});
    return;
  }
}

// Without us a program that lacks the function would not have started.
static void *behind_manager(const char *name, const void *caller) {
  void *function = function_of_caller(name, caller);
  if (function) return function;
  static const char reason[] = "chainshaper: libcontroller_manager.so is loaded in a way that hides "
                               "it; run the node without LD_PRELOAD\n";
  if (syscall(SYS_write, 2, reason, sizeof reason - 1) < 0) abort();
  abort();
}

#define MANAGER_CALL(name, place) \
  uint64_t OF_MANAGER(name)(uintptr_t manager, const void *time, const void *period) { \
    static uint64_t (*_Atomic behind)(uintptr_t, const void *, const void *); \
    const void *caller = __builtin_return_address(0); \
    if (!behind) \
      behind = (uint64_t(*)(uintptr_t, const void *, const void *))behind_manager( \
        AS_TEXT(OF_MANAGER(name)), caller); \
    int before = errno; \
    meet_manager(manager, caller); \
    bool recorded = (thread.ring && *memory_is_ours) || has_ring(); \
    uint64_t began = now(CLOCK_MONOTONIC), used = thread_time(began); \
    errno = before; \
    uint64_t result = behind(manager, time, period); \
    before = errno; \
    if (recorded) \
      write_record(number_controller_manager_call, 0, 5, \
                   (uint64_t[6]){manager, place, 0, began, used}, true); \
    errno = before; \
    return result; \
  }
MANAGER_CALL(4read, 0)
MANAGER_CALL(6update, 1)
MANAGER_CALL(5write, 2)
