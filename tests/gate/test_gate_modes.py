"""Modes: which slot a message takes, when a change is in force; by hand, and what always holds."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from passing import decided

from chainshaper.gate import decision as gate_module
from chainshaper.gate.decision import LATE, Gate, Modes, Shaper, release_of, text_of

# Slots [20, 21), [40, 42) and [60, 61) of every 100; the last is the city's.
MODES = Modes(bands={"city": 2, "village": 1, "highway": 0}, default="city")
GATE = Gate(slots=((20, 21), (40, 42), (60, 61)), cycle_ns=100, modes=MODES)


def with_late(late: str, overrun: str = "wait") -> Gate:
    return replace(GATE, overrun=overrun, modes=replace(MODES, late=late))


@pytest.mark.parametrize(
    ("mode", "arrival", "leaves_at", "slot"),
    [
        ("city", 1000, 1060, 2),  # early: past both slots before its own
        ("city", 1020, 1060, 2),  # inside another mode's slot: that one is not open to it
        ("city", 1060, 1060, 2),  # inside its own
        ("village", 1000, 1040, 1),
        ("village", 1041, 1041, 1),  # the last instant
        ("highway", 1000, 1020, 0),
    ],
)
def test_an_early_message_waits_for_the_slot_of_its_mode(
    mode: str, arrival: int, leaves_at: int, slot: int
) -> None:
    release = release_of(GATE, arrival, 1000, changes=[(500, mode)])
    assert (release.at_ns, release.slot, release.mode) == (leaves_at, slot, mode)
    assert (release.overrun, release.cycles_waited) == (None, 0)


@pytest.mark.parametrize(
    ("late", "overrun", "arrival", "leaves_at", "slot", "treated"),
    [
        # Behind the village's slot, before the city's.
        ("wait", "discard", 1042, 1140, 1, "wait"),
        ("discard", "wait", 1042, None, None, "discard"),
        ("publish", "wait", 1042, 1042, None, "publish"),
        ("next-slot", "discard", 1042, 1060, 2, "next-slot"),
        ("next-slot", "discard", 1060, 1060, 2, "next-slot"),
        # Behind the last slot of all: an overrun like any other where the next slot is taken.
        ("wait", "discard", 1070, 1140, 1, "wait"),
        ("next-slot", "wait", 1070, 1140, 1, "wait"),
        ("next-slot", "discard", 1061, None, None, "discard"),
        ("next-slot", "publish", 1061, 1061, None, "publish"),
        # In the next cycle already.
        ("wait", "wait", 1141, 1141, 1, "wait"),
        ("next-slot", "wait", 1142, 1160, 2, "wait"),
    ],
)
def test_a_late_message_is_treated_as_said(  # noqa: PLR0917 - a row of the table
    late: str, overrun: str, arrival: int, leaves_at: int | None, slot: int | None, treated: str
) -> None:
    release = release_of(with_late(late, overrun), arrival, 1000, changes=[(0, "village")])
    assert (release.at_ns, release.slot, release.overrun) == (leaves_at, slot, treated)


@pytest.mark.parametrize(
    ("announced_at", "cycle_of", "mode"),
    [
        (1000, 1000, "highway"),  # at the very start: in force
        (1001, 1000, "city"),  # within the cycle: not in this one
        (1001, 1100, "highway"),  # but in the next
        (1099, 1000, "city"),
    ],
)
def test_a_change_is_in_force_from_the_next_cycle_on(
    announced_at: int, cycle_of: int, mode: str
) -> None:
    arrival = cycle_of + 10
    assert release_of(GATE, arrival, cycle_of, [(announced_at, "highway")]).mode == mode
    anchored = replace(GATE, anchor="cycle")
    assert release_of(anchored, arrival, None, [(announced_at, "highway")]).mode == mode


def test_a_late_message_keeps_the_mode_of_the_cycle_that_it_belongs_to() -> None:
    changes = [(1050, "highway"), (1150, "village")]
    release = release_of(with_late("publish"), 1175, 1000, changes)
    assert (release.mode, release.at_ns) == ("city", 1175)
    assert release_of(GATE, 1175, 1100, changes).mode == "highway"
    assert release_of(GATE, 1275, 1200, changes).mode == "village"


def test_under_let_the_slot_of_the_mode_is_that_of_the_due_cycle() -> None:
    let = replace(GATE, due_cycles=1, modes=replace(MODES, late="discard"))
    release = release_of(let, 1070, 1000, [(0, "village")])
    assert (release.at_ns, release.overrun) == (1140, None)
    assert release_of(let, 1142, 1000, [(0, "village")]).at_ns is None


def test_without_modes_nothing_is_asked_of_them() -> None:
    release = release_of(replace(GATE, modes=None), 1000, 1000, [(0, "highway")])
    assert (release.at_ns, release.mode) == (1020, None)


@pytest.mark.parametrize(
    ("modes", "reason"),
    [
        (lambda: Modes({"city": 2}, "sea"), "'sea' has no band: choose one of city"),
        (lambda: Modes({"city": 2}, "city", late="never"), "choose one of wait, .*next-slot"),
        (lambda: replace(GATE, modes=Modes({"city": 3}, "city")), "numbered 0 to 2"),
        (lambda: replace(GATE, modes=Modes({"city": -1}, "city")), "numbered 0 to 2"),
    ],
)
def test_modes_that_make_no_sense_are_refused(modes: object, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        modes()  # type: ignore[operator]


LATER = st.integers(0, 400)
CHANGES = st.lists(st.tuples(LATER, st.sampled_from(sorted(MODES.bands)))).map(sorted)


@given(st.sampled_from(LATE), st.sampled_from(["wait", "discard", "publish"]), LATER, CHANGES)
def test_what_was_not_late_leaves_in_its_modes_slot_and_nowhere_else(
    late: str, overrun: str, arrival: int, changes: list[tuple[int, str]]
) -> None:
    release = release_of(with_late(late, overrun), arrival, 0, changes)
    assert release.mode is not None
    band = MODES.bands[release.mode]
    own_end = GATE.slots[band][1]
    assert (release.overrun is None) == (arrival < own_end)
    if release.overrun is None:
        assert release.slot == band
        assert release.at_ns == max(arrival, GATE.slots[band][0])


@given(st.sampled_from(LATE), LATER, LATER, CHANGES)
def test_one_cycle_has_one_mode(
    late: str, first: int, second: int, changes: list[tuple[int, str]]
) -> None:
    gate = replace(with_late(late), anchor="cycle")
    one, two = (release_of(gate, arrival, None, changes) for arrival in (first, second))
    if one.origin_ns == two.origin_ns:
        assert one.mode == two.mode


@given(st.sampled_from(LATE), LATER, CHANGES)
def test_only_next_slot_may_take_another_modes_slot(
    late: str, arrival: int, changes: list[tuple[int, str]]
) -> None:
    release = release_of(with_late(late), arrival, 0, changes)
    assert release.mode is not None
    if release.slot is not None and late != "next-slot":
        assert release.slot == MODES.bands[release.mode]


MS = 1_000_000


def _at(stamp_ns: int) -> bytes:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    stamp = seconds.to_bytes(4, "little", signed=True) + nanoseconds.to_bytes(4, "little")
    return b"\0\1\0\0" + stamp


def test_a_shaper_follows_the_modes_that_are_announced(monkeypatch: pytest.MonkeyPatch) -> None:
    """The offset between the two clocks, zero here, cannot be set for a test."""
    monkeypatch.setattr(gate_module, "clock_offset", lambda: 0)
    slots = tuple((start * MS, end * MS) for start, end in GATE.slots)
    shaper = Shaper(Gate(slots=slots, cycle_ns=100 * MS, modes=MODES))
    assert shaper.mode == "city"
    assert decided(shaper, _at(1000 * MS), 1010 * MS).at_ns == 1060 * MS

    assert shaper.switch("highway", 1050 * MS)
    assert shaper.mode == "highway"
    assert decided(shaper, _at(1000 * MS), 1055 * MS).at_ns == 1060 * MS, "its cycle was begun"
    assert decided(shaper, _at(1100 * MS), 1110 * MS).at_ns == 1120 * MS

    assert shaper.switch("highway", 1150 * MS), "no change, but a mode that exists"
    assert not shaper.switch("sea", 1150 * MS)
    assert not shaper.switch(None, 1150 * MS)
    assert decided(shaper, _at(1200 * MS), 1210 * MS).mode == "highway"


def test_a_shaper_without_modes_has_none() -> None:
    shaper = Shaper(Gate(slots=((20, 21),), cycle_ns=100))
    assert shaper.mode is None
    assert not shaper.switch("city", 5)


@pytest.mark.parametrize(
    ("payload", "text"),
    [
        (b"\0\1\0\0\5\0\0\0city\0", "city"),
        (b"\0\0\0\0\0\0\0\5city\0", "city"),  # big-endian
        (b"\0\1\0\0\1\0\0\0\0", ""),
        (b"\0\1\0\0\6\0\0\0city\0", None),  # longer than the message
        (b"\0\1\0\0\0\0\0\0", None),
        (b"\0\1\0\0", None),
        (b"", None),
    ],
)
def test_the_text_of_a_message_is_read_in_either_byte_order(
    payload: bytes, text: str | None
) -> None:
    assert text_of(payload) == text
