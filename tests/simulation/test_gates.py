"""The gate: its decisions against the live one's, and what it does to messages and time."""

from pathlib import Path

import polars as pl
import pytest
import yaml
from gate_table import PUBLISHING_NS, Case, cases
from schedules import MS, application, begin_of, ran, simulated
from small_chain import small_chain, small_chain_plan

from chainshaper import plan_recording, simulate
from chainshaper.analysis import analyse_latency
from chainshaper.planning import Plan, PlanRequest
from chainshaper.robot.gate import Overrun
from chainshaper.simulation import simulate_latencies
from chainshaper.values.recording import Recording
from chainshaper.workload.description import Application
from chainshaper.workload.timing import WARM_UP_CYCLES


def moves_in_order(case: Case) -> list[tuple[int, int]]:
    """From when on slots are moved, and by how much, as a description has them: later ones last."""
    moves: list[tuple[int, int]] = []
    for change in case.changes_of("moved"):
        assert isinstance(change.value, int)
        moves = [move for move in moves if move[0] < change.from_ns]
        moves.append((change.from_ns, change.value))
    return moves


def as_application(case: Case) -> Application:
    """The case's messages, each from a node on a core of its own, and its modes; the gate on 1."""
    gate, period = case.gate, "4s"
    nodes: dict[str, object] = {
        "clock": {"callbacks": [{"timer": period, "publishes": ["/tick"]}]},
        "clocked": {"callbacks": [{"subscription": "/tick", "publishes": ["/tock"]}]},
    }
    for number, (arrival, stamp) in enumerate(case.arrivals):
        assert stamp is not None
        timer = {
            "timer": period,
            "phase": f"{stamp}ns",
            "execution": {"constant": f"{arrival - stamp}ns"},
            "publishes": ["/in"],
        }
        nodes[f"source{number}"] = {"core": 10 + number, "callbacks": [timer]}
    described = {
        "slots": [[f"{bound}ns" for bound in slot] for slot in gate.slots],
        "cycle": f"{gate.cycle_ns}ns",
        **{name: getattr(gate, name) for name in ("anchor", "overrun", "due_cycles", "messages")},
        "depth": gate.depth,
        "into_open_slot": gate.into_open_slot,
        "moves": [
            [f"{WARM_UP_CYCLES * 4_000 * MS + from_ns}ns", f"{gate.slots[0][0] + by_ns}ns"]
            for from_ns, by_ns in moves_in_order(case)
        ],
    }
    if gate.modes is not None:
        announced = [(change.from_ns, str(change.value)) for change in case.changes_of("mode")]
        changes = [(3_900_000_000, gate.modes.default), *announced]  # as it was, for the next
        for number, (time, mode) in enumerate(changes):
            timer = {"timer": period, "phase": f"{time}ns", "announces": [mode]}
            driver = {"callbacks": [{**timer, "publishes": ["/mode"]}]}
            nodes[f"driver{number}"] = {"core": 40 + number, **driver}
        bands = {mode: place + 1 for mode, place in gate.modes.slots.items()}
        modes = {"bands": bands, "default": gate.modes.default}
        described["modes"] = {"topic": "/mode", "late": gate.modes.late, **modes}
    shape = {"subscription": "/in", "publishes": ["/out"], "gate": described}
    nodes["shaper"] = {"core": 2, "callbacks": [shape]}
    text = yaml.safe_dump({"chain": "/tick../tock", "nodes": nodes})
    return application(text, publish={"constant": f"{PUBLISHING_NS}ns"})


# A simulated machine has one clock, which nothing steps, and finds no phases.
SIMULATED = [case for case in cases() if not case.steps and not case.changes_of("phase")]


@pytest.mark.parametrize("case", SIMULATED, ids=lambda case: case.name)
def test_the_simulated_gate_does_what_the_table_says(tmp_path: Path, case: Case) -> None:
    # Publishing takes the sources' time as well: they are done so much earlier.
    recording = simulated(tmp_path, as_application(case))
    table = recording.events["gate_release"]
    (pid,) = set(table["pid"])
    sent = recording.events["rmw_publish"].filter(pl.col("pid") == pid)["time"].sort().to_list()
    found = [
        row["dropped"] or sent.pop(0) - begin_of(recording)
        for row in table.sort("arrival", maintain_order=True).iter_rows(named=True)
    ]
    assert tuple(found) == case.leave
    assert not sent


def published(recording: Recording, node: str) -> list[float]:
    (pid,) = (pid for pid, name in recording.info.processes.items() if name == node)
    times = recording.events["rmw_publish"].filter(pid=pid)["time"]
    return [(time - begin_of(recording)) / 1e6 for time in times]


CHAIN = """
chain: /in../out
nodes:
  source:
    callbacks:
      - {timer: 100ms, execution: {constant: 10ms}, publishes: [/in]}
  shaper:
    core: 2
    callbacks:
      - subscription: /in
        publishes: [/out]
        gate: {slots: [[30ms, 40ms]], cycle: 100ms, spin: 1ms, pause: 2ms}
"""


def test_a_gate_watches_the_clock_before_its_slot_and_pauses_behind_it(tmp_path: Path) -> None:
    costs = {"wake_up": {"constant": "500us"}, "publish": {"constant": "100us"}}
    recording = simulated(tmp_path, application(CHAIN, **costs))
    release = recording.events["gate_release"].row(0, named=True)
    assert release["time"] == release["release"]  # it woke 0.5 ms before, and watched
    (end,) = (
        recording.events["callback_end"].filter(pl.col("pid") == release["pid"])["time"].to_list()
    )
    # Published at 30 (after the origin), pause until 32.1, awake again half a millisecond later.
    assert (end - release["origin"]) / 1e6 == pytest.approx(30 + 0.1 + 2 + 0.5)


@pytest.mark.parametrize(("thread", "first_ms"), [("free", 3), ("in-slots", 16)])
def test_a_shaping_node_in_its_server_publishes_as_a_free_one_and_runs_later(
    tmp_path: Path, thread: str, first_ms: int
) -> None:
    """The output is there after 3 ms at least; the server opens at 16 for a slot at 21."""
    governed = small_chain_plan(10 * MS, 20 * MS, spin_ns=MS, shaping_thread=thread, anchor="cycle")
    recording = simulated(tmp_path, small_chain(tmp_path), governed, cycles=20)
    assert {round(at % 50, 1) for at in published(recording, "/chainshaper_t3")} == {21.0}
    earliest = min(at % 50 for name, at, _ in ran(recording) if name == "chainshaper_t3")
    assert first_ms <= earliest < first_ms + 10


TWO_SINKS = """
chain: /in../left
nodes:
  source: {callbacks: [{timer: 40ms, execution: {constant: 2ms}, publishes: [/in]}]}
  left: {callbacks: [{subscription: /in, execution: {constant: 3ms}, publishes: [/left]}]}
  right:
    core: 2
    callbacks: [{subscription: /in, execution: {constant: 7ms}, publishes: [/right]}]
"""


def test_every_sink_of_a_plan_has_its_shaping_node(tmp_path: Path) -> None:
    described = application(TWO_SINKS)
    profile = simulate(described, tmp_path / "profile", cycles=5)
    planned = plan_recording(profile, sinks=["/in../right"]).chains[
        0
    ]  # longest 5 ms and 9 ms, margin 1 ms
    recording = simulated(tmp_path, described, planned, cycles=2)
    assert published(recording, "/left") == [5, 45]
    assert published(recording, "/chainshaper_left") == [6, 46]
    assert published(recording, "/right") == [9, 49]
    assert published(recording, "/chainshaper_right") == [10, 50]


def test_under_let_per_callback_every_output_waits_for_the_next_cycle(tmp_path: Path) -> None:
    described = application(TWO_SINKS)
    profile = simulate(described, tmp_path / "profile", cycles=5)
    planned = plan_recording(
        profile,
        request=PlanRequest(policy="let-per-callback", spin_ns=300_000, pause_ns=500_000),
    ).chains[0]
    recording = simulated(tmp_path, described, planned, cycles=3)
    # The nodes share core 1. Before its slot [1, 2) that of /in watches no clock, so the source has
    # its 2 ms from the timer on; /left comes in the slot [0, 1) of the cycle after that.
    assert published(recording, "/source") == [2, 42, 82]
    assert published(recording, "/chainshaper_in") == [1, 41, 81, 121]
    assert published(recording, "/left") == [5, 45, 85, 124]
    assert published(recording, "/chainshaper_left") == [0, 40, 80, 120, 160]
    # The chain starts where it did before /in was shaped.
    analysis = analyse_latency(recording, recording.info.chain or "")
    assert analysis.traversals["latency_ns"].to_list() == [80_000_000] * 3
    assert simulate_latencies(described, Plan.of(planned), cycles=3).tolist() == [80_000_000] * 3


@pytest.mark.parametrize(("overrun", "late"), [(None, 15 * MS), ("wait", 46 * MS), ("discard", -1)])
def test_an_output_that_missed_its_slot_is_late_by_what_it_is_late_not_by_a_cycle(
    tmp_path: Path, overrun: Overrun | None, late: int
) -> None:
    text = """
    chain: /in../out
    nodes:
      source: {callbacks: [{timer: 40ms, publishes: [/in]}]}
      sink: {callbacks: [{subscription: /in, EXECUTION, publishes: [/out]}]}
    """
    usual, longer = (text.replace("EXECUTION", f"execution: {{constant: {n}ms}}") for n in (5, 15))
    profile = simulate(application(usual), tmp_path / "profile", cycles=300)
    plan = plan_recording(profile, request=PlanRequest(overrun=overrun)).chains[0]  # [6, 7) ms
    latencies = simulate_latencies(application(longer), Plan.of(plan), cycles=3)
    # Each is done in its own cycle, also where it is sent in slots only.
    assert latencies.tolist() == [late] * 3
