"""Counting events and reading them into data frames."""

# ruff: noqa: PLR0917 - the parts of one pass

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper.sources.ctf.assembly import Assembly, Table, Wanted, assemble, attach
from chainshaper.sources.ctf.columns import column
from chainshaper.sources.ctf.decode import (
    LARGE_BYTES,
    Stream,
    Walk,
    default_threads,
    fill,
    span_borders,
    walk,
)
from chainshaper.sources.ctf.layout import TextShape
from chainshaper.sources.ctf.program import Storage
from chainshaper.sources.ctf.streams import MappedFile
from chainshaper.sources.ctf.trace import CtfStream, CtfTrace

__all__ = ["Events", "count", "read"]

_HUGE_PAGE = 2 << 20
_NULL_COLUMNS = {"cpu": pl.Int32, "pid": pl.Int32, "tid": pl.Int32}


class Events(dict[str, pl.DataFrame]):
    """Frames by event name.

    ``warnings`` say what could not be read, ``counts`` how often each event happened in the
    streams that were read, also those that were not asked for; ``unread`` are the other streams.
    """

    warnings: tuple[str, ...] = ()
    counts: dict[str, int]
    unread: tuple[CtfStream, ...] = ()


def count(trace: CtfTrace, threads: int | None = None) -> tuple[dict[str, int], tuple[str, ...]]:
    """Events per name in order of the names, zeros included, and warnings."""
    assembly = _assembly(trace, Wanted())
    with _mapped(trace.streams) as streams:
        walks = _walks(streams, assembly, np.zeros(0, np.int64), threads)
    return _counts(trace, assembly, walks), tuple(w for found in walks for w in found.warnings)


def read(
    trace: CtfTrace,
    wanted: Wanted,
    threads: int | None,
    progress: Callable[[float], None] = lambda _: None,
) -> Events:
    """See `chainshaper.sources.ctf.read_events`."""
    assembly = _assembly(trace, wanted)
    rows = {assembly.event_streams[e] for e, t in enumerate(assembly.event_tables) if t >= 0}
    used = [s for s in trace.streams if not rows.isdisjoint(s.table[:, 2].tolist())]
    borders = span_borders(used, threads or default_threads())
    with _mapped(used) as streams:
        walks = _walks(streams, assembly, borders, threads, lambda share: progress(share / 3))
        total = sum((w.reached[-1] for w in walks), np.zeros(max(assembly.counters, 1), np.int64))
        storage = [_allocate(assembly, number, total) for number in range(len(assembly.tables))]
        texts = _fill(
            streams,
            walks,
            assembly,
            storage,
            len(borders) + 1,
            threads,
            lambda share: progress((1 + 2 * share) / 3),
        )
    unsorted = not all(w.sorted for w in walks)
    events = Events(_frames(assembly, storage, total, texts, unsorted))
    events.warnings = tuple(w for found in walks for w in found.warnings)
    events.counts = _counts(trace, assembly, walks)
    read_paths = {stream.path for stream in used}
    events.unread = tuple(s for s in trace.streams if s.path not in read_paths)
    return events


def _counts(trace: CtfTrace, assembly: Assembly, walks: list[Walk]) -> dict[str, int]:
    counts = dict.fromkeys(trace.event_names, 0)
    for found in walks:
        for name, number in zip(assembly.event_names, found.counts.tolist(), strict=False):
            counts[name] += number
    return counts


def _assembly(trace: CtfTrace, wanted: Wanted) -> Assembly:
    folders = [(folder.path, folder.declared) for folder in trace.folders]
    return assemble(folders, wanted)


@contextmanager
def _mapped(streams: Sequence[CtfStream]) -> Iterator[list[Stream]]:
    opened: list[Stream] = []
    try:
        for stream in streams:
            opened.append(Stream(stream.path, stream.table.copy(), MappedFile(stream.path)))
        yield opened
    finally:
        for one in opened:
            one.file.close()


def _walks(
    streams: list[Stream],
    assembly: Assembly,
    borders: NDArray[np.int64],
    threads: int | None,
    progress: Callable[[float], None] = lambda _: None,
) -> list[Walk]:
    size = sum(stream.file.size for stream in streams)
    # Read twice, a trace that fits into memory had better stay there in between.
    lean = size > LARGE_BYTES
    walks, done = [], 0
    with ThreadPoolExecutor(threads or default_threads()) as pool:
        found = pool.map(lambda stream: walk(stream, assembly, borders, lean), streams)
        for stream, one in zip(streams, found, strict=True):
            walks.append(one)
            done += stream.file.size
            progress(done / max(size, 1))
    return walks


class _Arrays:
    """The arrays of one table: time, cpu (or None) and its slots.

    They are parts of one piece of memory, large enough for huge pages: at millions of rows a
    second, the kernel's page faults would else be a third of all work.
    """

    def __init__(self, table: Table, total: NDArray[np.int64]) -> None:
        self.rows = [int(n) for n in total[table.counter : table.counter + table.levels]]
        wanted: list[tuple[int, np.dtype[Any]]] = [
            (self.rows[0], np.dtype("i8")),
            (self.rows[0] * table.has_cpu, np.dtype("i4")),
        ]
        wanted += [(self.rows[slot.level], np.dtype(slot.dtype)) for slot in table.slots]
        # Columns side by side must not begin alike in their pages, or they would compete for
        # the same few lines of the processor's cache.
        sizes = [-(-rows * kind.itemsize // 4096) * 4096 + 320 for rows, kind in wanted]
        memory = _memory(sum(sizes))
        arrays: list[NDArray[Any]] = []
        start = 0
        for (rows, kind), size in zip(wanted, sizes, strict=True):
            arrays.append(memory[start : start + rows * kind.itemsize].view(kind))
            start += size
        self.time = arrays[0]
        self.cpu = arrays[1] if table.has_cpu else None
        self.slots = arrays[2:]
        for slot, array in zip(table.slots, self.slots, strict=True):
            if slot.sparse:
                array[:] = 0


def _memory(size: int) -> NDArray[np.uint8]:
    """Bytes that hold anything; many of them fill huge pages from the first to the last.

    NumPy asks for huge pages where it can; what lies before the first and behind the last whole
    one would come in hundreds of small pages, each at the cost of a fault.
    """
    if size < 2 * _HUGE_PAGE:
        return np.empty(size, np.uint8)
    memory = np.empty((size // _HUGE_PAGE + 2) * _HUGE_PAGE, np.uint8)
    first = -memory.ctypes.data % _HUGE_PAGE
    return memory[first : first + size]


def _allocate(assembly: Assembly, number: int, total: NDArray[np.int64]) -> _Arrays:
    table = assembly.tables[number]
    arrays = _Arrays(table, total)
    storage = Storage(
        table.counter,
        [a.ctypes.data for a in arrays.slots],
        [a.itemsize for a in arrays.slots],
    )
    cpu = arrays.cpu.ctypes.data if arrays.cpu is not None else 0
    attach(assembly, number, storage, arrays.time.ctypes.data, cpu)
    return arrays


def _fill(
    streams: list[Stream],
    walks: list[Walk],
    assembly: Assembly,
    storage: list[_Arrays],
    spans: int,
    threads: int | None,
    progress: Callable[[float], None],
) -> list[str]:
    """Pass 2 over all spans; returns the strings that text slots then hold codes of."""
    if not streams:
        return []
    packets = np.concatenate([stream.packets for stream in streams])
    codes: dict[bytes, int] = {}
    with ThreadPoolExecutor(threads or default_threads()) as pool:
        found = pool.map(lambda s: fill(s, streams, walks, packets, assembly), range(spans))
        for span, strings in enumerate(found):
            own = [codes.setdefault(string, len(codes)) for string in strings]
            if own != list(range(len(own))):
                _recode(span, walks, assembly, storage, np.array(own, np.uint32))
            progress((span + 1) / spans)
    return [string.decode(errors="backslashreplace") for string in codes]


def _recode(
    span: int,
    walks: list[Walk],
    assembly: Assembly,
    storage: list[_Arrays],
    codes: NDArray[np.uint32],
) -> None:
    """Replace one span's own codes of strings by those of the whole."""
    before = sum(w.reached[span - 1] for w in walks) if span else walks[0].reached[0] * 0
    after = sum(w.reached[span] for w in walks)
    for table, arrays in zip(assembly.tables, storage, strict=True):
        for place in _text_slots(table):
            counter = table.counter + table.slots[place].level
            part = arrays.slots[place][before[counter] : after[counter]]
            part[:] = codes[part]


def _text_slots(table: Table) -> list[int]:
    def inside(shape: Any) -> Iterator[int]:
        if isinstance(shape, TextShape):
            yield shape.slot
        elif hasattr(shape, "element"):
            yield from inside(shape.element)
        for _, part in getattr(shape, "fields", ()) or getattr(shape, "options", ()):
            yield from inside(part)

    return [slot for _, shape in table.columns for slot in inside(shape)]


def _frames(
    assembly: Assembly,
    storage: list[_Arrays],
    total: NDArray[np.int64],
    texts: list[str],
    unsorted: bool,
) -> dict[str, pl.DataFrame]:
    strings = pl.Series("", texts or [""], dtype=pl.String)
    categories = strings.cast(pl.Categorical)
    parts: dict[str, list[pl.DataFrame]] = {}
    for number, table in enumerate(assembly.tables):
        # Arrays are let go one table at a time: Polars has copies of its own.
        frame = _frame(table, storage[number], strings, categories)
        storage[number] = _Arrays(table, total * 0)
        parts.setdefault(table.name, []).append(frame)
    frames: dict[str, pl.DataFrame] = {}
    for name in sorted(parts):
        frame = pl.concat(parts[name], how="diagonal_relaxed", rechunk=True)
        if unsorted or len(parts[name]) > 1:
            frame = frame.sort("time", maintain_order=True)
        frames[name] = frame.with_columns(pl.col("time").set_sorted())
    return frames


def _frame(
    table: Table, arrays: _Arrays, strings: pl.Series, categories: pl.Series
) -> pl.DataFrame:
    rows = arrays.rows
    found = {"time": pl.Series("time", arrays.time)}
    if arrays.cpu is not None:
        found["cpu"] = pl.Series("cpu", arrays.cpu)
    for name, shape in table.columns:
        texts = categories if name == "procname" else strings
        found[name] = column(name, shape, arrays.slots, rows, texts)
    for name, kind in _NULL_COLUMNS.items():
        if name not in found:
            found[name] = pl.Series(name, [None], dtype=kind).new_from_index(0, rows[0])
    leading = ["time", "cpu", "pid", "tid", *(["procname"] if "procname" in found else [])]
    return pl.DataFrame([found[n] for n in leading + [n for n in found if n not in leading]])
