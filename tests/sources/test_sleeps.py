"""How threads sleep, as the library in front of ROS 2 sees it: programs with loops."""

import shutil
import subprocess
import sys
from pathlib import Path

import polars as pl
import pytest
from traced_program import Traced, traced

from chainshaper.analysis.loops import thread_turns
from chainshaper.sources.preload import PreloadTracer, named_loops
from chainshaper.values.errors import InputError
from chainshaper.values.event_declarations import SLEEPING_CALLS

pytestmark = [
    pytest.mark.waiting,
    pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed"),
]
TURNS = 20

PROGRAM = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <poll.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/select.h>
#include <sys/syscall.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

typedef void (*event)(uint64_t, uint64_t, uint64_t, uint64_t, uint64_t);
static void emit(const char *name, uint64_t a, uint64_t b, uint64_t c, uint64_t d) {
  event function = (event)dlsym(RTLD_DEFAULT, name);
  if (function) function(a, b, c, d, 0);
}
static struct timespec later(clockid_t clock, long ns) {
  struct timespec time;
  clock_gettime(clock, &time);
  time.tv_nsec += ns;
  if (time.tv_nsec >= 1000000000) time.tv_nsec -= 1000000000, time.tv_sec++;
  return time;
}
static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t of_wall_clock = PTHREAD_COND_INITIALIZER, of_steady_clock;
static pthread_cond_t signalled = PTHREAD_COND_INITIALIZER;
static int timer, waiting;
static void *signals_again_and_again(void *unused) {
  for (;;) {
    nanosleep(&(struct timespec){0, 2000000}, NULL);
    pthread_mutex_lock(&mutex);
    pthread_cond_signal(&signalled);
    pthread_mutex_unlock(&mutex);
  }
  return unused;
}
// A callback that is announced deep on the stack, and whose end is not.
static __attribute__((noinline)) void throws(int depth) {
  volatile char frame[512];
  frame[0] = (char)depth;
  if (depth) throws(depth - 1);
  else emit("ros_trace_callback_start", 7, 0, 0, 0);
  frame[1] = frame[0];
}
int rmw_wait(void *, void *, void *, void *, void *, void *, const uint64_t *);

static void rest(const char *by) {
  const long ms = 2000000;
  struct timespec time = {0, ms}, monotonic = later(CLOCK_MONOTONIC, ms);
  struct timespec wall = later(CLOCK_REALTIME, ms);
  struct epoll_event none;
  uint64_t times;
  if (!strcmp(by, "absolute")) clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &monotonic, NULL);
  if (!strcmp(by, "wall")) clock_nanosleep(CLOCK_REALTIME, TIMER_ABSTIME, &wall, NULL);
  if (!strcmp(by, "nanosleep")) nanosleep(&time, NULL);
  if (!strcmp(by, "usleep")) usleep(2000);
  if (!strcmp(by, "poll")) poll(NULL, 0, 2);
  if (!strcmp(by, "ppoll")) ppoll(NULL, 0, &time, NULL);
  if (!strcmp(by, "epoll")) epoll_wait(waiting, &none, 1, 2);
  if (!strcmp(by, "epoll2")) epoll_pwait2(waiting, &none, 1, &time, NULL);
  if (!strcmp(by, "select")) select(0, NULL, NULL, NULL, &(struct timeval){0, 2000});
  if (!strcmp(by, "timerfd") && read(timer, &times, 8) != 8) puts("no timer");
  if (!strcmp(by, "rmw")) rmw_wait(0, 0, 0, 0, 0, 0, (uint64_t[2]){0, 2000000});
  if (!strcmp(by, "poll again")) poll(NULL, 0, 0);
  pthread_mutex_lock(&mutex);
  if (!strcmp(by, "timedwait")) pthread_cond_timedwait(&of_wall_clock, &mutex, &wall);
  if (!strcmp(by, "steady")) pthread_cond_timedwait(&of_steady_clock, &mutex, &monotonic);
  if (!strcmp(by, "for ever")) pthread_cond_wait(&signalled, &mutex);
  if (!strcmp(by, "clockwait"))
    pthread_cond_clockwait(&of_wall_clock, &mutex, CLOCK_MONOTONIC, &monotonic);
  pthread_mutex_unlock(&mutex);
}
static void *loop(void *by_and_what) {
  const char **words = by_and_what;
  for (int turn = 0; turn < 20; turn++) {
    if (strstr(words[1], "throws")) throws(3);
    if (strstr(words[1], "callback")) emit("ros_trace_callback_start", 7, 0, 0, 0);
    if (strstr(words[1], "within")) throws(3);
    if (strstr(words[1], "publish")) emit("ros_trace_rcl_publish", 0x50, 1, 0, 0);
    if (strstr(words[1], "log")) emit("ros_trace_rcl_publish", 0x60, 1, 0, 0);
    rest(words[0]);
    if (strstr(words[1], "callback")) emit("ros_trace_callback_end", 7, 0, 0, 0);
  }
  return NULL;
}
int main(int count, const char **words) {
  pthread_condattr_t steady;
  pthread_condattr_init(&steady);
  pthread_condattr_setclock(&steady, CLOCK_MONOTONIC);
  pthread_cond_init(&of_steady_clock, &steady);
  waiting = epoll_create1(0);
  timer = timerfd_create(CLOCK_MONOTONIC, 0);
  struct itimerspec every = {{0, 2000000}, {0, 2000000}};
  timerfd_settime(timer, 0, &every, NULL);
  emit("ros_trace_rcl_node_init", 1, 2, (uintptr_t)"actor", (uintptr_t)"/robot");
  emit("ros_trace_rcl_publisher_init", 0x60, 1, 3, (uintptr_t)"/rosout");
  emit("ros_trace_rcl_take", 1, 0, 0, 0);
  pthread_t signalling;
  if (!strcmp(words[1], "for ever"))
    pthread_create(&signalling, NULL, signals_again_and_again, NULL);
  for (int word = 1; word + 1 < count; word += 2) {
    pthread_t thread;
    pthread_create(&thread, NULL, loop, &words[word]);
    char name[16];
    snprintf(name, sizeof name, "by %s", words[word]);
    if (strchr(words[word + 1], '!')) pthread_setname_np(thread, "named");
    pthread_join(thread, NULL);
  }
  return 0;
}
"""
MIDDLEWARE = r"""
#include <pthread.h>
#include <stdint.h>
#include <time.h>
static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t ready = PTHREAD_COND_INITIALIZER;
int rmw_wait(void *a, void *b, void *c, void *d, void *e, void *f, const uint64_t *time) {
  struct timespec until;
  clock_gettime(CLOCK_REALTIME, &until);
  until.tv_nsec += (long)time[1];
  if (until.tv_nsec >= 1000000000) until.tv_nsec -= 1000000000, until.tv_sec++;
  pthread_mutex_lock(&mutex);
  pthread_cond_timedwait(&ready, &mutex, &until);
  return pthread_mutex_unlock(&mutex);
}
"""
"""An RMW waits by a condition variable, which is no sleep of the thread's own."""

STRANGE_CALLS = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <limits.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <sys/epoll.h>
#include <sys/select.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

typedef void (*event)(uint64_t, uint64_t, uint64_t, uint64_t, uint64_t);
static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t condition = PTHREAD_COND_INITIALIZER;
static void publish(void) {
  event function = (event)dlsym(RTLD_DEFAULT, "ros_trace_rcl_publish");
  if (function) function(0x50, 1, 0, 0, 0);
}
static void create_node(void) {
  event function = (event)dlsym(RTLD_DEFAULT, "ros_trace_rcl_node_init");
  if (function) function(1, 2, (uintptr_t)"actor", (uintptr_t)"/robot", 0);
}
static void on_alarm(int number) { (void)number; }
static void on_end(void *name) { printf("%s ends, errno %d\n", (const char *)name, errno); }
#define SHOW(call) do { \
    errno = 77; \
    long result = (long)(call); \
    printf("%s: %ld, errno %d\n", #call, result, errno); \
  } while (0)
#define TIME(seconds, rest) (&(struct timespec){seconds, rest})
#define TIMEVAL(seconds, rest) (&(struct timeval){seconds, rest})
#define SHOW_LOCKED(call) do { \
    pthread_mutex_lock(&mutex); \
    SHOW(call); \
    pthread_mutex_unlock(&mutex); \
  } while (0)
static void *sleeper(void *unused) {
  publish();
  pthread_cleanup_push(on_end, "a sleeper that is cancelled");
  errno = 77;
  for (;;) nanosleep(TIME(LONG_MAX, 0), NULL);
  pthread_cleanup_pop(0);
  return unused;
}
int main(void) {
  struct epoll_event none;
  char bytes[8];
  int waiting = epoll_create1(0), timer = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK);
  pthread_t thread;
  create_node();
  publish();
  SHOW(nanosleep(TIME(-1, 0), NULL));
  SHOW(nanosleep(TIME(0, 1000000000), NULL));
  SHOW(nanosleep(TIME(0, 0), NULL));
  SHOW(nanosleep(TIME(0, 1000000), NULL));
  SHOW(clock_nanosleep(1234, 0, TIME(0, 1000), NULL));
  SHOW(clock_nanosleep(1234, TIMER_ABSTIME, TIME(0, 1000), NULL));
  SHOW(clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, TIME(-1, 0), NULL));
  SHOW(clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, NULL, NULL));
  SHOW(clock_nanosleep(CLOCK_REALTIME, TIMER_ABSTIME, TIME(1, 0), NULL));
  SHOW(usleep(0));
  SHOW(sleep(0));
  SHOW(poll(NULL, 0, 0));
  SHOW(poll(NULL, 0, 1));
  SHOW(ppoll(NULL, 0, TIME(-1, 0), NULL));
  SHOW(epoll_wait(waiting, &none, 0, 1));
  SHOW(epoll_wait(-1, &none, 1, 1));
  SHOW(epoll_pwait2(waiting, &none, 1, TIME(0, 2000000000), NULL));
  SHOW(select(0, NULL, NULL, NULL, TIMEVAL(0, -1)));
  SHOW(select(0, NULL, NULL, NULL, TIMEVAL(0, 0)));
  SHOW(select(-1, NULL, NULL, NULL, TIMEVAL(0, 1)));
  SHOW(read(timer, bytes, 8));
  SHOW(read(-1, bytes, 8));
  SHOW(read(1 << 20, bytes, 8));
  SHOW(timerfd_create(1234, 0));
  SHOW_LOCKED(pthread_cond_timedwait(&condition, &mutex, TIME(0, -1)));
  SHOW_LOCKED(pthread_cond_timedwait(&condition, &mutex, TIME(0, 0)));
  SHOW_LOCKED(pthread_cond_clockwait(&condition, &mutex, 1234, TIME(1, 0)));
  SHOW_LOCKED(pthread_cond_clockwait(&condition, &mutex, CLOCK_MONOTONIC, TIME(0, -1)));
  sigaction(SIGALRM, &(struct sigaction){.sa_handler = on_alarm}, NULL);
  timer_t alarms;
  timer_create(CLOCK_MONOTONIC, NULL, &alarms);
  timer_settime(alarms, 0, &(struct itimerspec){{0, 20000000}, {0, 20000000}}, NULL);
  SHOW(nanosleep(TIME(LONG_MAX, 0), NULL));
  SHOW(clock_nanosleep(CLOCK_REALTIME, TIMER_ABSTIME, TIME(LONG_MAX, 0), NULL));
  SHOW(select(0, NULL, NULL, NULL, TIMEVAL(2000000000, 5000000)));
  SHOW(poll(NULL, 0, -1));
  timer_delete(alarms);
  pthread_create(&thread, NULL, sleeper, NULL);
  usleep(1000);
  pthread_cancel(thread);
  pthread_join(thread, NULL);
  return 0;
}
"""
"""Calls with times that are none, and with times that never come, and what they return."""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("program")
    middleware, program = folder / "librmw.so", folder / "loops"
    words = ["gcc", "-O1", "-x", "c", "-"]
    library = [*words, "-shared", "-fPIC", "-o", str(middleware)]
    subprocess.run(library, input=MIDDLEWARE.encode(), check=True)
    linked = ["-o", str(program), "-x", "none", str(middleware), "-lpthread", "-ldl"]
    subprocess.run([*words, *linked], input=PROGRAM.encode(), check=True)
    return program


def run(program: Path, folder: Path, *words: str, loops: tuple[str, ...] = ()) -> Traced:
    def start() -> list[list[str]]:
        subprocess.run([str(program), *words], check=True, timeout=60)
        return []

    return traced(PreloadTracer(folder, ["command"], (), None, loops), start)


def sleeps(traced_run: Traced) -> pl.DataFrame:
    """Each sleep, with the wake-up behind it."""
    slept, woke = (traced_run.tables[f"thread_{name}"] for name in ("sleep", "wake"))
    woke = woke.filter(pl.col("call") != 0)
    assert slept["call"].to_list() == woke["call"].to_list()
    return slept.with_columns(woke=woke["time"])


def test_calls_return_the_same_as_without_the_library(tmp_path: Path) -> None:
    """Also errno is the same; and a sleep that is refused is none, and one for ever has no end."""
    program = tmp_path / "calls"
    words = ["gcc", "-O1", "-x", "c", "-", "-o", str(program), "-lpthread", "-ldl", "-lrt"]
    subprocess.run(words, input=STRANGE_CALLS.encode(), check=True)

    def shown() -> list[str]:
        ran = subprocess.run([program], check=True, timeout=60, capture_output=True, text=True)
        return ran.stdout.splitlines()

    seen = list[list[str]]()

    def start() -> list[list[str]]:
        seen.append(shown())
        return []

    slept = traced(PreloadTracer(tmp_path, ["command"], ()), start).tables
    assert seen == [shown()]
    assert len(seen[0]) == 33 and "is cancelled ends" in seen[0][-1]
    until = slept["thread_sleep"]["until"]
    assert (until >= 0).all()
    assert (
        until == 0
    ).sum() == 4  # nanosleep, clock_nanosleep and poll for ever; the cancelled one
    woke = slept["thread_wake"].filter(pl.col("call") != 0)
    assert slept["thread_sleep"].height == woke.height + 1


CALLS = {
    "absolute": "clock_nanosleep",
    "wall": "clock_nanosleep",
    "nanosleep": "nanosleep",
    "usleep": "nanosleep",
    "timedwait": "pthread_cond_timedwait",
    "steady": "pthread_cond_timedwait",
    "clockwait": "pthread_cond_clockwait",
    "poll": "poll",
    "ppoll": "poll",
    "epoll": "epoll_wait",
    "epoll2": "epoll_wait",
    "select": "select",
    "timerfd": "timerfd",
    "rmw": "rmw_wait",
}


@pytest.mark.parametrize(("by", "call"), CALLS.items(), ids=CALLS)
def test_a_thread_that_publishes_is_seen_to_sleep(
    program: Path, tmp_path: Path, by: str, call: str
) -> None:
    traced_run = run(program, tmp_path, by, "publish")
    slept = sleeps(traced_run)
    assert slept["call"].to_list() == [SLEEPING_CALLS.index(call)] * TURNS
    if by == "timerfd":  # it does not say until when
        assert (slept["until"] == 0).all()
        return
    # What a poll rounds up, and a machine that is busy delays, is never earlier than wanted.
    assert (slept["until"] > slept["time"] + 1_000_000).all()
    assert (slept["until"] < slept["time"] + 1_000_000_000).all()
    assert (slept["woke"] >= slept["until"] - 100_000).all()
    used = traced_run.tables["thread_wake"]["thread_time"].diff().drop_nulls()
    assert (used >= 0).all()


def test_the_first_publication_outside_callbacks_says_that_the_thread_is_followed(
    program: Path, tmp_path: Path
) -> None:
    tables = run(program, tmp_path, "absolute", "publish").tables
    first = tables["thread_wake"].row(0, named=True)
    assert first["call"] == SLEEPING_CALLS.index("none")
    assert first["time"] <= tables["rcl_publish"]["time"][0]


def test_a_wait_without_a_time_is_seen_where_nothing_else_paces_the_thread(
    program: Path, tmp_path: Path
) -> None:
    """It says no time; another thread signals the condition every 2 ms."""
    for what, loops in (("publish", ()), ("nothing!", ("named",))):
        folder = tmp_path / what
        folder.mkdir()
        traced_run = run(program, folder, "for ever", what, loops=loops)
        slept = sleeps(traced_run)
        assert set(slept["call"]) == {SLEEPING_CALLS.index("pthread_cond_wait")}
        assert slept.height >= TURNS - 2, "a thread gets its name while it runs"
        assert (slept["until"] == 0).all()
        assert thread_turns(traced_run.tables)["due"].null_count() == slept.height
    without = run(program, tmp_path, "for ever", "nothing", loops=("/robot/actor",)).tables
    of_threads = without.get("thread_sleep", pl.DataFrame({"call": []}))
    assert SLEEPING_CALLS.index("pthread_cond_wait") not in of_threads["call"]


def test_a_callback_whose_end_never_comes_does_not_hide_the_loop_behind_it(
    program: Path, tmp_path: Path
) -> None:
    """It threw an exception, and the loop around its executor went on."""
    assert sleeps(run(program, tmp_path, "absolute", "throws publish")).height == TURNS


@pytest.mark.parametrize("what", ["nothing", "log", "callback publish", "callback within publish"])
def test_threads_that_are_no_loops_are_left_alone(program: Path, tmp_path: Path, what: str) -> None:
    """Those that only log, and those whose callbacks publish and sleep.

    Also within a callback in which another one ended without a word.
    """
    tables = run(program, tmp_path, "absolute", what).tables
    assert not {"thread_sleep", "thread_wake", "loop_named"} & tables.keys()


def test_a_look_that_waits_for_nothing_is_no_sleep(program: Path, tmp_path: Path) -> None:
    assert "thread_sleep" not in run(program, tmp_path, "poll again", "publish").tables


def test_a_loop_that_is_named_by_its_node_need_not_publish(program: Path, tmp_path: Path) -> None:
    traced_run = run(program, tmp_path, "absolute", "nothing", loops=("/robot/actor", "/other"))
    named = traced_run.tables["loop_named"].select("name", "is_thread").rows()
    assert named == [("/robot/actor", 0)]
    assert sleeps(traced_run).height == TURNS
    (note,) = (n for n in traced_run.info.notes if "not seen" in n)
    assert "/other" in note and "no node of this name was created" in note


def test_what_may_wait_for_data_counts_only_for_a_named_thread(
    program: Path, tmp_path: Path
) -> None:
    words, loops = ("timedwait", "nothing"), ("/robot/actor",)
    traced_run = run(program, tmp_path, *words, loops=loops)
    assert "thread_sleep" not in traced_run.tables
    (note,) = (n for n in traced_run.info.notes if "not seen" in n)
    assert "name its thread" in note


def test_a_loop_that_is_named_by_its_thread(program: Path, tmp_path: Path) -> None:
    traced_run = run(program, tmp_path, "timedwait", "nothing!", loops=("named", "absent"))
    assert set(traced_run.tables["loop_named"]["name"]) == {"named"}
    assert sleeps(traced_run).height >= TURNS - 2, "the thread gets its name while it runs"
    (note,) = (n for n in traced_run.info.notes if "not seen" in n)
    assert "absent" in note and "no thread of this name" in note


def test_a_thread_of_python_that_waits_for_the_interpreter_does_not_sleep(tmp_path: Path) -> None:
    """Two threads compute: each waits for the other by a condition variable, 5 ms at a time."""
    program = """
import ctypes, threading, time
library = ctypes.CDLL(None)
def compute():
    until = time.monotonic() + 0.3
    while time.monotonic() < until:
        library.ros_trace_rcl_publish(ctypes.c_uint64(80), ctypes.c_uint64(1))
threads = [threading.Thread(target=compute) for _ in range(2)]
for thread in threads: thread.start()
for thread in threads: thread.join()
"""

    def start() -> list[list[str]]:
        subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
        return []

    tables = traced(PreloadTracer(tmp_path, ["command"], ()), start).tables
    assert "rcl_publish" in tables
    assert "thread_sleep" not in tables


@pytest.mark.parametrize(
    ("name", "said"),
    [
        *((name, "names no loop") for name in ("", " ", "a,b", "/a b", "/a ")),
        ("a_name_of_18_bytes", "no thread"),
    ],
)
def test_names_that_no_loop_can_have_are_refused(name: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        named_loops.names_text([name])


def test_a_threads_name_may_have_a_space() -> None:
    assert named_loops.names_text(["control loop", "/actor"]) == "control loop,/actor"
