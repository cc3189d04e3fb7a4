"""Statistics of latencies and of callbacks."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from story import Story

from chainshaper.analysis import callback_statistics, data_flow, latency_statistics


def test_a_sample_worked_out_by_hand() -> None:
    # 1 … 201 ms: the k-th percentile lies at 1 + 2k ms exactly.
    found = latency_statistics([ms * 1_000_000 for ms in range(1, 202)], [True] + [False] * 200)
    assert (found.count, found.disturbed, found.incomplete) == (201, 1, 0)
    assert (found.min_ns, found.mean_ns, found.max_ns) == (1_000_000, 101_000_000, 201_000_000)
    assert (found.jitter_ns, found.spread_ns) == (200_000_000, 198_000_000)
    places = {"0.5": 2, "1": 3, "5": 11, "25": 51, "50": 101}
    places |= {"75": 151, "95": 191, "99": 199, "99.5": 200}
    assert found.percentiles_ns == {name: ms * 1_000_000 for name, ms in places.items()}


def test_no_sample_has_no_statistics() -> None:
    found = latency_statistics([], incomplete=3)
    assert (found.count, found.incomplete) == (0, 3)
    assert (found.min_ns, found.mean_ns, found.jitter_ns, found.spread_ns) == (None,) * 4
    assert found.percentiles_ns == {}


@given(st.lists(st.integers(0, 10**12), min_size=1, max_size=50))
def test_figures_are_whole_and_in_order(sample: list[int]) -> None:
    found = latency_statistics(sample)
    values = [found.min_ns, *found.percentiles_ns.values(), found.max_ns]
    assert all(isinstance(value, int) for value in values)
    assert values == sorted(values)  # type: ignore[type-var]
    assert found.mean_ns == pytest.approx(sum(sample) / len(sample), abs=1)


def test_callbacks_with_response_times_and_threads() -> None:
    # Two instances of 10 and 20 ns on two threads, and one that was still running.
    story = Story()
    timer = story.timer(story.node("/a", pid=1), period=100)
    story.runs(timer, 10, 20, tid=5)
    story.runs(timer, 110, 130, tid=4)
    story.start(timer, 210, tid=4)
    (row,) = callback_statistics(data_flow(story.tables())).iter_rows(named=True)
    assert (row["node"], row["kind"], row["period_ns"]) == ("/a", "timer", 100)
    assert (row["count"], row["unfinished"], row["tids"]) == (3, 1, [4, 5])
    assert row["response_ns"] == {"min": 10, "mean": 15.0, "max": 20}
    assert row["execution_ns"] is None
