"""The instants of a run, live or simulated."""

from dataclasses import dataclass

from chainshaper.workload.description import Application, origin_timer

WARM_UP_CYCLES = 5


@dataclass(frozen=True)
class Timing:
    """The instants of a run in ns, from the timers' common start to the end.

    Live they are of CLOCK_MONOTONIC, simulated of the simulation's clock.
    """

    start_ns: int  # the common start of all timers
    anchor_ns: int  # the first expiry of the timer that starts the chain
    record_from_ns: int  # events before are not recorded
    last_timer_ns: int  # timers expire until then
    stop_ns: int  # executors end then
    period_ns: int  # of the timer that starts the chain

    @property
    def cycles(self) -> int:
        """How many whole cycles are recorded at ``stop_ns``."""
        return (self.stop_ns - self.record_from_ns) // self.period_ns


def timing_of(application: Application, cycles: int, start_ns: int) -> Timing:
    """Compute the instants of a run of ``cycles`` recorded cycles; timers start at ``start_ns``.

    Recording begins just before an expiry of the chain's timer, so that no callback instance is cut
    in two. The run goes on after the last cycle until what began in it is complete.
    """
    _, timer = origin_timer(application)
    period_ns = timer.period_ns or 0
    anchor_ns = start_ns + timer.phase_ns
    first_ns = anchor_ns + WARM_UP_CYCLES * period_ns
    end_ns = first_ns + cycles * period_ns
    before_ns = min(1_000_000, period_ns // 10)
    due_cycles = max(
        (
            callback.gate.gate().due_cycles
            for _, callback in application.callbacks()
            if callback.gate is not None
        ),
        default=0,
    )
    return Timing(
        start_ns=start_ns,
        anchor_ns=anchor_ns,
        record_from_ns=first_ns - before_ns,
        last_timer_ns=end_ns - before_ns,
        stop_ns=end_ns + max(2 * period_ns, 200_000_000) + due_cycles * period_ns,
        period_ns=period_ns,
    )
