"""From the event logs of the live workload's processes to the event tables."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from chainshaper.values import events
from chainshaper.workload.event_log import ABSENT, LAYOUT, WIDTH, WORDS
from chainshaper.workload.stall_meter import NO_PACE

__all__ = ["ProcessLog", "event_tables", "meter_tables"]


_MAY_BE_ABSENT = {"gate_release": ("release", "slot")}


@dataclass(frozen=True)
class ProcessLog:
    """What one process recorded: rows of :mod:`~chainshaper.workload.event_log`, and objects."""

    pid: int
    core: int | None  # the one its executor was pinned to
    rows: bytes
    objects: tuple[dict[str, Any], ...]
    modes: tuple[str, ...] = ()  # that its gate knows


def event_tables(logs: Sequence[ProcessLog], from_ns: int) -> dict[str, pl.DataFrame]:
    """The event tables of all processes, sorted by time.

    Events before ``from_ns`` (the warm-up) are left out, objects are not: they exist throughout.
    """
    parts: dict[str, list[pl.DataFrame]] = {}
    for log in logs:
        rows = np.frombuffer(log.rows, dtype=np.int64).reshape(-1, WIDTH)
        rows = rows[rows[:, 1] >= from_ns]
        for number, (name, fields) in enumerate(LAYOUT):
            mine = rows[rows[:, 0] == number]
            if len(mine):
                columns = {"time": mine[:, 1]}
                columns |= {field: mine[:, 2 + i] for i, field in enumerate(fields)}
                parts.setdefault(name, []).append(_typed(name, pl.DataFrame(columns), log))
        for created in log.objects:
            name = created["event"]
            fields_of = {key: [value] for key, value in created.items() if key != "event"}
            parts.setdefault(name, []).append(_typed(name, pl.DataFrame(fields_of), log))
    return {
        name: pl.concat(frames).sort("time", maintain_order=True)
        for name, frames in sorted(parts.items())
    }


def _typed(name: str, frame: pl.DataFrame, log: ProcessLog) -> pl.DataFrame:
    frame = frame.with_columns(
        pl.when(pl.col(field) != ABSENT).then(pl.col(field)).alias(field)
        for field in _MAY_BE_ABSENT.get(name, ())
    )
    frame = frame.with_columns(
        pl.col(field).replace_strict(dict(enumerate(words)), default=None, return_dtype=pl.String())
        for field, words in {**WORDS, "mode": log.modes}.items()
        if field in frame.columns
    )
    tid = pl.col("tid") if "tid" in frame.columns else pl.lit(log.pid)  # executors: the main thread
    types = {**events.FIELDS[name], **events.OPTIONAL_FIELDS.get(name, {})}
    return frame.select(
        pl.col("time").cast(pl.Int64),
        pl.lit(log.pid, dtype=pl.Int32).alias("pid"),
        tid.cast(pl.Int32).alias("tid"),
        pl.lit(log.core, dtype=pl.Int32).alias("cpu"),
        *(pl.col(field).cast(type_) for field, type_ in types.items() if field in frame.columns),
    )


def meter_tables(
    seen: Sequence[tuple[int, int, bytes]], seen_by_gates: pl.DataFrame | None = None
) -> dict[str, pl.DataFrame]:
    """`machine_stall` and `machine_pace` from (pid, core, rows of `stall_meter.watch`) per meter.

    What a gate noticed while it watched the clock is added to the stalls.
    """
    rows = [
        pl.DataFrame(
            np.frombuffer(block, dtype=np.int64).reshape(-1, 3),
            schema=["time", "duration", "cpu_time"],
        ).with_columns(pl.lit(pid, pl.Int32()).alias("pid"), pl.lit(core, pl.Int32()).alias("cpu"))
        for pid, core, block in seen
    ]
    by_meters = pl.concat([events.empty("machine_pace").drop("tid"), *rows], how="diagonal")
    by_meters = by_meters.with_columns(tid=pl.col("pid"))
    is_stall = pl.col("cpu_time") == NO_PACE
    stalls = by_meters.filter(is_stall).select(events.empty("machine_stall").columns)
    paces = by_meters.filter(~is_stall).select(events.empty("machine_pace").columns)
    if seen_by_gates is not None:
        stalls = pl.concat([seen_by_gates, stalls])
    return {
        "machine_stall": stalls.sort("time", maintain_order=True),
        "machine_pace": paces.sort("time", maintain_order=True),
    }
