"""The records of traced processes as event tables."""

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper.sources.preload.memory import (
    FIRST_EVENT,
    LIBRARY,
    TracedProcess,
    event_names,
)
from chainshaper.sources.registers import table_of_registers
from chainshaper.sources.tracing_library import TracingLibrary, version_of
from chainshaper.values import events
from chainshaper.values.event_declarations import EVENTS

_COMMON = ("time", "tid", "cpu")


def creation_tables(process: TracedProcess) -> tuple[dict[str, pl.DataFrame], TracingLibrary]:
    """Return the tables of a process's events of creation, and the tracing library behind ours."""
    objects, texts = process.objects()
    places = np.flatnonzero(objects["event"] == LIBRARY)
    path = ""
    if places.size:
        path = texts.get(int(places[0]), {}).get(0, "").partition("\0")[0]
    library = TracingLibrary(Path(path), frozenset(), version_of(Path(path)))
    pids = np.full(objects.size, process.pid, np.int32)
    return _tables(objects, pids, texts, library, events.CREATION), library


def event_tables(
    records: NDArray[Any], pids: NDArray[np.int32], library: TracingLibrary
) -> dict[str, pl.DataFrame]:
    """Return the tables of records of :meth:`TracedProcess.new_records`, each of a process."""
    return _tables(records, pids, {}, library, frozenset(events.FIELDS) - events.CREATION)


def joined_tables(parts: Iterable[Mapping[str, pl.DataFrame]]) -> dict[str, pl.DataFrame]:
    """Join the tables of several processes, in order of time."""
    parts_of: dict[str, list[pl.DataFrame]] = {}
    for tables in parts:
        for name, table in tables.items():
            parts_of.setdefault(name, []).append(table)
    joined = dict[str, pl.DataFrame]()
    for name, tables_of_event in parts_of.items():
        table = pl.concat(tables_of_event, how="diagonal")
        in_order = table["time"].is_sorted()
        joined[name] = table if in_order else table.sort("time", maintain_order=True)
    return joined


def _tables(
    records: NDArray[Any],
    pids: NDArray[np.int32],
    texts: Mapping[int, Mapping[int, str]],
    library: TracingLibrary,
    names: Collection[str],
) -> dict[str, pl.DataFrame]:
    """Return the tables of the events of these names. ``texts`` are by place of a record."""
    tables = {}
    for number, name in enumerate(event_names(), FIRST_EVENT):
        places = np.flatnonzero(records["event"] == number) if name in names else np.array([])
        if places.size:

            def texts_at(place: int, events: NDArray[np.int64] = places) -> list[str | None]:
                return [texts.get(event, {}).get(place) for event in events.tolist()]

            rows, event = records.take(places), EVENTS[name]
            common = {column: np.ascontiguousarray(rows[column]) for column in _COMMON}
            # Service calls come from rmw, not from a tracetools that has functions for them.
            fields = event.fields
            if event.recorded_by_library == "arguments":
                fields = event.fields_of_version(library.major)
            recorded = [
                (field, place)
                for field in fields
                if (place := event.place_in_record(field)) is not None
            ]
            frame = pl.DataFrame({**common, "pid": pids[places]})
            tables[name] = table_of_registers(
                name, recorded, frame, rows["values"], texts_at, version=library.version
            )
    return tables
