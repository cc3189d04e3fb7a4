"""Simulated recordings: like live ones, readable by everything downstream, whole or absent."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from known import known
from measured_costs import measured_costs
from schedules import application, simulated
from small_chain import small_chain

from chainshaper.analysis import LatencyAnalysis, analyse_latency, data_flow
from chainshaper.flow.plan import plan_recording
from chainshaper.planning import ChainPlan, Plan
from chainshaper.simulation import machine, simulate, simulate_latencies
from chainshaper.simulation.simulating import with_recorded_times
from chainshaper.values.durations import parse_duration
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.recording import Recording
from chainshaper.workload.description import Application, load_application

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def chain() -> Application:
    return load_application(EXAMPLES / "synthetic_chain.yaml")


def test_tables_and_columns_are_those_of_a_live_recording(
    tmp_path: Path, unshaped: Recording, shaped: Recording, plan: ChainPlan
) -> None:
    ours = simulate(small_chain(tmp_path), tmp_path / "ours", Plan.of(plan), cycles=12)
    for theirs in (unshaped, shaped):
        for name in theirs.events:
            if name in {"machine_stall", "machine_pace"}:  # nobody watches the simulated machine
                continue
            assert ours.events[name].schema == theirs.events[name].schema, name
    assert ours.events.keys() <= {*shaped.events}


def test_the_same_seed_draws_the_execution_times_of_the_live_workload(
    tmp_path: Path, unshaped: Recording
) -> None:
    """A live callback used what was drawn for it, and a little for publishing; never less."""
    described = small_chain(tmp_path)
    costs = {name: {"constant_ns": 0} for name in ("wake_up", "take", "publish", "delivery")}
    free = described.simulation.model_validate({**costs, "interrupts": 0.0})
    ours = simulate(described.model_copy(update={"simulation": free}), tmp_path / "ours", cycles=12)
    chains = [analyse_latency(recording, "/t1../t3") for recording in (ours, unshaped)]
    drawn, used = (
        _execution_times(analysis, recording)
        for analysis, recording in zip(chains, (ours, unshaped), strict=True)
    )
    assert len(drawn) == len(used) == 12 * 3
    assert (used >= drawn).all()
    assert np.corrcoef(drawn, used)[0, 1] > 0.8


def _execution_times(
    analysis: LatencyAnalysis, recording: Recording
) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """CPU times in the chain's instances, by traversal and hop."""
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    times = analysis.hops.select("traversal", "hop", "instance").join(
        flow.instances.select("instance", "execution_ns"), on="instance"
    )
    return times.sort("traversal", "hop")["execution_ns"].to_numpy()


FUSION = """
chain: /front../fused
nodes:
  front: {core: 2, callbacks: [{timer: 100ms, publishes: [/front]}]}
  rear: {core: 3, callbacks: [{timer: 100ms, phase: 7ms, publishes: [/rear]}]}
  fusion:
    callbacks: [{synchronises: [/front, /rear], execution: {constant: 2ms}, publishes: [/fused]}]
"""

LATER = """
chain: /t2../t3
nodes:
  a: {callbacks: [{timer: 100ms, execution: {uniform: [1ms, 50ms]}, publishes: [/t1]}]}
  b: {callbacks: [{subscription: /t1, execution: {constant: 2ms}, publishes: [/t2]}]}
  c: {callbacks: [{subscription: /t2, execution: {constant: 3ms}, publishes: [/t3]}]}
"""

SKIPPING = """
chain: /t1../t2
nodes:
  a:
    callbacks:
      - {timer: 100ms, execution: {constant: 1ms}, publishes: [/t1]}
      - {timer: 400ms, execution: {constant: 250ms}}
  b: {core: 2, callbacks: [{subscription: /t1, execution: {constant: 3ms}, publishes: [/t2]}]}
"""
SMALL = {  # and the latencies that they can have, in ms
    "fusion": (FUSION, {9}),
    "from a subscription on": (LATER, {5}),
    "a timer that skips expiries": (SKIPPING, {4}),
}


@pytest.mark.parametrize("name", ["synthetic_chain", "asynchronous_chain", *SMALL])
def test_latencies_only_are_those_that_the_analysis_finds(tmp_path: Path, name: str) -> None:
    text, possible = SMALL.get(name, ("", set()))
    described = application(text) if text else load_application(EXAMPLES / f"{name}.yaml")
    profile = simulate(described, tmp_path / "profile", cycles=200)
    planned = None if text else plan_recording(profile)
    shaped = simulate(described, tmp_path / "shaped", planned, cycles=500)
    for recording, plan, cycles in ((profile, None, 200), (shaped, planned, 500)):
        table = analyse_latency(recording, described.chain).traversals.sort("start")
        found = table["latency_ns"].fill_null(-1).to_list()
        assert simulate_latencies(described, plan, cycles=cycles).tolist() == found
        assert not text or set(found) == {ms * 1_000_000 for ms in possible}
        assert (len(found) < cycles) == (text == SKIPPING)


def test_a_long_simulation_is_written_in_parts_that_read_as_one(
    tmp_path: Path, chain: Application, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = simulate(chain, tmp_path / "whole", cycles=2000)
    monkeypatch.setattr(machine, "LOG_ROWS", 4096)
    parts = simulate(chain, tmp_path / "parts", cycles=2000)
    assert len(list((parts.path / "rmw_take.parquet").iterdir())) > 3
    assert parts.events.keys() == whole.events.keys()
    assert all(parts.events[name].equals(whole.events[name]) for name in whole.events)


_PEAKS = """
import resource, sys
from chainshaper import load_application, simulate

for name, cycles in (("short", 4000), ("long", 24000)):
    recording = simulate(load_application(sys.argv[1]), f"{sys.argv[2]}/{name}", cycles=cycles)
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
print(sum(table.estimated_size() for table in recording.events.values()))
"""


def test_memory_does_not_grow_with_the_cycles(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _PEAKS, str(EXAMPLES / "synthetic_chain.yaml"), str(tmp_path)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    short, long, in_memory = map(int, run.stdout.split())
    assert long - short < in_memory / 4, f"{long - short} more for events of {in_memory} bytes"


def test_stretches_of_samples_keep_what_belongs_together() -> None:
    described = application(
        """
        chain: a../b
        nodes:
          a: {callbacks: [{timer: 100ms, execution: {samples: [1ms, 2ms, 3ms, 4ms], block: BLOCK},
                           publishes: [/a]}]}
          b: {callbacks: [{subscription: /a, publishes: [/b],
                           execution: {samples: [10ms, 20ms, 30ms, 40ms], block: BLOCK}}]}
        """.replace("BLOCK", "4")
    )
    latencies = simulate_latencies(described, cycles=800)
    # 11, 22, 33 or 44 ms: of the same place in both.
    assert set(latencies.tolist()) == {11_000_000 * place for place in (1, 2, 3, 4)}
    found = (latencies // 11_000_000).tolist()
    # Five cycles came before: stretches of four end with the cycles 2, 6, 10, ...
    within = [(one, two) for i, (one, two) in enumerate(pairwise(found)) if i % 4 != 2]
    assert all(two == one % 4 + 1 for one, two in within)
    across = [(one, two) for i, (one, two) in enumerate(pairwise(found)) if i % 4 == 2]
    assert any(two != one % 4 + 1 for one, two in across)


def test_costs_of_large_messages_are_told_apart_from_the_dds_threads_that_receive_them(
    tmp_path: Path,
) -> None:
    """A camera below the DDS threads of its core; its images need 1 ms there, and 0.4 ms before."""
    costs = {"wake_up": "130us", "take": "20us", "publish": "70us"}
    described = application(
        """
        chain: /image../seen
        nodes:
          camera:
            core: 0
            callbacks:
              - {timer: 100ms, publishes: [/image]}
              - {timer: 100ms, execution: {constant: 2ms}, publishes: [/other]}
          eye:
            callbacks:
              - {subscription: /image, execution: {constant: 10ms}, publishes: [/seen]}
          lid: {callbacks: [{subscription: /image, execution: {constant: 10ms}}]}
          brain: {callbacks: [{subscription: /seen, execution: {constant: 10ms}}]}
          ear: {core: 2, callbacks: [{subscription: /other}]}
        """,
        **{name: {"constant": cost} for name, cost in costs.items()},
        delivery={"constant": "400us"},
        receive={"constant": "1ms"},
    )
    found = measured_costs(simulate(described, tmp_path / "profile", cycles=20))
    for name, text in costs.items():
        assert set(getattr(found, name).samples_ns) == {parse_duration(text)}, name
    # Delivery, then a DDS thread wakes up and receives: /image for eye, /other for ear.
    assert set(found.delivery.samples_ns or ()) == {400_000 + 130_000 + 1_000_000}
    assert found.interrupts == 0.0, "the camera was interrupted by DDS threads, eye by nobody"


def test_a_recording_without_the_applications_callbacks_is_no_source_of_times(
    tmp_path: Path, chain: Application, unshaped: Recording
) -> None:
    said = "/node1 has CPU times of 0 callbacks of timers of 100 ms, and 1 are described"
    with pytest.raises(InputError, match=said):
        with_recorded_times(chain, unshaped)


def test_a_synchronising_callback_computes_when_it_publishes(tmp_path: Path) -> None:
    """/front is the last that it names, and always comes first: it only leaves its message."""
    described = application(FUSION.replace("[/front, /rear]", "[/rear, /front]"))
    again = with_recorded_times(described, simulate(described, tmp_path / "recorded", cycles=20))
    assert again.nodes["fusion"].callbacks[0].execution.samples_ns == (2_000_000,) * 20
    silent = FUSION.replace("/front../fused", "/front").replace(", publishes: [/fused]", "")
    sink = application(silent)
    recorded = simulate(sink, tmp_path / "sink", cycles=20)
    with pytest.raises(InputError, match="/fusion never published what it synchronises from"):
        with_recorded_times(sink, recorded)


ALIKE = """
chain: /a
nodes:
  source:
    callbacks:
      - {timer: 100ms, execution: {constant: 1ms}, publishes: [/a]}
      - {timer: 100ms, execution: {constant: 5ms}}
  sink:
    callbacks:
      - {subscription: /a, execution: {constant: 7ms}}
      - {subscription: /a, execution: {constant: 3ms}}
"""


def test_callbacks_with_the_same_trigger_keep_their_own_times(tmp_path: Path) -> None:
    described = application(ALIKE)
    recorded = simulate(described, tmp_path / "recorded", cycles=20)
    again = with_recorded_times(described, recorded, block=5)
    drawn = [one.execution for _, one in again.callbacks()]
    assert [(set(known(one.samples_ns)), one.block) for one in drawn] == [
        ({ms * 1_000_000}, 5) for ms in (1, 5, 7, 3)
    ]
    fewer = application(ALIKE.replace("      - {timer: 100ms, execution: {constant: 5ms}}\n", ""))
    said = "/source has CPU times of 2 callbacks of timers of 100 ms, and 1 are described"
    with pytest.raises(InputError, match=said):
        with_recorded_times(fewer, recorded)


def test_what_piles_up_without_end_is_reported(tmp_path: Path) -> None:
    described = application(
        """
        chain: source
        nodes:
          source: {core: 2, callbacks: [{timer: 1ms, publishes: [/a]}]}
          node: {callbacks: [{subscription: /a}]}
        """,
        delivery={"constant": "10s"},
    )
    with pytest.raises(OperationError, match="messages pile up without end"):
        simulated(tmp_path, described, cycles=20_000)
    assert list(tmp_path.iterdir()) == []
