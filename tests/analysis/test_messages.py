"""Which take read which publication, in the dialects of ROS 2's versions."""

from typing import Any

import polars as pl
import pytest
from story import OFFSET, Callback, Node, Publisher, Story

from chainshaper.analysis import DataFlow, application_graph, data_flow
from chainshaper.analysis.messages import discarded_instances, gate_decisions, gated_hops


def read(flow: DataFlow) -> list[tuple[int, int | None]]:
    """(time of the take, time of the publication it read)."""
    published = flow.publications.select("publication", sent="time")
    joined = flow.takes.join(published, on="publication", how="left", maintain_order="left")
    return list(joined.select("time", "sent").iter_rows())


def a_publisher_and_a_subscription(story: Story) -> tuple[Publisher, Callback]:
    publisher = story.publisher(story.node("/a", pid=1), "/x")
    return publisher, story.subscription(story.node("/b", pid=2), "/x")


def test_takes_are_matched_by_topic_and_source_timestamp() -> None:
    # /x and /y are published in the same nanosecond.
    story = Story()
    x, reader = a_publisher_and_a_subscription(story)
    y = story.publisher(story.node("/c", pid=3), "/y")
    story.publish(y, 10)
    story.publish(x, 10)
    story.publish(x, 20)
    story.take(reader, 30, sent=20)
    story.take(reader, 31, sent=10)
    flow = data_flow(story.tables())
    assert read(flow) == [(30, 20), (31, 10)]
    assert flow.publications.filter(topic="/y").height == 1


def test_handles_nobody_initialised_and_takes_that_found_nothing_are_left_out() -> None:
    story = Story()
    publisher, reader = a_publisher_and_a_subscription(story)
    story.publish(Publisher(1, 1, 0xD15C), 5)  # as ros_discovery_info is
    story.take(Callback(2, 0, 0xD15C), 6, sent=5)
    story.publish(publisher, 10)
    story.take(reader, 20, sent=10)
    story.take(reader, 30, sent=10, taken=0)
    flow = data_flow(story.tables())
    assert (read(flow), flow.publications.height) == ([(20, 10)], 1)


def test_an_instance_reads_the_latest_message_taken_for_it() -> None:
    # Two takes before one start: the first message was dropped by the executor.
    story = Story()
    publisher, reader = a_publisher_and_a_subscription(story)
    for sent in (10, 20):
        story.publish(publisher, sent)
        story.take(reader, sent + 5, sent=sent)
    story.runs(reader, 30, 40)
    flow = data_flow(story.tables())
    assert flow.takes["instance"].to_list() == [None, 0]


def test_publications_belong_to_the_innermost_running_instance() -> None:
    # The outer callback spins an executor that runs the inner one from 20 to 30.
    story = Story()
    node = story.node("/a", pid=1)
    outer, inner = story.timer(node, 100), story.timer(node, 5)
    publisher = story.publisher(node, "/x")
    story.start(outer, 10)
    story.runs(inner, 20, 30, writes=((publisher, 25),))
    for time in (15, 35, 45):  # 45 is after the outer callback's end
        story.publish(publisher, time)
    story.end(outer, 40)
    found = data_flow(story.tables()).publications.select("time", "instance").rows()
    assert found == [(15, 0), (25, 1), (35, 0), (45, None)]


def humble_publish(story: Story, publisher: Publisher, time: int, message: int = 7) -> None:
    """Before Jazzy: the publisher's handle only in `rcl_publish`, no timestamp."""
    pid, handle = publisher.pid, publisher.handle
    story.event("rcl_publish", time - 1, pid, publisher_handle=handle, message=message)
    story.event("rmw_publish", time, pid, message=message)


@pytest.mark.parametrize(
    ("takes", "expected"),
    [
        # DDS stamps 2 us after rmw_publish. The message of 30 was lost: its take is absent.
        ([(20, 12), (60, 52)], [(20, 10), (60, 50)]),
        # The events of a message of 42 were lost: its take must not read that of 30 again.
        ([(35, 32), (45, 42)], [(35, 30), (45, None)]),
    ],
)
def test_before_jazzy_takes_get_the_latest_publication_before_their_timestamp(
    takes: list[tuple[int, int]], expected: list[tuple[int, int | None]]
) -> None:
    story = Story()
    publisher, reader = a_publisher_and_a_subscription(story)
    for sent in (10, 30, 50):
        humble_publish(story, publisher, sent * 1000)
    # The address that rcl_publish named is used again, for discovery traffic.
    story.event("rmw_publish", 70_000, 1, message=7)
    for time, sent in takes:
        story.take(reader, time * 1000, sent=sent * 1000)
    flow = data_flow(story.tables(), OFFSET)
    assert read(flow) == [(time * 1000, sent and sent * 1000) for time, sent in expected]
    assert flow.publications["time"].to_list() == [10_000, 30_000, 50_000]


def test_caret_binds_stamps_to_writes_and_dispatches_callbacks() -> None:
    story = Story()
    publisher, reader = a_publisher_and_a_subscription(story)
    for sent in (10, 30):
        story.event("rcl_publish", sent - 1, 1, publisher_handle=publisher.handle, message=7)
        story.event("dds_write", sent, 1, message=7)
        story.event("dds_bind_addr_to_stamp", sent + 1, 1, addr=7, source_stamp=9_000 + sent)
        dispatched = {"message": 8, "callback": reader.handle, "source_stamp": 9_000 + sent}
        story.event("dispatch_subscription_callback", sent + 5, 2, **dispatched)
        story.runs(reader, sent + 6, sent + 9)
    flow = data_flow(story.tables())
    assert read(flow) == [(15, 10), (35, 30)]
    assert flow.takes["instance"].to_list() == [0, 1]


def intra_process(story: Story, capacity: int = 2) -> tuple[Publisher, Callback, int]:
    """A publisher and a subscription of one process, connected by a ring buffer."""
    node = story.node("/a", pid=1)
    publisher = story.publisher(node, "/x")
    buffer, ipb, twin = 0xB0F, 0x1B, 0x7717
    twin_callback = Callback(1, 0xCA11)
    story.event("rclcpp_construct_ring_buffer", 1, 1, buffer=buffer, capacity=capacity)
    story.event("rclcpp_buffer_to_ipb", 2, 1, buffer=buffer, ipb=ipb)
    story.event("rclcpp_ipb_to_subscription", 3, 1, ipb=ipb, subscription=twin)
    added = "rclcpp_subscription_callback_added"
    story.event(added, 4, 1, subscription=twin, callback=twin_callback.handle)
    story.subscription(node, "/x", time=5)
    rcl = story.rows["rcl_subscription_init"][-1]["subscription_handle"]
    # The order of rclcpp: the twin's own init event comes after its callback was added.
    story.rows["rcl_subscription_init"][-1]["time"] = 0
    story.event("rclcpp_subscription_init", 5, 1, subscription_handle=rcl, subscription=twin)
    return publisher, twin_callback, buffer


def hand_over(
    story: Story, publisher: Publisher, time: int, buffer: int, index: int, *, overwritten: int = 0
) -> None:
    story.event("rclcpp_intra_publish", time, 1, publisher_handle=publisher.handle, message=1)
    put = {"buffer": buffer, "index": index, "size": 1, "overwritten": overwritten}
    story.event("rclcpp_ring_buffer_enqueue", time + 1, 1, **put)


def receive(story: Story, twin: Callback, start: int, buffer: int, index: int) -> None:
    story.event("rclcpp_ring_buffer_dequeue", start - 1, 1, buffer=buffer, index=index, size=0)
    story.start(twin, start, intra=1)
    story.end(twin, start + 3)


def test_intra_process_messages_travel_by_buffer_and_index() -> None:
    # Index 0 is used twice: at 10 and, once it is free again, at 30.
    story = Story()
    publisher, twin, buffer = intra_process(story)
    hand_over(story, publisher, 10, buffer, 0)
    receive(story, twin, 20, buffer, 0)
    hand_over(story, publisher, 30, buffer, 0)
    hand_over(story, publisher, 33, buffer, 1)
    receive(story, twin, 40, buffer, 0)
    receive(story, twin, 50, buffer, 1)
    flow = data_flow(story.tables())
    assert read(flow) == [(19, 10), (39, 30), (49, 33)]
    assert flow.takes["instance"].to_list() == [0, 1, 2]
    # The twin is the same callback as the subscription's own.
    callbacks = application_graph(story.tables()).callbacks
    assert [callback.kind for callback in callbacks if callback.handle] == ["subscription"]


@pytest.mark.parametrize(
    "dispatch", ["dispatch_intra_process_subscription_callback", "dispatch_intra_process"]
)
@pytest.mark.parametrize("copies", [0, 1, 2])
def test_caret_dispatches_messages_of_a_process_by_their_address(
    dispatch: str, copies: int
) -> None:
    """All messages lie at one address, or are copied to another one, once or twice. The
    events of the fourth message's publication are lost."""
    story = Story()
    node = story.node("/a", pid=1)
    publisher, reader = story.publisher(node, "/x"), story.subscription(node, "/x")
    for sent in (10, 30, 50, 70):
        at = {"publisher_handle": publisher.handle, "message": 7}
        if sent != 70:
            story.event("rclcpp_intra_publish", sent, 1, **at)
        for copy in range(copies if sent != 70 else 0):
            addresses = {"original_message": 7 + copy, "constructed_message": 8 + copy}
            story.event("message_construct", sent + 1 + copy, 1, **addresses)
        story.event(dispatch, sent + 5, 1, message=7 + copies, callback=reader.handle)
        story.start(reader, sent + 6, intra=1)
        story.end(reader, sent + 9)
    flow = data_flow(story.tables())
    assert read(flow) == [(15, 10), (35, 30), (55, 50), (75, None)]
    assert flow.takes["instance"].to_list() == [0, 1, 2, 3]
    assert flow.takes["intra_process"].all()
    assert not any("no other event tells" in note for note in flow.notes)


def test_a_gate_s_decision_about_a_message_without_dds_is_found_by_its_instance() -> None:
    """The gate's thread has no other instance meanwhile; the process has other subscriptions."""
    story = Story()
    publisher, twin, buffer = intra_process(story)
    other = story.subscription(Node(1, story.rows["rcl_node_init"][0]["node_handle"]), "/z")
    for begin, release in ((20, 22), (40, None)):
        hand_over(story, publisher, begin - 10, buffer, 0)
        receive(story, twin, begin, buffer, 0)
        decided: dict[str, Any] = {"callback": None, "source_timestamp": None, "arrival": begin}
        decided |= {"origin": begin, "release": release, "slot": 0, "cycles_waited": 0}
        story.event("gate_release", begin + 2, 1, **decided, anchor="stamp", overrun=None)
    story.start(other, 60)
    story.end(other, 70)
    flow = data_flow(story.tables())
    decisions = gate_decisions(flow.events, flow.objects)
    read_by = flow.instances.filter(pl.col("intra_process"))["callback_id"][0]
    assert decisions.select("callback_id", "start").rows() == [(read_by, 20), (read_by, 40)]
    gone = discarded_instances(flow.takes, flow.events, flow.objects, flow.instances)
    assert gone.to_list()[:3] == [None, True, None]

    hops = flow.instances.select("callback_id", "start", traversal="instance", hop=pl.lit(1))
    hops = hops.with_columns(source_timestamp=pl.lit(None, dtype=pl.Int64))
    found = gated_hops(flow.events, flow.objects, hops)
    assert found.select("traversal", "arrival", "release").rows() == [(0, 20, 22), (1, 40, None)]


def test_a_message_given_to_buffers_and_to_dds_is_one_publication() -> None:
    story = Story()
    publisher, twin, buffer = intra_process(story)
    outside = story.subscription(story.node("/b", pid=2), "/x")
    hand_over(story, publisher, 10, buffer, 0)
    story.publish(publisher, 14)
    receive(story, twin, 20, buffer, 0)
    story.take(outside, 25, sent=14)
    flow = data_flow(story.tables())
    assert flow.publications.select("time", "intra_time").rows() == [(14, 10)]
    assert flow.takes["publication"].to_list() == [0, 0]
