"""Sleeping until an instant of CLOCK_MONOTONIC, and the offset of another clock."""

import ctypes
import errno
import time

_libc = ctypes.CDLL(None)


def sleep_until(deadline_ns: int) -> None:
    """Sleep until an instant of CLOCK_MONOTONIC, however late the sleep itself begins."""
    seconds, rest = divmod(max(0, deadline_ns), 1_000_000_000)
    timespec = (ctypes.c_long * 2)(seconds, rest)
    absolute = 1  # TIMER_ABSTIME
    # A signal ends the sleep early (EINTR); the deadline stays the same.
    while _libc.clock_nanosleep(time.CLOCK_MONOTONIC, absolute, timespec, None) == errno.EINTR:
        pass


def watch_until(deadline_ns: int) -> int:
    """Watch the clock until an instant of CLOCK_MONOTONIC; return the time, microseconds later."""
    clock = time.monotonic_ns
    while (now := clock()) < deadline_ns:
        pass
    return now


def clock_offset(clock: int = time.CLOCK_REALTIME) -> int:
    """Return a clock minus CLOCK_MONOTONIC in ns, to a fraction of a microsecond."""
    measured = []  # how long each measurement took, and the offset
    for _ in range(5):
        before, now, after = time.monotonic_ns(), time.clock_gettime_ns(clock), time.monotonic_ns()
        measured.append((after - before, now - (before + after) // 2))
        if after - before < 2_000:  # in a longer time something else ran in between
            break
    return min(measured)[1]
