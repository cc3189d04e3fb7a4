"""Callback instances: pairing starts with ends, and CPU time."""

from collections.abc import Iterator

import polars as pl
from hypothesis import given, settings
from hypothesis import strategies as st
from story import Callback, Story

from chainshaper.analysis import callback_instances, data_flow, resolve_objects
from chainshaper.analysis.flow import cpu_time


def instances(story: Story) -> pl.DataFrame:
    tables = story.tables()
    return callback_instances(tables, resolve_objects(tables).callbacks)


def pairs(story: Story) -> list[tuple[int, int, int | None]]:
    return list(instances(story).select("tid", "start", "end").iter_rows())


def one_timer(story: Story, pid: int = 1) -> Callback:
    return story.timer(story.node(f"/node{pid}", pid))


def test_overlapping_instances_of_processes_and_threads() -> None:
    # Three threads run the same handle at the same time: two of process 1, one of process 2.
    story = Story()
    first = one_timer(story, 1)
    other = story.timer(story.node("/b", pid=2), handle=first.handle)
    story.start(first, 10, tid=11)
    story.start(other, 11)
    story.start(first, 12, tid=12)
    story.end(first, 20, tid=12)
    story.end(first, 30, tid=11)
    story.end(other, 40)
    assert pairs(story) == [(11, 10, 30), (2, 11, 40), (12, 12, 20)]


def test_lost_end_and_unfinished_and_lost_start() -> None:
    # 5: an end whose start was before the recording; 10: its end was lost; 50: still running.
    story = Story()
    timer = one_timer(story)
    story.end(timer, 5)
    story.start(timer, 10)
    story.start(timer, 30)
    story.end(timer, 40)
    story.start(timer, 50)
    assert pairs(story) == [(1, 10, None), (1, 30, 40), (1, 50, None)]


def test_back_to_back_instances_share_an_instant() -> None:
    # As a saturated simulation has them: every end is the next start.
    story = Story()
    timer = one_timer(story)
    for start in (0, 10, 20):
        story.runs(timer, start, start + 10)
    assert pairs(story) == [(1, 0, 10), (1, 10, 20), (1, 20, 30)]


def test_instances_that_take_no_time() -> None:
    story = Story()
    timer = one_timer(story)
    for start in (10, 20):
        story.runs(timer, start, start)
    assert pairs(story) == [(1, 10, 10), (1, 20, 20)]


def test_nested_callbacks_are_paired_by_their_own_handle() -> None:
    story = Story()
    node = story.node("/a", pid=1)
    outer, inner = story.timer(node), story.timer(node, period=5)
    story.start(outer, 10)
    story.runs(inner, 20, 30)
    story.end(outer, 40)
    assert pairs(story) == [(1, 10, 40), (1, 20, 30)]


def test_execution_time_from_thread_time() -> None:
    # 30 ns passed, of which the thread ran 12.
    story = Story()
    timer = one_timer(story)
    callback = timer.handle
    story.event("callback_start", 10, 1, callback=callback, is_intra_process=0, thread_time=100)
    story.event("callback_end", 40, 1, callback=callback, thread_time=112)
    assert instances(story)["execution_ns"].to_list() == [12]


def switch(story: Story, time: int, prev: int, following: int, cpu: int = 0) -> None:
    story.event(
        "sched_switch",
        time,
        0,
        prev_comm="",
        prev_tid=prev,
        prev_prio=0,
        prev_state=0,
        next_comm="",
        next_tid=following,
        next_prio=0,
    )


def test_execution_time_from_sched_switch() -> None:
    # Thread 1 runs [5, 20), is pre-empted by 99 until 32, runs on to 50. The instance lasts
    # from 10 to 40: 10 before the pre-emption, 8 after it.
    story = Story()
    timer = one_timer(story)
    switch(story, 5, 0, 1)
    switch(story, 20, 1, 99)
    switch(story, 32, 99, 1)
    switch(story, 50, 1, 0)
    story.runs(timer, 10, 40)
    assert instances(story)["execution_ns"].to_list() == [18]


def test_a_thread_that_ran_since_before_the_recording() -> None:
    # sched_switch begins at 0; thread 1 is switched out at 20: it has run until then.
    story = Story()
    timer = one_timer(story)
    switch(story, 0, 98, 99, cpu=1)
    switch(story, 20, 1, 0)
    switch(story, 30, 0, 1)
    story.runs(timer, 10, 40)
    assert instances(story)["execution_ns"].to_list() == [20]


def test_execution_time_unknown_without_an_end_or_switches() -> None:
    story = Story()
    timer = one_timer(story)
    story.runs(timer, 10, 40)
    story.start(timer, 50)
    assert instances(story)["execution_ns"].to_list() == [None, None]
    switch(story, 0, 0, 77)
    assert instances(story)["execution_ns"].to_list() == [None, None]
    assert "execution times cannot be known" in data_flow(story.tables()).notes[0]


KEY = st.tuples(st.integers(1, 2), st.integers(1, 2), st.integers(0, 1))
EVENTS = st.lists(st.tuples(KEY, st.booleans()), max_size=60)


def paired_by_hand(
    happenings: list[tuple[tuple[int, int, int], bool]],
) -> Iterator[tuple[int, ...]]:
    """Start → end of the same key if the next event of that key is an end."""
    for index, (key, is_start) in enumerate(happenings):
        if is_start:
            following = next(
                ((i, s) for i, (k, s) in enumerate(happenings[index + 1 :], index + 1) if k == key),
                None,
            )
            end = -1 if following is None or following[1] else following[0]
            yield (*key[:2], index, end)


@settings(max_examples=40, deadline=None)
@given(EVENTS)
def test_pairing_agrees_with_the_obvious_loop(
    happenings: list[tuple[tuple[int, int, int], bool]],
) -> None:
    story = Story()
    timers = {}
    for pid in (1, 2):
        node = story.node(f"/n{pid}", pid, time=-1)
        for which in (0, 1):
            timers[pid, which] = story.timer(node, period=which + 1, time=-1, handle=0x10 + which)
    for time, ((pid, tid, which), is_start) in enumerate(happenings):
        (story.start if is_start else story.end)(timers[pid, which], time, tid)
    found = [
        (pid, tid, start, -1 if end is None else end)
        for pid, tid, start, end in instances(story)
        .select("pid", "tid", "start", "end")
        .iter_rows()
    ]
    assert found == list(paired_by_hand(happenings))


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
    for time in range(1, len(running)):
        if running[time] != running[time - 1]:
            switch(story, time, running[time - 1], running[time])
    frame = pl.DataFrame(
        {
            "tid": [tid for tid in (1, 2, 3) for _ in spans],
            "start": [min(span) for span in spans] * 3,
            "end": [max(span) for span in spans] * 3,
        },
        schema={"tid": pl.Int32, "start": pl.Int64, "end": pl.Int64},
    )
    extended = running + [running[-1]] * 41  # nobody switched afterwards
    for (tid, start, end), used in zip(
        frame.iter_rows(), cpu_time(story.tables(), frame), strict=True
    ):
        if used is not None:
            assert used == sum(thread == tid for thread in extended[start:end])
        else:  # the thread had not run by the time the span began
            assert tid not in running[: start + 1]
