"""Lidars in a scene of boxes: rays are cast, and what is measured is disturbed as real scans are.

All rays of one azimuth lie in one vertical plane, so a box is met by that plane once, between two
horizontal distances; which beams of the azimuth meet it follows from the heights there.
"""

import numpy as np
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
    flat = _cast(origin, azimuth + lidar.yaw + yaw, np.tan(elevation), boxes)
    ranges: Floats = (flat / np.cos(elevation)).ravel()
    ranges[ranges > RANGE_M] = np.inf
    return ranges


def _cast(origin: Floats, azimuths: Floats, slopes: Floats, boxes: Floats) -> Floats:
    """Horizontal distances to the nearest thing, (azimuths, beams)."""
    x, y, z = origin
    with np.errstate(divide="ignore", invalid="ignore"):  # along an axis, or level: never met
        floor = np.where(slopes < 0, -z / slopes, np.inf)
        nearest = np.tile(floor, (azimuths.size, 1))
        along_x, along_y = np.cos(azimuths), np.sin(azimuths)
        for x0, y0, z0, x1, y1, z1 in boxes:
            sides_x = np.sort([(x0 - x) / along_x, (x1 - x) / along_x], axis=0)
            sides_y = np.sort([(y0 - y) / along_y, (y1 - y) / along_y], axis=0)
            enter, leave = np.maximum(sides_x[0], sides_y[0]), np.minimum(sides_x[1], sides_y[1])
            columns = np.flatnonzero(leave > np.maximum(enter, 0.0))
            entered, left = enter[columns, np.newaxis], leave[columns, np.newaxis]
            height, behind = z + slopes * entered, z + slopes * left
            through_side = (z0 <= height) & (height <= z1)
            through_top = (slopes < 0) & (height > z1) & (behind <= z1)
            from_below = (slopes > 0) & (height < z0) & (behind >= z0)
            ways = [through_side, through_top, from_below]
            met = np.select(ways, [entered, (z1 - z) / slopes, (z0 - z) / slopes], np.inf)
            nearest[columns] = np.minimum(nearest[columns], np.maximum(met, 0.0))
    return nearest


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
