"""Lidars in a scene of boxes: rays are cast, and what is measured is disturbed as real scans are.

All rays of one azimuth lie in one vertical plane, so a box is met by that plane once, between two
horizontal distances; which beams of the azimuth meet it follows from the heights there.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .lidar import Lidar

__all__ = ["cast", "measured"]

Floats = NDArray[np.float64]

RANGE_M = 45.0
NOISE_M = 0.02
SPECKLES = 0.004
"""Share of rays that measure dust or rain instead."""


def cast(lidar: Lidar, pose: Floats, boxes: Floats) -> Floats:
    """Distances (m) to the first thing on each ray, inf for none: (azimuths x beams,).

    ``pose`` is the vehicle's x, y, yaw; ``boxes`` (n, 6), on a floor at height 0.
    """
    x, y, yaw = pose
    azimuth, elevation = lidar.angles()
    origin = np.array([x + lidar.x * np.cos(yaw), y + lidar.x * np.sin(yaw), lidar.height])
    flat = np.empty((lidar.azimuths, lidar.beams))
    _cast(origin, azimuth + lidar.yaw + yaw, np.tan(elevation), boxes, flat)
    ranges: Floats = (flat / np.cos(elevation)).ravel()
    ranges[ranges > RANGE_M] = np.inf
    return ranges


@njit(error_model="numpy")  # used once: a cache would be loaded without a look at who wrote it
def _cast(origin: Floats, azimuths: Floats, slopes: Floats, boxes: Floats, nearest: Floats) -> None:
    """Horizontal distances, (azimuths, beams), into ``nearest``."""
    x, y, z = origin
    for column in range(azimuths.size):
        for beam in range(slopes.size):
            down = slopes[beam] < 0
            nearest[column, beam] = -z / slopes[beam] if down else np.inf  # the floor
        along_x, along_y = np.cos(azimuths[column]), np.sin(azimuths[column])
        for box in range(boxes.shape[0]):
            x0, y0, z0, x1, y1, z1 = boxes[box]
            enter_x, leave_x = (x0 - x) / along_x, (x1 - x) / along_x
            enter_y, leave_y = (y0 - y) / along_y, (y1 - y) / along_y
            enter = max(min(enter_x, leave_x), min(enter_y, leave_y))
            leave = min(max(enter_x, leave_x), max(enter_y, leave_y))
            if leave <= max(enter, 0.0):
                continue
            for beam in range(slopes.size):
                slope = slopes[beam]
                height = z + slope * enter
                if z0 <= height <= z1:
                    met = enter
                elif slope < 0 and height > z1 and z + slope * leave <= z1:
                    met = (z1 - z) / slope  # through its top
                elif slope > 0 and height < z0 and z + slope * leave >= z0:
                    met = (z0 - z) / slope  # from below
                else:
                    continue
                nearest[column, beam] = min(nearest[column, beam], max(met, 0.0))


def measured(ranges: Floats, lost: float, random: np.random.Generator) -> NDArray[np.float32]:
    """What the lidar says of true distances: noisy, some of dust, ``lost`` (a share) missing.

    Rays that return nothing are NaN.
    """
    seen = ranges + random.normal(0.0, NOISE_M, ranges.size)
    dust = random.random(ranges.size) < SPECKLES
    seen[dust] = np.minimum(seen[dust], random.uniform(1.0, 20.0, dust.sum()))
    seen[random.random(ranges.size) < lost] = np.nan
    seen[~np.isfinite(seen)] = np.nan
    return seen.astype(np.float32)
