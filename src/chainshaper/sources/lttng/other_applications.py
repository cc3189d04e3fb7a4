"""Telling the command's processes from others that the same session daemon traces.

A process is the command's if it descends from us, or has a mark of ours in its environment: a
daemon, whose parent is gone, keeps that, and what `sudo` starts, which has lost it, descends.
Everybody else's events are left out of the tables.
"""

import os
from collections.abc import Collection

import polars as pl

from chainshaper.linux.processes import descendants
from chainshaper.linux.threads import parents, read_proc
from chainshaper.linux.users import process_folder, user_in
from chainshaper.values.events import EventTables
from chainshaper.values.recording import RecordingInfo

__all__ = ["processes_apart", "without_processes"]


def processes_apart(mark: str, users: Collection[int]) -> tuple[set[int], set[int]]:
    """The living processes that somebody else has started, and those that we have.

    The ``mark`` counts in processes of these ``users``: others can read and write it as well.
    """
    parent_of = parents()
    unrelated = set(parent_of) - descendants(parent_of, os.getpid())
    others = {pid for pid in unrelated if not _is_marked(pid, mark, users)}
    return others, set(parent_of) - others


def _is_marked(pid: int, mark: str, users: Collection[int]) -> bool:
    try:
        with process_folder(pid) as folder:
            marked = mark.encode() in read_proc("environ", folder).split(b"\0")
            return marked and user_in(folder) in users
    except OSError:  # it has ended, or is another user's
        return False


def without_processes(
    strangers: Collection[int], tables: EventTables, info: RecordingInfo
) -> tuple[EventTables, RecordingInfo]:
    """The events without those of processes that are none of the command's, if there are any."""
    traced = (frame["pid"].drop_nulls().unique() for frame in tables.values())
    foreign = sorted({pid for pids in traced for pid in pids} & set(strangers))
    if not foreign:
        return tables, info
    own = {
        name: frame.filter(~pl.col("pid").is_in(foreign).fill_null(False))
        for name, frame in tables.items()
    }
    names = ", ".join(f"{pid} {info.processes.get(pid, '')}".strip() for pid in foreign)
    facts = {
        "processes": {pid: name for pid, name in info.processes.items() if pid not in foreign},
        "notes": (
            *info.notes,
            f"processes that the command has not started are left out: {names}.",
        ),
        "trace_events": {
            name if name == "sched_switch" else f"ros2:{name}": frame.height
            for name, frame in own.items()
        },
    }
    return own, info.model_copy(update=facts)
