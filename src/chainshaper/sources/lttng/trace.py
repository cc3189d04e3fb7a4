"""LTTng traces as recordings: the folders that `ros2 trace` writes.

Events lose their provider (``ros2:callback_start`` → ``callback_start``) and get the columns and
types of :mod:`chainshaper.values.events`. A field that a trace does not declare, or declares with a
type that cannot be cast, becomes a column of nulls; a note says so, unless this is usual in some
distribution.

Tables are decoded in groups that are used together, since a pass over a trace costs nearly the same
for a single table as for twenty.

Processes in different containers may have the same numbers. So folders of different hosts are read
host by host; and folders of the same host path by path, unless the paths are of the same session,
since containers with `--network host` have the host's name. Where two hosts have the same numbers,
those of the later host are moved (:data:`NEXT_HOST`).

CARET emits the events of an application's start again when tracing begins; ``init_timestamp`` says
when they really happened.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import get_args

import polars as pl

from chainshaper.sources.ctf import CtfTrace, Events, open_trace, read_events
from chainshaper.sources.ctf import tsdl as ctf
from chainshaper.sources.lttng.sessions import (
    CARET_INIT,
    Place,
    first_of_session,
    refuse_same_events,
    table_name,
)
from chainshaper.sources.system import (
    NEXT_HOST,
    distribution_of,
    processes_of,
    rmw_of_gids,
)
from chainshaper.values import events
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.event_declarations import EventGroup, events_in_group
from chainshaper.values.events import CREATION
from chainshaper.values.middleware import rmw_of_threads
from chainshaper.values.progress import Progress
from chainshaper.values.recording import Recording, RecordingInfo

_MESSAGES = events_in_group("messages")
_GROUPS = tuple(events_in_group(group) for group in get_args(EventGroup))
_WHO_RUNS = ("callback_start", "rmw_publish", "rmw_take", "rclcpp_publish")


class SeveralClocksError(InputError):
    """The folders of a trace were taken by several clocks: of several hosts, or boots of one.

    ``folders`` are those of each clock.
    """

    def __init__(self, folders: tuple[tuple[Path, ...], ...]) -> None:
        self.folders = folders
        (first, *_), (another, *_), *_ = folders
        super().__init__(
            f"{another} was taken by another clock than {first} (another machine or boot): their"
            " times cannot be compared; give the folders of one recording"
        )


def open_lttng_trace(paths: Sequence[str | Path], progress: Progress | None = None) -> Recording:
    """Open the LTTng trace in ``paths``: folders of one recording, searched recursively.

    Raises InputError: no trace there, metadata that cannot be understood. SeveralClocksError: it is
    of several hosts.
    """
    progress = progress or (lambda _, __: None)
    progress(0.0, "opening the trace")
    try:
        trace = open_trace(*paths)
    except PermissionError as error:
        remedy = "copy the trace, or run as its owner"
        raise InputError(f"{error.filename}: no permission to read it: {remedy}") from error
    except OSError as error:
        raise OperationError(f"the trace cannot be read: {error}") from error
    first = trace.folders[0]
    by_clock: dict[object, list[Path]] = {}
    for folder in trace.folders:
        by_clock.setdefault(folder.clock.uuid, []).append(folder.path)
    if len(by_clock) > 1 and None not in by_clock:
        raise SeveralClocksError(tuple(map(tuple, by_clock.values())))
    refuse_same_events(trace)
    tables = TraceTables(_by_host(trace, paths), progress)
    creation, hosts = tables.creation(), {_fact(folder, "hostname") for folder in trace.folders}
    kernels = (_fact(folder, "kernel_release") for folder in trace.folders)
    lost = {"discarded_events": trace.discarded_events, "lost_packets": trace.lost_packets}
    if damaged := trace.damaged_places + tables.damaged:
        lost["damaged_packets"] = damaged
    info = RecordingInfo(
        source="lttng",
        host=", ".join(sorted(host for host in hosts if host)),
        boot=None if first.clock.uuid is None else str(first.clock.uuid),
        kernel=next(filter(None, kernels), "unknown"),
        distribution=distribution_of(creation, tables.fields, tables.gid_length()),
        rmw=rmw_of_gids(creation) or rmw_of_threads(tables.thread_names()),
        clock_offset_ns=trace.clock_offset_ns,
        processes=processes_of(creation, tables.commands()),
        lost=lost,
        notes=(*trace.warnings, *tables.notes()),
    )
    return Recording(Path(paths[0]), info, tables)


def _fact(folder: ctf.TraceClass, name: str) -> str:
    """Return what a folder's metadata says of the machine under a name; "": nothing."""
    return str(folder.env.get(name) or "")


class TraceTables(Mapping[str, pl.DataFrame]):
    """The event tables of a trace, decoded when they are first used. It has no empty tables.

    * ``counts``: events per full name, provider included.
    * ``fields``: table → the fields that are declared for its event.
    * ``damaged``: the number of damaged packets.
    """

    def __init__(self, hosts: Mapping[str, CtfTrace], progress: Progress) -> None:
        self._hosts, self._progress, trace = hosts, progress, next(iter(hosts.values()))
        self.fields = _declared_fields(trace)
        self._read: dict[str, pl.DataFrame] = {}
        self._decoding = Lock()  # the analysis asks for tables from two threads
        self._sources: dict[str, list[str]] = {}
        for full_name in trace.event_names:
            if (name := table_name(full_name)) is not None:
                self._sources.setdefault(name, []).append(full_name)
        self.counts = Counter[str]()
        self.warnings: tuple[str, ...] = ()
        self.damaged = 0
        self._names: dict[int, str] = {}
        self._anonymous = 0
        self._pids: set[int] = set()
        self._moved: dict[str, int] = {}
        # Whether numbers of processes have to be moved is known when those of all hosts are.
        self._decode(CREATION | {CARET_INIT} | _MESSAGES)

    def creation(self) -> events.EventTables:
        """Return the tables of creation, and CARET's `caret_init`; empty ones included."""
        return {
            name: table
            for name, table in self._read.items()
            if name in CREATION or name == CARET_INIT
        }

    def commands(self) -> dict[int, str]:
        """Return process → its main thread's name, of processes that created objects.

        If no creation was traced, of those that ran.
        """
        tables = [self._read[name] for name in CREATION if name in self._read]
        if not any(self._counted(name) for name in ("rcl_node_init", "rcl_init")):
            tables += [self[name] for name in _WHO_RUNS if name in self]
        pids = {pid for table in tables for pid in table["pid"].unique().drop_nulls()}
        return {pid: self._names.get(pid, "") for pid in pids}

    def thread_names(self) -> set[str]:
        """Return the names of all threads that are known."""
        switches = events.table(self, "sched_switch", ["next_comm"])
        return {*self._names.values(), *switches["next_comm"].unique().drop_nulls()}

    def gid_length(self) -> int:
        """Return how long a publisher's gid is declared to be (bytes); 0: it is not declared."""
        match self.fields.get("rmw_publisher_init", {}).get("gid"):
            case ctf.ArrayType(length=int(length)):
                return length
        return 0

    def __getitem__(self, name: str) -> pl.DataFrame:
        if name not in self:
            raise KeyError(name)
        with self._decoding:
            if name not in self._read:
                self._decode(next(group for group in _GROUPS if name in group))
        return self._read[name]

    def let_go(self, names: Collection[str]) -> None:
        """Forget tables, which are decoded again when they are asked for."""
        with self._decoding:
            for name in names:
                self._read.pop(name, None)

    def __contains__(self, name: object) -> bool:
        return name in events.FIELDS and self._counted(str(name)) > 0

    def __iter__(self) -> Iterator[str]:
        return (name for name in sorted(self._sources) if name in self)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def _counted(self, name: str) -> int:
        return sum(self.counts[source] for source in self._sources.get(name, ()))

    def notes(self) -> Iterator[str]:
        """Yield notes on the tables: damage, absent fields, moved numbers."""
        yield from self.warnings
        for name in sorted(set(self) & self.fields.keys()):
            missing = [
                field
                for field, kind in events.FIELDS[name].items()
                if field not in events.VERSION_FIELDS.get(name, ())
                and not events.castable(_decoded_type(self.fields[name].get(field)), kind)
            ]
            if missing:
                fields = f"no usable field {', '.join(missing)}"
                yield f"the trace's {name} has {fields}: what depends on it cannot be known."
        for host, added in self._moved.items():
            if added:
                yield (
                    f"processes and threads of host {host} have {added} added to their numbers,"
                    " which another host's processes have as well."
                )
        if self._anonymous:
            yield (
                f"{self._anonymous} events say no process or thread and cannot be used: record "
                "with `ros2 trace`, or `lttng add-context --userspace --type=vpid --type=vtid`."
            )

    def _decode(self, group: frozenset[str]) -> None:
        """Decode the tables of a group, host by host; the first call counts all events, too."""
        parts: dict[str, list[pl.DataFrame]] = {}
        wanted = [full for name in group for full in self._sources.get(name, ())]
        nameless = [full for full in wanted if table_name(full) not in CREATION]
        first, unnamed = not self.counts, not self._names
        for place, (host, trace) in enumerate(self._hosts.items()):

            def report(share: float, place: int = place) -> None:
                self._progress((place + share) / len(self._hosts), "decoding events")

            report(0.0)
            frames = read_events(trace, wanted, nameless=nameless, counted=first, progress=report)
            if first:
                self._take_stock(host, frames)
            if unnamed:
                self._note_names(host, trace, frames)
            for name in group:
                for full in self._sources.get(name, ()):
                    decoded = frames.pop(full)  # so that its memory is free after this turn
                    table = _event_table(decoded, name, trace.clock_offset_ns)
                    if first:
                        self._anonymous += decoded.height - table.height
                    if moved := self._moved[host]:
                        table = table.with_columns(pl.col("pid", "tid") + moved)
                    parts.setdefault(name, []).append(table)
        for name, tables in parts.items():
            table = tables[0]
            if len(tables) > 1:  # of several providers; CARET emits copies of events
                table = pl.concat(tables, how="diagonal_relaxed").sort("time", maintain_order=True)
                table = table.unique(maintain_order=True) if table.height else table
            self._read[name] = table

    def _take_stock(self, host: str, frames: Events) -> None:
        """Count all events; find out whether numbers of this host's processes have to be moved."""
        self.counts.update(frames.counts)
        self.warnings += frames.warnings
        self.damaged += frames.damaged
        self._moved[host] = 0
        if len(self._hosts) > 1:
            known = [frame for frame in frames.values() if frame.schema["pid"].is_integer()]
            pids = {pid for frame in known for pid in frame["pid"].unique().drop_nulls()}
            if pids & self._pids:
                self._moved[host] = max(self._moved.values()) + NEXT_HOST
            self._pids |= pids

    def _note_names(self, host: str, trace: CtfTrace, frames: Events) -> None:
        """Store the names of processes: from the events of creation, else from those of running."""
        names = _process_names(frames)
        if not names and not any(name in self for name in CREATION):
            ran = [full for name in _WHO_RUNS for full in self._sources.get(name, ())]
            names = _process_names(read_events(trace, ran))
        self._names |= {pid + self._moved[host]: name for pid, name in names.items()}


def _by_host(trace: CtfTrace, paths: Sequence[str | Path]) -> dict[str, CtfTrace]:
    """Split the trace by host, or by path where a host has several sessions.

    Streams of a kernel whose host has no traced processes go to the first part.
    """
    of_kernel = [folder.env.get("domain") == "kernel" for folder in trace.folders]
    places: list[Place] = [
        (_fact(folder, "hostname"), next(p for p in paths if folder.path.is_relative_to(p)))
        for folder in trace.folders
    ]
    session = first_of_session(trace, places)
    places = [session.get(place, place) for place in places]
    user = {place for place, kernel in zip(places, of_kernel, strict=True) if not kernel}
    several = Counter(host for host, _ in user)
    hosts = [
        f"{host} in {path}" if several[host] > 1 and (host, path) in user else host
        for host, path in places
    ]
    of_user = (host for host, kernel in zip(hosts, of_kernel, strict=True) if not kernel)
    traced = list(dict.fromkeys(of_user))
    if len(traced) < 2:
        return {"": trace}
    owners = [host if host in traced else traced[0] for host in hosts]
    parts = {}
    for host in traced:
        streams = tuple(stream for stream in trace.streams if owners[stream.folder] == host)
        parts[host] = replace(trace, streams=streams)
    return parts


def _process_names(frames: Mapping[str, pl.DataFrame]) -> dict[int, str]:
    """Return process → name of its main thread, or of any thread where that was not seen."""
    names: dict[int, str] = {}
    for frame in frames.values():
        numbers = all(frame.schema[column].is_integer() for column in ("pid", "tid"))
        if numbers and "procname" in frame.columns:
            seen = frame.select("pid", "tid", "procname").unique().drop_nulls()
            for pid, tid, name in seen.iter_rows():
                if pid == tid or pid not in names:
                    names[pid] = str(name)
    return names


def _declared_fields(trace: CtfTrace) -> dict[str, dict[str, ctf.Type]]:
    """Return table → the fields that the trace declares for its event."""
    declared: dict[str, dict[str, ctf.Type]] = {}
    streams = [stream for folder in trace.folders for stream in folder.streams.values()]
    for event in (event for stream in streams for event in stream.events.values()):
        if (name := table_name(event.name)) is not None:
            fields = event.fields.fields if event.fields is not None else ()
            types = {ctf.field_name(field.name): field.type for field in fields}
            declared.setdefault(name, {}).update(types)
    return declared


def _decoded_type(declared: ctf.Type | None) -> pl.DataType | None:
    """Return what the values of a declared field become; None: a kind that no table has."""
    match declared:
        case ctf.IntegerType():
            return pl.Int64()
        case ctf.ArrayType(ctf.IntegerType(8, 8)):
            return pl.String() if ctf.is_text(declared) else pl.List(pl.Int64())
        case ctf.StringType():
            return pl.String()
    return None


def _event_table(frame: pl.DataFrame, name: str, clock_offset_ns: int) -> pl.DataFrame:
    """Return a decoded event's frame as an event table; events without a thread are left out."""
    if "init_timestamp" in frame.columns and frame.schema["init_timestamp"].is_integer():
        happened = pl.col("init_timestamp")
        wall_clock = happened > clock_offset_ns
        at = pl.when(wall_clock).then(happened - clock_offset_ns).otherwise(happened)
        frame = frame.with_columns(time=at.cast(pl.Int64)).sort("time", maintain_order=True)
    if name not in events.FIELDS:
        return frame
    columns = []
    for column, kind in {**events.COMMON_COLUMNS, **events.FIELDS[name]}.items():
        if events.castable(frame.schema.get(column), kind):
            columns.append(pl.col(column).cast(kind, strict=False))
        elif column not in events.VERSION_FIELDS.get(name, ()):
            columns.append(pl.lit(None, dtype=kind).alias(column))
    table = frame.select(columns)
    # `sched_switch` names its threads itself.
    nameless = name != "sched_switch" and (table["pid"].null_count() or table["tid"].null_count())
    return table.drop_nulls(["pid", "tid"]) if nameless else table
