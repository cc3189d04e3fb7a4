"""How far the localizer is off: poses beside those that the drive really had.

Errors are appended to the file that the environment variable AVP_ERRORS names, one line a pose:
scan, metres, radians. A localizer that loses its way is no benchmark.
"""

import os
from pathlib import Path

import numpy as np

from chainshaper.workload.dds import number_in

from .messages import pose_of
from .scene import drive

__all__ = ["check_pose", "root_mean_square_error"]

_poses = drive()


def check_pose(message: bytes) -> None:
    """Note the error of a published pose."""
    scan = number_in(message)
    x, y, yaw = pose_of(message) - _poses[scan % len(_poses)]
    turn = abs((yaw + np.pi) % (2 * np.pi) - np.pi)
    if "AVP_ERRORS" in os.environ:
        with Path(os.environ["AVP_ERRORS"]).open("a") as file:
            file.write(f"{scan} {np.hypot(x, y):.6f} {turn:.6f}\n")


def root_mean_square_error(path: Path) -> tuple[float, float]:
    """Of a file of errors: root mean square and maximum of the distances in metres."""
    distances = np.loadtxt(path, ndmin=2)[:, 1]
    return float(np.sqrt(np.mean(distances**2))), float(distances.max())
