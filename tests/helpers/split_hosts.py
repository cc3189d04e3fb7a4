"""Recordings of one host, split by process into those of two, whose clocks differ as one likes.

What the clocks are, and so what every latency truly is, is known.
"""

from collections.abc import Callable, Collection
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.values import events
from chainshaper.values.event_declarations import EVENTS
from chainshaper.values.recording import Recording, write_recording

Times: TypeAlias = npt.NDArray[np.int64]
Clock: TypeAlias = Callable[[Times], Times]
HOUR = 3_600_000_000_000


def true_time(times: Times) -> Times:
    """Return what a clock shows that shows the truth."""
    return times


def drifting(
    offset_ns: int, ppm: float, steps: Collection[tuple[int, int]] = (), since_ns: int = 0
) -> Clock:
    """Return a clock: what it shows at true times (ns).

    From ``since_ns`` on it runs ``ppm`` too fast; ``steps`` are when it jumps, and by how much.
    """

    def shown(times: Times) -> Times:
        result: Times = (
            times + offset_ns + np.rint((times - since_ns) * (ppm / 1e6)).astype(np.int64)
        )
        for at, by in steps:
            result = result + np.where(times >= at, by, 0)
        return result

    return shown


def split(
    recording: Recording,
    second: Collection[int],
    clocks: tuple[Clock, Clock],
    folder: Path,
    *,
    wall_ns: tuple[int, int] = (0, 0),
    names: tuple[str, str] = ("head", "base"),
) -> tuple[Path, Path]:
    """Write a recording as those of two hosts, of which the ``second`` has these processes.

    ``clocks`` are what their clocks show at the recording's times, ``wall_ns`` by how much their
    wall clocks are wrong: source timestamps too.
    """
    folder.mkdir(exist_ok=True)
    sent = events.table(recording.events, "rmw_publish").filter(pl.col("pid").is_in(list(second)))
    theirs_stamped = sent["timestamp"].implode()
    begun = events.first_and_last_start(recording.events)[0]
    paths = []
    for number, (name, clock) in enumerate(zip(names, clocks, strict=True)):
        tables = {}
        for event, table in recording.events.items():
            theirs = pl.col("pid").is_in(list(second)).fill_null(False)
            rows = table.filter(theirs if number else ~theirs)
            fields = EVENTS[event].fields if event in EVENTS else ()
            instants = ["time", *(field.name for field in fields if field.kind == "instant")]
            for column in ("timestamp", "source_timestamp"):
                if event in ("rmw_publish", "rmw_take") and column in rows.columns:
                    late = pl.col(column).is_in(theirs_stamped)
                    stamp = pl.col(column) + wall_ns[0]
                    stamped = pl.when(late).then(pl.col(column) + wall_ns[1]).otherwise(stamp)
                    rows = rows.with_columns(stamped.alias(column))
            tables[event] = rows.with_columns(
                _shown(rows[column], clock) for column in instants if column in rows.columns
            )
        at_begin = int(clock(np.array([begun], dtype=np.int64))[0]) - begun
        info = recording.info.model_copy(
            update={
                "host": name,
                "clock_offset_ns": recording.info.clock_offset_ns - at_begin + wall_ns[number],
                "checksums": None,
                "stall_meter": None,
                "application": None,
                "processes": {
                    pid: node
                    for pid, node in recording.info.processes.items()
                    if (pid in second) == bool(number)
                },
                "threads": (),
            }
        )
        paths.append(write_recording(folder / f"{number}_{name}", tables, info).path)
    return paths[0], paths[1]


def _shown(column: pl.Series, clock: Clock) -> pl.Series:
    times = column.fill_null(0).to_numpy()
    shown = pl.Series(column.name, np.where(times > 0, clock(times), times), pl.Int64)
    return shown.set(column.is_null(), None) if column.null_count() else shown
