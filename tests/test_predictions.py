"""Prediction beside measurement: known answers, and a live run with three bands."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from rich.console import Console
from small_chain import small_chain

from chainshaper import compare_recordings, measure_latency, plan_recording, shape_application
from chainshaper.analysis import LatencyAnalysis, latency_statistics
from chainshaper.planning import (
    Modes,
    Plan,
    PlanRequest,
    Profile,
    plan_chain,
    publish_slots,
)
from chainshaper.planning.overruns import cycles_until_output
from chainshaper.planning.plan import revised
from chainshaper.predictions import hold_prediction
from chainshaper.recording import Recording
from chainshaper.reporting.predictions import prediction_json, prediction_table

MS = 1_000_000
PROFILE = Profile(np.array([40, 50, 60, 61, 69, 84]) * MS, 100 * MS)


def _measured(latencies: list[int], like: LatencyAnalysis) -> LatencyAnalysis:
    """An analysis with other latencies, one traversal each, and no hops."""
    values = np.array(latencies, dtype=np.int64)
    return replace(
        like,
        traversals=pl.DataFrame(
            {
                "traversal": range(values.size),
                "latency_ns": values,
                "complete": [True] * values.size,
                "disturbed": [False] * values.size,
            },
            schema={
                "traversal": pl.Int64(),
                "latency_ns": pl.Int64(),
                "complete": pl.Boolean(),
                "disturbed": pl.Boolean(),
            },
        ),
        hops=like.hops.clear(),
        undisturbed=latency_statistics(values),
    )


@pytest.fixture
def like(unshaped: Recording) -> LatencyAnalysis:
    return measure_latency(unshaped).analysis


def _bands(bands: int = 3) -> Plan:
    return plan_chain(PROFILE, PlanRequest(bands=bands, publish_slot_ns=MS))


def test_outputs_at_slot_starts_are_as_predicted(
    unshaped: Recording, like: LatencyAnalysis
) -> None:
    plan = _bands()
    starts = [start for start, _ in publish_slots(plan)]
    counts = [round(share * 6) for share in plan.predicted.shares]
    latencies = [
        start + 50_000 for start, count in zip(starts, counts, strict=True) for _ in range(count)
    ]
    held = hold_prediction(plan, unshaped, _measured(latencies, like))
    assert (held.mean.holds, held.max.holds, held.jitter.holds) == (True, True, True)
    assert held.mean.at_end_ns == plan.predicted.mean_ns
    assert held.mean.at_start_ns == pytest.approx(plan.predicted.mean_ns - MS, abs=2)
    assert held.max.at_start_ns == starts[-1]
    assert held.jitter.at_start_ns == starts[-1] - starts[0]
    assert [band.count for band in held.bands] == counts
    assert [band.inside for band in held.bands] == counts
    assert [band.share for band in held.bands] == pytest.approx(plan.predicted.shares)
    assert [band.jitter_ns for band in held.bands] == [0, 0, 0]
    assert held.late == 0


def test_what_differs_is_said_to_differ(unshaped: Recording, like: LatencyAnalysis) -> None:
    plan = _bands(1)
    held = hold_prediction(plan, unshaped, _measured([85 * MS, 97 * MS, 203 * MS], like))
    assert (held.max.holds, held.jitter.holds) == (False, False)
    assert held.bands[0].inside == 1
    assert held.bands[0].jitter_ns == 12 * MS
    assert held.late == 1
    nothing = hold_prediction(plan, unshaped, _measured([], like))
    assert (nothing.mean.holds, nothing.bands[0].share) == (None, None)
    assert prediction_json(nothing)["bands"][0]["jitter_ns"] is None


def test_let_publishes_a_cycle_later(unshaped: Recording, like: LatencyAnalysis) -> None:
    plan = plan_chain(PROFILE, PlanRequest(policy="let-per-chain"))
    assert cycles_until_output(plan) == 1
    held = hold_prediction(plan, unshaped, _measured([100 * MS + 10, 100 * MS + 20], like))
    assert (held.mean.at_start_ns, held.mean.at_end_ns) == (100 * MS, 101 * MS)
    assert (held.mean.holds, held.max.holds, held.late) == (True, True, 0)
    assert held.bands[0].count == held.bands[0].inside == 2


def test_policies_without_slots_predict_one_figure(
    unshaped: Recording, like: LatencyAnalysis
) -> None:
    for policy, start in (("server-per-chain", None), ("one-long-slot", 62 * MS)):
        request = PlanRequest(policy=policy, slot_start_ns=start)  # type: ignore[arg-type]
        plan = plan_chain(PROFILE, request)
        held = hold_prediction(plan, unshaped, _measured([63 * MS, 85 * MS], like))
        assert held.mean.at_start_ns == held.mean.at_end_ns == plan.predicted.mean_ns


def test_each_mode_is_held_by_its_own_band(unshaped: Recording, like: LatencyAnalysis) -> None:
    """Two of the six latencies are behind the slot of the mode `fast`: one such output waits."""
    chain = replace(PROFILE, nodes=("/a", "/b"), topics=("/x", "/y"))
    plan = revised(
        plan_chain(chain, PlanRequest(bands=2, publish_slot_ns=MS)),
        modes=Modes(topic="/m", default="slow", bands={"slow": 2, "fast": 1}),
    )
    (first, _), (last, _) = publish_slots(plan)
    outputs = [
        ("slow", 1, None, last + 10),
        ("slow", 1, None, last + 40),
        ("fast", 0, None, first + 20),
        ("fast", 0, "wait", first + 100 * MS),
    ]
    stamps = range(1, 5)
    analysis = _measured([latency for *_, latency in outputs], like)
    last_hop = len(like.chain.callbacks) - 1
    hops = pl.DataFrame({"traversal": range(4), "hop": [last_hop] * 4, "source_timestamp": stamps})
    releases = pl.DataFrame(
        {
            "source_timestamp": stamps,
            **{
                name: [output[place] for output in outputs]
                for place, name in enumerate(("mode", "slot", "overrun"))
            },
        }
    )
    recording = replace(unshaped, events={**unshaped.events, "gate_release": releases})
    held = hold_prediction(plan, recording, replace(analysis, hops=hops))
    slow, fast = held.bands
    assert (slow.mode, slow.count, slow.inside, slow.late, slow.jitter_ns) == ("slow", 2, 2, 0, 30)
    assert (fast.mode, fast.count, fast.inside, fast.late, fast.jitter_ns) == ("fast", 1, 1, 1, 0)
    assert (slow.share, fast.share) == (1, 0.5)
    assert (slow.predicted_share, fast.predicted_share) == (1, plan.predicted.shares[0])
    assert (slow.slot_start_ns, fast.slot_start_ns) == (last, first)
    assert held.late == 1
    assert {held.mean.holds, held.max.holds, held.jitter.holds} == {None}, "the modes decide"
    assert [one["mode"] for one in prediction_json(held)["bands"]] == ["slow", "fast"]
    with io.StringIO() as text:
        Console(file=text, width=120).print(prediction_table(held))
        assert "fast, 1 late" in text.getvalue()


def test_three_bands_live(tmp_path: Path, unshaped: Recording) -> None:
    pytest.importorskip("numba")
    plan = plan_recording(
        unshaped, request=PlanRequest(bands=3, publish_slot_ns=100_000, epsilon_ns=3 * MS)
    )
    after = shape_application(small_chain(tmp_path), plan, tmp_path / "after", cycles=12)
    held = compare_recordings([unshaped, after]).measurements[1].held
    assert held is not None
    assert [(band.slot_start_ns, band.slot_end_ns) for band in held.bands] == [*publish_slots(plan)]
    undisturbed = measure_latency(after).analysis.undisturbed
    assert sum(band.count for band in held.bands) + held.late == undisturbed.count
    for band in held.bands:
        assert band.min_ns is None or band.min_ns >= band.slot_start_ns, "before its slot"


def test_the_plan_may_be_named_where_the_recording_does_not(
    unshaped: Recording, plan: Plan
) -> None:
    comparison = compare_recordings([unshaped, unshaped], plan=plan)
    first, second = comparison.measurements
    assert first.held is None
    assert second.held is not None
    assert second.held.mean.holds is False
