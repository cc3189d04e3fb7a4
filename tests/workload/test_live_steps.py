"""Described applications whose output and loop are in step: moved while they run."""

from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from chain_in_step import LEAD, LOOP, MS, chain_in_step_plan, chain_in_step_text

import chainshaper as cs
from chainshaper.planning.plan import Plan
from chainshaper.values.event_declarations import LOOP_MOVES
from chainshaper.values.recording import Recording

pytestmark = pytest.mark.timed

CYCLES = 160
SETTLED = 4_000 * MS


def run(folder: Path, moves: Literal["output", "loop"]) -> Recording:
    (folder / "app.yaml").write_text(chain_in_step_text(priority=85))
    application = cs.load_application(folder / "app.yaml")
    plan = Plan.of(chain_in_step_plan(moves, move_ns=3 * MS))
    return cs.shape_application(application, plan, folder / "live", cycles=CYCLES, realtime=None)


def usual_lead(recording: Recording) -> float:
    """From an output to the loop's next start, usually, when all has settled (ns)."""
    (pid,) = (pid for pid, name in recording.info.processes.items() if name == "/controller")
    wakes = recording.events["thread_wake"].filter(pid=pid)["time"].to_numpy()
    outputs = recording.events["gate_release"].drop_nulls("release")["release"].to_numpy()
    outputs = outputs[(outputs > outputs[0] + SETTLED) & (outputs < wakes[-1])]
    assert outputs.size > CYCLES // 4
    return float(np.median(wakes[np.searchsorted(wakes, outputs)] - outputs))


def test_the_loop_is_moved_behind_the_output(tmp_path: Path) -> None:
    recording = run(tmp_path, "loop")
    moved = recording.events["loop_moved"]
    whys = [LOOP_MOVES[why] for why in moved["why"]]
    assert whys[:2] == ["asked", "kept"] and set(whys[2:]) <= {"kept"}
    assert recording.events["gate_release"]["moved"].unique().to_list() == [0]
    # `until` is when each sleep was to end: no wake-up comes before it.
    (tid,) = moved["tid"].unique()
    slept = recording.events["thread_sleep"].filter(tid=tid)
    wakes = recording.events["thread_wake"].filter(tid=tid)["time"].to_numpy()
    behind = np.searchsorted(wakes, slept["time"].to_numpy(), side="right")
    early = slept["until"].to_numpy()[behind < wakes.size] - wakes[behind[behind < wakes.size]]
    assert early.max() <= 0
    assert np.median(-early) < LOOP / 5
    assert abs(usual_lead(recording) - LEAD) < LOOP / 5
    # Its rate is the same: it has started once in each period, but where it was moved.
    (pid,) = (pid for pid, name in recording.info.processes.items() if name == "/controller")
    wakes = recording.events["thread_wake"].filter(pid=pid)["time"].to_numpy()
    turns = np.rint(np.diff(wakes) / LOOP)
    assert np.mean(turns == 1) > 0.9


def test_the_output_is_moved_before_the_loop(tmp_path: Path) -> None:
    recording = run(tmp_path, "output")
    assert "loop_moved" not in recording.events
    gates = recording.events["gate_release"]
    assert gates["moved"].n_unique() > 1 and (gates["moved"] >= 0).all()
    assert abs(usual_lead(recording) - LEAD) < LOOP / 5
    # No output was lost, or published twice, or out of order, while slots have moved.
    outputs = gates.drop_nulls("release")
    assert gates["dropped"].null_count() == gates.height
    assert outputs["source_timestamp"].is_unique().all()
    assert outputs["source_timestamp"].is_sorted()
    assert outputs["time"].is_sorted()
