"""A car park, and a drive through it: boxes for what stands there, poses of who drives.

Everything is an axis-parallel box (x0, y0, z0, x1, y1, z1; metres), cars being two of them: body
and cabin. North of the island the rows are nearly full and in the south nearly empty, so that a
drive sees much and little. The drive is a closed loop: it can be replayed for as long as wanted.
"""

import numpy as np
from numpy.typing import NDArray

__all__ = ["SCANS", "drive", "moving_boxes", "parked_boxes"]

Floats = NDArray[np.float64]

LENGTH_M, WIDTH_M, WALL_M = 84.0, 54.0, 2.6
SPACE_M = 2.7
SCANS = 480
"""Of one loop: 48 s at 10 Hz, with 3.5 m/s on average."""

LOOP_X, LOOP_Y, CORNER_M = 30.0, 14.0, 6.0
OCCUPIED = {"north": 0.9, "island": 0.6, "south": 0.25}
MOVING = 8


def parked_boxes(seed: int) -> Floats:
    """Walls, pillars and parked cars: (n, 6)."""
    random = np.random.default_rng(seed)
    boxes = [*_walls()]
    for y, row in ((22.0, "north"), (3.0, "island"), (-3.0, "island"), (-22.0, "south")):
        reach = 36.0 if row in {"north", "south"} else 20.0
        for x in np.arange(-reach, reach, SPACE_M):
            if random.random() < OCCUPIED[row]:
                boxes += _car(random, float(x) + SPACE_M / 2, y)
    for x in np.arange(-20.0, 21.0, 3 * SPACE_M):
        boxes.append((x - 0.3, -0.3, 0.0, x + 0.3, 0.3, WALL_M))
        boxes.append((x - 0.3, 18.0, 0.0, x + 0.3, 18.6, WALL_M))
    return np.array(boxes)


def _walls() -> list[tuple[float, ...]]:
    x, y = LENGTH_M / 2, WIDTH_M / 2
    return [
        (-x, -y - 0.3, 0.0, x, -y, WALL_M),
        (-x, y, 0.0, x, y + 0.3, WALL_M),
        (-x - 0.3, -y, 0.0, -x, y, WALL_M),
        (x, -y, 0.0, x + 0.3, y, WALL_M),
    ]


def _car(random: np.random.Generator, x: float, y: float) -> list[tuple[float, ...]]:
    """A car that is parked across the aisle: body, and cabin on top of it."""
    length, width = random.uniform(3.6, 5.0), random.uniform(1.6, 2.0)
    height, x, y = random.uniform(1.4, 2.0), x + random.normal(0, 0.1), y + random.normal(0, 0.2)
    half = width / 2
    return [
        (x - half, y - length / 2, 0.2, x + half, y + length / 2, 0.9),
        (x - half + 0.1, y - length / 4, 0.9, x + half - 0.1, y + length / 4, height),
    ]


def moving_boxes(scan: int, seed: int) -> Floats:
    """Cars and people who move along the aisles, at the time of a scan: (n, 6)."""
    random = np.random.default_rng([seed, 1])
    start, speed = random.uniform(-30, 30, MOVING), random.uniform(-2.5, 2.5, MOVING)
    lane = np.where(np.arange(MOVING) % 2, LOOP_Y, -LOOP_Y) + random.choice([-3.6, 3.6], MOVING)
    is_car = np.arange(MOVING) % 4 == 0
    x = (start + speed * scan / 10 + 35) % 70 - 35
    long, wide = np.where(is_car, 2.2, 0.25), np.where(is_car, 0.9, 0.25)
    bottom, top = np.zeros(MOVING), np.where(is_car, 1.5, 1.75)
    return np.stack([x - long, lane - wide, bottom, x + long, lane + wide, top], axis=1)


def drive() -> Floats:
    """The vehicle's true pose at every scan: x, y (m), yaw (rad); (SCANS, 3).

    A rectangle with rounded corners, faster on the way and slower in the corners.
    """
    time = np.arange(SCANS) / SCANS
    along = time + 0.05 / (2 * np.pi) * np.sin(4 * np.pi * time)  # share of the loop
    side_x, side_y = 2 * (LOOP_X - CORNER_M), 2 * (LOOP_Y - CORNER_M)
    arc = CORNER_M * np.pi / 2
    lengths = np.array([side_x, arc, side_y, arc, side_x, arc, side_y, arc])
    ends = np.cumsum(lengths)
    distance = along * ends[-1]
    part = np.searchsorted(ends, distance, side="right")
    into = distance - (ends - lengths)[part]
    corner = np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]])[part // 2]
    centre = corner * [LOOP_X - CORNER_M, LOOP_Y - CORNER_M]
    turned = np.where(part % 2, into / CORNER_M, 0.0)
    yaw = (part // 2) * np.pi / 2 + turned
    before = np.where(part % 2, 0.0, lengths[part] - into)  # straight on until the corner begins
    outward = np.stack([np.sin(yaw), -np.cos(yaw)], axis=1) * CORNER_M
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=1) * before[:, None]
    return np.column_stack([centre + outward - ahead, np.unwrap(yaw)])
