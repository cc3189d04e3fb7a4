"""ros2_control's loop by the calls of its controller manager: answers worked out by hand."""

import pytest
from loop_story import LOOP, NANOSLEEP, PID
from story import OFFSET, Story

from chainshaper.analysis import DataFlow, analyse_latency, data_flow, graph_of
from chainshaper.analysis.latency import callback_statistics
from chainshaper.values.event_declarations import MANAGER_FUNCTIONS

MANAGER = 0x77
CHAIN = "/a../cm:write"


def call(story: Story, name: str, began: int, ended: int, used: int) -> None:
    """A call that computes ``used`` ns: the thread's CPU time is ``began`` × 10 when it begins."""
    about = {"manager": MANAGER, "function": MANAGER_FUNCTIONS.index(name), "began": began}
    times = {"thread_time_began": began * 10, "thread_time": began * 10 + used}
    story.event("controller_manager_call", ended, PID, LOOP, **about, **times)


def sleep(story: Story, time: int, until: int, tid: int = LOOP) -> None:
    until_and_how = {"until": until, "call": NANOSLEEP, "thread_time": 0}
    story.event("thread_sleep", time, PID, tid, **until_and_how)
    story.event("thread_wake", until + 1, PID, tid, call=NANOSLEEP, thread_time=0)


def turn(story: Story, at: int, until: int | None, read: int = 10, waits: int = 0) -> None:
    """read() lasts ``read`` and ``waits``, update() is called 2 later and lasts 20, write() 8."""
    began = at + read + waits + 2
    call(story, "read", at, at + read + waits, read)
    call(story, "update", began, began + 20, 18)
    call(story, "write", began + 21, began + 29, 8)
    if until is not None:
        sleep(story, began + 30, until)


def controlled(sent: tuple[int, ...]) -> Story:
    """/sensor sends /a; a controller, of another node than the manager, stores it 10 later."""
    story = Story()
    timer, sensor = story.source("/sensor", 10, "/a")
    story.node("/cm", PID)
    reader = story.subscription(story.node("/forward", PID), "/a")
    for at in sent:
        story.runs(timer, at, at + 2, writes=((sensor, at + 1),))
        story.runs(reader, at + 10, at + 12, reads=at + 1, tid=LOOP + 1)
    story.event("controller_manager_found", 500, PID, LOOP, manager=MANAGER, name="/cm")
    return story


def flow_of(story: Story) -> DataFlow:
    return data_flow(story.tables(), OFFSET)


def in_time(*starts: int) -> Story:
    """Turns that begin 1 behind the ends of their sleeps, 100 apart."""
    story = controlled((1000, 1093, 1150, 1340))
    sleep(story, 900, starts[0] - 1)
    for start, following in zip(starts, (*starts[1:], starts[-1] + 100), strict=True):
        turn(story, start, following - 1)
    return story


def test_turns_are_from_read_to_the_return_of_write() -> None:
    flow = flow_of(in_time(1100, 1200, 1300, 1400))
    (loop,) = (callback for callback in graph_of(flow).callbacks if callback.kind == "loop")
    assert (loop.node, loop.publishes, loop.period_ns) == ("/cm", ("/cm:write",), 100)
    ran = flow.instances.filter(callback_id=loop.id).join(flow.turns, on="instance").sort("start")
    assert ran["start"].to_list() == [1100, 1200, 1300, 1400]
    assert ran["end"].to_list() == [1141, 1241, 1341, 1441]
    assert ran["reads"].to_list() == [1112, 1212, 1312, 1412]
    assert ran["due"].to_list() == [1099, 1199, 1299, 1399]
    assert ran["overran"].to_list() == [False] * 4
    assert ran["execution_ns"].to_list() == [(1133 - 1100) * 10 + 8] * 4
    (figures,) = callback_statistics(flow).filter(kind="loop").iter_rows(named=True)
    assert (figures["overruns"], figures["start_jitter_ns"]) == (0, 0)


def test_each_turn_writes_what_was_stored_before_its_update() -> None:
    """The message of 1093 is stored at 1103, while read() runs: the turn of 1100 writes it, so
    1000's is never used. 1150's is used by the next two; 1340's, stored at 1350, by that of 1400.
    """
    analysis = analyse_latency(flow_of(in_time(1100, 1200, 1300, 1400)), CHAIN)
    by_start = analysis.traversals.sort("start")
    assert by_start["latency_ns"].to_list() == [None, 48, 91, 101]
    assert by_start["reason"].to_list() == ["not used", None, None, None]
    assert analysis.data_age is not None
    cycles = analysis.data_age.cycles
    assert cycles["age_at_loop_ns"].to_list() == [19, 62, 162, 72]
    assert cycles["age_at_end_ns"].to_list() == [48, 91, 191, 101]
    assert cycles["use"].to_list() == [1, 1, 2, 1]
    assert analysis.data_age.uses == {"never": 1, "once": 2, "again": 1}


@pytest.mark.parametrize("ending", [":write", ":end"])
def test_the_end_of_the_loop_is_the_same_place(ending: str) -> None:
    analysis = analyse_latency(flow_of(in_time(1100, 1200, 1300, 1400)), f"/a../cm{ending}")
    assert analysis.chain.topics == ("/a", "/cm:write")


def test_a_turn_that_ends_when_the_next_was_due_overran_though_it_slept_again() -> None:
    """The third begins 65 late and lasts 41: until 1405, and the next was due at 1399."""
    story = controlled((1000,))
    sleep(story, 900, 1099)
    for start, until in ((1100, 1199), (1200, 1299), (1364, 1499), (1500, 1599), (1600, 1699)):
        turn(story, start, until)
    assert flow_of(story).turns["overran"].to_list() == [False, False, True, False, False]


def test_a_turn_behind_which_it_did_not_sleep_overran() -> None:
    story = controlled((1000,))
    sleep(story, 900, 1099)
    for start, until in ((1100, None), (1200, 1299), (1300, 1399), (1400, 1499)):
        turn(story, start, until)
    assert flow_of(story).turns["overran"].to_list() == [True, False, False, False]


def test_where_read_waits_for_the_device_the_turn_begins_behind_it() -> None:
    story = controlled((1000, 1170))
    for start in (1000, 1100, 1200, 1300):
        turn(story, start, None, waits=57)
    flow = flow_of(story)
    (loop,) = (callback for callback in graph_of(flow).callbacks if callback.kind == "loop")
    ran = flow.instances.filter(callback_id=loop.id).sort("start")
    assert ran["start"].to_list() == [1067, 1167, 1267, 1367]
    assert ran["execution_ns"].to_list() == [(1090 - 1000) * 10 + 8 - 10] * 4
    assert flow.turns["overran"].null_count() == flow.turns["due"].null_count() == 4
    assert any("waits for its device in read()" in note for note in flow.notes)
    # 1170's is stored at 1180, behind the update of 1169: the turn of 1267 has it.
    assert analyse_latency(flow, CHAIN).traversals["latency_ns"].to_list() == [98, 128]


def test_only_the_first_write_of_a_turn_counts() -> None:
    """Gazebo writes at each step of its simulation."""
    story = in_time(1100, 1200, 1300)
    for time in (1050, 1145, 1150, 1250):
        call(story, "write", time, time + 4, 3)
    flow = flow_of(story)
    ends = flow.publications.filter(topic="/cm:write")["time"]
    assert ends.to_list() == [1141, 1241, 1341]


def test_turns_without_a_write_or_an_update_have_no_end_and_are_there() -> None:
    story = controlled((1000,))
    for at in (1100, 1200, 1300):
        call(story, "read", at, at + 10, 9)
    call(story, "write", 1220, 1230, 9)
    flow = flow_of(story)
    (loop,) = (callback for callback in graph_of(flow).callbacks if callback.kind == "loop")
    ran = flow.instances.filter(callback_id=loop.id).sort("start")
    assert ran["end"].to_list() == [None, 1230, None]
    assert analyse_latency(flow, CHAIN).traversals["latency_ns"].to_list() == [230]


def test_what_it_publishes_in_a_turn_is_published_by_the_loop() -> None:
    story = in_time(1100, 1200, 1300, 1400)
    state = story.publisher(story.node("/states", PID), "/states")
    forward = story.node("/forward", PID)
    for topic in ("/forward/transition_event", "/follow_path/_action/status"):  # states, no outputs
        story.publish(story.publisher(forward, topic), 1119, LOOP)
    for at in (1120, 1220, 1320, 1420):
        story.publish(state, at, LOOP)
    graph = graph_of(flow_of(story))
    loops = {c.node: c.publishes for c in graph.callbacks if c.kind == "loop"}
    assert loops == {"/cm": ("/cm:write",), "/states": ("/states",)}
