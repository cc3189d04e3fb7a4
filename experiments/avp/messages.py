"""Point clouds and poses as messages: packed behind the header, numbered by their scan."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from chainshaper import origin_of
from chainshaper.workload.dds import data_message, data_of, number_in

__all__ = ["cloud_message", "cloud_of", "pose_message", "pose_of", "scan_message"]


def scan_message(points: NDArray[np.float32], stamp_ns: int, scan: int) -> bytes:
    """A cloud of (n, 3) float32 that was measured at ``stamp_ns`` (CLOCK_REALTIME)."""
    return data_message(_bytes(points), stamp_ns, scan)


def cloud_message(points: NDArray[np.float32], *, like: bytes) -> bytes:
    """A cloud with the stamp and the number of the message that it was computed from."""
    return data_message(_bytes(points), origin_of(like) or 0, number_in(like))


def cloud_of(message: bytes) -> NDArray[np.float32]:
    """The (n, 3) points of a message, not copied."""
    return np.frombuffer(data_of(message), dtype=np.float32).reshape(-1, 3)


def pose_message(pose: NDArray[np.float64], *, like: bytes) -> bytes:
    """x, y (m) and yaw (rad) of where the vehicle was when ``like`` was measured."""
    return data_message(_bytes(pose), origin_of(like) or 0, number_in(like))


def pose_of(message: bytes) -> NDArray[np.float64]:
    """x, y (m) and yaw (rad)."""
    return np.frombuffer(data_of(message), dtype=np.float64)


def _bytes(array: NDArray[Any]) -> memoryview:
    return np.ascontiguousarray(array).data.cast("B")
