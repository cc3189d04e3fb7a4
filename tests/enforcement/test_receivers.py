"""Receivers of an output that no command line names: the plan's own recording does.

A container and a ros2_control node have the names of their nodes in no command line. The plan names
the recording that it was made of, which knows the process.
"""

import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from applied_plans import CYCLE, NODE, applied_here, needs_fifo, plan_for, running_node, server
from command_line import called
from processes import wait_for
from story import OFFSET, Story

from chainshaper import find_threads, planned_changes
from chainshaper.linux.scheduling import available_cores
from chainshaper.linux.threads import list_threads
from chainshaper.planning import ChainPlan, Plan, save_plan
from chainshaper.planning.chain_plan import ShapingNode, revised
from chainshaper.values.recording import RecordingInfo, write_recording

pytestmark = pytest.mark.timed

GATE = ShapingNode(
    name="gate_of_receivers",
    input="/out_tmp",
    output="/out",
    core=available_cores()[-1],
    fifo_priority=84,
    spin_ns=0,
    pause_ns=0,
    receivers=("/sink", "/absent"),
)
ABSENT = "not running, or not recognised: /absent, which receives /out"


@contextmanager
def unnamed_node(folder: Path) -> Iterator[int]:
    """A node that has its name in no command line, as one in a container."""
    output = folder / "unnamed"
    command = [sys.executable, str(NODE), str(CYCLE), "1000000", str(output), "--ros-args"]
    with subprocess.Popen(command) as process:
        wait_for(lambda: output.exists() and output.stat().st_size > 0, "the node")
        try:
            yield process.pid
        finally:
            process.kill()


def recorded(pid: int, path: Path) -> Path:
    """A recording in which the process ran the node `/sink`."""
    story = Story()
    story.node("/sink", pid, time.monotonic_ns())
    info = RecordingInfo(source="lttng", clock_offset_ns=OFFSET)
    return write_recording(path, story.tables(), info).path


def plan_of(recording: Path | None) -> ChainPlan:
    bare = plan_for(
        server("chain", "chain_of_receivers", (0, 50)), server("output", GATE.name, (50, 60))
    )
    evidence = bare.evidence.model_copy(update={"recording": recording and str(recording)})
    return revised(bare, shaping_node=GATE, evidence=evidence)


@pytest.fixture
def receiver(tmp_path: Path) -> Iterator[int]:
    """The process of a receiver, beside those of the chain and its shaping node."""
    with (
        running_node("chain_of_receivers", tmp_path / "chain_of_receivers"),
        running_node(GATE.name, tmp_path / "gate"),
        unnamed_node(tmp_path) as pid,
    ):
        yield pid


@needs_fifo
def test_receivers_are_known_by_the_recording_that_the_plan_names(
    receiver: int, tmp_path: Path
) -> None:
    plan = plan_of(recorded(receiver, tmp_path / "recording"))
    before = list_threads(receiver)
    with applied_here(plan, tmp_path / "runs", phase_ns=0) as states:
        (executor,) = list_threads(receiver)
        assert (executor.policy, executor.cores) == ("SCHED_FIFO", (GATE.core,))
        (note,) = (note for note in states[0].notes if "not recognised" in note)
        assert note.startswith(ABSENT)
    assert list_threads(receiver) == before


@needs_fifo
def test_who_asks_first_sees_the_same(receiver: int, tmp_path: Path) -> None:
    plan = plan_of(recorded(receiver, tmp_path / "recording"))
    (changed,) = (
        one
        for one in planned_changes(Plan.of(plan), "fifo").threads
        if "/sink" in one.node_thread.nodes
    )
    assert changed.node_thread.thread.pid == receiver
    assert changed.scheduling.cores == (GATE.core,)
    save_plan(Plan.of(plan), tmp_path / "plan.yaml")
    shown = called("apply", tmp_path / "plan.yaml", "--backend", "fifo", "--dry-run")
    assert "/sink" in shown.out
    assert f"note: {ABSENT}" in shown.err


@needs_fifo
@pytest.mark.parametrize("left", ["none", "gone", "spoilt"])
def test_without_a_recording_it_is_said_who_is_left_out(
    receiver: int, left: str, tmp_path: Path
) -> None:
    path = recorded(receiver, tmp_path / "recording")
    if left == "gone":
        shutil.rmtree(path)
    elif left == "spoilt":
        (path / "recording.json").write_text("{")
    plan = plan_of(None if left == "none" else path)
    reason = {"none": "", "gone": f"{path} is not here", "spoilt": "cannot be read"}[left]
    before = list_threads(receiver)
    with applied_here(plan, tmp_path / "runs", phase_ns=0) as states:
        assert list_threads(receiver) == before
        (note,) = (note for note in states[0].notes if "not recognised" in note)
    assert "/sink, which receives /out" in note
    assert reason in note
    notes = find_threads(Plan.of(plan)).notes
    assert any("/sink, which receives /out" in note for note in notes)
    assert any(reason in note for note in notes)
