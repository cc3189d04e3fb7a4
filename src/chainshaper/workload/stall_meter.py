"""The stall meter: a sleeper that notices when the machine itself stood still.

Virtual machines and firmware stop all threads of a core for milliseconds now and then. A thread
at the highest priority that only sleeps and looks at the clock wakes late exactly then; the
figures of a run can only be judged beside what it saw. They run at half their pace as well while
others keep their hardware busy; then the sleeper's wake-ups, which are the same work each time,
take it twice as much CPU time. One process per core:
``python -m chainshaper.workload.stall_meter`` speaks the launcher's protocol. Where it is
not known beforehand how long a run takes, :data:`ENOUGH` ends the watch early.
"""

import signal
import time
from array import array
from collections.abc import Callable

from chainshaper.gate.decision import STALL_NS, sleep_until
from chainshaper.linux.scheduling import (
    lock_memory,
    set_thread_name,
    signalled_with_parent,
    stop_garbage_collection,
)
from chainshaper.workload.event_log import receive, send, send_events, wait_for_leave

__all__ = ["ENOUGH", "NO_PACE", "PERIOD_NS", "PRIORITY", "main", "watch"]

PERIOD_NS = 1_000_000
"""A wake-up costs some 20 us on a virtual machine: more of them would disturb what they watch."""
PRIORITY = 98
"""Above everything it watches, so that none of it looks like a stall."""
ENOUGH = signal.SIGUSR1
WAKEUPS_PER_PACE = 10
"""Wake-ups whose CPU time is taken together: reading that clock is a call of the kernel."""
NO_PACE = -1
ORDINARY = 1_000_000
"""So many ordinary wake-ups are enough to know their median, however long a run takes."""


def watch(
    start_ns: int,
    stop_ns: int,
    period_ns: int = PERIOD_NS,
    threshold_ns: int = STALL_NS,
    enough: Callable[[], bool] = lambda: False,
) -> "tuple[array[int], int, int]":
    """Sleep in steps of ``period_ns`` from ``start_ns`` until ``stop_ns`` on the calling thread.

    It is over as well when ``enough`` says so.

    Returns what was seen as rows of three, the number of wake-ups, and the median lateness of
    the ordinary ones (all ns). A row is a stall (when it should have woken, how late it was,
    NO_PACE) or the pace of some wake-ups (their beginning, how long they lasted, the CPU time of
    one).
    """
    seen = array("q")
    lateness = array("q")
    clock, cpu_clock = time.monotonic_ns, time.thread_time_ns
    due = since = start_ns
    wakeups, used = 0, cpu_clock()
    while due < stop_ns and not enough():
        sleep_until(due)
        now = clock()
        late = now - due
        wakeups += 1
        if late >= threshold_ns:
            seen.extend((due, late, NO_PACE))
            due += late // period_ns * period_ns  # stay on the grid
        elif len(lateness) < ORDINARY:
            lateness.append(late)
        due += period_ns
        if wakeups % WAKEUPS_PER_PACE == 0:
            used_before, used = used, cpu_clock()
            seen.extend((since, now - since, (used - used_before) // WAKEUPS_PER_PACE))
            since = now
    ordinary = sorted(lateness)
    return seen, wakeups, ordinary[len(ordinary) // 2] if ordinary else 0


def main() -> None:
    """Watch the core this process is put on, as the launcher says."""
    spec = receive()
    signalled_with_parent(spec["parent"], signal.SIGKILL)
    set_thread_name("stall-meter")
    signals: list[int] = []
    signal.signal(ENOUGH, lambda number, _: signals.append(number))
    send(missing=[], memory_locked=lock_memory())
    times = receive()
    stop_garbage_collection()
    seen, wakeups, ordinary = watch(
        times["meter_from_ns"], times["stop_ns"], enough=lambda: bool(signals)
    )
    send_events(seen.tobytes(), wakeups=wakeups, median_lateness_ns=ordinary)
    wait_for_leave()


if __name__ == "__main__":
    main()
