"""The rows that timelines draw, in a run whose every instant is known by hand."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from known_run import LATENCY_NS, MS, PERIOD_NS, known_plan, known_run

from chainshaper import data_flow, measure_latency
from chainshaper.planning import ChainPlan, Plan
from chainshaper.planning.chain_plan import revised
from chainshaper.reporting.timeline import BARS, CYCLES, KINDS, Timeline, timeline_data, timeline_of
from chainshaper.values.recording import Recording


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return known_run(tmp_path_factory.mktemp("timeline") / "known", cycles=2)


def _timeline(recording: Recording, plan: ChainPlan | None = None) -> Timeline:
    measured = measure_latency(recording, plan=Plan.of(plan) if plan else None)
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    return timeline_of(recording, flow, measured.analysis, measured.plan)


def _with(recording: Recording, **tables: pl.DataFrame | None) -> Recording:
    """The recording with other tables, or without them."""
    changed = {name: recording.events[name] for name in recording.events} | tables
    left = {name: table for name, table in changed.items() if table is not None}
    return Recording(recording.path, recording.info, left)


def test_threads_slots_and_stalls(known: Recording) -> None:
    timeline = _timeline(known)
    gate = f"/{known_plan().shaping_node.name}"  # type: ignore[union-attr]
    assert timeline.threads["nodes"].to_list() == ["/first", "/second", gate, "/actuator"]
    about = timeline.threads["about"].to_list()
    assert about == [None, "SCHED_FIFO 80, core 1", None, None]
    assert timeline.origins.rows() == [(0, MS, False), (1, PERIOD_NS + MS, False)]
    assert timeline.slots.select("traversal", "server", "start", "end").rows() == [
        (0, "chain", MS, 31 * MS),
        (0, "output", 31 * MS, 32 * MS),
        (1, "chain", PERIOD_NS + MS, PERIOD_NS + 31 * MS),
        (1, "output", PERIOD_NS + 31 * MS, PERIOD_NS + 32 * MS),
    ]
    assert timeline.stalls.rows() == [(1, PERIOD_NS + 7 * MS, PERIOD_NS + 9 * MS)]


def test_what_the_gate_held_lies_between_arrival_and_release(tmp_path: Path) -> None:
    held = _timeline(known_run(tmp_path / "known", cycles=2, overran=(1,))).holds
    rows = held.select("traversal", "arrival", "let_go", "slot", "overrun").rows()
    late = PERIOD_NS + MS + 31 * MS
    assert rows == [(0, 17 * MS, 31 * MS + 20_000, 0, None), (1, late, late, None, "publish")]


def test_a_cycle_whose_output_never_reached_the_gate_counts_from_its_stamp(tmp_path: Path) -> None:
    origins = _timeline(known_run(tmp_path / "known", untaken=(1,))).origins
    assert origins["origin"].to_list() == [MS, PERIOD_NS + MS, 2 * PERIOD_NS + MS]
    assert origins["assumed"].to_list() == [False, True, False]


def test_cycles_that_no_event_dates_are_assumed_to_start_a_wake_up_before_the_chain(
    tmp_path: Path,
) -> None:
    silent = _with(known_run(tmp_path / "known", plan=None), gate_release=None)
    timeline = _timeline(silent, revised(known_plan(), anchor="cycle"))
    assert timeline.origins["assumed"].all()
    starts = np.array([0, 1, 2]) * PERIOD_NS + MS
    (before,) = set(starts - timeline.origins["origin"].to_numpy())
    assert 0 < before < MS
    without = _timeline(silent)
    assert without.slots.height == without.origins.height == 0, "without a plan"


def test_a_callback_whose_end_was_lost_is_drawn_until_the_next_of_its_thread(
    known: Recording,
) -> None:
    ends = known.events["callback_end"]
    first_of_second = ends.filter(ends["pid"] == 2)["time"][0]
    lossy = _with(known, callback_end=ends.filter(ends["time"] != first_of_second))
    (cut,) = _timeline(lossy).slices.filter(~pl.col("ended")).rows(named=True)
    assert (cut["pid"], cut["start"], cut["end"]) == (2, 6 * MS, PERIOD_NS + 6 * MS)


def _page_data(recording: Recording, asked: Sequence[int] = ()) -> dict[str, Any]:
    return timeline_data(measure_latency(recording), _timeline(recording), asked, MS)


def _bars(data: dict[str, Any], kind: str) -> list[tuple[Any, ...]]:
    """``row, start, length, cycle, text, used`` of the bars of one kind."""
    return [
        (row, start, length, cycle, data["texts"][text], used)
        for row, start, length, what, cycle, text, used in zip(
            *(data[name] for name in BARS), strict=True
        )
        if KINDS[what] == kind
    ]


def test_a_page_has_all_of_few_cycles(tmp_path: Path) -> None:
    data = _page_data(known_run(tmp_path / "known", 3, untaken=(1,)))
    assert [cycle["n"] for cycle in data["cycles"]] == [0, 1, 2]
    one, broken, _ = data["cycles"]
    assert one["hops"] == [
        [1, None, 0, 4 * MS, 4 * MS + 1000],
        [2, 5 * MS - 1, 5 * MS, 15 * MS, 15 * MS + 1000],
        [3, 16 * MS - 1, 16 * MS, LATENCY_NS, LATENCY_NS + 1000],
    ]
    assert one["latency"] == LATENCY_NS
    gated = (3, 16 * MS, LATENCY_NS - 16 * MS, 0, "cycle 0: in the gate", None)
    assert _bars(data, "gated")[0] == gated
    names = [name for name, _ in data["rows"]]
    slot = _bars(data, "slot")[0]
    assert (names[slot[0]], *slot[1:4]) == ("server chain", 0, 30 * MS, 0)
    assert slot[4] == "server chain, cycle 0\n[0.000, 30.000) ms"
    assert broken["about"].startswith("incomplete: lost (/t1); began 0.100 s after the first")
    assert len(_bars(data, "callback")) == 3 * 4 - 3
    stall = (names.index("stalls of core 1"), PERIOD_NS + 6 * MS, 2 * MS, -1)
    assert _bars(data, "stall") == [(*stall, "the machine stalled", None)]


def test_a_page_has_of_many_cycles_those_that_a_reader_looks_for(tmp_path: Path) -> None:
    recording = known_run(tmp_path / "known", 900, untaken=(511,), overran=(333,))
    data = _page_data(recording, asked=(777,))
    found = {cycle["n"] for cycle in data["cycles"]}
    assert len(found) <= CYCLES + 1
    assert {333, 511, 777} <= found, "the longest, the one that broke, the one that was asked for"
    assert data["of"] == 900
    assert data["chosen"] == {"longest": 333, "median": 450, "shortest": 0}
    starts = [start for _, start, *_ in _bars(data, "callback")]
    inside = [not any(low < start < high for low, high in data["gaps"]) for start in starts]
    assert np.mean(inside) > 0.95, "callbacks of the other cycles are left out"
    # What a flight recorder was asked for is shown first.
    begun = measure_latency(recording).analysis.traversals["start"]
    info = recording.info.model_copy(update={"worst_ns": (begun[778],)})
    data = _page_data(replace(recording, info=info))
    assert data["chosen"]["first"] == 778
    assert 778 in [cycle["n"] for cycle in data["cycles"]]
