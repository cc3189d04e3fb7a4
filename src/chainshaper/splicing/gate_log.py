"""The log of a shaping node as a table: what it did with each message.

A node in ROS 2 is not recorded like one of the live workload, so it notes its decisions itself:
lines of comma-separated values with the columns of the event ``gate_release``
(:mod:`chainshaper.events`), to which this turns them.
"""

import contextlib
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper import events
from chainshaper.enforcement.gate import STALL_NS
from chainshaper.errors import InputError

__all__ = ["read_gate_log", "releases_so_far", "with_gate_logs"]


def read_gate_log(path: str | Path) -> pl.DataFrame:
    """The event table ``gate_release`` of a shaping node's log, sorted by time.

    ``callback`` is null: a node does not know its callback's handle. The last line is left out if
    it is not whole, as when the node was killed while it wrote.

    Raises:
        InputError: no such file, or it is no shaping node's log.
    """
    types = {
        **events.COMMON_COLUMNS,
        **events.FIELDS["gate_release"],
        **events.OPTIONAL_FIELDS["gate_release"],
    }
    try:
        text = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    whole = text[: text.rfind(b"\n") + 1]
    names = whole.split(b"\n", 1)[0].decode(errors="replace").split(",")
    if set(names) != types.keys() - {"callback"}:
        raise InputError(
            f"{path}:1: this is not the log of a shaping node, which begins with the names of its "
            "columns: name the file that the parameter `log` of the node names"
        )
    try:
        table = pl.read_csv(whole, schema={name: types[name] for name in names})
    except pl.exceptions.PolarsError as error:
        raise InputError(f"{path}: a line is not as a shaping node writes it: {error}") from error
    null = pl.lit(None, dtype=types["callback"]).alias("callback")
    return table.with_columns(null).select(*types).sort("time", maintain_order=True)


def releases_so_far(logs: Iterable[Path]) -> npt.NDArray[np.int64]:
    """The latest planned releases (ns) of shaping nodes that are at work, at most 100 of each."""
    found = [np.empty(0, dtype=np.int64)]
    for log in logs:
        with contextlib.suppress(InputError):  # not there yet, or nothing is in it
            found.append(read_gate_log(log)["release"].drop_nulls().tail(100).to_numpy())
    return np.concatenate(found)


def with_gate_logs(
    tables: events.EventTables, logs: Sequence[Path], since_ns: int, until_ns: int
) -> tuple[events.EventTables, tuple[str, ...]]:
    """Event tables with `gate_release` from the logs of shaping nodes, and which are not there.

    A node writes its log for as long as it runs. Of that, the cycles count that began at
    ``since_ns`` or later, and whose message was let go before ``until_ns``: those are in the other
    tables too (both CLOCK_MONOTONIC).

    Raises:
        InputError: a file is no shaping node's log.
    """
    there = [log for log in logs if log.is_file()]
    missing = tuple(
        f"the shaping node's log {log} is not there: it has let nothing through, or did not start."
        for log in logs
        if log not in there
    )
    if not there:
        return tables, missing
    releases = pl.concat([read_gate_log(log) for log in there]).sort("time", maintain_order=True)
    releases = releases.filter(pl.col("origin") >= since_ns, pl.col("time") < until_ns)
    stalls = pl.concat([events.table(tables, "machine_stall"), _stalls(releases)], how="diagonal")
    stalls = stalls.sort("time", maintain_order=True)
    return {**tables, "gate_release": releases, "machine_stall": stalls}, missing


def _stalls(releases: pl.DataFrame) -> pl.DataFrame:
    """The rows of `machine_stall` that gates saw: each watches the clock at its releases."""
    seen = releases.filter(pl.col("stalled") >= STALL_NS)
    return seen.select("pid", "tid", "cpu", time="release", duration="stalled")
