"""Logical execution time and several messages a cycle, live over DDS."""

from pathlib import Path

import polars as pl
import pytest
from small_chain import DDS_CORE, EXECUTOR_CORE, PERIOD_NS, small_chain

from chainshaper import plan_recording, run_application, simulate
from chainshaper.flow.described import shape_application
from chainshaper.planning import PlanRequest
from chainshaper.values.recording import Recording
from chainshaper.values.yaml_file import AS_YAML
from chainshaper.verify.measure import measure_latency
from chainshaper.workload.description import Application


def test_let_per_callback_has_no_jitter_of_a_period(tmp_path: Path, unshaped: Recording) -> None:
    """The slot of /t1 comes behind the end of fast callbacks, in the same cycle."""
    application = small_chain(tmp_path)
    plan = plan_recording(unshaped, request=PlanRequest(policy="let-per-callback"))
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


def application_of(messages: str, depth: int) -> Application:
    """A source with ten messages in every cycle of the gate."""
    timer = {"timer": "5ms", "publishes": ("/in",)}
    gate = {"slots": (("20ms", "45ms"),), "cycle": "50ms", "anchor": "cycle", "depth": depth}
    shape = {"subscription": "/in", "publishes": ("/out",), "gate": {**gate, "messages": messages}}
    described = {
        "name": "fast",
        "chain": "/in../out",
        "scheduling": {
            "executors": {"core": EXECUTOR_CORE, "priority": 80},
            "dds": {"core": DDS_CORE, "priority": 90},
        },
        "nodes": {
            "source": {"callbacks": (timer,)},
            "shaper": {"priority": 85, "callbacks": (shape,)},
            "sink": {"callbacks": ({"subscription": "/out"},)},
        },
    }
    return Application.model_validate(described, context=AS_YAML)


@pytest.mark.parametrize(
    ("messages", "depth", "lost"),
    [
        ("all-in-order", 20, set()),
        ("all-in-order", 2, {"overflowed"}),
        ("newest", 20, {"replaced"}),
        ("first", 20, {"surplus"}),
    ],
)
def test_what_comes_in_comes_out_or_is_counted(
    tmp_path: Path, messages: str, depth: int, lost: set[str]
) -> None:
    application = application_of(messages, depth)
    recording = run_application(application, tmp_path / "recording", cycles=100)

    def timestamps(node: str) -> set[int]:
        (pid,) = (pid for pid, name in recording.info.processes.items() if name == node)
        return set(recording.events["rmw_publish"].filter(pid=pid)["timestamp"])

    rows = recording.events["gate_release"]
    # What DDS loses on a machine that is busy with others has no row; the traversals count it.
    unseen = timestamps("/source") - set(rows["source_timestamp"])
    measured = measure_latency(recording)
    incomplete, dropped = measured.analysis.incomplete, measured.dropped
    assert len(unseen) == sum(n for why, n in incomplete.items() if why != "discarded")
    assert len(unseen) <= 0.1 * rows.height
    assert dropped is not None
    assert rows.height == len(timestamps("/shaper")) + sum(dropped.values())
    if not lost:  # a gate that a busy machine keeps from its core for long loses some
        assert sum(dropped.values()) <= 0.1 * rows.height
    else:
        assert dropped.keys() >= lost
    left = rows.filter(pl.col("release").is_not_null())
    assert left["source_timestamp"].is_sorted(), "in the order they came"
    assert set(left["anchor"]) == {"cycle"}
    if messages == "first":
        held = left.filter(pl.col("release") > pl.col("arrival"))["release"]
        assert held.len() > 0
        assert set((held - held[0]) % PERIOD_NS) == {0}, "strictly periodic"
