"""One loop through the car park, measured once and kept in a file: what a bag is to a real vehicle.

    python -m experiments.avp.drive        # generates it, about 10 s; done by itself where needed

The file has the ranges of both lidars for every scan, and a map of the car park without whoever
moved in it. It stands outside the repository, in the user's cache folder.
"""

import os
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .lidar import FRONT, REAR, Lidar, directions, in_vehicle, points_of
from .scene import SCANS, drive, moving_boxes, parked_boxes

__all__ = ["Drive", "recorded_drive"]

SEED = 1
VERSION = 3
MAP_EVERY = 8
MAP_CELL_M = 0.25
LOST = (0.02, 0.45)


@dataclass(frozen=True)
class Drive:
    """Ranges (m, NaN: nothing) by scan and ray, true poses by scan (x, y, yaw), and the map (n, 3).

    Rays are those of :func:`experiments.avp.lidar.directions`.
    """

    rear: NDArray[np.float32]
    front: NDArray[np.float32]
    poses: NDArray[np.float64]
    map: NDArray[np.float32]


def recorded_drive() -> Drive:
    """The drive from its file, which is made if there is none."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = cache / "chainshaper" / f"avp-{VERSION}"
    if not folder.exists():
        _keep(folder, generate())
    rear, front, map_ = (np.load(folder / f"{name}.npy") for name in ("rear", "front", "map"))
    return Drive(rear, front, drive(), map_)


def _keep(folder: Path, made: Drive) -> None:
    """Write the files beside, and rename: whoever reads them finds all or nothing."""
    beside = folder.with_name(f"{folder.name}.{os.getpid()}")
    beside.mkdir(parents=True)
    for name in ("rear", "front", "map"):
        np.save(beside / f"{name}.npy", getattr(made, name))
    try:
        beside.rename(folder)
    except OSError:  # another process was faster
        shutil.rmtree(beside)


def generate(scans: int = SCANS, seed: int = SEED) -> Drive:
    """Cast the rays of the first ``scans`` scans of the drive, and those that see the map."""
    from .raycasting import cast, measured

    parked, poses, random = parked_boxes(seed), drive()[:scans], np.random.default_rng(seed)
    # Rain comes and goes: smooth over some seconds, from hardly anything to nearly half lost.
    knots = np.arange(0, scans + 40, 40)
    lost = np.interp(np.arange(scans), knots, random.uniform(*LOST, knots.size))
    rear, front = (
        np.stack(
            [
                measured(
                    cast(lidar, pose, np.vstack([parked, moving_boxes(n, seed)])), gone, random
                )
                for n, (pose, gone) in enumerate(zip(poses, lost, strict=True))
            ]
        )
        for lidar in (REAR, FRONT)
    )
    points = np.concatenate(
        [
            _in_world(points_of(cast(lidar, pose, parked), directions(lidar)), lidar, pose)
            for pose in poses[::MAP_EVERY]
            for lidar in (REAR, FRONT)
        ]
    )
    points = points[points[:, 2] > 0.1]
    cells = np.unique(np.floor(points / MAP_CELL_M), axis=0, return_index=True)[1]
    return Drive(rear, front, poses, points[cells].astype(np.float32))


def _in_world(
    points: NDArray[np.float64], lidar: Lidar, pose: NDArray[np.float64]
) -> NDArray[np.float64]:
    x, y, yaw = pose
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    in_world: NDArray[np.float64] = in_vehicle(points, lidar) @ turn.T + [x, y, 0.0]
    return in_world


if __name__ == "__main__":
    begun = time.monotonic()
    found = recorded_drive()
    print(f"{len(found.rear)} scans, {len(found.map)} points in the map")
    print(f"{time.monotonic() - begun:.1f} s")
