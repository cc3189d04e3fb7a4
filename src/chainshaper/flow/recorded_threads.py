"""What a recording says about the threads of processes that may still run.

Tracers number processes and threads as these do themselves, in their own pid namespace. Which nodes
a process has, its creation events tell; which threads execute, the callbacks that they ran.
"""

import platform
import time

import polars as pl

from chainshaper.analysis import callback_statistics, data_flow
from chainshaper.enforcement.threads.allocation import RecordedProcess, RecordedThread
from chainshaper.linux.dds_threads import ThreadRole
from chainshaper.values import events
from chainshaper.values.recording import Recording

__all__ = ["recorded_processes"]

KNOWN_ROLES: dict[str, ThreadRole] = {
    "executor": "executor",
    "publisher": "publisher",
    "dds": "dds",
}


def recorded_processes(recording: Recording) -> tuple[tuple[RecordedProcess, ...], tuple[str, ...]]:
    """The processes of a recording, and why it says nothing about this machine, if that is so."""
    if platform.node() not in recording.info.host.split(", "):
        return (), (
            f"{recording.path} was taken on {recording.info.host or 'an unknown machine'}, so its "
            f"thread ids say nothing about {platform.node()}",
        )
    nodes = _nodes(recording.events)
    ran = _executors(recording)
    seen = _last_seen(recording.events)
    if any(instant > time.monotonic_ns() for instant in seen.values()):
        return (), (
            f"{recording.path} is from before this machine booted, so its thread ids say nothing",
        )
    threads: dict[int, dict[int, RecordedThread]] = {}
    for info in recording.info.threads:
        role = KNOWN_ROLES.get(info.role)
        if role is not None:
            own = (info.node,) if info.node else ()
            threads.setdefault(info.pid, {})[info.tid] = RecordedThread(info.tid, role, own)
            nodes.setdefault(info.pid, list(own))
    for (pid, tid), names in ran.items():
        threads.setdefault(pid, {})[tid] = RecordedThread(tid, "executor", tuple(names))
    found = [
        RecordedProcess(pid, tuple(names), tuple(threads.get(pid, {}).values()), seen[pid])
        for pid, names in nodes.items()
        if pid in seen
    ]
    return tuple(found), ()


def _nodes(tables: events.EventTables) -> dict[int, list[str]]:
    created = events.table(tables, "rcl_node_init").select("pid", node=events.NODE_NAME)
    found: dict[int, list[str]] = {}
    for pid, node in created.unique(maintain_order=True).iter_rows():
        found.setdefault(pid, []).append(node)
    return found


def _executors(recording: Recording) -> dict[tuple[int, int], list[str]]:
    """The nodes whose callbacks each thread ran, by process and thread."""
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    ran = callback_statistics(flow).filter(pl.col("node").is_not_null()).explode("tids")
    found: dict[tuple[int, int], list[str]] = {}
    for pid, tid, node in ran.select("pid", "tids", pl.col("node").cast(pl.String)).iter_rows():
        names = found.setdefault((pid, tid), [])
        if node not in names:
            names.append(node)
    return found


def _last_seen(tables: events.EventTables) -> dict[int, int]:
    seen = pl.concat(
        [
            events.table(tables, name).select("pid", "time")
            for name in ("rcl_node_init", "callback_start")
        ]
    )
    return dict(seen.drop_nulls().group_by("pid").agg(pl.col("time").max()).iter_rows())
