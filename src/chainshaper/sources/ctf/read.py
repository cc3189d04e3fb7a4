"""Counting events and reading them into data frames.

Pass 1 (`_File.walk`) steps over every event of a file and counts, so that each has its row. Pass 2
(`_fill`) writes the wanted events of a chunk of a file to their rows, which are sorted in the end.
Chunks run on several threads; of a large trace only some are in memory at once.
"""

# ruff: noqa: PLR0917 - the parts of one pass

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper.sources.ctf import layout as tb
from chainshaper.sources.ctf import tsdl
from chainshaper.sources.ctf.copies import CtfStream
from chainshaper.sources.ctf.layout import Layout, Table, lay_out
from chainshaper.sources.ctf.trace import CtfTrace, MappedFile, Scratch
from chainshaper.values.compiled import kernel

_run_events = kernel("chainshaper.sources.ctf.kernels", "run_events")
_CHUNK_BYTES = 128 << 20
_SMALL_BYTES = 4 << 20
_LARGE_BYTES = 512 << 20
_HUGE_PAGE = 2 << 20
_MOST_WARNINGS = 20
_FAILURES = {
    tb.OTHER_TIME: "an event outside the time that its packet says it was open",
    tb.NO_PROCESS: "an event of process or thread 0: there are zeros instead of what was recorded",
    tb.ALL_ZEROS: "zeros instead of events",
    tb.TRUNCATED: "an event reaches past the end of its packet's content",
    tb.NO_OPTION: "a variant's tag names none of its options",
    tb.BAD_LENGTH: "an array or sequence is longer than the rest of its packet",
    tb.UNTERMINATED: "a string does not end within its packet",
    tb.UNKNOWN_EVENT: "an event id that the metadata does not declare: perhaps it ends too early",
    tb.OVER_BUDGET: "its fields, most of them of no bits, would take far more memory than its size"
    f" warrants ({tb.BUDGET} times)",
}
_Progress = Callable[[float], None]


class Events(dict[str, pl.DataFrame]):
    """Frames by event name; ``warnings`` say what cannot be read, of so many packets ``damaged``.

    ``counts`` are of all events in the streams that were read, zeros included.
    """

    warnings: tuple[str, ...] = ()
    damaged: int = 0
    counts: dict[str, int]


def count_events(
    trace: CtfTrace, threads: int | None = None
) -> tuple[dict[str, int], tuple[str, ...]]:
    """Events per name, zeros included, ordered by name, and what cannot be read.

    Raises `CtfError` where a file is gone.
    """
    found = read_events(trace, (), threads=threads, counted=True)
    return found.counts, found.warnings


def read_events(
    trace: CtfTrace,
    names: Collection[str] | None = None,
    *,
    nameless: Collection[str] = (),
    counted: bool = False,
    threads: int | None = None,
    progress: _Progress = lambda _: None,
) -> Events:
    """Read events into one frame per name, ordered by name of event.

    Every name of ``names`` (None: all) that the metadata declares is in the result, without
    rows where it never happened. Rows are sorted by ``time``; equal times stand in the order
    of the stream files, and in one file as recorded. Columns:

    * ``time``: Int64, ns on the trace's own clock (CLOCK_MONOTONIC for LTTng), its offset not
      added; ``cpu``: Int32; ``pid``, ``tid``: integers as recorded; null where the trace has none.
    * ``procname``: Categorical, where recorded; not for the events that are ``nameless``, since
      reading it is most of the work for an event without other texts.
    * the payload under its own names without LTTng's leading underscore; a field called like
      one of the above is ``payload.<name>``. Integers keep their width and sign, enumerations
      their integer; strings and text arrays are String (bytes that are not UTF-8 as ``\\xNN``),
      arrays and sequences of bytes List of UInt8. Fields of other kinds are passed over.

    Events that cannot be read end their packet; the result's ``warnings`` say which and why. All
    are to be ``counted``, or those of streams without ``names`` need not be. ``progress`` gets the
    share that is done, from 0 to 1.
    Raises `CtfError` where a file is gone or changes while it is read.
    """
    asked = trace.event_names if names is None else names
    layout = lay_out(trace.folders, {name: name not in nameless for name in asked})
    rows = {event.stream for event in layout.events if event.row[tb.E_COUNTER] >= 0}
    used = [
        stream
        for stream in trace.streams
        if counted or not rows.isdisjoint(stream.table[:, tb.P_STREAM].tolist())
    ]
    files, workers = [_File(stream) for stream in used], threads or len(os.sched_getaffinity(0))
    size = sum(file.map.size for file in files)
    chunk = min(_CHUNK_BYTES, max(_SMALL_BYTES, size // workers))
    with ThreadPoolExecutor(workers) as pool:
        # Read twice, a trace that fits into memory had better stay there in between.
        walks = pool.map(lambda file: file.walk(layout, chunk, size > _LARGE_BYTES), files)
        for done, _ in enumerate(walks, 1):
            progress(done / len(files) / 3)
        ends = np.cumsum([file.rows for file in files], axis=0)
        columns = [
            _Columns(layout, number, table, int(ends[-1][number]) if files else 0)
            for number, table in enumerate(layout.tables)
        ]
        texts = _filled(pool, files, layout, ends, columns, progress)
    try:
        events = Events(_frames(columns, texts))
    except pl.exceptions.PolarsError as error:
        reason = f"events of one name have fields of types that do not fit together: {error}"
        folder = trace.folders[0].path
        raise tsdl.CtfError(folder, None, reason, "read its folders one by one") from None
    events.warnings = tuple(_warnings(files))
    events.damaged = sum(int((file.packets[:, tb.P_ERROR] < 0).sum()) for file in files)
    events.counts = dict.fromkeys(trace.event_names, 0)
    for file in files:
        for event, number in zip(layout.events, file.counts.tolist(), strict=False):
            events.counts[event.name] += number
    return events


# Pass 1


class _Chunk(NamedTuple):
    """Packets [first, last) of a file, clock and rows of the tables before them, rows behind."""

    first: int
    last: int
    clock: int
    before: NDArray[np.int64]
    after: NDArray[np.int64]


class _File:
    """A stream file that is being read, and what pass 1 finds in it.

    ``counts`` are per event class, ``rows`` per table.
    """

    def __init__(self, stream: CtfStream) -> None:
        self.path, self.packets = stream.path, stream.table.copy()
        self.map = MappedFile(stream.path)
        self.counts = self.rows = np.zeros(0, np.int64)
        self.chunks: list[_Chunk] = []

    def walk(self, layout: Layout, chunk_bytes: int, lean: bool) -> None:
        """Step over all events, and shorten packets to what can be read; ``lean`` on memory."""
        scratch, packets = Scratch(layout), self.packets
        self.counts = np.zeros(max(len(layout.events), 1), np.int64)
        first = 0
        while first < len(packets):
            limit = packets[first, tb.P_BYTE] + chunk_bytes
            last = max(int(np.searchsorted(packets[:, tb.P_BYTE], limit)), first + 1)
            clock, before = int(scratch.state[tb.X_CLOCK]), scratch.rows.copy()
            scratch.run(_run_events, self.map, packets, first, last, self.counts.ctypes.data, 0)
            self.chunks.append(_Chunk(first, last, clock, before, scratch.rows.copy()))
            if lean:
                self.map.forget(packets[first:last])
            first = last
        self.rows = scratch.rows


def _warnings(files: Sequence[_File]) -> Iterator[str]:
    """What cannot be read, packet by packet, the first ones of very many."""
    for file in files:
        damaged = file.packets[file.packets[:, tb.P_ERROR] < 0]
        for packet in damaged[:_MOST_WARNINGS]:
            place = int(packet[tb.P_BYTE] + (packet[tb.P_ERROR_AT] >> 3))
            reason = _FAILURES[int(packet[tb.P_ERROR])]
            yield str(
                tsdl.CtfError(file.path, place, reason, "the rest of this packet is not read")
            )
        if len(damaged) > _MOST_WARNINGS:
            yield f"{file.path}: {len(damaged) - _MOST_WARNINGS} more packets are like that"


# Pass 2


def _filled(
    pool: ThreadPoolExecutor,
    files: list[_File],
    layout: Layout,
    ends: NDArray[np.int64],
    columns: list["_Columns"],
    progress: _Progress,
) -> list[bytes]:
    """Pass 2 over all chunks; returns the texts and bytes that slots then have codes of.

    ``ends`` are the tables' rows behind those of each file.
    """
    chunks = [
        (file, one._replace(before=end - file.rows + one.before, after=end - file.rows + one.after))
        for file, end in zip(files, ends, strict=True)
        for one in file.chunks
        if (one.after > one.before).any()
    ]
    codes: dict[bytes, int] = {}
    found = pool.map(lambda one: _fill(one[0], one[1], layout), chunks)
    for done, ((_, chunk), strings) in enumerate(zip(chunks, found, strict=True), 1):
        own = [codes.setdefault(string, len(codes)) for string in strings]
        if own != list(range(len(own))):
            for table in columns:
                table.recode(chunk, np.array(own, np.uint32))
        progress((1 + 2 * done / len(chunks)) / 3)
    return list(codes)


def _fill(file: _File, chunk: _Chunk, layout: Layout) -> list[bytes]:
    """Pass 2 over one chunk; the strings of its text slots."""
    scratch = Scratch(layout)
    scratch.caps[:] = chunk.after
    status = tb.FULL_DICTIONARY
    while status == tb.FULL_DICTIONARY:
        scratch.rows[:], scratch.batches[:, 0] = chunk.before, 0
        scratch.state[tb.X_CLOCK] = chunk.clock
        numbers = (chunk.first, chunk.last, 0, len(layout.events))
        status = scratch.run(_run_events, file.map, file.packets, *numbers)
        if status == tb.FULL_DICTIONARY:
            scratch.grow()
    if status < 0 or (scratch.rows != scratch.caps).any():
        reason = "it has not the events that were counted: it changed while it was read"
        raise tsdl.CtfError(file.path, None, reason, "stop the recording first")
    strings = scratch.strings()
    file.map.forget(file.packets[chunk.first : chunk.last])
    return strings


# Columns


class _Columns:
    """The arrays of one table of so many ``rows``: time, cpu (or nothing) and its slots.

    They are parts of one piece of memory, large enough for huge pages: page faults would else be a
    third of all work.
    """

    def __init__(self, layout: Layout, number: int, table: Table, rows: int) -> None:
        self.number, self.table, self.rows = number, table, rows
        wanted: list[tuple[int, np.dtype[Any]]] = [(rows, np.dtype("i8"))]
        wanted += [(rows * table.has_cpu, np.dtype("i4"))]
        wanted += [(rows, kind) for kind in table.slot_types()]
        # Columns side by side must not begin alike in their pages, or they would compete for
        # the same few lines of the processor's cache.
        sizes = [-(-count * kind.itemsize // 4096) * 4096 + 320 for count, kind in wanted]
        parts = np.split(_memory(sum(sizes)), np.cumsum(sizes))
        self.time, self.cpu, *self.slots = (
            part[: count * kind.itemsize].view(kind)
            for part, (count, kind) in zip(parts, wanted, strict=False)
        )
        cpu = self.cpu.ctypes.data if table.has_cpu else 0
        slots = [(array.ctypes.data, array.itemsize) for array in self.slots]
        layout.attach(table, self.time.ctypes.data, cpu, slots)

    def recode(self, chunk: _Chunk, codes: NDArray[np.uint32]) -> None:
        """Replace one chunk's own codes of strings by those of the whole."""
        rows = slice(chunk.before[self.number], chunk.after[self.number])
        for (_, kind), array in zip(self.table.columns, self.slots, strict=True):
            if not isinstance(kind, tsdl.IntegerType):
                array[rows] = codes[array[rows]]

    def frame(self, known: list[bytes], strings: pl.Series, categories: pl.Series) -> pl.DataFrame:
        """The table's frame; codes are of what is ``known``, which are ``strings`` as texts.

        Rows stand file by file, each in order of time but for clocks that went back.
        """
        time, cpu, *slots = self.time, self.cpu, *self.slots
        if (time[1:] < time[:-1]).any():
            order = np.argsort(time, kind="stable")
            time, cpu, *slots = (
                one.take(order, mode="clip") if one.size else one for one in (time, cpu, *slots)
            )
        found = {"time": pl.Series("time", time)}
        if self.table.has_cpu:
            found["cpu"] = pl.Series("cpu", cpu)
        for (name, kind), values in zip(self.table.columns, slots, strict=True):
            if tsdl.is_text(kind):
                texts = categories if name == "procname" else strings
                found[name] = texts.gather(pl.Series(values)).alias(name)
            elif isinstance(kind, tsdl.ArrayType):
                codes, places = np.unique(values, return_inverse=True)
                lists = [list(known[code]) for code in codes]
                found[name] = pl.Series(name, lists, pl.List(pl.UInt8)).gather(places)
            else:
                found[name] = pl.Series(name, values)
        for name in ("cpu", "pid", "tid"):
            if name not in found:
                found[name] = pl.Series(name, [None], pl.Int32).new_from_index(0, self.rows)
        leading = [n for n in ("time", "cpu", "pid", "tid", "procname") if n in found]
        return pl.DataFrame([found[n] for n in dict.fromkeys([*leading, *found])])


def _memory(size: int) -> NDArray[np.uint8]:
    """Bytes of any content; many of them fill huge pages, which NumPy asks for, from end to end."""
    if size < 2 * _HUGE_PAGE:
        return np.empty(size, np.uint8)
    memory = np.empty((size // _HUGE_PAGE + 2) * _HUGE_PAGE, np.uint8)
    first = -memory.ctypes.data % _HUGE_PAGE
    return memory[first : first + size]


def _frames(columns: list[_Columns], known: list[bytes]) -> dict[str, pl.DataFrame]:
    texts = [text.decode(errors="backslashreplace") for text in known]
    strings = pl.Series("", texts or [""], dtype=pl.String)
    categories = strings.cast(pl.Categorical)
    parts: dict[str, list[pl.DataFrame]] = {}
    while columns:
        # Arrays are let go one table at a time: Polars has copies of its own.
        table = columns.pop(0)
        parts.setdefault(table.table.name, []).append(table.frame(known, strings, categories))
    frames: dict[str, pl.DataFrame] = {}
    for name in sorted(parts):
        frame = pl.concat(parts[name], how="diagonal_relaxed", rechunk=True)
        if len(parts[name]) > 1:
            frame = frame.sort("time", maintain_order=True)
        frames[name] = frame.with_columns(pl.col("time").set_sorted())
    return frames
