"""Traversals of chains: hand-made runs with answers worked out by hand."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from story import OFFSET, Callback, Node, Publisher, Story
from test_messages import hand_over, intra_process, receive

from chainshaper.analysis import analyse_latency, data_flow, find_chain, graph_of, traverse
from chainshaper.analysis.traversals import Traversals
from chainshaper.monitor.budgets import (
    LEAST_MISSING,
    Budget,
    ChainBudget,
    check_budget,
    propose_budget,
)
from chainshaper.reporting.latency import breakdown_json, breakdown_table
from chainshaper.values.recording import RecordingInfo, write_recording

PARTS = ["communication_ns", "computation_ns", "waiting_ns"]


@dataclass
class Relay:
    """/source (timer, process 1) → /t1 → /relay (process 2) → /t2 → /sink (process 3)."""

    story: Story = field(default_factory=Story)

    def __post_init__(self) -> None:
        self.timer, self.t1 = self.story.source("/source", 1, "/t1")
        self.relay, self.t2 = self.story.relay("/relay", 2, "/t1", "/t2")
        self.sink = self.story.subscription(self.story.node("/sink", 3), "/t2")

    def send(self, start: int, *sent: int, end: int | None = None) -> None:
        writes = tuple((self.t1, time) for time in sent)
        self.story.runs(self.timer, start, end or max((start, *sent)) + 1, writes=writes)

    def forward(self, start: int, reads: int, *sent: int, end: int | None = None) -> None:
        end, writes = end or max((start, *sent)) + 1, tuple((self.t2, time) for time in sent)
        self.story.runs(self.relay, start, end, reads=reads, writes=writes)

    def cycle(self, begin: int = 0) -> None:
        """Starts at 10, published at 12, taken at 19, forwarded in [20, 31) at 30: latency 20."""
        self.send(begin + 10, begin + 12)
        self.forward(begin + 20, begin + 12, begin + 30)

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


@pytest.mark.parametrize("spec", ["/t1../t2", "/source../sink", "/source../t2", "/t1../relay"])
def test_a_message_goes_through(spec: str) -> None:
    run = Relay()
    run.cycle()
    found = run.traversals(spec)
    assert found.frame.select("start", "end", "latency_ns", "complete").rows() == [
        (10, 30, 20, True)
    ]
    columns = ["hop", "take", "start", "publish", "end", *PARTS]
    assert found.hops.select(columns).rows() == [
        (0, None, 10, 12, 13, None, 2, 0),
        (1, 19, 20, 30, 31, 8, 10, 0),
    ]


def _lost(run: Relay) -> None:
    """The message of 12 is never taken, that of 112 is; 212 comes too late to be taken."""
    run.send(10, 12)
    run.cycle(100)
    run.send(210, 212)


def _not_executed(run: Relay) -> None:
    run.send(10, 12)
    run.story.take(run.relay, 19, sent=12)
    run.cycle(100)


def _unfinished(run: Relay) -> None:
    """The first relay instance ends without publishing, the second is still running."""
    run.send(10, 12)
    run.forward(20, 12)
    run.cycle(100)
    run.send(210, 212)
    run.story.runs(run.relay, 220, None, reads=212)


def _first_is_running(run: Relay) -> None:
    run.cycle()
    run.story.start(run.timer, 110)


def _first_is_silent(run: Relay) -> None:
    """A first callback that publishes nothing begins no traversal."""
    run.send(10)
    run.cycle(100)


@pytest.mark.parametrize(
    ("tell", "expected"),
    [
        (_lost, [(10, "/t1", "lost"), (110, None, None), (210, "/t1", "not taken")]),
        (_not_executed, [(10, "/t1", "not executed"), (110, None, None)]),
        (
            _unfinished,
            [(10, "/t2", "not published"), (110, None, None), (210, "/t2", "still running")],
        ),
        (_first_is_running, [(10, None, None), (110, "/t1", "still running")]),
        (_first_is_silent, [(110, None, None)]),
    ],
)
def test_incomplete_traversals_say_where_and_why(
    tell: Callable[[Relay], None], expected: list[tuple[int, str | None, str | None]]
) -> None:
    run = Relay()
    tell(run)
    found = run.traversals()
    assert (reasons(found), found.silent) == (expected, int(tell is _first_is_silent))


def _overtaking(run: Relay) -> None:
    run.send(10, 12)
    run.send(20, 22)
    run.forward(30, 22, 35)
    run.forward(40, 12, 45)


def _recreated(run: Relay) -> None:
    run.cycle()
    node = Node(2, run.story.rows["rcl_node_init"][1]["node_handle"])
    run.relay = run.story.subscription(node, "/t1", time=50)
    run.cycle(100)


@pytest.mark.parametrize(
    ("tell", "expected"),
    [(_overtaking, [(10, 45), (20, 35)]), (_recreated, [(10, 30), (110, 130)])],
)
def test_every_message_is_followed(
    tell: Callable[[Relay], None], expected: list[tuple[int, int]]
) -> None:
    run = Relay()
    tell(run)
    assert spans(run.traversals()) == expected


def test_a_python_node_in_the_chain() -> None:
    # /py emits no callback events: its instance is assumed to begin with the take at 19.
    story = Story()
    timer, t1 = story.source("/source", 1, "/t1")
    taker, t2 = story.relay("/py", 2, "/t1", "/t2", callbackless=True)
    for cycle in (0, 100):
        story.runs(timer, cycle + 10, cycle + 13, writes=((t1, cycle + 12),))
        story.take(taker, cycle + 19, sent=cycle + 12)
        story.publish(t2, cycle + 30)
    found = traversals(story, "/t1../t2")
    assert spans(found) == [(10, 30), (110, 130)]
    assert found.hops.filter(hop=1)["start"].to_list() == [19, 119]
    assert "without callback events" in data_flow(story.tables()).notes[0]


def test_messages_that_rmw_takes_without_an_event_are_counted() -> None:
    """As Lyrical's rmw_fastrtps_cpp does with those that have bytes; others have theirs."""
    story = Story()
    reader = story.subscription(story.node("/a", 1), "/t1")
    other = story.subscription(story.node("/b", 2), "/t1")
    for time in range(10, 200, 10):
        story.event("rcl_take", time + 2, 1, message=1)
        story.event("rcl_take", time + 2, 2, message=1)
        story.take(other, time + 1, sent=time)
    story.take(reader, 11, sent=10)
    (note,) = data_flow(story.tables()).notes
    assert note.startswith("19 messages were taken without an event of rmw")


def test_a_driver_that_publishes_from_a_thread_of_its_own() -> None:
    # No callback of /driver publishes /t1: the chain is measured from the publications.
    story = Story()
    t1 = story.publisher(story.node("/driver", 1), "/t1")
    forward, t2 = story.relay("/relay", 2, "/t1", "/t2")
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
    timer, t1 = story.source("/source", 1, "/t1")
    node = story.node("/cyclic", 2)
    store, cyclic = story.subscription(node, "/t1"), story.timer(node, period=50)
    out = story.publisher(node, "/out")
    for cycle in (0, 100):
        story.runs(timer, cycle + 10, cycle + 13, writes=((t1, cycle + 12),))
        story.runs(store, cycle + 20, cycle + 22, reads=cycle + 12)
        story.runs(cyclic, cycle + 45, cycle + 51, writes=((out, cycle + 50),))
    assert spans(traversals(story, "/t1../out")) == [(10, 50), (110, 150)]


def stored_twice(cycles: int = 10, unit: int = 1) -> Story:
    """A camera every 50, whose messages are stored; a timer every 100, which publishes at 84."""
    story = Story()
    camera, image = story.source("/camera", 1, "/image", 50 * unit)
    node = story.node("/planner", 2)
    store, timer = story.subscription(node, "/image"), story.timer(node, period=100 * unit)
    out = story.publisher(node, "/plan")
    for begin in range(1_000 * unit, (1_000 + 100 * cycles) * unit, 100 * unit):
        for sent in (begin + 2 * unit, begin + 52 * unit):
            story.runs(camera, sent - 2 * unit, sent + 2 * unit, writes=((image, sent),))
            story.runs(store, sent + 5 * unit, sent + 8 * unit, reads=sent)
        done = ((out, begin + 84 * unit),)
        story.runs(timer, begin + 80 * unit, begin + 85 * unit, writes=done)
    return story


def test_of_several_messages_stored_for_a_timer_the_newest_counts() -> None:
    found = analyse_latency(stored_twice().tables(), "/image../plan")
    assert found.traversals["latency_ns"].to_list() == [None, 34] * 10, "not 34 and 84 in turns"
    assert found.incomplete == {"not used": 10}
    assert found.traversals["broken_at"].to_list() == ["/plan", None] * 10
    counted = found.statistics.count, found.statistics.incomplete, found.silent
    assert counted == (10, 10, 0), "none disappears"
    last = found.hops.filter(pl.col("hop") == 1).drop_nulls("publish")
    assert last.select(PARTS).rows() == [(5, 3 + 4, 20)] * 10


def test_what_waited_and_what_was_not_used_in_budget_table_and_page(tmp_path: Path) -> None:
    ms = 1_000_000
    info = RecordingInfo(source="lttng", clock_offset_ns=OFFSET)
    recording = write_recording(tmp_path / "recording", stored_twice(unit=ms).tables(), info)
    (chain,) = propose_budget(recording, ["/image../plan"]).chains
    assert (chain.missing, chain.hops[0].waiting_ns) == (LEAST_MISSING, None)
    limits = (chain.hops[1].computation_ns, chain.hops[1].waiting_ns)
    assert limits == pytest.approx((7.7 * ms, 22 * ms), rel=0.01)
    shorter = chain.hops[1].model_copy(update={"waiting_ns": 19 * ms})
    budget = Budget(chains=(chain.model_copy(update={"hops": (shorter,)}),))
    (broken,) = [one for one in check_budget(recording, budget) if not one.met]
    assert (broken.figure, broken.measured) == ("waiting of /plan", 20 * ms)
    budget = Budget(chains=(ChainBudget(chain="/image../plan", maximum_ns=ms),))
    (broken,) = check_budget(recording, budget)
    assert broken.because == "its longest hop is /planner (20 ms of waiting on average to /plan)"
    analysis = analyse_latency(recording, "/image../plan")
    titles = [column.title for column in breakdown_table(analysis).columns]
    assert "waiting\nmean" in titles
    values = breakdown_json(analysis)
    assert (values["hops"][1]["waiting_ns"]["max"], round(values["waiting_share"], 3)) == (
        20 * ms,
        round(20 / 34, 3),
    )


def two_lefts(symbol: str) -> Story:
    """Two messages of the left input in each set, 82 and 42 before the output."""
    run = Fusion(symbol)
    for begin in (1_000, 1_300):
        left, points = run.timers["left"]
        for start in (begin, begin + 40):
            run.story.runs(left, start, start + 10, writes=((points, start + 8),))
            run.story.runs(run.inputs["left"], start + 12, start + 15, reads=start + 8)
        right, points = run.timers["right"]
        run.story.runs(right, begin + 60, begin + 70, writes=((points, begin + 68),))
        done = ((run.fused, begin + 82),)
        run.story.runs(run.inputs["right"], begin + 80, begin + 83, reads=begin + 68, writes=done)
    return run.story


def test_a_synchroniser_of_the_application_s_own_has_the_newest_input() -> None:
    found = traversals(two_lefts("Fusion::left(Cloud)"), LEFT)
    assert found.frame["latency_ns"].to_list() == [None, 42] * 2
    assert found.notes == ()


def test_which_message_a_queue_had_in_its_set_no_event_says() -> None:
    found = traversals(two_lefts(MESSAGE_FILTER), LEFT)
    assert found.frame["latency_ns"].to_list() == [82, 42] * 2
    assert [note.partition(":")[0] for note in found.notes] == [
        "2 messages on /left/points count with the same publication on /fused as another one"
    ]


def test_the_whole_analysis_with_the_reception_of_a_subscriber() -> None:
    # Published at 30 and 130; the sink's callback starts at 36, the second message is lost.
    run = Relay()
    run.cycle()
    run.cycle(100)
    run.send(210, 212)
    run.story.runs(run.sink, 36, 40, reads=30)
    found = analyse_latency(run.story.tables(), "/t1../t2")
    counts = found.statistics.count, found.statistics.incomplete, found.statistics.mean_ns
    assert (counts, found.incomplete) == ((2, 1, 20), {"not taken": 1})
    assert found.subscriber is not None
    assert found.subscriber.max_ns == 26
    assert found.traversals["received"].to_list() == [36, None, None]
    assert not found.traversals["disturbed"].any()


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
    run.cycle()  # so that every callback is seen to publish its topic
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
    parts = pl.sum_horizontal(pl.col(PARTS).sum())
    joined = complete.join(found.hops.group_by("traversal").agg(total=parts), on="traversal")
    assert joined["total"].to_list() == joined["latency_ns"].to_list()


# -- synchronising callbacks: which publication a message goes into -----------------------------

MESSAGE_FILTER = "message_filters::Subscriber<Cloud>::subscribe(rclcpp::Node*)::{lambda()#1}"
LEFT, RIGHT = "/left/points../fused", "/right/points../fused"


@dataclass
class Fusion:
    """/left and /right (timers) → /fusion, whose two inputs publish /fused together."""

    symbol: str | None = None
    story: Story = field(default_factory=Story)

    def __post_init__(self) -> None:
        story = self.story
        self.timers: dict[str, tuple[Callback, Publisher]] = {}
        for pid, side in enumerate(("left", "right"), 1):
            node = story.node(f"/{side}", pid)
            self.timers[side] = (story.timer(node), story.publisher(node, f"/{side}/points"))
        self.create()

    def create(self, time: int = 0) -> None:
        fusion = self.story.node("/fusion", pid=3, time=time)
        self.fused = self.story.publisher(fusion, "/fused", time=time)
        self.inputs = {
            side: self.story.subscription(fusion, f"/{side}/points", time=time, symbol=self.symbol)
            for side in ("left", "right")
        }

    def read(self, side: str, sent: int, start: int, published: int | None = None) -> None:
        """Published at ``sent`` (its cycle starts 1 before), read at ``start``."""
        timer, publisher = self.timers[side]
        self.story.runs(timer, sent - 1, sent + 1, writes=((publisher, sent),))
        end, writes = (published or start) + 1, ((self.fused, published or 0),)
        self.story.runs(
            self.inputs[side], start, end, reads=sent, writes=writes if published else ()
        )

    def tell(self, told: str) -> Story:
        """``left 10-20>25``: sent at 10, read at 20, both inputs' set published at 25."""
        for one in told.split(", "):
            side, sent, start, published = re.findall(r"(\w+) (\d+)(?:-(\d+))?(?:>(\d+))?", one)[0]
            if side == "anew":
                self.create(int(sent))
            else:
                self.read(side, int(sent), int(start), int(published) if published else None)
        return self.story


RIGHT_LAST = "left 10-20, right 30-40>45, left 110-120, right 130-140>145"
EITHER_LAST = "left 10-20, right 30-40>45, right 110-120, left 130-140>145"
OWN = "Fusion::on_points(Cloud)"


@pytest.mark.parametrize(
    ("symbol", "told", "spec", "expected"),
    [
        (None, RIGHT_LAST, LEFT, [(9, 45), (109, 145)]),
        (None, RIGHT_LAST, RIGHT, [(29, 45), (129, 145)]),
        # Left completes the second set; message_filters registered both callbacks.
        (MESSAGE_FILTER, EITHER_LAST, LEFT, [(9, 45), (129, 145)]),
        (MESSAGE_FILTER, EITHER_LAST, RIGHT, [(29, 45), (109, 145)]),
        # Two left messages wait for one right message; the third waits for ever.
        (
            *(None, "left 10-20, left 22-25, right 30-40>45, left 110-120", LEFT),
            [(9, 45), (21, 45), (109, None)],
        ),
        # Both are the application's own functions and publish each for itself: the left message of
        # 110 is dropped on purpose, the right one's answer at 145 is not its own.
        (
            *(OWN, "left 10-20>25, right 30-40>45, left 110-120, right 130-140>145", LEFT),
            [(9, 25), (109, None)],
        ),
        # A synchroniser of the application's own: each ran between any two publications.
        (OWN, EITHER_LAST, LEFT, [(9, 45), (129, 145)]),
        (OWN, EITHER_LAST, RIGHT, [(29, 45), (109, 145)]),
        # Left waits at 120 for a right message. The node is destroyed, created again at 200 in the
        # same process, and publishes a set of its own.
        (
            None,
            "left 10-20, right 30-40>45, left 110-120, anew 200, left 310-320, right 330-340>345",
            *(LEFT, [(9, 45), (109, None), (309, 345)]),
        ),
    ],
)
def test_a_synchronised_message_leaves_with_the_input_that_completes_the_set(
    symbol: str | None, told: str, spec: str, expected: list[tuple[int, int | None]]
) -> None:
    found = traversals(Fusion(symbol).tell(told), spec)
    assert spans(found) == expected
    for start, *why in reasons(found):
        assert why == ([None, None] if dict(expected)[start] else ["/fused", "not published"])
    if (told, spec) == (RIGHT_LAST, LEFT):
        assert found.hops.filter(hop=1)["via"].to_list() == ["sibling", "sibling"]
        assert found.notes == ()


def test_waiting_for_the_other_input_is_no_computation() -> None:
    """The right input comes 100 behind the left one; each callback computes for 3."""
    run = Fusion(symbol=MESSAGE_FILTER)
    for begin in (1_000, 1_300):
        for side, start in (("left", begin), ("right", begin + 100)):
            timer, points = run.timers[side]
            run.story.runs(timer, start, start + 10, writes=((points, start + 8),))
        left, right = (run.inputs[side] for side in ("left", "right"))
        run.story.runs(left, begin + 10, begin + 13, reads=begin + 8)
        done = ((run.fused, begin + 112),)
        run.story.runs(right, begin + 110, begin + 113, reads=begin + 108, writes=done)
    for spec, fused in ((LEFT, (2, 5, 97)), (RIGHT, (2, 2, 0))):
        found = traversals(run.story, spec)
        hops = found.hops.filter(pl.col("hop") == 1).select(PARTS)
        assert hops.rows() == [fused, fused], "3 of one callback and 2 of the other"
        assert found.hops.filter(pl.col("hop") == 0).select(PARTS).rows() == [(None, 8, 0)] * 2


@pytest.mark.parametrize("came", [30, 25])
def test_what_a_gate_holds_back_waits(came: int) -> None:
    """Of 45 between start and publication the gate held the message for 33, from its arrival."""
    story = Story()
    timer, t1 = story.source("/source", 1, "/tmp")
    hold, out = story.relay("/gate", 2, "/tmp", "/t1")
    story.runs(timer, 0, 20, writes=((t1, 10),))
    story.runs(hold, 25, 75, reads=10, writes=((out, 70),))
    story.gate(hold, 10, came, 63, origin=0)
    found = traversals(story, "/tmp../t1")
    assert found.hops.select(PARTS).rows() == [(None, 10, 0), (15, 45 - (63 - came), 63 - came)]


def test_outputs_without_a_new_input_give_a_holding_synchroniser_away() -> None:
    # Right publishes at 45 and 65 without a left message between: one of the two earlier left
    # messages was held back, which one the events do not show.
    told = "left 10-20, left 22-25, right 30-40>45, right 50-60>65, left 110-120, right 130-140>145"
    (note,) = traversals(Fusion(MESSAGE_FILTER).tell(told), LEFT).notes
    assert note.startswith("1 of 3 publications on /fused came without a new message")
