"""Tables of events whose fields were recorded as registers: a function's arguments.

Uprobes and the tracing library in front of ROS 2 see the arguments of `ros_trace_<event>` as the
caller left them in 64-bit registers.
"""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper.values import events
from chainshaper.values.event_declarations import EventField


def table_of_registers(
    event: str,
    places: Iterable[tuple[EventField, int]],
    common: pl.DataFrame,
    values: NDArray[np.uint64],
    texts: Callable[[int], Any],
    *,
    version: str | None,
) -> pl.DataFrame:
    """Return the table of an event, sorted by time.

    * ``places``: fields, and in which register each is, from 0; a gid is in two of them.
    * ``common``: a row for each event, with the columns that all tables begin with.
    * ``values``: a row of registers for each event.
    * ``texts``: gives the texts whose addresses were in a register, one for each event.
    * ``version``: of the tracing library, which `rcl_init` has as a field.
    """
    columns: dict[str, Any] = {}
    for field, place in places:
        match field.kind:
            case "text":
                columns[field.name] = pl.Series(texts(place), dtype=pl.String)
            case "gid":
                gids = np.ascontiguousarray(values[:, place : place + 2])
                columns[field.name] = pl.Series(gids.view(np.uint8)).cast(pl.List(pl.UInt8))
            case "flag":  # the upper bytes of a register with a bool are undefined
                columns[field.name] = pl.Series(np.ascontiguousarray(values[:, place]) & 0xFF)
            case _:
                columns[field.name] = pl.Series(np.ascontiguousarray(values[:, place]))
    frame = common.with_columns(**columns)
    if event == "rcl_init":
        frame = frame.with_columns(version=pl.lit(version, pl.String))
    columns_as_declared = []
    for name, dtype in events.column_types(event).items():
        if name not in frame.columns:
            continue
        if dtype == pl.Int64() and frame.schema[name] == pl.UInt64():
            columns_as_declared.append(pl.col(name).reinterpret(signed=True))
        else:
            columns_as_declared.append(pl.col(name).cast(dtype))
    return frame.select(columns_as_declared).sort("time", maintain_order=True)
