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
from dataclasses import Field, dataclass, fields
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias, get_args, get_origin

Anchor: TypeAlias = Literal["stamp", "cycle"]
Overrun: TypeAlias = Literal["wait", "discard", "publish"]
Late: TypeAlias = Literal["wait", "discard", "publish", "next-slot"]
IntoOpenSlot: TypeAlias = Literal["at-once", "next-slot"]
Messages: TypeAlias = Literal["all-in-order", "newest"]
ANCHORS, OVERRUNS, LATE = get_args(Anchor), get_args(Overrun), get_args(Late)
INTO_OPEN_SLOT, MESSAGES = get_args(IntoOpenSlot), get_args(Messages)

DEPTH = 10  # messages that may wait at a gate by default
MAX_FUTURE_NS = 1_000_000  # a stamp further ahead of the arrival is of no use
MAX_AGE_CYCLES = 10  # neither is a stamp older than this, behind the message's due cycle


def _check_word(key: str, word: str, choices: Sequence[str]) -> None:
    if word not in choices:
        raise ValueError(f"{key} {word!r}: choose one of {', '.join(choices)}")


@dataclass(frozen=True)
class GateModes:
    """The slot that the messages of each mode of the system leave in.

    * ``slots``: the place of each mode's slot among the gate's, from 0. Users number them from 1,
      as bands of a plan.
    * ``default``: the mode in force until one is announced.
    * ``late``: what happens to a message behind its mode's slot; with ``next-slot`` one that comes
      behind the last slot is still an overrun.
    """

    slots: Mapping[str, int]
    default: str
    late: str = "wait"

    def __post_init__(self) -> None:
        if self.default not in self.slots:
            choose = f"choose one of {', '.join(self.slots)}"
            raise ValueError(f"the default mode {self.default!r} has no band: {choose}")
        _check_word("late", self.late, LATE)


class AtLeast(NamedTuple):
    """The smallest value of a number, and the message about a smaller one."""

    number: int
    otherwise: str


def limit_of(declared: "Field[Any]") -> AtLeast | None:
    """Return the limit of a field; None: it has none."""
    limits = (limit for limit in get_args(declared.type) if isinstance(limit, AtLeast))
    return next(limits, None)


@dataclass(frozen=True)
class Gate:
    """The publish slots of one output, and what happens to its messages.

    This is the one declaration of a gate's fields. Names in ``_ns`` are times in nanoseconds. From
    its numbers and words derive the ROS parameters (:mod:`chainshaper.robot.node_parameters`), the
    values in C++ (`scripts/gate-words`), the description in YAML
    (:class:`chainshaper.workload.description.GateDescription`) and what the simulator gets.

    * ``slots``: half-open ``(start, end)`` intervals in ns, counted from the start of the cycle;
      ascending, apart from each other, inside ``[0, cycle_ns)``.
    * ``cycle_ns``: the time from the start of one cycle to the next.
    * ``anchor``: where a cycle starts: at the stamp of the message, or where the servers start it.
    * ``phase_ns``: an instant at which a cycle starts, for the anchor ``cycle``, and for a stamp
      that is of no use: older than :data:`MAX_AGE_CYCLES`, or from the future.
    * ``overrun``: what happens to a message behind the last slot that it was due in.
    * ``due_cycles``: cycles from the one that a message belongs to until the one that it is due in
      (logical execution time); it leaves in none before. With the anchor ``cycle`` a message
      belongs to the cycle it arrives in, and is due in the next one at the latest: the data of each
      callback came a cycle before.
    * ``modes``: which slots the messages of each mode leave in; None: there are no modes.
    * ``messages``: which of several messages in one cycle leave.
    * ``depth``: how many messages may wait.
    * ``into_open_slot``: when a message leaves that arrives in an open slot.

    Raises ValueError: such a gate makes no sense.
    """

    slots: tuple[tuple[int, int], ...]
    cycle_ns: Annotated[int, AtLeast(1, "cycle of {} ns: it must be longer than nothing")]
    anchor: Anchor = "stamp"
    phase_ns: int = 0
    overrun: Overrun = "wait"
    due_cycles: Annotated[int, AtLeast(0, "due {} cycles later: no message is due beforehand")] = 0
    modes: GateModes | None = None
    messages: Messages = "all-in-order"
    depth: Annotated[int, AtLeast(1, "room for {} messages: a gate needs it for one at least")] = (
        DEPTH
    )
    into_open_slot: IntoOpenSlot = "at-once"

    def __post_init__(self) -> None:
        for declared in fields(self):
            value, limit = getattr(self, declared.name), limit_of(declared)
            if get_origin(declared.type) is Literal:
                _check_word(declared.name, value, get_args(declared.type))
            if limit is not None and value < limit.number:
                raise ValueError(limit.otherwise.format(value))
        if not self.slots:
            raise ValueError("a gate without slots would never let anything through")
        previous_end = 0
        for start, end in self.slots:
            if not previous_end <= start < end <= self.cycle_ns:
                rule = "slots must ascend, not overlap and lie within the cycle"
                raise ValueError(f"slot [{start}, {end}) ns: {rule}")
            previous_end = end
        for mode, place in ({} if self.modes is None else self.modes.slots).items():
            if not 0 <= place < len(self.slots):
                bands = f"bands are numbered 1 to {len(self.slots)}"
                raise ValueError(f"mode {mode!r}: band {place + 1}, but {bands}")

    def may_move(self, by_ns: int) -> bool:
        """Return whether slots that are moved by this time still lie within the cycle."""
        return self.slots[0][0] + by_ns >= 0 and self.slots[-1][1] + by_ns <= self.cycle_ns

    @property
    def policy(self) -> str:
        """What happens to a message that comes behind the last slot that is open to it."""
        if self.modes is None or self.modes.late == "next-slot":
            return self.overrun
        return self.modes.late

    def lets_out(self, slot: tuple[int, int], from_ns: int, arrival_ns: int, ready_ns: int) -> bool:
        """Return whether a message may leave in a slot, or wait for it.

        ``from_ns`` is the start of the slot's cycle; the message is ready at ``ready_ns``.
        """
        in_time = self.into_open_slot == "at-once" or arrival_ns <= from_ns + slot[0]
        return in_time and ready_ns < from_ns + slot[1]

    def counts_from(self, stamp_ns: int | None, arrival_ns: int) -> bool:
        """Return whether a message's slots count from its stamp."""
        if stamp_ns is None or self.anchor != "stamp":
            return False
        max_age = (MAX_AGE_CYCLES + self.due_cycles) * self.cycle_ns
        return -MAX_FUTURE_NS <= arrival_ns - stamp_ns <= max_age


VALUES = tuple(
    declared for declared in fields(Gate) if declared.name not in ("slots", "modes", "depth")
)
"""The declarations of a gate's values that are one number or one word."""


def values_of(gate: Gate) -> dict[str, int | str]:
    """Return a gate's values that are one number or one word, by their names."""
    return {declared.name: getattr(gate, declared.name) for declared in VALUES}
