"""One point: worked out by hand, and against the same steps taken one by one."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quick_chain import quick_chain

from chainshaper.flow.plan import plan_recording
from chainshaper.flow.sweep import FIGURES, OTHER_RUN, grid_of, points_of, profile_at, row_at
from chainshaper.planning import PlanRequest
from chainshaper.simulation import simulate, simulate_latencies
from chainshaper.verify.measure import measure_latency
from chainshaper.workload.description import Application

MS = 1_000_000
VARYING = {"uniform": ["1ms", "4ms"]}


def _rows(
    application: Application, axes: dict[str, Any], cycles: int = 20, plan: Any = None
) -> Any:
    grid = grid_of(application, axes, plan, cycles=cycles)
    return [
        row_at(grid, point, None if plan is not None else profile_at(grid, point))
        for point in points_of(grid)
    ]


def test_a_point_is_what_simulate_plan_simulate_give(tmp_path: Path) -> None:
    application = quick_chain(VARYING, VARYING, wake_up={"uniform": ["10us", "90us"]})
    (row,) = _rows(application, {"bands": (2,), "epsilon": ("500us",)}, cycles=300)
    profile = simulate(application, tmp_path / "profile", cycles=300)
    plan = plan_recording(profile, None, PlanRequest(bands=2, epsilon_ns=500_000, seed=7))
    judged = simulate(
        application, tmp_path / "judged", plan, cycles=300, seed=application.seed + OTHER_RUN
    )
    measured = measure_latency(judged)
    assert list(row) == list(FIGURES)
    assert row["profile_max_ns"] == plan.evidence.max_latency_ns
    assert row["predicted_mean_ns"] == plan.predicted.mean_ns
    for name in ("count", "incomplete", "min_ns", "mean_ns", "max_ns", "jitter_ns", "spread_ns"):
        assert row[name] == getattr(measured.analysis.statistics, name), name
    assert row["p99_ns"] == measured.analysis.statistics.percentiles_ns["99"]
    assert measured.prediction is not None
    assert row["late"] == measured.prediction.late
    for ours, held in zip(row["per_band"], measured.prediction.bands, strict=True):
        assert ours["share"] * row["count"] == pytest.approx(held.count)
        assert ours["jitter_ns"] == held.jitter_ns


def test_a_share_of_late_cycles_is_judged_by_all_cycles_of_the_profile() -> None:
    """Not by the hundred that are recorded for the application's structure."""
    axes = {"overrun_probability": (0.01,), "policy": ("shaped",)}
    few, many = (_rows(quick_chain(VARYING), axes, cycles=cycles)[0] for cycles in (200, 300))
    assert "200 cycles are too few for an overrun probability of 0.01" in few["error"]
    assert many["error"] is None


def test_a_percentile_is_of_all_cycles_of_the_profile() -> None:
    """The 297th of 300 latencies, and the last."""
    application = quick_chain(VARYING)
    some, every = _rows(application, {"percentile": (99, 100)}, cycles=300)
    latencies = np.sort(simulate_latencies(application, cycles=300))
    assert (some["profile_max_ns"], every["profile_max_ns"]) == (latencies[296], latencies[299])


def test_constant_times_by_hand() -> None:
    """2 ms and 2 ms: L̄ = 4 ms; with ε = 1 ms the slot is [5 ms, 6 ms), left at its start."""
    (row,) = _rows(quick_chain(), {"epsilon": ("1ms",)})
    assert (row["profile_min_ns"], row["profile_max_ns"]) == (4 * MS, 4 * MS)
    assert (row["predicted_mean_ns"], row["predicted_max_ns"]) == (6 * MS, 6 * MS)
    assert (row["count"], row["incomplete"], row["late"]) == (20, 0, 0)
    assert (row["min_ns"], row["mean_ns"], row["max_ns"], row["jitter_ns"]) == (5 * MS,) * 3 + (0,)
    slot = {"start_ns": 5 * MS, "end_ns": 6 * MS}
    assert row["per_band"] == [{**slot, "predicted_share": 1.0, "share": 1.0, "jitter_ns": 0}]


def test_outputs_that_outgrow_a_given_plan_are_late_or_lost_by_hand(tmp_path: Path) -> None:
    """10 ms instead of 4 miss the slot [5 ms, 6 ms): they leave 50 ms later, or not at all."""
    plan = plan_recording(simulate(quick_chain(), tmp_path / "profile", cycles=5))
    axes = {
        "nodes.second.callbacks.0.execution.constant": ("2ms", "8ms"),
        "plan.overrun": ("wait", "discard"),
        # The chain may go on outside of its slot, or its second callback waited for the next.
        "plan.servers.0.slots.0.1": ("50ms",),
    }
    in_time, in_time_too, waited, discarded = _rows(quick_chain(), axes, plan=plan)
    for row in (in_time, in_time_too):
        assert (row["count"], row["late"], row["max_ns"]) == (20, 0, 5 * MS)
    assert (waited["count"], waited["late"]) == (20, 20)
    assert (waited["min_ns"], waited["max_ns"]) == (55 * MS, 55 * MS)
    assert waited["per_band"][0]["share"] == 0.0
    assert (discarded["count"], discarded["incomplete"], discarded["late"]) == (0, 20, 0)
    assert discarded["mean_ns"] is None


def test_a_chain_is_profiled_in_front_of_all_others() -> None:
    """Unplanned, a load of 10 to 20 ms with a better priority is in the latency; not in L̄."""
    axes = {
        "interference": ("20ms",),
        "nodes.interference.priority": (95,),
        "nodes.interference.callbacks.0.phase": ("500us",),  # while the first callback runs
        "policy": ("none", "server-per-chain"),
    }
    unplanned, planned = _rows(quick_chain(VARYING, VARYING), axes, cycles=50)
    assert unplanned["min_ns"] >= 12 * MS
    assert planned["profile_max_ns"] <= 8 * MS
    assert planned["max_ns"] <= 8 * MS, "its server is in front as well"
    assert unplanned["profile_max_ns"] is None


@pytest.mark.parametrize(
    ("execution", "axes", "reason"),
    [
        ({"constant": "49ms"}, {"bands": (1,)}, "do not fit into the cycle of 50 ms"),
        (VARYING, {"bands": (40,), "grid": ("1ms",)}, "slots"),
        (VARYING, {"bands": (2,), "policy": ("server-per-chain",)}, "places latency bands"),
    ],
)
def test_a_point_that_cannot_be_says_why(execution: Any, axes: Any, reason: str) -> None:
    (row,) = _rows(quick_chain(execution), axes)
    assert reason in row["error"]
    assert row["mean_ns"] is None
    assert list(row) == list(FIGURES)
