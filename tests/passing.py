"""Messages passing a gate one by one."""

import time

from chainshaper.gate.decision import Outcome, Release, Shaper

__all__ = ["decided", "held"]


def decided(shaper: Shaper, payload: bytes, arrival_ns: int) -> Release:
    """What is decided about a message that comes then, before it is withdrawn."""
    shaper.arrive(payload, arrival_ns)
    release, _ = shaper.queue.decide()
    shaper.queue.leave(release, arrival_ns)
    return release


def held(shaper: Shaper, payload: bytes = b"no header") -> Outcome:
    """What becomes of a message that comes now."""
    shaper.arrive(payload, time.monotonic_ns())
    result = shaper.hold()
    assert result is not None
    return result
