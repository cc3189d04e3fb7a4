"""Loops: threads that sleep, wake up and publish outside callbacks, in tables written by hand."""

from typing import Any

import polars as pl
import pytest
from story import Callback, Publisher, Story

from chainshaper.analysis import analyse_latency, callback_statistics, data_flow, graph_of
from chainshaper.analysis.loops import thread_turns
from chainshaper.values.event_declarations import SLEEPING_CALLS

NANOSLEEP, RMW_WAIT = (SLEEPING_CALLS.index(name) for name in ("clock_nanosleep", "rmw_wait"))
PID, LOOP = 20, 22


def turn(
    story: Story,
    woke: int,
    sleeps: int,
    until: int,
    *,
    tid: int = LOOP,
    pid: int = PID,
    call: int = NANOSLEEP,
    writes: tuple[tuple[Publisher, int], ...] = (),
) -> None:
    """What lies between two sleeps; the thread uses 60 % of the time between them."""
    used = woke * 10
    story.event("thread_wake", woke, pid, tid, call=call, thread_time=used)
    for publisher, time in writes:
        story.publish(publisher, time, tid)
    later = {"until": until, "call": call, "thread_time": used + (sleeps - woke) * 6 // 10}
    story.event("thread_sleep", sleeps, pid, tid, **later)


def first_sleep(story: Story, time: int, until: int, tid: int = LOOP, pid: int = PID) -> None:
    story.event("thread_sleep", time, pid, tid, until=until, call=NANOSLEEP)


def loop_behind(
    inputs: tuple[int, ...], wakes: tuple[int, ...], *, publishes: int = 30
) -> tuple[Story, Callback]:
    """/sensor sends /a at these times; a loop of /actor stores it and publishes /cmd.

    The subscription runs 10 behind the sending, on another thread than the loop. A turn lasts 50,
    publishes 30 after its beginning, and was due 1 before it.
    """
    story = Story()
    timer, sensor = story.source("/sensor", 10, "/a")
    node = story.node("/actor", PID)
    reader, cmd = story.subscription(node, "/a"), story.publisher(node, "/cmd")
    for at in inputs:
        story.runs(timer, at, at + 2, writes=((sensor, at + 1),))
        story.runs(reader, at + 10, at + 12, reads=at + 1, tid=21)
    first_sleep(story, wakes[0] - 60, wakes[0] - 1)
    for woke, following in zip(wakes, (*wakes[1:], wakes[-1] + 100), strict=True):
        turn(story, woke, woke + 50, following - 1, writes=((cmd, woke + publishes),))
    return story, reader


def latencies(story: Story, chain: str) -> list[tuple[int, int]]:
    frame = analyse_latency(data_flow(story.tables()), chain).traversals.filter("complete")
    return frame.select("start", "end").rows()


def row(story: Story, node: str = "/actor", kind: str = "loop") -> dict[str, Any]:
    statistics = callback_statistics(data_flow(story.tables()))
    (only,) = statistics.filter(node=node, kind=kind).to_dicts()
    return only


def test_a_turn_is_what_lies_between_two_sleeps() -> None:
    story, _ = loop_behind((0,), (100, 200, 300))
    turns = thread_turns(story.tables())
    assert turns.select("start", "end", "due", "left_ns", "execution_ns").rows() == [
        (100, 150, 99, 49, 30),
        (200, 250, 199, 49, 30),
        (300, 350, 299, 49, 30),
    ]


def test_a_turn_whose_sleep_was_lost_has_no_end() -> None:
    story = Story()
    first_sleep(story, 40, 99)
    story.event("thread_wake", 100, PID, LOOP, call=NANOSLEEP)
    story.event("thread_wake", 200, PID, LOOP, call=NANOSLEEP)
    assert thread_turns(story.tables()).select("start", "end", "due").rows() == [
        (100, None, 99),
        (200, None, None),
    ]


def test_a_loop_is_shown_like_a_timer() -> None:
    story, _ = loop_behind((0, 200), (100, 200, 300, 400))
    loop = row(story)
    assert (loop["period_ns"], loop["count"], loop["tids"]) == (100, 4, [LOOP])
    assert loop["response_ns"] == {"min": 50, "mean": 50, "max": 50}
    assert loop["execution_ns"] == {"min": 30, "mean": 30, "max": 30}
    # Each turn begins 1 behind its time, 100 ns apart from 100 on.
    assert (loop["phase_ns"], loop["start_jitter_ns"], loop["overruns"]) == (0, 0, 0)
    (callback,) = (c for c in graph_of(data_flow(story.tables())).callbacks if c.kind == "loop")
    assert (callback.publishes, callback.label) == (("/cmd",), "/actor loop every 100ns")


def test_what_was_stored_last_before_a_turn_is_what_it_used_and_repeats_are_no_cycles() -> None:
    """Two turns for each message: the first use is the reaction."""
    story, _ = loop_behind((0, 200, 400), (100, 200, 300, 400, 500, 600))
    assert latencies(story, "/a../cmd") == [(0, 130), (200, 330), (400, 530)]


def test_a_message_that_comes_while_a_turn_computes_goes_into_the_next() -> None:
    """It is stored at 110, before the turn publishes at 130."""
    story, _ = loop_behind((100,), (100, 200))
    assert latencies(story, "/a../cmd") == [(100, 230)]


def test_of_two_messages_before_a_turn_the_newer_one_is_used() -> None:
    story, _ = loop_behind((0, 20), (100, 200))
    analysis = analyse_latency(data_flow(story.tables()), "/a../cmd")
    assert analysis.traversals["latency_ns"].to_list() == [None, 110]
    assert analysis.incomplete == {"not used": 1}


@pytest.mark.parametrize("publishes", [15, 30])
def test_a_loop_that_takes_its_messages_itself_uses_them_in_the_same_turn(publishes: int) -> None:
    """spin_some, then the publication: the message comes before it."""
    story = Story()
    timer, sensor = story.source("/sensor", 10, "/a")
    node = story.node("/actor", PID)
    reader, cmd = story.subscription(node, "/a"), story.publisher(node, "/cmd")
    first_sleep(story, 40, 99)
    for woke in (100, 200, 300):
        story.runs(timer, woke - 50, woke - 48, writes=((sensor, woke - 49),))
        turn(story, woke, woke + 50, woke + 99, writes=((cmd, woke + publishes),))
        story.runs(reader, woke + 5, woke + 9, reads=woke - 49, tid=LOOP)
    expected = [(w - 50, w + publishes) for w in (100, 200, 300)]
    assert latencies(story, "/a../cmd") == expected


def test_what_a_loop_takes_behind_its_publication_goes_into_the_next_turn() -> None:
    story = Story()
    timer, sensor = story.source("/sensor", 10, "/a")
    node = story.node("/actor", PID)
    reader, cmd = story.subscription(node, "/a"), story.publisher(node, "/cmd")
    first_sleep(story, 40, 99)
    for woke in (100, 200):
        turn(story, woke, woke + 50, woke + 99, writes=((cmd, woke + 5),))
    story.runs(timer, 50, 52, writes=((sensor, 51),))
    story.runs(reader, 120, 125, reads=51, tid=LOOP)
    assert latencies(story, "/a../cmd") == [(50, 205)]


def python_loop(*, sleeps: bool) -> Story:
    """`while: spin_once(timeout); publish`, twice as fast as its input: /a comes in every 2nd turn.

    Python has no events of callbacks. The message is taken 2 after the turn's beginning.
    """
    story = Story()
    timer, sensor = story.source("/sensor", 10, "/a")
    node = story.node("/actor", PID)
    reader = story.subscription(node, "/a", callbackless=True)
    cmd = story.publisher(node, "/cmd")
    if sleeps:
        first_sleep(story, 40, 99)
    for number, woke in enumerate(range(100, 900, 100)):
        if number % 2 == 0:
            story.runs(timer, woke - 50, woke - 48, writes=((sensor, woke - 49),))
            story.take(reader, woke + 2, woke - 49, LOOP)
        if sleeps:
            turn(story, woke, woke + 50, woke + 99, call=RMW_WAIT)
        story.publish(cmd, woke + 10, LOOP)
    return story


@pytest.mark.parametrize("sleeps", [True, False], ids=["sleeps recorded", "without sleeps"])
def test_a_python_loop_that_is_faster_than_its_input_has_a_cycle_for_each_message(
    sleeps: bool,
) -> None:
    expected = [(woke - 50, woke + 10) for woke in range(100, 900, 200)]
    assert latencies(python_loop(sleeps=sleeps), "/a../cmd") == expected


def named(story: Story, name: str, *, tid: int = PID, is_thread: int = 0) -> None:
    story.event("loop_named", 1, PID, tid, name=name, is_thread=is_thread)


def controller(*, is_thread: int = 0) -> Story:
    """/manager's thread publishes nothing; /controller stores /a. Two nodes of one process."""
    story = Story()
    timer, sensor = story.source("/sensor", 10, "/a")
    story.node("/manager", PID)
    reader = story.subscription(story.node("/controller", PID, time=5), "/a")
    named(story, "worker" if is_thread else "/manager", tid=LOOP, is_thread=is_thread)
    for at in (0, 200):
        story.runs(timer, at, at + 2, writes=((sensor, at + 1),))
        story.runs(reader, at + 10, at + 12, reads=at + 1, tid=21)
    first_sleep(story, 40, 99)
    for woke in (100, 200, 300, 400):
        turn(story, woke, woke + 50, woke + 99)
    return story


@pytest.mark.parametrize("is_thread", [0, 1], ids=["by node", "by thread"])
def test_a_named_loop_that_publishes_nothing_ends_a_chain_with_the_end_of_its_turn(
    is_thread: int,
) -> None:
    """Across the nodes of its process."""
    story = controller(is_thread=is_thread)
    assert latencies(story, "/a../manager:end") == [(0, 150), (200, 350)]
    assert row(story, "/manager")["count"] == 4


def test_a_loop_that_is_not_named_reads_nothing_of_other_nodes() -> None:
    story, _ = loop_behind((0,), (100, 200))
    other = story.subscription(story.node("/monitor", PID), "/a")
    graph = graph_of(data_flow(story.tables()))
    (monitor,) = (c for c in graph.callbacks if c.handle == other.handle)
    assert monitor.publishes == ()


def test_a_thread_that_sleeps_irregularly_has_no_period_and_its_spread_is_said() -> None:
    story, _ = loop_behind((0,), (100, 200, 330, 700, 760, 1000, 1900))
    assert row(story)["period_ns"] is None
    (note,) = (n for n in data_flow(story.tables()).notes if "irregularly" in n)
    assert "usually" in note and "(p95)" in note and "nothing is to be planned" in note


def test_a_loop_that_is_woken_before_its_time_is_paced_by_data() -> None:
    story = Story()
    node = story.node("/driver", PID)
    out = story.publisher(node, "/points")
    first_sleep(story, 40, 1000)
    for woke in range(100, 600, 100):  # it would have slept until 900 later
        turn(story, woke, woke + 50, woke + 1000, writes=((out, woke + 10),))
    flow = data_flow(story.tables())
    assert flow.objects.callbacks["kind"].to_list() == ["unknown"]
    (note,) = (n for n in flow.notes if "paced by data" in n)
    assert "/driver publishes /points" in note and str(LOOP) in note


def test_two_loops_of_one_thread_are_told_apart_by_what_they_publish() -> None:
    story = Story()
    node = story.node("/actor", PID)
    fast, slow = story.publisher(node, "/fast"), story.publisher(node, "/slow")
    first_sleep(story, 40, 99)
    for place, woke in enumerate(range(100, 900, 100)):
        wrote = slow if place % 4 == 3 else fast
        turn(story, woke, woke + 50, woke + 99, writes=((wrote, woke + 10),))
    flow = data_flow(story.tables())
    counts = callback_statistics(flow).filter(kind="loop")["count"].to_list()
    assert sorted(counts) == [2, 6]
    assert any(f"thread {LOOP} of /actor has 2 loops" in note for note in flow.notes)


def test_a_turn_behind_which_no_time_is_left_to_sleep_overran() -> None:
    story = Story()
    node = story.node("/actor", PID)
    out = story.publisher(node, "/cmd")
    first_sleep(story, 40, 99)
    turn(story, 100, 150, 199, writes=((out, 110),))
    turn(story, 200, 320, 299, writes=((out, 210),))  # it should have begun again at 299
    turn(story, 321, 350, 399, writes=((out, 330),))
    turn(story, 400, 450, 499, writes=((out, 410),))
    assert data_flow(story.tables()).turns.select("due", "overran").rows() == [
        (99, False),
        (199, True),
        (299, False),
        (399, False),
    ]


def in_cpp(story: Story, node: Any) -> None:
    """Give a node a service with a callback, as rclcpp gives each node some."""
    story.service(node, "/actor/get_parameters")


def test_without_events_of_sleeps_a_thread_that_publishes_regularly_is_a_loop() -> None:
    """Its instances are known by their publications alone."""
    story, _ = loop_behind((0, 200, 400), tuple(range(100, 1300, 100)))
    in_cpp(story, story.node("/actor", PID))
    del story.rows["thread_sleep"], story.rows["thread_wake"]
    loop = row(story)
    assert (loop["period_ns"], loop["count"], loop["response_ns"]) == (100, 12, None)
    # The message of 200 is stored at 210; it goes into the publication of 230, not of 330.
    assert latencies(story, "/a../cmd") == [(0, 130), (200, 230), (400, 430)]
    assert any("No event shows its sleep" in note for note in data_flow(story.tables()).notes)


def test_without_sleeps_a_thread_that_publishes_irregularly_is_no_loop() -> None:
    story, _ = loop_behind((0,), (100, 110, 190, 300, 305, 400, 620, 700, 1100, 1110, 1300))
    in_cpp(story, story.node("/actor", PID))
    del story.rows["thread_sleep"], story.rows["thread_wake"]
    kinds = data_flow(story.tables()).objects.callbacks.filter(pl.col("handle") == 0)["kind"]
    assert kinds.to_list() == ["unknown"]
