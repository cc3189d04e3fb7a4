"""Messages that missed their slot: what each policy does, by hand, and what it may never do."""

import time
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from passing import held

from chainshaper.gate import decision as gate_module
from chainshaper.gate.decision import Gate, Release, Shaper, missed, release_of

# Slots [20, 30) and [60, 61) of every 100: what comes from 61 on has overrun.
TWO = Gate(slots=((20, 30), (60, 61)), cycle_ns=100)
DISCARD, PUBLISH = replace(TWO, overrun="discard"), replace(TWO, overrun="publish")


@pytest.mark.parametrize(
    ("arrival", "waits", "discards", "publishes"),
    [
        (1000, 1020, 1020, 1020),  # in time, all policies agree
        (1025, 1025, 1025, 1025),
        (1030, 1060, 1060, 1060),  # it missed a slot, but not the last
        (1060, 1060, 1060, 1060),  # the last instant
        (1061, 1120, None, 1061),  # the first one that is too late
        (1099, 1120, None, 1099),
        (1130, 1160, None, 1130),  # in the next cycle: still an overrun of its own
    ],
)
def test_an_overrun_is_treated_as_the_policy_says(
    arrival: int, waits: int, discards: int | None, publishes: int
) -> None:
    for gate, leaves_at in ((TWO, waits), (DISCARD, discards), (PUBLISH, publishes)):
        release = release_of(gate, arrival, stamp_ns=1000)
        assert release.at_ns == leaves_at
        assert release.overrun == (gate.overrun if arrival >= 1061 else None)


def test_what_leaves_in_no_slot_names_none() -> None:
    late = Release(None, 1000, None, 1, "stamp", "discard")
    assert release_of(DISCARD, 1130, stamp_ns=1000) == late
    assert release_of(PUBLISH, 1130, stamp_ns=1000) == replace(late, at_ns=1130, overrun="publish")


def test_anchored_to_the_cycle_a_message_belongs_to_the_cycle_it_comes_in() -> None:
    discard = replace(DISCARD, anchor="cycle", phase_ns=7)
    assert release_of(discard, 1067, None).at_ns == 1067
    assert release_of(discard, 1068, None).at_ns is None
    assert release_of(discard, 1107, None).at_ns == 1127


def test_under_let_an_output_is_due_a_cycle_later() -> None:
    let = Gate(slots=((0, 1),), cycle_ns=100, overrun="discard", due_cycles=1)
    for arrival in (1000, 1040):
        assert release_of(let, arrival, stamp_ns=1000) == Release(1100, 1000, 0, 1, "stamp")
    assert release_of(let, 1100, stamp_ns=1000).at_ns == 1100
    assert release_of(let, 1101, stamp_ns=1000).overrun == "discard"
    waiting = replace(let, overrun="wait")
    assert release_of(waiting, 1101, stamp_ns=1000) == Release(1200, 1000, 0, 2, "stamp", "wait")


def test_a_stamp_from_the_future_is_no_overrun() -> None:
    assert release_of(DISCARD, 990, stamp_ns=1000).at_ns == 1020


def test_a_slot_is_missed_from_its_end_on() -> None:
    release = release_of(DISCARD, 1000, stamp_ns=1000)
    assert [missed(DISCARD, release, now) for now in (1020, 1029, 1030)] == [False, False, True]
    at_once = release_of(PUBLISH, 1070, stamp_ns=1000)
    assert not missed(PUBLISH, at_once, 5000), "it was to leave in no slot"


@st.composite
def gates(draw: st.DrawFn) -> Gate:
    cycle = draw(st.integers(2, 40))
    cuts = sorted(draw(st.sets(st.integers(0, cycle), min_size=2, max_size=8)))
    return Gate(
        slots=tuple(zip(cuts[::2], cuts[1::2], strict=False)),
        cycle_ns=cycle,
        anchor=draw(st.sampled_from(["stamp", "cycle"])),
        phase_ns=draw(st.integers(-100, 100)),
        max_future_ns=draw(st.integers(0, 50)),
        due_cycles=draw(st.integers(0, 2)),
    )


STAMPS = st.none() | st.integers(0, 300)


@given(gates(), st.integers(0, 300), STAMPS)
def test_discarding_publishes_in_the_slots_of_the_due_cycle_and_nowhere_else(
    gate: Gate, arrival: int, stamp: int | None
) -> None:
    release = release_of(replace(gate, overrun="discard"), arrival, stamp)
    if release.at_ns is None:
        last_end = release.origin_ns + gate.due_cycles * gate.cycle_ns + gate.slots[-1][1]
        assert arrival >= last_end, "it came in time"
        return
    after_start = release.at_ns - release.origin_ns
    cycle, within = divmod(after_start, gate.cycle_ns)
    assert cycle <= gate.due_cycles
    assert any(start <= within < end for start, end in gate.slots)


@given(gates(), st.integers(0, 300), STAMPS)
def test_publishing_at_once_never_waits_beyond_the_last_slot(
    gate: Gate, arrival: int, stamp: int | None
) -> None:
    release = release_of(replace(gate, overrun="publish"), arrival, stamp)
    assert release.at_ns is not None
    last_end = release.origin_ns + gate.due_cycles * gate.cycle_ns + gate.slots[-1][1]
    assert arrival <= release.at_ns < max(last_end, arrival + 1)


@given(gates(), st.integers(0, 300), STAMPS)
def test_policies_differ_for_overruns_only(gate: Gate, arrival: int, stamp: int | None) -> None:
    wait, *others = (
        release_of(replace(gate, overrun=policy), arrival, stamp)
        for policy in ("wait", "discard", "publish")
    )
    for other in others:
        assert (wait.overrun is None) == (other.overrun is None)
        if wait.overrun is None:
            assert other == wait


@given(
    gates(),
    st.sampled_from(["wait", "discard", "publish"]),
    st.lists(st.integers(0, 60), min_size=1),
)
def test_one_after_another_messages_leave_in_the_order_they_came(
    gate: Gate, policy: str, latencies: list[int]
) -> None:
    """The shaping node handles a message when the one before it has left."""
    gate = replace(gate, overrun=policy)
    now = 0
    for number, latency in enumerate(latencies):
        stamp = number * gate.cycle_ns
        handled_at = max(now, stamp + latency)
        release = release_of(gate, handled_at, stamp)
        if release.at_ns is not None:
            assert release.at_ns >= handled_at, "it left before the one before it"
            now = release.at_ns


MS = 1_000_000


def _message() -> bytes:
    """A message whose chain began when this is called."""
    seconds, nanoseconds = divmod(time.time_ns(), 1_000_000_000)
    stamp = seconds.to_bytes(4, "little", signed=True) + nanoseconds.to_bytes(4, "little")
    return b"\0\1\0\0" + stamp


def test_a_message_to_be_discarded_is_not_waited_for() -> None:
    gate = Gate(slots=((0, 1),), cycle_ns=3_600_000 * MS, overrun="discard")
    one = held(Shaper(gate), _message())
    assert (one.release.at_ns, one.release.overrun) == (None, "discard")
    assert one.dropped == "discarded"


def test_who_wakes_behind_the_slot_discards_what_came_in_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The machine stands still over the slot: the sleep ends late."""
    slot = (20 * MS, 21 * MS)

    def oversleep(deadline_ns: int) -> None:
        while time.monotonic_ns() < deadline_ns + 3 * MS:
            pass

    monkeypatch.setattr(gate_module, "sleep_until", oversleep)
    for policy, leaves in (("discard", False), ("wait", True), ("publish", True)):
        shaper = Shaper(Gate(slots=(slot,), cycle_ns=100 * MS, overrun=policy))
        release = held(shaper, _message()).release
        assert (release.at_ns is not None) == leaves, policy
        assert (release.overrun, release.slot) == ((None, 0) if leaves else ("discard", None))
