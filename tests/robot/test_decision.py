"""The gate's decision: worked by hand, against a walk through time, and what may never be.

What several messages do to each other, and logical execution time, is in `gate_conformance.yaml`.
"""

import time
from dataclasses import replace
from typing import Any

import pytest
from gate_table import Case, Change, walk
from hypothesis import given
from hypothesis import strategies as st
from known import known
from passing import decided, held, serialized

from chainshaper.robot import shaper as shaping
from chainshaper.robot.decision import Release, missed, release_of
from chainshaper.robot.gate import LATE, OVERRUNS, Gate, GateModes, Overrun
from chainshaper.robot.schedules import (
    SCHEDULES,
    Schedule,
    Schedules,
    first_schedule,
    schedule_in_force,
    with_change,
    with_phase_seen,
)
from chainshaper.robot.serialized import origin_of, text_of
from chainshaper.robot.shaper import Shaper

MS, SECOND = 1_000_000, 1_000_000_000

ONE = Gate(slots=((60, 61),), cycle_ns=100)
BANDS = Gate(slots=((20, 25), (25, 30), (80, 100)), cycle_ns=100)
# What comes from 61 on has overrun.
TWO = Gate(slots=((20, 30), (60, 61)), cycle_ns=100)
DISCARD, PUBLISH = replace(TWO, overrun="discard"), replace(TWO, overrun="publish")
# The last slot is the city's.
MODES = GateModes(slots={"city": 2, "village": 1, "highway": 0}, default="city")
MODAL = Gate(slots=((20, 21), (40, 42), (60, 61)), cycle_ns=100, modes=MODES)
MODAL_MS = Gate(
    slots=tuple((start * MS, end * MS) for start, end in MODAL.slots),
    cycle_ns=100 * MS,
    modes=MODES,
)


def announced(*changes: tuple[int, str]) -> Schedules:
    """The schedules of a gate whose modes were announced then."""
    schedules: Schedules = (first_schedule(MODAL),)
    for from_ns, mode in changes:
        schedules = with_change(schedules, from_ns, mode=mode)
    return schedules


def with_late(late: str, overrun: Overrun = "wait") -> Gate:
    return replace(MODAL, overrun=overrun, modes=replace(MODES, late=late))


@st.composite
def gates(draw: st.DrawFn) -> Gate:
    """Small enough that a test can walk through every instant of a few cycles."""
    cycle = draw(st.integers(2, 40))
    cuts = sorted(draw(st.sets(st.integers(0, cycle), min_size=2, max_size=8)))
    return Gate(
        slots=tuple(zip(cuts[::2], cuts[1::2], strict=False)),
        cycle_ns=cycle,
        anchor=draw(st.sampled_from(["stamp", "cycle"])),
        phase_ns=draw(st.integers(-100, 100)),
        due_cycles=draw(st.integers(0, 2)),
    )


ARRIVALS, STAMPS = st.integers(0, 1000), st.none() | st.integers(0, 1000)


# Slots and anchors ------------------------------------------------------------------------------

CYCLIC = replace(ONE, anchor="cycle", phase_ns=7)  # cycles start at 7, 107, …, whatever the stamp
DISCARDED = Release(None, 1000, None, 1, "stamp", "discard", dropped="discarded")


@pytest.mark.parametrize(
    ("gate", "arrival", "stamp", "leaves"),
    [
        (BANDS, 1000, 1000, Release(1020, 1000, 0, 0, "stamp")),  # as early as can be
        (BANDS, 1024, 1000, Release(1024, 1000, 0, 0, "stamp")),  # inside: at once
        (BANDS, 1025, 1000, Release(1025, 1000, 1, 0, "stamp")),  # the next slot begins here
        (BANDS, 1099, 1000, Release(1099, 1000, 2, 0, "stamp")),  # it ends with the cycle
        (BANDS, 1740, 1000, Release(1780, 1000, 2, 7, "stamp", "wait")),  # seven cycles late
        (CYCLIC, 7, 1, Release(67, 7, 0, 0, "cycle")),
        (CYCLIC, 68, 1, Release(167, 7, 0, 1, "cycle", "wait")),
        (CYCLIC, 107, 1, Release(167, 107, 0, 0, "cycle")),
        (CYCLIC, 5, 1, Release(67, -93, 0, 1, "cycle", "wait")),  # before the phase
        # A clock that is ahead by more than a whole cycle: no slot is skipped, none overrun.
        (ONE, 1000, 1150, Release(1210, 1150, 0, 0, "stamp")),
        (DISCARD, 990, 1000, Release(1020, 1000, 0, 0, "stamp")),
        (TWO, 1061, 1000, Release(1120, 1000, 0, 1, "stamp", "wait")),
        (TWO, 1130, 1000, Release(1160, 1000, 1, 1, "stamp", "wait")),
        (DISCARD, 1060, 1000, Release(1060, 1000, 1, 0, "stamp")),  # the last instant
        (DISCARD, 1130, 1000, DISCARDED),
        (PUBLISH, 1130, 1000, Release(1130, 1000, None, 1, "stamp", "publish")),
    ],
)
def test_known_answers(gate: Gate, arrival: int, stamp: int | None, leaves: Release) -> None:
    assert release_of(gate, arrival, stamp) == leaves
    ends = leaves.start_ns(100) + (0 if leaves.slot is None else gate.slots[leaves.slot][1])
    assert missed(gate, leaves, ends - 1) is False
    assert missed(gate, leaves, ends) == (leaves.slot is not None)


def test_a_stamp_is_of_use_that_is_neither_old_nor_far_from_the_future() -> None:
    for due, arrival, stamp, anchor in (
        (0, 1000, None, "cycle"),
        (0, 2000, 1000, "stamp"),  # ten cycles is the oldest, and those it is due after
        (0, 2001, 1000, "cycle"),
        (2, 2200, 1000, "stamp"),
        (2, 2201, 1000, "cycle"),
        (0, 1000, 1000 + MS, "stamp"),
        (0, 1000, 1001 + MS, "cycle"),
    ):
        assert release_of(replace(ONE, due_cycles=due), arrival, stamp).anchor == anchor


@given(gates(), ARRIVALS, STAMPS)
def test_a_message_leaves_at_the_first_instant_inside_a_slot(
    gate: Gate, arrival: int, stamp: int | None
) -> None:
    gate = replace(gate, due_cycles=0)
    release = release_of(gate, arrival, stamp)
    assert release.at_ns is not None
    instant = max(arrival, release.origin_ns)  # no cycle exists before the first one
    while not _inside_a_slot(gate, instant - release.origin_ns):
        instant += 1
    assert release.at_ns == instant
    start, end = gate.slots[known(release.slot)]
    assert start <= release.at_ns - release.start_ns(gate.cycle_ns) < end
    if release.anchor == "stamp":
        assert (gate.anchor, release.origin_ns) == ("stamp", stamp)
    else:
        assert (release.origin_ns - gate.phase_ns) % gate.cycle_ns == 0
        assert 0 <= arrival - release.origin_ns < gate.cycle_ns


def _inside_a_slot(gate: Gate, since_origin: int) -> bool:
    return any(start <= since_origin % gate.cycle_ns < end for start, end in gate.slots)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"slots": ()}, "without slots"),
        ({"cycle_ns": 0}, "longer than nothing"),
        ({"cycle_ns": 60}, "within the cycle"),  # the slot ends after it
        ({"slots": ((60, 60),)}, "must ascend"),  # empty
        ({"slots": ((-1, 60),)}, "within the cycle"),
        ({"slots": ((10, 20), (19, 30))}, "not overlap"),
        ({"anchor": "clock"}, "choose one of stamp, cycle"),
        ({"overrun": "drop"}, "choose one of wait, discard, publish"),
        ({"due_cycles": -1}, "due beforehand"),
        ({"depth": 0}, "for one at least"),
        ({"modes": ({"city": 3}, "city")}, "numbered 1 to 1"),
        ({"modes": ({"city": -1}, "city")}, "numbered 1 to 1"),
        ({"modes": ({"city": 0}, "sea")}, "'sea' has no band: choose one of city"),
        ({"modes": ({"city": 0}, "city", "never")}, "choose one of wait, .*next-slot"),
    ],
)
def test_gates_that_make_no_sense_are_refused(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        replace(
            ONE, **changes | ({"modes": GateModes(*changes["modes"])} if "modes" in changes else {})
        )


# Overruns ---------------------------------------------------------------------------------------


@given(gates(), ARRIVALS, STAMPS)
def test_overruns_are_treated_behind_the_slots_of_the_due_cycle_and_nowhere_else(
    gate: Gate, arrival: int, stamp: int | None
) -> None:
    wait, discard, publish = (
        release_of(replace(gate, overrun=policy), arrival, stamp) for policy in OVERRUNS
    )
    due = gate.due_cycles if wait.anchor == "stamp" else min(gate.due_cycles, 1)
    last_end = wait.origin_ns + due * gate.cycle_ns + gate.slots[-1][1]
    if wait.overrun is None:
        assert wait == discard == publish
        assert wait.at_ns is not None
        assert arrival <= wait.at_ns < max(last_end, arrival + 1)
        cycle, within = divmod(wait.at_ns - wait.origin_ns, gate.cycle_ns)
        assert cycle == due
        assert any(start <= within < end for start, end in gate.slots)
    else:
        assert arrival >= last_end, "it came in time"
        assert (discard.at_ns, publish.at_ns) == (None, arrival)
        assert known(wait.at_ns) >= arrival, "so one handled when another has left leaves behind it"
        assert (discard.overrun, publish.overrun) == ("discard", "publish")


def test_who_wakes_behind_the_slot_discards_what_came_in_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The machine stands still over the slot: the sleep ends late."""
    slot = (20 * MS, 21 * MS)

    def oversleep(deadline_ns: int) -> None:
        while time.monotonic_ns() < deadline_ns + 3 * MS:
            pass

    monkeypatch.setattr(shaping, "sleep_until", oversleep)
    treatments: dict[Overrun, tuple[str | None, int | None, str | None]] = {
        "discard": ("discard", None, "discarded"),
        "wait": (None, 0, None),
        "publish": (None, 0, None),
    }
    for policy, treated in treatments.items():
        shaper = Shaper(Gate(slots=(slot,), cycle_ns=100 * MS, overrun=policy))
        release = held(shaper, serialized(time.time_ns())).release
        assert (release.overrun, release.slot, release.dropped) == treated, policy
        assert (release.at_ns is None) == (release.slot is None)
    never = Shaper(Gate(slots=((0, 1),), cycle_ns=3_600_000 * MS, overrun="discard"))
    one = held(never, serialized(time.time_ns()))
    assert one.release.dropped == "discarded", "without waiting"


# Modes ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("late", "overrun", "arrival", "leaves_at", "slot", "treated"),
    [
        ("wait", "wait", 1020, 1040, 1, None),  # inside the slot of another mode
        ("wait", "wait", 1041, 1041, 1, None),  # the last instant of its own
        # Behind the village's slot, before the city's.
        ("wait", "discard", 1042, 1140, 1, "wait"),
        ("discard", "wait", 1042, None, None, "discard"),
        ("publish", "wait", 1042, 1042, None, "publish"),
        ("next-slot", "discard", 1042, 1060, 2, "next-slot"),
        # Behind the last slot of all: an overrun like any other where the next slot is taken.
        ("next-slot", "wait", 1070, 1140, 1, "wait"),
        ("next-slot", "discard", 1061, None, None, "discard"),
        ("next-slot", "publish", 1061, 1061, None, "publish"),
        ("next-slot", "wait", 1142, 1160, 2, "wait"),  # in the next cycle already
    ],
)
def test_a_message_leaves_in_the_slot_of_its_mode_or_as_said(  # noqa: PLR0917 - a row of the table
    late: str, overrun: Overrun, arrival: int, leaves_at: int | None, slot: int | None, treated: str
) -> None:
    release = release_of(with_late(late, overrun), arrival, 1000, announced((0, "village")))
    assert (release.at_ns, release.slot, release.overrun) == (leaves_at, slot, treated)
    assert release.mode == "village"


def test_a_change_is_in_force_from_the_next_cycle_on() -> None:
    schedules = announced((1000, "highway"), (1150, "village"))
    for cycle, mode in ((900, "city"), (1000, "highway"), (1100, "highway"), (1200, "village")):
        for gate, stamp in ((MODAL, cycle), (replace(MODAL, anchor="cycle"), None)):
            assert release_of(gate, cycle + 10, stamp, schedules).mode == mode
    late = release_of(with_late("publish"), 1175, 1000, schedules)
    assert (late.mode, late.at_ns) == ("highway", 1175), "that of the cycle it belongs to"


LATER = st.integers(0, 400)
CHANGES = st.lists(st.tuples(LATER, st.sampled_from(sorted(MODES.slots)))).map(sorted)


@given(st.sampled_from(LATE), st.sampled_from(OVERRUNS), LATER, LATER, CHANGES)
def test_a_cycle_has_one_mode_and_messages_leave_in_its_slot_unless_late(
    late: str, overrun: Overrun, arrival: int, other: int, changes: list[tuple[int, str]]
) -> None:
    schedules = announced(*changes)
    release = release_of(with_late(late, overrun), arrival, 0, schedules)
    band = MODES.slots[known(release.mode)]
    start, end = MODAL.slots[band]
    assert (release.overrun is None) == (arrival < end)
    if release.overrun is None:
        assert (release.slot, release.at_ns) == (band, max(arrival, start))
    elif release.slot is not None and late != "next-slot":
        assert release.slot == band
    gate = replace(with_late(late), anchor="cycle")
    one, two = (release_of(gate, time, None, schedules) for time in (arrival, other))
    assert one.origin_ns != two.origin_ns or one.mode == two.mode


# Schedules --------------------------------------------------------------------------------------


def test_the_last_schedule_that_had_begun_is_in_force() -> None:
    first = Schedule(100, phase_ns=7)
    schedules = with_change((first,), 200, moved_ns=5)
    schedules = with_change(schedules, 200, phase_ns=1)
    for start_ns, phase_ns, moved_ns in ((-5, 7, 0), (100, 7, 0), (199, 7, 0), (200, 1, 5)):
        schedule = schedule_in_force(schedules, start_ns)
        assert (schedule.phase_ns, schedule.moved_ns) == (phase_ns, moved_ns)


@given(
    st.lists(st.tuples(st.integers(0, 9), st.sampled_from(["phase_ns", "moved_ns", "mode"]), LATER))
)
def test_of_each_kind_the_change_announced_last_holds(changes: list[tuple[int, str, int]]) -> None:
    """Whatever else was announced, and in which order: worked out by looking at all of them."""
    schedules: Schedules = (Schedule(0, phase_ns=0, mode="0"),)
    for from_ns, what, value in changes:
        if what == "phase_ns":
            schedules = with_change(schedules, from_ns, phase_ns=value)
        elif what == "moved_ns":
            schedules = with_change(schedules, from_ns, moved_ns=value)
        else:
            schedules = with_change(schedules, from_ns, mode=str(value))
    beginnings = [schedule.from_ns for schedule in schedules]
    assert beginnings == sorted(beginnings)
    for start_ns in range(10):
        wanted: dict[str, int] = {"phase_ns": 0, "moved_ns": 0, "mode": 0}
        wanted |= {what: value for from_ns, what, value in changes if from_ns <= start_ns}
        in_force = schedule_in_force(schedules, start_ns)
        assert (in_force.phase_ns, in_force.moved_ns) == (wanted["phase_ns"], wanted["moved_ns"])
        assert in_force.mode == str(wanted["mode"])


def test_what_changes_nothing_adds_nothing_and_only_the_last_are_remembered() -> None:
    schedules: Schedules = (Schedule(0, phase_ns=0),)
    assert with_change(schedules, 50, moved_ns=0) is schedules
    for from_ns in range(2 * SCHEDULES):
        schedules = with_change(schedules, from_ns, moved_ns=from_ns + 1)
        assert with_change(schedules, from_ns + 1, moved_ns=from_ns + 1) is schedules
    assert len(schedules) == SCHEDULES
    assert schedule_in_force(schedules, 0).moved_ns == SCHEDULES + 1, "the oldest that is known"


def test_a_good_stamp_shows_where_cycles_start_until_a_phase_is_announced() -> None:
    schedules = with_change((Schedule(0, phase_ns=0),), 200, moved_ns=5)
    schedules = with_change(schedules, 300, phase_ns=40)
    schedules = with_phase_seen(schedules, 7, arrival_ns=150)
    assert [each.phase_ns for each in schedules] == [7, 7, 40]
    schedules = with_phase_seen(schedules, 8, arrival_ns=250)
    assert [each.phase_ns for each in schedules] == [7, 8, 40]
    assert with_phase_seen(schedules, 8, arrival_ns=299) is schedules


# Messages, and a gate at work -------------------------------------------------------------------


@given(st.integers(1, 2**31 * SECOND - 1), st.booleans())
def test_the_stamp_is_read_in_either_byte_order(stamp: int, big_endian: bool) -> None:
    assert origin_of(serialized(stamp, big_endian=big_endian)[:12]) == stamp
    not_a_header = bytes([0, 1, 0, 0]) + b"\xff" * 8  # 4.3 billion ns in a second
    for payload in (serialized(0), b"", serialized(stamp)[:11], not_a_header):
        assert origin_of(payload) is None


@pytest.mark.parametrize(
    ("payload", "text"),
    [
        (b"\0\1\0\0\5\0\0\0city\0", "city"),
        (b"\0\0\0\0\0\0\0\5city\0", "city"),  # big-endian
        (b"\0\1\0\0\1\0\0\0\0", ""),
        (b"\0\1\0\0\6\0\0\0city\0", None),  # longer than the message
        (b"\0\1\0\0\0\0\0\0", None),
        (b"", None),
    ],
)
def test_the_text_of_a_message_is_read_in_either_byte_order(
    payload: bytes, text: str | None
) -> None:
    assert text_of(payload) == text


@pytest.mark.parametrize(
    ("phase", "first_ms"),
    [(13, 113), (93, 193), (0, 200)],  # later than before; earlier, but that has passed; the same
)
def test_a_new_phase_is_in_force_from_the_next_cycle_that_begins_there(
    phase: int, first_ms: int
) -> None:
    shaper = Shaper(Gate(((60 * MS, 61 * MS),), 100 * MS, anchor="cycle"))
    shaper.queue.set_phase(phase * MS, 100 * MS if phase == 13 else 100 * MS + 1)
    before = decided(shaper, b"", first_ms * MS - 1)
    assert before.origin_ns == 100 * MS, "what comes until then belongs to a cycle as it was"
    assert decided(shaper, b"", first_ms * MS).origin_ns == first_ms * MS


def test_a_step_of_the_wall_clock_disturbs_no_message(monkeypatch: pytest.MonkeyPatch) -> None:
    """NTP corrects the clock by an hour while a message is under way.

    The wall clock cannot be stepped for a test, so the offset that the shaper reads stands in.
    """
    offset = 1_700_000_000 * SECOND
    monkeypatch.setattr(shaping, "clock_offset", lambda: offset)
    shaper = Shaper(Gate(((60 * MS, 61 * MS),), 100 * MS))
    started = 5 * SECOND + 42 * MS
    under_way = serialized(started + 100 * MS + offset)

    def passing(payload: bytes, after_ms: int) -> tuple[str, int | None]:
        release = decided(shaper, payload, started + after_ms * MS)
        return release.anchor, release.at_ns

    assert passing(serialized(started + offset), 30) == ("stamp", started + 60 * MS)
    offset += 3600 * SECOND
    assert passing(under_way, 130) == ("cycle", started + 160 * MS)
    later = serialized(started + 200 * MS + offset)
    assert passing(later, 230) == ("stamp", started + 260 * MS)
    before = offset
    offset += 20 * MS  # so little that a stamp of before could be one
    for after_ms in (430, 435, 529):
        under_way = serialized(started + 400 * MS + before)
        assert passing(under_way, after_ms)[0] == "cycle"
    assert passing(serialized(started + 500 * MS + offset), 530)[0] == "stamp"


def test_a_shaper_follows_the_modes_that_are_announced(monkeypatch: pytest.MonkeyPatch) -> None:
    """The offset between the two clocks, zero here, cannot be set for a test."""
    monkeypatch.setattr(shaping, "clock_offset", lambda: 0)
    shaper = Shaper(MODAL_MS)
    assert decided(shaper, serialized(1000 * MS), 1010 * MS).at_ns == 1060 * MS
    assert shaper.queue.switch("highway", 1050 * MS)
    assert decided(shaper, serialized(1000 * MS), 1055 * MS).at_ns == 1060 * MS, "it was begun"
    assert decided(shaper, serialized(1100 * MS), 1110 * MS).at_ns == 1120 * MS
    assert shaper.queue.switch("highway", 1150 * MS), "no change, but a mode that exists"
    for unknown in ("sea", None):
        assert not shaper.queue.switch(unknown, 1150 * MS)
    assert decided(shaper, serialized(1200 * MS), 1210 * MS).mode == "highway"
    assert not Shaper(ONE).queue.switch("city", 5)


@given(
    overrun=st.sampled_from(["wait", "publish"]),
    arrivals=st.lists(st.integers(0, 2_000), min_size=1, max_size=12).map(sorted),
    ages=st.lists(st.integers(0, 150), min_size=12, max_size=12),
    moves=st.lists(st.tuples(st.integers(0, 2_000), st.integers(-60, 39)), max_size=5),
)
def test_moves_lose_double_and_reorder_no_message(
    overrun: Overrun, arrivals: list[int], ages: list[int], moves: list[tuple[int, int]]
) -> None:
    gate = Gate(slots=((60, 61),), cycle_ns=100, overrun=overrun, depth=12)
    stamped = tuple((at, at - age) for at, age in zip(arrivals, ages, strict=False))
    changes = tuple(Change(from_ns, "moved", by_ns) for from_ns, by_ns in moves)
    outcomes = walk(Case(gate, stamped, changes), publishing_ns=1)
    left = [outcome.left_ns for outcome in outcomes]
    assert all(known(time) >= at for time, at in zip(left, arrivals, strict=True))
    assert sorted(set(left), key=known) == left, "each once, in the order in which they came"
    for outcome in outcomes:
        release = outcome.release
        if release.slot is not None:
            start = release.start_ns(100) + 60 + release.moved_ns
            assert start <= known(release.at_ns) < start + 1, "in the slot of its cycle"
