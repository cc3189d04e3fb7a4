"""Sleeping until an instant of CLOCK_MONOTONIC, and the offset of another clock."""

import ctypes
import errno
import time

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
