"""The gate's decision for one message: when it may leave, or why it never does.

What may change from one cycle to the next is in the gate's schedules (`schedules.py`).
The same decision in C++ is `core/gate/decision.hpp`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, get_args

from chainshaper.robot.gate import Gate
from chainshaper.robot.schedules import Schedule, first_schedule, schedule_in_force

Dropped: TypeAlias = Literal["replaced", "overflowed", "discarded"]
DROPPED = get_args(Dropped)


@dataclass(slots=True)  # making a frozen one takes a microsecond more, on the way of every message
class Release:
    """The gate's decision for one message. Times are ns of CLOCK_MONOTONIC.

    * ``at_ns``: when the message may leave; not after its arrival: at once; None: it is dropped.
    * ``origin_ns``: when the message's own cycle starts.
    * ``slot``: the place of the slot that it leaves in, from 0; None: it leaves in no slot.
    * ``cycles_waited``: cycles from its own to the one it leaves in.
    * ``anchor``: what its slots were counted from.
    * ``overrun``: the policy that was applied to it; None: it came in time.
    * ``mode``: the mode of its cycle; None: there are no modes.
    * ``moved_ns``: by how much the slots of the cycle in which it leaves are moved.
    * ``dropped``: the reason why it never leaves; None: it leaves.
    """

    at_ns: int | None
    origin_ns: int
    slot: int | None
    cycles_waited: int
    anchor: str
    overrun: str | None = None
    mode: str | None = None
    moved_ns: int = 0
    dropped: str | None = None

    def start_ns(self, cycle_ns: int) -> int:
        """Return when the cycle starts in which the message leaves."""
        return self.origin_ns + self.cycles_waited * cycle_ns

    def dropping(self, reason: Dropped) -> "Release":
        """Return the decision to drop the message instead."""
        return replace(self, at_ns=None, slot=None, dropped=reason)


def release_of(
    gate: Gate,
    arrival_ns: int,
    stamp_ns: int | None,
    schedules: Sequence[Schedule] = (),
    *,
    ready_ns: int | None = None,
    phase_ns: int | None = None,
) -> Release:
    """Decide when a message may leave. Times are ns of CLOCK_MONOTONIC.

    * ``stamp_ns``: the message's origin; None: it has none.
    * ``schedules``: what holds from which cycle on; none: what the gate says.
    * ``ready_ns``: the message leaves at this time at the earliest, because others leave before it;
      None: at its arrival.
    * ``phase_ns``: where cycles started when the message came; None: as its schedule has it.

        >>> gate = Gate(slots=((60, 61),), cycle_ns=100)
        >>> release_of(gate, arrival_ns=1040, stamp_ns=1000).at_ns      # early: it waits
        1060
        >>> release_of(gate, arrival_ns=1070, stamp_ns=1000).at_ns      # missed: the next cycle
        1160
        >>> moved = [Schedule(0, phase_ns=0), Schedule(1050, phase_ns=0, moved_ns=10)]
        >>> release_of(gate, 1140, 1100, moved).at_ns
        1170
        >>> modes = GateModes(slots={"city": 1, "highway": 0}, default="city", late="next-slot")
        >>> gate = Gate(slots=((20, 21), (60, 61)), cycle_ns=100, modes=modes)
        >>> release_of(gate, 1110, 1100, [Schedule(1050, phase_ns=0, mode="highway")]).at_ns
        1120
    """
    cycle_ns, modes, policy = gate.cycle_ns, gate.modes, gate.policy
    schedules = schedules or (first_schedule(gate),)
    if stamp_ns is not None and gate.counts_from(stamp_ns, arrival_ns):
        origin, anchor, due = stamp_ns, "stamp", gate.due_cycles
    else:
        if phase_ns is None:
            phase_ns = schedule_in_force(schedules, arrival_ns).phase_ns
        elapsed = (arrival_ns - phase_ns) % cycle_ns
        origin, anchor, due = arrival_ns - elapsed, "cycle", min(gate.due_cycles, 1)
    mode, first, slots = None, 0, gate.slots
    if modes is not None:
        mode = schedule_in_force(schedules, origin).mode or modes.default
        first = modes.slots[mode]
        slots = slots[first : None if modes.late == "next-slot" else first + 1]
    ready = arrival_ns if ready_ns is None else max(arrival_ns, ready_ns)
    # A stamp slightly from the future puts the arrival before its own cycle: cycle 0 still.
    cycle = max(due, (ready - origin) // cycle_ns)
    due_from = origin + due * cycle_ns
    moved = schedule_in_force(schedules, due_from).moved_ns
    if policy != "wait" and not gate.lets_out(slots[-1], due_from + moved, arrival_ns, ready):
        at_once = Release(ready, origin, None, cycle, anchor, policy, mode, moved)
        return at_once if policy == "publish" else at_once.dropping("discarded")
    while True:
        cycle_start = origin + cycle * cycle_ns
        moved = schedule_in_force(schedules, cycle_start).moved_ns
        for number, slot in enumerate(slots, first):
            if gate.lets_out(slot, cycle_start + moved, arrival_ns, ready):
                at = max(ready, cycle_start + moved + slot[0])
                later = "next-slot" if mode is not None and number > first else None
                treated = "wait" if cycle > due else later
                return Release(at, origin, number, cycle, anchor, treated, mode, moved)
        cycle += 1


def missed(gate: Gate, release: Release, now_ns: int) -> bool:
    """Return whether the slot that the message was to leave in is over."""
    if release.slot is None:
        return False
    cycle_start = release.start_ns(gate.cycle_ns) + release.moved_ns
    return now_ns >= cycle_start + gate.slots[release.slot][1]
