"""Executors of several threads, of Python, and such without events: answers worked out by hand."""

import polars as pl
import pytest
from story import Story
from test_traversals import spans, traversals

from chainshaper.analysis import data_flow, executors
from chainshaper.flow.recorded_profile.times import undisturbed_instances


def latencies(story: Story, spec: str) -> list[tuple[int, int | None]]:
    """Start and end of each traversal."""
    return spans(traversals(story, spec))


def threads(story: Story) -> list[set[int]]:
    return [set(one.threads) for one in executors(data_flow(story.tables()))]


@pytest.mark.parametrize("spec", ["/left../out", "/right../out"])
@pytest.mark.parametrize(("turns", "overtaken"), [(False, False), (True, False), (True, True)])
def test_what_runs_already_has_got_its_inputs_before(
    spec: str, turns: bool, overtaken: bool
) -> None:
    """Two inputs of a set, in a reentrant group: each takes a thread of its own.

    The second one computes for 138 (in turns 3 and 138), so that the inputs of the next set, 100
    later, are there when it publishes. Where it is overtaken, it starts first in every third set,
    but gets the lock of the sets last.
    """
    story = Story()
    source, join = story.node("/source", 1), story.node("/join", 2)
    timer, out = story.timer(source), story.publisher(join, "/out")
    inputs = [
        (story.publisher(source, t), story.subscription(join, t)) for t in ("/left", "/right")
    ]
    expected = []
    for k in range(8):
        at, fast = 100 * k, turns and k % 2 == 1
        writes = tuple((topic, at + 1 + n) for n, (topic, _) in enumerate(inputs))
        story.runs(timer, at, at + 5, writes=writes)
        first, second = (1, 0) if fast else (0, 1)
        sent, begun = at + (15 if fast else 150), at + (9 if overtaken and k % 3 == 1 else 12)
        story.runs(inputs[first][1], at + 10, at + 11, reads=at + 1 + first, tid=21)
        about = {"reads": at + 1 + second, "tid": 22 + k % 2}
        story.runs(inputs[second][1], begun, sent + 1, writes=((out, sent),), **about)
        expected.append((at, sent))
    assert latencies(story, spec) == expected
    if turns:  # else nothing shows that 21 and 22 are one executor's
        assert threads(story) == [{1}, {21, 22, 23}]


def test_a_timer_that_runs_already_does_not_read_what_is_stored_now() -> None:
    """The timer works in [100, 131); what comes at 110 leaves with the next one."""
    story = Story()
    source, node = story.node("/source", 1), story.node("/node", 2)
    begin, sent = story.timer(source), story.publisher(source, "/in")
    store, timer = story.subscription(node, "/in"), story.timer(node)
    out = story.publisher(node, "/out")
    story.runs(begin, 104, 106, writes=((sent, 105),))
    story.runs(store, 110, 111, reads=105, tid=21)
    for at in (100, 200):
        story.runs(timer, at, at + 31, writes=((out, at + 30),), tid=22)
    assert latencies(story, "/in../out") == [(104, 230)]


@pytest.mark.parametrize("out_of_order", [False, True])
def test_instances_of_one_callback_beside_each_other(out_of_order: bool) -> None:
    """Each message is read on a thread of its own, while others are in work there."""
    story = Story()
    timer, begun = story.source("/source", 1, "/begun")
    callback, done = story.relay("/work", 2, "/begun", "/done")
    for k in range(6):
        at, ends = 10 * k, 10 * k + (35 - 12 * (k % 3) if out_of_order else 30)
        story.runs(timer, at, at + 2, writes=((begun, at + 1),))
        story.runs(callback, at + 5, ends + 1, reads=at + 1, writes=((done, ends),), tid=21 + k % 4)
    times = [35, 33, 31, 65, 63, 61] if out_of_order else [30, 40, 50, 60, 70, 80]
    expected = [(10 * k, time) for k, time in enumerate(times)]
    assert latencies(story, "/begun../done") == expected


def python_node(*, calls: bool) -> Story:
    """A node whose timer publishes /begun, which it takes itself and publishes /done.

    On threads in turns: the timer's next call is where the message before was taken.
    """
    story = Story()
    node, timer = story.node("/python", 10), story.handle()
    begun, done = story.publisher(node, "/begun"), story.publisher(node, "/done")
    story.event("rcl_timer_init", 0, 10, timer_handle=timer, period=100)
    callback = story.subscription(node, "/begun", callbackless=True)
    for k in range(4):
        at, one, other = 100 * k, 11 + k % 2, 11 + (k + 1) % 2
        if calls:
            story.event("rcl_timer_call", at, 10, one, timer_handle=timer)
        story.publish(begun, at + 5, one)
        story.take(callback, at + 10, at + 5, other)
        story.publish(done, at + 20, other)
    return story


def test_what_a_timer_in_python_publishes_is_not_what_its_thread_took_before() -> None:
    story = python_node(calls=True)
    assert latencies(story, "/begun../done") == [(100 * k, 100 * k + 20) for k in range(4)]
    assert threads(story) == [{10, 11, 12}], "the main thread gives the others their work"
    flow = data_flow(story.tables())
    timer = flow.objects.callbacks.filter(kind="timer").select("node", "period_ns", "observed")
    assert timer.rows() == [("/python", 100, False)]
    # Of which a plan is made: 5 of the timer's, 10 of the subscription's.
    none = pl.DataFrame(schema={"start": pl.Int64(), "end": pl.Int64()})
    assert undisturbed_instances(flow, none)["response"].to_list() == [5, 10] * 4


def test_without_calls_of_timers_a_topic_that_came_before_all_takes_is_no_output_of_one() -> None:
    found = latencies(python_node(calls=False), "/begun../done")
    assert found == [(100 * k + 5, 100 * k + 20) for k in range(4)]


def test_who_calls_timers_belongs_to_the_executor_that_runs_their_callbacks() -> None:
    """rclcpp's events executor: thread 31 calls, the main thread executes."""
    story = Story()
    timer, out = story.source("/node", 30, "/out")
    handle = story.rows["rclcpp_timer_callback_added"][-1]["timer_handle"]
    for at in (100, 200):
        story.event("rcl_timer_call", at, 30, 31, timer_handle=handle)
        story.runs(timer, at + 1, at + 5, writes=((out, at + 3),), tid=30)
    assert threads(story) == [{30, 31}]
    assert latencies(story, "/node../out") == [(101, 103), (201, 203)]
