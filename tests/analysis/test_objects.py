"""Who exists: handles reused, recreated, shared, missing."""

from collections.abc import Callable

import pytest
from story import Callback, Story

from chainshaper.analysis import application_graph, callback_instances, resolve_objects


def _two_processes(story: Story) -> None:
    for start, (name, pid, topic) in ((20, ("/a", 1, "/x")), (50, ("/b", 2, "/y"))):
        callback = story.subscription(story.node(name, pid=pid), topic, handle=0xBEEF)
        story.runs(callback, start, start + 10)


def _another_object(story: Story) -> None:
    node = story.node("/a", pid=1)
    story.runs(story.subscription(node, "/x", time=10, handle=0xBEEF), 20, 30)
    story.runs(story.timer(node, time=40, handle=0xBEEF), 50, 60)


def _second_process(story: Story) -> None:
    """The second process has the same number, node handle and callback handle."""
    first = story.subscription(story.node("/a", 1, time=0, handle=8), "/x", 1, handle=0xBEEF)
    story.runs(first, 20, 30)
    again = story.subscription(story.node("/b", 1, time=40, handle=8), "/x", 41, handle=0xBEEF)
    story.runs(again, 50, 60)


def _recreated(story: Story) -> None:
    node = story.node("/a", pid=1)
    story.runs(story.subscription(node, "/x", time=10), 20, 30)
    story.runs(story.subscription(node, "/x", time=40), 50, 60)


def _two_timers(story: Story) -> None:
    """Both are in use at the same time, though node, period and even symbol agree."""
    node = story.node("/a", pid=1)
    one, two = (story.timer(node, time=10, symbol="A::tick()") for _ in range(2))
    for start in (100, 200):
        story.runs(one, start, start + 5)
        story.runs(two, start + 10, start + 15)


def _before_registration(story: Story) -> None:
    story.event("callback_start", 5, 1, callback=0xBEEF, is_intra_process=0)
    story.event("callback_end", 8, 1, callback=0xBEEF)
    later = story.subscription(story.node("/a", pid=1, time=10), "/x", 20, handle=0xBEEF)
    story.runs(later, 30, 40)


@pytest.mark.parametrize(
    ("tell", "callbacks", "starts"),
    [
        (_two_processes, ["/a ← /x", "/b ← /y"], {0: [20], 1: [50]}),
        (_another_object, ["/a ← /x", "/a every 100ns"], {0: [20], 1: [50]}),
        (_second_process, ["/a ← /x", "/b ← /x"], {0: [20], 1: [50]}),
        (_recreated, ["/a ← /x"], {0: [20, 50]}),
        (_two_timers, ["/a every 100ns"] * 2, {0: [100, 200], 1: [110, 210]}),
        (
            _before_registration,
            ["unknown (process 1) callback 0xbeef", "/a ← /x"],
            {0: [5], 1: [30]},
        ),
    ],
)
def test_whose_a_handle_is_depends_on_process_and_time(
    tell: Callable[[Story], None], callbacks: list[str], starts: dict[int, list[int]]
) -> None:
    story = Story()
    tell(story)
    tables = story.tables()
    graph, objects = application_graph(tables), resolve_objects(tables)
    assert [callback.label for callback in graph.callbacks] == callbacks
    found = callback_instances(tables, objects.callbacks).group_by("callback_id").agg("start")
    assert dict(found.iter_rows()) == starts
    late = any("tracing started after the application" in note for note in objects.notes)
    assert late == (tell is _before_registration)


def test_symbol_of_a_later_user_of_the_address_is_not_taken() -> None:
    story = Story()
    node = story.node("/a", pid=1)
    story.subscription(node, "/x", time=10, handle=0xBEEF)
    story.subscription(node, "/y", time=40, handle=0xBEEF, symbol="second()")
    graph = application_graph(story.tables())
    assert [callback.symbol for callback in graph.callbacks] == [None, "second()"]


def test_lost_init_events_leave_what_is_known() -> None:
    # The node's and the rcl subscription's events are missing: topic and node stay unknown.
    story = Story()
    story.event("rclcpp_subscription_init", 1, 1, subscription_handle=5, subscription=6)
    story.event("rclcpp_subscription_callback_added", 2, 1, subscription=6, callback=7)
    story.event("callback_start", 3, 1, callback=7, is_intra_process=0)
    (callback,) = application_graph(story.tables()).callbacks
    found = (callback.kind, callback.topic, callback.node)
    assert found == ("subscription", None, "unknown (process 1)")


@pytest.mark.parametrize("executes", [False, True])
@pytest.mark.parametrize("registered", [False, True])
def test_takes_tell_whose_a_callback_of_an_unregistered_address_is(
    executes: bool, registered: bool
) -> None:
    """The callback was registered at another address, or not at all. /a publishes /y in it. Another
    unregistered callback, of a timer, starts in between: no take comes right before it.

    Loaned messages have no event of a take, but of their execution.
    """
    story = Story()
    node = story.node("/a", pid=1)
    reader = story.subscription(node, "/x", callbackless=not registered)
    writer = story.publisher(node, "/y")
    moved, timer = Callback(1, 0x63), Callback(1, 0x77)
    for time in range(100, 1000, 100):
        if executes:
            handle = story.rows["rcl_subscription_init"][0]["subscription_handle"]
            story.event("rclcpp_executor_execute", time, 1, handle=handle)
        else:
            story.take(reader, time, sent=time - 10)
        story.runs(moved, time + 1, time + 5, writes=((writer, time + 3),))
        story.runs(timer, time + 10, time + 15)
    tables = story.tables()
    graph, objects = application_graph(tables), resolve_objects(tables)
    labels = [one.label for one in graph.callbacks]
    assert sorted(labels) == ["/a ← /x", "unknown (process 1) callback 0x77"]
    assert graph.callbacks[labels.index("/a ← /x")].publishes == ("/y",)
    found = callback_instances(tables, objects.callbacks).group_by("callback_id").len()
    assert set(found["len"]) == {9}
    assert sum("0x63, which was not registered" in note for note in objects.notes) == 1
    assert not any("without callback events" in note for note in objects.notes)


def test_publisher_created_before_its_node_as_rosout_is() -> None:
    story = Story()
    story.publisher(story.node("/a", pid=1, time=6, handle=8), "/rosout", time=5)
    assert application_graph(story.tables()).publishers == {"/rosout": ("/a",)}


def test_empty_tables_are_an_empty_application() -> None:
    graph = application_graph({})
    assert (graph.nodes, graph.callbacks, graph.topics) == ((), (), ())
    assert callback_instances({}, resolve_objects({}).callbacks).height == 0
