"""How old data are when a loop reads them: from the times of a chain and of a loop that reads it.

A chain begins every CT, and its message is stored for the loop between ``a`` and ``b`` behind its
beginning. The loop begins an instance every T, at a *phase* behind a cycle of the chain or up to
its *jitter* J later, and uses the newest message that was stored before. With g the greatest common
divisor of T and CT, instances begin in all of

    [phase + i · g, phase + i · g + J],  i = 0, 1, 2, …

behind some cycle of the chain, and nowhere else. Two things follow.

* Chance decides which message an instance uses if and only if one of these intervals *straddles*
  the storing: it ends behind ``a`` and does not begin behind ``b``.
* Where none does, the age at a message's first use takes as many values as multiples of g fit into
  the shorter of T and CT. It is constant if and only if one of these two is a multiple of the
  other.
"""

import math
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class LoopTimes:
    """When a chain stores its messages, and when a loop reads them; all times in ns.

    * ``cycle_ns``: from one cycle of the chain to the next.
    * ``stored_ns``: when a message is stored behind the beginning of its cycle, the earliest and
      the latest time; they are less than a cycle apart.
    * ``period_ns``: of the loop.
    * ``phase_ns``: how long after a cycle of the chain an instance begins, at the earliest. None:
      any time, as the clocks of chain and loop differ, or the loop is started anew.
    * ``jitter_ns``: how much later it may begin.
    """

    cycle_ns: int
    stored_ns: tuple[int, int]
    period_ns: int
    phase_ns: int | None
    jitter_ns: int = 0

    @property
    def common_ns(self) -> int:
        """The distance of instances in the chain's cycle; 1 ns: they may begin at any time."""
        return 1 if self.phase_ns is None else math.gcd(self.cycle_ns, self.period_ns)


@dataclass(frozen=True)
class Ages:
    """How old data are when a loop reads them (ns, from the beginning of the chain's cycle).

    * ``first_ns``: at the first use of a message, lowest and highest.
    * ``every_ns``: in all of the loop's cycles, also those that use a message again.
    * ``uses``: in how many cycles a message is used, fewest and most.
    * ``straddled``: whether chance decides which message an instance uses.
    """

    first_ns: tuple[int, int]
    every_ns: tuple[int, int]
    uses: tuple[int, int]
    straddled: bool


def ages(times: LoopTimes) -> Ages:
    """Return how old the data of a loop are, exactly: each bound is reached."""
    earliest, latest = times.stored_ns
    period, jitter, cycle = times.period_ns, times.jitter_ns, times.cycle_ns
    first, last = _first_reading(times), _last_before_next(times)
    highest = min(last + jitter, latest + cycle)
    # An instance before the first use came too early for the message.
    highest_first = min(last + min(0, period - cycle) + jitter, highest)
    return Ages(
        first_ns=(max(first, earliest + 1), highest_first),
        every_ns=(max(first, earliest + 1), highest),
        uses=_uses(times),
        straddled=first <= latest,
    )


def straddles(times: LoopTimes) -> bool:
    """Whether an instance may begin while a message is stored, so that chance decides its use."""
    return _first_reading(times) <= times.stored_ns[1]


def later_without_straddling(times: LoopTimes) -> int | None:
    """Return how much later messages have to be stored, at least, so that no instance straddles it.

    None: none of all times is free.
    """
    earliest, latest = times.stored_ns
    if latest - earliest + times.jitter_ns >= times.common_ns:
        return None
    first = _first_reading(times)
    return first + times.jitter_ns - earliest if first <= latest else 0


def start_in_step(starts_ns: tuple[int, int], lead_ns: int, phase_ns: int, common_ns: int) -> int:
    """Return the start of a slot that lies so long before a loop's instance; times in ns.

    ``starts_ns``: where it starts, earliest and latest, behind the beginning of the chain's cycle.
    ``lead_ns``: how long before the instance, at least; more, where the latest start is before it.
    The loop uses the message then in the same instance. ``common_ns`` is the greatest common
    divisor of the chain's cycle and the loop's period: so far apart its instances begin in a cycle,
    the first of them at ``phase_ns``.
    """
    earliest, latest = starts_ns
    return min(earliest + (phase_ns - lead_ns - earliest) % common_ns, latest)


def move_into_step(start_ns: int, lead_ns: int, phase_ns: int, common_ns: int) -> int:
    """Return how much later a loop's instances have to begin, so long behind a slot's start.

    It is less than ``common_ns``; for the rest see :func:`start_in_step`.
    """
    return (start_ns + lead_ns - phase_ns) % common_ns


def at_any_phase(times: LoopTimes) -> LoopTimes:
    """Return the same times for a loop of which the phase is not known."""
    return replace(times, phase_ns=None)


def _first_reading(times: LoopTimes) -> int:
    """Return when the first interval of instances begins that ends behind the earliest store."""
    since = times.stored_ns[0] + 1 - times.jitter_ns
    return since + ((times.phase_ns or 0) - since) % times.common_ns


def _last_before_next(times: LoopTimes) -> int:
    """Return when the last interval begins in which the next message need not be stored."""
    until = times.stored_ns[1] + times.cycle_ns
    return until - (until - (times.phase_ns or 0)) % times.common_ns


def _uses(times: LoopTimes) -> tuple[int, int]:
    """Return in how many instances a message is used, fewest and most."""
    earliest, latest = times.stored_ns
    period, common, phase = times.period_ns, times.common_ns, times.phase_ns or 0
    # All that begin behind its latest store and end before the earliest store of the next use it.
    since, until = latest + 1, earliest + times.cycle_ns - times.jitter_ns
    begins_last = since + (phase - since) % common + period - common
    fewest = max(0, (until - begins_last) // period + 1)
    # All that may begin behind its earliest store and before the latest store of the next may.
    since, until = earliest + 1 - times.jitter_ns, latest + times.cycle_ns
    begins_first = since + (phase - since) % common
    return fewest, (until - begins_first) // period + 1
