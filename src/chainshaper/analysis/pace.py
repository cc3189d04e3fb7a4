"""At which pace the machine ran: whether the same work took it the same time.

A core can run for a while without a stall, and yet at half its pace: a neighbour of a virtual
machine uses the same hardware, caches are cold, the clock is throttled. The stall meter is a
witness of that as well. Each of its wake-ups is the same work; `machine_pace` says what CPU time
it took (paused threads do not count). A pace is given relative to an ordinary one: 2 means that
everything takes twice as long.
"""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from chainshaper.values import events
from chainshaper.values.events import EventTables

__all__ = ["ordinary_pace", "relative_pace"]


def ordinary_pace(tables: EventTables) -> dict[int, float]:
    """The median CPU time of a wake-up on each core that was watched (ns)."""
    frame = events.table(tables, "machine_pace", ["cpu"])
    medians = frame.group_by("cpu").median().select("cpu", "cpu_time").iter_rows()
    return {core: median for core, median in medians if median}


def relative_pace(
    tables: EventTables,
    start: npt.NDArray[np.int64],
    end: npt.NDArray[np.int64],
    ordinary: Mapping[int, float],
) -> npt.NDArray[np.float64]:
    """Per core of ``ordinary`` a row: the mean pace in each window [start, end) of ``start``.

    Not a number where the core was not watched. A window begins with the stretch of wake-ups that
    was under way.
    """
    frame = events.table(tables, "machine_pace", ["cpu"]).sort("time")
    rows = []
    for core, usual in ordinary.items():
        time, cpu_time = (
            frame.filter(cpu=core)[column].to_numpy() for column in ("time", "cpu_time")
        )
        first = np.maximum(np.searchsorted(time, start, side="right") - 1, 0)
        behind = np.searchsorted(time, end, side="left")
        total = np.concatenate(([0], np.cumsum(cpu_time)))
        count = behind - first
        used = np.where(count > 0, total[behind] - total[np.minimum(first, behind)], np.nan)
        rows.append(used / np.maximum(count, 1) / usual)
    return np.array(rows).reshape(len(ordinary), len(start))
