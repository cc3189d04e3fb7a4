"""What holds in every schedule: work conserved, one thread a core, slots kept, order, causality."""

import tempfile
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from schedules import MS, application
from test_schedules import plan

from chainshaper.analysis import data_flow
from chainshaper.planning import Plan
from chainshaper.planning.chain_plan import Server, Thread
from chainshaper.simulation import simulate
from chainshaper.simulation.simulating import START_NS
from chainshaper.values import events
from chainshaper.values.recording import Recording

SETTINGS = settings(
    max_examples=12,
    deadline=None,
    phases=(Phase.explicit, Phase.generate),  # a failure says enough; shrinking takes minutes
    suppress_health_check=[HealthCheck.too_slow],
)
PERIOD_MS = 20


def _ms(low: int, high: int) -> st.SearchStrategy[str]:
    return st.integers(low, high).map(lambda tenths: f"{tenths * 100}us")


def _times(high: int) -> st.SearchStrategy[dict[str, Any]]:
    constant = _ms(0, high).map(lambda time: {"constant": time})
    uniform = st.tuples(st.integers(0, high), st.integers(0, high)).map(
        lambda pair: {"uniform": [f"{min(pair) * 100}us", f"{max(pair) * 100}us"]}
    )
    return st.one_of(constant, uniform)


@st.composite
def descriptions(draw: st.DrawFn) -> dict[str, Any]:
    """Applications of up to six nodes on two cores; topics lead from a node to later ones."""
    nodes: dict[str, Any] = {}
    topics: dict[str, Any] = {}
    published: list[str] = []
    count = draw(st.integers(2, 6))
    for number in range(count):
        callbacks = []
        for place in range(draw(st.integers(1, 2))):
            callback: dict[str, Any] = {"execution": draw(_times(30))}
            if number == place == 0 or not published or draw(st.integers(0, 3)) == 0:
                periods = 1 if number == place == 0 else draw(st.sampled_from((1, 2)))
                callback["timer"] = f"{PERIOD_MS // periods}ms"
                if number + place > 0:
                    callback["phase"] = draw(_ms(0, 100))
            elif len(published) > 1 and draw(st.booleans()):
                inputs = st.lists(st.sampled_from(published), min_size=2, max_size=3, unique=True)
                callback["synchronises"] = draw(inputs)
            else:
                callback["subscription"] = draw(st.sampled_from(published))
                callback["kind"] = draw(st.sampled_from(("subscription", "service", "client")))
            topic = f"/t{number}_{place}"
            callback["publishes"] = [topic]
            topics[topic] = {
                "publication": draw(st.sampled_from(("synchronous", "asynchronous"))),
                "depth": draw(st.integers(1, 3)),
            }
            callbacks.append(callback)
        published += [topic for callback in callbacks for topic in callback["publishes"]]
        nodes[f"node{number}"] = {
            "core": draw(st.integers(1, 2)),
            "priority": draw(st.integers(2, 4)),
            "callbacks": callbacks,
        }
    simulation = {
        "interrupts": 0.0,
        "executor": draw(st.sampled_from(("single-threaded", "static", "events"))),
        "wake_up": draw(_times(3)),
        "take": draw(_times(3)),
        "publish": draw(_times(3)),
        "delivery": draw(_times(30)),
    }
    if draw(st.booleans()):
        simulation["receive"] = draw(_times(3))
    return {"chain": "node0", "nodes": nodes, "topics": topics, "simulation": simulation}


def recorded(description: dict[str, Any], servers: tuple[Server, ...] = ()) -> Recording:
    described = application(yaml.safe_dump(description))
    governed = None
    if servers:
        governed = Plan.of(plan(*servers, chain=description["chain"], cycle_ms=PERIOD_MS))
    with tempfile.TemporaryDirectory() as folder:
        recording = simulate(described, Path(folder) / "r", governed, cycles=12, switches=True)
        loaded = {name: recording.events[name] for name in recording.events}
    return Recording(recording.path, recording.info, loaded)


Stretches = dict[int, list[tuple[int, int, int]]]


def stretches(recording: Recording) -> Stretches:
    """Per core what ran there: (thread, from, to)."""
    found: Stretches = {}
    for (core,), table in events.table(recording.events, "sched_switch").group_by("cpu"):
        rows = table.sort("time", maintain_order=True).select("time", "prev_tid", "next_tid").rows()
        own = []
        for (start, _, tid), (end, before, _) in pairwise(rows):
            assert before == tid  # who leaves is who came
            if tid:
                own.append((tid, start, end))
        found[int(str(core))] = own
    return found


@SETTINGS
@given(descriptions())
def test_every_schedule_conserves_work_and_the_order_of_messages(
    description: dict[str, Any],
) -> None:
    recording = recorded(description)
    by_core = stretches(recording)
    _check_cores(recording, by_core)
    _check_work(recording, by_core)
    _check_messages(recording)
    again = recorded(description)
    assert recording.events.keys() == again.events.keys()
    assert all(recording.events[name].equals(again.events[name]) for name in again.events)


def _check_cores(recording: Recording, by_core: Stretches) -> None:
    """A core runs one thread at a time, and a thread runs on its core."""
    homes = {thread.tid: thread.cores for thread in recording.info.threads}
    for core, own in by_core.items():
        assert all(end <= start for (_, _, end), (_, start, _) in pairwise(own))
        assert all(homes[tid] == (core,) for tid, _, _ in own)


def _check_work(recording: Recording, by_core: Stretches) -> None:
    """From a callback's start to its end its core runs it, or what is as urgent at least.

    And the time for which it ran is the CPU time that it says it used.
    """
    threads = {thread.tid: thread for thread in recording.info.threads}
    frame = data_flow(recording.events).instances.drop_nulls(["end", "execution_ns"])
    for tid, start, end, used in frame.select("tid", "start", "end", "execution_ns").iter_rows():
        own = by_core.get(threads[tid].cores[0], [])
        if not own or start < own[0][1] or end > own[-1][2]:
            continue  # only partly recorded
        meanwhile = [
            (runner, min(end, to) - max(start, since))
            for runner, since, to in own
            if min(end, to) > max(start, since)
        ]
        assert sum(time for _, time in meanwhile) == end - start
        assert all(threads[one].priority >= threads[tid].priority for one, _ in meanwhile)
        assert sum(time for runner, time in meanwhile if runner == tid) == used


def _check_messages(recording: Recording) -> None:
    """Messages come after their publication, in its order, and once."""
    published = events.table(recording.events, "rmw_publish")
    stamps = set(published["timestamp"].to_list())
    taken = events.table(recording.events, "rmw_take").filter(taken=1)
    assert (taken["time"] >= taken["source_timestamp"]).all()
    for _, own in taken.group_by("pid", "rmw_subscription_handle"):
        sources = own.sort("time", maintain_order=True)["source_timestamp"].to_numpy()
        assert (np.diff(sources) >= 0).all()
        # Each topic has one publisher here, which may publish twice at an instant; never thrice.
        known = [stamp for stamp in sources if stamp in stamps]
        assert len(known) - len(set(known)) <= sum(published["timestamp"].is_duplicated())


@SETTINGS
@given(descriptions(), st.integers(0, 12), st.integers(1, 8))
def test_threads_of_a_server_never_run_outside_its_slots(
    description: dict[str, Any], first: int, length: int
) -> None:
    core, slot = description["nodes"]["node1"]["core"], (first * MS, (first + length) * MS)
    thread = Thread(node="/node1")
    governed = Server(name="s", core=core, priority=1, slots=(slot,), threads=(thread,))
    recording = recorded(description, (governed,))
    tid = next(t.tid for t in recording.info.threads if t.node == "/node1")
    for own in stretches(recording).values():
        for runner, start, end in own:
            if runner == tid and start < end:
                begin = (start - START_NS) % (PERIOD_MS * MS)
                assert slot[0] <= begin
                assert begin + (end - start) <= slot[1]
