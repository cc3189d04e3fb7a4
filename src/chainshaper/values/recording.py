"""A recording on disk: a folder with a Parquet file for each event table and a `recording.json`.

`recording.json` has the conditions of the run, what was lost, and a checksum of every other file.
"""

import io
import json
import os
import platform
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import polars as pl
from pydantic import BaseModel, Field

from chainshaper.values.errors import InputError, OperationError, shown, storable
from chainshaper.values.events import (
    EventTables,
    as_table,
    column_problems,
    first_and_last_start,
    happened,
)
from chainshaper.values.files import (
    folder_beside,
    free_place,
    open_output,
    open_to_all,
    rename_output,
    write_whole,
)
from chainshaper.values.hosts import HostInfo
from chainshaper.values.notebook import notebook_html
from chainshaper.values.parquet import PackedColumns, is_packable, packed
from chainshaper.values.yaml_file import wrong_values_refused

INFO_FILE = "recording.json"
FORMAT = 1
MOST_ROWS = 1_000_000
MOST_ROWS_PER_BYTE = 16
"""A file may have MOST_ROWS, and so many for each of its bytes.

Real events take more room: even those as regular as a clock take four bytes each.
"""
_OR_AGAIN = ", or record the run again"
Integer: TypeAlias = Annotated[int, Field(ge=-(1 << 63), lt=1 << 63)]


class ThreadInfo(BaseModel, frozen=True):
    """A thread as the kernel reported it while the application ran (not as it was asked for)."""

    tid: Integer
    pid: Integer
    comm: str
    node: str
    role: str  # executor, dds, publisher, loop, stall-meter, unknown
    policy: str  # SCHED_FIFO, SCHED_OTHER, ...
    priority: Integer
    cores: tuple[Integer, ...]


class EndpointInfo(BaseModel, frozen=True):
    """A publisher or subscription with its QoS, in the words of `ros2 topic info -v`, lower case.

    What neither DDS discovery nor the trace shows is None. Durations are ns, None: no limit.
    """

    node: str
    topic: str
    kind: Literal["publisher", "subscription"]
    type: str | None = None  # std_msgs/msg/Header
    reliability: str | None = None
    durability: str | None = None
    history: str | None = None
    depth: Integer | None = None
    deadline_ns: Integer | None = None
    lifespan_ns: Integer | None = None
    liveliness: str | None = None
    liveliness_lease_ns: Integer | None = None


class StallMeterInfo(BaseModel, frozen=True):
    """How the machine was watched for stalls, by a sleeper on each core."""

    cores: tuple[Integer, ...]
    period_ns: Integer  # between two wake-ups
    threshold_ns: Integer  # a wake-up that is later than this is a stall
    wakeups: Integer  # of all sleepers
    median_lateness_ns: tuple[Integer, ...]  # of ordinary wake-ups, on each core
    realtime: bool  # False: a stall may be ordinary scheduling


class InForceInfo(BaseModel, frozen=True):
    """When the plan was in force, from its first whole cycle (ns of CLOCK_MONOTONIC)."""

    since_ns: int
    until_ns: int | None = None  # None: to the end


class RecordingInfo(BaseModel, frozen=True):
    """The facts of a recording that are not events."""

    format: Integer = FORMAT
    source: str  # live, simulated, lttng, preload, ebpf
    host: str = Field(default_factory=platform.node)
    kernel: str = Field(default_factory=platform.release)
    hosts: tuple[HostInfo, ...] = ()  # of a joint recording, the reference first; (): one host
    boot: str | None = None  # the host's boot id; None: not known
    distribution: str | None = None  # of ROS 2
    rmw: str | None = None
    clock_offset_ns: Integer  # added to the time of an event, it is CLOCK_REALTIME
    command: tuple[str, ...] = ()
    processes: dict[Integer, str] = {}  # pid → the node or command it runs
    # Inode of the namespace in which processes and threads have their ids; None: each has the id
    # of its own namespace.
    pid_namespace: Integer | None = None
    threads: tuple[ThreadInfo, ...] = ()
    endpoints: tuple[EndpointInfo, ...] = ()
    realtime: bool | None = None  # SCHED_FIFO for all threads that were to have it; None: unknown
    notes: tuple[str, ...] = ()
    worst_ns: tuple[Integer, ...] = ()  # starts of cycles for which a flight recorder has saved it
    lost: dict[str, Integer] = {}  # how many events are known to be missing, by reason
    trace_events: dict[str, Integer] = {}  # how many the converted trace had, by event
    stall_meter: StallMeterInfo | None = None
    chain: str | None = None  # the chain the application's description names first
    # What the user declared of topics (values/handed_over.py): input and output.
    through: tuple[tuple[str, str], ...] = ()
    application: dict[str, Any] | None = None  # the description that ran, when we ran it
    plan: dict[str, Any] | None = None  # the plan in force, when one was
    in_force: InForceInfo | None = None  # None: no plan was in force, or an old version recorded
    # Of runs that were joined: the times between them (from, until), in which nothing ran.
    pauses_ns: tuple[tuple[Integer, Integer], ...] = ()
    # File → its CRC-32, as `crc32:89abcdef`; None: an old version recorded, without checksums.
    checksums: dict[str, str] | None = None


@dataclass(frozen=True)
class Recording:
    """An open recording or trace."""

    path: Path
    info: RecordingInfo
    events: EventTables = field(repr=False)  # each is read at its first use

    def __repr__(self) -> str:
        info = self.info
        about = [f"{info.source} on {info.host}"]
        about += [f"ROS 2 {info.distribution}"] if info.distribution else []
        about += [f"chain {info.chain}"] if info.chain else []
        about += ["a plan was in force"] if info.plan is not None else []
        about += [lost_text(info.lost)] if any(info.lost.values()) else []
        return shown(f"Recording({self.path}: {', '.join(about)})")

    _repr_html_ = notebook_html


class _TablesOnDisk(Mapping[str, pl.DataFrame]):
    """The tables in a folder: each is a file or, if it has several parts, a folder of files."""

    def __init__(self, path: Path, checksums: Mapping[str, str]) -> None:
        self._path, self._checksums = path, checksums
        self._read: dict[str, pl.DataFrame] = {}
        self._files = {
            file.stem: sorted(file.glob("*.parquet")) if file.is_dir() else [file]
            for file in sorted(path.glob("*.parquet"))
        }
        known = {str(file.relative_to(path)) for files in self._files.values() for file in files}
        if missing := sorted(checksums.keys() - known):
            reason = f"no such file, but {INFO_FILE} names it"
            raise InputError(f"{path / missing[0]}: {reason}: copy the recording whole{_OR_AGAIN}")
        for name, file in ((name, file) for name, files in self._files.items() for file in files):
            with _readable(file), file.open("rb") as stream:
                problems = column_problems(pl.read_parquet_schema(stream), name)
            if problems:
                raise InputError(f"{file}: {'; '.join(problems)}; record the run again")

    def __getitem__(self, name: str) -> pl.DataFrame:
        if name not in self._read:
            files = self._files[name]
            with _readable(files[0].parent if len(files) > 1 else files[0]) as file:
                parts: list[Any] = [io.BytesIO(self._content(part)) for part in files]
                lazy = pl.scan_parquet(parts, glob=False)
                rows = lazy.select(pl.len()).collect().item()
                size = sum(part.getbuffer().nbytes for part in parts)
                if rows > MOST_ROWS + MOST_ROWS_PER_BYTE * size:
                    many = f"{rows} rows in {size} bytes are more than any run has"
                    raise InputError(f"{file}: {many}; record the run again")
                table = as_table(lazy.collect(), name)
            self._read[name] = table.sort("time", maintain_order=True)
        return self._read[name]

    def _content(self, file: Path) -> bytes:
        """Read a file. Raises InputError: its checksum is not that of what was written."""
        content = file.read_bytes()
        expected = self._checksums.get(str(file.relative_to(self._path)))
        if expected is not None and expected != (checksum := _checksum(content)):
            damage = f"damaged: its checksum is {checksum}, {INFO_FILE} says {expected}"
            raise InputError(f"{file}: {damage}; copy the recording again{_OR_AGAIN}")
        return content

    def __iter__(self) -> Iterator[str]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


@contextmanager
def _readable(file: Path) -> Iterator[Path]:
    """Turn all errors of reading a table's file into an InputError."""
    try:
        yield file
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
        reason = f"not a readable event table ({' '.join(str(error).split())})"
        raise InputError(f"{file}: {reason}; record the run again") from error


def _checksum(*parts: bytes | memoryview) -> str:
    checksum = 0
    for part in parts:
        checksum = zlib.crc32(part, checksum)
    return f"crc32:{checksum:08x}"


def event_counts(recording: Recording) -> pl.DataFrame:
    """Count the events of a recording.

    Columns, ordered by event:
        event: its name. Those of a trace begin with the provider (``ros2:callback_start``), and
            include events that have no table.
        count: how often it happened.
    """
    counts = getattr(recording.events, "counts", recording.info.trace_events)
    if not counts:
        counts = {name: frame.height for name, frame in recording.events.items()}
    rows = sorted((name, count) for name, count in counts.items() if count)
    return pl.DataFrame(rows, schema={"event": pl.String, "count": pl.Int64}, orient="row")


def lost_text(lost: Mapping[str, int]) -> str:
    """Say what was lost while recording, by reason, or that it was nothing."""
    reasons = [f"{count} {reason.replace('_', ' ')}" for reason, count in lost.items() if count]
    return f"lost while recording: {', '.join(reasons) or 'nothing'}"


def open_recording(path: str | Path) -> Recording:
    """Open a recording folder.

    Raises InputError: no such folder, no or an unreadable `recording.json`, a newer format, a table
    that is missing or has not the columns of its event.
    """
    path = Path(path)
    file = path / INFO_FILE
    if not file.is_file():
        problem, output = "no such folder", path
        if path.is_dir():
            problem = "a folder without recording.json"
        elif path.is_file():
            problem, output = "a file, where the folder of a recording is wanted", Path("REC")
        made = f"a recording is made with `chainshaper run APP.yaml -o {output}`, a trace, which is"
        raise InputError(f"{path}: {problem}; {made} accepted as well, with `ros2 trace`")
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{file}: not readable as JSON ({error}); record the run again") from error
    # The format first: this version cannot know what else a newer one holds.
    format_ = values.get("format", FORMAT) if isinstance(values, dict) else FORMAT
    if format_ != FORMAT:
        reason = f"format {format_}, this chainshaper reads format {FORMAT}"
        raise InputError(f"{file}: {reason}; update it")
    with wrong_values_refused(RecordingInfo, f"{file}: not a recording's description: "):
        info = RecordingInfo.model_validate_json(json.dumps(values), strict=True)
    return Recording(path, info, _TablesOnDisk(path, info.checksums or {}))


def refuse_existing(path: str | Path) -> Path:
    """Return the path if a new folder can be written there. Raises InputError: it cannot."""
    path = Path(path)
    free_place(path, path.exists() and not (path.is_dir() and not any(path.iterdir())))
    if os.path.ismount(path) or (path.exists() and path.samefile(".")):
        raise InputError(f"{path} cannot be replaced by a new folder: name one inside it")
    parent = path.absolute().parent
    if not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(f"{parent}: no permission to write {path.name} into it: name another")
    return path


def write_recording(
    path: str | Path, tables: EventTables | Iterable[EventTables], info: RecordingInfo
) -> Recording:
    """Write a recording, whole or not at all, and open it.

    ``tables`` may come in parts, one after the other in time, for a recording that is larger than
    memory; a table with several parts becomes a folder of files. Raises InputError: ``path`` exists
    already. OperationError: it cannot be written.
    """
    path = refuse_existing(path)
    try:
        with folder_beside(path) as made:
            partial = Path(made)
            checksums = _write_parts(partial, [tables] if isinstance(tables, Mapping) else tables)
            info = info.model_copy(update={"checksums": checksums})
            values = storable(info.model_dump(mode="json"))
            text = json.dumps(values, indent=2, ensure_ascii=False) + "\n"
            write_whole(partial / INFO_FILE, [text.encode()])
            open_to_all(partial)
            rename_output(partial, path)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise OperationError(f"{path}: the recording cannot be written: {error}") from error
    return open_recording(path)


def join_runs(runs: Sequence[Recording], output: str | Path) -> Recording:
    """Write the recordings of runs of an application, one behind the other, as one recording.

    The chains go on through them, as through nodes that were started again. Where a plan was in
    force, only what happened then is in it. Raises: as :func:`write_recording`.
    """
    *_, last = (run.info for run in runs)
    tables = [
        dict(run.events)
        if run.info.in_force is None
        else happened(run.events, run.info.in_force.since_ns, run.info.in_force.until_ns)
        for run in runs
    ]
    spans = [first_and_last_start(events) for events in tables]
    pauses = tuple((ended, begun) for (_, ended), (begun, _) in pairwise(spans))
    meters = [run.info.stall_meter for run in runs if run.info.stall_meter is not None]
    lost = Counter[str]()
    for run in runs:
        lost.update(run.info.lost)
    realtime, stall_meter = None, None
    if all(run.info.realtime is not None for run in runs):
        realtime = all(run.info.realtime for run in runs)
    if len(meters) == len(runs):
        wakeups = sum(meter.wakeups for meter in meters)
        stall_meter = meters[-1].model_copy(update={"wakeups": wakeups})
    joined = {
        "processes": {pid: name for run in runs for pid, name in run.info.processes.items()},
        "threads": tuple(thread for run in runs for thread in run.info.threads),
        "endpoints": tuple(endpoint for run in runs for endpoint in run.info.endpoints),
        "notes": tuple(dict.fromkeys(note for run in runs for note in run.info.notes)),
        "realtime": realtime,
        "lost": dict(lost),
        "stall_meter": stall_meter,
        "in_force": None,  # throughout, if at all
        "pauses_ns": pauses,
        "checksums": None,
    }
    return write_recording(output, tables, last.model_copy(update=joined))


def _write_parts(folder: Path, parts: Iterable[EventTables]) -> dict[str, str]:
    """Write the tables of all parts; return the files' checksums, by their names in the folder.

    Threads write the tables of a part while the next part is made, so that a recording takes the
    time of making it or of writing it, whichever is longer. No more than two parts are in memory.
    """
    count = Counter[str]()
    writing: dict[Path, Future[str]] = {}
    checksums: dict[Path, str] = {}
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as threads:
        for part in parts:
            checksums |= {file: future.result() for file, future in writing.items()}
            writing = {}
            columns = PackedColumns()
            for name, frame in part.items():
                file = _next_file(folder / f"{name}.parquet", count[name], checksums)
                count[name] += 1
                writing[file] = threads.submit(_write_table, file, frame, columns)
        checksums |= {file: future.result() for file, future in writing.items()}
    return {str(file.relative_to(folder)): checksum for file, checksum in checksums.items()}


def _next_file(file: Path, before: int, checksums: dict[Path, str]) -> Path:
    """Return the file for the next part of a table, ``before`` parts of which are written.

    A table of a single part is a file; when the second comes, a folder of files takes its place.
    """
    if before == 1:
        first = file.rename(file.with_suffix(".first"))
        file.mkdir()
        checksums[first.rename(file / "000000.parquet")] = checksums.pop(file)
    return file / f"{before:06}.parquet" if before else file


def _write_table(file: Path, frame: pl.DataFrame, columns: PackedColumns) -> str:
    """Write a file; return its checksum. Tables of one part have ``columns`` in common."""
    parts = packed(frame, columns) if is_packable(frame) else [_written_by_polars(frame)]
    with os.fdopen(open_output(file), "wb") as stream:
        stream.writelines(parts)
        stream.flush()
        os.fsync(stream.fileno())
    return _checksum(*parts)


def _written_by_polars(frame: pl.DataFrame) -> memoryview:
    content = io.BytesIO()  # Polars would report a full disk as a wrong file
    frame.write_parquet(content, compression="zstd", compression_level=1, statistics=False)
    return content.getbuffer()


State: TypeAlias = Literal["good", "limited", "absent"]


@dataclass(frozen=True)
class Check:
    """An ability of the machine."""

    name: str
    state: State
    found: str  # what there is, in words
    needed_for: str  # what does not work without it
    remedy: str = ""  # what would bring it


@dataclass(frozen=True)
class MachineReport:
    """The checks of a machine, and the stalls that were seen on its cores."""

    checks: tuple[Check, ...]
    stalls: pl.DataFrame  # table `machine_stall`
    stall_meter: StallMeterInfo
    watched_ns: int  # how long the cores were watched
