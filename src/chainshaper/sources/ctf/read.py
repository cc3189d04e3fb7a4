"""Count events, and read them into data frames.

Pass 1 (`_File.count`) steps over every event of a file and counts, so that the row of each event is
known. Pass 2 (`_write_events`) writes the wanted events, chunk by chunk of the files, to their
rows; then each table is sorted by time. Both passes are C++ (core/ctf), and run on several threads.
Of a large trace only some chunks are in memory at once.
"""

import mmap
import os
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper import _core
from chainshaper.sources.ctf import tsdl
from chainshaper.sources.ctf.copies import CtfStream
from chainshaper.sources.ctf.layout import Table, lay_out, select
from chainshaper.sources.ctf.trace import CtfTrace, MappedFile
from chainshaper.values.progress import ShareDone

_CHUNK_BYTES, _SMALLEST_CHUNK_BYTES = 32 << 20, 4 << 20
_LARGE_BYTES = 512 << 20
"""A trace of more bytes is not left in memory between the two passes."""
_HUGE_PAGE = 2 << 20
_LARGE_COLUMN = 4 * _HUGE_PAGE
_PAGE = 4096
_APART = 320
"""Columns side by side must not begin alike in their pages, or they would compete for the same few
lines of the processor's cache: each begins so many bytes further than the one before it."""
_MOST_WARNINGS = 20
"""Damaged packets that are named, of each file; of more only the number is."""
_FAILURES = {
    _core.CtfFailure.OTHER_TIME: "an event outside the time that its packet says it was open",
    _core.CtfFailure.NO_PROCESS: "an event of process or thread 0: there are zeros instead of what"
    " was recorded",
    _core.CtfFailure.ALL_ZEROS: "zeros instead of events",
    _core.CtfFailure.TRUNCATED: "an event reaches past the end of its packet's content",
    _core.CtfFailure.NO_OPTION: "a variant's tag names none of its options",
    _core.CtfFailure.BAD_LENGTH: "an array or sequence is longer than the rest of its packet",
    _core.CtfFailure.UNTERMINATED: "a string does not end within its packet",
    _core.CtfFailure.UNKNOWN_EVENT: "an event id that the metadata does not declare: perhaps it"
    " ends too early",
    _core.CtfFailure.OVER_BUDGET: "its fields, most of them of no bits, would take far more memory"
    f" than its size warrants ({_core.CTF_BUDGET_PER_BYTE} times)",
}


class Events(dict[str, pl.DataFrame]):
    """Frames by event name."""

    warnings: tuple[str, ...] = ()  # what cannot be read
    damaged: int = 0  # packets with events that cannot be read
    counts: dict[str, int]  # of all events in the streams that were read, zeros included


def count_events(
    trace: CtfTrace, threads: int | None = None
) -> tuple[dict[str, int], tuple[str, ...]]:
    """Count events per name, ordered by name, zeros included; and say what cannot be read.

    Raises `CtfError` where a file is gone.
    """
    events = read_events(trace, (), threads=threads, counted=True)
    return events.counts, events.warnings


def read_events(
    trace: CtfTrace,
    names: Collection[str] | None = None,
    *,
    nameless: Collection[str] = (),
    counted: bool = False,
    threads: int | None = None,
    progress: ShareDone = lambda _: None,
) -> Events:
    """Read events into one frame per name, ordered by name of event.

    Every name of ``names`` (None: all) that the metadata declares is in the result, without
    rows where it never happened. Rows are sorted by ``time``; equal times stand in the order
    of the stream files, and in one file as recorded. Columns:

    * ``time``: Int64, ns of the trace's clock (CLOCK_MONOTONIC for LTTng), its offset not added
    * ``cpu``: Int32, the core; null where the trace does not say it
    * ``pid``, ``tid``: integers as recorded; null where the trace has none
    * ``procname``: Categorical, where recorded; not for the events in ``nameless``, since reading
      it is most of the work for an event without other texts
    * the fields of the event, under their names without LTTng's leading underscore; a field called
      like one of the above is ``payload.<name>``. Integers keep their width and sign, enumerations
      their integer; strings and text arrays are String (bytes that are not UTF-8 as ``\\xNN``),
      arrays and sequences of bytes List of UInt8. Fields of other types are passed over.

    An event that cannot be read ends its packet; the result's ``warnings`` say which and why.
    With ``counted``, ``counts`` are of all streams; else streams that cannot have an event of
    ``names`` are not read, and their events count as none. ``progress`` gets the share that is
    done, from 0 to 1.
    Raises `CtfError` where a file is gone or changes while it is read.
    """
    read = trace.event_names if names is None else names
    wanted = select(trace.folders, {name: name not in nameless for name in read})
    layout = lay_out(trace.folders, trace.described, wanted.events)
    used = [
        stream
        for stream in trace.streams
        if counted or not wanted.stream_classes.isdisjoint(stream.packets["stream_class"])
    ]
    files = [_File(stream, layout) for stream in used]
    workers = threads or len(os.sched_getaffinity(0))
    size = sum(file.map.size for file in files)
    chunk = min(_CHUNK_BYTES, max(_SMALLEST_CHUNK_BYTES, size // workers))
    with ThreadPoolExecutor(workers) as pool:
        # Files are read twice: a trace that fits into memory had better stay there in between.
        counted_files = pool.map(lambda file: file.count(chunk, size > _LARGE_BYTES), files)
        for done, _ in enumerate(counted_files, 1):
            progress(done / len(files) / 3)
        rows = [np.zeros(len(wanted.tables), np.int64), *(file.rows for file in files)]
        first_rows = np.cumsum(rows, axis=0)
        columns = [
            _TableColumns(number, table, int(first_rows[-1][number]) if files else 0)
            for number, table in enumerate(wanted.tables)
        ]
        texts = _write_events(pool, files, first_rows, columns, progress)
        parts = _parts(pool, columns, texts)
    try:
        events = Events(_frames(parts))
    except pl.exceptions.PolarsError as error:
        reason = f"events of one name have fields of types that do not fit together: {error}"
        folder = trace.folders[0].path
        raise tsdl.CtfError(folder, None, reason, "read its folders one by one") from None
    events.warnings = tuple(_warnings(files))
    events.damaged = sum(len(file.reader.bad_events) for file in files)
    events.counts = dict.fromkeys(trace.event_names, 0)
    classes = [stream for folder in trace.folders for stream in folder.streams.values()]
    declared = [event.name for stream in classes for event in stream.events.values()]
    for file in files:
        for name, number in zip(declared, file.reader.counts.tolist(), strict=True):
            events.counts[name] += number
    return events


# Pass 1


class _File:
    """A stream file that is being read.

    ``chunks`` are the parts in which it is read; ``rows`` says how many rows of each table it
    gives. Both are known after :meth:`count`.
    """

    def __init__(self, stream: CtfStream, layout: _core.CtfLayout) -> None:
        self.path, self.packets = stream.path, stream.packets
        self.map = MappedFile(stream.path)
        names = ("offset", "content_bits", "stream_class", "cpu", "earliest", "latest")
        columns = {name: self.packets[name].to_numpy() for name in names}
        try:
            self.reader = _core.CtfEventReader(layout, self.map.bytes, **columns)
        except ValueError:  # a packet reaches over the file's end
            raise _changed(self.path) from None
        self.rows: NDArray[np.int64] = np.zeros(0, np.int64)
        self.chunks: list[_core.CtfChunk] = []

    def count(self, chunk_bytes: int, lean: bool) -> None:
        """Count all events, and shorten packets to what can be read of them.

        ``lean``: let go of the file's pages after each chunk.
        """
        offsets = self.packets["offset"].to_numpy()
        first = 0
        while first < len(offsets):
            end = max(int(np.searchsorted(offsets, offsets[first] + chunk_bytes)), first + 1)
            self.chunks.append(self.reader.count(end))
            if lean:
                self.map.forget(self.packets[first:end])
            first = end
        self.rows = self.reader.rows

    def write(
        self, chunk: _core.CtfChunk, tables: list[_core.CtfTable], first_rows: NDArray[np.int64]
    ) -> list[bytes]:
        """Write a chunk's events to their tables; return the texts, in the order of their codes."""
        try:
            texts = self.reader.write(chunk, tables, first_rows)
        except _core.CtfFileChangedError:
            raise _changed(self.path) from None
        self.map.forget(self.packets[chunk.first : chunk.end])
        return texts


def _changed(path: Path) -> tsdl.CtfError:
    reason = "it has not the events that were counted: it changed while it was read"
    return tsdl.CtfError(path, None, reason, "stop the recording first")


def _warnings(files: Sequence[_File]) -> Iterator[str]:
    """Say what cannot be read, packet by packet, up to :data:`_MOST_WARNINGS` of each file."""
    for file in files:
        bad_events = file.reader.bad_events
        for event in bad_events[:_MOST_WARNINGS]:
            reason = _FAILURES[event.failure]
            yield str(
                tsdl.CtfError(
                    file.path, event.offset, reason, "the rest of this packet is not read"
                )
            )
        if len(bad_events) > _MOST_WARNINGS:
            yield f"{file.path}: {len(bad_events) - _MOST_WARNINGS} more packets are like that"


# Pass 2


def _write_events(
    pool: ThreadPoolExecutor,
    files: list[_File],
    first_rows: NDArray[np.int64],
    columns: list["_TableColumns"],
    progress: ShareDone,
) -> list[bytes]:
    """Write the events of all chunks to the tables (pass 2).

    ``first_rows``: for each file and each table, the row at which the file's events begin.
    Returns the texts, and arrays of bytes, in the order of their codes in text columns.
    """
    tables = [table.arrays() for table in columns]
    chunks = [
        (file, first, chunk)
        for file, first in zip(files, first_rows, strict=False)
        for chunk in file.chunks
        if (chunk.rows_after > chunk.rows_before).any()
    ]
    codes: dict[bytes, int] = {}
    written = pool.map(lambda part: part[0].write(part[2], tables, part[1]), chunks)
    for done, ((_, first, chunk), texts) in enumerate(zip(chunks, written, strict=True), 1):
        # Each chunk has codes of its own, from 0; these are the codes in the whole trace.
        common_codes = [codes.setdefault(text, len(codes)) for text in texts]
        if common_codes != list(range(len(common_codes))):
            for table in columns:
                before, after = first + chunk.rows_before, first + chunk.rows_after
                rows = slice(before[table.number], after[table.number])
                table.recode(rows, np.array(common_codes, np.uint32))
        progress((1 + 2 * done / len(chunks)) / 3)
    # So far rows stand file by file, each in order of time unless a clock went back.
    list(pool.map(_core.CtfTable.sort_by_time, tables))
    return list(codes)


# Columns


class _TableColumns:
    """The arrays that the decoder writes a table of events to.

    * ``time``: when each event happened (ns), int64.
    * ``cpu``: on which core, int32; empty where the trace does not say.
    * ``values``: an array for each column of the table, of the column's type; codes for texts.

    Each has ``rows`` entries. Large arrays have memory of their own, so that a frame that is made
    of some of them keeps no others. The small ones of a table are parts of one piece of memory,
    large enough for huge pages: page faults would else be a third of all work.
    """

    def __init__(self, number: int, table: Table, rows: int) -> None:
        self.number, self.table, self.rows = number, table, rows
        wanted: list[tuple[int, np.dtype[Any]]] = [(rows, np.dtype("i8"))]
        wanted += [(rows * table.has_cpu, np.dtype("i4"))]
        wanted += [(rows, kind) for kind in table.column_types()]
        sizes = [-(-count * kind.itemsize // _PAGE) * _PAGE + _APART for count, kind in wanted]
        shared = _memory(sum(size for size in sizes if size < _LARGE_COLUMN))
        arrays = []
        for place, (size, (count, kind)) in enumerate(zip(sizes, wanted, strict=True)):
            if size < _LARGE_COLUMN:
                memory, shared = shared[:size], shared[size:]
            else:
                memory = _returned_memory(place * _APART + size)[place * _APART :]
            arrays.append(memory[: count * kind.itemsize].view(kind))
        self.time, self.cpu, *self.values = arrays

    def arrays(self) -> _core.CtfTable:
        """The arrays for the decoder to write to."""
        cpus = self.cpu if self.table.has_cpu else None
        return _core.CtfTable(times_ns=self.time, cpus=cpus, columns=self.values)

    def recode(self, rows: slice, codes: NDArray[np.uint32]) -> None:
        """Replace a chunk's codes of texts by those in the whole trace: ``codes[old]`` is new."""
        for (_, kind), array in zip(self.table.columns, self.values, strict=True):
            if not isinstance(kind, tsdl.IntegerType):
                _core.recode(array[rows], codes)

    def frame(self, texts: list[bytes], strings: pl.Series, categories: pl.Series) -> pl.DataFrame:
        """Make the table's frame.

        Codes are positions in ``texts``, which are also given as ``strings`` and ``categories``.
        """
        columns = {"time": pl.Series("time", self.time)}
        if self.table.has_cpu:
            columns["cpu"] = pl.Series("cpu", self.cpu)
        for (name, kind), values in zip(self.table.columns, self.values, strict=True):
            if tsdl.is_text(kind):
                shown = categories if name == "procname" else strings
                columns[name] = shown.gather(pl.Series(values)).alias(name)
            elif isinstance(kind, tsdl.ArrayType):
                codes, places = np.unique(values, return_inverse=True)
                lists = [list(texts[code]) for code in codes]
                columns[name] = pl.Series(name, lists, pl.List(pl.UInt8)).gather(places)
            else:
                columns[name] = pl.Series(name, values)
        for name in ("cpu", "pid", "tid"):
            if name not in columns:
                columns[name] = pl.Series(name, [None], pl.Int32).new_from_index(0, self.rows)
        leading = [n for n in ("time", "cpu", "pid", "tid", "procname") if n in columns]
        return pl.DataFrame([columns[n] for n in dict.fromkeys([*leading, *columns])])


def _memory(size: int) -> NDArray[np.uint8]:
    """Return bytes of any content; many of them begin at a huge page, which NumPy asks for."""
    if size < 2 * _HUGE_PAGE:
        return np.empty(size, np.uint8)
    memory = np.empty((size // _HUGE_PAGE + 2) * _HUGE_PAGE, np.uint8)
    first = -memory.ctypes.data % _HUGE_PAGE
    return memory[first : first + size]


def _returned_memory(size: int) -> NDArray[np.uint8]:
    """Zeros in huge pages, which the system gets back with the last array that has a part of them.

    NumPy's memory is `malloc`'s, which keeps what it has once let go.
    """
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with suppress(OSError):  # a kernel without huge pages
        memory.madvise(mmap.MADV_HUGEPAGE)
    return np.frombuffer(memory, np.uint8)


def _parts(
    pool: ThreadPoolExecutor, columns: list[_TableColumns], known: list[bytes]
) -> dict[str, list[pl.DataFrame]]:
    """Event → the frames of its tables; codes of texts are of what is ``known``."""
    texts = [text.decode(errors="backslashreplace") for text in known]
    strings = pl.Series("", texts or [""], dtype=pl.String)
    categories = strings.cast(pl.Categorical)
    parts: dict[str, list[pl.DataFrame]] = {}
    frames = pool.map(lambda table: table.frame(known, strings, categories), columns)
    for table, frame in zip(columns, frames, strict=True):
        parts.setdefault(table.table.name, []).append(frame)
    return parts


def _frames(parts: dict[str, list[pl.DataFrame]]) -> dict[str, pl.DataFrame]:
    """One frame for each event, ordered by name."""
    frames: dict[str, pl.DataFrame] = {}
    for name in sorted(parts):
        frame = pl.concat(parts[name], how="diagonal_relaxed", rechunk=True)
        if len(parts[name]) > 1:
            frame = frame.sort("time", maintain_order=True)
        frames[name] = frame.with_columns(pl.col("time").set_sorted())
    return frames
