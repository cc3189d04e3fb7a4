"""Execution times: drawn from a distribution, and spent as CPU time."""

import time
import zlib
from collections import deque
from collections.abc import Iterator
from itertools import count
from typing import Any

import numpy as np
import numpy.typing as npt

BLOCK = 1024
FIRST_AFTER = 1 << 16
"""What callbacks do behind their publications is numbered from here, callbacks from 0."""
_DATA, _STEP_NS = bytes(16_384), 30_000
"""Bytes for whose checksum the lock is released, and longer than that takes."""


def draw(
    execution: dict[str, Any], number: int, random: np.random.Generator
) -> npt.NDArray[np.int64]:
    """``number`` execution times (ns) from a described ``ExecutionTime``, as a dictionary."""
    if (constant := execution.get("constant_ns")) is not None:
        return np.full(number, constant, dtype=np.int64)
    if (uniform := execution.get("uniform_ns")) is not None:
        return random.integers(uniform[0], uniform[1], number, dtype=np.int64, endpoint=True)
    if (samples := execution.get("samples_ns")) is not None:
        block = execution.get("block", 1)
        starts = (random.random(-(-number // block)) * len(samples)).astype(np.int64)
        places = (starts[:, None] + np.arange(block)).ravel()[:number] % len(samples)
        measured: npt.NDArray[np.int64] = np.asarray(samples, dtype=np.int64)[places]
        return measured
    mean, deviation = execution["normal_ns"]
    low, high = execution["within_ns"]
    drawn = random.normal(mean, deviation, number)
    while (outside := (drawn < low) | (drawn > high)).any():
        drawn[outside] = random.normal(mean, deviation, int(outside.sum()))
    return drawn.astype(np.int64)


def blocks(
    execution: dict[str, Any], seed: int, node: str, index: int
) -> Iterator[npt.NDArray[np.int64]]:
    """The endless sequence of execution times of one callback, in blocks of `BLOCK` values (ns).

    Seed, node and the callback's index in its node determine the sequence, in a run and in its
    simulation. Stretches of samples depend on the seed only: callbacks that were measured together
    draw together.
    """
    if (sequence := execution.get("sequence_ns")) is not None:
        measured: npt.NDArray[np.int64] = np.asarray(sequence, dtype=np.int64)
        for first in count(0, BLOCK):
            yield measured[(first + np.arange(BLOCK)) % len(measured)]
    together = execution.get("block", 1) > 1
    random = np.random.default_rng([seed] if together else [seed, zlib.crc32(node.encode()), index])
    while True:  # values that are drawn again must not depend on how many are asked for at once
        yield draw(execution, BLOCK, random)


class ExecutionTimes:
    """The same sequence one by one, drawn beforehand: a callback has to spend them, not to draw."""

    def __init__(self, execution: dict[str, Any], seed: int, node: str, index: int) -> None:
        self._blocks = blocks(execution, seed, node, index)
        self._values: deque[int] = deque()

    def refill(self, count: int) -> None:
        """Have at least ``count`` values ready, so that the next ones cost nothing."""
        while len(self._values) < count:
            self._values.extend(next(self._blocks).tolist())

    def next(self) -> int:
        """The execution time of the next instance."""
        self.refill(1)
        return self._values.popleft()


def spend(cpu_ns: int, since_ns: int, *, beside_others: bool = False) -> None:
    """Compute until this thread has used ``cpu_ns`` since its CPU clock showed ``since_ns``.

    ``beside_others``: without the interpreter's lock, so that other threads compute meanwhile.
    """
    clock = time.thread_time_ns
    until = since_ns + cpu_ns
    while beside_others and clock() < until - _STEP_NS:
        zlib.crc32(_DATA)
    while clock() < until:
        pass
