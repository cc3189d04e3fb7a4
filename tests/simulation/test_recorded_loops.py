"""What a recording says of the loop that a chain goes through, and plans that are made from it."""

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from known import known
from schedules import application

from chainshaper.analysis import recorded_flow
from chainshaper.analysis.chains import find_chain
from chainshaper.analysis.graph import graph_of
from chainshaper.flow.plan import plan_recording, profile_chains
from chainshaper.flow.recorded_processes import recorded_processes
from chainshaper.flow.recorded_profile.loops import before_loop, phase_of
from chainshaper.simulation import simulate
from chainshaper.sources import open_source
from chainshaper.values.application import Chain
from chainshaper.values.errors import InputError

MS, US = 1_000_000, 1_000
CYCLES = np.arange(0, 20_000 * MS, 20 * MS, dtype=np.int64)


@settings(deadline=None, max_examples=40)
@given(
    st.sampled_from([1, 5, 10, 20, 40]), st.integers(0, 20_000), st.integers(0, 100), st.booleans()
)
def test_phase_and_jitter_are_those_of_the_starts(
    period: int, phase_us: int, jitter_us: int, drifts: bool
) -> None:
    """And of clocks that drift apart by 50 ppm, the phase at the end."""
    random = np.random.default_rng(7)
    common = min(period, 20) * MS
    drift = 50e-6 if drifts else 0.0
    due = np.arange(0, 19_900 * MS, period * MS, dtype=np.int64)
    due = phase_us * US + (due * (1 - drift)).astype(np.int64)
    late = random.integers(0, jitter_us * US + 1, len(due))
    phase = phase_of(np.sort(due + late), CYCLES, common)
    assert phase.drift_ppm == pytest.approx(drift * 1e6, abs=1.5)
    expected = int(due[-1]) % common

    def apart(found: int) -> int:
        around = (found - expected) % common
        return min(around, common - around)

    assert apart(phase.phase_ns) <= 0.02 * jitter_us * US + 5 * US
    assert abs(phase.jitter_ns - jitter_us * US) <= 0.06 * jitter_us * US + 5 * US


@pytest.mark.parametrize("drift", [0.0, 50e-6, -300e-6])
def test_late_starts_are_no_drift(drift: float) -> None:
    """A loop that is late by more and more, and skips instances then, is where it was behind that.

    Followed from start to start it is a period further each time.
    """
    due = np.arange(0, 19_900 * MS, 10 * MS, dtype=np.int64)
    due = 3 * MS + (due * (1 - drift)).astype(np.int64)
    late = np.zeros(len(due), np.int64)
    for stall in range(200, 1700, 400):
        late[stall : stall + 3] = 3 * MS, 6 * MS, 9 * MS
    kept = np.delete(np.arange(len(due)), np.arange(203, 1700, 400))
    phase = phase_of((due + late)[kept], CYCLES, 10 * MS)
    assert phase.drift_ppm == pytest.approx(drift * 1e6, abs=0.5)
    assert phase.phase_ns == pytest.approx(int(due[-1]) % (10 * MS), abs=10 * US)
    assert phase.jitter_ns <= 50 * US, "8 of 1986 starts are late, or early as the next one: 0.4 %"


def test_starts_without_a_usual_phase_have_their_period_as_jitter() -> None:
    starts = np.sort(np.random.default_rng(3).integers(0, 20_000 * MS, 900))
    assert phase_of(starts, CYCLES, 10 * MS) == (0, 10 * MS, 0.0)


CHAIN = """
chain: /scan../driven
nodes:
  sensor: {core: 2, callbacks: [{timer: 20ms, publishes: [/scan], execution: {constant: 1ms}}]}
  filter:
    core: 2
    callbacks: [{subscription: /scan, publishes: [/out], execution: {constant: 2ms}}]
  controller:
    core: 3
    callbacks:
      - {loop: 10ms, phase: 5ms, core: 1, reads: [/out], execution: {constant: 300us},
         publishes: [/command]}
  driver: {core: 3, callbacks: [{subscription: /command, publishes: [/driven]}]}
"""
COSTS: dict[str, Any] = {"delivery": {"constant": "150us"}}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("loops") / "recording"
    simulate(application(CHAIN, **COSTS), folder, cycles=100)
    return folder


@pytest.mark.parametrize("chain", ["/scan../driven", "/scan../command", "/scan../controller:end"])
def test_a_chain_through_a_loop_is_planned_up_to_what_the_loop_reads(
    chain: str, recording: Path
) -> None:
    (profile,) = profile_chains(recording, [chain])
    assert profile.topics == ("/scan", "/out")
    assert (profile.spec, profile.receivers) == ("/scan../out", ("/controller",))
    loop = known(profile.loop)
    assert (loop.chain, loop.node, loop.topic, loop.thread) == (
        chain,
        "/controller",
        "/out",
        "loop",
    )
    assert (loop.period_ns, loop.phase_ns, loop.jitter_ns) == (10 * MS, 5 * MS, 0)
    assert (loop.stored_ns, loop.storing_ns) == ((150 * US, 150 * US, 150 * US), 0)
    assert (loop.core, loop.time_ns, loop.once_ns) == (1, 600 * US, 300 * US)
    assert loop.realtime_priority is None, "the description raised it"
    (plan,) = plan_recording(recording, chain).chains
    assert plan.chain.output == known(plan.shaping_node).output == "/out"
    assert known(plan.loop).chain == chain
    # Latencies are 3.15 ms; with 1 ms behind them outputs leave at 4.15 ms, just before the loop.
    assert known(plan.loop).age.first_ns == (5 * MS, 5 * MS)


def test_what_is_before_no_loop_has_none(recording: Path) -> None:
    (profile,) = profile_chains(recording, ["/scan../out"])
    assert profile.loop is None
    with pytest.raises(InputError, match=r"--in-step: /scan../out goes through no loop"):
        plan_recording(recording, "/scan../out", in_step=True)
    flow = recorded_flow(open_source(recording))
    whole = find_chain(graph_of(flow), "/scan../driven")
    behind = Chain("/controller..", whole.callbacks[2:], whole.topics[2:])
    with pytest.raises(InputError, match=r"begins at /controller ← /out.*publishes /out"):
        before_loop(flow, behind)


def test_too_few_instances_are_refused(tmp_path: Path) -> None:
    simulate(application(CHAIN, **COSTS), tmp_path / "short", cycles=4)
    with pytest.raises(InputError, match="instances, too few to plan with: record longer"):
        profile_chains(tmp_path / "short", ["/scan../command"])


def test_the_thread_of_a_recorded_loop_is_known_as_that(tmp_path: Path) -> None:
    """In the example, /controller is process 200, and its loop the thread 203."""
    examples = Path(__file__).parents[2] / "examples"
    runpy.run_path(str(examples / "write_loop.py"))["main"](str(tmp_path / "loop"))
    processes, _ = recorded_processes(open_source(tmp_path / "loop"))
    threads = {thread.tid: thread for process in processes for thread in process.threads}
    assert (threads[203].role, threads[203].nodes) == ("loop", ("/controller",))
    assert threads[200].role == "executor"
