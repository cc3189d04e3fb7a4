"""The car park, the lidars and the localisation: rays and clouds worked by hand, a short drive."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("small_gicp", reason="registration needs small_gicp (extra `experiments`)")

from avp.checking import check_pose, root_mean_square_error
from avp.drive import generate
from avp.filtering import (
    front_filter,
    fusion,
    rear_filter,
    voxel_centroids,
    voxel_grid,
    within_view,
    without_ground,
    without_outliers,
)
from avp.lidar import FRONT, REAR, Lidar, directions, in_vehicle, points_of
from avp.localizer import Localizer
from avp.messages import cloud_message, cloud_of, pose_message, scan_message
from avp.raycasting import cast
from avp.scene import SCANS, drive
from avp.throttling import throttle_front, throttle_rear

from chainshaper.robot.serialized import origin_of
from chainshaper.workload.dds import number_in

AHEAD = Lidar(x=1.0, yaw=0.0, width=np.pi / 2, azimuths=3, beams=3, height=2.0)
"""Rays to the right, ahead and to the left at 45°, 24° down, 9° down and 6° up."""


def test_rays_meet_the_floor_walls_and_the_tops_of_boxes_where_they_must() -> None:
    down, up = np.deg2rad(-24.0), np.deg2rad(6.0)
    free = cast(AHEAD, np.zeros(3), np.empty((0, 6))).reshape(3, 3)
    assert free[:, 0] == pytest.approx(2.0 / np.sin(-down))  # the floor
    assert np.isinf(free[:, 2]).all()  # the sky
    wall = np.array([[4.0, -50, 0, 5, 50, 3]])
    ahead = cast(AHEAD, np.zeros(3), wall).reshape(3, 3)
    assert ahead[1, 0] == pytest.approx(3.0 / np.cos(down))  # 3 m ahead of the lidar
    assert ahead[2, 2] == pytest.approx(3.0 * np.sqrt(2) / np.cos(up))
    behind = cast(AHEAD, np.array([0, 0, np.pi]), wall).reshape(3, 3)
    assert behind == pytest.approx(free)
    low = np.array([[3.0, -1, 0, 9, 1, 1.0]])  # met from above, 1 m below the lidar
    assert cast(AHEAD, np.zeros(3), low).reshape(3, 3)[1, 0] == pytest.approx(1.0 / np.sin(-down))
    turned = cast(AHEAD, np.array([0, 0, np.pi / 2]), np.array([[-50, 7.0, 0, 50, 8, 3]]))
    assert turned.reshape(3, 3)[1, 0] == pytest.approx(min(6.0 / np.cos(down), 2 / np.sin(-down)))


def test_points_are_moved_from_where_the_lidar_is_mounted_and_clouds_keep_their_stamp() -> None:
    point = np.array([[2.0, 1.0, -1.9]], dtype=np.float32)
    assert in_vehicle(point, REAR) == pytest.approx(np.array([[-2.8, -1.0, 0.0]]), abs=1e-6)
    assert np.linalg.norm(directions(FRONT), axis=1) == pytest.approx(1.0, abs=1e-6)
    stamp, points = 1_700_000_000_000_000_000, np.zeros((1, 3), dtype=np.float32)
    message = cloud_message(point, like=scan_message(points, stamp, 41))
    assert (origin_of(message), number_in(message)) == (stamp, 41)
    # A voxel becomes the centroid of its points.
    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [-0.1, 0.1, 0.1]], dtype=np.float32)
    centroids = np.array([[-0.1, 0.1, 0.1], [0.2, 0.1, 0.1]])
    assert voxel_centroids(points, 1.0) == pytest.approx(centroids)


def test_filters_keep_what_stands_and_lose_ground_dust_and_the_vehicle_itself() -> None:
    random = np.random.default_rng(1)
    tilted = random.uniform(-20, 20, (2000, 3))
    tilted[:, 2] = 0.002 * tilted[:, 0] - 1.9  # the vehicle pitches
    car = random.uniform([5, 5, -1.5], [7, 9, -0.5], (500, 3))
    body = np.array([[0.5, 0.5, -1.0]])
    far = np.array([[60.0, 0, -1.0]])
    points = np.concatenate([tilted, car, body, far]).astype(np.float32)
    standing = without_ground(within_view(points, 1.9), 1.9)
    assert len(standing) == len(car)
    dust = np.array([[-9.0, -9, 0]], dtype=np.float32)
    clean = without_outliers(np.concatenate([standing, dust]))
    assert (clean[:, 0] > 0).all() and len(clean) > 400


def test_the_drive_is_a_closed_smooth_loop() -> None:
    poses = drive()
    assert poses.shape == (SCANS, 3)
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    assert steps.min() > 0.2 and steps.max() < 0.5
    headings = np.arctan2(*np.diff(poses[:, :2], axis=0).T[::-1])
    assert np.cos(headings - poses[:-1, 2]).min() > 0.99
    assert poses[-1, 2] - poses[0, 2] == pytest.approx(2 * np.pi, abs=0.1)


def test_the_throttler_holds_back_a_scan_that_comes_too_early() -> None:
    points = np.zeros((2, 3), dtype=np.float32)
    passed = throttle_rear(scan_message(points, 5, scan=7))
    assert passed is not None
    assert (origin_of(passed) or 0) > 5, "the chain begins here"
    assert number_in(passed) == 7 and cloud_of(passed).tolist() == points.tolist()
    assert throttle_rear(scan_message(points, 5, scan=8)) is None
    assert throttle_front(scan_message(points, 5, scan=7)) is not None, "the other lidar's is not"


def test_the_localizer_finds_its_way_through_the_whole_pipeline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = generate(scans=6)
    localizer = Localizer(made.map, made.poses[0])
    monkeypatch.setenv("AVP_ERRORS", str(tmp_path / "errors"))
    for scan in range(6):
        messages = []
        for lidar, ranges, filtered in (
            (REAR, made.rear[scan], rear_filter),
            (FRONT, made.front[scan], front_filter),
        ):
            points = points_of(ranges, directions(lidar))
            messages.append(filtered(scan_message(points, (scan + 1) * 100_000_000, scan)))
        cloud = voxel_grid(fusion(*messages))
        assert len(cloud_of(cloud)) < sum(len(cloud_of(one)) for one in messages)
        found = localizer.locate(cloud_of(cloud), origin_of(cloud) or 0)
        check_pose(pose_message(found, like=cloud))
    error, worst = root_mean_square_error(tmp_path / "errors")
    assert 0 < error < worst < 0.05
