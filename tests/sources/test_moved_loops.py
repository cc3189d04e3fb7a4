"""Loops that are moved by the library in front of ROS 2: real programs, each with its own loop."""

import contextlib
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from chainshaper.flow.loop_phase import phase_of
from chainshaper.linux.threads import list_threads
from chainshaper.sources.preload import LoopMover, PreloadTracer, move_loop
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.event_declarations import LOOP_MOVES

pytestmark = [
    pytest.mark.timed,
    pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed"),
]
MS = 1_000_000
PERIOD = 10 * MS
NEAR = PERIOD // 10  # how exactly a busy machine lets a loop be seen where it is

PROGRAM = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

typedef void (*event)(uint64_t, uint64_t, uint64_t, uint64_t, uint64_t);
static void publish(void) {
  event function = (event)dlsym(RTLD_DEFAULT, "ros_trace_rcl_publish");
  if (function) function(0x50, 1, 0, 0, 0);
}
static int64_t now(void) {
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return time.tv_sec * 1000000000LL + time.tv_nsec;
}
static struct timespec spec(int64_t ns) {
  return (struct timespec){ns / 1000000000, ns % 1000000000};
}
static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t condition = PTHREAD_COND_INITIALIZER;
static void work(int64_t ns) { for (int64_t until = now() + ns; now() < until;) continue; }
static void on_alarm(int number) { (void)number; }

int main(int count, char **words) {
  const char *by = words[1];
  const int64_t period = atoll(words[2]), busy = count > 3 ? atoll(words[3]) : 200000;
  int64_t next = now() + period;
  int timer = timerfd_create(CLOCK_MONOTONIC, 0);
  struct itimerspec every = {spec(period), spec(period)};
  if (!strcmp(by, "timer")) timerfd_settime(timer, 0, &every, NULL);
  if (!strcmp(by, "signals")) {
    sigaction(SIGALRM, &(struct sigaction){.sa_handler = on_alarm}, NULL);
    timer_t alarms;
    timer_create(CLOCK_MONOTONIC, NULL, &alarms);
    timer_settime(alarms, 0, &(struct itimerspec){{0, 370700000}, {0, 370700000}}, NULL);
  }
  sched_setscheduler(0, SCHED_FIFO, &(struct sched_param){.sched_priority = 60});  // if permitted
  puts("ready");
  fflush(stdout);
  for (;;) {
    publish();
    work(busy);
    struct timespec time = spec(next), left = spec(next > now() ? next - now() : 1);
    uint64_t times;
    if (!strcmp(by, "absolute")) clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &time, NULL);
    if (!strcmp(by, "wall")) {
      struct timespec wall;
      clock_gettime(CLOCK_REALTIME, &wall);
      int64_t offset = wall.tv_sec * 1000000000LL + wall.tv_nsec - now();
      time = spec(next + offset);
      clock_nanosleep(CLOCK_REALTIME, TIMER_ABSTIME, &time, NULL);
    }
    if (!strcmp(by, "rate")) nanosleep(&left, NULL);  // the rest of the period, as rclcpp::Rate
    if (!strcmp(by, "signals")) while (nanosleep(&left, &left)) continue;
    if (!strcmp(by, "relative")) {  // a period behind the end of the last sleep
      left = spec(period - busy);
      nanosleep(&left, NULL);
    }
    if (!strcmp(by, "usleep")) usleep((period - busy) / 1000);
    if (!strcmp(by, "condition") || !strcmp(by, "steady")) {
      pthread_mutex_lock(&mutex);
      while (pthread_cond_clockwait(&condition, &mutex, CLOCK_MONOTONIC, &time) == 0) continue;
      pthread_mutex_unlock(&mutex);
    }
    struct itimerspec single = {{0, 0}, time};
    if (!strcmp(by, "once")) timerfd_settime(timer, TFD_TIMER_ABSTIME, &single, NULL);
    if (!strcmp(by, "once") || !strcmp(by, "timer"))
      if (read(timer, &times, 8) != 8) return 1;
    if (!strcmp(by, "checked")) {  // as ros2_control since 4.20: what is over is left out
      while (next < now()) next += period;
      time = spec(next);
      clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &time, NULL);
    }
    next += period;
  }
}
"""

OWN_INSTANTS = ("absolute", "wall", "rate", "signals", "condition", "once", "checked")
FOLLOWS = ("relative", "usleep", "timer")


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    program = tmp_path_factory.mktemp("moved") / "loop"
    words = ["gcc", "-O1", "-x", "c", "-", "-o", str(program), "-lpthread", "-ldl", "-lrt"]
    subprocess.run(words, input=PROGRAM.encode(), check=True)
    return program


@dataclass
class Running:
    """A loop that runs, in the main thread of its process, and all that was seen of it."""

    process: "subprocess.Popen[str]"
    tracer: PreloadTracer
    tables: dict[str, pl.DataFrame]

    @property
    def pid(self) -> int:
        return self.process.pid

    def mover(self, lease_ns: int = 0) -> LoopMover:
        """Wait until the library has seen the loop."""
        return wait_for(lambda: _mover(self.pid, lease_ns))


def _mover(pid: int, lease_ns: int) -> LoopMover | None:
    try:
        return LoopMover(pid, pid, lease_ns)
    except OperationError:
        return None


def wait_for(condition: Callable[[], object], within_s: float = 30.0) -> "LoopMover":
    until = time.monotonic() + within_s
    while not (answer := condition()):
        assert time.monotonic() < until, "it did not happen in time"
        time.sleep(0.02)
    return answer  # type: ignore[return-value]


@contextmanager
def running(
    program: Path, folder: Path, *words: object, loops: tuple[str, ...] = ()
) -> Iterator[Running]:
    """Run a loop beneath the library; what was recorded is there when the context has ended."""
    folder.mkdir(exist_ok=True)
    tracer = PreloadTracer(folder, ["command"], (), None, loops)
    tables: dict[str, pl.DataFrame] = {}
    try:
        with pytest.MonkeyPatch.context() as patch:
            for name, value in tracer.start().items():
                patch.setenv(name, value)
            command = [str(program), *map(str, words)]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            yield Running(process, tracer, tables)
        finally:
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()
        tracer.stop()
        tables.update(tracer.recording()[0])
    finally:
        tracer.remove()


def seen_until(mover: LoopMover, starts: int) -> list[int]:
    """Wait for so many further starts of a loop, and return them."""
    seen = list[int]()

    def enough() -> bool:
        seen.extend(mover.seen()[0])
        return len(seen) >= starts

    wait_for(enough)
    return seen


def moved_by(before: list[int], after: list[int], period: int = PERIOD) -> int:
    """By how much later a loop starts, from nearly a whole period less than none up."""
    first, second = phase_of(before, period), phase_of(after, period)
    assert first is not None and second is not None
    moved = (second.at_ns - first.near(second.at_ns)) % period
    return int(moved - period if moved > period - NEAR else moved)


def settled(mover: LoopMover, number: int) -> None:
    """Wait until a request is followed for some sleeps."""
    wait_for(lambda: any(move.number == number for move in mover.seen()[1]))
    seen_until(mover, 4)


@pytest.mark.parametrize("by", [*OWN_INSTANTS, *FOLLOWS])
def test_a_loop_is_moved_once_and_keeps_its_rate(program: Path, tmp_path: Path, by: str) -> None:
    with running(program, tmp_path / "trace", by, PERIOD) as loop:
        mover = loop.mover()
        before = seen_until(mover, 40)
        phase = phase_of(before, PERIOD)
        if by in FOLLOWS and by != "timer":  # what a sleep takes longer belongs to its period
            pace = int(np.median(np.diff(before)))
        else:
            pace = PERIOD
            assert phase is not None
        settled(mover, mover.move(3 * MS, pace))
        after = seen_until(mover, 40)
        if by not in FOLLOWS or by == "timer":
            assert abs(moved_by(before, after) - 3 * MS) < NEAR
        settled(mover, mover.move(4 * MS, pace))
        later = seen_until(mover, 40)
        if by not in FOLLOWS or by == "timer":
            assert abs(moved_by(before, later) - 4 * MS) < NEAR
        mover.close()
        over = seen_until(mover, 20)
        for starts in (before, after, later, over):
            assert np.median(np.diff(starts)) == pytest.approx(pace, rel=0.05)
    moved = loop.tables["loop_moved"]
    whys = [LOOP_MOVES[why] for why in moved["why"]]
    kept = moved["kept"].to_list()
    if by in FOLLOWS:
        assert whys[-1] == "over" and set(whys[:-1]) <= {"asked", "followed"}
        assert set(kept) == {0}
        assert moved["added"].sum() in range(4 * MS - 1, 4 * MS + 2)
    else:
        assert whys == ["asked", "kept", "kept", "over"]
        assert kept == [0, 3 * MS, 4 * MS, 0]
        assert abs(moved_by(before, over)) < NEAR
    # No sleep was shorter than wanted, but where it is said.
    assert (moved.filter(pl.col("why") != LOOP_MOVES.index("over"))["added"] >= 0).all()


def test_each_sleep_ends_when_the_recording_says(program: Path, tmp_path: Path) -> None:
    """`until` has what was added; so the jitter of starts is that of the loop as it runs."""
    with running(program, tmp_path / "trace", "absolute", PERIOD) as loop:
        mover = loop.mover()
        settled(mover, mover.move(5 * MS, PERIOD))
        seen_until(mover, 20)
    until = loop.tables["thread_sleep"]["until"].to_numpy()
    steps = np.diff(until)
    assert sorted(set(steps[steps != PERIOD])) in ([15 * MS], [5 * MS, 15 * MS])
    assert (steps != PERIOD).sum() == 1


def test_a_loop_that_checks_for_overruns_gets_its_own_instants_back(
    program: Path, tmp_path: Path
) -> None:
    """Moved by 7 of 10 ms, it has 3 ms for work of 5: it would leave out each second instance."""
    with running(program, tmp_path / "trace", "checked", PERIOD, 5 * MS) as loop:
        mover = loop.mover()
        before = seen_until(mover, 30)
        mover.move(7 * MS, PERIOD)
        moves = list[str]()

        def is_given_back() -> bool:
            moves.extend(move.why for move in mover.seen()[1])
            return "rate changed" in moves

        wait_for(is_given_back)
        seen_until(mover, 4)
        after = seen_until(mover, 30)
        assert np.median(np.diff(after)) == pytest.approx(PERIOD, rel=0.05)
        assert abs(moved_by(before, after)) < NEAR
    assert moves == ["asked", "kept", "rate changed"]


def test_a_clock_that_drifts_is_followed(program: Path, tmp_path: Path) -> None:
    """The loop's period is 100 ppm longer than 10 ms: its phase is kept by ever smaller moves."""
    period = PERIOD + 1_000
    with running(program, tmp_path / "trace", "absolute", period) as loop:
        mover = loop.mover()
        first = phase_of(seen_until(mover, 40), PERIOD)
        assert first is not None and first.drift_ppm == pytest.approx(100, abs=80)
        move_ns, wanted = 6 * MS, first.phase_ns + 6 * MS
        settled(mover, mover.move(move_ns, period))
        for _ in range(5):
            phase = phase_of(seen_until(mover, 40), PERIOD)
            assert phase is not None
            late = (phase.at_ns - wanted + PERIOD // 2) % PERIOD - PERIOD // 2
            assert abs(late) < NEAR
            move_ns -= late
            settled(mover, mover.move(move_ns, period))
    assert {LOOP_MOVES[why] for why in loop.tables["loop_moved"]["why"]} == {"asked", "kept"}


def test_a_request_whose_process_was_killed_ends_with_its_lease(
    program: Path, tmp_path: Path
) -> None:
    with running(program, tmp_path / "trace", "absolute", PERIOD) as loop:
        before = seen_until(loop.mover(), 30)
        asking = (
            "import os, signal\nfrom chainshaper.sources.preload import LoopMover\n"
            f"mover = LoopMover({loop.pid}, {loop.pid}, 1_000_000_000)\n"
            f"mover.move({4 * MS}, {PERIOD})\nos.kill(os.getpid(), signal.SIGKILL)\n"
        )
        killed = subprocess.run([sys.executable, "-c", asking], check=False, timeout=60)
        assert killed.returncode == -signal.SIGKILL
        mover = loop.mover()
        whys = list[str]()

        def is_over() -> bool:
            whys.extend(move.why for move in mover.seen()[1])
            return "over" in whys

        wait_for(is_over)
        seen_until(mover, 4)
        assert abs(moved_by(before, seen_until(mover, 30))) < NEAR
    assert whys == ["asked", "kept", "over"]


def test_a_request_that_is_half_written_counts_for_nothing(program: Path, tmp_path: Path) -> None:
    with running(program, tmp_path / "trace", "absolute", PERIOD) as loop:
        mover = loop.mover()
        number = mover.move(4 * MS, PERIOD)
        settled(mover, number)
        mover._asked["move"] = 9 * MS  # its writer was killed in the midst of it
        mover._asked["number"] = number + 1
        seen_until(mover, 20)
        assert not mover.seen()[1]
    assert loop.tables["loop_moved"]["kept"].to_list() == [0, 4 * MS]


def test_the_loop_of_another_process_stays(program: Path, tmp_path: Path) -> None:
    with (
        running(program, tmp_path / "first", "absolute", PERIOD) as loop,
        running(program, tmp_path / "second", "absolute", PERIOD) as neighbour,
    ):
        mover, beside = loop.mover(), neighbour.mover()
        settled(mover, mover.move(4 * MS, PERIOD))
        seen_until(beside, 20)
    assert "loop_moved" in loop.tables
    assert "loop_moved" not in neighbour.tables
    steps = np.diff(neighbour.tables["thread_sleep"]["until"].to_numpy())
    assert set(steps) == {PERIOD}


def test_what_cannot_be_moved_is_refused(program: Path, tmp_path: Path) -> None:
    with running(program, tmp_path / "trace", "absolute", PERIOD) as loop:
        mover = loop.mover()
        for move_ns in (-1, PERIOD, 2 * PERIOD):
            with pytest.raises(InputError, match="less than its period"):
                mover.move(move_ns, PERIOD)
        with pytest.raises(InputError, match="cannot be moved"):
            mover.move(0, 0)
        with pytest.raises(OperationError, match="no such thread"):
            move_loop(loop.pid, loop.pid + 1, MS, PERIOD)
        assert [thread.tid for thread in list_threads(loop.pid)] == [loop.pid]
    with pytest.raises(OperationError, match="cannot be moved"):
        move_loop(loop.pid, loop.pid, MS, PERIOD)
    beside = subprocess.Popen(["sleep", "60"])
    try:
        with pytest.raises(OperationError, match="library in front"):
            move_loop(beside.pid, beside.pid, MS, PERIOD)
    finally:
        beside.kill()
        beside.wait()


def test_two_processes_that_ask_leave_a_whole_request(program: Path, tmp_path: Path) -> None:
    """Whatever two writers mix, what the loop follows was asked for by one of them."""
    with running(program, tmp_path / "trace", "absolute", PERIOD) as loop:
        first, second = loop.mover(), loop.mover()
        over = threading.Event()

        def ask(mover: LoopMover, move_ns: int) -> None:
            while not over.is_set():
                mover.move(move_ns, PERIOD)

        threads = [
            threading.Thread(target=ask, args=pair) for pair in ((first, 2 * MS), (second, 4 * MS))
        ]
        watcher = loop.mover()
        for thread in threads:
            thread.start()
        seen_until(watcher, 60)
        over.set()
        for thread in threads:
            thread.join()
    moved = loop.tables["loop_moved"]
    assert set(moved["asked"]) <= {2 * MS, 4 * MS}


UPDATE_THREAD = r"""
#include <dlfcn.h>
#include <pthread.h>
#include <sched.h>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <thread>

int main() {
  using create = void (*)(uint64_t, uint64_t, const char *, const char *, uint64_t);
  if (auto created = reinterpret_cast<create>(dlsym(RTLD_DEFAULT, "ros_trace_rcl_node_init")))
    created(1, 2, "controller_manager", "/", 0);
  std::thread([] {
    pthread_setname_np(pthread_self(), "control_loop");
    sched_param priority{};
    priority.sched_priority = 60;
    sched_setscheduler(0, SCHED_FIFO, &priority);
    const auto period = std::chrono::milliseconds(10);
    auto next = std::chrono::steady_clock::now();
    std::puts("ready");
    std::fflush(stdout);
    for (;;) {
      const auto until = std::chrono::steady_clock::now() + std::chrono::microseconds(200);
      while (std::chrono::steady_clock::now() < until) continue;
      next += period;
      std::this_thread::sleep_until(next);
    }
  }).join();
}
"""
"""As ros2_control's: the thread publishes nothing, and is named; its node is in the process."""


@pytest.mark.parametrize("sanitizer", [(), ("-fsanitize=address",)], ids=["plain", "asan"])
def test_an_update_thread_in_cpp_that_was_named_is_moved(
    tmp_path: Path, sanitizer: tuple[str, ...]
) -> None:
    program = tmp_path / "manager"
    words = ["g++", "-O1", "-std=c++17", *sanitizer, "-x", "c++", "-", "-o", str(program)]
    subprocess.run([*words, "-lpthread", "-ldl"], input=UPDATE_THREAD.encode(), check=True)
    with running(program, tmp_path / "trace", loops=("control_loop",)) as loop:

        def found() -> LoopMover | None:
            for thread in list_threads(loop.pid):
                if thread.comm == "control_loop":
                    with contextlib.suppress(OperationError):
                        return LoopMover(loop.pid, thread.tid, 0)
            return None

        mover = wait_for(found)
        before = seen_until(mover, 40)
        settled(mover, mover.move(3 * MS, PERIOD))
        after = seen_until(mover, 40)
        assert abs(moved_by(before, after) - 3 * MS) < NEAR
    assert loop.tables["loop_named"]["name"].to_list() == ["control_loop"]
    moved = loop.tables["loop_moved"]
    assert moved["kept"].to_list() == [0, 3 * MS]
    assert set(loop.tables["thread_sleep"]["tid"]) == {mover.tid}
