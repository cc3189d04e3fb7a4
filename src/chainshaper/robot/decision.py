"""The gate: when may a message of the chain's output leave?

A latency-shaping node lets its messages go only inside the publish slots of its server R_m° (paper,
sections 3.2.2 and 3.3): the gate *is* that server. Slots repeat every cycle, counted from an
**anchor**: the ``stamp`` of the message (its first field is a ``std_msgs/Header``), or ``phase_ns``
of CLOCK_MONOTONIC and every ``cycle`` thereafter.

An early message waits for its slot. One that comes **into an open slot** leaves ``at-once``, or in
the ``next-slot``: then only what came before a slot's start leaves in it, and all at that instant.
One behind the last slot it was due in, or without a next one, is an **overrun** (section 6):
``wait`` for a slot of a later cycle, ``discard`` it, or ``publish`` it at once.

Of several **messages** in a cycle leave ``all-in-order`` (the oldest is dropped where more than
``depth`` wait), the ``newest`` of those that wait, or the ``first`` that came. With **modes**
(section 3.3) each mode has a slot of its own; a change is in force from the first cycle that begins
after it. Slots that follow latencies are **moved**, all by the same time, from the first cycle that
begins after an instant.

The gate in C++ (core/gate) has the words and limits from here, its nodes columns and parameters.
Every gate runs `tests/robot/gate_conformance.yaml`. Only the standard library is imported, since
this is a part of the Python nodes' own files.
"""

import ctypes
import errno
import os
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, Literal, TypeAlias, get_args

Anchor: TypeAlias = Literal["stamp", "cycle"]
Overrun: TypeAlias = Literal["wait", "discard", "publish"]
Late: TypeAlias = Literal["wait", "discard", "publish", "next-slot"]
IntoOpenSlot: TypeAlias = Literal["at-once", "next-slot"]
Messages: TypeAlias = Literal["all-in-order", "newest", "first"]
Dropped: TypeAlias = Literal["replaced", "surplus", "overflowed", "discarded"]
ANCHORS, OVERRUNS, LATE = get_args(Anchor), get_args(Overrun), get_args(Late)
INTO_OPEN_SLOT, MESSAGES, DROPPED = get_args(IntoOpenSlot), get_args(Messages), get_args(Dropped)

LOG_COLUMNS = (
    *("time", "pid", "tid", "cpu", "source_timestamp", "arrival", "origin", "release", "slot"),
    *("cycles_waited", "anchor", "overrun", "mode", "published", "stalled", "dropped", "lost"),
    *("row", "moved"),
)
"""Of a shaping node's log, comma-separated, a row per message: the event ``gate_release``."""

DEPTH = 10  # so many messages may wait at a gate unless it is said otherwise
READER_DEPTH = 1000  # of the history before a gate: the gate itself drops, and counts, the rest
MAX_FUTURE_NS = 1_000_000
MAX_AGE_CYCLES = 10  # the oldest stamp of use, beside the cycles after which the message is due
STALL_NS = 100_000  # a thread may wake up so late on a machine that does not stall
STEP_NS = 500_000  # of the wall clock; slewing moves it by at most 50 us in a cycle of 100 ms
LOOK_NS = 50_000_000  # between two looks for messages: often enough for the reader's history
OTHERS_NS = 2_000_000  # an executor's other callbacks take less
CHANGES = 64  # so many changes of the mode, or moves, reach back further than the oldest stamp


def _one_of(key: str, word: str, known: Sequence[str]) -> None:
    if word not in known:
        raise ValueError(f"{key} {word!r}: choose one of {', '.join(known)}")


@dataclass(frozen=True)
class Modes:
    """Which of the gate's ``slots`` (by its place, from 0) the messages of each mode leave in.

    ``default`` is in force until a mode is announced. ``late``: of messages that come behind their
    mode's slot; with ``next-slot`` one behind the last slot is still an overrun.
    """

    bands: Mapping[str, int]
    default: str
    late: str = "wait"

    def __post_init__(self) -> None:
        if self.default not in self.bands:
            choose = f"choose one of {', '.join(self.bands)}"
            raise ValueError(f"the default mode {self.default!r} has no band: {choose}")
        _one_of("late", self.late, LATE)


@dataclass(frozen=True)
class Gate:
    """The publish slots of one output. All times are nanoseconds.

    ``slots`` are half-open ``(start, end)`` intervals counted from the anchor, ascending, apart
    from each other and inside ``[0, cycle_ns)``. With the ``stamp`` anchor, ``phase_ns`` serves
    messages whose stamp is of no use: it is older than :data:`MAX_AGE_CYCLES`, or from the future.

    A message is due in the cycle that it belongs to, or, under logical execution time,
    ``due_cycles`` later, and leaves in none before. With the ``cycle`` anchor it belongs to the
    cycle it arrives in, and is due in the next one at the latest: the data of each callback came a
    cycle before. Raises ValueError: such a gate makes no sense.
    """

    slots: tuple[tuple[int, int], ...]
    cycle_ns: int
    anchor: str = "stamp"
    phase_ns: int = 0
    overrun: str = "wait"
    due_cycles: int = 0
    modes: Modes | None = None
    messages: str = "all-in-order"
    depth: int = DEPTH
    into_open_slot: str = "at-once"

    def __post_init__(self) -> None:
        _one_of("anchor", self.anchor, ANCHORS)
        _one_of("overrun", self.overrun, OVERRUNS)
        _one_of("messages", self.messages, MESSAGES)
        _one_of("into_open_slot", self.into_open_slot, INTO_OPEN_SLOT)
        if self.depth < 1:
            raise ValueError(f"room for {self.depth} messages: a gate needs it for one at least")
        if self.due_cycles < 0:
            raise ValueError(f"due {self.due_cycles} cycles later: no message is due beforehand")
        if self.cycle_ns <= 0:
            raise ValueError(f"cycle of {self.cycle_ns} ns: it must be longer than nothing")
        if not self.slots:
            raise ValueError("a gate without slots would never let anything through")
        previous_end = 0
        for start, end in self.slots:
            if not previous_end <= start < end <= self.cycle_ns:
                rule = "slots must ascend, not overlap and lie within the cycle"
                raise ValueError(f"slot [{start}, {end}) ns: {rule}")
            previous_end = end
        for mode, band in ({} if self.modes is None else self.modes.bands).items():
            if not 0 <= band < len(self.slots):
                known = f"slots are numbered 0 to {len(self.slots) - 1}"
                raise ValueError(f"mode {mode!r}: band {band}, but {known}")

    def may_move(self, by_ns: int) -> bool:
        """Whether slots that are moved by so much lie within the cycle still."""
        return self.slots[0][0] + by_ns >= 0 and self.slots[-1][1] + by_ns <= self.cycle_ns

    @property
    def policy(self) -> str:
        """What becomes of a message that comes behind the last slot that is open to it."""
        if self.modes is None or self.modes.late == "next-slot":
            return self.overrun
        return self.modes.late

    def lets_out(self, slot: tuple[int, int], from_ns: int, arrival_ns: int, ready_ns: int) -> bool:
        """Whether a message may leave in a slot of the cycle that begins then, or before it."""
        in_time = self.into_open_slot == "at-once" or arrival_ns <= from_ns + slot[0]
        return in_time and ready_ns < from_ns + slot[1]

    def counts_from(self, stamp_ns: int | None, arrival_ns: int) -> bool:
        """Whether a message's slots count from its stamp."""
        if stamp_ns is None or self.anchor != "stamp":
            return False
        max_age = (MAX_AGE_CYCLES + self.due_cycles) * self.cycle_ns
        return -MAX_FUTURE_NS <= arrival_ns - stamp_ns <= max_age


@dataclass(slots=True)  # making a frozen one takes a microsecond more, on the way of every message
class Release:
    """The gate's decision for one message; times are ns of CLOCK_MONOTONIC."""

    at_ns: int | None  # when it may leave (not after the arrival: at once; None: it is dropped)
    origin_ns: int
    slot: int | None  # in which one that is, if in any
    cycles_waited: int  # after its own
    anchor: str  # what the slots were counted from
    overrun: str | None = None  # the policy that was applied to it; None: it came in time
    mode: str | None = None  # of its cycle; None: there are no modes
    moved_ns: int = 0  # by so much the slots of the cycle in which it leaves
    dropped: str | None = None  # for that reason

    def start_ns(self, cycle_ns: int) -> int:
        """When the cycle starts in which the message leaves."""
        return self.origin_ns + self.cycles_waited * cycle_ns

    def dropping(self, reason: Dropped) -> "Release":
        """The decision to drop the message instead."""
        return replace(self, at_ns=None, slot=None, dropped=reason)


def release_of(
    gate: Gate,
    arrival_ns: int,
    stamp_ns: int | None,
    changes: Sequence[tuple[int, str]] = (),
    *,
    ready_ns: int | None = None,
    phase_ns: int | None = None,
    moves: Sequence[tuple[int, int]] = (),
) -> Release:
    """Decide when a message may leave; times are ns of CLOCK_MONOTONIC.

    ``stamp_ns`` is its origin, if it has one; ``changes`` are the modes that were announced, each
    with the time, ascending. It leaves at ``ready_ns`` at the earliest, where others are before it.
    ``phase_ns`` stands for the gate's own. ``moves`` are from when on slots are moved, ascending,
    and by how much from where the gate has them.

        >>> gate = Gate(slots=((60, 61),), cycle_ns=100)
        >>> release_of(gate, arrival_ns=1040, stamp_ns=1000).at_ns      # early: it waits
        1060
        >>> release_of(gate, arrival_ns=1070, stamp_ns=1000).at_ns      # missed: the next cycle
        1160
        >>> release_of(gate, arrival_ns=1140, stamp_ns=1100, moves=[(1050, 10)]).at_ns
        1170
        >>> modes = Modes(bands={"city": 1, "highway": 0}, default="city", late="next-slot")
        >>> gate = Gate(slots=((20, 21), (60, 61)), cycle_ns=100, modes=modes)
        >>> release_of(gate, 1110, 1100, changes=[(1050, "highway")]).at_ns
        1120
    """
    cycle_ns, modes, policy = gate.cycle_ns, gate.modes, gate.policy
    if stamp_ns is not None and gate.counts_from(stamp_ns, arrival_ns):
        origin, anchor, due = stamp_ns, "stamp", gate.due_cycles
    else:
        elapsed = (arrival_ns - (gate.phase_ns if phase_ns is None else phase_ns)) % cycle_ns
        origin, anchor, due = arrival_ns - elapsed, "cycle", min(gate.due_cycles, 1)
    mode, first, slots = None, 0, gate.slots
    if modes is not None:
        announced = (name for since, name in reversed(changes) if since <= origin)
        mode = next(announced, modes.default)
        first = modes.bands[mode]
        slots = slots[first : None if modes.late == "next-slot" else first + 1]
    ready = arrival_ns if ready_ns is None else max(arrival_ns, ready_ns)
    # A stamp slightly from the future puts the arrival before its own cycle: cycle 0 still.
    cycle = max(due, (ready - origin) // cycle_ns)
    moved = moved_at(moves, due_from := origin + due * cycle_ns)
    if policy != "wait" and not gate.lets_out(slots[-1], due_from + moved, arrival_ns, ready):
        at_once = Release(ready, origin, None, cycle, anchor, policy, mode, moved)
        return at_once if policy == "publish" else at_once.dropping("discarded")
    while True:
        cycle_start = origin + cycle * cycle_ns
        moved = moved_at(moves, cycle_start)
        for number, slot in enumerate(slots, first):
            if gate.lets_out(slot, cycle_start + moved, arrival_ns, ready):
                at = max(ready, cycle_start + moved + slot[0])
                later = "next-slot" if mode is not None and number > first else None
                treated = "wait" if cycle > due else later
                return Release(at, origin, number, cycle, anchor, treated, mode, moved)
        cycle += 1


def moved_at(moves: Sequence[tuple[int, int]], cycle_start_ns: int) -> int:
    """By how much the slots of a cycle that begins then are moved (ns)."""
    return next((by for since, by in reversed(moves) if since <= cycle_start_ns), 0)


def missed(gate: Gate, release: Release, now_ns: int) -> bool:
    """Whether the slot that a message was to leave in is over (ns of CLOCK_MONOTONIC)."""
    if release.slot is None:
        return False
    cycle_start = release.start_ns(gate.cycle_ns) + release.moved_ns
    return now_ns >= cycle_start + gate.slots[release.slot][1]


@dataclass
class NodeParameters:
    """The ROS parameters of shaping node, standby and throttler; times are ns, 0-based places."""

    slots_ns: list[int] = field(default_factory=list)  # start and end of each, one after the other
    cycle_ns: int = 0
    anchor: str = "stamp"
    phase_ns: int = 0
    overrun: str = "wait"
    due_cycles: int = 0
    messages: str = "all-in-order"
    depth: int = 0  # 0: the publisher's history, DEPTH at least
    into_open_slot: str = "at-once"
    mode_topic: str = ""  # no modes
    mode_names: list[str] = field(default_factory=list)
    mode_slots: list[int] = field(default_factory=list)
    mode_default: str = ""
    mode_late: str = "wait"
    spin_ns: int = 0
    pause_ns: int = 0
    core: int = -1
    fifo_priority: int = 0
    output_depth: int = DEPTH  # where the history of the original publisher is not known
    server_cores: list[int] = field(default_factory=list)
    log: str = ""
    log_bytes: int = 100_000_000  # the log and the one before it have no more
    handover: str = ""  # the node is alone
    # Of the standby,
    shaping_node: str = "the shaping node"
    fallback: str = "bypass"
    patience_ns: int = 0
    # and of the throttler.
    inputs: list[str] = field(default_factory=list)
    outputs: list[str] = field(default_factory=list)
    period_ns: int = 0
    rule: str = "newest"

    def gate(self, depth: int = DEPTH) -> Gate:
        """The gate that they describe. Raises ValueError: they describe none."""
        bands = dict(zip(self.mode_names, self.mode_slots, strict=True))
        return Gate(
            slots=tuple(zip(self.slots_ns[::2], self.slots_ns[1::2], strict=False)),
            modes=Modes(bands, self.mode_default, self.mode_late) if self.mode_topic else None,
            depth=depth,
            **{name: getattr(self, name) for name in SAME},
        )


SAME = ("cycle_ns", "anchor", "phase_ns", "overrun", "due_cycles", "messages", "into_open_slot")
"""What a gate, its parameters and its description have alike, under these names."""


def gate_parameters(gate: Gate, mode_topic: str = "") -> dict[str, Any]:
    """The parameters that describe a gate, whose modes are announced on that topic."""
    known: dict[str, Any] = {"slots_ns": [bound for slot in gate.slots for bound in slot]}
    known |= {name: getattr(gate, name) for name in SAME}
    if (modes := gate.modes) is not None:
        bands = {"mode_names": [*modes.bands], "mode_slots": [*modes.bands.values()]}
        late = {"mode_default": modes.default, "mode_late": modes.late}
        known |= {"mode_topic": mode_topic, **bands, **late}
    return known


# Serialized messages ----------------------------------------------------------------------------


def origin_of(payload: bytes) -> int | None:
    """The header stamp (int32 seconds, uint32 nanoseconds, behind the encapsulation header) of a
    serialized message in ns of its clock, None if it is zero or short.
    """
    if len(payload) < 12:
        return None
    order = "<" if payload[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", payload, 4)
    if nanoseconds >= 1_000_000_000:
        return None
    stamp: int = seconds * 1_000_000_000 + nanoseconds
    return stamp or None


def text_of(payload: bytes) -> str | None:
    """The text of a serialized ``std_msgs/String``, None where the bytes are none."""
    if len(payload) < 8:
        return None
    length = int.from_bytes(payload[4:8], "little" if payload[1] & 1 else "big")  # with the NUL
    if not 1 <= length <= len(payload) - 8:
        return None
    return payload[8 : 7 + length].decode(errors="replace")


# Clocks ------------------------------------------------------------------------------------------


_libc = ctypes.CDLL(None)


def sleep_until(deadline_ns: int) -> None:
    """Sleep until an instant of CLOCK_MONOTONIC, however late the sleep itself begins."""
    until = (ctypes.c_long * 2)(*divmod(max(0, deadline_ns), 1_000_000_000))  # a timespec
    absolute = (
        1  # TIMER_ABSTIME: a signal ends the sleep early (EINTR), the deadline stays the same
    )
    while _libc.clock_nanosleep(time.CLOCK_MONOTONIC, absolute, until, None) == errno.EINTR:
        pass


def watch_until(deadline_ns: int) -> int:
    """Watch the clock, to microseconds, until an instant of CLOCK_MONOTONIC; the time then."""
    clock = time.monotonic_ns
    while (now := clock()) < deadline_ns:
        pass
    return now


def clock_offset(clock: int = time.CLOCK_REALTIME) -> int:
    """A clock minus CLOCK_MONOTONIC in ns, to a fraction of a microsecond."""
    measured = []  # how long each took, and what it found
    for _ in range(5):
        before, now, after = time.monotonic_ns(), time.clock_gettime_ns(clock), time.monotonic_ns()
        measured.append((after - before, now - (before + after) // 2))
        if after - before < 2_000:  # a longer bracket means that something came between
            break
    return min(measured)[1]


# Messages that wait -------------------------------------------------------------------------------


@dataclass(eq=False)
class Waiting:
    """A message that has come and not left; times are ns of CLOCK_MONOTONIC."""

    payload: bytes
    arrival_ns: int
    stamp_ns: int | None
    phase_ns: int
    about: Any = None  # what its owner knows of it: the source timestamp, in ROS 2 nodes
    lost: int | None = None  # how many, between the one before it and this one; None: not known


@dataclass(frozen=True)
class Outcome:
    """What became of a message: it may leave now, or is dropped."""

    message: Waiting
    release: Release
    awake_ns: int  # when that was clear (CLOCK_MONOTONIC)


class Queue:
    """The messages that wait at a gate, and which of them leave. It knows no clock."""

    def __init__(self, gate: Gate) -> None:
        self.gate = gate
        self.phase_ns = gate.phase_ns
        self.waiting: deque[Waiting] = deque()
        self.changes: deque[tuple[int, str]] = deque(maxlen=CHANGES)
        self.moves: deque[tuple[int, int]] = deque(maxlen=CHANGES)
        self.free_ns = 0  # when it is the turn of the oldest message, if it is there then
        # When cycles start: the one that the oldest message, or another for it, leaves in, and
        # the one in which the last has left.
        self._leaving: int | None = None
        self._left: int | None = None
        self._unsure_until_ns = 0

    def doubt_stamps(self, now_ns: int) -> None:
        """The wall clock was stepped: stamps of messages that are under way may be of either side
        of the step. They are of no use until the last of these has come.
        """
        self._unsure_until_ns = now_ns + (self.gate.due_cycles + 1) * self.gate.cycle_ns

    def arrive(
        self,
        payload: bytes,
        arrival_ns: int,
        stamp_ns: int | None,
        about: Any = None,
        lost: int | None = None,
    ) -> Outcome | None:
        """A message came; the one for which there is no room any more."""
        stamp_ns = None if arrival_ns < self._unsure_until_ns else stamp_ns
        message = Waiting(payload, arrival_ns, stamp_ns, self.phase_ns, about, lost)
        self.waiting.append(message)
        if stamp_ns is not None and self.gate.counts_from(stamp_ns, arrival_ns):
            self.phase_ns = stamp_ns % self.gate.cycle_ns
        if len(self.waiting) <= self.gate.depth:
            return None
        oldest = self.waiting.popleft()
        return Outcome(oldest, self._release(oldest, arrival_ns).dropping("overflowed"), arrival_ns)

    def decide(self) -> Release:
        """When the oldest message may leave, or why it never does."""
        oldest = self.waiting[0]
        ready = max(oldest.arrival_ns, self.free_ns)
        release = self._release(oldest, ready)
        if release.slot is None or self.gate.messages == "all-in-order":
            return release
        if self._left is not None and self._same_cycle(release, self._left):
            if self.gate.messages == "first":
                return release.dropping("surplus")
            last_end = self._left + moved_at(self.moves, self._left) + self.gate.slots[-1][1]
            release = self._release(oldest, max(ready, last_end))
            if release.slot is None:
                return release if release.at_ns is None else replace(release, at_ns=ready)
        if not self._same_cycle(release, self._leaving):
            self._leaving = release.start_ns(self.gate.cycle_ns)
        return release

    def replaced(self, release: Release, now_ns: int) -> bool:
        """Whether a newer message leaves for the oldest one, which was to leave like this."""
        if self.gate.messages != "newest" or release.slot is None:
            return False
        others = (self._release(newer, now_ns) for newer in islice(self.waiting, 1, None))
        return any(one.slot is not None and self._same_cycle(one, self._leaving) for one in others)

    def leave(self, release: Release | None, now_ns: int) -> None:
        """The oldest message leaves, or is dropped; None: it is not this gate's to decide."""
        self.waiting.popleft()
        self.free_ns = now_ns
        if release is not None and release.slot is not None:
            self._left = self._leaving

    def _release(self, message: Waiting, ready_ns: int) -> Release:
        return release_of(
            *(self.gate, message.arrival_ns, message.stamp_ns, self.changes),
            ready_ns=ready_ns,
            phase_ns=message.phase_ns,
            moves=self.moves,
        )

    def _same_cycle(self, release: Release, start_ns: int | None) -> bool:
        """Stamps are not quite periodic: cycles are the same less than half a cycle apart."""
        cycle_ns = self.gate.cycle_ns
        return start_ns is not None and 2 * abs(release.start_ns(cycle_ns) - start_ns) < cycle_ns


class Shaper:
    """A gate at work: holds each message until its release, and minds the clocks.

    Stamps are CLOCK_REALTIME, and the wall clock may be stepped: its offset is taken anew for every
    message. Messages under way during a step are anchored to the cycle instead, at the phase that
    the last good stamp had.

    One shaper belongs to one thread, which does nothing else at the time of a release. Its owner
    sets what it calls: ``look`` has new messages :meth:`arrive`, while others wait, before each
    release and behind it. ``moved`` says with each message how slots are to be moved
    (:meth:`move_slots`; None: as before). ``on_waking`` gets the time of a release ``spin_ns``
    before it; ``on_decision`` each decision, before it is waited for, and where cycles begin.
    """

    def __init__(self, gate: Gate, spin_ns: int = 0) -> None:
        self.gate, self.queue = gate, Queue(gate)
        self.spin_ns = spin_ns
        self.overflowed: list[Outcome] = []  # since the owner has emptied it
        self.look: Callable[[], None] = lambda: None
        self.moved: Callable[[], tuple[int, int] | None] = lambda: None
        self.on_waking: Callable[[int], None] = lambda _: None
        self.on_decision: Callable[[Release, int], None] = lambda *_: None
        self._looked_ns = self._waited_ns = self._turn_ns = 0
        self._offset = clock_offset()
        self._next_phase: tuple[int, int] | None = None  # from when on, and which
        self._thread, self._schedstat = 0, -1

    def set_phase(self, phase_ns: int, now_ns: int) -> None:
        """Cycles begin elsewhere, from the first such beginning after ``now_ns`` on."""
        self._next_phase = (now_ns + (phase_ns - now_ns) % self.gate.cycle_ns, phase_ns)

    def move_slots(self, by_ns: int, from_ns: int) -> None:
        """Slots of cycles that begin at ``from_ns`` or later are moved by so much from where the
        gate has them, unless that is where they are, or they would leave the cycle.
        """
        moves = self.queue.moves
        if by_ns != (moves[-1][1] if moves else 0) and self.gate.may_move(by_ns):
            moves.append((from_ns, by_ns))

    def switch(self, mode: str | None, now_ns: int) -> bool:
        """A mode is announced, in force from the next cycle on; False: there is none like it."""
        modes, changes = self.gate.modes, self.queue.changes
        if modes is None or mode is None or mode not in modes.bands:
            return False
        if mode != (changes[-1][1] if changes else modes.default):
            changes.append((now_ns, mode))
        return True

    def arrive(
        self,
        payload: bytes,
        now_ns: int,
        source_ns: int | None = None,
        about: Any = None,
        lost: int | None = None,
    ) -> None:
        """A message was taken now. With ``source_ns`` (CLOCK_REALTIME) it counts as having come
        then, if that is after the last look: it waited in the reader.
        """
        offset = clock_offset()
        stepped = abs(offset - self._offset) > STEP_NS
        self._offset = offset
        if stepped:
            self.queue.doubt_stamps(now_ns)
        stamp, arrival = origin_of(payload), now_ns
        if source_ns is not None and not stepped:
            arrival = min(now_ns, max(self._looked_ns, source_ns - offset))
        if self._next_phase is not None and arrival >= self._next_phase[0]:
            self.queue.phase_ns = self._next_phase[1]
            self._next_phase = None
        if (moved := self.moved()) is not None:
            self.move_slots(*moved)
        stamp = None if stamp is None else stamp - offset
        if (full := self.queue.arrive(payload, arrival, stamp, about, lost)) is not None:
            self.overflowed.append(full)

    def hold(self) -> Outcome | None:
        """Wait until the oldest message leaves, or is dropped; None: it was overflowed meanwhile.

        Where overruns are discarded, so is a message that came in time and would leave behind its
        slot because this thread woke late.
        """
        queue = self.queue
        message, now = queue.waiting[0], time.monotonic_ns()
        self._turn_ns = now  # before, this thread was busy with the message before it
        release = queue.decide()
        self.on_decision(release, queue.phase_ns)
        if release.at_ns is not None:
            self._waited_ns = self._others_ran_ns()
            slept = release.at_ns > now
            while (awake := release.at_ns - self.spin_ns) > now:
                sleep_until(min(awake, now + LOOK_NS))
                self._look()
                now = time.monotonic_ns()
            if not slept and self.gate.messages == "newest":
                self._look()
            if queue.waiting[0] is not message:
                return None
            if queue.replaced(release, now):
                release = release.dropping("replaced")
        if release.at_ns is not None:
            if slept:
                self.on_waking(release.at_ns)
                if time.monotonic_ns() < release.at_ns:
                    # Awake in time: what other threads took before is of no consequence.
                    self._waited_ns = self._others_ran_ns()
            now = watch_until(release.at_ns)
            if self.gate.policy == "discard" and missed(self.gate, release, now):
                release = replace(release.dropping("discarded"), overrun="discard")
        queue.leave(release, now)
        return Outcome(message, release, now)

    def _look(self) -> None:
        now = time.monotonic_ns()
        self.look()
        self._looked_ns = now

    def nothing_due(self, until_ns: int | None = None) -> bool:
        """Whether there is time for something else, until an instant, before the next release."""
        if not self.queue.waiting:
            return True
        at_ns = self.queue.decide().at_ns
        until_ns = time.monotonic_ns() + OTHERS_NS if until_ns is None else until_ns
        return at_ns is not None and at_ns > until_ns + self.spin_ns

    def rest(self, published_ns: int, pause_ns: int) -> None:
        """Pause behind a publication, unless another message has to leave meanwhile."""
        self.queue.free_ns = published_ns
        self._look()
        if self.nothing_due(published_ns + pause_ns):
            sleep_until(published_ns + pause_ns)
            self.queue.free_ns = time.monotonic_ns()

    def time_lost(self, release: Release, until_ns: int) -> int:
        """How much of the delay from a release until now, right after publishing, no thread used:
        interrupts, or a core that was taken away from the whole system (ns).
        """
        since_ns = max(release.at_ns or 0, self._turn_ns)
        return max(0, until_ns - since_ns - (self._others_ran_ns() - self._waited_ns))

    def _others_ran_ns(self) -> int:
        """For how long this thread has been ready while others ran, by the second number of its
        schedstat (kernel: scheduler/sched-stats.rst); without one, all delay is other threads'.
        """
        if self._thread != threading.get_ident():  # the file is bound to who opened it
            self._thread, self._schedstat = threading.get_ident(), -1
            with suppress(OSError):
                self._schedstat = os.open("/proc/thread-self/schedstat", os.O_RDONLY)
        if self._schedstat < 0:
            return time.monotonic_ns()
        return int(os.pread(self._schedstat, 128, 0).split()[1])


# The throttler's rules: which messages of an input, not quite periodic, pass on (paper, 5.1).
#
# ``newest``: at fixed instants, once a period, the newest that came since the last one.
#
# ``first``, the paper's: as they come, but none that "has not come after a certain time interval
# with respect to the previous one" that passed. A whole period would halve an input that is a
# little faster, so it is four fifths; and only the first of each period passes. Periods follow each
# other, each from a fifth before its message is due: behind a late message none is lost.

Rule: TypeAlias = Literal["newest", "first"]
RULES = get_args(Rule)
EARLY_DIVISOR = 5  # a message may come early by a period divided by this


class FirstOfPeriod:
    """The rule ``first`` for one topic; times are ns of CLOCK_MONOTONIC, ascending.

    k + 1 messages that pass take more than k - 1 periods. An input passes whole that comes a period
    apart or more, or periodically but for delays of at most a fifth of a period. Of one that comes
    0.8 to 1 periods apart, one message passes in every period.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns, self._early_ns = period_ns, period_ns // EARLY_DIVISOR
        self._due_ns = self._passed_ns = -2 * period_ns  # the first one passes

    def passes(self, now_ns: int) -> bool:
        """Whether a message that comes now passes."""
        if now_ns < max(self._due_ns, self._passed_ns + self._period_ns) - self._early_ns:
            return False
        none_came = now_ns >= self._due_ns + self._period_ns - self._early_ns
        self._due_ns = (now_ns if none_came else self._due_ns) + self._period_ns
        self._passed_ns = now_ns
        return True
