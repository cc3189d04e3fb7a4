"""From two lidars' scans to one small cloud: crop, no ground, no outliers, fused, down-sampled.

Clouds are (n, 3) float32 in metres, in their lidar's frame until they are fused in the vehicle's.
The functions at the end are the callbacks; what they compute stands before them.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .lidar import FRONT, REAR, Lidar, in_vehicle
from .messages import cloud_message, cloud_of

__all__ = [
    "front_filter",
    "fusion",
    "rear_filter",
    "voxel_centroids",
    "voxel_grid",
    "within_view",
    "without_ground",
    "without_outliers",
]

Cloud = NDArray[np.float32]

NEAREST_M, FARTHEST_M, HIGHEST_M = 1.2, 38.0, 2.4
GROUND_M = 0.15
NEIGHBOURS = 6
VOXEL_M = 0.18


def within_view(points: Cloud, height: float) -> Cloud:
    """What is neither the vehicle's own body, nor far away, nor high up.

    ``points`` stand in the frame of a lidar at ``height``.
    """
    squared = points[:, 0] ** 2 + points[:, 1] ** 2
    seen = (
        (squared > NEAREST_M**2) & (squared < FARTHEST_M**2) & (points[:, 2] < HIGHEST_M - height)
    )
    return points[seen]


def without_ground(points: Cloud, height: float) -> Cloud:
    """What is more than :data:`GROUND_M` above the floor, which is ``height`` below the lidar.

    More exactly, the floor is the plane through the lowest points, by least squares: vehicles
    pitch and roll.
    """
    low = points[points[:, 2] < 2 * GROUND_M - height]
    if len(low) < 3:
        return points
    flat = np.column_stack([low[:, :2], np.ones(len(low), dtype=np.float32)])
    plane = np.linalg.solve(flat.T @ flat, flat.T @ low[:, 2])
    above: Cloud = points[points[:, 2] - points[:, :2] @ plane[:2] - plane[2] > GROUND_M]
    return above


def without_outliers(points: Cloud) -> Cloud:
    """Statistical outlier removal (Rusu et al., 2008): far from its neighbours is dust.

    Removed is what is farther from its :data:`NEIGHBOURS` nearest, on average, than the mean of
    all points plus one standard deviation.
    """
    if len(points) <= NEIGHBOURS:
        return points
    distances, _ = cKDTree(points).query(points, NEIGHBOURS + 1)
    apart = distances[:, 1:].mean(axis=1)
    among_others: Cloud = points[apart < apart.mean() + apart.std()]
    return among_others


def voxel_centroids(points: Cloud, size: float = VOXEL_M) -> Cloud:
    """The centroid of the points in every cube of ``size`` metres that has any."""
    cells = np.floor(points / size).astype(np.int64)
    keys = (cells - cells.min(axis=0, initial=0)) @ np.array([1 << 40, 1 << 20, 1])
    _, voxel, count = np.unique(keys, return_inverse=True, return_counts=True)
    sums = [np.bincount(voxel, points[:, axis], len(count)) for axis in range(3)]
    centroids: Cloud = (np.stack(sums, axis=1) / count[:, None]).astype(np.float32)
    return centroids


def rear_filter(scan: bytes) -> bytes:
    """The rear lidar's filter."""
    return _filtered(scan, REAR)


def front_filter(scan: bytes) -> bytes:
    """The front lidar's filter."""
    return _filtered(scan, FRONT)


def _filtered(scan: bytes, lidar: Lidar) -> bytes:
    in_view = within_view(cloud_of(scan), lidar.height)
    return cloud_message(without_outliers(without_ground(in_view, lidar.height)), like=scan)


def fusion(rear: bytes, front: bytes) -> bytes:
    """Both clouds in the vehicle's frame, with the stamp of the rear one: there the chain began."""
    pair = in_vehicle(cloud_of(rear), REAR), in_vehicle(cloud_of(front), FRONT)
    return cloud_message(np.concatenate(pair), like=rear)


def voxel_grid(cloud: bytes) -> bytes:
    """The cloud, down-sampled."""
    return cloud_message(voxel_centroids(cloud_of(cloud)), like=cloud)
