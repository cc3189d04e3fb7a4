"""Loops that are watched: their rate, when they miss it, and who ran on their core then."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from command_line import called, refused
from loop_story import LOOP, PID, first_sleep, turn
from own_memories import follow_only_children_of, program
from processes import wait_for
from story import Story

from chainshaper.analysis import DataFlow, data_flow
from chainshaper.linux.core_use import CoreUse, Used
from chainshaper.monitor import watch as watch_module
from chainshaper.monitor.budgets import Budget, LoopBudget, broken_limits, not_running
from chainshaper.monitor.watch import SECOND, Seen, Watch
from chainshaper.monitor.watched_loops import Miss, WatchedLoops
from chainshaper.sources.preload import PreloadTracer, in_front, installed_library, named_loops
from chainshaper.values.errors import InputError

MS = 1_000_000
HOG, ITS_CORE = 31, 1


class Counted(CoreUse):
    """What the kernel counted: these threads ran, in a span of a second."""

    def __init__(self, *used: Used) -> None:
        super().__init__()
        self.used = {each.tid: each for each in used}

    def between(self, since_ns: int, until_ns: int) -> tuple[int, dict[int, Used]]:  # noqa: ARG002
        return SECOND, self.used


def late_loop(late_ms: int, *, computes_ms: int = 50, core: int = ITS_CORE) -> DataFlow:
    """A loop of 100 ms, which at 500 ms wakes up late; /hog's callback has its core from 505 on."""
    story = Story()
    timer, _ = story.source("/hog", 30, "/noise")
    story.runs(timer, 505 * MS, 535 * MS, tid=HOG)
    cmd = story.publisher(story.node("/actor", PID), "/cmd")
    first_sleep(story, 40 * MS, 100 * MS)
    for due in range(100, 1000, 100):
        if due == 600 and computes_ms > 100:
            continue  # the instance before still runs
        woke = due + (late_ms if due == 500 else 0)
        ends = due + (computes_ms if due == 500 else 50)
        turn(story, woke * MS, ends * MS, (due + 100) * MS, writes=((cmd, (woke + 1) * MS),))
    tables = dict(story.tables())
    for name in ("thread_wake", "callback_start"):
        tables[name] = tables[name].with_columns(cpu=pl.lit(core, pl.Int32))
    return data_flow(tables)


def misses(flow: DataFlow, *used: Used) -> list[Miss]:
    loops = WatchedLoops()
    loops._cores = Counted(*used)
    return loops.take(flow, 0, 950 * MS, 0, [PID])


def test_a_late_loop_names_what_was_under_way_on_its_core_and_who_ran() -> None:
    own = Used(LOOP, "loop", ITS_CORE, 300 * MS, 38 * MS)
    others = Used(31, "hog", ITS_CORE, 400 * MS, 0), Used(99, "far", 0, 900 * MS, 0)
    (miss,) = misses(late_loop(40), own, *others)
    assert (miss.loop, miss.since_ns, miss.until_ns) == (
        "loop of /actor to /cmd",
        500 * MS,
        540 * MS,
    )
    assert re.search(r"missed its 100 ms at \d\d:\d\d:\d\d\.500: it woke up 40 ms late", miss.text)
    assert "under way on its core 1 then: a timer of /hog for 30 ms" in miss.text
    assert "ran on core 1: hog (thread 31) for 400 ms" in miss.text
    assert "far" not in miss.text, "it was on another core"
    assert "waited for a core for 38 ms then: another thread had it" in miss.text


def test_a_thread_that_did_not_wait_for_its_core_was_held_up_by_something_else() -> None:
    (miss,) = misses(late_loop(40), Used(LOOP, "loop", ITS_CORE, 300 * MS, 0))
    assert "ran on core 1: no other thread" in miss.text
    assert "no thread took its core for all that time" in miss.text and "the machine" in miss.text


def test_an_instance_that_takes_too_long_says_how_long_it_computed() -> None:
    (miss,) = misses(late_loop(0, computes_ms=130))
    assert "its instance took 130 ms, of which it computed for 78 ms" in miss.text


def test_a_loop_that_keeps_its_rate_is_not_named_and_one_a_little_late_neither() -> None:
    for late_ms in (0, 9):
        loops = WatchedLoops()
        assert loops.take(late_loop(late_ms), 0, 950 * MS, 0, [PID]) == []
        (now,) = loops.now()
        assert (now.loop, now.misses, now.problem) == ("loop of /actor to /cmd", 0, None)
        assert (now.rate.period_ns, now.rate.count, now.rate.overruns) == (100 * MS, 9, 0)
        assert now.rate.start_jitter_ns == late_ms * MS


def test_a_loop_that_goes_on_missing_its_rate_is_named_once_a_minute() -> None:
    loops, flow = WatchedLoops(), late_loop(40)
    assert len(loops.take(flow, 0, 550 * MS, 0, [PID])) == 1
    assert loops.take(flow, 0, 550 * MS, 0, [PID]) == []


def test_a_loop_that_does_not_come_any_more_is_named_while_its_process_runs() -> None:
    flow = late_loop(0)
    for running, count in (([PID], 1), ([], 0)):
        loops = WatchedLoops()
        assert loops.take(flow, 0, 950 * MS, 0, running) == []
        gone = loops.take(flow, 950 * MS, 3900 * MS, 0, running)
        assert len(gone) == count
        assert not gone or "no instance has begun for 3 s" in gone[0].text


def test_where_no_event_says_the_core_that_is_said() -> None:
    flow = late_loop(40)
    woke = flow.events["thread_wake"].drop("cpu")
    without = data_flow({**flow.events, "thread_wake": woke})
    (miss,) = misses(without)
    assert "on which core it runs, no event says" in miss.text


def test_a_busy_thread_is_seen_on_its_core() -> None:
    """Both spin on one core until the kernel has counted enough for each."""
    core = max(os.sched_getaffinity(0))
    words = ["taskset", "-c", str(core), sys.executable, "-c", "while True: pass"]
    with subprocess.Popen(words) as busy:
        try:
            use = CoreUse()
            deadline = time.monotonic() + 60
            while time.monotonic() < deadline:
                use.look()
                time.sleep(0.2)
                lasted, used = use.between(0, time.monotonic_ns())
                if busy.pid in used and used[busy.pid].ran_ns > 10 * MS:
                    break
        finally:
            busy.kill()
    assert lasted > 0
    assert used[busy.pid].core == core and used[busy.pid].ran_ns > 10 * MS


PROGRAM = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdint.h>
#include <time.h>
typedef void (*event)(uint64_t, uint64_t, uint64_t, uint64_t, uint64_t);
static void emit(const char *name, uint64_t a, uint64_t b, uint64_t c, uint64_t d) {
  event function = (event)dlsym(RTLD_DEFAULT, name);
  if (function) function(a, b, c, d, 0);
}
static int64_t now(void) {
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return time.tv_sec * INT64_C(1000000000) + time.tv_nsec;
}
int main(void) {
  emit("ros_trace_rcl_node_init", 1, 2, (uintptr_t)"actor", (uintptr_t)"/");
  emit("ros_trace_rcl_publisher_init", 0x50, 1, 3, (uintptr_t)"/cmd");
  int64_t next = now();
  for (int turn = 1; ; turn++) {
    next += 20000000;
    struct timespec until = {next / 1000000000, next % 1000000000};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, 0);
    emit("ros_trace_rcl_publish", 0x50, 1, 0, 0);
    int64_t computes = turn % 100 == 0 ? 70000000 : 100000;
    for (int64_t end = now() + computes; now() < end;) continue;
  }
}
"""
"""A loop of 20 ms, every hundredth instance of which takes 70 ms."""


@pytest.fixture(scope="module")
def looping(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("gcc") is None:
        pytest.skip("gcc is not installed")
    file = tmp_path_factory.mktemp("looping") / "looping"
    words = ["gcc", "-O1", "-x", "c", "-", "-o", str(file), "-ldl"]
    subprocess.run(words, input=PROGRAM.encode(), check=True)
    return file


@contextmanager
def running(looping: Path, **variables: str) -> Iterator["subprocess.Popen[bytes]"]:
    environment = {**os.environ, **in_front(installed_library()), **variables}
    with subprocess.Popen([str(looping)], env=environment) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.waiting
def test_a_loop_that_runs_is_watched_and_its_limits_hold_for_it(
    looping: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watch_module, "memories", vars(watch_module)["memories"])  # put back
    follow_only_children_of(os.getpid())
    seen: Seen | None = None
    with running(looping):
        watch = Watch([], users={os.geteuid()}, longest_ns=SECOND // 5)
        deadline, said = time.monotonic() + 120, list[str]()
        while not any(int(re.findall(r"instance took (\d+)", text)[0]) >= 70 for text in said):
            assert time.monotonic() < deadline, f"the overrun was not seen: {seen}, {said}"
            for _ in range(10):
                time.sleep(0.02)
                watch.read()
            seen = watch.look()
            said += [text for text in seen.missed if "its instance took" in text]
            watch.loops._said_ns.clear()  # each miss is said
    assert seen is not None
    (loop,) = seen.loops
    assert loop.loop == "loop of /actor to /cmd" and loop.misses > 0
    assert loop.rate.period_ns == pytest.approx(20 * MS, rel=0.01)
    assert loop.rate.overruns
    limits = Budget(
        loops=(
            LoopBudget(node="/actor", period_ns=10 * MS, shortest_period_ns=MS),
            LoopBudget(node="/other", period_ns=MS),
        )
    )
    (broken,) = broken_limits(limits, seen)
    assert (broken.where, broken.figure) == ("loop of /actor", "period")
    (note,) = not_running(limits, seen)
    assert "loop of /other has not run yet: it has the loop of /actor to /cmd" in note
    assert seen.as_json()["loops"][0]["rate"]["node"] == "/actor"


@pytest.mark.waiting
def test_the_command_shows_loops_alone_and_says_which_it_has_not_seen(looping: Path) -> None:
    words = [sys.executable, "-c", program(), "watch", "--every", "300ms", "--longest", "200ms"]
    words += ["--loop", "/actor", "--loop", "/ghost", "--", str(looping)]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, **pipes) as shown:
        said = ""
        for line in shown.stderr or ():
            said += line
            if "/ghost was not seen" in said and " missed its 20 ms at " in said:
                break
        shown.send_signal(signal.SIGINT)
        text, rest = shown.communicate(timeout=60)
    said += rest
    assert "note: the loop /ghost was not seen: no node of this name was created" in said
    assert "Loops, over the last minute" in text and "loop of /actor" in text


def test_names_of_loops_are_part_of_the_environment_and_wrong_ones_are_refused() -> None:
    lines = called("watch", "--environment", "--loop", "/a", "--loop", "control").out.splitlines()
    assert "export CHAINSHAPER_LOOPS=/a,control" in lines
    assert "names no loop" in refused(2, "watch", "--loop", "/a b", "--", "true")


@pytest.mark.waiting
def test_a_recording_that_attaches_takes_names_that_the_robot_was_started_with(
    looping: Path, tmp_path: Path
) -> None:
    """The library reads them when its process starts."""
    environment = {**in_front(installed_library()), **named_loops.variables(["/actor"])}
    with running(looping, **environment) as process:
        memory = Path(f"/proc/{process.pid}/fd")
        wait_for(
            lambda: any("chainshaper-trace" in str(file.readlink()) for file in memory.iterdir()),
            "the memory of the process",
        )
        for number, name in enumerate(("/actor", "/other")):
            folder = tmp_path / str(number)
            folder.mkdir()
            tracer = PreloadTracer(folder, [], [process.pid], None, [name])
            try:
                if name == "/other":
                    with pytest.raises(InputError, match=r"--environment --loop NAME") as said:
                        tracer.start()
                    assert "no process that runs has met the loop /other" in str(said.value)
                    continue
                tracer.start()
                time.sleep(0.5)
                tracer.stop()
                tables, info = tracer.recording()
            finally:
                tracer.remove()
            assert tables["thread_sleep"].height > 1
            assert not any("was not seen" in note for note in info.notes)
