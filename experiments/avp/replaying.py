"""The drive is played back at almost 10 Hz, as a bag is: not at regular intervals (section 5.1).

Scans come up to 1.5 ms late, and one in fifty 25 ms, behind which the next one comes too early.
"""

import time
from itertools import count

import numpy as np
from numpy.typing import NDArray

from .drive import recorded_drive
from .lidar import FRONT, REAR, Lidar, directions, points_of
from .messages import scan_message

__all__ = ["play_front", "play_rear"]

LATE_S, VERY_LATE_S, ONE_IN = 1.5e-3, 25e-3, 50

_drive = recorded_drive()
_rays = {lidar: directions(lidar) for lidar in (REAR, FRONT)}
_rear_scans, _front_scans = count(), count()


def play_rear() -> bytes:
    """The rear lidar's next scan, somewhat late. The front lidar's waits for it."""
    scan = next(_rear_scans)
    very_late = scan % ONE_IN == ONE_IN - 1
    time.sleep(VERY_LATE_S if very_late else np.random.default_rng(scan).uniform(0, LATE_S))
    return _played(scan, _drive.rear, REAR)


def play_front() -> bytes:
    """The front lidar's next scan."""
    return _played(next(_front_scans), _drive.front, FRONT)


def _played(scan: int, ranges: NDArray[np.float32], lidar: Lidar) -> bytes:
    points = points_of(ranges[scan % len(ranges)], _rays[lidar])
    return scan_message(points, time.time_ns(), scan)
