"""LTTng traces as recordings: the folders that `ros2 trace` writes.

Events keep their names without the provider (``ros2:callback_start`` → ``callback_start``) and get
the columns and types of :mod:`chainshaper.events`; what the analysis does not know is left out.
Tables are decoded in groups that are used together, because one pass over a trace costs nearly the
same for one table as for twenty: those of the objects' creation, of callbacks and of messages at
once, since every analysis needs them (an overview only creation); what the upper layers say about
the same messages, `sched_switch` and the executor's when somebody asks for them.

Times stay what the tracer wrote, ns of CLOCK_MONOTONIC. CARET keeps the events of an
application's start and emits them again when tracing begins; those carry ``init_timestamp``, the
time at which they really happened, and are put there.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import polars as pl

from chainshaper import events
from chainshaper.errors import InputError, OperationError
from chainshaper.recording import Recording, RecordingInfo
from chainshaper.sources.ctf import CtfError, CtfTrace, count_events, open_trace, read_events
from chainshaper.sources.ctf.read import Events
from chainshaper.sources.ctf.types import ArrayType, StructType, field_name
from chainshaper.sources.system import distribution_of, processes_of, rmw_of_gids, rmw_of_threads

__all__ = ["Progress", "TraceTables", "open_lttng_trace"]

Progress: TypeAlias = Callable[[float, str], None]
"""Told the share of the work that is done, from 0 to 1, and what is being done."""

_EXECUTOR = frozenset(name for name in events.FIELDS if name.startswith("rclcpp_executor_"))
_SWITCHES = frozenset(("sched_switch",))
_CREATION = frozenset(
    name
    for name in events.FIELDS
    if name.endswith(("_init", "_added", "_register", "_link_node", "_to_ipb", "_to_subscription"))
) | {"rmw_implementation", "rclcpp_construct_ring_buffer"}
_UPPER_LAYERS = frozenset(("rclcpp_publish", "rcl_publish", "rcl_take", "rclcpp_take"))
_MESSAGES = frozenset(events.FIELDS) - _EXECUTOR - _SWITCHES - _CREATION - _UPPER_LAYERS
_GROUPS = (_CREATION, _MESSAGES, _UPPER_LAYERS, _EXECUTOR, _SWITCHES)
_ALSO = frozenset(("caret_init",))  # read with the creation, but no table of ours
_WHO_RUNS = ("callback_start", "rmw_publish", "rmw_take", "rclcpp_publish")


class TraceTables(Mapping[str, pl.DataFrame]):
    """The event tables of an open trace, decoded on first use.

    ``counts`` are the events per full name, provider included. Only events that happened are in
    the mapping.
    """

    def __init__(self, trace: CtfTrace, progress: Progress, overview: bool) -> None:
        self._trace = trace
        self._progress = progress
        self._read: dict[str, pl.DataFrame] = {}
        self._sources: dict[str, list[str]] = {}
        for full_name in trace.event_names:
            name = _plain(full_name)
            if name in events.FIELDS or name in _ALSO:
                self._sources.setdefault(name, []).append(full_name)
        self.counts: dict[str, int] = {}
        self.warnings: tuple[str, ...] = ()
        self._names: dict[int, str] = {}
        self._decode(_CREATION | _ALSO | (frozenset() if overview else _MESSAGES))

    def creation(self) -> events.EventTables:
        """The tables of the objects' creation, and CARET's `caret_init`; empty ones included."""
        return {name: self._read[name] for name in _CREATION | _ALSO if name in self._read}

    def commands(self) -> dict[int, str]:
        """Process → its name, as far as the tracer recorded it with the objects' creation.

        Where nothing was created during the recording, everything that ran is looked at.
        """
        tables = [self._read[name] for name in _CREATION if name in self._read]
        if not any(self._counted(name) for name in ("rcl_node_init", "rcl_init")):
            tables += [self[name] for name in _WHO_RUNS if name in self]
        return {
            pid: self._names.get(pid, "")
            for table in tables
            for pid in table["pid"].unique().drop_nulls().to_list()
        }

    def thread_names(self) -> set[str]:
        """Names of threads that the tracer recorded, the kernel's view included."""
        names = set(self._names.values())
        if "sched_switch" in self and "next_comm" in self["sched_switch"].columns:
            names |= set(self["sched_switch"]["next_comm"].unique().drop_nulls())
        return names

    def __getitem__(self, name: str) -> pl.DataFrame:
        if name not in self:
            raise KeyError(name)
        if name not in self._read:
            self._decode(next(group for group in _GROUPS if name in group))
        return self._read[name]

    def __contains__(self, name: object) -> bool:
        return name in events.FIELDS and self._counted(str(name)) > 0

    def __iter__(self) -> Iterator[str]:
        return (name for name in sorted(self._sources) if name in self)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def _counted(self, name: str) -> int:
        return sum(self.counts.get(source, 0) for source in self._sources.get(name, ()))

    def _with_unread(self, found: Events) -> dict[str, int]:
        """Counts of all events, with those of streams in which nothing was asked for."""
        with _as_our_errors():
            others = count_events(replace(self._trace, streams=found.unread))
        return {name: count + others.get(name, 0) for name, count in found.counts.items()}

    def _decode(self, group: frozenset[str]) -> None:
        wanted = [full for name in group for full in self._sources.get(name, ())]
        what = "decoding events"
        self._progress(0.0, what)
        with _as_our_errors():
            found = read_events(
                self._trace, wanted, progress=lambda share: self._progress(share, what)
            )
        if not self.counts:
            self.counts = self._with_unread(found)
            self.warnings = found.warnings
        if not self._names:
            rare = {name: frame for name, frame in found.items() if _plain(name) in _CREATION}
            self._names = _process_names(rare) or _process_names(found)
        for name in group:
            parts = [
                _table(found.pop(full), name, self._trace) for full in self._sources.get(name, ())
            ]
            if len(parts) == 1:
                self._read[name] = parts[0]
            elif parts:
                self._read[name] = _merged(parts)


def open_lttng_trace(
    paths: Sequence[str | Path], progress: Progress | None = None, *, overview: bool = False
) -> Recording:
    """Open the LTTng trace in ``paths``: folders of one recording, searched recursively.

    Kernel and user space, users (per-uid) and processes (per-pid) have a folder each; all are
    merged by time. ``overview`` leaves callbacks and messages undecoded until they are asked for;
    ``progress`` is told about this, and about decoding later on.

    Raises:
        InputError: no trace there, metadata that cannot be understood, or traces taken by
            different clocks (other machines, other boots), whose times cannot be compared.
    """
    progress = progress or _untold
    progress(0.0, "opening the trace (the first time on a machine, its decoder is compiled)")
    with _as_our_errors():
        trace = open_trace(*paths)
    _refuse_different_clocks(trace)
    tables = TraceTables(trace, progress, overview)
    creation = tables.creation()
    hosts = sorted({str(folder.declared.env.get("hostname", "")) for folder in trace.folders})
    info = RecordingInfo(
        source="lttng",
        host=", ".join(host for host in hosts if host),
        kernel=_kernel(trace),
        distribution=distribution_of(creation, _declared_fields(trace)),
        rmw=rmw_of_gids(creation) or rmw_of_threads(tables.thread_names()),
        clock_offset_ns=trace.clock_offset_ns,
        processes=processes_of(creation, tables.commands()),
        lost={
            "discarded_events": trace.discarded_events,
            "lost_packets": trace.lost_packets,
        },
        notes=(*trace.warnings, *tables.warnings),
    )
    return Recording(Path(paths[0]), info, tables)


class _as_our_errors:  # noqa: N801 - reads like a function where it is used
    """What the decoder raises inside becomes an error of the project."""

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, CtfError):
            raise InputError(str(error)) from error
        if isinstance(error, PermissionError):
            raise InputError(
                f"{error.filename}: no permission to read it: copy the trace, or run as its owner"
            ) from error
        if isinstance(error, OSError):
            raise OperationError(f"the trace cannot be read: {error}") from error


def _untold(*_: object) -> None:
    """Progress that nobody watches."""


def _plain(full_name: str) -> str:
    return full_name.rpartition(":")[2]


def _table(frame: pl.DataFrame, name: str, trace: CtfTrace) -> pl.DataFrame:
    """A decoded event's frame as an event table."""
    types = {**events.COMMON_COLUMNS, **events.FIELDS.get(name, {})}
    if "init_timestamp" in frame.columns:
        happened = pl.col("init_timestamp")
        wall_clock = happened > trace.clock_offset_ns
        at = pl.when(wall_clock).then(happened - trace.clock_offset_ns).otherwise(happened)
        frame = frame.with_columns(time=at.cast(pl.Int64)).sort("time", maintain_order=True)
    if name in events.FIELDS:
        frame = frame.select(column for column in types if column in frame.columns)
    different = {c: t for c, t in types.items() if c in frame.columns and frame.schema[c] != t}
    return frame.cast(different, strict=False) if different else frame  # type: ignore[arg-type]


def _merged(parts: list[pl.DataFrame]) -> pl.DataFrame:
    """Several providers' events of one name, by time; CARET's copy of an event is not another."""
    merged = pl.concat(parts, how="diagonal_relaxed").sort("time", maintain_order=True)
    return merged.unique(maintain_order=True) if merged.height else merged


def _process_names(frames: Mapping[str, pl.DataFrame]) -> dict[int, str]:
    """Process → name of its main thread, or of any thread where that was not seen."""
    names: dict[int, str] = {}
    for frame in frames.values():
        if "procname" in frame.columns:
            seen = frame.select("pid", "tid", "procname").unique().drop_nulls()
            for pid, tid, name in seen.iter_rows():
                if pid == tid or pid not in names:
                    names[pid] = str(name)
    return names


def _declared_fields(trace: CtfTrace) -> dict[str, dict[str, int]]:
    """Event → its fields, with the length of those that are arrays."""
    declared: dict[str, dict[str, int]] = {}
    for folder in trace.folders:
        for stream in folder.declared.streams.values():
            for event in stream.events.values():
                if isinstance(event.fields, StructType):
                    declared[_plain(event.name)] = {
                        field_name(f.name): f.type.length if isinstance(f.type, ArrayType) else 0
                        for f in event.fields.fields
                    }
    return declared


def _kernel(trace: CtfTrace) -> str:
    releases = [folder.declared.env.get("kernel_release") for folder in trace.folders]
    return next((str(release) for release in releases if release), "unknown")


def _refuse_different_clocks(trace: CtfTrace) -> None:
    first = trace.folders[0]
    for folder in trace.folders[1:]:
        clocks = {first.clock.uuid, folder.clock.uuid}
        if None not in clocks and len(clocks) == 2:
            raise InputError(
                f"{folder.path} was taken by another clock than {first.path} (another machine, or "
                "another boot of this one): their times cannot be compared; give the folders of "
                "one recording"
            )
