"""Execution times: drawn from a distribution, and spent as CPU time."""

import time
import zlib
from collections import deque
from collections.abc import Iterator
from itertools import count
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from chainshaper.workload.description import ExecutionTime

Int64s: TypeAlias = npt.NDArray[np.int64]
BLOCK = 1024
FIRST_AFTER = 1 << 16
"""Added to a callback's index, it is the index of what that callback does after publishing."""
_DATA = bytes(16_384)  # so much that `crc32` releases the interpreter's lock
_STEP_NS = 30_000  # longer than `crc32` of it takes


def draw(times: ExecutionTime, number: int, random: np.random.Generator) -> Int64s:
    """Draw ``number`` execution times (ns) of a described distribution."""
    if times.constant_ns is not None:
        return np.full(number, times.constant_ns, dtype=np.int64)
    if times.uniform_ns is not None:
        low, high = times.uniform_ns
        return random.integers(low, high, number, dtype=np.int64, endpoint=True)
    if times.samples_ns is not None:
        samples = np.asarray(times.samples_ns, dtype=np.int64)
        stretches = -(-number // times.block)
        starts = (random.random(stretches) * len(samples)).astype(np.int64)
        places = (starts[:, None] + np.arange(times.block)).ravel()[:number] % len(samples)
        measured: Int64s = samples[places]
        return measured
    if times.normal_ns is None or times.within_ns is None:
        raise ValueError("a sequence is gone through, not drawn from")
    mean, deviation = times.normal_ns
    low, high = times.within_ns
    drawn = random.normal(mean, deviation, number)
    while (outside := (drawn < low) | (drawn > high)).any():
        drawn[outside] = random.normal(mean, deviation, int(outside.sum()))
    return drawn.astype(np.int64)


def blocks(times: ExecutionTime, seed: int, node: str, index: int) -> Iterator[Int64s]:
    """Yield the endless sequence of execution times of a callback, in blocks of `BLOCK` (ns).

    Seed, node and the callback's index in its node determine the sequence, in a run and in its
    simulation. Stretches of samples depend on the seed only: callbacks that were measured together
    draw together.
    """
    if times.sequence_ns is not None:
        measured: Int64s = np.asarray(times.sequence_ns, dtype=np.int64)
        for first in count(0, BLOCK):
            yield measured[(first + np.arange(BLOCK)) % len(measured)]
    together = times.block > 1
    random = np.random.default_rng([seed] if together else [seed, zlib.crc32(node.encode()), index])
    # Always as many at once: which values of `normal` are drawn again depends on it.
    while True:
        yield draw(times, BLOCK, random)


class ExecutionTimes:
    """A callback's sequence of execution times, value by value, drawn before they are needed."""

    def __init__(self, times: ExecutionTime, seed: int, node: str, index: int) -> None:
        self._blocks = blocks(times, seed, node, index)
        self._values: deque[int] = deque()

    def refill(self, count: int) -> None:
        """Have at least ``count`` values ready, so that the next ones cost nothing."""
        while len(self._values) < count:
            self._values.extend(next(self._blocks).tolist())

    def next(self) -> int:
        """Return the execution time of the next instance (ns)."""
        self.refill(1)
        return self._values.popleft()


def spend(cpu_ns: int, since_ns: int, *, beside_others: bool = False) -> None:
    """Compute until this thread has used ``cpu_ns`` since its CPU clock showed ``since_ns``.

    With ``beside_others`` it releases the interpreter's lock, so that other threads compute, too.
    """
    clock = time.thread_time_ns
    until = since_ns + cpu_ns
    while beside_others and clock() < until - _STEP_NS:
        zlib.crc32(_DATA)
    while clock() < until:
        pass
