"""Loops: threads that sleep, wake up and publish outside callbacks, in tables written by hand."""

from typing import Any

import polars as pl
import pytest
from loop_story import LOOP, NANOSLEEP, PID, RMW_WAIT, first_sleep, loop_behind, turn
from story import Story

from chainshaper.analysis import analyse_latency, callback_statistics, data_flow, graph_of
from chainshaper.analysis.loops import thread_turns
from chainshaper.values.event_declarations import SLEEPING_CALLS


def latencies(story: Story, chain: str) -> list[tuple[int, int]]:
    frame = analyse_latency(data_flow(story.tables()), chain).traversals.filter("complete")
    return frame.select("start", "end").rows()


def row(story: Story, node: str = "/actor", kind: str = "loop") -> dict[str, Any]:
    statistics = callback_statistics(data_flow(story.tables()))
    (only,) = statistics.filter(node=node, kind=kind).to_dicts()
    return only


def test_a_turn_is_what_lies_between_two_sleeps() -> None:
    story = loop_behind((0,), (100, 200, 300))
    turns = thread_turns(story.tables())
    assert turns.select("start", "end", "due", "left_ns", "execution_ns").rows() == [
        (100, 150, 99, 49, 30),
        (200, 250, 199, 49, 30),
        (300, 350, 299, 49, 30),
    ]


def test_what_is_published_before_the_first_sleep_is_followed_from_its_publication() -> None:
    """A thread's sleeps are recorded from its first publication on."""
    story = Story()
    node = story.node("/actor", PID)
    cmd = story.publisher(node, "/cmd")
    drives, out = story.relay("/drive", 30, "/cmd", "/out")
    story.event("thread_wake", 20, PID, LOOP, call=0)
    story.publish(cmd, 21, LOOP)
    first_sleep(story, 40, 99)
    turn(story, 100, 150, 199, writes=((cmd, 130),))
    for sent in (21, 130):
        story.runs(drives, sent + 5, sent + 9, reads=sent, writes=((out, sent + 8),))
    assert latencies(story, "/cmd../out") == [(21, 29), (100, 138)]


def test_a_thread_that_waits_until_now_looks_and_does_not_sleep() -> None:
    """Fast DDS does so in `spin_some`: on real ROS 2 every second message cut a turn in two."""
    story = Story()
    first_sleep(story, 40, 99)
    about = {"call": SLEEPING_CALLS.index("pthread_cond_timedwait"), "thread_time": 0}
    for woke in (100, 200, 300):
        story.event("thread_wake", woke, PID, LOOP, call=NANOSLEEP, thread_time=0)
        story.event("thread_sleep", woke + 10, PID, LOOP, until=woke + 8, **about)
        story.event("thread_wake", woke + 12, PID, LOOP, **about)
        first_sleep(story, woke + 50, woke + 99)
    turns = thread_turns(story.tables()).select("start", "end", "due")
    assert turns.rows() == [(woke, woke + 50, woke - 1) for woke in (100, 200, 300)]


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
    story = loop_behind((0, 200), (100, 200, 300, 400))
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
    story = loop_behind((0, 200, 400), (100, 200, 300, 400, 500, 600))
    assert latencies(story, "/a../cmd") == [(0, 130), (200, 330), (400, 530)]


def test_a_message_that_comes_while_a_turn_computes_goes_into_the_next() -> None:
    """It is stored at 110, before the turn publishes at 130."""
    story = loop_behind((100,), (100, 200))
    assert latencies(story, "/a../cmd") == [(100, 230)]


def test_of_two_messages_before_a_turn_the_newer_one_is_used() -> None:
    story = loop_behind((0, 20), (100, 200))
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
    for number, woke in enumerate(range(100, 1300, 100)):
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
    expected = [(woke - 50, woke + 10) for woke in range(100, 1300, 200)]
    assert latencies(python_loop(sleeps=sleeps), "/a../cmd") == expected


@pytest.mark.parametrize("sleeps", [True, False], ids=["sleeps recorded", "without sleeps"])
def test_a_python_callback_that_publishes_twice_has_two_rows_for_each_message(sleeps: bool) -> None:
    """Its executor waits for a time in between; the two come 10 and 15 behind the wake-up."""
    story = Story()
    timer, sensor = story.source("/sensor", 10, "/a")
    node = story.node("/actor", PID)
    reader = story.subscription(node, "/a", callbackless=True)
    out = story.publisher(node, "/out")
    if sleeps:
        first_sleep(story, 40, 99)
    wakes = range(100, 1300, 100)
    for woke in wakes:
        story.runs(timer, woke - 50, woke - 48, writes=((sensor, woke - 49),))
        story.take(reader, woke + 2, woke - 49, LOOP)
        if sleeps:
            turn(story, woke, woke + 50, woke + 99, call=RMW_WAIT)
        for later in (10, 15):
            story.publish(out, woke + later, LOOP)
    expected = [(woke - 50, woke + later) for woke in wakes for later in (10, 15)]
    assert latencies(story, "/a../out") == expected
    assert "loop" not in data_flow(story.tables()).objects.callbacks["kind"].to_list()


def test_the_first_message_that_a_python_loop_takes_is_not_its_callbacks_either() -> None:
    """It is taken and passed on before the thread first sleeps."""
    story = python_loop(sleeps=True)
    first = min(row["time"] for row in story.rows["thread_sleep"])
    for name in ("thread_sleep", "thread_wake"):
        story.rows[name] = [row for row in story.rows[name] if row["time"] > first + 100]
    graph = graph_of(data_flow(story.tables()))
    (reader,) = (c for c in graph.callbacks if c.topic == "/a")
    assert reader.passes_on == ("/cmd",)
    expected = [(woke - 50, woke + 10) for woke in range(100, 1300, 200)]
    assert latencies(story, "/a../cmd") == expected


def ages(story: Story, chain: str) -> list[tuple[int, int | None, int | None, int | None]]:
    """Start of each cycle of the loop; the data's age there and at the end; which use it is."""
    age = analyse_latency(data_flow(story.tables()), chain).data_age
    assert age is not None
    return age.cycles.select("start", "age_at_loop_ns", "age_at_end_ns", "use").rows()


def test_the_age_of_what_a_loop_uses_is_known_for_each_of_its_cycles() -> None:
    """/a leaves its sensor's callback at 0 and 200. The loop publishes 30 behind its start."""
    story = loop_behind((0, 200, 210), (5, 100, 200, 300, 400))
    assert ages(story, "/a../cmd") == [
        (5, None, None, None),  # nothing is stored yet
        (100, 100, 130, 1),
        (200, 200, 230, 2),
        (300, 90, 120, 1),  # of 210, the newer one
        (400, 190, 220, 2),
    ]
    age = analyse_latency(data_flow(story.tables()), "/a../cmd").data_age
    assert age is not None
    assert (age.uses, age.most_uses) == ({"never": 1, "once": 0, "again": 2}, 2)


def test_where_a_message_is_stored_while_the_loop_is_awake_the_cycle_is_ambiguous() -> None:
    """The callback runs for 2, from 10 behind its input; a turn from 100, 200, … publishes at 30.

    It may store its message behind the wake-up of the turn that it began before (at 99), within the
    turn (at 210 and at 329), or behind the publication (at 431).
    """
    story = loop_behind((89, 200, 319, 421), (100, 200, 300, 400, 500))
    age = analyse_latency(data_flow(story.tables()), "/a../cmd").data_age
    assert age is not None
    assert age.cycles.select("start", "ambiguous").rows() == [
        (100, True),
        (200, True),
        (300, True),
        (400, False),
        (500, False),
    ]
    assert age.ambiguous == 3


def test_what_the_loop_takes_itself_makes_no_cycle_ambiguous() -> None:
    age = analyse_latency(data_flow(python_loop(sleeps=True).tables()), "/a../cmd").data_age
    assert age is not None and age.ambiguous == 0


def test_without_events_of_sleeps_it_is_not_known_which_cycles_are_ambiguous() -> None:
    story = loop_behind(tuple(range(0, 2000, 200)), tuple(range(100, 2100, 100)))
    tables = {name: t for name, t in story.tables().items() if not name.startswith("thread_")}
    age = analyse_latency(data_flow(tables), "/a../cmd").data_age
    assert age is None or age.ambiguous is None


def test_the_age_at_the_end_is_that_of_the_output_behind_the_loop() -> None:
    """/out reads each command 5 behind it and publishes 3 later."""
    story = loop_behind((0,), (100, 200))
    drives, out = story.relay("/drive", 30, "/cmd", "/out")
    for sent in (130, 230):
        story.runs(drives, sent + 5, sent + 10, reads=sent, writes=((out, sent + 8),))
    assert latencies(story, "/a../out") == [(0, 138)]
    assert ages(story, "/a../out") == [(100, 100, 138, 1), (200, 200, 238, 2)]


def test_what_a_loop_takes_itself_is_as_old_as_when_it_is_taken() -> None:
    assert ages(python_loop(sleeps=True), "/a../cmd")[:3] == [
        (100, 52, 60, 1),
        (200, 150, 160, 2),
        (300, 52, 60, 1),
    ]


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
    expected = [(100, 100, 150, 1), (200, 200, 250, 2), (300, 100, 150, 1), (400, 200, 250, 2)]
    assert ages(story, "/a../manager:end") == expected


def test_a_loop_that_is_not_named_reads_nothing_of_other_nodes() -> None:
    story = loop_behind((0,), (100, 200))
    other = story.subscription(story.node("/monitor", PID), "/a")
    graph = graph_of(data_flow(story.tables()))
    (monitor,) = (c for c in graph.callbacks if c.handle == other.handle)
    assert monitor.publishes == ()


def test_a_thread_that_sleeps_irregularly_has_no_period_and_its_spread_is_said() -> None:
    story = loop_behind((0,), (100, 200, 330, 700, 760, 1000, 1900))
    assert row(story)["period_ns"] is None
    (note,) = (n for n in data_flow(story.tables()).notes if "irregularly" in n)
    assert "usually" in note and "(p95)" in note and "nothing is to be planned" in note


def test_a_loop_on_a_machine_that_stands_still_has_the_period_that_it_sleeps_by() -> None:
    """Two of three starts are late, by 40 to 90 of 100; it sleeps until multiples of 100."""
    story = Story()
    cmd = story.publisher(story.node("/actor", PID), "/cmd")
    first_sleep(story, 40, 100)
    for due in range(100, 3100, 100):
        woke = due + (0 if due % 300 == 0 else 40 + due // 100 * 17 % 50)
        turn(story, woke, woke + 5, due + 100, writes=((cmd, woke + 2),))
    starts = data_flow(story.tables()).instances["start"].sort().diff().drop_nulls()
    assert (starts.is_between(90, 110)).mean() < 0.5
    assert row(story)["period_ns"] == 100
    assert not any("irregularly" in note for note in data_flow(story.tables()).notes)


def test_a_loop_that_leaves_out_periods_has_the_one_that_it_sleeps_by() -> None:
    """Rates that overran begin anew: of the instants until which it sleeps most are 100 apart."""
    story = Story()
    cmd = story.publisher(story.node("/actor", PID), "/cmd")
    first_sleep(story, 40, 100)
    dues = [100, 200, 300, 537, 637, 737, 990, 1090, 1190, 1290, 1655, 1755, 1855]
    for due, following in zip(dues, [*dues[1:], 1955], strict=True):
        turn(story, due + 1, due + 50, following, writes=((cmd, due + 2),))
    assert row(story)["period_ns"] == 100


def test_a_loop_that_is_woken_before_its_time_is_paced_by_data() -> None:
    story = Story()
    node = story.node("/driver", PID)
    out = story.publisher(node, "/points")
    first_sleep(story, 40, 1000)
    for woke in range(100, 600, 100):  # it would have slept until 900 later
        turn(story, woke, woke + 50, woke + 1000, writes=((out, woke + 10),))
    flow = data_flow(story.tables())
    assert flow.objects.callbacks["kind"].to_list() == ["unknown"]
    (note,) = flow.notes
    assert "/driver publishes /points" in note and str(LOOP) in note and "paced by data" in note


def test_a_driver_that_blocks_on_its_device_and_then_sleeps_for_a_moment_is_no_loop() -> None:
    """It is awake for 90 of 100 and computes for 5: a chain begins when it has published."""
    story = Story()
    out = story.publisher(story.node("/driver", PID), "/points")
    drives, after = story.relay("/filter", 30, "/points", "/filtered")
    first_sleep(story, 90, 99)
    for woke in range(100, 1300, 100):
        used = woke // 20
        story.event("thread_wake", woke, PID, LOOP, call=NANOSLEEP, thread_time=used)
        story.publish(out, woke + 88, LOOP)
        sleep = {"until": woke + 99, "call": NANOSLEEP, "thread_time": used + 5}
        story.event("thread_sleep", woke + 90, PID, LOOP, **sleep)
        story.runs(drives, woke + 92, woke + 95, reads=woke + 88, writes=((after, woke + 94),))
    flow = data_flow(story.tables())
    assert "loop" not in flow.objects.callbacks["kind"].to_list()
    assert any("paced by data" in note and str(LOOP) in note for note in flow.notes)
    assert latencies(story, "/points../filtered") == [
        (woke + 88, woke + 94) for woke in range(100, 1300, 100)
    ]


def test_a_sleep_that_ends_a_little_early_is_one_for_a_time() -> None:
    """By 2 of 100, as where the middleware waits by another clock."""
    story = Story()
    node = story.node("/actor", PID)
    out = story.publisher(node, "/cmd")
    first_sleep(story, 0, 102)
    for woke in range(100, 600, 100):
        turn(story, woke, woke + 2, woke + 102, writes=((out, woke + 1),))
    assert row(story)["period_ns"] == 100


def test_a_loop_that_never_sleeps_for_a_time_is_paced_by_data() -> None:
    """It blocks on a device: that it is followed is all that is known of its thread."""
    story = Story()
    node = story.node("/driver", PID)
    in_cpp(story, node)
    out = story.publisher(node, "/points")
    story.event("thread_wake", 100, PID, LOOP, call=0)
    for at in range(100, 2000, 100):
        story.publish(out, at, LOOP)
    flow = data_flow(story.tables())
    assert flow.objects.callbacks.filter(handle=0)["kind"].to_list() == ["unknown"]
    assert any("paced by data" in note and str(LOOP) in note for note in flow.notes)


UNTIMED = SLEEPING_CALLS.index("pthread_cond_wait")


def test_waits_without_a_time_inside_a_publication_do_not_end_a_turn() -> None:
    """The middleware waits for its own thread, twice in each turn of 50."""
    story = loop_behind((0, 200), (100, 200, 300, 400))
    for woke in (100, 200, 300, 400):
        for at in (31, 35):
            story.event("thread_sleep", woke + at, PID, LOOP, until=0, call=UNTIMED)
            story.event("thread_wake", woke + at + 2, PID, LOOP, call=UNTIMED)
    turns = thread_turns(story.tables())
    assert turns.select("start", "end").rows() == [(w, w + 50) for w in (100, 200, 300, 400)]
    assert row(story)["period_ns"] == 100


def test_a_named_thread_that_waits_without_a_time_has_turns() -> None:
    """Another thread signals it every 100."""
    story = Story()
    story.node("/manager", PID)
    named(story, "worker", tid=LOOP, is_thread=1)
    story.event("thread_sleep", 40, PID, LOOP, until=0, call=UNTIMED)
    for woke in range(100, 1100, 100):
        turn(story, woke, woke + 50, 0, call=UNTIMED)
    loop = row(story, "/manager")
    assert (loop["period_ns"], loop["count"], loop["start_jitter_ns"]) == (100, 10, None)


def queueing(counts: tuple[int, ...]) -> Story:
    """A loop that publishes for every message; so many come before each of its turns, 10 apart."""
    story = Story()
    timer, sensor = story.source("/sensor", 10, "/a")
    node = story.node("/actor", PID)
    reader, cmd = story.subscription(node, "/a"), story.publisher(node, "/cmd")
    first_sleep(story, 40, 99)
    for number, count in enumerate(counts):
        woke = 100 * (number + 1)
        for place in range(count):
            at = woke - 50 + 10 * place
            story.runs(timer, at, at + 2, writes=((sensor, at + 1),))
            story.runs(reader, at + 4, at + 6, reads=at + 1, tid=21)
        writes = tuple((cmd, woke + 10 + place) for place in range(count))
        turn(story, woke, woke + 40, woke + 99, writes=writes)
    return story


def test_a_loop_that_publishes_for_each_message_queues_them() -> None:
    """Three came before the second turn: each has its own publication, in order."""
    assert latencies(queueing((1, 3, 0, 1)), "/a../cmd") == [
        (50, 110),
        (150, 210),
        (160, 211),
        (170, 212),
        (350, 410),
    ]
    assert ages(queueing((1, 3)), "/a../cmd") == [
        (100, 50, 60, 1),
        (200, 50, 60, 1),
        (200, 40, 51, 1),
        (200, 30, 42, 1),
    ]


def test_a_node_whose_named_loop_may_be_one_of_several_threads_is_named() -> None:
    story = controller()
    first_sleep(story, 60, 109, tid=LOOP + 1)
    turn(story, 110, 120, 209, tid=LOOP + 1)
    (note,) = (n for n in data_flow(story.tables()).notes if "Name the thread instead" in n)
    assert f"({LOOP}, {LOOP + 1})" in note


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
    story = loop_behind((0, 200, 400), tuple(range(100, 1300, 100)))
    in_cpp(story, story.node("/actor", PID))
    del story.rows["thread_sleep"], story.rows["thread_wake"]
    loop = row(story)
    assert (loop["period_ns"], loop["count"], loop["response_ns"]) == (100, 12, None)
    # The message of 200 is stored at 210; it goes into the publication of 230, not of 330.
    assert latencies(story, "/a../cmd") == [(0, 130), (200, 230), (400, 430)]
    assert any("No event shows its sleep" in note for note in data_flow(story.tables()).notes)


def test_without_sleeps_a_thread_that_publishes_irregularly_is_no_loop() -> None:
    story = loop_behind((0,), (100, 110, 190, 300, 305, 400, 620, 700, 1100, 1110, 1300))
    in_cpp(story, story.node("/actor", PID))
    del story.rows["thread_sleep"], story.rows["thread_wake"]
    kinds = data_flow(story.tables()).objects.callbacks.filter(pl.col("handle") == 0)["kind"]
    assert kinds.to_list() == ["unknown"]
