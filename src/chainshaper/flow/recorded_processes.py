"""The processes of a recording: which nodes each has, and which callbacks its threads execute.

Creation events say which nodes a process has, the callbacks that ran which threads execute.
"""

import platform
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, cast

from chainshaper.enforcement.node_threads import RecordedProcess, RecordedThread
from chainshaper.linux.threads import ThreadRole
from chainshaper.planning.plan import Plan
from chainshaper.values.errors import ChainshaperError, shown

if TYPE_CHECKING:
    from chainshaper.analysis import DataFlow
    from chainshaper.values.recording import Recording  # slow to import


def evidence_of(
    plan: Plan | None, recording: "Recording | None" = None
) -> tuple[tuple["Recording", ...], tuple[str, ...]]:
    """Return the recordings that say which thread of an application does what.

    They are the ``recording``, or else those that the plan names; behind them stand sentences about
    those that cannot be read.
    """
    if recording is not None:
        return (recording,), ()
    recordings, notes = list["Recording"](), list[str]()
    chains = () if plan is None else plan.chains
    paths = [chain.evidence.recording for chain in chains if chain.evidence.recording]
    for path in dict.fromkeys(paths):
        if not Path(path).is_dir():
            notes.append(f"the plan's recording {shown(path)} is not here")
            continue
        from chainshaper.sources import open_source  # slow to import, and many plans name none

        try:
            recordings.append(open_source(path))
        except ChainshaperError as error:
            notes.append(f"the plan's recording cannot be read: {error}")
    return tuple(recordings), tuple(notes)


def recorded_in(
    recordings: Iterable["Recording"], notes: Iterable[str] = ()
) -> tuple[tuple[RecordedProcess, ...], tuple[str, ...]]:
    """Return the processes of several recordings; and ``notes``, with why a recording says nothing.

    Why it says nothing: see :func:`recorded_processes`.
    """
    processes, all_notes = list[RecordedProcess](), list(notes)
    for recording in recordings:
        of_recording, why_not = recorded_processes(recording)
        processes += of_recording
        all_notes += why_not
    return tuple(processes), tuple(all_notes)


def recorded_processes(
    recording: "Recording",
) -> tuple[tuple[RecordedProcess, ...], tuple[str, ...]]:
    """Return the processes of a recording, and why it says nothing about this machine, if so."""
    import polars as pl  # slow to import, and not installed on every robot

    from chainshaper.analysis import data_flow, executors
    from chainshaper.sources.system import own_pid_namespace
    from chainshaper.values import events

    info, tables, taken_on = recording.info, recording.events, recording.info.host
    if platform.node() not in taken_on.split(", "):
        where = f"was taken on {taken_on or 'an unknown machine'}, so its thread ids say nothing"
        return (), (f"{recording.path} {where} about {platform.node()}",)
    if info.hosts:
        where = "has several hosts: name the recording that was taken here"
        return (), (f"{recording.path} {where}",)
    names = ("rcl_node_init", "callback_start")
    seen = pl.concat(events.table(tables, name).select("pid", "time") for name in names)
    last = seen.drop_nulls().group_by("pid").agg(pl.col("time").max())
    last_seen: dict[int, int] = dict(last.iter_rows())
    if any(instant > time.monotonic_ns() for instant in last_seen.values()):
        when = "is from before this machine booted, so its thread ids say nothing"
        return (), (f"{recording.path} {when}",)
    nodes: dict[int, list[str]] = {}  # by pid
    created = events.table(tables, "rcl_node_init").select("pid", node=events.NODE_NAME)
    for pid, node in created.unique(maintain_order=True).iter_rows():
        nodes.setdefault(pid, []).append(node)
    threads = defaultdict[int, dict[int, RecordedThread]](dict)  # by pid and tid
    for listed in info.threads:
        of_node, role = (listed.node,) if listed.node else (), cast(ThreadRole, listed.role)
        threads[listed.pid][listed.tid] = RecordedThread(listed.tid, role, of_node, listed.comm)
        nodes.setdefault(listed.pid, list(of_node))
    flow = data_flow(tables, info.clock_offset_ns)
    for pid, tid, node in _threads_of_loops(flow):
        comm = threads[pid][tid].comm if tid in threads[pid] else ""
        threads[pid][tid] = RecordedThread(tid, "loop", (node,), comm)
    ran = executors(flow)
    executors_in = Counter(executor.pid for executor in ran)
    for executor in ran:
        of_process = threads[executor.pid]
        # Names of callbacks tell apart the executors of one process.
        callback_names = executor.names if executors_in[executor.pid] > 1 else ()
        for tid, nodes_of_thread in executor.threads.items():
            comm = of_process[tid].comm if tid in of_process else ""
            of_process[tid] = RecordedThread(tid, "executor", nodes_of_thread, comm, callback_names)
    is_here = info.pid_namespace == own_pid_namespace()
    processes = tuple(
        RecordedProcess(
            pid, tuple(names_of_nodes), tuple(threads[pid].values()), last_seen[pid], is_here
        )
        for pid, names_of_nodes in nodes.items()
        if pid in last_seen
    )
    return processes, ()


def _threads_of_loops(flow: "DataFlow") -> Iterator[tuple[int, int, str]]:
    """Yield each thread that is in a loop: process, thread and the loop's node."""
    import polars as pl

    loops = flow.objects.callbacks.filter(pl.col("kind") == "loop").select("callback_id", "node")
    ran = flow.instances.join(loops.unique("callback_id"), on="callback_id", maintain_order="left")
    yield from ran.select("pid", "tid", "node").drop_nulls().unique(maintain_order=True).iter_rows()
