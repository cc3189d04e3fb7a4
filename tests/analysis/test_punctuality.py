"""When outputs were due, and which came late: stories whose every instant is known by hand."""

from typing import Any

import pytest
from story import OFFSET, Story

from chainshaper.analysis import LatencyAnalysis, analyse_latency
from chainshaper.analysis.disturbance import Due

PERIOD = 1_000


def _chain(
    outputs: list[tuple[int, int]], gated: list[dict[str, Any]] | None = None, period: int = PERIOD
) -> Story:
    """/source starts at ``outputs[i][0]``, and /gate publishes /out at ``outputs[i][1]``.

    ``gated`` are the fields of the gate's decisions; the message is at the gate 100 later.
    """
    story = Story()
    source, gate = story.node("/source", 1), story.node("/gate", 2)
    timer, raw = story.timer(source, period=period), story.publisher(source, "/raw")
    hold, out = story.subscription(gate, "/raw"), story.publisher(gate, "/out")
    for number, (start, end) in enumerate(outputs):
        story.runs(timer, start, start + 60, writes=((raw, start + 50),))
        story.runs(hold, start + 100, end + 10, reads=start + 50, writes=((out, end),), tid=number)
        if gated is not None:
            usual = {"slot": 0, "cycles_waited": 0, "anchor": "stamp", "overrun": None}
            found = {"arrival": start + 100, "origin": start, "release": end, **gated[number]}
            story.event(
                "gate_release",
                end,
                2,
                callback=hold.handle,
                source_timestamp=start + 50 + OFFSET,
                **{**usual, **found},
            )
    return story


def _analysed(story: Story, due: Due | None = None) -> LatencyAnalysis:
    found = analyse_latency(story.tables(), "/raw../out", OFFSET, due=() if due is None else (due,))
    assert found.statistics.incomplete == 0
    return found


def _late(story: Story, due: Due | None = None) -> list[bool | None]:
    return _analysed(story, due).traversals["late"].to_list()


SLOT = Due(PERIOD, slots=((300, 310),))
OUTPUTS = [(1_000, 1_300), (2_000, 2_315), (3_000, 4_300)]


def test_what_a_gate_let_go_behind_its_slot_is_late() -> None:
    """In its slot; in it but published behind it; a period later; at once, behind the slot."""
    outputs = [*OUTPUTS, (5_000, 5_400)]
    gated: list[dict[str, Any]] = [
        {},
        {"release": 2_300},
        {"overrun": "wait", "cycles_waited": 1, "arrival": 3_350},
        {"overrun": "publish", "arrival": 5_400, "slot": None},
    ]
    found = _analysed(_chain(outputs, gated), SLOT)
    assert found.traversals["late"].to_list() == [False, True, True, True]
    assert found.traversals["place_ns"].to_list() == [300, 315, 1_300, 400]
    assert found.traversals["due_at"].to_list() == [1_300, 2_300, 3_300, 5_300]
    assert (found.statistics.late, found.undisturbed.late) == (3, 3)
    # Without the plan the gate's own word remains, and when others were due.
    found = _analysed(_chain(outputs, gated))
    assert found.traversals["late"].to_list() == [False, False, True, True]
    assert found.traversals["due_at"].to_list() == [1_300, 2_300, 3_300, 5_300]


def test_with_the_anchor_cycle_the_cycle_counts_in_which_the_chain_began() -> None:
    """The gate takes the third for an output of the cycle that it arrives in, and in time."""
    cycle = Due(PERIOD, slots=((300, 310),), from_cycle=True)
    gated = [
        {"anchor": "cycle", "origin": 980},
        {"anchor": "cycle", "origin": 2_010, "release": 2_310},
        {"anchor": "cycle", "origin": 4_000, "arrival": 4_020},
    ]
    outputs = [(1_000, 1_280), (2_000, 2_312), (3_000, 4_300)]
    found = _analysed(_chain(outputs, gated), cycle)
    assert found.traversals["place_ns"].to_list() == [300, 302, 1_300]
    assert found.traversals["late"].to_list() == [False, False, True]
    assert found.traversals["due_at"].to_list() == [1_280, 2_310, 3_300]


def test_under_let_an_output_is_due_a_cycle_later() -> None:
    let = Due(PERIOD, cycles=1, slots=((0, 10),))
    gated: list[dict[str, Any]] = [{"cycles_waited": 1}, {"cycles_waited": 2, "overrun": "wait"}]
    assert _late(_chain([(1_000, 2_000), (2_000, 4_000)], gated), let) == [False, True]
    assert _late(_chain([(1_000, 2_000), (2_000, 4_000)]), let) == [False, True], "without a gate"


def test_a_mode_has_a_slot_of_its_own() -> None:
    modes = Due(PERIOD, slots=((200, 210), (300, 310)), last_slot={"fast": 0, "slow": 1})
    outputs = [(1_000, 1_300), (2_000, 2_300)]
    gated: list[dict[str, Any]] = [
        {"mode": "slow", "slot": 1},
        {"mode": "fast", "overrun": "publish", "slot": None},
    ]
    found = _analysed(_chain(outputs, gated), modes)
    assert found.traversals["late"].to_list() == [False, True]
    assert found.traversals["due_at"].to_list() == [1_300, 2_200]


@pytest.mark.parametrize(
    ("due", "late"),
    [
        (None, [False, False, True]),  # a period behind the chain's start
        (Due(2 * PERIOD), [False, False, False]),
        (Due(PERIOD, slots=((300, 310),)), [False, False, True]),  # the cycle, where no gate spoke
    ],
)
def test_without_a_gate_an_output_is_due_within_its_cycle(
    due: Due | None, late: list[bool]
) -> None:
    story = _chain(OUTPUTS)
    assert _late(story, due) == late
    assert _analysed(story, due).statistics.late == sum(late)


def test_nothing_says_when_an_output_was_due_where_no_timer_starts_the_chain() -> None:
    story = Story()
    source, gate = story.node("/source", 1), story.node("/gate", 2)
    ticks, raw = story.subscription(source, "/ticks"), story.publisher(source, "/raw")
    hold, out = story.subscription(gate, "/raw"), story.publisher(gate, "/out")
    story.runs(ticks, 1_000, 1_060, writes=((raw, 1_050),))
    story.runs(hold, 1_100, 1_310, reads=1_050, writes=((out, 1_300),))
    found = _analysed(story)
    assert found.traversals["late"].to_list() == [None]
    assert found.statistics.late is None


def test_a_late_output_waits_through_a_stall_and_is_not_excused() -> None:
    """The third leaves a period late, and the machine stalls while it waits for that."""
    gated: list[dict[str, Any]] = [{}, {}, {"overrun": "wait", "cycles_waited": 1}]
    story = _chain([(s * 1_000_000, e * 1_000_000) for s, e in OUTPUTS], None, PERIOD * 1_000_000)
    due = Due(PERIOD * 1_000_000, slots=((300_000_000, 310_000_000),))
    story.event("machine_stall", 3_600_000_000, 9, cpu=1, duration=400_000_000)
    found = _analysed(story, due)
    assert found.statistics.disturbed == 1, "without a gate the cycle's end bounds it"
    for number, (start, end) in enumerate(OUTPUTS):
        story.event(
            "gate_release",
            end * 1_000_000,
            2,
            callback=None,
            source_timestamp=start * 1_000_000 + 50 + OFFSET,
            arrival=start * 1_000_000 + 100,
            origin=start * 1_000_000,
            release=end * 1_000_000,
            anchor="stamp",
            **{"slot": 0, "cycles_waited": 0, "overrun": None, **gated[number]},
        )
    found = _analysed(story, due)
    assert (found.statistics.disturbed, found.statistics.late, found.undisturbed.late) == (0, 2, 2)
    assert found.statistics.max_ns == found.undisturbed.max_ns == 1_300_000_000


def _two_gates(same_process: bool, named: bool) -> Story:
    """/source → /g1 → /g2; both gates read messages of one and the same source timestamp."""
    story = Story()
    source = story.node("/source", 1)
    first = story.node("/g1", 2)
    second = story.node("/g2", 2 if same_process else 3)
    timer, raw = story.timer(source, period=PERIOD), story.publisher(source, "/raw")
    one, middle = story.subscription(first, "/raw"), story.publisher(first, "/middle")
    two, out = story.subscription(second, "/middle"), story.publisher(second, "/out")
    for start in (1_000, 2_000):
        story.runs(timer, start, start + 60, writes=((raw, start + 50),))
        story.runs(one, start + 100, start + 210, reads=start + 50, writes=((middle, start + 200),))
        story.runs(
            two, start + 250, start + 410, reads=start + 200, writes=((out, start + 400),), tid=9
        )
        for gate, sent, arrival, release in ((one, 50, 100, 200), (two, 200, 250, 400)):
            story.event(
                "gate_release",
                start + release,
                gate.pid,
                callback=gate.handle if named else None,
                source_timestamp=start + sent + OFFSET,
                arrival=start + arrival,
                origin=start,
                release=start + release,
                slot=0,
                cycles_waited=0,
                anchor="stamp",
                overrun=None,
            )
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
    for table in ("rmw_publish", "rmw_take", "rmw_take_with_info", "gate_release"):
        for row in story.rows.get(table, []):
            for name in ("timestamp", "source_timestamp"):
                if row.get(name) in {1_050 + OFFSET, 2_050 + OFFSET}:
                    row[name] = 1_050 + OFFSET
    found = analyse_latency(story.tables(), "/raw../out", OFFSET)
    arrivals = dict(found.releases.select("traversal", "arrival").rows())
    starts = dict(found.hops.filter(found.hops["hop"] == 1).select("traversal", "start").rows())
    assert arrivals == starts
