"""A plan that is applied to an application that runs keeps its output and loop in step."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, cast

import pytest
from chain_in_step import MS, chain_in_step_plan, chain_in_step_text

from chainshaper.enforcement.undoing import RunState
from chainshaper.flow import apply
from chainshaper.flow.apply import apply_plan
from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.planning.chain_plan import ChainPlan, revised
from chainshaper.planning.plan import Plan
from chainshaper.reporting.overviews import servers_table
from chainshaper.sources.preload import named_loops
from chainshaper.splicing.application import splice_application
from chainshaper.workload.description import load_application
from chainshaper.workload.launcher import LOOP_NAME
from chainshaper.workload.live import StartedNodes, run_application

pytestmark = [
    pytest.mark.timed,
    pytest.mark.skipif(not may_use_fifo(), reason="SCHED_FIFO is not permitted here"),
]


@pytest.mark.parametrize(
    ("moves", "beneath"), [("loop", True), ("output", True), ("output", False), ("loop", False)]
)
def test_an_applied_plan_keeps_output_and_loop_in_step(
    tmp_path: Path, moves: Literal["output", "loop"], beneath: bool
) -> None:
    """Beneath the library and, where only the output is moved, without it."""
    (tmp_path / "app.yaml").write_text(chain_in_step_text())
    plan = Plan.of(chain_in_step_plan(moves))
    application = splice_application(load_application(tmp_path / "app.yaml"), plan)
    front = {}
    if beneath:
        front = named_loops.in_front_of([LOOP_NAME])
    started, over = threading.Event(), threading.Event()
    states = list[RunState]()

    def watch(state: RunState) -> None:
        states.append(state)
        waits = any("are not in step: no such loop" in note for note in state.notes)
        if state.steps or (waits and len(states) > 4):
            over.set()

    def enforcement(nodes: StartedNodes) -> Any:
        from contextlib import nullcontext

        assert nodes.pids
        started.set()
        return nullcontext()

    with ThreadPoolExecutor() as pool:
        ran = pool.submit(
            run_application,
            application,
            tmp_path / "recording",
            cycles=500,
            enforcement=enforcement,
            loops_in_front=front,
        )
        assert started.wait(60)
        time.sleep(3)  # until its timers run
        stop = threading.Event()
        applied = pool.submit(
            apply_plan,
            plan,
            back_end="fifo",
            wait_ns=20_000_000_000,
            folder=tmp_path / "runs",
            stop=stop,
            watch=watch,
        )
        until = time.monotonic() + 60
        while not (over.is_set() or applied.done() or ran.done()) and time.monotonic() < until:
            time.sleep(0.1)
        stop.set()
        final = applied.result().state
        ran.cancel()
        recording = ran.result()
    if moves == "loop" and not beneath:
        assert any("start it beneath the library in front" in note for note in final.notes)
        return
    assert final.steps, final.notes
    first = final.steps[0]
    assert (first.moves, first.loop) == (moves, "/controller")
    assert first.moved_ns is not None and 0 <= first.moved_ns < 15 * MS
    assert "its phase was measured" in first.why
    assert final.steps[-1].text in str(servers_table(final).caption)
    if moves == "output":
        moved = recording.events["gate_release"]["moved"].unique().sort().to_list()
        assert moved[0] == 0 and first.moved_ns in moved


def test_outputs_to_be_moved_are_waited_for_until_they_have_gates(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A shaping node runs before it has found a publisher: `shape -- ros2 launch` ended there."""
    plan = Plan.of(chain_in_step_plan("output"))
    thread = SimpleNamespace(thread=SimpleNamespace(pid=7))
    run = SimpleNamespace(
        anchored=SimpleNamespace(given=plan),
        threads=SimpleNamespace(find=lambda _: SimpleNamespace(threads=[thread])),
        command_has_ended=False,
        stop=threading.Event(),
        go_on=lambda: None,
    )
    looks = list[Any]()

    def gates_of(topic: str, pids: set[int]) -> list[str]:
        looks.append((topic, pids))
        return ["its gate"] if len(looks) == 3 else []

    monkeypatch.setattr(apply, "gates_of", gates_of)
    minute_ns = 60_000_000_000
    apply._await_gates(cast(Any, run), {}, minute_ns, lambda *_: None)
    assert looks == [("/scan", {7})] * 3
    apply._await_gates(cast(Any, run), {}, 0, lambda *_: None)  # what follows says what is missing
    assert len(looks) == 4
    apply._await_gates(
        cast(Any, SimpleNamespace(anchored=SimpleNamespace(given=Plan.of(unmoved())))),
        {},
        minute_ns,
        lambda *_: None,
    )
    assert len(looks) == 4, "nothing is to be moved"


def unmoved() -> ChainPlan:
    return revised(chain_in_step_plan("output"), loop=None)
