"""The two lidars of the vehicle: where they are mounted, and where their rays go."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["FRONT", "REAR", "Lidar", "directions", "in_vehicle", "points_of"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Lidar:
    """A lidar and how it is mounted: ``x`` (m) ahead of the vehicle's origin, ``yaw`` (rad).

    It looks over ``width`` (rad) in ``azimuths`` columns of ``beams``.
    """

    x: float
    yaw: float
    width: float
    azimuths: int
    beams: int = 40
    height: float = 1.9

    def angles(self) -> tuple[Floats, Floats]:
        """Azimuths and elevations of its rays (rad)."""
        half = self.width / 2
        return (
            np.linspace(-half, half, self.azimuths),
            np.deg2rad(np.linspace(-24.0, 6.0, self.beams)),
        )


FRONT = Lidar(x=3.4, yaw=0.0, width=np.deg2rad(220.0), azimuths=500)
REAR = Lidar(x=-0.8, yaw=np.pi, width=np.deg2rad(150.0), azimuths=660)


def directions(lidar: Lidar) -> NDArray[np.float32]:
    """Unit vectors of the rays in the lidar's frame: (azimuths x beams, 3)."""
    azimuth, elevation = (angle.ravel() for angle in np.meshgrid(*lidar.angles(), indexing="ij"))
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
    return rays.astype(np.float32)


def points_of(ranges: NDArray[Any], rays: NDArray[np.float32]) -> NDArray[Any]:
    """The points at ranges (m) along rays, in the lidar's frame: (n, 3), n as far as they end."""
    returned = np.isfinite(ranges)
    points: NDArray[Any] = rays[returned] * ranges[returned, None]
    return points


def in_vehicle(points: NDArray[Any], lidar: Lidar) -> NDArray[Any]:
    """Points of a lidar's frame in the vehicle's, whose origin is on the floor: (n, 3)."""
    cosine, sine = np.cos(lidar.yaw), np.sin(lidar.yaw)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], dtype=points.dtype)
    moved: NDArray[Any] = points @ turn.T
    moved += np.array([lidar.x, 0, lidar.height], dtype=points.dtype)
    return moved
