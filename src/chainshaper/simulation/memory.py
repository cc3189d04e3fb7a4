"""One array for everything: areas of rows, and references to rows as places in the array.

While an area is filled, columns that refer to a row of another area hold that row's number. When
all areas are in one array, the numbers become places.
"""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from chainshaper.simulation import layout as at
from chainshaper.simulation.layout import NONE, Int64s

__all__ = ["Memory", "refer_to_places"]


class Memory:
    """One array with areas of rows, and what it takes to refer to their rows."""

    def __init__(self, areas: Mapping[str, Int64s]) -> None:
        self._columns = {name: area.shape[1] for name, area in areas.items()}
        self._first: dict[str, int] = {}
        self._areas: dict[str, Int64s] = {}
        self.array = np.zeros(sum(area.size for area in areas.values()), dtype=np.int64)
        first = 0
        for name, area in areas.items():
            self._first[name] = first
            self._areas[name] = self.array[first : first + area.size].reshape(area.shape)
            self._areas[name][:] = area
            first += area.size

    def __getitem__(self, name: str) -> Int64s:
        """An area, as a view with a row per thing."""
        return self._areas[name]

    def place(self, name: str, row: int) -> int:
        """Where a row of an area begins."""
        return int(self._first[name] + row * self._columns[name])

    def refer(
        self, name: str, column: int, target: str, rows: npt.NDArray[np.bool_] | None = None
    ) -> None:
        """Turn a column's numbers of rows of ``target`` into their places."""
        numbers = self._areas[name][:, column]
        chosen = numbers != NONE if rows is None else rows & (numbers != NONE)
        numbers[chosen] = self._first[target] + numbers[chosen] * self._columns[target]


def refer_to_places(memory: Memory) -> None:
    """Turn the numbers of rows into places, and note where the areas are."""
    memory.refer("threads", at.T_CORE, "cores")
    memory.refer("threads", at.T_FIRST, "entities")
    memory.refer("threads", at.T_END, "entities")
    for column in (at.T_WAKE, at.T_TAKE, at.T_PUBLISH, at.T_RECEIVE, at.T_DELIVERY):
        memory.refer("threads", column, "streams")
    memory.refer("threads", at.T_PUBLISHER_THREAD, "threads")
    memory.refer("threads", at.T_DDS_THREAD, "threads")
    memory.refer("entities", at.E_THREAD, "threads")
    memory.refer("entities", at.E_EXECUTION, "streams")
    memory.refer("entities", at.E_PUBLISHERS, "publishers")
    memory.refer("entities", at.E_PUBLISHERS_END, "publishers")
    memory.refer("entities", at.E_HISTORY, "rings")
    synchronising = memory["entities"][:, at.E_BODY] == at.SYNCHRONISE
    memory.refer("entities", at.E_BODY_ROW, "gates", ~synchronising)
    memory.refer("entities", at.E_BODY_ROW, "synchronisers", synchronising)
    memory.refer("publishers", at.P_FIRST, "readers")
    memory.refer("publishers", at.P_END, "readers")
    memory.refer("publishers", at.P_MODES, "announced")
    memory.refer("readers", at.R_ENTITY, "entities")
    memory.refer("gates", at.G_SLOTS, "slots")
    memory.refer("gates", at.G_SLOTS_END, "slots")
    memory.refer("gates", at.G_BANDS, "bands")
    memory.refer("gates", at.G_CHANGES, "changes")
    memory.refer("synchronisers", at.S_FIRST, "inputs")
    memory.refer("synchronisers", at.S_END, "inputs")
    memory.refer("inputs", at.I_RING, "rings")
    memory.refer("cores", at.C_FIRST, "core_threads")
    memory.refer("cores", at.C_END, "core_threads")
    memory.refer("core_threads", 0, "threads")
    for column in (at.C_TABLE, at.C_TABLE_END, at.C_NEXT):
        memory.refer("cores", column, "boundaries")
    messages = memory["messages"]
    messages[:-1, at.M_NEXT] = [memory.place("messages", row) for row in range(1, len(messages))]
    for kind in range(at.LOG_KINDS):
        stride = memory[f"log {kind}"].shape[1]
        memory["counts"][kind] = (memory.place(f"log {kind}", 0), stride, 0)
    control = memory["control"][0]
    control[at.X_CORES] = memory.place("cores", 0)
    control[at.X_CORES_END] = memory.place("cores", len(memory["cores"]))
    control[at.X_FREE] = memory.place("messages", 0)
    control[at.X_HEAP] = control[at.X_HEAP_END] = memory.place("heap", 0)
    control[at.X_HEAP_LIMIT] = memory.place("heap", len(memory["heap"]) - at.RESERVE)
    control[at.X_LOGS] = memory.place("counts", 0)
    control[at.X_LATENCIES] = memory.place("latencies", 0)
    control[at.X_LATENCIES_END] = control[at.X_LATENCIES] + memory["latencies"].shape[1]
