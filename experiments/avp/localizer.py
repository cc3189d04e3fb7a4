"""Where the vehicle is: its cloud is registered with the map, from where it is expected to be.

Generalised ICP (Segal et al., 2009), as small_gicp has it. How long it takes depends on how much
is seen and on how far the expectation was off, so it varies along the drive, as in a real
localizer.
"""

import numpy as np
import small_gicp
from numpy.typing import NDArray

__all__ = ["Localizer"]

Floats = NDArray[np.float64]

NEIGHBOURS = 20
CORRESPONDENCE_M = 1.0
MOST_ITERATIONS = 12
CONVERGED = 1e-4
"""Metres and radians by which an iteration moves the pose, at most, when it is the last one."""


class Localizer:
    """A map, and where the vehicle was last.

    ``map_points`` (n, 3) in metres; ``start`` is x, y, yaw of the first scan.
    """

    def __init__(self, map_points: NDArray[np.float32], start: Floats) -> None:
        self._map = small_gicp.PointCloud(map_points.astype(np.float64))
        self._tree = small_gicp.KdTree(self._map)
        small_gicp.estimate_normals_covariances(self._map, self._tree, NEIGHBOURS)
        self._pose = start
        self._speed = np.zeros(3)
        self._stamp_ns: int | None = None

    def locate(self, cloud: NDArray[np.float32], stamp_ns: int) -> Floats:
        """x, y, yaw where a cloud of the vehicle's frame was measured, expecting constant speed."""
        passed = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) / 1e9
        expected = self._pose + self._speed * passed
        source = small_gicp.PointCloud(cloud.astype(np.float64))
        small_gicp.estimate_covariances(source, small_gicp.KdTree(source), NEIGHBOURS)
        found = small_gicp.align(
            self._map,
            source,
            self._tree,
            init_T_target_source=_matrix(expected),
            registration_type="GICP",
            max_correspondence_distance=CORRESPONDENCE_M,
            max_iterations=MOST_ITERATIONS,
            translation_epsilon=CONVERGED,
            rotation_epsilon=CONVERGED,
        )
        pose = _pose(found.T_target_source, near=expected[2])
        if passed > 0:
            self._speed = (pose - self._pose) / passed
        self._pose, self._stamp_ns = pose, stamp_ns
        return pose


def _matrix(pose: Floats) -> Floats:
    """A pose on the floor as a transformation from the vehicle's frame into the map's."""
    x, y, yaw = pose
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.array([[cosine, -sine, 0, x], [sine, cosine, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]])


def _pose(matrix: Floats, near: float) -> Floats:
    """The pose of a transformation, its yaw less than half a turn from ``near``."""
    yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
    yaw += 2 * np.pi * np.round((near - yaw) / (2 * np.pi))
    return np.array([matrix[0, 3], matrix[1, 3], yaw])
