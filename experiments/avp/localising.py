"""The localizer's callback; the map is loaded when this module is."""

from chainshaper import origin_of

from .drive import recorded_drive
from .localizer import Localizer
from .messages import cloud_of, pose_message

__all__ = ["localise"]


def _at_the_start() -> Localizer:
    drive = recorded_drive()
    return Localizer(drive.map, drive.poses[0])


_localizer = _at_the_start()


def localise(cloud: bytes) -> bytes:
    """The pose for a fused, down-sampled cloud."""
    pose = _localizer.locate(cloud_of(cloud), origin_of(cloud) or 0)
    return pose_message(pose, like=cloud)
