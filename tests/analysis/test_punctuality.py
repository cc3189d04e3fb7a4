"""When outputs were due, and which came late: stories whose every instant is known by hand."""

from dataclasses import replace
from typing import Any

import pytest
from story import OFFSET, Story

from chainshaper.analysis import LatencyAnalysis, analyse_latency, data_flow
from chainshaper.analysis.disturbance import Due
from chainshaper.analysis.flow import left_when_taken

PERIOD = 1_000


def _chain(
    outputs: list[tuple[int, int]], gated: list[dict[str, Any]] | None = None, period: int = PERIOD
) -> Story:
    """/source starts at ``outputs[i][0]``, and /gate publishes /out at ``outputs[i][1]``.

    ``gated`` are the fields of the gate's decisions; the message is at the gate 100 later.
    """
    story = Story()
    timer, raw = story.source("/source", 1, "/raw", period)
    hold, out = story.relay("/gate", 2, "/raw", "/out")
    for number, (start, end) in enumerate(outputs):
        story.runs(timer, start, start + 60, writes=((raw, start + 50),))
        story.runs(hold, start + 100, end + 10, reads=start + 50, writes=((out, end),), tid=number)
        if gated is not None:
            found = {"origin": start, "arrival": start + 100, "release": end, **gated[number]}
            story.gate(hold, start + 50, **found)
    return story


def _analysed(story: Story, due: Due | None = None) -> LatencyAnalysis:
    found = analyse_latency(story.tables(), "/raw../out", OFFSET, due=() if due is None else (due,))
    assert found.statistics.incomplete == 0
    return found


SLOT = Due(PERIOD, slots=((300, 310),))
OUTPUTS = [(1_000, 1_300), (2_000, 2_315), (3_000, 4_300)]
CYCLE = replace(SLOT, from_cycle=True)
LET = Due(PERIOD, cycles=1, slots=((0, 10),))
MODES = Due(PERIOD, slots=((200, 210), (300, 310)), last_slot={"fast": 0, "slow": 1})
# In its slot; in it but published behind it; a period later; at once, behind the slot.
BEHIND: list[dict[str, Any]] = [
    {},
    {"release": 2_300},
    {"overrun": "wait", "cycles_waited": 1, "arrival": 3_350},
    {"overrun": "publish", "arrival": 5_400, "slot": None},
]
# The gate takes the third for an output of the cycle that it arrives in, and in time.
BY_CYCLE: list[dict[str, Any]] = [
    {"anchor": "cycle", "origin": 980},
    {"anchor": "cycle", "origin": 2_010, "release": 2_310},
    {"anchor": "cycle", "origin": 4_000, "arrival": 4_020},
]
OF_MODES: list[dict[str, Any]] = [
    {"mode": "slow", "slot": 1},
    {"mode": "fast", "overrun": "publish", "slot": None},
]
A_CYCLE_LATER: list[dict[str, Any]] = [
    {"cycles_waited": 1},
    {"cycles_waited": 2, "overrun": "wait"},
]


FIVE = [*OUTPUTS, (5_000, 5_400)]
TWO = [(1_000, 2_000), (2_000, 4_000)]


@pytest.mark.parametrize(
    ("told", "due", "late", "places", "due_at"),
    [
        ((FIVE, BEHIND), SLOT, "-LLL", [300, 315, 1_300, 400], [1_300, 2_300, 3_300, 5_300]),
        # Without the plan the gate's own word remains, and when others were due.
        ((FIVE, BEHIND), None, "--LL", None, [1_300, 2_300, 3_300, 5_300]),
        (
            ([(1_000, 1_280), (2_000, 2_312), (3_000, 4_300)], BY_CYCLE),
            *(CYCLE, "--L", [300, 302, 1_300], [1_280, 2_310, 3_300]),
        ),
        ((TWO, A_CYCLE_LATER), LET, "-L", None, None),
        ((TWO,), LET, "-L", None, None),
        (([(1_000, 1_300), (2_000, 2_300)], OF_MODES), MODES, "-L", None, [1_300, 2_200]),
        ((OUTPUTS,), None, "--L", None, None),  # a period behind the chain's start
        ((OUTPUTS,), Due(2 * PERIOD), "---", None, None),
        ((OUTPUTS,), SLOT, "--L", None, None),  # the cycle, where no gate spoke
    ],
)
def test_an_output_is_late_behind_its_slot_or_cycle(
    told: tuple[Any, ...],
    due: Due | None,
    late: str,
    places: list[int] | None,
    due_at: list[int] | None,
) -> None:
    found = _analysed(_chain(*told), due)
    assert found.traversals["late"].to_list() == [one == "L" for one in late]
    assert places in (None, found.traversals["place_ns"].to_list())
    assert due_at in (None, found.traversals["due_at"].to_list())
    assert found.statistics.late == found.undisturbed.late == late.count("L")


def test_nothing_says_when_an_output_was_due_where_no_timer_starts_the_chain() -> None:
    story = Story()
    ticks, raw = story.relay("/source", 1, "/ticks", "/raw")
    story.runs(ticks, 1_000, 1_060, writes=((raw, 1_050),))
    found = analyse_latency(story.tables(), "/raw", OFFSET)
    assert found.traversals["late"].to_list() == [None]
    assert found.statistics.late is None


def test_a_late_output_waits_through_a_stall_and_is_not_excused() -> None:
    """The third leaves a period late, and the machine stalls while it waits for that."""
    outputs = [(s * 1_000_000, e * 1_000_000) for s, e in OUTPUTS]
    due = Due(PERIOD * 1_000_000, slots=((300_000_000, 310_000_000),))
    gated: list[dict[str, Any]] = [{}, {}, {"overrun": "wait", "cycles_waited": 1}]
    stall = {"cpu": 1, "duration": 400_000_000}
    without, behind = (_chain(outputs, one, PERIOD * 1_000_000) for one in (None, gated))
    for story in (without, behind):
        story.event("machine_stall", 3_600_000_000, 9, **stall)
    found = _analysed(without, due)
    assert found.statistics.disturbed == 1, "without a gate the cycle's end bounds it"
    found = _analysed(behind, due)
    assert (found.statistics.disturbed, found.statistics.late, found.undisturbed.late) == (0, 2, 2)
    assert found.statistics.max_ns == found.undisturbed.max_ns == 1_300_000_000


def _two_gates(same_process: bool, named: bool) -> Story:
    """/source → /g1 → /g2; both gates read messages of one and the same source timestamp."""
    story = Story()
    timer, raw = story.source("/source", 1, "/raw", PERIOD)
    one, middle = story.relay("/g1", 2, "/raw", "/middle")
    two, out = story.relay("/g2", 2 if same_process else 3, "/middle", "/out")
    nameless = {} if named else {"callback": None}
    for at in (1_000, 2_000):
        story.runs(timer, at, at + 60, writes=((raw, at + 50),))
        story.runs(one, at + 100, at + 210, reads=at + 50, writes=((middle, at + 200),))
        story.runs(two, at + 250, at + 410, reads=at + 200, writes=((out, at + 400),), tid=9)
        story.gate(one, at + 50, at + 100, at + 200, origin=at, **nameless)
        story.gate(two, at + 200, at + 250, at + 400, origin=at, **nameless)
    return story


@pytest.mark.parametrize("same_process", [False, True])
@pytest.mark.parametrize("named", [False, True])
def test_each_hop_finds_the_decision_of_its_own_gate(same_process: bool, named: bool) -> None:
    """A shaping node of ROS 2 does not know its callback's handle."""
    found = analyse_latency(_two_gates(same_process, named).tables(), "/raw../middle../out", OFFSET)
    rows = found.releases.select("traversal", "hop", "arrival", "release").rows()
    assert rows == [
        *((0, 1, 1_100, 1_200), (0, 2, 1_250, 1_400)),
        *((1, 1, 2_100, 2_200), (1, 2, 2_250, 2_400)),
    ]


def test_of_equal_stamps_the_decision_is_meant_that_was_made_there() -> None:
    """A clock that stands still stamps two messages alike, and both go through one gate."""
    story = _chain([(1_000, 1_300), (2_000, 2_300)], [{}, {}])
    for table in ("rmw_publish", "rmw_take", "gate_release"):
        for row in story.rows.get(table, []):
            for name in ("timestamp", "source_timestamp"):
                if row.get(name) in {1_050 + OFFSET, 2_050 + OFFSET}:
                    row[name] = 1_050 + OFFSET
    found = analyse_latency(story.tables(), "/raw../out", OFFSET)
    arrivals = dict(found.releases.select("traversal", "arrival").rows())
    starts = dict(found.hops.filter(found.hops["hop"] == 1).select("traversal", "start").rows())
    assert arrivals == starts


# -- when asynchronous messages left, and what was withheld --


def _sent_by_thread(outcomes: tuple[str | None, ...]) -> Story:
    """A timer publishes at 100, 200, …; its publisher thread deals with that 60 later."""
    story = Story()
    node = story.node("/n", 1)
    timer, t1 = story.timer(node), story.publisher(node, "/t1")
    story.rows["rcl_publisher_init"][0]["asynchronous"] = 1
    listener = story.subscription(story.node("/listener", 2), "/t1")
    for number, outcome in enumerate(outcomes, start=1):
        at = 100 * number
        story.runs(timer, at - 10, at + 5, writes=((t1, at),))
        if outcome is not None:
            sent = {"rmw_publisher_handle": t1.rmw_handle, "timestamp": at + OFFSET}
            story.event("asynchronous_send", at + 60, 1, 11, **sent, outcome=outcome, duration=3)
        if outcome == "sent":
            story.runs(listener, at + 70, at + 75, reads=at)
    return story


@pytest.mark.parametrize(
    ("asynchronous", "outcomes", "latencies", "reasons"),
    [
        (1, ("sent", "sent"), [70, 70], [None, None]),
        (
            *(1, ("sent", "expired", "overwritten", None), [70, None, None, None]),
            [None, "discarded", "discarded", "not sent"],
        ),
        (1, (None, None), [None, None], ["not sent"] * 2),  # a thread that never ran
        (0, (None, None), [10, 10], [None, None]),  # without one publishing is sending
        (None, (None, None), [10, 10], [None, None]),
    ],
)
def test_the_latency_ends_when_the_message_was_sent(
    asynchronous: int | None,
    outcomes: tuple[str | None, ...],
    latencies: list[int | None],
    reasons: list[str | None],
) -> None:
    story = _sent_by_thread(outcomes)
    story.rows["rcl_publisher_init"][0]["asynchronous"] = asynchronous
    found = analyse_latency(story.tables(), "/n../t1", OFFSET)
    rows = found.traversals.select("latency_ns", "reason", "broken_at").rows()
    expected = zip(latencies, reasons, strict=True)
    assert rows == [(latency, why, why and "/t1") for latency, why in expected]
    if outcomes[0]:
        assert found.traversals["reception_ns"][0] == 80
        first = found.hops.select("publish", "end", "computation_ns", "waiting_ns").row(0)
        assert first == (160, 105, 10, 60), "it left when its callback instance had ended"


def test_where_no_event_says_when_it_was_sent_as_in_ros_the_first_reader_does() -> None:
    story = _sent_by_thread(("sent", "sent", None))
    recorded = data_flow(story.tables(), OFFSET)
    assert left_when_taken(recorded, ["/t1"]) is recorded
    del story.rows["asynchronous_send"], story.rows["rcl_publisher_init"][0]["asynchronous"]
    found = analyse_latency(left_when_taken(data_flow(story.tables(), OFFSET), ["/t1"]), "/n../t1")
    assert found.traversals["latency_ns"].to_list() == [79, 79, None], "handed over after 10"
    assert found.incomplete == {"not sent": 1}
    assert "publishes /t1: when it left no event says" in found.notes[-1]


def test_inside_a_chain_waiting_for_the_thread_belongs_to_the_hop_that_publishes() -> None:
    story = _sent_by_thread(("sent", "expired"))
    callback, t2 = story.relay("/relay", 3, "/t1", "/t2")
    story.runs(callback, 180, 190, reads=100, writes=((t2, 185),))
    found = analyse_latency(story.tables(), "/t1../t2", OFFSET)
    rows = found.traversals.select("latency_ns", "reason", "broken_at").rows()
    assert rows == [(95, None, None), (None, "discarded", "/t1")]
    parts = ("communication_ns", "computation_ns", "waiting_ns")
    hops = found.hops.filter(traversal=0).select(parts)
    assert hops.rows() == [(None, 10, 60), (20, 5, 0)], "for the thread it waits"


def test_what_a_gate_discarded_is_not_lost() -> None:
    story = Story()
    timer, t1 = story.source("/source", 1, "/tmp")
    hold, out = story.relay("/gate", 2, "/tmp", "/t1")
    for start, released in ((1_000, 1_060), (1_100, None), (1_200, 1_260)):
        story.runs(timer, start, start + 20, writes=((t1, start + 10),))
        writes = () if released is None else ((out, released),)
        story.runs(hold, start + 30, start + 65, reads=start + 10, writes=writes)
        discarded = {} if released else {"slot": None, "overrun": "discard"}
        story.gate(hold, start + 10, start + 31, released, origin=start, **discarded)
    # An instance that published nothing, of whose message the gate says nothing.
    story.runs(timer, 1_300, 1_320, writes=((t1, 1_310),))
    story.runs(hold, 1_330, 1_365, reads=1_310)
    found = analyse_latency(story.tables(), "/tmp../t1", OFFSET)
    assert found.traversals["latency_ns"].to_list() == [60, None, 60, None]
    assert found.incomplete == {"discarded": 1, "not published": 1}
