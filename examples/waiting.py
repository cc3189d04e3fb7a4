"""Callbacks that wait for a device rather than compute: they sleep for a time that is drawn."""

import random
import time

from chainshaper import origin_of
from chainshaper.workload.dds import data_message, data_of

_random = random.Random(1)


def detect(message: bytes) -> bytes:
    """60 to 70 ms."""
    return _after(0.060, 0.070, message)


def track(message: bytes) -> bytes:
    """20 to 25 ms."""
    return _after(0.020, 0.025, message)


def _after(shortest: float, longest: float, message: bytes) -> bytes:
    time.sleep(_random.uniform(shortest, longest))
    return data_message(data_of(message), origin_of(message) or 0)
