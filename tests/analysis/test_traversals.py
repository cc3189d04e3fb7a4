"""Traversals of chains: hand-made runs with answers worked out by hand."""

from dataclasses import dataclass, field

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from story import Node, Story
from test_messages import hand_over, intra_process, receive

from chainshaper.analysis import (
    LatencyAnalysis,
    Traversals,
    analyse_latency,
    data_flow,
    find_chain,
    graph_of,
    reception,
    traverse,
)


@dataclass
class Relay:
    """/source (timer, process 1) → /t1 → /relay (process 2) → /t2 → /sink (process 3)."""

    story: Story = field(default_factory=Story)

    def __post_init__(self) -> None:
        story = self.story
        source, relay, sink = (
            story.node(name, pid) for pid, name in enumerate(("/source", "/relay", "/sink"), 1)
        )
        self.timer, self.t1 = story.timer(source), story.publisher(source, "/t1")
        self.relay, self.t2 = story.subscription(relay, "/t1"), story.publisher(relay, "/t2")
        self.sink = story.subscription(sink, "/t2")

    def send(self, start: int, *sent: int, end: int | None = None) -> None:
        writes = tuple((self.t1, time) for time in sent)
        self.story.runs(self.timer, start, end or max((start, *sent)) + 1, writes=writes)

    def forward(self, start: int, reads: int, *sent: int, end: int | None = None) -> None:
        writes = tuple((self.t2, time) for time in sent)
        self.story.runs(
            self.relay, start, end or max((start, *sent)) + 1, reads=reads, writes=writes
        )

    def traversals(self, spec: str = "/t1../t2") -> Traversals:
        return traversals(self.story, spec)


def traversals(story: Story, spec: str) -> Traversals:
    flow = data_flow(story.tables())
    graph = graph_of(flow)
    return traverse(flow, find_chain(graph, spec), graph)


def spans(found: Traversals) -> list[tuple[int, int | None]]:
    return list(found.frame.select("start", "end").iter_rows())


def reasons(found: Traversals) -> list[tuple[int, str | None, str | None]]:
    return list(found.frame.select("start", "broken_at", "reason").iter_rows())


def test_a_message_goes_through() -> None:
    # Starts at 10, published at 12, taken at 19, forwarded in [20, 31) at 30: latency 20.
    run = Relay()
    run.send(10, 12)
    run.forward(20, 12, 30)
    found = run.traversals()
    assert found.frame.select("start", "end", "latency_ns", "complete").rows() == [
        (10, 30, 20, True)
    ]
    columns = ["hop", "take", "start", "publish", "end", "communication_ns", "computation_ns"]
    assert found.hops.select(columns).rows() == [
        (0, None, 10, 12, 13, None, 2),
        (1, 19, 20, 30, 31, 8, 10),
    ]


def test_lost_messages_leave_incomplete_traversals() -> None:
    # The message of 12 is never taken, that of 112 is; 212 comes too late to be taken.
    run = Relay()
    for start in (10, 110, 210):
        run.send(start, start + 2)
    run.forward(120, 112, 130)
    found = run.traversals()
    assert spans(found) == [(10, None), (110, 130), (210, None)]
    assert reasons(found) == [(10, "/t1", "lost"), (110, None, None), (210, "/t1", "not taken")]


def test_taken_but_not_executed() -> None:
    run = Relay()
    run.send(10, 12)
    run.story.take(run.relay, 19, sent=12)
    run.send(110, 112)
    run.forward(120, 112, 130)
    assert reasons(run.traversals())[0] == (10, "/t1", "not executed")


def test_unfinished_and_silent_hops() -> None:
    # The first relay instance ends without publishing, the second is still running.
    run = Relay()
    for start in (10, 110, 210):
        run.send(start, start + 2)
    run.forward(20, 12)
    run.forward(120, 112, 130)
    run.story.runs(run.relay, 220, None, reads=212)
    assert reasons(run.traversals()) == [
        (10, "/t2", "not published"),
        (110, None, None),
        (210, "/t2", "still running"),
    ]


def test_first_callbacks_that_publish_nothing_begin_no_traversal() -> None:
    run = Relay()
    run.send(10)
    run.send(110, 112)
    run.forward(120, 112, 130)
    found = run.traversals()
    assert spans(found) == [(110, 130)]
    assert found.silent == 1


def test_a_first_callback_that_is_still_running_does_begin_one() -> None:
    run = Relay()
    run.send(10, 12)
    run.forward(20, 12, 30)
    run.story.start(run.timer, 110)
    assert reasons(run.traversals())[1] == (110, "/t1", "still running")


def test_publishing_twice_makes_two_traversals() -> None:
    # One instance publishes at 12 and 14; the relay answers the first once, the second twice.
    run = Relay()
    run.send(10, 12, 14)
    run.forward(20, 12, 30)
    run.forward(40, 14, 50, 52)
    assert spans(run.traversals()) == [(10, 30), (10, 50), (10, 52)]


def test_pipelined_cycles_with_latency_beyond_the_period() -> None:
    # Period 10, latency 25: cycle 1 starts before cycle 0 ends, in overlapping processes.
    run = Relay()
    for start in (0, 10, 20):
        run.send(start, start + 1, end=start + 9)
    for start in (15, 25, 35):
        run.forward(start, start - 14, start + 10, end=start + 10)
    found = run.traversals()
    assert spans(found) == [(0, 25), (10, 35), (20, 45)]
    assert found.frame["latency_ns"].to_list() == [25, 25, 25]


def test_messages_that_overtake_each_other() -> None:
    run = Relay()
    run.send(10, 12)
    run.send(20, 22)
    run.forward(30, 22, 35)
    run.forward(40, 12, 45)
    assert spans(run.traversals()) == [(10, 45), (20, 35)]


def test_a_recreated_subscription_continues_the_chain() -> None:
    run = Relay()
    run.send(10, 12)
    run.forward(20, 12, 30)
    node = Node(2, run.story.rows["rcl_node_init"][1]["node_handle"])
    run.relay = run.story.subscription(node, "/t1", time=50)
    run.send(110, 112)
    run.forward(120, 112, 130)
    assert spans(run.traversals()) == [(10, 30), (110, 130)]


def test_a_python_node_in_the_chain() -> None:
    # /py emits no callback events: its instance is assumed to begin with the take at 19.
    story = Story()
    source, python = story.node("/source", 1), story.node("/py", 2)
    timer, t1 = story.timer(source), story.publisher(source, "/t1")
    taker, t2 = story.subscription(python, "/t1", callbackless=True), story.publisher(python, "/t2")
    for cycle in (0, 100):
        story.runs(timer, cycle + 10, cycle + 13, writes=((t1, cycle + 12),))
        story.take(taker, cycle + 19, sent=cycle + 12)
        story.publish(t2, cycle + 30)
    found = traversals(story, "/t1../t2")
    assert spans(found) == [(10, 30), (110, 130)]
    assert found.hops.filter(hop=1)["start"].to_list() == [19, 119]


def test_a_driver_that_publishes_from_a_thread_of_its_own() -> None:
    # No callback of /driver publishes /t1: the chain is measured from the publications.
    story = Story()
    driver, relay = story.node("/driver", 1), story.node("/relay", 2)
    t1, t2 = story.publisher(driver, "/t1"), story.publisher(relay, "/t2")
    forward = story.subscription(relay, "/t1")
    for cycle in (0, 100):
        story.publish(t1, cycle + 12, tid=77)
        story.runs(forward, cycle + 20, cycle + 31, reads=cycle + 12, writes=((t2, cycle + 30),))
    found = analyse_latency(story.tables(), "/t1../t2")
    assert found.traversals.select("start", "end").rows() == [(12, 30), (112, 130)]
    assert found.silent == 0
    assert "outside its callbacks" in found.notes[0]
    labels = [callback.label for callback in found.graph.callbacks]
    assert labels == ["/relay ← /t1", "/driver outside callbacks"]


def test_intra_process_hops_and_overwritten_messages() -> None:
    # A buffer of one place: the message of 22 overwrites that of 12 before it was read.
    story = Story()
    publisher, twin, buffer = intra_process(story, capacity=1)
    node = Node(1, story.rows["rcl_node_init"][0]["node_handle"])
    timer, out = story.timer(node), story.publisher(node, "/y")
    for start, overwritten in ((10, 0), (20, 1)):
        story.start(timer, start)
        hand_over(story, publisher, start + 2, buffer, 0, overwritten=overwritten)
        story.end(timer, start + 5)
    receive(story, twin, 40, buffer, 0)
    story.publish(out, 42)
    found = traversals(story, "/x../y")
    assert reasons(found) == [(10, "/x", "overwritten"), (20, None, None)]
    assert spans(found) == [(10, None), (20, 42)]


def test_messages_stored_for_a_timer() -> None:
    # The node's subscription publishes nothing, its timer publishes at 50 and 150.
    story = Story()
    source, node = story.node("/source", 1), story.node("/cyclic", 2)
    timer, t1 = story.timer(source), story.publisher(source, "/t1")
    store, cyclic = story.subscription(node, "/t1"), story.timer(node, period=50)
    out = story.publisher(node, "/out")
    for cycle in (0, 100):
        story.runs(timer, cycle + 10, cycle + 13, writes=((t1, cycle + 12),))
        story.runs(store, cycle + 20, cycle + 22, reads=cycle + 12)
        story.runs(cyclic, cycle + 45, cycle + 51, writes=((out, cycle + 50),))
    assert spans(traversals(story, "/t1../out")) == [(10, 50), (110, 150)]


def test_reception_is_when_the_subscribers_callback_starts() -> None:
    # Published at 30 and 130; the sink's callback starts at 36, the second message is lost.
    run = Relay()
    for cycle in (0, 100):
        run.send(cycle + 10, cycle + 12)
        run.forward(cycle + 20, cycle + 12, cycle + 30)
    run.story.runs(run.sink, 36, 40, reads=30)
    flow = data_flow(run.story.tables())
    graph = graph_of(flow)
    found = traverse(flow, find_chain(graph, "/t1../t2"), graph)
    assert reception(flow, found, graph)["received"].to_list() == [36, None]
    assert reception(flow, found, graph, "/sink")["reception_ns"].to_list() == [26, None]
    assert reception(flow, found, graph, "/relay")["received"].to_list() == [None, None]


def test_the_whole_analysis_in_one_call() -> None:
    run = Relay()
    for cycle in (0, 100):
        run.send(cycle + 10, cycle + 12)
    run.forward(20, 12, 30)
    run.story.runs(run.sink, 36, 40, reads=30)
    found: LatencyAnalysis = analyse_latency(run.story.tables(), "/t1../t2")
    assert (found.statistics.count, found.statistics.incomplete) == (1, 1)
    assert found.statistics.mean_ns == 20
    assert found.incomplete == {"not taken": 1}
    assert found.subscriber is not None
    assert found.subscriber.max_ns == 26
    assert found.traversals["disturbed"].to_list() == [False, False]


# -- against an obvious reference ---------------------------------------------------------------


@dataclass(frozen=True)
class Cycle:
    """One cycle of a random run: when within it messages are sent, and what becomes of them."""

    sent: list[int]
    taken: bool
    delay: int
    forwarded: int


CYCLES = st.lists(
    st.builds(
        Cycle,
        sent=st.lists(st.integers(1, 9), max_size=2, unique=True),
        taken=st.booleans(),
        delay=st.integers(1, 60),
        forwarded=st.integers(0, 2),
    ),
    max_size=12,
)


@settings(max_examples=25, deadline=None)
@given(CYCLES)
def test_traversals_agree_with_following_each_message_by_hand(cycles: list[Cycle]) -> None:
    """A random pipelined run of period 10; what must come out is noted while it is told."""
    run = Relay()
    run.send(10, 12)  # so that every callback is seen to publish its topic
    run.forward(20, 12, 30)
    expected = [(10, 30)]
    incomplete, free, silent = 0, 0, 0
    for index, cycle in enumerate(cycles):
        start = 100 + index * 10
        sent = sorted(start + time for time in cycle.sent)
        run.send(start, *sent, end=start + 10)
        silent += not sent
        for time in sent:
            if not cycle.taken:
                incomplete += 1
                continue
            begin = max(time + cycle.delay, free) + 2
            outputs = [begin + 1 + k for k in range(cycle.forwarded)]
            run.forward(begin, time, *outputs, end=begin + 4)
            free = begin + 4
            expected += [(start, output) for output in outputs]
            incomplete += not outputs
    found = run.traversals()
    complete = found.frame.filter(pl.col("complete"))
    assert sorted(complete.select("start", "end").iter_rows()) == sorted(expected)
    assert found.frame.height - complete.height == incomplete
    assert found.silent == silent
    shares = found.hops.group_by("traversal").agg(
        total=pl.col("communication_ns").sum() + pl.col("computation_ns").sum()
    )
    joined = complete.join(shares, on="traversal")
    assert joined["total"].to_list() == joined["latency_ns"].to_list()


@pytest.mark.parametrize("spec", ["/t1../t2", "/source../sink", "/source../t2", "/t1../relay"])
def test_ways_to_write_the_same_chain(spec: str) -> None:
    run = Relay()
    run.send(10, 12)
    run.forward(20, 12, 30)
    assert spans(run.traversals(spec)) == [(10, 30)]
