"""What is suggested for names that do not exist."""

import pytest

from chainshaper.analysis.chains import close_names

NAMES = (
    "/lidar_front/points_raw",
    "/lidar_rear/points_raw",
    "/localization/ndt_pose",
    "/point_cloud_fusion",
    "/points_downsampled",
    "/points_fused",
)


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("/lidar_rear/point_raw", ["/lidar_rear/points_raw", "/lidar_front/points_raw"]),
        ("/points_raw", ["/lidar_front/points_raw", "/lidar_rear/points_raw"]),
        ("/localisation/ndt_pos", ["/localization/ndt_pose"]),
        ("ndt_pose", ["/localization/ndt_pose"]),
        ("/Points_Fused", ["/points_fused"]),
        ("/fusion", ["/point_cloud_fusion"]),
        ("/x", []),
        ("/entirely/different", []),
    ],
)
def test_the_likeliest_names_come_first(typed: str, meant: list[str]) -> None:
    assert close_names(typed, NAMES) == meant


def test_of_no_names_none_is_close() -> None:
    assert close_names("/x", ()) == []
