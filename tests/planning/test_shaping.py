"""Single-band shaping and its prediction, against answers worked out by hand."""

import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chainshaper.planning import (
    Plan,
    Thread,
    band_predictions,
    plan_json,
    plan_shaping,
    plan_warnings,
    publish_slots,
    server_per_chain,
    with_bands,
)
from chainshaper.planning.bands import predict_bands
from chainshaper.values.errors import InputError, OperationError

MS = 1_000_000


def test_the_papers_synthetic_chain() -> None:
    # Section 5.2: the longest latency is 58.5 ms; with ε = 0.5 ms the slots are the paper's.
    latencies = np.array([25_500_000, 58_500_000, 40_000_000])
    plan = plan_shaping(
        latencies,
        100 * MS,
        spec="/t1../t5",
        output="/ns/t5",
        publisher="/node5",
        nodes=["/node1", "/node5"],
        epsilon_ns=MS // 2,
    )
    chain, output = plan.servers
    assert chain.slots == ((0, 59 * MS),)
    assert chain.threads == (Thread(node="/node1"), Thread(node="/node5"))
    assert output.slots == publish_slots(plan) == ((59 * MS, 60 * MS),)
    assert (output.core, output.priority, chain.core, chain.priority) == (1, 1, 1, 2)
    assert plan.shaping_node is not None
    assert plan.shaping_node.name == "chainshaper_ns_t5"
    assert plan.shaping_node.input == "/ns/t5_tmp"
    assert output.threads == (plan.shaping_node.thread,)
    assert plan.evidence.mean_latency_ns == 41_333_333
    assert plan.predicted.mean_ns == plan.predicted.max_ns == 60 * MS
    assert plan.predicted.jitter_ns == MS
    assert plan.predicted.shares == (1.0,)


def test_asynchronous_publication_gates_the_publishers_thread() -> None:
    plan = _plan(publication="asynchronous", output="/t5", publisher="/node5", nodes=["/node5"])
    assert plan.shaping_node is None
    assert plan.servers[1].threads == (Thread(node="/node5", role="publisher"),)
    assert publish_slots(plan) == ((61 * MS, 62 * MS),)
    with pytest.raises(InputError, match="name the node"):
        _plan(publication="asynchronous", output="/t5")
    assert _plan(publication="asynchronous") == _plan()  # eq. 2 and eq. 4: the same slots


def test_bare_latencies_make_a_plan_to_study() -> None:
    plan = _plan()
    assert plan.shaping_node is None
    assert publish_slots(plan) == ((61 * MS, 62 * MS),)


def test_the_last_nanosecond_fits_and_the_next_does_not() -> None:
    assert publish_slots(_plan(period_ns=62 * MS)) == ((61 * MS, 62 * MS),)
    with pytest.raises(OperationError, match=r"cycle of 61\.999999ms: 1ns too long") as caught:
        _plan(period_ns=62 * MS - 1)
    assert "a margin of 999.999us, or a publish slot of 999.999us" in str(caught.value)
    assert "pipeline" not in str(caught.value)
    with pytest.raises(OperationError, match=r"12ms too long.*pipeline over several cores"):
        _plan(period_ns=50 * MS)


@pytest.mark.parametrize("wrong", [{"epsilon_ns": -1}, {"publish_slot_ns": 0}, {"period_ns": 0}])
def test_impossible_durations_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(InputError, match="longer than 0ms"):
        _plan(**wrong)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"output": "t5"}, "output: 't5' is not a full ROS 2 name"),
        ({"output": "/t5", "fifo_priority": 99}, "fifo_priority: 99 should be less than"),
        ({"nodes": ["/a", "/a"]}, r"servers\[0\]\.threads\[1\]: .* already"),
    ],
)
def test_values_no_plan_may_have_are_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        _plan(**wrong)


def test_prediction_of_the_papers_three_bands() -> None:
    # Slots [62, 63], [77, 78], [86, 87]: the paper states a jitter of 25 ms.
    latencies = np.array([40, 63, 64, 78, 79, 79, 80, 86]) * MS
    predicted = predict_bands(latencies, [63 * MS, 78 * MS, 87 * MS], MS)
    assert predicted.jitter_ns == 25 * MS
    assert predicted.max_ns == 87 * MS
    assert predicted.shares == (0.25, 0.25, 0.5)
    assert predicted.mean_ns == (2 * 63 + 2 * 78 + 4 * 87) * MS // 8


def test_each_band_has_a_share_and_a_jitter() -> None:
    latencies = np.array([40, 63, 64, 78, 79, 79, 80, 84]) * MS
    plan = with_bands(plan_shaping(latencies, 100 * MS), latencies, 3, grid_ns=MS)
    bands = band_predictions(plan)
    assert [(band.start_ns, band.end_ns) for band in bands] == list(publish_slots(plan))
    assert tuple(band.share for band in bands) == plan.predicted.shares
    assert [band.jitter_ns for band in bands] == [MS] * 3
    assert plan_json(plan)["predicted_bands"][2] == {
        **{"start_ns": 85 * MS, "end_ns": 86 * MS, "share": bands[2].share, "jitter_ns": MS}
    }
    assert band_predictions(server_per_chain(plan)) == ()


@pytest.mark.parametrize("ends", [[], [5, 5], [7, 5], [5, 9]])
def test_prediction_refuses_slots_that_leave_latencies_out(ends: list[int]) -> None:
    with pytest.raises(InputError):
        predict_bands(np.array([3, 10]), ends, 1)


@settings(deadline=None)
@given(
    st.lists(st.integers(0, 10**8), min_size=1, max_size=50),
    st.lists(st.integers(1, 10**8), max_size=5),
)
def test_prediction_is_what_publishing_one_by_one_gives(sample: list[int], cuts: list[int]) -> None:
    ends = sorted({*cuts, 10**8 + 1})
    published = [min(end for end in ends if latency <= end) for latency in sample]
    predicted = predict_bands(np.array(sample), ends, 1)
    assert predicted.mean_ns == round(sum(published) / len(published))
    assert predicted.shares == tuple(published.count(end) / len(published) for end in ends)
    assert predicted.max_ns == ends[-1]


def test_a_sound_plan_has_no_warnings() -> None:
    assert plan_warnings(_plan(samples=299, realtime=True)) == []


@pytest.mark.parametrize(
    ("doubtful", "words"),
    [
        ({"samples": 298}, "sample is small: 298 cycles .* Record 299 cycles"),
        ({"realtime": False}, "without real-time scheduling"),
        (
            {"disturbed": 3, "longest_stall_ns": 8 * MS},
            r"disturbed 3 of 103 cycles, longest stall 8.000 ms",
        ),
        ({"incomplete": 2}, "2 executions"),
        ({"period_ns": 63 * MS}, "fills 98.4% of the cycle 63ms"),
        ({"period_ns": 63 * MS}, "throttles"),
        ({"utilisation": 0.97}, "takes 97.0% of its core"),
    ],
)
def test_doubts_are_said(doubtful: dict[str, Any], words: str) -> None:
    assert any(re.search(words, warning) for warning in plan_warnings(_plan(**doubtful)))


def _plan(samples: int = 100, period_ns: int = 100 * MS, **options: Any) -> Plan:
    latencies = np.linspace(30 * MS, 60 * MS, samples).astype(np.int64)
    return plan_shaping(latencies, period_ns, **options)
