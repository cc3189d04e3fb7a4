"""Nodes that were started again: which processes of one node's name followed each other.

A node that dies and is started again is another process, with other callbacks, and still one node:
its callbacks go on where they ended. Two processes that run a node of one name at the same time are
two nodes. What tells the two cases apart is when each process was seen: one that had its last event
before another one's first was followed by it.
"""

from collections import defaultdict
from collections.abc import Collection, Sequence

import polars as pl

from chainshaper.analysis.objects import Objects
from chainshaper.values import events

FOLLOWED = pl.Schema({"node": pl.String, "pid": pl.Int32, "last_pid": pl.Int32})


def followed_processes(
    tables: events.EventTables, objects: Objects, ended: Collection[int] | None = None
) -> pl.DataFrame:
    """``node, pid, last_pid``: for each process of a node that was started again, its last one.

    Nodes that were not started again have no row. ``ended`` are the processes that are known to
    have ended; without them, a process had ended where a later one of its node's name had its
    first event behind its own last event. Where several had, the one that ended last is followed.
    """
    processes = defaultdict[str, set[int]](set)
    for name in ("nodes", "callbacks"):
        pairs = getattr(objects, name).select("node", "pid").unique().drop_nulls()
        for node, pid in pairs.iter_rows():
            processes[node].add(pid)
    several = {node: pids for node, pids in processes.items() if len(pids) > 1}
    if not several:
        return FOLLOWED.to_frame()
    spans = _spans(tables, set[int]().union(*several.values()))
    rows = []
    for node, pids in several.items():
        seen = sorted((pid for pid in pids if pid in spans), key=lambda pid: spans[pid])
        for succession in _successions(seen, spans, ended):
            rows += [(node, pid, succession[-1]) for pid in succession if len(succession) > 1]
    return pl.DataFrame(rows, FOLLOWED, orient="row")


def _successions(
    pids: Sequence[int], spans: dict[int, tuple[int, int]], ended: Collection[int] | None
) -> list[list[int]]:
    """Processes of one node's name, in order of their first event, put behind each other."""
    found: list[list[int]] = []
    if ended is not None:  # what runs follows what has ended, whenever it began
        pids = sorted(pids, key=lambda pid: (pid not in ended, spans[pid]))
    for pid in pids:
        began = spans[pid][0]
        over = [
            one
            for one in found
            if (spans[one[-1]][1] < began if ended is None else one[-1] in ended)
        ]
        if over:
            max(over, key=lambda one: spans[one[-1]][1]).append(pid)
        else:
            found.append([pid])
    return found


def _spans(tables: events.EventTables, pids: Collection[int]) -> dict[int, tuple[int, int]]:
    """Each process's first and last event (ns)."""
    spans: dict[int, tuple[int, int]] = {}
    for name in tables:
        table = tables[name]
        if not {"pid", "time"} <= {*table.columns}:
            continue
        own = table.lazy().filter(pl.col("pid").is_in(list(pids))).group_by("pid")
        for pid, first, last in (
            own.agg(first=pl.col("time").min(), last=pl.col("time").max()).collect().iter_rows()
        ):
            before = spans.get(pid, (first, last))
            spans[pid] = min(first, before[0]), max(last, before[1])
    return spans
