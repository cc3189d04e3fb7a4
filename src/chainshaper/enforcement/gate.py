"""The gate: when may a message of the chain's output leave?

A latency-shaping node receives the chain's output early, late or somewhere between, and lets it
go only inside the publish slots of its server R_m° (paper, sections 3.2.2 and 3.3). The gate
*is* that server: no kernel support is needed to hold back one's own publication.

Slots repeat every cycle and are counted from an **anchor**, the instant at which a cycle starts:

* ``stamp``: the cycle starts when the chain started, which the message itself says (its first
  field is a ``std_msgs/Header``). Latency is constant even when the first callback's timer
  drifts or starts late.
* ``cycle``: cycles start at ``phase_ns`` of CLOCK_MONOTONIC and every cycle thereafter, whatever
  the messages say. The output is strictly periodic, and messages need no stamp.

A message that arrives before a slot waits for its start; one that arrives inside a slot leaves
at once. One that comes behind the last slot it was due in is an **overrun** (section 6): the
chain ran longer than it was planned for. What becomes of it is a policy:

* ``wait``: it takes the first slot of a later cycle, so that outputs come in slots only;
* ``discard``: it is never published, so that nobody acts on old data;
* ``publish``: it leaves at once, so that it does not become older still.

With **modes** (section 3.3) each mode of the system has its own slot: the latency is constant
within a mode, and the servers stay as they are when it changes. An early message waits for the
slot of its mode, past the slots before it; one that comes behind it is treated like an overrun,
by a policy of its own, which may also be ``next-slot``: it takes the next slot of the cycle.
Which mode a message has is decided by the cycle it belongs to: a change is in force from the
first cycle that begins after it was announced, and no cycle has two modes.

This module is deliberately free of any import outside the standard library: it also runs
inside a ROS 2 node, where nothing of ours may be installed.
"""

import ctypes
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, get_args

__all__ = [
    "ANCHORS",
    "LATE",
    "OVERRUNS",
    "STALL_NS",
    "Anchor",
    "Gate",
    "Late",
    "Modes",
    "Overrun",
    "Release",
    "Shaper",
    "clock_offset",
    "missed",
    "origin_of",
    "release_of",
    "sleep_until",
    "text_of",
    "watch_until",
]

Anchor: TypeAlias = Literal["stamp", "cycle"]
Overrun: TypeAlias = Literal["wait", "discard", "publish"]
Late: TypeAlias = Literal["wait", "discard", "publish", "next-slot"]
ANCHORS, OVERRUNS, LATE = get_args(Anchor), get_args(Overrun), get_args(Late)

STALL_NS = 100_000
"""A thread may wake up so late on a machine that does not stall."""


@dataclass(frozen=True)
class Modes:
    """Which slot the messages of each mode leave in.

    ``bands`` has the place of every mode's slot in the gate's ``slots``. ``default`` is in force
    until a mode is announced. ``late`` says what becomes of a message that comes behind its
    mode's slot; with ``next-slot`` one that comes behind the last slot, too, is an overrun like
    any other.
    """

    bands: Mapping[str, int]
    default: str
    late: str = "wait"

    def __post_init__(self) -> None:
        if self.default not in self.bands:
            raise ValueError(
                f"the default mode {self.default!r} has no band: choose one of "
                f"{', '.join(self.bands)}"
            )
        if self.late not in LATE:
            raise ValueError(f"late {self.late!r}: choose one of {', '.join(LATE)}")


@dataclass(frozen=True)
class Gate:
    """The publish slots of one output. All times are nanoseconds.

    ``slots`` are half-open ``(start, end)`` intervals counted from the anchor, ascending, apart
    from each other and inside ``[0, cycle_ns)``. ``phase_ns`` anchors cycles to CLOCK_MONOTONIC;
    with the ``stamp`` anchor it is used for messages whose stamp is of no use. A stamp is of use
    when its message is at most ``max_age_ns`` old and comes at most ``max_future_ns`` from the
    future (clocks of different hosts disagree a little).

    A message is due in the cycle that it belongs to, or ``due_cycles`` later (1 under logical
    execution time); what comes behind the last slot of that cycle is treated as ``overrun``
    says. With the ``cycle`` anchor a message belongs to the cycle that it arrives in, since
    nothing says in which one its chain began.
    """

    slots: tuple[tuple[int, int], ...]
    cycle_ns: int
    anchor: str = "stamp"
    phase_ns: int = 0
    max_age_ns: int | None = None  # None: ten cycles
    max_future_ns: int = 1_000_000
    overrun: str = "wait"
    due_cycles: int = 0
    modes: Modes | None = None

    def __post_init__(self) -> None:
        if self.anchor not in ANCHORS:
            raise ValueError(f"anchor {self.anchor!r}: choose one of {', '.join(ANCHORS)}")
        if self.overrun not in OVERRUNS:
            raise ValueError(f"overrun {self.overrun!r}: choose one of {', '.join(OVERRUNS)}")
        if self.due_cycles < 0:
            raise ValueError(f"due {self.due_cycles} cycles later: no message is due beforehand")
        if self.cycle_ns <= 0:
            raise ValueError(f"cycle of {self.cycle_ns} ns: it must be longer than nothing")
        if not self.slots:
            raise ValueError("a gate without slots would never let anything through")
        previous_end = 0
        for start, end in self.slots:
            if not previous_end <= start < end <= self.cycle_ns:
                raise ValueError(
                    f"slot [{start}, {end}) ns: slots must ascend, not overlap and lie within the "
                    f"cycle of {self.cycle_ns} ns"
                )
            previous_end = end
        for mode, band in ({} if self.modes is None else self.modes.bands).items():
            if not 0 <= band < len(self.slots):
                raise ValueError(
                    f"mode {mode!r} has the band {band}, but the slots are numbered 0 to "
                    f"{len(self.slots) - 1}"
                )

    @property
    def policy(self) -> str:
        """What becomes of a message that comes behind the last slot that is open to it."""
        if self.modes is None or self.modes.late == "next-slot":
            return self.overrun
        return self.modes.late


@dataclass(frozen=True)
class Release:
    """The gate's decision for one message; times are ns of CLOCK_MONOTONIC.

    ``at_ns`` is when the message may leave (not after the arrival: at once; None: never),
    ``slot`` which of the slots that is (None: it is in none), ``cycles_waited`` how many cycles
    after its own, ``anchor`` what the slots were counted from. ``overrun`` is None for a message
    that came in time, and otherwise the policy that was applied to it. ``mode`` is the mode of
    its cycle; None: there are no modes.
    """

    at_ns: int | None
    origin_ns: int
    slot: int | None
    cycles_waited: int
    anchor: str
    overrun: str | None = None
    mode: str | None = None


def release_of(
    gate: Gate, arrival_ns: int, stamp_ns: int | None, changes: Sequence[tuple[int, str]] = ()
) -> Release:
    """Decide when a message that arrived at ``arrival_ns`` may leave.

    ``stamp_ns`` is its origin on CLOCK_MONOTONIC (see :func:`origin_of`), None if it has none.
    ``changes`` are the modes that were announced, each with the time (ns), ascending.

        >>> gate = Gate(slots=((60, 61),), cycle_ns=100)
        >>> release_of(gate, arrival_ns=1040, stamp_ns=1000).at_ns      # early: held
        1060
        >>> release_of(gate, arrival_ns=1070, stamp_ns=1000).at_ns      # missed: the next cycle
        1160
        >>> gate = Gate(slots=((60, 61),), cycle_ns=100, overrun="publish")
        >>> release_of(gate, arrival_ns=1070, stamp_ns=1000).at_ns      # missed: at once
        1070
        >>> modes = Modes(bands={"city": 1, "highway": 0}, default="city", late="next-slot")
        >>> gate = Gate(slots=((20, 21), (60, 61)), cycle_ns=100, modes=modes)
        >>> release_of(gate, arrival_ns=1010, stamp_ns=1000).at_ns      # early for its mode: held
        1060
        >>> release_of(gate, 1110, 1100, changes=[(1050, "highway")]).at_ns
        1120
    """
    if gate.anchor == "stamp" and stamp_ns is not None and _usable(gate, arrival_ns - stamp_ns):
        origin, anchor = stamp_ns, "stamp"
    else:
        elapsed = (arrival_ns - gate.phase_ns) % gate.cycle_ns
        origin, anchor = arrival_ns - elapsed, "cycle"
    mode, first, slots = None, 0, gate.slots
    if gate.modes is not None:
        mode = _mode_at(gate.modes, origin, changes)
        first, slots = _open_to(gate, gate.modes, mode)
    # A stamp slightly from the future puts the arrival before its own cycle: cycle 0 still.
    cycle = max(0, (arrival_ns - origin) // gate.cycle_ns)
    due_from = origin + gate.due_cycles * gate.cycle_ns
    overran, policy = arrival_ns >= due_from + slots[-1][1], gate.policy
    if overran and policy != "wait":
        at_once = arrival_ns if policy == "publish" else None
        return Release(at_once, origin, None, cycle, anchor, policy, mode)
    treated = "wait" if overran else None
    if mode is not None and not overran and arrival_ns >= due_from + slots[0][1]:
        treated = "next-slot"
    while True:
        cycle_start = origin + cycle * gate.cycle_ns
        for slot, (start, end) in enumerate(slots, first):
            if arrival_ns < cycle_start + end:
                at = max(arrival_ns, cycle_start + start)
                return Release(at, origin, slot, cycle, anchor, treated, mode)
        cycle += 1


def _mode_at(modes: Modes, origin_ns: int, changes: Sequence[tuple[int, str]]) -> str:
    """The mode of the cycle that began at ``origin_ns``."""
    announced = (mode for since, mode in reversed(changes) if since <= origin_ns)
    return next(announced, modes.default)


def _open_to(gate: Gate, modes: Modes, mode: str) -> tuple[int, tuple[tuple[int, int], ...]]:
    """The slots that are open to a mode, behind the place of the first of them."""
    band = modes.bands[mode]
    last = len(gate.slots) if modes.late == "next-slot" else band + 1
    return band, gate.slots[band:last]


def missed(gate: Gate, release: Release, now_ns: int) -> bool:
    """Whether the slot that a message was to leave in is over (ns of CLOCK_MONOTONIC)."""
    if release.slot is None:
        return False
    _, end = gate.slots[release.slot]
    return now_ns >= release.origin_ns + release.cycles_waited * gate.cycle_ns + end


def _usable(gate: Gate, age_ns: int) -> bool:
    max_age = 10 * gate.cycle_ns if gate.max_age_ns is None else gate.max_age_ns
    return -gate.max_future_ns <= age_ns <= max_age


def origin_of(payload: bytes) -> int | None:
    """The header stamp of a serialized message in ns of its clock, None if it is zero or short.

    A message whose first field is a ``std_msgs/Header`` has its stamp (int32 seconds, uint32
    nanoseconds) right behind the 4-byte CDR encapsulation header, whose second byte gives the
    byte order. Nothing else of the message needs to be known.
    """
    if len(payload) < 12:
        return None
    order = "little" if payload[1] & 1 else "big"
    seconds = int.from_bytes(payload[4:8], order, signed=True)  # type: ignore[arg-type]
    nanoseconds = int.from_bytes(payload[8:12], order)  # type: ignore[arg-type]
    if (seconds == 0 and nanoseconds == 0) or nanoseconds >= 1_000_000_000:
        return None
    return seconds * 1_000_000_000 + nanoseconds


def text_of(payload: bytes) -> str | None:
    """The text of a serialized ``std_msgs/String``, None where the bytes are none.

    Behind the encapsulation header stand the length, with the final NUL, and the characters.
    """
    if len(payload) < 8:
        return None
    order = "little" if payload[1] & 1 else "big"
    length = int.from_bytes(payload[4:8], order)  # type: ignore[arg-type]
    if not 1 <= length <= len(payload) - 8:
        return None
    return payload[8 : 7 + length].decode(errors="replace")


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


_libc = ctypes.CDLL(None, use_errno=True)
_TIMER_ABSTIME = 1


def sleep_until(deadline_ns: int) -> None:
    """Sleep until an instant of CLOCK_MONOTONIC; returns at once when it has passed.

    ``time.sleep`` takes a relative time, so a pre-emption between computing and sleeping would
    be added to it. An absolute sleep cannot be late for that reason.
    """
    request = _Timespec(*divmod(max(0, deadline_ns), 1_000_000_000))
    while True:
        # A signal ends the sleep early (EINTR, 4); the deadline stays the same.
        error = _libc.clock_nanosleep(
            time.CLOCK_MONOTONIC, _TIMER_ABSTIME, ctypes.byref(request), None
        )
        if error != 4:
            break
    if error:
        raise OSError(error, f"clock_nanosleep: {os.strerror(error)}")


def watch_until(deadline_ns: int) -> int:
    """Watch the clock until an instant of CLOCK_MONOTONIC has come; returns the time then.

    Waking from a sleep costs the kernel some tens of microseconds, and not always the same.
    Watching the clock over the last stretch trades a little CPU time for that variation.
    """
    clock = time.monotonic_ns
    now = clock()
    while now < deadline_ns:
        now = clock()
    return now


def clock_offset() -> int:
    """CLOCK_REALTIME minus CLOCK_MONOTONIC in ns, to a fraction of a microsecond."""
    best_width, best = None, 0
    for _ in range(5):
        before, realtime, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        width = after - before
        if best_width is None or width < best_width:
            best_width, best = width, realtime - (before + after) // 2
        if width < 2_000:  # a longer bracket means that something came between
            break
    return best


class Shaper:
    """A gate at work: holds each message until its release, and minds the clocks.

    Stamps are CLOCK_REALTIME, sleeping is CLOCK_MONOTONIC; the offset between the two is taken
    anew for every message, since NTP or an operator may step the wall clock. A message under way
    during a step has a stamp of which nobody can say to which side it belongs: it is anchored to
    the cycle instead, at the phase that the last good stamp had.

    One shaper belongs to one thread, which does nothing else at the time of a release. That makes
    it a witness of the machine's own stalls (:meth:`time_lost`).

    ``on_waking`` is called with the time of a release when it wakes ``spin_ns`` before that, to
    watch the clock from there; what it does there should be over in time.
    """

    STEP_NS = 500_000  # slewing moves the clock by at most 50 us in a cycle of 100 ms

    def __init__(
        self, gate: Gate, spin_ns: int = 0, on_waking: Callable[[int], None] = lambda _: None
    ) -> None:
        self.gate = gate
        self.spin_ns = spin_ns
        self._on_waking = on_waking
        self._offset = clock_offset()
        self._waiting = _WaitingTime()
        self._waited = 0
        # So many changes reach back further than the oldest stamp that is of use.
        self._changes: deque[tuple[int, str]] = deque(maxlen=64)
        self._next_phase: tuple[int, int] | None = None  # from when on, and which

    def set_phase(self, phase_ns: int, now_ns: int) -> None:
        """Cycles begin elsewhere, from the first such beginning after ``now_ns`` on."""
        self._next_phase = (now_ns + (phase_ns - now_ns) % self.gate.cycle_ns, phase_ns)

    @property
    def mode(self) -> str | None:
        """The mode that was announced last; None without modes."""
        if self.gate.modes is None:
            return None
        return self._changes[-1][1] if self._changes else self.gate.modes.default

    def switch(self, mode: str | None, now_ns: int) -> bool:
        """A mode is announced, in force from the next cycle on; False: there is none like it."""
        if self.gate.modes is None or mode is None or mode not in self.gate.modes.bands:
            return False
        if mode != self.mode:
            self._changes.append((now_ns, mode))
        return True

    def decide(self, payload: bytes, arrival_ns: int) -> Release:
        """When the message that arrived may leave, after :func:`release_of`."""
        offset = clock_offset()
        stepped = abs(offset - self._offset) > self.STEP_NS
        self._offset = offset
        stamp = None if stepped else origin_of(payload)
        origin = None if stamp is None else stamp - offset
        if self._next_phase is not None and arrival_ns >= self._next_phase[0]:
            self.gate = replace(self.gate, phase_ns=self._next_phase[1])
            self._next_phase = None
        release = release_of(self.gate, arrival_ns, origin, self._changes)
        if release.anchor == "stamp":
            phase = release.origin_ns % self.gate.cycle_ns
            self.gate = replace(self.gate, phase_ns=phase)
        return release

    def hold(self, payload: bytes) -> tuple[Release, int, int]:
        """Wait until a message may leave: the decision, its arrival and the time then (ns).

        One that is to be discarded is not waited for. Where overruns are discarded, so is a
        message that came in time and would leave behind its slot because this thread woke late.
        """
        arrival = time.monotonic_ns()
        release = self.decide(payload, arrival)
        if release.at_ns is None:
            return release, arrival, arrival
        self._waited = self._waiting.so_far()
        if release.at_ns > arrival:
            sleep_until(release.at_ns - self.spin_ns)
            self._on_waking(release.at_ns)
            if time.monotonic_ns() < release.at_ns:
                # Awake in time: what other threads took before is of no consequence.
                self._waited = self._waiting.so_far()
        awake = watch_until(release.at_ns)
        if self.gate.policy == "discard" and missed(self.gate, release, awake):
            release = replace(release, at_ns=None, slot=None, overrun="discard")
        return release, arrival, awake

    def time_lost(self, release: Release, until_ns: int) -> int:
        """How much of the delay from a release until then the machine itself took (ns).

        The kernel counts for how long a thread was ready but others ran. What is left of the delay
        until the thread was awake nobody used: interrupts, or a core that was taken away from the
        whole system; until it had published, that takes microseconds besides. To be called right
        after publishing.
        """
        if release.at_ns is None:
            return 0
        return max(0, until_ns - release.at_ns - (self._waiting.so_far() - self._waited))


class _WaitingTime:
    """For how long the calling thread has been ready while others ran, by the kernel's account.

    The second number of `/proc/thread-self/schedstat` (Documentation/scheduler/sched-stats.rst).
    Where the kernel has none, all delay is taken to be other threads', and none the machine's.
    """

    def __init__(self) -> None:
        self._file: int | None = None
        self._thread: int | None = None

    def so_far(self) -> int:
        if self._thread != threading.get_ident():  # the file is bound to who opened it
            self._thread = threading.get_ident()
            try:
                self._file = os.open("/proc/thread-self/schedstat", os.O_RDONLY)
            except OSError:
                self._file = None
        if self._file is None:
            return time.monotonic_ns()
        return int(os.pread(self._file, 128, 0).split()[1])
