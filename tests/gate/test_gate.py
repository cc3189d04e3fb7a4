"""The gate's decision: worked by hand, and against a walk through time instant by instant."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from passing import decided

from chainshaper.gate import decision as gate_module
from chainshaper.gate.decision import Gate, Release, Shaper, origin_of, release_of

ONE = Gate(slots=((60, 61),), cycle_ns=100)
BANDS = Gate(slots=((20, 25), (25, 30), (80, 100)), cycle_ns=100)

MS = 1_000_000
SECOND = 1_000_000_000


@pytest.mark.parametrize(
    ("phase", "first_ms"),
    [(13, 113), (93, 193), (0, 200)],  # later than before; earlier, but that has passed; the same
)
def test_a_new_phase_is_in_force_from_the_next_cycle_that_begins_there(
    phase: int, first_ms: int
) -> None:
    shaper = Shaper(Gate(((60 * MS, 61 * MS),), 100 * MS, anchor="cycle"))
    shaper.set_phase(phase * MS, 100 * MS if phase == 13 else 100 * MS + 1)
    before = decided(shaper, b"", first_ms * MS - 1)
    assert before.origin_ns == 100 * MS, "what comes until then belongs to a cycle as it was"
    assert decided(shaper, b"", first_ms * MS).origin_ns == first_ms * MS
    assert decided(shaper, b"", (first_ms + 100) * MS).origin_ns == (first_ms + 100) * MS


@pytest.mark.parametrize(
    ("arrival", "leaves_at", "slot", "cycles_waited"),
    [
        (1000, 1020, 0, 0),  # as early as can be
        (1019, 1020, 0, 0),  # just before the slot
        (1020, 1020, 0, 0),  # at its start: inside
        (1024, 1024, 0, 0),  # inside: at once
        (1025, 1025, 1, 0),  # at its end: outside, but the next slot begins here
        (1029, 1029, 1, 0),
        (1030, 1080, 2, 0),  # between two slots
        (1099, 1099, 2, 0),  # the last instant of a slot that ends with the cycle
        (1100, 1120, 0, 1),  # after the last slot: the next cycle, and counted
        (1130, 1180, 2, 1),
        (1740, 1780, 2, 7),  # seven cycles late
    ],
)
def test_stamped_messages_leave_in_the_first_slot_they_can_reach(
    arrival: int, leaves_at: int, slot: int, cycles_waited: int
) -> None:
    release = release_of(BANDS, arrival, stamp_ns=1000)
    overrun = "wait" if cycles_waited else None
    assert release == Release(leaves_at, 1000, slot, cycles_waited, "stamp", overrun)


@pytest.mark.parametrize(
    ("arrival", "leaves_at", "origin", "cycles_waited"),
    [
        (7, 67, 7, 0),  # cycles start at 7, 107, 207, …, whatever the stamp says
        (66, 67, 7, 0),
        (67, 67, 7, 0),
        (68, 167, 7, 1),  # missed
        (106, 167, 7, 1),
        (107, 167, 107, 0),  # a new cycle begins
        (5, 67, -93, 1),  # before the phase: the cycle that began at -93, its slot [-33, -32)
    ],
)
def test_the_cycle_anchor_counts_from_its_phase(
    arrival: int, leaves_at: int, origin: int, cycles_waited: int
) -> None:
    gate = replace(ONE, anchor="cycle", phase_ns=7)
    assert release_of(gate, arrival, stamp_ns=1) == Release(
        leaves_at, origin, 0, cycles_waited, "cycle", "wait" if cycles_waited else None
    )


def test_a_message_without_a_stamp_is_anchored_to_the_cycle() -> None:
    gate = replace(ONE, phase_ns=30)
    assert release_of(gate, 1000, stamp_ns=None) == Release(1090, 930, 0, 1, "cycle", "wait")


def test_a_stamp_slightly_from_the_future_still_starts_cycle_0() -> None:
    gate = replace(ONE, max_future_ns=150)
    # The other host's clock is 150 ns ahead: more than a whole cycle, and no slot is skipped.
    assert release_of(gate, 1000, stamp_ns=1150) == Release(1210, 1150, 0, 0, "stamp")


def test_a_stamp_far_from_the_future_is_of_no_use() -> None:
    gate = replace(ONE, max_future_ns=150)
    assert release_of(gate, 1000, stamp_ns=1151).anchor == "cycle"
    hours_ahead = release_of(Gate(((60 * MS, 61 * MS),), 100 * MS), 0, stamp_ns=7200 * SECOND)
    assert hours_ahead.at_ns is not None
    assert hours_ahead.at_ns < 100 * MS, "the message would be held for two hours"


def test_a_stamp_hours_old_is_of_no_use() -> None:
    gate = Gate(((60 * MS, 61 * MS),), 100 * MS, phase_ns=3 * MS)
    release = release_of(gate, 7200 * SECOND, stamp_ns=50 * MS)
    assert (release.anchor, release.at_ns) == ("cycle", 7200 * SECOND + 63 * MS)


def test_ten_cycles_is_the_oldest_stamp_unless_said_otherwise() -> None:
    assert release_of(ONE, 2000, stamp_ns=1000).anchor == "stamp"
    assert release_of(ONE, 2001, stamp_ns=1000).anchor == "cycle"
    assert release_of(replace(ONE, max_age_ns=2000), 2001, stamp_ns=1000).anchor == "stamp"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"slots": ()}, "without slots"),
        ({"cycle_ns": 0}, "longer than nothing"),
        ({"cycle_ns": -100}, "longer than nothing"),
        ({"cycle_ns": 60}, "within the cycle"),  # the slot ends after it
        ({"slots": ((60, 60),)}, "must ascend"),  # empty
        ({"slots": ((61, 60),)}, "must ascend"),
        ({"slots": ((-1, 60),)}, "within the cycle"),
        ({"slots": ((30, 40), (10, 20))}, "must ascend"),
        ({"slots": ((10, 20), (19, 30))}, "not overlap"),
        ({"anchor": "clock"}, "choose one of stamp, cycle"),
        ({"overrun": "drop"}, "choose one of wait, discard, publish"),
        ({"due_cycles": -1}, "due beforehand"),
    ],
)
def test_gates_that_make_no_sense_are_refused(changes: dict[str, object], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        replace(ONE, **changes)  # type: ignore[arg-type]


@st.composite
def gates(draw: st.DrawFn) -> Gate:
    """Small enough that a test can walk through every instant of a few cycles."""
    cycle = draw(st.integers(2, 40))
    cuts = sorted(draw(st.sets(st.integers(0, cycle), min_size=2, max_size=8)))
    slots = tuple(zip(cuts[::2], cuts[1::2], strict=False))
    return Gate(
        slots=slots,
        cycle_ns=cycle,
        anchor=draw(st.sampled_from(["stamp", "cycle"])),
        phase_ns=draw(st.integers(-100, 100)),
        max_future_ns=draw(st.integers(0, 50)),
    )


@given(gates(), st.integers(0, 1000), st.none() | st.integers(0, 1000))
def test_a_message_leaves_at_the_first_instant_inside_a_slot(
    gate: Gate, arrival: int, stamp: int | None
) -> None:
    release = release_of(gate, arrival, stamp)

    assert release.at_ns is not None
    assert release.slot is not None
    instant = max(arrival, release.origin_ns)  # no cycle exists before the first one
    while not _inside_a_slot(gate, instant - release.origin_ns):
        instant += 1
    assert release.at_ns == instant

    after_start = release.at_ns - release.origin_ns - release.cycles_waited * gate.cycle_ns
    start, end = gate.slots[release.slot]
    assert start <= after_start < end
    assert release_of(gate, arrival, stamp) == release, "the same question, another answer"


def _inside_a_slot(gate: Gate, since_origin: int) -> bool:
    return any(start <= since_origin % gate.cycle_ns < end for start, end in gate.slots)


@given(gates(), st.integers(0, 1000), st.integers(0, 1000))
def test_the_origin_is_the_stamp_or_a_start_of_the_cycle(
    gate: Gate, arrival: int, stamp: int
) -> None:
    release = release_of(gate, arrival, stamp)
    if release.anchor == "stamp":
        assert gate.anchor == "stamp"
        assert release.origin_ns == stamp
    else:
        assert (release.origin_ns - gate.phase_ns) % gate.cycle_ns == 0
        assert 0 <= arrival - release.origin_ns < gate.cycle_ns


def message(stamp_ns: int, *, big_endian: bool = False) -> bytes:
    """A serialized message whose first field is a header with this stamp."""
    seconds, nanoseconds = divmod(stamp_ns, SECOND)
    order = "big" if big_endian else "little"
    encapsulation = bytes([0, 0 if big_endian else 1, 0, 0])
    return (
        encapsulation
        + seconds.to_bytes(4, order, signed=True)  # type: ignore[arg-type]
        + nanoseconds.to_bytes(4, order)  # type: ignore[arg-type]
        + b"the rest of the message"
    )


@given(st.integers(1, 2**31 * SECOND - 1), st.booleans())
def test_the_stamp_is_read_in_either_byte_order(stamp: int, big_endian: bool) -> None:
    assert origin_of(message(stamp, big_endian=big_endian)) == stamp


def test_payloads_without_a_stamp_have_no_origin() -> None:
    assert origin_of(message(0)) is None
    assert origin_of(b"") is None
    assert origin_of(message(5)[:11]) is None
    assert origin_of(message(5)[:12]) == 5
    not_a_header = bytes([0, 1, 0, 0]) + b"\xff" * 8  # 4.3 billion ns in a second
    assert origin_of(not_a_header) is None


def test_a_step_of_the_wall_clock_disturbs_no_message(monkeypatch: pytest.MonkeyPatch) -> None:
    """NTP corrects the clock by an hour while a message is under way.

    The wall clock cannot be stepped for a test, so the offset that the shaper reads stands in.
    """
    offset = 1_700_000_000 * SECOND
    monkeypatch.setattr(gate_module, "clock_offset", lambda: offset)
    shaper = Shaper(Gate(((60 * MS, 61 * MS),), 100 * MS))

    started = 5 * SECOND + 42 * MS
    before = decided(shaper, message(started + offset), started + 30 * MS)
    assert (before.anchor, before.at_ns) == ("stamp", started + 60 * MS)

    under_way = message(started + 100 * MS + offset)
    offset += 3600 * SECOND
    during = decided(shaper, under_way, started + 130 * MS)
    assert (during.anchor, during.at_ns) == ("cycle", started + 160 * MS)

    after = decided(shaper, message(started + 200 * MS + offset), started + 230 * MS)
    assert (after.anchor, after.at_ns) == ("stamp", started + 260 * MS)


def test_a_shaper_without_stamps_keeps_the_phase_of_the_last_good_one() -> None:
    shaper = Shaper(Gate(((60 * MS, 61 * MS),), 100 * MS))
    offset = gate_module.clock_offset()
    good = decided(shaper, message(5_042 * MS + offset), 5_072 * MS)
    stampless = decided(shaper, message(0), 5_172 * MS)
    assert stampless.anchor == "cycle"
    assert good.at_ns is not None
    assert stampless.at_ns is not None
    assert stampless.at_ns - good.at_ns == 100 * MS
