"""What changes a gate while it runs: from some cycle on, another schedule holds.

A gate keeps its schedules in the order of their beginnings. In a cycle that schedule is in force
which began last, at the start of the cycle or before. So all messages of a cycle have one mode, and
a server's slots move between two cycles, never within one. For a message there are two cycles:

* **its own**, which starts at its stamp, or, where that is of no use, at the gate's phase. The
  message leaves in a slot of the **mode** of its own cycle: what it says was computed in that mode.
* the one in which **it leaves**, a later one where the message has overrun, or is due later. It
  leaves in the **slots** as they lie in that cycle, since the server opens there.

The **phase** says where a cycle starts that no stamp names: the message's own one, at its arrival.

The same in C++ is `core/gate/schedules.hpp`.
"""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

from chainshaper.robot.gate import Gate

SCHEDULES = 64  # so many are remembered: they reach back behind the oldest stamp


@dataclass(frozen=True, slots=True)
class Schedule:
    """What holds at a gate from some cycle on. Times are ns of CLOCK_MONOTONIC.

    * ``from_ns``: it holds in cycles that start then or later.
    * ``phase_ns``: an instant at which a cycle starts, for messages whose stamp is of no use.
    * ``moved_ns``: by how much the slots are moved from where the gate has them.
    * ``mode``: the mode of the system; None: there are no modes.
    """

    from_ns: int
    phase_ns: int
    moved_ns: int = 0
    mode: str | None = None


Schedules: TypeAlias = tuple[Schedule, ...]


def first_schedule(gate: Gate) -> Schedule:
    """Return the schedule that a gate begins with."""
    mode = None if gate.modes is None else gate.modes.default
    return Schedule(from_ns=0, phase_ns=gate.phase_ns, mode=mode)


def schedule_in_force(schedules: Sequence[Schedule], start_ns: int) -> Schedule:
    """Return the schedule of the cycle that starts at this time.

    The first one that is remembered holds in all cycles before it, too.
    """
    return schedules[_place_in_force(schedules, start_ns)]


def _place_in_force(schedules: Sequence[Schedule], start_ns: int) -> int:
    """Return the place of the schedule of the cycle that starts at this time."""
    for place in range(len(schedules) - 1, 0, -1):
        if schedules[place].from_ns <= start_ns:
            return place
    return 0


def with_change(
    schedules: Schedules,
    from_ns: int,
    *,
    phase_ns: int | None = None,
    moved_ns: int | None = None,
    mode: str | None = None,
) -> Schedules:
    """Return the schedules with another phase, place of the slots, or mode from some cycle on.

    What is None stays as it is. Schedules that begin later, because they were announced ahead, get
    the change as well: it holds until the next one of its kind is announced.

        >>> schedules = with_change((Schedule(0, phase_ns=7),), 200, moved_ns=10)
        >>> schedules = with_change(schedules, 100, phase_ns=50)
        >>> [(each.from_ns, each.phase_ns, each.moved_ns) for each in schedules]
        [(0, 7, 0), (100, 50, 0), (200, 50, 10)]
    """

    def changed(schedule: Schedule, from_ns: int) -> Schedule:
        return Schedule(
            from_ns,
            schedule.phase_ns if phase_ns is None else phase_ns,
            schedule.moved_ns if moved_ns is None else moved_ns,
            schedule.mode if mode is None else mode,
        )

    place = bisect_right([schedule.from_ns for schedule in schedules], from_ns)
    in_force = schedules[max(0, place - 1)]
    later = [changed(schedule, schedule.from_ns) for schedule in schedules[place:]]
    changes_nothing = changed(in_force, in_force.from_ns) == in_force
    if changes_nothing and later == [*schedules[place:]]:
        return schedules
    return (*schedules[:place], changed(in_force, from_ns), *later)[-SCHEDULES:]


def with_phase_seen(schedules: Schedules, phase_ns: int, arrival_ns: int) -> Schedules:
    """Return the schedules with the phase that a good stamp shows.

    The schedule that is in force at the message's arrival gets it, and with it those later ones
    that took their phase over from that one.
    """
    place = _place_in_force(schedules, arrival_ns)
    before_ns = schedules[place].phase_ns
    if phase_ns == before_ns:
        return schedules
    seen = (
        replace(schedule, phase_ns=phase_ns) if schedule.phase_ns == before_ns else schedule
        for schedule in schedules[place:]
    )
    return (*schedules[:place], *seen)
