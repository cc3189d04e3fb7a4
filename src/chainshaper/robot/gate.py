"""The gate: the publish slots of a chain's output, and what happens to messages that miss them.

A latency-shaping node publishes only inside the slots of its reservation server R_m° (paper,
sections 3.2.2 and 3.3): the gate *is* that server. Slots repeat every cycle. A cycle begins at the
**anchor**: at the ``stamp`` of the message (its first field is a ``std_msgs/Header``), or at
``phase_ns`` of CLOCK_MONOTONIC and every ``cycle_ns`` thereafter.

* A message that arrives before its slot waits for it.
* A message that arrives **into an open slot** leaves ``at-once``, or waits for the ``next-slot``.
  With ``next-slot`` every message of a slot leaves at the start of that slot.
* A message that arrives behind the last slot it was due in is an **overrun** (section 6). The gate
  lets it ``wait`` for a slot of a later cycle, ``discard``s it, or ``publish``es it at once.
* Of several **messages** in one cycle leave ``all-in-order`` (the gate drops the oldest where more
  than ``depth`` wait), or only the ``newest`` of those that wait.
* With **modes** (section 3.3) each mode of the system has a slot of its own.

:mod:`chainshaper.robot.decision` decides about one message, :mod:`chainshaper.robot.waiting` about
those that wait, and :mod:`chainshaper.robot.shaper` adds clocks and sleeping. The gate in C++
(core/gate) takes words and limits from here; every gate runs `tests/robot/gate_conformance.yaml`.

The modules of this room import only each other and the standard library: the Python nodes are
single files that :mod:`chainshaper.splicing` puts together from them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

Anchor: TypeAlias = Literal["stamp", "cycle"]
Overrun: TypeAlias = Literal["wait", "discard", "publish"]
Late: TypeAlias = Literal["wait", "discard", "publish", "next-slot"]
IntoOpenSlot: TypeAlias = Literal["at-once", "next-slot"]
Messages: TypeAlias = Literal["all-in-order", "newest"]
ANCHORS, OVERRUNS, LATE = get_args(Anchor), get_args(Overrun), get_args(Late)
INTO_OPEN_SLOT, MESSAGES = get_args(IntoOpenSlot), get_args(Messages)

DEPTH = 10  # messages that may wait at a gate by default
MAX_FUTURE_NS = 1_000_000  # a stamp further ahead of the arrival is of no use
MAX_AGE_CYCLES = 10  # nor is one older than this, behind the message's due cycle


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
