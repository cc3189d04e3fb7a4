"""Nodes that were started again: which processes of one node's name followed each other.

A node that dies and is started again is another process with other handles, and still one node: its
callbacks continue in the new process. Two processes that run nodes of one name at the same time are
two nodes. The times of events distinguish the two cases: if the last event of a process lies before
the first one of another, the second process followed the first.
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
    """Make a frame that gives each process of a node that was started again the node's last one.

    Columns: ``node, pid, last_pid``. Nodes that were not started again have no row. ``ended`` are
    the processes that are known to have ended. Without that, a process has ended if a process with
    its node's name has its first event after this one's last. If several have ended, the new
    process follows the one that ended last.
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
    """Put processes of one node's name into rows in which each follows the one before.

    ``pids`` are in order of their first event.
    """
    successions: list[list[int]] = []
    if ended is not None:  # what runs follows what has ended, whenever it began
        pids = sorted(pids, key=lambda pid: (pid not in ended, spans[pid]))
    for pid in pids:
        began = spans[pid][0]
        over = [
            succession
            for succession in successions
            if (spans[succession[-1]][1] < began if ended is None else succession[-1] in ended)
        ]
        if over:
            max(over, key=lambda succession: spans[succession[-1]][1]).append(pid)
        else:
            successions.append([pid])
    return successions


def _spans(tables: events.EventTables, pids: Collection[int]) -> dict[int, tuple[int, int]]:
    """Map each process to the instants of its first and last event (ns)."""
    spans: dict[int, tuple[int, int]] = {}
    for name in tables:
        table = tables[name]
        if not {"pid", "time"} <= {*table.columns}:
            continue
        events_of_pids = table.lazy().filter(pl.col("pid").is_in(list(pids))).group_by("pid")
        for pid, first, last in (
            events_of_pids.agg(first=pl.col("time").min(), last=pl.col("time").max())
            .collect()
            .iter_rows()
        ):
            before = spans.get(pid, (first, last))
            spans[pid] = min(first, before[0]), max(last, before[1])
    return spans
