"""Node Throttler: scans that come too early after the last one are held back, per lidar.

It makes of a lidar that is played back at almost 10 Hz a source of at most one scan a period, so
its callbacks can be seen as the timers that begin chains. What passes gets a stamp there.
"""

import time

from chainshaper.workload.dds import data_message, data_of, number_in

__all__ = ["throttle_front", "throttle_rear"]

SHORTEST_NS = 80_000_000

_passed_ns = {"rear": 0, "front": 0}


def throttle_rear(scan: bytes) -> bytes | None:
    """The rear lidar's scan, or None if it came too early."""
    return _throttled(scan, "rear")


def throttle_front(scan: bytes) -> bytes | None:
    """The front lidar's scan, or None if it came too early."""
    return _throttled(scan, "front")


def _throttled(scan: bytes, lidar: str) -> bytes | None:
    now = time.monotonic_ns()
    if now - _passed_ns[lidar] < SHORTEST_NS:
        return None
    _passed_ns[lidar] = now
    return data_message(data_of(scan), time.time_ns(), number_in(scan))
