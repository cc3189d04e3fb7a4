"""Where the engine's numbers come from: execution times, costs and delays, in blocks."""

from collections.abc import Iterator

import numpy as np

from chainshaper.simulation import layout as at
from chainshaper.simulation.layout import Int64s, Machine
from chainshaper.workload.description import ExecutionTime
from chainshaper.workload.execution import BLOCK, blocks

__all__ = ["Streams"]

AHEAD = 16 * BLOCK
"""So many values of every stream are drawn beforehand."""

FIRST_COST = 1 << 20
"""Costs are numbered from here, callbacks of a node from 0: no two draw the same sequence."""


class Streams:
    """All streams of a simulation: drawn in Python, consumed by the engine.

    A callback's stream is that of the live workload, value for value: it depends on the seed, the
    node's full name and the callback's place in it. So does a cost's; constants need no drawing.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._constants: list[int] = []
        self._sources: list[Iterator[Int64s] | None] = []

    def callback(self, times: ExecutionTime, node: str, index: int) -> int:
        """The number of a stream of execution times (ns)."""
        constant = times.constant_ns
        values = (
            None if constant is not None else blocks(times.model_dump(), self._seed, node, index)
        )
        self._sources.append(values)
        self._constants.append(at.NONE if constant is None else constant)
        return len(self._sources) - 1

    def cost(self, times: ExecutionTime, node: str, number: int) -> int:
        """The number of a stream of costs or delays (ns)."""
        return self.callback(times, node, FIRST_COST + number)

    def __len__(self) -> int:
        return len(self._sources)

    def rows(self) -> Int64s:
        """The streams' rows of the engine's array, before any value is drawn."""
        rows = np.zeros((len(self), at.STREAM_COLUMNS), dtype=np.int64)
        rows[:, at.D_CONSTANT] = self._constants
        return rows

    def fill(self, machine: Machine) -> None:
        """Draw for all streams that run short (all, the first time)."""
        first = machine.first_draw
        for stream, source in enumerate(self._sources):
            row, begin = machine.streams[stream], first + stream * AHEAD
            if source is None or (row[at.D_NEXT] and row[at.D_NEXT] < row[at.D_LIMIT] - BLOCK):
                continue
            used = (int(row[at.D_NEXT]) - begin) // BLOCK * BLOCK if row[at.D_NEXT] else AHEAD
            values = machine.draws[stream]
            values[: AHEAD - used] = values[used:].copy()
            for place in range(AHEAD - used, AHEAD, BLOCK):
                values[place : place + BLOCK] = next(source)
            row[at.D_NEXT] = row[at.D_NEXT] - used if row[at.D_NEXT] else begin
            row[at.D_LIMIT] = begin + AHEAD - at.RESERVE
