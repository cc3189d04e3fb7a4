"""Counting events and reading them into data frames."""

# ruff: noqa: PLR0917 - the parts of one pass

from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper.sources.ctf import tables as tb
from chainshaper.sources.ctf.assembly import Assembly, Table, Wanted, assemble, attach
from chainshaper.sources.ctf.decode import (
    LARGE_BYTES,
    CtfStream,
    MappedFile,
    Stream,
    Walk,
    default_threads,
    fill,
    span_borders,
    walk,
)
from chainshaper.sources.ctf.program import (
    ListShape,
    OptionShape,
    RecordShape,
    ScalarShape,
    Shape,
    Storage,
    TextShape,
)
from chainshaper.sources.ctf.trace import CtfTrace

__all__ = ["Events", "count_events", "read_events"]

_HUGE_PAGE = 2 << 20
_NULL_COLUMNS = {"cpu": pl.Int32, "pid": pl.Int32, "tid": pl.Int32}
_Progress = Callable[[float], None]


class Events(dict[str, pl.DataFrame]):
    """Frames by event name.

    ``warnings`` say what could not be read, ``counts`` how often each event happened in the
    streams that were read, also those that were not asked for; ``unread`` are the other streams.
    """

    warnings: tuple[str, ...] = ()
    counts: dict[str, int]
    unread: tuple[CtfStream, ...] = ()


def count_events(trace: CtfTrace, threads: int | None = None) -> dict[str, int]:
    """Events per name, zeros included, ordered by name; nothing is built.

    Raises `CtfError` where a file is gone.
    """
    assembly = assemble(trace.folders, Wanted())
    with _mapped(trace.streams) as streams:
        walks = _walks(streams, assembly, np.zeros(0, np.int64), threads)
    return _counts(trace, assembly, walks)


def read_events(
    trace: CtfTrace,
    names: Collection[str] | None = None,
    *,
    context: bool = False,
    nameless: Collection[str] = (),
    threads: int | None = None,
    progress: _Progress = lambda _: None,
) -> Events:
    """Read events into one frame per name, ordered by name of event.

    Every name of ``names`` (None: all) that the metadata declares is in the result, without
    rows where it never happened. Rows are sorted by ``time``; equal times stand in the order
    of the stream files, and in one file as recorded. Columns:

    * ``time``: Int64, ns on the trace's own clock (CLOCK_MONOTONIC for LTTng), its offset not
      added; ``cpu``: Int32; ``pid``, ``tid``: integers as recorded (``vpid``, ``vtid`` in user
      space, ``pid``, ``tid`` in the kernel); null where the trace has none.
    * ``procname``: Categorical, where recorded; not for the events that are ``nameless``, since
      reading it is most of the work for an event without other texts.
    * the payload under its own names without LTTng's leading underscore; a field called like
      one of the above is ``payload.<name>``. Integers and floats keep their width and sign,
      enumerations their integer; strings and text arrays are String (bytes that are not UTF-8
      as ``\\xNN``); arrays are Array, sequences List, structures Struct, variants Struct with
      all but the chosen option null.
    * with ``context``, the other context fields as ``context.<name>``.

    Events that cannot be read end their packet; the result's ``warnings`` say which and why.
    ``progress`` gets the share that is done, from 0 to 1.
    Raises `CtfError` where a file is gone or changes while it is read.
    """
    asked = frozenset(trace.event_names if names is None else names)
    assembly = assemble(trace.folders, Wanted(asked, frozenset(nameless), context))
    rows = {event.stream for event in assembly.events if event.table >= 0}
    used = [s for s in trace.streams if not rows.isdisjoint(s.table[:, tb.P_STREAM].tolist())]
    borders = span_borders(used, threads or default_threads())
    with _mapped(used) as streams:
        walks = _walks(streams, assembly, borders, threads, lambda share: progress(share / 3))
        total = sum((w.reached[-1] for w in walks), np.zeros(max(assembly.counters, 1), np.int64))
        storage = [_allocate(assembly, number, total) for number in range(len(assembly.tables))]
        texts = _fill(
            streams, walks, assembly, storage, threads, lambda share: progress((1 + 2 * share) / 3)
        )
    unsorted = not all(w.sorted for w in walks)
    events = Events(_frames(assembly, storage, texts, unsorted))
    events.warnings = tuple(w for found in walks for w in found.warnings)
    events.counts = _counts(trace, assembly, walks)
    read_paths = {stream.path for stream in used}
    events.unread = tuple(s for s in trace.streams if s.path not in read_paths)
    return events


def _counts(trace: CtfTrace, assembly: Assembly, walks: list[Walk]) -> dict[str, int]:
    counts = dict.fromkeys(trace.event_names, 0)
    for found in walks:
        for event, number in zip(assembly.events, found.counts.tolist(), strict=False):
            counts[event.name] += number
    return counts


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
    progress: _Progress = lambda _: None,
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
        addresses=[a.ctypes.data for a in arrays.slots],
        widths=[a.itemsize for a in arrays.slots],
    )
    cpu = arrays.cpu.ctypes.data if arrays.cpu is not None else 0
    attach(assembly, number, storage, arrays.time.ctypes.data, cpu)
    return arrays


def _fill(
    streams: list[Stream],
    walks: list[Walk],
    assembly: Assembly,
    storage: list[_Arrays],
    threads: int | None,
    progress: _Progress,
) -> list[str]:
    """Pass 2 over all spans; returns the strings that text slots then hold codes of."""
    if not streams:
        return []
    packets = np.concatenate([stream.packets for stream in streams])
    spans = len(walks[0].reached) - 1
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
    before, after = (sum(w.reached[border] for w in walks) for border in (span, span + 1))
    for table, arrays in zip(assembly.tables, storage, strict=True):
        for place in (place for _, shape in table.columns for place in _text_slots(shape)):
            counter = table.counter + table.slots[place].level
            part = arrays.slots[place][before[counter] : after[counter]]
            part[:] = codes[part]


def _text_slots(shape: Shape | None) -> Iterator[int]:
    match shape:
        case TextShape(slot=slot):
            yield slot
        case ListShape(element=element):
            yield from _text_slots(element)
        case RecordShape(fields=parts) | OptionShape(options=parts):
            for _, part in parts:
                yield from _text_slots(part)


def _frames(
    assembly: Assembly, storage: list[_Arrays], texts: list[str], unsorted: bool
) -> dict[str, pl.DataFrame]:
    strings = pl.Series("", texts or [""], dtype=pl.String)
    categories = strings.cast(pl.Categorical)
    parts: dict[str, list[pl.DataFrame]] = {}
    for table in assembly.tables:
        # Arrays are let go one table at a time: Polars has copies of its own.
        frame = _frame(table, storage.pop(0), strings, categories)
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
        found[name] = _column(name, shape, arrays.slots, rows, texts)
    for name, kind in _NULL_COLUMNS.items():
        if name not in found:
            found[name] = pl.Series(name, [None], dtype=kind).new_from_index(0, rows[0])
    leading = ["time", "cpu", "pid", "tid", *(["procname"] if "procname" in found else [])]
    return pl.DataFrame([found[n] for n in leading + [n for n in found if n not in leading]])


def _column(
    name: str,
    shape: Shape,
    slots: Sequence[NDArray[Any]],
    rows: Sequence[int],
    texts: pl.Series,
    level: int = 0,
) -> pl.Series:
    """One column of a table.

    ``slots`` are the table's arrays, ``rows`` the rows of each level, ``texts`` the strings
    that text slots hold codes of. Numbers keep their type; arrays become Polars arrays,
    sequences lists, structures and variants structs, an absent option null.
    """
    match shape:
        case ScalarShape(slot=slot):
            return pl.Series(name, slots[slot])
        case TextShape(slot=slot):
            return texts.gather(pl.Series(slots[slot])).alias(name)
        case ListShape(slot=slot, level=inner, count=count, element=element):
            values = _column(name, element, slots, rows, texts, inner)
            if slot < 0 and count > 0:
                deeper = values.dtype.shape if isinstance(values.dtype, pl.Array) else ()
                return values.reshape((rows[level], count, *deeper))
            return _ragged(values, slots[slot] if slot >= 0 else np.zeros(rows[level], np.uint32))
        case RecordShape(fields=fields):
            parts = [_column(n, s, slots, rows, texts, level) for n, s in fields]
        case OptionShape(slot=slot, options=options):
            chosen = pl.Series(slots[slot])
            parts = []
            for number, (option, inside) in enumerate(options, start=1):
                if inside is not None:
                    values = _column(option, inside, slots, rows, texts, level)
                    present = pl.when(pl.Series(chosen == number)).then(pl.lit(values))
                    parts.append(pl.select(present.otherwise(None).alias(option)).to_series())
            if not parts:
                return pl.Series(name, [None] * rows[level], dtype=pl.Null)
    return pl.DataFrame(_distinct(parts)).to_struct(name)


def _ragged(values: pl.Series, lengths: NDArray[Any]) -> pl.Series:
    """``values`` cut into lists of the given lengths, in order."""
    full = np.flatnonzero(lengths)
    if not len(full):
        return pl.Series(values.name, [[]] * len(lengths), dtype=pl.List(values.dtype))
    owner = pl.Series("owner", np.repeat(full, lengths[full])).set_sorted()
    lists = (
        pl.DataFrame([owner, values.alias("value")])
        .group_by("owner", maintain_order=True)
        .agg("value")["value"]
        .alias(values.name)
    )
    if len(full) == len(lengths):
        return lists
    # Rows without an element point at an empty list behind the others.
    empty = pl.Series(values.name, [[]], dtype=lists.dtype)
    places = np.full(len(lengths), len(full), np.uint32)
    places[full] = np.arange(len(full), dtype=np.uint32)
    return pl.concat([lists, empty]).gather(pl.Series(places))


def _distinct(parts: list[pl.Series]) -> list[pl.Series]:
    """Columns with a name each: ``_a`` and ``a`` of one structure are both shown as ``a``."""
    found: dict[str, pl.Series] = {}
    for part in parts:
        name = part.name
        while name in found:
            name = "_" + name
        found[name] = part.alias(name)
    return list(found.values())
