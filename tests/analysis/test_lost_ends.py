"""Ends that cannot be those of an instance: its own, and the next start, were lost."""

import polars as pl
import pytest
from story import Callback, Publisher, Story

from chainshaper.analysis import analyse_latency, callback_statistics, data_flow

Lost = frozenset[tuple[str, int]]


def waits(story: Story, time: int) -> None:
    story.event("rclcpp_executor_get_next_ready", time, 2)
    story.event("rclcpp_executor_wait_for_work", time + 1, 2, timeout=-1)


def relayed(lost: Lost = frozenset(), *, looks: bool = True) -> Story:
    """/src publishes /x every 100, from 100 to 2000; /relay needs 30 for it and publishes /y at 20.

    ``lost`` are the events of /relay that are not there: what, and of which message.
    """
    story = Story()
    source, x = story.source("/src", 1, "/x")
    reader, y = story.relay("/relay", 2, "/x", "/y")
    for sent in range(100, 2001, 100):
        story.runs(source, sent - 5, sent + 5, writes=((x, sent),))
        left = {step for step in ("take", "start", "publish", "end") if (step, sent) not in lost}
        if "take" in left:
            story.take(reader, sent + 9, sent=sent)
        if "start" in left:
            story.start(reader, sent + 10)
        if "publish" in left:
            story.publish(y, sent + 30)
        if "end" in left:
            story.end(reader, sent + 40)
        if looks:
            waits(story, sent + 50)
    return story


PAIR: Lost = frozenset({("end", 500), ("start", 600)})


def longest(story: Story, node: str = "/relay") -> tuple[int, int, int]:
    """Instances of the node's callback, those without an end, the longest response time."""
    found = callback_statistics(data_flow(story.tables())).row(
        by_predicate=pl.col("node") == node, named=True
    )
    return found["count"], found["unfinished"], found["response_ns"]["max"]


def latencies(story: Story) -> tuple[int, int | None, dict[str, int]]:
    found = analyse_latency(story.tables(), "/x../y")
    return found.statistics.count, found.statistics.max_ns, found.incomplete


def test_the_next_take_proves_that_the_callback_had_ended() -> None:
    story = relayed(PAIR, looks=False)
    assert longest(story) == (19, 1, 30)
    assert latencies(story) == (19, 35, {"not executed": 1})


def test_the_executor_s_search_for_work_proves_it_too() -> None:
    """The take is lost as well: all that is left between the two is that the thread looked."""
    story = relayed(PAIR | {("take", 600)})
    assert longest(story) == (19, 1, 30)
    assert latencies(story) == (19, 35, {"lost": 1})


def test_what_comes_behind_the_proof_was_not_published_by_the_instance() -> None:
    """Nothing of the second instance is there but its publication, which has no instance then."""
    story = relayed(frozenset({("end", 500), *((n, 600) for n in ("take", "start", "end"))}))
    assert latencies(story) == (19, 35, {"lost": 1})


@pytest.mark.parametrize("executes", [False, True])
def test_a_timer_s_callback_too(executes: bool) -> None:
    """That it is executed again proves it also where no event is known to be lost."""
    story = Story()
    timer, _ = story.source("/t", 2, "/x")
    handle = story.rows["rcl_timer_init"][0]["timer_handle"]
    for time in range(100, 2001, 100):
        if executes:
            story.event("rclcpp_executor_execute", time - 1, 2, handle=handle)
        if time != 600:
            story.start(timer, time)
        if time != 500:
            story.end(timer, time + 30)
        waits(story, time + 40)
    assert longest(story, "/t") == (19, 1, 30)
    if executes:
        flow = data_flow(story.tables(), complete=True)
        assert flow.instances.filter(pl.col("end").is_null()).height == 1


def test_where_no_event_was_lost_a_callback_took_its_next_message_itself() -> None:
    """As a shaping node does, which takes what comes while it holds a message."""
    story = relayed(PAIR, looks=False)
    flow = data_flow(story.tables(), complete=True)
    (relay,) = flow.objects.callbacks.filter(node="/relay")["callback_id"]
    own = flow.instances.filter(callback_id=relay)
    assert (own["end"] - own["start"]).to_list() == [30] * 4 + [130] + [30] * 14
    assert not [note for note in flow.notes if "took the next message" in note]


def test_another_callback_of_the_thread_proves_it_too() -> None:
    """No event of executors is there, but of a timer of the same thread."""
    story = relayed(PAIR | {("take", 600)}, looks=False)
    timer = story.timer(story.node("/timer", 2), 100)
    for time in range(50, 2001, 100):
        story.runs(timer, time, time + 10)
    assert longest(story) == (19, 1, 30)


def spinning(every: int) -> tuple[Story, Callback, Publisher]:
    """A timer whose callback waits for an answer, in every ``every``-th of 20 instances."""
    story = Story()
    timer, x = story.source("/t", 2, "/x")
    for number in range(20):
        time = 100 + 100 * number
        story.start(timer, time)
        if number % every == 0:
            waits(story, time + 20)
        publishes = time + 60 if number % every == 0 else time + 15
        story.publish(x, publishes)
        story.end(timer, publishes + 10)
        waits(story, time + 80)
    return story, timer, x


def test_a_callback_that_spins_an_executor_itself_is_as_long_as_it_is() -> None:
    for every in (1, 2, 4):
        story, _, _ = spinning(every)
        assert longest(story, "/t") == (20, 0, 70)
        flow = data_flow(story.tables())
        assert flow.publications["instance"].to_list() == list(range(20))
