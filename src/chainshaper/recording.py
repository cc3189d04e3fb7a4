"""A recording on disk: a folder with one Parquet file per event table and a `recording.json`.

The folder is written beside its final place and renamed when it is complete, so a recording
that exists is whole. `recording.json` says under which conditions the events were taken, and
what was lost on the way: figures computed from a recording are only as good as these facts.
"""

import io
import json
import os
import platform
import shutil
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import polars as pl
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from chainshaper.errors import InputError, OperationError
from chainshaper.events import EventTables
from chainshaper.yaml_file import explanations, key_text

__all__ = [
    "EndpointInfo",
    "Recording",
    "RecordingInfo",
    "StallMeterInfo",
    "ThreadInfo",
    "open_recording",
    "refuse_existing",
    "write_recording",
]

INFO_FILE = "recording.json"
FORMAT = 1


class ThreadInfo(BaseModel):
    """One thread as the kernel reported it while the application ran (not as it was asked for)."""

    model_config = ConfigDict(frozen=True)

    tid: int
    pid: int
    comm: str
    node: str
    role: str  # executor, dds, publisher, stall-meter, unknown
    policy: str  # SCHED_FIFO, SCHED_OTHER, ...
    priority: int
    cores: tuple[int, ...]


class EndpointInfo(BaseModel):
    """A publisher or subscription with its QoS, as DDS discovery and the trace show them.

    What neither tells is None: without ROS 2 at hand only the trace does, and not every RMW tells
    others about its history. Durations are ns, None also where there is no limit. QoS words are
    those of `ros2 topic info -v` in lower case.
    """

    model_config = ConfigDict(frozen=True)

    node: str
    topic: str
    kind: Literal["publisher", "subscription"]
    type: str | None = None  # std_msgs/msg/Header
    reliability: str | None = None
    durability: str | None = None
    history: str | None = None
    depth: int | None = None
    deadline_ns: int | None = None
    lifespan_ns: int | None = None
    liveliness: str | None = None
    liveliness_lease_ns: int | None = None


class StallMeterInfo(BaseModel):
    """How the machine was watched: a sleeper on every core of ``cores`` (ns throughout).

    Stalls shorter than ``threshold_ns`` are not recorded. ``median_lateness_ns`` is what an
    ordinary wake-up took on each core; ``realtime`` is false when the sleeper itself could be
    pre-empted, so that its stalls may be ordinary scheduling.
    """

    model_config = ConfigDict(frozen=True)

    cores: tuple[int, ...]
    period_ns: int
    threshold_ns: int
    wakeups: int
    median_lateness_ns: tuple[int, ...]
    realtime: bool


class RecordingInfo(BaseModel):
    """The facts of a recording that are not events. Times are ns of CLOCK_MONOTONIC.

    ``clock_offset_ns`` is what to add to event times for CLOCK_REALTIME. ``lost`` counts events
    that are known to be missing, by reason. ``realtime`` says whether SCHED_FIFO was in force
    for every thread it was asked for, ``notes`` what a reader of the figures must know.
    ``trace_events`` are the events, by their full names, of the trace that it was converted from,
    those included that no table keeps.
    """

    model_config = ConfigDict(frozen=True)

    format: int = FORMAT
    source: str  # live, simulated, lttng, ebpf
    host: str = Field(default_factory=platform.node)
    kernel: str = Field(default_factory=platform.release)
    distribution: str | None = None  # of ROS 2
    rmw: str | None = None
    clock_offset_ns: int
    command: tuple[str, ...] = ()
    processes: dict[int, str] = {}  # pid → the node or command it runs
    threads: tuple[ThreadInfo, ...] = ()
    endpoints: tuple[EndpointInfo, ...] = ()
    realtime: bool | None = None  # None: unknown
    notes: tuple[str, ...] = ()
    lost: dict[str, int] = {}
    trace_events: dict[str, int] = {}
    stall_meter: StallMeterInfo | None = None
    chain: str | None = None  # the chain the application's description names first
    application: dict[str, Any] | None = None  # the description that ran, when we ran it
    plan: dict[str, Any] | None = None  # the plan in force, when one was


@dataclass(frozen=True)
class Recording:
    """An open recording: ``info`` and the event tables, read from disk when first asked for.

    ``events`` behaves like a dictionary of frames, so every analysis function takes it as it is.
    A trace that another tracer wrote is opened as a recording too
    (:func:`chainshaper.sources.open_source`): what follows does not care.
    """

    path: Path
    info: RecordingInfo
    events: EventTables = field(repr=False)


class _TablesOnDisk(Mapping[str, pl.DataFrame]):
    def __init__(self, path: Path) -> None:
        self._files = {file.stem: file for file in sorted(path.glob("*.parquet"))}
        self._read: dict[str, pl.DataFrame] = {}

    def __getitem__(self, name: str) -> pl.DataFrame:
        if name not in self._read:
            file = self._files[name]
            try:
                frame = pl.read_parquet(file, glob=False)
            except (pl.exceptions.PolarsError, OSError) as error:
                raise InputError(
                    f"{file}: not a readable event table ({error}); record the run again"
                ) from error
            if "time" not in frame.columns:
                raise InputError(f"{file}: an event table needs a column `time`, this one has none")
            self._read[name] = frame.sort("time", maintain_order=True)
        return self._read[name]

    def __iter__(self) -> Any:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


def open_recording(path: str | Path) -> Recording:
    """Open a recording folder.

    Raises:
        InputError: no such folder, no or an unreadable `recording.json`, a newer format.
    """
    path = Path(path)
    file = path / INFO_FILE
    if not file.is_file():
        what = "a folder without recording.json" if path.is_dir() else "no such folder"
        if path.is_file():
            what = "a file, where the folder of a recording is wanted"
        raise InputError(
            f"{path}: {what}; a recording is made with `chainshaper run APP.yaml -o {path}`, a "
            "trace, which is accepted as well, with `ros2 trace`"
        )
    return Recording(path, _read_info(file), _TablesOnDisk(path))


def _read_info(file: Path) -> RecordingInfo:
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{file}: not readable as JSON ({error}); record the run again") from error
    # The format first: what else a newer one holds is not ours to judge.
    format_ = values.get("format", FORMAT) if isinstance(values, dict) else FORMAT
    if format_ != FORMAT:
        raise InputError(
            f"{file}: format {format_}, this chainshaper reads format {FORMAT}; update it"
        )
    try:
        return RecordingInfo.model_validate(values)
    except ValidationError as error:
        problems = [
            f"{key_text(where)}: {reason}" for where, reason in explanations(error, RecordingInfo)
        ]
        raise InputError(f"{file}: not a recording's description: {'; '.join(problems)}") from error


def refuse_existing(path: str | Path) -> Path:
    """The path, once it is sure that nothing of the user's is there to be overwritten.

    Asked before a run begins, so that nobody loses a minute to learn it at the end.
    """
    path = Path(path)
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise InputError(
            f"{path} exists already and is not overwritten: name another, or remove it"
        )
    if os.path.ismount(path) or (path.exists() and path.samefile(".")):
        raise InputError(f"{path} cannot be replaced by a new folder: name one inside it")
    parent = path.absolute().parent
    if not parent.is_dir():
        raise InputError(f"{parent}: no such folder to write {path.name} into")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(f"{parent}: no permission to write {path.name} into it: name another")
    return path


def write_recording(
    path: str | Path, tables: EventTables | Iterable[EventTables], info: RecordingInfo
) -> Recording:
    """Write a recording, whole or not at all, and open it.

    ``tables`` may come in parts, one after the other in time, for a recording that is larger than
    memory. A table of several parts is a folder of Parquet files, which readers take for one.

    Raises:
        InputError: ``path`` exists already.
        OperationError: it cannot be written (disk full, no permission); nothing is left behind.
    """
    path = refuse_existing(path)
    partial: Path | None = None
    try:
        partial = Path(
            tempfile.mkdtemp(prefix=f".{path.name}.partial-", dir=path.absolute().parent)
        )
        for part in [tables] if isinstance(tables, Mapping) else tables:
            for name, frame in part.items():
                _write_table(_next_part(partial / f"{name}.parquet"), frame)
        (partial / INFO_FILE).write_text(info.model_dump_json(indent=2) + "\n")
        partial.chmod(0o755)
        partial.rename(path)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise OperationError(f"{path}: the recording cannot be written: {error}") from error
    finally:
        if partial is not None and partial.exists():
            shutil.rmtree(partial, ignore_errors=True)
    return open_recording(path)


def _next_part(file: Path) -> Path:
    """Where the next part of a table goes: the first one is a file, several are a folder."""
    if file.is_file():
        first = file.rename(file.with_suffix(".first"))
        file.mkdir()
        first.rename(file / "000000.parquet")
    return file / f"{len(list(file.iterdir())):06}.parquet" if file.is_dir() else file


def _write_table(file: Path, frame: pl.DataFrame) -> None:
    # By way of memory: writing to a file itself, Polars reports a full disk as a file that is out
    # of specification.
    content = io.BytesIO()
    frame.write_parquet(content, compression="zstd", compression_level=1, statistics=False)
    with file.open("wb") as stream:
        stream.write(content.getbuffer())
        stream.flush()
        os.fsync(stream.fileno())
