"""When asynchronous messages left, and what was withheld: stories with known ends."""

import polars as pl
import pytest
from story import OFFSET, Story

from chainshaper.analysis import analyse_latency

OUTCOMES = (None, "sent", "expired", "overwritten")


def _sent_by_thread(outcomes: tuple[str | None, ...], *, asynchronous: int = 1) -> Story:
    """A timer publishes at 100, 200, …; its publisher thread deals with that 60 later."""
    story = Story()
    node = story.node("/n", 1)
    timer, t1 = story.timer(node), story.publisher(node, "/t1")
    story.rows["rcl_publisher_init"][0]["asynchronous"] = asynchronous
    listener = story.subscription(story.node("/listener", 2), "/t1")
    for number, outcome in enumerate(outcomes, start=1):
        at = 100 * number
        story.runs(timer, at - 10, at + 5, writes=((t1, at),))
        if outcome is not None:
            story.event(
                "asynchronous_send",
                at + 60,
                1,
                11,
                rmw_publisher_handle=t1.rmw_handle,
                timestamp=at + OFFSET,
                outcome=outcome,
                duration=3,
            )
        if outcome == "sent":
            story.runs(listener, at + 70, at + 75, reads=at)
    return story


def test_the_latency_ends_when_the_message_was_sent() -> None:
    found = analyse_latency(_sent_by_thread(("sent", "sent")).tables(), "/n../t1", OFFSET)
    assert found.traversals["latency_ns"].to_list() == [70, 70]
    assert found.traversals["reception_ns"].to_list() == [80, 80]
    (first, _) = found.hops.select("publish", "end", "computation_ns").rows()
    assert first == (160, 105, 70), "it left when its callback instance had ended"


def test_a_message_that_was_not_sent_has_no_latency() -> None:
    story = _sent_by_thread(("sent", "expired", "overwritten", None))
    found = analyse_latency(story.tables(), "/n../t1", OFFSET)
    assert found.traversals["latency_ns"].to_list() == [70, None, None, None]
    assert found.traversals["reason"].to_list() == [None, "discarded", "discarded", "not sent"]
    assert found.traversals["broken_at"].to_list() == [None, "/t1", "/t1", "/t1"]
    assert found.incomplete == {"discarded": 2, "not sent": 1}


def test_a_thread_that_never_ran_sent_nothing() -> None:
    found = analyse_latency(_sent_by_thread((None, None)).tables(), "/n../t1", OFFSET)
    assert found.incomplete == {"not sent": 2}


@pytest.mark.parametrize("asynchronous", [0, None])
def test_where_nobody_knows_better_publishing_is_sending(asynchronous: int | None) -> None:
    story = _sent_by_thread((None, None))
    story.rows["rcl_publisher_init"][0]["asynchronous"] = asynchronous
    found = analyse_latency(story.tables(), "/n../t1", OFFSET)
    assert found.traversals["latency_ns"].to_list() == [10, 10]


def test_inside_a_chain_waiting_for_the_thread_belongs_to_the_hop_that_publishes() -> None:
    story = _sent_by_thread(("sent", "expired"))
    relay = story.node("/relay", 3)
    callback, t2 = story.subscription(relay, "/t1"), story.publisher(relay, "/t2")
    story.runs(callback, 180, 190, reads=100, writes=((t2, 185),))
    found = analyse_latency(story.tables(), "/t1../t2", OFFSET)
    assert found.traversals["latency_ns"].to_list() == [95, None]
    assert found.traversals["reason"].to_list() == [None, "discarded"]
    assert found.traversals["broken_at"].to_list() == [None, "/t1"]
    hops = found.hops.filter(pl.col("traversal") == 0)
    assert hops["computation_ns"].to_list() == [70, 5]
    assert hops["communication_ns"].to_list() == [None, 20]


def test_what_a_gate_discarded_is_not_lost() -> None:
    story = Story()
    source, gate = story.node("/source", 1), story.node("/gate", 2)
    timer, t1 = story.timer(source), story.publisher(source, "/tmp")
    hold, out = story.subscription(gate, "/tmp"), story.publisher(gate, "/t1")
    for start, released in ((1_000, 1_060), (1_100, None), (1_200, 1_260)):
        story.runs(timer, start, start + 20, writes=((t1, start + 10),))
        writes = () if released is None else ((out, released),)
        story.runs(hold, start + 30, start + 65, reads=start + 10, writes=writes)
        story.event(
            "gate_release",
            released or start + 31,
            2,
            callback=hold.handle,
            source_timestamp=start + 10 + OFFSET,
            arrival=start + 31,
            origin=start,
            release=released,
            slot=None if released is None else 0,
            cycles_waited=0,
            anchor="stamp",
            overrun=None if released else "discard",
        )
    # An instance that published nothing, of whose message the gate says nothing.
    story.runs(timer, 1_300, 1_320, writes=((t1, 1_310),))
    story.runs(hold, 1_330, 1_365, reads=1_310)
    found = analyse_latency(story.tables(), "/tmp../t1", OFFSET)
    assert found.traversals["latency_ns"].to_list() == [60, None, 60, None]
    assert found.incomplete == {"discarded": 1, "not published": 1}
