"""Counting events and reading them into data frames.

Pass 1 (`_File.walk`) steps over every event, counts, and finds where each span of time begins in
each file. Pass 2 (`_fill`) merges the streams of one span by time and writes the wanted events to
their rows. Spans run on several threads; of a large trace only some are in memory at once.
"""

# ruff: noqa: PLR0917 - the parts of one pass

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper.sources.ctf import layout as tb
from chainshaper.sources.ctf import tsdl
from chainshaper.sources.ctf.layout import Layout, Table, lay_out
from chainshaper.sources.ctf.trace import CtfStream, CtfTrace, MappedFile, Scratch
from chainshaper.values.compiled import kernel

_walk_events = kernel("chainshaper.sources.ctf.kernels", "walk_events")
_fill_columns = kernel("chainshaper.sources.ctf.kernels", "fill_columns")
_CHUNK_BYTES = 128 << 20
_SMALL_BYTES = 4 << 20
_LARGE_BYTES = 512 << 20
_HUGE_PAGE = 2 << 20
_MOST_WARNINGS = 20
_FAILURES = {
    tb.TRUNCATED: "an event reaches past the end of its packet's content",
    tb.NO_OPTION: "a variant's tag names none of its options",
    tb.BAD_LENGTH: "an array or sequence is longer than the rest of its packet",
    tb.UNTERMINATED: "a string does not end within its packet",
    tb.UNKNOWN_EVENT: "an event id that the metadata does not declare",
    tb.OVER_BUDGET: "its fields, most of them of no bits, would take far more memory than its size"
    f" warrants ({tb.BUDGET} times)",
    tb.FULL_TABLE: "more events than were counted",
}
_Progress = Callable[[float], None]


class Events(dict[str, pl.DataFrame]):
    """Frames by event name; ``warnings`` say what could not be read.

    ``counts`` are of all events in the streams that were read; ``unread`` are the other streams.
    """

    warnings: tuple[str, ...] = ()
    counts: dict[str, int]
    unread: tuple[CtfStream, ...] = ()


def count_events(
    trace: CtfTrace, threads: int | None = None
) -> tuple[dict[str, int], tuple[str, ...]]:
    """Events per name, zeros included, ordered by name, and what cannot be read.

    Raises `CtfError` where a file is gone.
    """
    layout = lay_out(trace.folders, {})
    files = _walked(trace.streams, layout, np.zeros(0, np.int64), threads)
    return _counts(trace, layout, files), tuple(_warnings(files))


def read_events(
    trace: CtfTrace,
    names: Collection[str] | None = None,
    *,
    nameless: Collection[str] = (),
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

    Events that cannot be read end their packet; the result's ``warnings`` say which and why.
    ``progress`` gets the share that is done, from 0 to 1.
    Raises `CtfError` where a file is gone or changes while it is read.
    """
    asked = trace.event_names if names is None else names
    layout = lay_out(trace.folders, {name: name not in nameless for name in asked})
    rows = {event.stream for event in layout.events if event.row[tb.E_COUNTER] >= 0}
    used = [s for s in trace.streams if not rows.isdisjoint(s.table[:, tb.P_STREAM].tolist())]
    borders = _span_borders(used, layout, threads or _cores())
    files = _walked(used, layout, borders, threads, lambda share: progress(share / 3))
    columns = [
        _Columns(layout, number, table, sum(int(file.reached[-1][number]) for file in files))
        for number, table in enumerate(layout.tables)
    ]
    texts = _filled(
        files, layout, len(borders) + 1, columns, threads, lambda n: progress((1 + 2 * n) / 3)
    )
    try:
        events = Events(_frames(columns, texts, any(file.unsorted for file in files)))
    except pl.exceptions.PolarsError as error:
        reason = f"events of one name have fields of types that do not fit together: {error}"
        folder = trace.folders[0].path
        raise tsdl.CtfError(folder, None, reason, "read its folders one by one") from None
    events.warnings = tuple(_warnings(files))
    events.counts = _counts(trace, layout, files)
    events.unread = tuple(stream for stream in trace.streams if stream not in used)
    return events


def _cores() -> int:
    return len(os.sched_getaffinity(0))


# Pass 1


class _File:
    """A stream file that is being read, and what pass 1 finds in it.

    ``counts`` per event class; ``marks`` (spans - 1, 3) where each span but the first begins:
    packet, bit position, clock; ``reached`` (spans + 1, counters) the rows before each span and
    before the end; ``unsorted``: time went back.
    """

    def __init__(self, stream: CtfStream) -> None:
        self.path = stream.path
        self.packets = stream.table.copy()
        self.map = MappedFile(stream.path)
        self.counts: NDArray[np.int64] = np.zeros(0, np.int64)
        self.marks = self.reached = np.zeros((0, 0), np.int64)
        self.unsorted = False

    def walk(self, layout: Layout, borders: NDArray[np.int64], lean: bool) -> None:
        """Step over all events, and shorten packets to what can be read; ``lean`` on memory."""
        scratch, packets = Scratch(layout), self.packets
        self.counts = np.zeros(max(len(layout.events), 1), np.int64)
        marks = np.zeros((len(borders) + 1, 3 + len(scratch.rows)), np.int64)
        scratch.state[tb.X_LATEST] = -(1 << 62)
        border = first = 0
        while first < len(packets):
            limit = packets[first, tb.P_BYTE] + _CHUNK_BYTES
            last = max(int(np.searchsorted(packets[:, tb.P_BYTE], limit)), first + 1)
            border = _walk_events(
                scratch.address, scratch.registers.ctypes.data, self.map.address, self.map.size,
                packets.ctypes.data, first, last, self.counts.ctypes.data, borders.ctypes.data,
                border, len(borders), marks.ctypes.data,
            )  # fmt: skip
            if lean:
                self.map.forget(packets[first:last])
            first = last
        marks[border:, 0], marks[border:, 1], marks[border:, 3:] = len(packets), -1, scratch.rows
        self.marks = marks[:-1, :3]
        self.reached = np.vstack([np.zeros_like(scratch.rows), marks[:, 3:]])
        self.unsorted = bool(scratch.state[tb.X_UNSORTED])


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


def _walked(
    streams: Sequence[CtfStream],
    layout: Layout,
    borders: NDArray[np.int64],
    threads: int | None,
    progress: _Progress = lambda _: None,
) -> list[_File]:
    files, done = [_File(stream) for stream in streams], 0
    size = sum(file.map.size for file in files)
    with ThreadPoolExecutor(threads or _cores()) as pool:
        # Read twice, a trace that fits into memory had better stay there in between.
        steps = pool.map(lambda file: file.walk(layout, borders, size > _LARGE_BYTES), files)
        for file, _ in zip(files, steps, strict=True):
            done += file.map.size
            progress(done / max(size, 1))
    return files


def _counts(trace: CtfTrace, layout: Layout, files: list[_File]) -> dict[str, int]:
    counts = dict.fromkeys(trace.event_names, 0)
    for file in files:
        for event, number in zip(layout.events, file.counts.tolist(), strict=False):
            counts[event.name] += number
    return counts


def _span_borders(streams: list[CtfStream], layout: Layout, threads: int) -> NDArray[np.int64]:
    """Instants (ns) that cut the streams into spans of about equal size in bytes."""
    table = np.concatenate(
        [np.zeros((0, tb.PACKET_COLUMNS), np.int64), *(s.table for s in streams)]
    )
    total = int(table[:, tb.P_BYTES].sum())
    spans = max(-(-total // _CHUNK_BYTES), threads) if total > _SMALL_BYTES else 1
    rates = {layout.streams[row][tb.S_FREQUENCY] for row in np.unique(table[:, tb.P_STREAM])}
    if spans <= 1 or rates != {tb.BILLION} or any(s.table[0, tb.P_BEGIN] < 0 for s in streams):
        return np.zeros(0, np.int64)
    table = table[np.argsort(table[:, tb.P_BEGIN], kind="stable")]
    reached = np.cumsum(table[:, tb.P_BYTES])
    places = np.searchsorted(reached, total * np.arange(1, spans) / spans)
    return np.unique(table[np.minimum(places, len(table) - 1), tb.P_BEGIN])


# Pass 2


def _filled(
    files: list[_File],
    layout: Layout,
    spans: int,
    columns: list["_Columns"],
    threads: int | None,
    progress: _Progress,
) -> list[bytes]:
    """Pass 2 over all spans; returns the texts and bytes that slots then have codes of."""
    if not files:
        return []
    packets = np.concatenate([file.packets for file in files])
    codes: dict[bytes, int] = {}
    with ThreadPoolExecutor(threads or _cores()) as pool:
        found = pool.map(lambda span: _fill(span, files, packets, layout), range(spans))
        for span, strings in enumerate(found):
            own = [codes.setdefault(string, len(codes)) for string in strings]
            if own != list(range(len(own))):
                before, after = (sum(f.reached[end] for f in files) for end in (span, span + 1))
                for table in columns:
                    table.recode(before, after, np.array(own, np.uint32))
            progress((span + 1) / spans)
    return list(codes)


def _fill(span: int, files: list[_File], packets: NDArray[np.int64], layout: Layout) -> list[bytes]:
    """Pass 2 over one span of ``packets``, those of all files; the strings of its text slots."""
    table, count = _span_files(span, files), len(files)
    scratch = Scratch(layout, count)
    scratch.rows[:] = sum(file.reached[span] for file in files)
    scratch.caps[:] = sum(file.reached[span + 1] for file in files)
    cursors = np.zeros((count, tb.CURSOR_COLUMNS), np.int64)
    cursors[:, tb.C_PACKET] = table[:, tb.F_PACKET] - 1
    ahead = np.zeros((count * tb.AHEAD, tb.AHEAD_COLUMNS), np.int64)
    leaves = 1 << (count - 1).bit_length()
    tree = np.full((2 * leaves, 2), tb.NEVER, np.int64)
    tree[leaves : leaves + count] = [(-(1 << 63), file) for file in range(count)]
    for node in range(leaves - 1, 0, -1):
        tree[node] = tree[2 * node]
    status = tb.FULL_DICTIONARY
    while status == tb.FULL_DICTIONARY:
        status = _fill_columns(
            scratch.address, table.ctypes.data, cursors.ctypes.data, ahead.ctypes.data,
            tree.ctypes.data, leaves, packets.ctypes.data, scratch.registers.ctypes.data,
            layout.registers, len(layout.events),
        )  # fmt: skip
        if status == tb.FULL_DICTIONARY:
            scratch.grow()
    if status < 0:
        reason = f"{_FAILURES[status]}: the files changed while they were read"
        raise tsdl.CtfError(files[0].path.parent, None, reason, "stop the recording first")
    strings = scratch.strings()
    for file, (first, last) in zip(files, table[:, [tb.F_PACKET, tb.F_LAST_PACKET]], strict=True):
        if first < last:  # this span was the last to read these
            file.map.forget(packets[first:last])
    return strings


def _span_files(span: int, files: list[_File]) -> NDArray[np.int64]:
    table = np.zeros((len(files), tb.FILE_COLUMNS), np.int64)
    first = 0
    for row, file in zip(table, files, strict=True):
        begin, end = (0, -1, 0), (len(file.packets), -1, 0)
        if span:
            begin = file.marks[span - 1]
        if span < len(file.marks):
            end = file.marks[span]
        row[tb.F_BASE], row[tb.F_SIZE] = file.map.address, file.map.size
        row[tb.F_PACKET], row[tb.F_POSITION], row[tb.F_CLOCK] = first + begin[0], *begin[1:]
        row[tb.F_LAST_PACKET], row[tb.F_LAST_POSITION] = first + end[0], end[1]
        first += len(file.packets)
    return table


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

    def recode(
        self, before: NDArray[np.int64], after: NDArray[np.int64], codes: NDArray[np.uint32]
    ) -> None:
        """Replace one span's own codes of strings by those of the whole."""
        span = slice(before[self.number], after[self.number])
        for (_, kind), array in zip(self.table.columns, self.slots, strict=True):
            if not isinstance(kind, tsdl.IntegerType):
                array[span] = codes[array[span]]

    def frame(self, known: list[bytes], strings: pl.Series, categories: pl.Series) -> pl.DataFrame:
        """The table's frame; codes are of what is ``known``, which are ``strings`` as texts."""
        found = {"time": pl.Series("time", self.time)}
        if self.table.has_cpu:
            found["cpu"] = pl.Series("cpu", self.cpu)
        for (name, kind), slot in zip(self.table.columns, self.slots, strict=True):
            if tsdl.is_text(kind):
                texts = categories if name == "procname" else strings
                found[name] = texts.gather(pl.Series(slot)).alias(name)
            elif isinstance(kind, tsdl.ArrayType):
                codes, places = np.unique(slot, return_inverse=True)
                lists = [list(known[code]) for code in codes]
                found[name] = pl.Series(name, lists, pl.List(pl.UInt8)).gather(places)
            else:
                found[name] = pl.Series(name, slot)
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


def _frames(columns: list[_Columns], known: list[bytes], unsorted: bool) -> dict[str, pl.DataFrame]:
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
        if unsorted or len(parts[name]) > 1:
            frame = frame.sort("time", maintain_order=True)
        frames[name] = frame.with_columns(pl.col("time").set_sorted())
    return frames
