"""The threads of a running application as a table and as plain data."""

from typing import Any

from rich.table import Table

from chainshaper.enforcement.threads import Allocation, NodeThread
from chainshaper.reporting.cells import terminal_table

__all__ = ["threads_json", "threads_table"]


def threads_json(allocation: Allocation) -> dict[str, Any]:
    """All threads, and what is not certain about them."""
    return {
        "threads": [_row(found) for found in allocation.threads],
        "notes": list(allocation.notes),
    }


def threads_table(allocation: Allocation) -> Table:
    """A row per thread; what is as in the row above is left out."""
    names = ("node", "pid", "tid", "name", "role", "class", "cores", "known by")
    table = terminal_table("Threads", names)
    above: NodeThread | None = None
    for found in allocation.threads:
        row = _row(found)
        first = above is None or above.thread.pid != found.thread.pid
        same_nodes = not first and above is not None and above.nodes == found.nodes
        known_by = [f"{row['known_by'] or '-'}"]
        if first and found.nodes:
            known_by.append(f"node: {row['nodes_known_by']}")
        table.add_row(
            "" if same_nodes else ", ".join(found.nodes) or "unknown",
            str(row["pid"]) if first else "",
            str(row["tid"]),
            row["comm"],
            f"DDS {row['dds_kind']}" if row["role"] == "dds" else row["role"],
            _class(found),
            _ranges(row["cores"]),
            "; ".join(known_by),
        )
        above = found
    return table


def _class(found: NodeThread) -> str:
    policy = found.thread.policy.removeprefix("SCHED_")
    return f"{policy} {found.thread.priority}" if found.thread.priority else policy


def _row(found: NodeThread) -> dict[str, Any]:
    thread = found.thread
    return {
        "nodes": list(found.nodes),
        "nodes_known_by": found.nodes_known_by or None,
        "pid": thread.pid,
        "tid": thread.tid,
        "comm": thread.comm,
        "role": thread.role,
        "dds_kind": thread.kind,
        "known_by": found.known_by or None,
        "policy": thread.policy,
        "priority": thread.priority,
        "cores": list(thread.cores),
    }


def _ranges(cores: list[int]) -> str:
    """Cores as the kernel writes them: ``0-3,7``."""
    runs: list[list[int]] = []
    for core in cores:
        if runs and core == runs[-1][-1] + 1:
            runs[-1].append(core)
        else:
            runs.append([core])
    return ",".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)
