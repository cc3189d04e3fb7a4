"""Callback instances: pairing starts with ends, and CPU time."""

import itertools
from collections import Counter
from typing import Any

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from story import Callback, Story

from chainshaper.analysis import callback_instances, data_flow, resolve_objects
from chainshaper.analysis.flow import cpu_time
from chainshaper.analysis.matching import ends_of_starts


def instances(story: Story) -> pl.DataFrame:
    tables = story.tables()
    return callback_instances(tables, resolve_objects(tables).callbacks)


def pairs(story: Story) -> list[tuple[int, int, int | None]]:
    return list(instances(story).select("tid", "start", "end").iter_rows())


def one_timer(story: Story) -> Callback:
    return story.timer(story.node("/node1", 1))


def test_overlapping_instances_of_processes_and_threads() -> None:
    # Three threads run the same handle at the same time: two of process 1, one of process 2.
    story = Story()
    first = one_timer(story)
    other = story.timer(story.node("/b", pid=2), handle=first.handle)
    story.runs(first, 10, 30, tid=11)
    story.runs(other, 11, 40)
    story.runs(first, 12, 20, tid=12)
    assert pairs(story) == [(11, 10, 30), (2, 11, 40), (12, 12, 20)]


def test_behind_an_end_whose_start_was_not_recorded_instances_that_touch_are_told_apart() -> None:
    """One ends in the nanosecond in which the next one starts, as executors under load have it."""
    starts = pl.DataFrame({"pid": [1, 1], "tid": [1, 1], "callback": [7, 7], "time": [20, 30]})
    ends = pl.DataFrame(
        {"pid": [1, 1, 1], "tid": [1, 1, 1], "callback": [7, 7, 7], "time": [10, 30, 40]}
    )
    assert list(ends_of_starts(starts, ends)) == [1, 2]


Happenings = list[tuple[int, int, int]]


def by_definition(starts: Happenings, ends: Happenings) -> list[int]:
    """For every start the next event of its thread and callback, if that is an end."""
    result = [-1] * len(starts)
    for key in {event[:2] for event in (*starts, *ends)}:
        own = [(t, 0, i) for i, (*k, t) in enumerate(starts) if tuple(k) == key]
        own += [(t, 1, i) for i, (*k, t) in enumerate(ends) if tuple(k) == key]
        ordered: list[tuple[int, int, int]] = []
        for moment in sorted({t for t, _, _ in own}):
            now = [event for event in own if event[0] == moment]
            depth = 0
            for _, kind, _ in ordered:  # an end without a start is of an instance of before
                depth = depth + 1 if kind == 0 else max(0, depth - 1)
            first = 1 if depth > 0 else 0  # the end of what is open, or else a start
            ordered += sorted(now, key=lambda event, first=first: event[1] != first)  # type: ignore[misc]
        for (_, kind, row), (_, after, end) in itertools.pairwise(ordered):
            if (kind, after) == (0, 1):
                result[row] = end
    return result


def paired(starts: Happenings, ends: Happenings) -> list[int]:
    types = {"tid": pl.Int32, "callback": pl.UInt64, "time": pl.Int64}
    tables = (
        pl.DataFrame(rows, types, orient="row").with_columns(pid=pl.lit(7, pl.Int32))
        for rows in (starts, ends)
    )
    return list(ends_of_starts(*tables).cast(pl.Int64).fill_null(-1))


HAPPENINGS = st.lists(
    st.tuples(st.integers(0, 1), st.integers(0, 2), st.integers(0, 12)), max_size=40
).map(lambda rows: sorted(rows, key=lambda row: row[2]))


@settings(max_examples=150, deadline=None)
@given(HAPPENINGS, HAPPENINGS)
def test_pairing_agrees_with_its_definition(starts: Happenings, ends: Happenings) -> None:
    """Lost starts, lost ends, equal times: whatever a trace may hold."""
    assert paired(starts, ends) == by_definition(starts, ends)


def test_more_callbacks_than_the_table_was_made_for() -> None:
    starts, ends = ([(1, k, 2 * k + late) for k in range(5000)] for late in (0, 1))
    assert paired(starts, ends) == list(range(5000))


def test_execution_time_from_thread_time() -> None:
    # 30 ns passed, of which the thread ran 12.
    story = Story()
    callback = one_timer(story).handle
    story.event("callback_start", 10, 1, callback=callback, is_intra_process=0, thread_time=100)
    story.event("callback_end", 40, 1, callback=callback, thread_time=112)
    assert instances(story)["execution_ns"].to_list() == [12]


def switch(story: Story, time: int, prev: int, following: int) -> None:
    unused: dict[str, Any] = {"prev_comm": "", "prev_prio": 0, "prev_state": 0}
    unused |= {"next_comm": "", "next_prio": 0}
    story.event("sched_switch", time, 0, prev_tid=prev, next_tid=following, **unused)


@pytest.mark.parametrize(
    ("switches", "used"),
    [
        # Thread 1 runs [5, 20), is pre-empted by 99 until 32, runs on to 50. The instance lasts
        # from 10 to 40: 10 before the pre-emption, 8 after it.
        ([(5, 0, 1), (20, 1, 99), (32, 99, 1), (50, 1, 0)], 18),
        # sched_switch begins at 0; thread 1 is switched out at 20: it has run until then.
        ([(0, 98, 99), (20, 1, 0), (30, 0, 1)], 20),
    ],
)
def test_execution_time_from_sched_switch(switches: list[tuple[int, int, int]], used: int) -> None:
    story = Story()
    timer = one_timer(story)
    for one in switches:
        switch(story, *one)
    story.runs(timer, 10, 40)
    assert instances(story)["execution_ns"].to_list() == [used]


def test_execution_time_unknown_without_an_end_or_switches() -> None:
    story = Story()
    timer = one_timer(story)
    story.runs(timer, 10, 40)
    story.start(timer, 50)
    assert instances(story)["execution_ns"].to_list() == [None, None]
    switch(story, 0, 0, 77)
    assert instances(story)["execution_ns"].to_list() == [None, None]
    assert "execution times cannot be known" in data_flow(story.tables()).notes[0]


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.integers(0, 3), min_size=1, max_size=40),
    st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40)), min_size=1, max_size=10),
)
def test_cpu_time_agrees_with_counting_nanoseconds(
    running: list[int], spans: list[tuple[int, int]]
) -> None:
    # `running[t]` is the thread that has the core in [t, t + 1); 0 is the idle thread.
    story = Story()
    switch(story, 0, 0, running[0])
    for time, (before, after) in enumerate(itertools.pairwise(running), 1):
        if before != after:
            switch(story, time, before, after)
    rows = [(tid, min(span), max(span)) for tid in (1, 2, 3) for span in spans]
    types = {"tid": pl.Int32, "start": pl.Int64, "end": pl.Int64}
    found = cpu_time(story.tables(), pl.DataFrame(rows, types, orient="row"))
    extended = running + [running[-1]] * 41  # nothing switched afterwards
    for (tid, start, end), used in zip(rows, found, strict=True):
        if used is not None:
            assert used == Counter(extended[start:end])[tid]
        else:  # the thread had not run by the time the span began
            assert tid not in running[: start + 1]
