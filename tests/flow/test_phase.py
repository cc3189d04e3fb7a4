"""Where in a cycle a chain begins, found from when its thread woke up; shaping nodes get it.

Setting a node's parameter crosses into ROS 2, which need not be here: other commands stand in for
it. That a node follows is tested where the node is, with and without ROS 2.
"""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import numpy.typing as npt
import pytest
from applied_plans import CYCLE, MS, applied_here, needs_fifo, plan_for, running_node, server
from hypothesis import given
from hypothesis import strategies as st
from processes import wait_for

from chainshaper.enforcement.node_threads import Allocation
from chainshaper.enforcement.undoing import RunState
from chainshaper.flow import phase
from chainshaper.flow.phase import (
    NO_NODE,
    DriftWatch,
    Telling,
    find_drift,
    find_phase,
    measure_phase,
    watch_wake_ups,
)
from chainshaper.flow.plan_in_force import phases, supervision, threads
from chainshaper.planning import ChainPlan
from chainshaper.planning.chain_plan import shaping_nodes
from chainshaper.planning.shaping import plan_shaping
from chainshaper.sources import ros
from chainshaper.sources.ros import Script
from chainshaper.values.errors import OperationError

pytestmark = pytest.mark.timed

TICKING = """
import sys, time
period, first = int(sys.argv[1]), int(sys.argv[2])
now = time.monotonic_ns()
due = now - now % period + first
print("ready", flush=True)
while True:
    while due <= time.monotonic_ns():
        due += period
    time.sleep((due - time.monotonic_ns()) / 1e9)
    busy = time.monotonic_ns() + 2_000_000
    while time.monotonic_ns() < busy:
        pass
"""

TAKING_TURNS = """
import sys, threading, time
from itertools import cycle
period, first = int(sys.argv[1]), int(sys.argv[2])
ready = [threading.Event() for _ in range(3)]
def work(own):
    while True:
        own.wait()
        own.clear()
workers = [threading.Thread(target=work, args=(one,), daemon=True) for one in ready]
for one in workers:
    one.start()
print(*(one.native_id for one in workers), flush=True)
for own in cycle(ready):
    now = time.monotonic_ns()
    time.sleep(((first - now) % period or period) / 1e9)
    own.set()
"""


def circular(one: int, other: int, cycle: int = CYCLE) -> int:
    return abs((one - other + cycle // 2) % cycle - cycle // 2)


@given(
    at=st.integers(0, CYCLE - 1),
    lateness=st.lists(st.integers(0, MS), min_size=12, max_size=12),
    others=st.lists(st.tuples(st.integers(0, 11), st.integers(3 * MS, 60 * MS)), max_size=20),
    missing=st.integers(0, 2),
)
def test_a_timer_is_found_wherever_it_lies_and_whatever_else_wakes_its_thread(
    at: int, lateness: list[int], others: list[tuple[int, int]], missing: int
) -> None:
    """Lateness up to 1 ms, two cycles without, others within 60 ms: the rest before is longest."""
    begins = [n * CYCLE + at + late for n, late in enumerate(lateness)][: 12 - missing]
    extra = [n * CYCLE + at + MS + place for n, place in others]
    phase = find_phase(np.sort(np.array(begins + extra, dtype=np.int64)), CYCLE, 12)
    assert phase is not None
    assert circular(phase.at_ns, at) <= 2 * MS
    all_over = [n * (CYCLE + 7 * MS) for n in range(12)]
    assert find_phase(np.array(all_over, dtype=np.int64), CYCLE, 12) is None


@contextmanager
def running(body: str, *arguments: object) -> Iterator[tuple[int, str]]:
    """A Python program: its process id and the first line that it prints."""
    command = [sys.executable, "-c", body, *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield process.pid, process.stdout.readline()
        finally:
            process.kill()


def test_a_process_and_an_executor_of_several_threads_are_measured() -> None:
    """The reference is the phase that they were given; half a slot's lead is the tolerance. Each of
    three threads begins every third cycle only, as in rclcpp's EventsCBGExecutor.
    """
    period, first = 50 * MS, 17 * MS
    with running(TICKING, period, first) as (pid, _):
        phase = measure_phase(pid, [pid], period)
    assert circular(phase.at_ns, first, period) < period // 10
    with running(TAKING_TURNS, period, first) as (pid, printed):
        tids = [*map(int, printed.split())]
        phase = measure_phase(pid, tids, period)
        with pytest.raises(OperationError, match="does not wake up at one place"):
            measure_phase(pid, tids[:1], period, 6)
    assert circular(phase.at_ns, first, period) < period // 10


@pytest.mark.parametrize(
    ("lasts", "cycle", "words"),
    [
        (0.2, CYCLE, "ended while its phase was measured"),
        (60, 10 * MS, r"does not wake up: not once in 12 cycles of 10 ms\. .*--phase"),
    ],
)
def test_a_thread_that_ends_or_never_wakes_has_no_phase(
    lasts: float, cycle: int, words: str
) -> None:
    body = f"import time; print(flush=True); time.sleep({lasts})"
    with running(body) as (pid, _), pytest.raises(OperationError, match=words):
        measure_phase(pid, [pid], cycle)


def test_what_a_thread_lacks_of_a_beginning_is_counted_by_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Twelve wake-ups in twelve cycles, of which seven have one at 5 ms: ten would have to."""
    places = (5.0, 5.1, 5.2, 5.3, 5.2, 5.1, 5.0, 8, 9, 11, 13, 17)
    wake_ups = np.array([n * 20 * MS + int(at * MS) for n, at in enumerate(places)])
    monkeypatch.setattr(phase, "watch_wake_ups", lambda *_: wake_ups)
    with pytest.raises(OperationError) as raised:
        measure_phase(7, [8], 20 * MS)
    said = (
        "thread 8 of process 7 does not wake up at one place of the cycle 20 ms: 12 wake-ups in 12"
    )
    said += " cycles, of which 7 at most have one within the same 400 us, and 10 have to."
    assert str(raised.value).startswith(said)
    assert str(raised.value).endswith("try again when it is calm; or give its --phase")


def test_being_stopped_at_a_slots_end_is_no_beginning() -> None:
    """Wake-ups as seen of a node on a chain's server [0, 70): it begins with the slot, or in it."""
    slots = ((0, 70 * MS),)
    for begins in (0, 3 * MS):
        wake_ups = [
            1_000 * CYCLE + 17 * MS + cycle * CYCLE + at
            for cycle in range(8)
            for at in (begins + 100_000, begins + 9 * MS, 70 * MS + 900_000)
        ]
        seen, anchor = np.array(wake_ups), 17 * MS
        assert find_drift(seen, CYCLE, 8, anchor, slots) == begins + 100_000
        assert find_drift(seen, CYCLE, 8, anchor) == -29_100_000, "which is why slots are looked at"
    assert find_drift(np.array([], dtype=np.int64), CYCLE, 8, 0, slots) is None


def test_wake_ups_without_work_can_be_left_out_and_others_not_looked_for() -> None:
    """It wakes five times per period and works in one of them.

    At a real-time priority: whoever shares its core in slices does not work through.
    """
    body = (
        "import contextlib, os, time\n"
        "with contextlib.suppress(PermissionError):\n"
        "    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))\n"
        "due, number = time.monotonic_ns(), 0\n"
        "print(due, flush=True)\n"
        "while number < 1_000:\n"
        "    due, number = due + 40_000_000, number + 1\n"
        "    time.sleep(max(0, due - time.monotonic_ns()) / 1e9)\n"
        "    used = time.thread_time_ns()\n"
        "    while number % 5 == 0 and time.thread_time_ns() - used < 12_000_000:\n"
        "        pass\n"
    )
    with running(body) as (pid, printed):
        every = watch_wake_ups(pid, [pid], 800 * MS)
        working = watch_wake_ups(pid, [pid], 1200 * MS, least_ns=MS)
        closes = int(printed) + 70 * MS  # and opens 100 ms later, 30 ms before it works

        def until_then(now_ns: int) -> int:
            place = (now_ns - closes) % (200 * MS)
            return 0 if place > 100 * MS else 100 * MS - place

        some = watch_wake_ups(pid, [pid], 800 * MS, rest_ns=until_then)
    assert len(some) > 0
    assert ((some - closes) % (200 * MS) > 99 * MS).all()
    assert len(working) >= 3
    assert _longest_rest(working, 200 * MS) > 100 * MS > _longest_rest(every, 200 * MS)


def _longest_rest(wake_ups: npt.NDArray[np.int64], period: int) -> int:
    places = np.sort(wake_ups % period)
    return int(np.diff(np.append(places, places[0] + period)).max())


@contextmanager
def applied(
    plan: ChainPlan,
    folder: Path,
    tell: Callable[[int], Telling],
    monkeypatch: pytest.MonkeyPatch,
    stop: threading.Event | None = None,
) -> Iterator[list[RunState]]:
    """The plan in force, with what was seen of its state; drift is looked for all the time."""
    monkeypatch.setattr(phases, "tell_phase", lambda _plan, _found, phase_ns: tell(phase_ns))
    monkeypatch.setattr(threads, "LOOK_S", 0.2)
    monkeypatch.setattr(supervision, "LOOK_S", 0.2)
    monkeypatch.setattr(DriftWatch, "EVERY_S", 0.1)
    monkeypatch.setattr(DriftWatch, "CYCLES", 5)
    with applied_here(plan, folder / "runs", stop) as states:
        yield states


def telling(*command: str) -> Telling:
    """Somebody is told by a command."""
    printed, said = os.memfd_create("printed"), os.memfd_create("said")
    process = subprocess.Popen(command, stdout=printed, stderr=said, start_new_session=True)
    return Telling(("/shaper",), Script(process, printed, said), time.monotonic())


@needs_fifo
def test_a_beginning_that_moves_is_told_again_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[int] = []

    def tell(phase_ns: int) -> Telling:
        told.append(phase_ns)
        if len(told) == 1:
            return telling("sh", "-c", "echo warned >&2; echo no such service >&2; exit 1")
        return telling("true")

    plan = plan_for(server("first", "moving", (0, 30)))
    with (
        running_node("moving", tmp_path / "moving") as node,
        applied(plan, tmp_path, tell, monkeypatch) as states,
    ):
        wait_for(lambda: bool(states) and states[-1].drift_ns is not None, "the first look")
        assert len(told) == 1
        assert "/shaper did not get where cycles begin" in states[-1].notes[-1]
        assert "(no such service)" in states[-1].notes[-1]
        os.kill(node.pid, signal.SIGUSR1)
        wait_for(lambda: len(told) == 2, "the nodes to be told again")
        seen = len(states)
        wait_for(lambda: len(states) > seen + 2, "a few more looks")
    assert len(told) == 2, "it has not moved any further"
    moved = (told[1] - told[0]) % CYCLE
    assert abs(moved - CYCLE // 3) < CYCLE // 10
    assert "has moved by" in states[-1].notes[-1]
    assert abs((states[-1].drift_ns or 0) - CYCLE // 3) < 10 * MS


def test_one_look_at_a_busy_machine_moves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread that was late throughout one look has not moved; one that is twice so has."""
    looks, surely = iter([10_000, 330_000, -20_000, 400_000, 420_000]), list[int | None]()

    def look(watch: DriftWatch, _near: int | None, _expected: int, _cycles: int) -> int:
        surely.append(watch.surely_ns)
        if (seen := next(looks, None)) is None:
            raise OperationError("the thread has ended")
        return seen

    monkeypatch.setattr(DriftWatch, "_look", look)
    monkeypatch.setattr(DriftWatch, "EVERY_S", 0.0)
    watch = DriftWatch(1, [1], CYCLE, 0)
    wait_for(lambda: len(surely) == 6, "the looks")
    assert surely == [None, 0, 10_000, -20_000, -20_000, 400_000]
    assert watch.looks == 5
    # A program that has applied a plan and goes on had kept each one, at a real-time priority.
    monkeypatch.setattr(DriftWatch, "_look", lambda *_: 0)
    before, watch = set(threading.enumerate()), DriftWatch(1, [1], CYCLE, 0)
    (thread,) = set(threading.enumerate()) - before
    watch.end()
    thread.join(5)
    assert not thread.is_alive()


@needs_fifo
def test_it_can_be_stopped_before_the_nodes_were_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tellings: list[Telling] = []
    stop = threading.Event()

    def tell(_: int) -> Telling:
        tellings.append(telling("sleep", "600"))
        stop.set()
        return tellings[-1]

    plan = plan_for(server("first", "steady", (0, 30)))
    with (
        running_node("steady", tmp_path / "steady"),
        pytest.raises(OperationError, match="asked to end before the plan was in force"),
        applied(plan, tmp_path, tell, monkeypatch, stop),
    ):
        pass
    (only,) = tellings
    assert only.script is not None
    assert only.script.process.returncode == -signal.SIGKILL


def test_a_node_that_never_answers_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    waiting = telling("sleep", "600")
    assert not waiting.is_over()
    monkeypatch.setattr(phase, "_PATIENCE_S", 0)
    assert waiting.is_over()
    (note,) = waiting.end()
    assert "ROS 2 did not answer within 0 s" in note
    (note,) = Telling(("/shaper",), None, 0.0, "python3 cannot be started").end()
    assert "/shaper did not get where cycles begin (python3 cannot be started)" in note
    assert NO_NODE.end() == ()


@pytest.mark.parametrize("has_page", [True, False])
def test_a_shaping_node_is_asked_on_its_page_and_by_ros_where_it_has_none(
    monkeypatch: pytest.MonkeyPatch, has_page: bool
) -> None:
    """A process that joins the robot's graph may hold up what others publish with Fast DDS."""
    plan = plan_shaping(np.array([20 * MS, 21 * MS]), CYCLE, nodes=("/last",), output="/out")
    asked: list[object] = []

    def ask(topic: str, pids: set[int], phase_ns: int) -> None:
        if not has_page:
            raise OperationError("no gates publish it now")
        asked.append((topic, pids, phase_ns))

    def start(_environment: object, _script: str, *arguments: str) -> Script:
        asked.append(arguments)
        return telling("true").script  # type: ignore[return-value]

    monkeypatch.setattr(phase, "ask_phase", ask)
    monkeypatch.setattr(ros, "start_with_rclpy", start)
    in_ros = ros.Environment({phase._HAS_ROS: "/opt/ros/jazzy"}, os.getuid())
    monkeypatch.setattr(ros, "environment_of", lambda _: in_ros)
    thread = SimpleNamespace(nodes=("/chainshaper_out",), thread=SimpleNamespace(pid=7))
    allocation = Allocation(threads=(thread,), notes=())  # type: ignore[arg-type]
    told = phase.tell_phase(shaping_nodes(plan), allocation, 5 * MS)
    if has_page:
        assert asked == [("/out", {7}, 5 * MS)]
        assert told == NO_NODE
    else:
        assert asked == [("parameter", "phase_ns", str(5 * MS), "/chainshaper_out")]
        told.end()
