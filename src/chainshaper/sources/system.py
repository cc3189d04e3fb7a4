"""What the events of a trace tell about the system it was taken on: distribution, RMW, processes.

Upstream: changelogs of tracetools.
"""

import re
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import polars as pl

from chainshaper.linux.processes import boot_id
from chainshaper.values.events import NODE_NAME, EventTables, table
from chainshaper.values.middleware import rmw_of_vendor
from chainshaper.values.recording import RecordingInfo

NEXT_HOST = 10_000_000
"""Added to numbers of processes and threads that others may have; Linux goes up to 4,194,304."""

_RELEASES = {  # Versions of tracetools below these belong to the distribution.
    "eloquent": (1, 0),
    "foxy": (2, 0),
    "galactic": (3, 0),
    "humble": (5, 0),
    "iron": (7, 0),
    "jazzy": (8, 3),
    "kilted": (8, 7),
    "lyrical": (8, 11),
}


def info_of(
    source: str,
    tables: EventTables,
    versions: Iterable[str | None],
    names: Mapping[int, str],
    lost: int,
    **facts: Any,
) -> RecordingInfo:
    """Return the information of a recording that we traced.

    ``versions`` are those of tracetools, ``names`` those of processes without nodes.
    """
    known = pl.DataFrame({"version": [version for version in versions if version][:1]})
    return RecordingInfo(
        source=source,
        boot=boot_id(),
        distribution=distribution_of({"rcl_init": known}, {}),
        rmw=facts.pop("rmw", None) or rmw_of_gids(tables),
        processes=processes_of(tables, names),
        lost={"lost_events": lost},
        **facts,
    )


def own_pid_namespace() -> int:
    """Return the pid namespace whose numbers we see processes under (its inode)."""
    return Path("/proc/self/ns/pid").stat().st_ino


def distribution_of(
    tables: EventTables, fields: Mapping[str, Collection[str]], gid_length: int = 0
) -> str | None:
    """Return the ROS 2 distribution as `ROS_DISTRO` has it (``jazzy``); None: nothing shows it.

    CARET's `caret_init` says it, or `rcl_init` by the version of tracetools. Else the declared
    events' ``fields``: `rmw_publish` has a source timestamp since Jazzy, a gid 16 bytes instead of
    24 since Kilted, intra-process events came with Iron.
    """
    by_caret = _first(tables, "caret_init", "distribution")
    if by_caret is not None:
        return by_caret
    parts = re.match(r"(\d+)\.(\d+)", _first(tables, "rcl_init", "version") or "")
    if parts is not None:
        version = int(parts[1]), int(parts[2])
        return next((name for name, below in _RELEASES.items() if version < below), "rolling")
    if "timestamp" in fields.get("rmw_publish", ()):
        return {24: "jazzy", 16: "kilted"}.get(gid_length)
    if fields.keys() >= {"rmw_publish", "rclcpp_intra_publish", "rclcpp_ring_buffer_enqueue"}:
        return "iron"
    return "humble" if fields.keys() >= {"rmw_publish", "rclcpp_executor_execute"} else None


def _first(tables: EventTables, event: str, field: str) -> str | None:
    """Return what the first event of a name has in a field; None: there is no such event."""
    frame = tables.get(event, pl.DataFrame())
    if field not in frame.columns:
        return None
    return next(map(str, frame[field].head(1).drop_nulls()), None)


def rmw_of_gids(tables: EventTables) -> str | None:
    """Return the RMW implementation, from CARET's event, or from the endpoints' gids."""
    named = _first(tables, "rmw_implementation", "rmw_impl")
    if named is not None:
        return named
    for event in ("rmw_publisher_init", "rmw_subscription_init"):
        gids = table(tables, event, ["gid"])["gid"].drop_nulls().head(1000)
        names = {rmw_of_vendor(gid) for gid in gids}
        if len(names) == 1:
            return names.pop()
    return None


def processes_of(tables: EventTables, commands: Mapping[int, str]) -> dict[int, str]:
    """Return process → the nodes it created, else its ``commands`` entry (its tracer's name)."""
    named = table(tables, "rcl_node_init").select("pid", node=NODE_NAME).drop_nulls()
    nodes = named.unique(maintain_order=True).group_by("pid").agg(pl.col("node").str.join(", "))
    return dict(sorted({**commands, **dict(nodes.iter_rows())}.items()))
