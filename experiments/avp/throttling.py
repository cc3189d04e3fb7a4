"""Node Throttler: of each lidar's scans the first of a period passes as it comes, the paper's rule.

It makes of a lidar that is played back at almost 10 Hz a source of at most one scan a period, so
its callbacks can be seen as the timers that begin chains. What passes gets a stamp there.
"""

import time

from chainshaper.robot.throttling import FirstOfPeriod
from chainshaper.workload.dds import data_message, data_of, number_in

__all__ = ["throttle_front", "throttle_rear"]

PERIOD_NS = 100_000_000

_rules = {lidar: FirstOfPeriod(PERIOD_NS) for lidar in ("rear", "front")}


def throttle_rear(scan: bytes) -> bytes | None:
    """The rear lidar's scan, or None if it came too early."""
    return _throttled(scan, "rear")


def throttle_front(scan: bytes) -> bytes | None:
    """The front lidar's scan, or None if it came too early."""
    return _throttled(scan, "front")


def _throttled(scan: bytes, lidar: str) -> bytes | None:
    if not _rules[lidar].passes(time.monotonic_ns()):
        return None
    return data_message(data_of(scan), time.time_ns(), number_in(scan))
