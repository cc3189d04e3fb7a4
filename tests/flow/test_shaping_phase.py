"""Shaping nodes are told where cycles begin, and again when that has moved.

Telling a node crosses into ROS 2, which need not be here: other commands stand in for it.
That a node follows is tested where the node is, with and without ROS 2.
"""

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from applied_plans import CYCLE, MS, needs_fifo, plan_for, running_node, server
from processes import wait_for

from chainshaper.enforcement.phase import DriftWatch
from chainshaper.enforcement.runs.state import RunState
from chainshaper.flow import apply as applying
from chainshaper.flow import shaping_phase
from chainshaper.flow.shaping_phase import NOBODY, Telling
from chainshaper.planning import Plan
from chainshaper.sources.ros.interpreter import Script
from chainshaper.values.errors import OperationError


@contextmanager
def applied(
    plan: Plan,
    folder: Path,
    tell: Callable[[int], Telling],
    monkeypatch: pytest.MonkeyPatch,
    stop: threading.Event | None = None,
) -> Iterator[list[RunState]]:
    """The plan in force, with what was seen of its state; drift is looked for all the time.

    Raises:
        OperationError: it does not come into force.
    """
    states: list[RunState] = []
    failures: list[OperationError] = []
    stop = stop or threading.Event()
    monkeypatch.setattr(applying, "tell_phase", lambda _plan, _found, phase_ns: tell(phase_ns))
    monkeypatch.setattr(applying, "_LOOK_S", 0.2)
    monkeypatch.setattr(DriftWatch, "EVERY_S", 0.1)
    monkeypatch.setattr(DriftWatch, "CYCLES", 5)
    how = {"back_end": "fifo", "stop": stop, "watch": states.append, "folder": folder / "runs"}

    def apply() -> None:
        try:
            applying.apply_plan(plan, **how)  # type: ignore[arg-type]
        except OperationError as error:
            failures.append(error)

    run = threading.Thread(target=apply)
    run.start()
    try:
        yield states
    finally:
        stop.set()
        run.join(10)
        assert not run.is_alive(), "it waits for somebody"
    if failures:
        raise failures[0]


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
        assert "/shaper could not be told" in states[-1].notes[-1]
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
        wait_for(lambda: bool(tellings), "the nodes to be told")
    (only,) = tellings
    assert only.script is not None
    assert only.script.process.returncode == -signal.SIGKILL


def test_a_node_that_never_answers_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    waiting = telling("sleep", "600")
    assert not waiting.is_over()
    monkeypatch.setattr(shaping_phase, "_PATIENCE_S", 0)
    assert waiting.is_over()
    (note,) = waiting.end()
    assert "ROS 2 did not answer within 0 s" in note
    (note,) = Telling(("/shaper",), None, 0.0, "python3 cannot be started").end()
    assert "/shaper could not be told where cycles begin (python3 cannot be started)" in note
    assert NOBODY.end() == ()
