"""Shaping nodes are told where cycles begin, and again when that has moved.

Telling a node crosses into ROS 2, which need not be here: a stand-in notes what it would be told.
That a node follows is tested where the node is, with and without ROS 2.
"""

import os
import signal
import threading
from pathlib import Path

import pytest
from applied_plans import CYCLE, MS, needs_fifo, plan_for, running_node, server
from processes import wait_for

from chainshaper import applying
from chainshaper.enforcement.phase import DriftWatch
from chainshaper.enforcement.runs.state import RunState
from chainshaper.enforcement.threads.allocation import Allocation
from chainshaper.planning import Plan


@needs_fifo
def test_a_beginning_that_moves_is_told_again_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[int] = []
    states: list[RunState] = []

    def tell(_plan: Plan, _found: Allocation, phase_ns: int) -> tuple[str, ...]:
        told.append(phase_ns)
        return ()

    monkeypatch.setattr(applying, "tell_phase", tell)
    monkeypatch.setattr(applying, "_LOOK_S", 0.2)
    monkeypatch.setattr(DriftWatch, "EVERY_S", 0.1)
    monkeypatch.setattr(DriftWatch, "CYCLES", 5)
    plan, stop = plan_for(server("first", "moving", (0, 30))), threading.Event()
    with running_node("moving", tmp_path / "moving") as node:
        run = threading.Thread(
            target=applying.apply_plan,
            args=(plan,),
            kwargs={
                "back_end": "fifo",
                "stop": stop,
                "watch": states.append,
                "folder": tmp_path / "runs",
            },
        )
        run.start()
        try:
            wait_for(lambda: bool(states) and states[-1].drift_ns is not None, "the first look")
            assert len(told) == 1
            os.kill(node.pid, signal.SIGUSR1)
            wait_for(lambda: len(told) == 2, "the nodes to be told again")
            seen = len(states)
            wait_for(lambda: len(states) > seen + 2, "a few more looks")
        finally:
            stop.set()
            run.join()
    assert len(told) == 2, "it has not moved any further"
    moved = (told[1] - told[0]) % CYCLE
    assert abs(moved - CYCLE // 3) < CYCLE // 10
    assert "has moved by" in states[-1].notes[-1]
    assert abs((states[-1].drift_ns or 0) - CYCLE // 3) < 10 * MS
