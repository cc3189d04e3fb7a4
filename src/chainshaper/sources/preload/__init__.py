"""Tracing by a library that `LD_PRELOAD` puts in front of ROS 2: no root, no daemon, no module.

`preload.c` is that library. It sends us the memory of its process with the process's first event;
that of a process that runs already is in `/proc`. A thread reads all memories ten times a second,
also what a process wrote that was killed in between.

A process writes into its memory whatever it likes, by a mistake as well. So every record is checked
before it is used; the first that the library cannot have written is the last that is looked at of
that process, whose events from there on are counted as lost.
"""

import fcntl
import functools
import mmap
import os
import re
import secrets
import socket
import stat
import struct
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper import _core
from chainshaper.linux.processes import descendants, run_users
from chainshaper.linux.threads import (
    innermost_id,
    list_threads,
    of_another_clock,
    parents,
    read_proc,
    time_namespace,
)
from chainshaper.robot.clocks import clock_offset
from chainshaper.sources.preload.events_header import FORMAT
from chainshaper.sources.registers import table_of_registers
from chainshaper.sources.system import NEXT_HOST, info_of, own_pid_namespace
from chainshaper.sources.tracing_library import TracingLibrary, version_of
from chainshaper.values import events
from chainshaper.values.errors import InputError, OperationError, PlatformError, text_of
from chainshaper.values.event_declarations import EVENTS, events_of_library
from chainshaper.values.events import EventTables
from chainshaper.values.files import open_output
from chainshaper.values.recording import RecordingInfo

RECORD = np.dtype(
    [("time", "<i8"), ("tid", "<u4"), ("cpu", "<u2"), ("event", "<u2"), ("values", "<u8", 6)]
)
"""`struct record`: one event, or a part of a text."""

_COUNTS = ("magic", "format", "pid", "rings", "ring_records", "object_records")
_HEADER = np.dtype(
    [
        *((name, "<u4") for name in _COUNTS),
        ("objects", "<u8"),
        ("dropped", "<u8"),
        ("clock", "<u8"),
        ("unused", "<u8", 2),
    ]
)
_RING = np.dtype([("written", "<u8"), ("taken", "<u4"), ("unused", "<u4", 13)])
_MAGIC, _FORMAT = 0x63687368, FORMAT
_TEXT, _LIBRARY, _FIRST_EVENT = 1, 2, 3
_TEXT_BYTES, _PLACES = 40, 16
_RINGS, _RING_RECORDS, _OBJECT_RECORDS = 64, 1 << 14, 1 << 15  # of this format, no others
_OF_OBJECTS = _HEADER.itemsize + _RINGS * _RING.itemsize
_OF_RECORDS = _OF_OBJECTS + _OBJECT_RECORDS * RECORD.itemsize
_SIZE = _OF_RECORDS + _RINGS * _RING_RECORDS * RECORD.itemsize
_F_GET_SEALS, _F_SEAL_SHRINK = 1034, 2  # linux/fcntl.h
_LONGEST_TEXT = 4096  # `LONGEST_TEXT` in preload.c
_MOST_WRITTEN = 1 << 40  # records between two looks: a week of as many as one core can write
_COMMON = ("time", "tid", "cpu")
_LARGEST_ID = 1 << 22  # of processes and threads: linux/threads.h, PID_MAX_LIMIT


def event_names() -> tuple[str, ...]:
    """The events that the library records, in the order of their numbers."""
    return tuple(event.name for event in events_of_library())


@functools.cache
def _events_of_rings() -> NDArray[np.bool_]:
    """By the number of an event, whether rings have it: what happens, not what is created."""
    known = np.zeros(1 << 16, bool)
    for number, name in enumerate(event_names(), _FIRST_EVENT):
        known[number] = name not in events.CREATION
    return known


@functools.cache
def _events_of_objects() -> NDArray[np.bool_]:
    """The same of what is created; 0 is an event that is being written."""
    known = ~_events_of_rings()
    known[_FIRST_EVENT + len(event_names()) :] = False
    return known


class RefusedMemoryError(InputError):
    """The memory of a process, ``inner_pid`` as that calls itself, that says nothing to us."""

    def __init__(self, why: str, inner_pid: int) -> None:
        super().__init__(why)
        self.inner_pid = inner_pid


class TracedProcess:
    """The memory of one process; ``lost`` counts what was overwritten, and what is not used since
    there is ``damage``: why, as half a sentence.

    Nothing is locked: a reader copies what is new in a ring, then looks again how much has been
    written, and counts as lost what may have been overwritten meanwhile. ``pid`` is the process's
    number here, ``inner_pid`` what it calls itself in its container.

    Raises InputError: the descriptor is of no such memory, or of one that may shrink.
    RefusedMemoryError: it is of another version, or of a process whose times are of another clock.
    """

    def __init__(self, descriptor: int, pid: int = 0) -> None:
        seals = 0
        with suppress(OSError):  # no memfd
            seals = fcntl.fcntl(descriptor, _F_GET_SEALS)
        size = os.fstat(descriptor).st_size
        if not seals & _F_SEAL_SHRINK or size < _HEADER.itemsize:
            raise InputError("what was sent is no memory of a traced process")
        header = np.frombuffer(os.pread(descriptor, _HEADER.itemsize, 0), _HEADER)
        magic, form, self.inner_pid, *counts = header[0].tolist()[: len(_COUNTS)]
        # Whatever a process says, no more is read than a memory of this version has.
        known = [_RINGS, _RING_RECORDS, _OBJECT_RECORDS]
        if (magic, form, counts) != (_MAGIC, _FORMAT, known) or size != _SIZE:
            why = (
                "its memory is that of another version of chainshaper: start it again with this one"
            )
            raise RefusedMemoryError(why, self.inner_pid)
        memory = mmap.mmap(descriptor, size, prot=mmap.PROT_READ)
        self.header: NDArray[Any] = np.frombuffer(memory, _HEADER, 1)
        self.pid = pid or self.inner_pid
        if not (0 < self.pid <= _LARGEST_ID and 0 < self.inner_pid <= _LARGEST_ID):
            raise InputError(f"what was sent says that it is of process {self.inner_pid}")
        clock = int(header["clock"][0])  # what it said counts, for it may have ended since
        if clock not in (0, time_namespace()) or (not clock and of_another_clock(self.pid)):
            raise RefusedMemoryError(
                "it has another clock, that of a time namespace: record it in there"
                f" (`nsenter --time --target {self.pid} …`)",
                self.inner_pid,
            )
        self.damage: str | None = None
        self._tids: dict[int, int] = {}
        self._rings = np.frombuffer(memory, _RING, _RINGS, _HEADER.itemsize)
        self._objects = np.frombuffer(memory, RECORD, _OBJECT_RECORDS, _OF_OBJECTS)
        records = np.frombuffer(memory, RECORD, _RINGS * _RING_RECORDS, _OF_RECORDS)
        self._records = records.reshape(_RINGS, _RING_RECORDS)
        self._read = np.zeros(_RINGS, np.uint64)
        self.lost = 0

    @property
    def dropped(self) -> int:
        """Events for which the process itself had no room."""
        dropped = int(self.header["dropped"][0])
        if dropped >= _MOST_WRITTEN:
            self._damaged(f"it says that it had no room for {dropped} events")
            return 1
        return dropped

    def new_records(self) -> list[NDArray[Any]]:
        """What came into the rings since the last time, each ring's in the order of writing."""
        found = []
        for number in np.flatnonzero(self._rings["written"] != self._read):
            ring, read = self._records[number], int(self._read[number])
            written = int(self._rings["written"][number])
            if not read <= written < read + _MOST_WRITTEN:
                self._damaged(f"it says that it has written {written - read} events at once")
                self._read[number] = written
                self.lost += 1
                continue
            if self.damage is not None:
                self.lost += written - read
                self._read[number] = written
                continue
            oldest = max(read, written - ring.size)
            places = np.arange(oldest, written) % ring.size
            copied = ring.take(places)
            # The record behind `written` may be half there, in the place of the oldest of all.
            whole = max(oldest, int(self._rings["written"][number]) + 1 - ring.size)
            self.lost += min(whole, written) - read
            self._read[number] = written
            if whole < written:
                records = copied[whole - oldest :]
                good = self._good(records, _events_of_rings())
                self.lost += records.size - good
                if good:
                    found.append(self._numbered(records[:good]))
        return found

    def _good(self, records: NDArray[Any], known: NDArray[np.bool_]) -> int:
        """How many records stand before the first that the library cannot have written."""
        times, tids, numbers = records["time"], records["tid"], records["event"]
        good = (times >= 0) & (times <= time.monotonic_ns()) & known[numbers]
        good &= (tids > 0) & (tids <= _LARGEST_ID)
        good |= known[0] & (numbers == 0)
        if good.all():
            return records.size
        at = int(np.argmin(good))
        self._damaged(
            f"it has a record of event {numbers[at]} in thread {tids[at]} at {times[at]} ns"
        )
        return at

    def _damaged(self, why: str) -> None:
        self.damage = self.damage or why

    def _numbered(self, records: NDArray[Any]) -> NDArray[Any]:
        """Records with the numbers that their threads have here, as long as they run."""
        if self.pid == self.inner_pid:
            return records
        inner, places = np.unique(records["tid"], return_inverse=True)
        if not self._tids.keys() >= set(inner.tolist()):
            self._tids |= {one.inner_tid: one.tid for one in list_threads(self.pid)}
        numbers = [self._tids.setdefault(tid, tid + NEXT_HOST) for tid in inner.tolist()]
        records["tid"] = np.array(numbers, np.uint32)[places]
        return records

    def objects(self) -> tuple[NDArray[Any], dict[int, dict[int, str]]]:
        """The events of creation so far, and by the number of one of these the texts of it.

        Texts are by the place of the argument. An event that is being written is left out.
        """
        asked = min(int(self.header["objects"][0]), self._objects.size)
        records = self._objects[:asked].copy()
        records = records[: self._good(records, _events_of_objects())]
        lengths, places = np.divmod(records["values"][:, 0], np.uint64(_PLACES))
        is_text = records["event"] == _TEXT
        if (long := is_text & (lengths > _LONGEST_TEXT)).any():
            good = int(long.argmax())
            self._damaged(f"it has a text of {lengths[good]} bytes")
            records, is_text = records[:good], is_text[:good]
        created = np.flatnonzero(~is_text)
        texts: dict[int, dict[int, bytes]] = {}
        for at in np.flatnonzero(is_text):
            said = texts.setdefault(int(np.searchsorted(created, at)) - 1, {})
            place, length = int(places[at]), int(lengths[at])
            said[place] = (said.get(place, b"") + records["values"][at, 1:].tobytes())[:length]
        whole = np.flatnonzero(records["event"][created])  # the others' texts are theirs as well
        return self._numbered(records[created[whole]]), {
            number: {place: text_of(text) for place, text in texts.get(behind, {}).items()}
            for number, behind in enumerate(whole.tolist())
        }


def creation_tables(process: TracedProcess) -> tuple[dict[str, pl.DataFrame], TracingLibrary]:
    """The tables of what a process has created, and the tracing library behind ours."""
    objects, texts = process.objects()
    libraries = (texts.get(int(n), {}) for n in np.flatnonzero(objects["event"] == _LIBRARY))
    path = next((one.get(0, "") for one in libraries), "").partition("\0")[0]
    library = TracingLibrary(Path(path), frozenset(), version_of(Path(path)))
    pids = np.full(objects.size, process.pid, np.int32)
    return _tables(objects, pids, texts, library, events.CREATION), library


def event_tables(
    records: NDArray[Any], pids: NDArray[np.int32], library: TracingLibrary
) -> dict[str, pl.DataFrame]:
    """The tables of records of :meth:`TracedProcess.new_records`, each of a process."""
    return _tables(records, pids, {}, library, frozenset(events.FIELDS) - events.CREATION)


def joined_tables(parts: Iterable[Mapping[str, pl.DataFrame]]) -> dict[str, pl.DataFrame]:
    """The tables of several processes as those of one application, in order of time."""
    found: dict[str, list[pl.DataFrame]] = {}
    for name, table in (pair for tables in parts for pair in tables.items()):
        found.setdefault(name, []).append(table)
    joined = ((name, pl.concat(own, how="diagonal")) for name, own in found.items())
    return {
        name: one if one["time"].is_sorted() else one.sort("time", maintain_order=True)
        for name, one in joined
    }


def _tables(
    records: NDArray[Any],
    pids: NDArray[np.int32],
    texts: Mapping[int, Mapping[int, str]],
    library: TracingLibrary,
    names: Collection[str],
) -> dict[str, pl.DataFrame]:
    tables = {}
    for number, name in enumerate(event_names(), _FIRST_EVENT):
        places = np.flatnonzero(records["event"] == number) if name in names else np.array([])
        if places.size:

            def said(place: int, events: NDArray[np.int64] = places) -> list[str | None]:
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
                name, recorded, frame, rows["values"], said, version=library.version
            )
    return tables


VARIABLE = "CHAINSHAPER_TRACE"
_BETWEEN_LOOKS_S = 0.1
_BETWEEN_SEARCHES_NS = 1_000_000_000
_CREDENTIALS = struct.Struct("iII")  # struct ucred: pid, uid, gid


def native_library(name: str) -> Path:
    """What was built or installed with the native library: it is beside `chainshaper._core`."""
    return Path(_core.__file__).with_name(name)


def installed_library() -> Path:
    """The library that traces from the front of ROS 2."""
    return native_library("libchainshaper_trace.so")


def preloading(library: Path) -> str:
    """`LD_PRELOAD` with the library in front of what it names. Raises PlatformError: it cannot."""
    if re.search(r"[\s:]", str(library)):
        why = f"{str(library)!r} has a space or a colon in it, so LD_PRELOAD cannot name it"
        raise PlatformError(f"{why}: install chainshaper in a folder whose path has neither")
    before = os.environ.get("LD_PRELOAD", "").split(":")
    return ":".join([str(library), *(one for one in before if one and one != str(library))])


SANITIZER, ANY_ORDER = "ASAN_OPTIONS", "verify_asan_link_order=0"
"""A node built with AddressSanitizer refuses to start behind any library in `LD_PRELOAD`, unless
this variable tells it not to look at the order of libraries. The last word of it counts."""


def in_front(library: Path) -> dict[str, str]:
    """The variables that put a library in front of ROS 2 in all that is started with them.

    Raises PlatformError: as :func:`preloading`.
    """
    options = filter(None, [os.environ.get(SANITIZER, ""), ANY_ORDER])
    return {"LD_PRELOAD": preloading(library), SANITIZER: ":".join(options)}


NO_PROCESS = (
    "no process of these users runs with the library in front: set what `chainshaper watch "
    "--environment` prints before the application is started, or name its user (--user)"
)
_MEMORY = re.compile(rb"/memfd:chainshaper-trace\b")


def memories(
    users: Collection[int],
    known: Collection[int],
    refused: Callable[[int, str], None] = lambda *_: None,
) -> Iterator[tuple[int, TracedProcess]]:
    """Processes of some users that have the library in front, but for those that are ``known``.

    ``refused`` gets those whose memory says nothing to us, and a sentence that names one and says
    why.
    """
    running = (int(name) for name in os.listdir("/proc") if name.isdigit())  # noqa: PTH208
    for pid in {*running}.difference(known):
        with suppress(OSError):  # it has ended, or may not be looked into
            if Path(f"/proc/{pid}").stat().st_uid not in users:
                continue
            inner_pid = innermost_id(read_proc(f"/proc/{pid}/status"))
            for descriptor in Path(f"/proc/{pid}/fd").iterdir():
                with suppress(OSError):  # it is closed meanwhile, or may not be opened
                    memory = _memory_of(descriptor, pid)
                    # Another process's memory is open in one that reads it, as we do.
                    if memory is None or memory.inner_pid != inner_pid:
                        continue
                    if isinstance(memory, RefusedMemoryError):
                        refused(pid, _left_out(pid, memory))
                    else:
                        yield pid, memory
                    break


def _name_of(pid: int) -> str:
    """The name of a program that runs. Raises OSError: it has ended."""
    return text_of(read_proc(f"/proc/{pid}/comm").removesuffix(b"\n"))


def _left_out(pid: int, why: Exception) -> str:
    """A sentence that names a process of which nothing is recorded."""
    name = ""
    with suppress(OSError):  # it has ended
        name = f" ({_name_of(pid)})"
    return f"nothing of process {pid}{name} is recorded: {why}."


def _memory_of(descriptor: Path, pid: int) -> TracedProcess | RefusedMemoryError | None:
    """The memory behind an open file of a process, in `/proc`; None: it is another kind of file.

    Anything may have the name of a memory, and opening a pipe or a device may wait for ever or do
    something: so the file is looked at before it is opened for reading. Raises OSError.
    """
    if not _MEMORY.match(os.fsencode(descriptor.readlink())):
        return None
    place = os.open(descriptor, os.O_PATH | os.O_CLOEXEC)
    try:
        if not stat.S_ISREG(os.fstat(place).st_mode):
            return None
        with Path(f"/proc/self/fd/{place}").open("rb") as file:
            return TracedProcess(file.fileno(), pid)
    except RefusedMemoryError as refused:
        return refused
    except InputError:
        return None
    finally:
        os.close(place)


class PreloadTracer:
    """Records with the library in front: a :class:`~chainshaper.sources.Tracer`."""

    def __init__(
        self,
        folder: Path,
        command: Sequence[str],
        pids: Sequence[int],
        users: Collection[int] | None = None,
    ) -> None:
        self._folder, self._pids, self._attaches = folder, pids, not command
        self._users = {os.geteuid(), *(run_users() if users is None else users)}
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._reader = threading.Thread(target=self._read_until_over, daemon=True)
        self._over = threading.Event()
        self._failure: str | None = None
        self._clock_offset_ns = 0
        self._processes: list[TracedProcess] = []
        self._names: dict[int, str] = {}
        self._refused: list[str] = []  # sentences: nothing of these is recorded, and why
        self._found: set[int] = set()  # attached to, by the ids that they have here
        self._searched_ns = 0

    def start(self) -> Mapping[str, str]:
        """Wait for the processes that have the library, or take those that run with it."""
        self._clock_offset_ns = clock_offset()
        if self._attaches:
            self._search()
            if not self._processes:
                why = "; ".join(one.rstrip(".") for one in self._refused) or NO_PROCESS
                raise OperationError(f"{why}, or attach with `--source ebpf`")
            for process in self._processes:  # what happened until now is none of this recording
                process.new_records()
                process.lost = 0
            self._reader.start()
            return {}
        library = installed_library()
        name = f"chainshaper-{os.getpid()}-{secrets.token_hex(8)}"
        self._socket.bind(f"\0{name}")
        self._socket.listen(128)
        self._socket.settimeout(_BETWEEN_LOOKS_S)
        self._reader.start()
        return {**in_front(library), VARIABLE: name}

    def failure(self) -> str | None:
        return self._failure

    def stop(self) -> None:
        self._over.set()
        if self._reader.ident is not None:
            self._reader.join()

    def remove(self) -> None:
        self.stop()
        self._socket.close()

    def recording(self) -> tuple[EventTables, RecordingInfo]:
        if not self._processes:
            raise OperationError(
                "no process has loaded the tracing library: is tracing compiled into this ROS 2 "
                "(`ros2 run tracetools status`), and do the nodes run here, not in a container, "
                "without more rights than you (LD_PRELOAD is ignored then)? Else `--source lttng`"
            )
        parts: list[dict[str, pl.DataFrame]] = []
        versions: list[str | None] = []
        for place, process in enumerate(self._processes):
            file = self._file(place)
            records = np.fromfile(file, RECORD) if file.exists() else np.empty(0, RECORD)
            created, library = creation_tables(process)
            pids = np.full(records.size, process.pid, np.int32)
            versions.append(library.version)
            parts += (created, event_tables(records, pids, library))
        tables = joined_tables(parts)
        lost = sum(process.lost + process.dropped for process in self._processes)
        notes = [f"{self._failure}."] if self._failure else []
        notes += self._refused
        for process in self._processes:
            if process.damage is not None:
                name = self._names.get(process.pid, "unknown")
                notes.append(
                    f"process {process.pid} ({name}): from where {process.damage}, which the"
                    " library never writes, its events are left out and counted as lost."
                )
        if lost:
            notes.append(f"{lost} events were lost: recording did not run often enough for them.")
        facts = {"clock_offset_ns": self._clock_offset_ns, "notes": tuple(notes)}
        facts |= {"pid_namespace": own_pid_namespace()}
        return tables, info_of("preload", tables, versions, self._names, lost, **facts)

    def written(self) -> None:
        for place in range(len(self._processes)):
            self._file(place).unlink(missing_ok=True)  # the tables have all of it

    def _file(self, place: int) -> Path:
        return self._folder / f"process_{place}.records"

    def _read_until_over(self) -> None:
        try:
            while not self._over.is_set():
                if not self._attaches:
                    self._welcome()
                elif not self._over.wait(_BETWEEN_LOOKS_S):
                    self._search()
                self._read_all()
            self._read_all()
        except OSError as error:
            self._failure = f"events can no longer be written down ({error.strerror})"
        except Exception as error:
            self._failure = f"reading events has failed ({type(error).__name__}: {error})"

    def _welcome(self) -> None:
        """Take the memories that were sent, for as long as it is until the next look."""
        until = time.monotonic() + _BETWEEN_LOOKS_S  # whoever else connects all the time
        with suppress(TimeoutError):
            while not self._over.is_set() and time.monotonic() < until:
                peer, _ = self._socket.accept()
                with peer:
                    self._take_memory(peer)

    def _search(self) -> None:
        """Processes with the library that are new, once a second."""
        if time.monotonic_ns() - self._searched_ns < _BETWEEN_SEARCHES_NS:
            return
        self._searched_ns = time.monotonic_ns()
        family = descendants(parents(), *self._pids)

        def refuse(pid: int, why: str) -> None:
            if not self._pids or pid in family:
                self._found.add(pid)
                self._refused.append(why)

        for pid, process in memories(self._users, self._found, refuse):
            if not self._pids or pid in family:
                self._found.add(pid)
                self._processes.append(process)

    def _take_memory(self, peer: socket.socket) -> None:
        """The memory of one process, which runs as one of the users that are recorded."""
        credentials = peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        pid, user, _ = _CREDENTIALS.unpack(credentials)
        if user not in self._users:
            return
        peer.settimeout(_BETWEEN_LOOKS_S)
        try:
            _, descriptors, _, _ = socket.recv_fds(peer, 64, 1)
        except OSError:
            return
        for descriptor in descriptors:
            try:
                process = TracedProcess(descriptor, pid)
            except (InputError, OSError) as error:
                self._refused.append(_left_out(pid, error))
            else:
                self._processes.append(process)
                with suppress(OSError):
                    self._names[process.pid] = _name_of(pid)
            os.close(descriptor)

    def _read_all(self) -> None:
        for place, process in enumerate(self._processes):
            if parts := process.new_records():
                flags = os.O_WRONLY | os.O_APPEND
                with os.fdopen(open_output(self._file(place), flags), "ab") as file:
                    file.writelines(part.tobytes() for part in parts)
