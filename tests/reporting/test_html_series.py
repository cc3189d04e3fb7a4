"""What charts leave out does not change what they show: extremes stay, counts are complete."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from hypothesis import given
from hypothesis import strategies as st
from known_run import LATENCY_NS, MS, PERIOD_NS, known_run

from chainshaper import data_flow, measure_latency
from chainshaper.reporting.page import latency_histogram, latency_points
from chainshaper.reporting.timeline import BARS, CYCLES, KINDS, timeline_data, timeline_of
from chainshaper.values.recording import Recording


def _traversals(latencies: Sequence[int | None], disturbed: Sequence[bool]) -> pl.DataFrame:
    return pl.DataFrame(
        {
            "traversal": range(len(latencies)),
            "start": [number * PERIOD_NS for number in range(len(latencies))],
            "latency_ns": latencies,
            "complete": [latency is not None for latency in latencies],
            "disturbed": disturbed,
        },
        schema={
            "traversal": pl.UInt32,
            "start": pl.Int64,
            "latency_ns": pl.Int64,
            "complete": pl.Boolean,
            "disturbed": pl.Boolean,
        },
    )


cycles = st.lists(
    st.tuples(st.one_of(st.none(), st.integers(0, 10**9)), st.booleans()), max_size=200
)


@given(cycles, st.integers(16, 64))
def test_points_keep_every_extreme_and_are_few(
    rows: list[tuple[int | None, bool]], limit: int
) -> None:
    frame = _traversals([one for one, _ in rows], [hit and one is not None for one, hit in rows])
    points = latency_points(frame, 0, limit)
    complete = frame.filter("complete")
    assert points["of"] == complete.height
    assert len(points["cycle"]) <= max(limit + 8, 0)
    if complete.height <= limit:
        assert points["cycle"] == complete["traversal"].to_list()
    drawn = frame[points["cycle"]] if points["cycle"] else frame.clear()
    assert points["latency"] == drawn["latency_ns"].to_list()
    assert points["time"] == drawn["start"].to_list() == sorted(points["time"])
    hit = [place for place, one in enumerate(drawn["disturbed"]) if one]
    assert points["disturbed"] == hit
    for kind in (True, False):
        every = complete.filter(pl.col("disturbed") == kind)["latency_ns"]
        shown = drawn.filter(pl.col("disturbed") == kind)["latency_ns"]
        assert (every.min(), every.max()) == (shown.min(), shown.max())
    assert set(points["incomplete"]) <= set(frame.filter(~pl.col("complete"))["start"])


@given(st.lists(st.integers(0, 10**9), max_size=100), st.integers(2, 50))
def test_a_histogram_counts_every_undisturbed_cycle_once_in_its_bin(
    latencies: list[int], bins: int
) -> None:
    frame = _traversals([*latencies, 5, None], [*(False for _ in latencies), True, False])
    found = latency_histogram(frame, bins)
    width = found["width"]
    assert str(width).strip("0") == "1", "a power of ten"
    expected: dict[int, int] = {}
    for latency in latencies:
        expected[latency // width] = expected.get(latency // width, 0) + 1
    assert dict(zip(found["bin"], found["count"], strict=True)) == expected
    assert max(found["bin"], default=0) - min(found["bin"], default=0) < bins


def test_a_hundred_thousand_cycles_fit_a_page() -> None:
    rng = np.random.default_rng(1)
    latencies = rng.integers(30 * MS, 90 * MS, 100_000).tolist()
    frame = _traversals(latencies, (rng.random(100_000) < 0.01).tolist())
    points, histogram = latency_points(frame, 0), latency_histogram(frame)
    assert len(points["cycle"]) <= 4_100
    assert {min(latencies), max(latencies)} <= set(points["latency"])
    assert len(str(points)) + len(str(histogram)) < 400_000
    # The middle is where most cycles are, and where most of them are drawn.
    middle = [50 * MS < latency < 70 * MS for latency in points["latency"]]
    assert 0.1 < np.mean(middle) < 0.5


def _page_data(recording: Recording, asked: Sequence[int] = ()) -> dict[str, Any]:
    measured = measure_latency(recording)
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    timeline = timeline_of(recording, flow, measured.analysis, measured.plan)
    return timeline_data(measured, timeline, asked, MS)


def _bars(data: dict[str, Any], kind: str) -> list[tuple[Any, ...]]:
    """``row, start, length, cycle, text, used`` of the bars of one kind."""
    columns = [data[name] for name in BARS]
    return [
        (row, start, length, cycle, data["texts"][text], used)
        for row, start, length, what, cycle, text, used in zip(*columns, strict=True)
        if KINDS[what] == kind
    ]


def test_a_timeline_of_few_cycles_keeps_all_of_them(tmp_path: Path) -> None:
    data = _page_data(known_run(tmp_path / "known", 3, untaken=(1,)))
    assert [cycle["n"] for cycle in data["cycles"]] == [0, 1, 2]
    one, broken, _ = data["cycles"]
    assert one["hops"] == [
        [1, None, 0, 4 * MS, 4 * MS + 1000],
        [2, 5 * MS - 1, 5 * MS, 15 * MS, 15 * MS + 1000],
        [3, 16 * MS - 1, 16 * MS, LATENCY_NS, LATENCY_NS + 1000],
    ]
    assert one["latency"] == LATENCY_NS
    held = (3, 16 * MS, LATENCY_NS - 16 * MS, 0, "cycle 0: held", None)
    assert _bars(data, "held")[0] == held
    names = [name for name, _ in data["rows"]]
    slot = _bars(data, "slot")[0]
    assert (names[slot[0]], *slot[1:4]) == ("server chain", 0, 30 * MS, 0)
    assert slot[4] == "server chain, cycle 0\n[0.000, 30.000) ms"
    assert broken["about"].startswith("incomplete: lost (/t1); began 0.100 s after the first")
    assert len(_bars(data, "callback")) == 3 * 4 - 3
    stall = (names.index("stalls of core 1"), PERIOD_NS + 6 * MS, 2 * MS, -1)
    assert _bars(data, "stall") == [(*stall, "the machine stalled", None)]


def test_a_timeline_of_many_cycles_keeps_those_that_somebody_looks_for(tmp_path: Path) -> None:
    recording = known_run(tmp_path / "known", 900, untaken=(511,), overran=(333,))
    data = _page_data(recording, asked=(777,))
    kept = {cycle["n"] for cycle in data["cycles"]}
    assert len(kept) <= CYCLES + 1
    assert {333, 511, 777} <= kept, "the longest, the one that broke, the one that was asked for"
    assert data["of"] == 900
    assert data["chosen"] == {"longest": 333, "median": 450, "shortest": 0}
    starts = [start for _, start, *_ in _bars(data, "callback")]
    inside = [not any(low < start < high for low, high in data["gaps"]) for start in starts]
    assert np.mean(inside) > 0.95, "callbacks of the other cycles are left out"
