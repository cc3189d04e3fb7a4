"""Logical execution time and several messages a cycle, live over DDS."""

from pathlib import Path
from typing import Any

import polars as pl
import pytest
from small_chain import DDS_CORE, EXECUTOR_CORE, PERIOD_NS, small_chain

from chainshaper import plan_recording, run_application, simulate
from chainshaper.flow.plan import shape_application
from chainshaper.planning import PlanRequest
from chainshaper.values.recording import Recording
from chainshaper.values.yaml_file import AS_YAML
from chainshaper.verify.measure import measure_latency
from chainshaper.workload.description import Application


def test_let_per_callback_has_no_jitter_of_a_period(tmp_path: Path) -> None:
    """The slot of /t1 comes behind the end of fast callbacks, in the same cycle."""
    application = small_chain(tmp_path)
    profile = run_application(application, tmp_path / "profile", cycles=12)
    plan = plan_recording(profile, request=PlanRequest(policy="let-per-callback"))
    shaped = shape_application(application, plan, tmp_path / "shaped", cycles=20)

    releases = shaped.events["gate_release"].filter(pl.col("overrun").is_null())
    held = releases.select("pid", "cycles_waited", since=pl.col("release") - pl.col("origin"))
    each = held.group_by("pid").agg(pl.all().unique())
    assert sorted(each["cycles_waited"].to_list()) == [[1], [2], [3]], "of the three gates"
    latencies = measure_latency(shaped).analysis.traversals["latency_ns"].drop_nulls()
    # A thread that woke behind its slot is an overrun, and later by whole cycles.
    assert latencies.min() >= 3 * PERIOD_NS  # type: ignore[operator]
    assert (latencies < 3.5 * PERIOD_NS).sum() >= 0.8 * latencies.len()
    simulated = simulate(application, tmp_path / "simulated", plan, cycles=20)
    assert measure_latency(simulated).analysis.statistics.jitter_ns == 0


CYCLE_NS = 50_000_000
GATES = {
    ("all-in-order", 20): set(),
    ("all-in-order", 2): {"overflowed"},
    ("newest", 20): {"replaced"},
    ("first", 20): {"surplus"},
}
"""What each drops of a source with ten messages in every cycle."""


@pytest.fixture(scope="module")
def gated(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """One run of a source with all gates behind it."""
    nodes: dict[str, Any] = {"source": {"callbacks": ({"timer": "5ms", "publishes": ("/in",)},)}}
    gate = {"slots": (("20ms", "45ms"),), "cycle": "50ms", "anchor": "cycle"}
    for number, (messages, depth) in enumerate(GATES):
        own = {**gate, "depth": depth, "messages": messages}
        shape = {"subscription": "/in", "publishes": (f"/out{number}",), "gate": own}
        nodes[f"shaper{number}"] = {"priority": 85, "callbacks": (shape,)}
    nodes["sink"] = {"callbacks": tuple({"subscription": f"/out{n}"} for n in range(len(GATES)))}
    described = {
        "name": "fast",
        "chain": "/in../out0",
        "scheduling": {
            "executors": {"core": EXECUTOR_CORE, "priority": 80},
            "dds": {"core": DDS_CORE, "priority": 90},
        },
        "nodes": nodes,
    }
    application = Application.model_validate(described, context=AS_YAML)
    place = tmp_path_factory.mktemp("gated") / "recording"
    return run_application(application, place, cycles=100)


@pytest.mark.parametrize(("number", "gate"), enumerate(GATES))
def test_what_comes_in_comes_out_or_is_counted(
    gated: Recording, number: int, gate: tuple[str, int]
) -> None:
    pids = {name: pid for pid, name in gated.info.processes.items()}

    def timestamps(node: str) -> set[int]:
        return set(gated.events["rmw_publish"].filter(pid=pids[node])["timestamp"])

    rows = gated.events["gate_release"].filter(pid=pids[f"/shaper{number}"])
    # What DDS loses on a machine that is busy with others has no row; the traversals count it.
    unseen = timestamps("/source") - set(rows["source_timestamp"])
    incomplete = measure_latency(gated, f"/in../out{number}").analysis.incomplete
    assert len(unseen) == sum(n for why, n in incomplete.items() if why != "discarded")
    assert len(unseen) <= 0.1 * rows.height
    dropped = set(rows["dropped"].drop_nulls())
    assert rows.height == len(timestamps(f"/shaper{number}")) + rows["dropped"].count()
    if not GATES[gate]:  # a gate that a busy machine keeps from its core for long loses some
        assert rows["dropped"].count() <= 0.1 * rows.height
    else:
        assert dropped >= GATES[gate]
    left = rows.filter(pl.col("release").is_not_null())
    assert left["source_timestamp"].is_sorted(), "in the order they came"
    assert set(left["anchor"]) == {"cycle"}
    if gate[0] == "newest":
        held = left.filter(pl.col("release") > pl.col("arrival"))["release"]
        assert held.len() > 0
        assert set((held - held[0]) % CYCLE_NS) == {0}, "strictly periodic"
