"""Messages that callbacks got although no event tells of their takes."""

import polars as pl
import pytest
from story import Story

from chainshaper.analysis import analyse_latency, data_flow

NODES = [("/src", 1), ("/relay", 2)]


def told(
    starts: list[int], sent: list[int] | None = None, *, lasts: int = 20, foxy: bool = False
) -> Story:
    """/src publishes /x ``sent`` (by default every 100 from 100 on); /relay's callback ``starts``,
    without an event of a take. It publishes /y 5 later. Foxy has no event of rmw at all."""
    story = Story()
    source, x = story.source("/src", 1, "/x")
    reader, y = story.relay("/relay", 2, "/x", "/y")

    def publish(publisher_pid: int, time: int) -> None:
        publisher = x if publisher_pid == 1 else y
        if foxy:
            about = {"publisher_handle": publisher.handle, "message": 7}
            story.event("rcl_publish", time, publisher_pid, **about)
        else:
            story.publish(publisher, time)

    for time in sent or range(100, 1001, 100):
        story.start(source, time - 5)
        publish(1, time)
        story.end(source, time + 5)
    for start in starts:
        story.start(reader, start)
        publish(2, start + 5)
        story.end(reader, start + lasts)
    return story


def cycles(story: Story) -> list[tuple[int, int | None]]:
    """When /x was published, and how long behind that /y was."""
    found = analyse_latency(story.tables(), "/x../y")
    frame = found.traversals.select(pl.col("start") + 5, pl.col("latency_ns") - 5)
    return list(frame.iter_rows())


EVERY = [(time, 15) for time in range(100, 1001, 100)]


@pytest.mark.parametrize("foxy", [False, True])
def test_publication_and_callback_determine_each_other(foxy: bool) -> None:
    story = told([time + 10 for time in range(100, 1001, 100)], foxy=foxy)
    assert cycles(story) == EVERY
    (note,) = data_flow(story.tables()).notes
    assert "/relay for /x ran without any event of a take (instances: 10" in note
    assert "of 10 it is certain" in note


def test_messages_without_a_callback_break_only_their_own_cycle() -> None:
    """The third message was lost. The thread was idle when the next one came."""
    starts = [time + 10 for time in range(100, 1001, 100) if time != 300]
    assert cycles(told(starts)) == [one if one[0] != 300 else (300, None) for one in EVERY]


def test_a_callback_that_may_be_behind_is_not_taken_to_be_the_latest_message_s() -> None:
    """A callback takes 105: from the second message on the thread is never idle, each start may be
    that of a message before; whose it is follows from the first one. It is late, but in order."""
    starts = [110 + 105 * place for place in range(9)]
    story = told(starts, lasts=105)
    found = dict(cycles(story))
    assert [found[time] for time in range(100, 1000, 100)] == [15 + 5 * n for n in range(9)]
    assert found[1000] is None


def test_the_first_message_may_be_waiting_already() -> None:
    """The reader is busy with something else from before the first message until 250, and never
    idle then: it may be a message behind all the time, which nothing tells."""
    story = told([250 + 100 * place for place in range(9)], lasts=100)
    other = story.timer(story.node("/busy", 2))
    story.runs(other, 50, 250)
    found = analyse_latency(story.tables(), "/x../y")
    assert found.statistics.count == 0
    assert found.incomplete == {"take not recorded": 10}
    assert any("cannot be known, since publications and callbacks" in note for note in found.notes)


def test_two_publishers_do_not_determine_the_callback() -> None:
    story = told([time + 10 for time in range(100, 1001, 100)])
    second = story.publisher(story.node("/second", 3), "/x")
    story.publish(second, 550)
    found = analyse_latency(story.tables(), "/src../x../y")
    assert found.incomplete == {"take not recorded": 10}
    assert any("2 publishers write the topic" in note for note in found.notes)


def test_publisher_and_subscriber_may_share_a_thread() -> None:
    """The thread was idle before the publisher's callback, so nothing waited."""
    story = Story()
    node = story.node("/all", 1)
    source, x = story.timer(node), story.publisher(node, "/x")
    reader, y = story.subscription(node, "/x"), story.publisher(node, "/y")
    for time in range(100, 1001, 100):
        story.runs(source, time - 5, time + 5, writes=((x, time),))
        story.runs(reader, time + 10, time + 20, writes=((y, time + 15),))
    assert cycles(story) == EVERY
