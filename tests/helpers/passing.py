"""Messages passing a gate one by one."""

import struct
import time

from chainshaper.robot.decision import Release
from chainshaper.robot.shaper import Shaper
from chainshaper.robot.waiting import Outcome


def decided(shaper: Shaper, payload: bytes, arrival_ns: int) -> Release:
    """What is decided about a message that comes then, before it is withdrawn."""
    shaper.arrive(payload, arrival_ns)
    release = shaper.queue.decide()
    shaper.queue.leave(release, arrival_ns)
    return release


def held(shaper: Shaper, payload: bytes = b"no header") -> Outcome:
    """What becomes of a message that comes now."""
    shaper.arrive(payload, time.monotonic_ns())
    result = shaper.hold()
    assert result is not None
    return result


def serialized(stamp_ns: int, rest: bytes = b"the rest", *, big_endian: bool = False) -> bytes:
    """A serialized message whose first field is a header with this stamp."""
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    stamp = struct.pack(">iI" if big_endian else "<iI", seconds, nanoseconds)
    return bytes([0, 0 if big_endian else 1, 0, 0]) + stamp + rest
