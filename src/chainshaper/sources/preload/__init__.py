"""Tracing by a library that `LD_PRELOAD` puts in front of ROS 2: no root, no daemon, no module.

`preload.c` is that library. It sends us the memory of its process with the process's first event;
that of a process that runs already is in `/proc`. A thread reads all memories ten times a second,
also what a process wrote that was killed in between.
"""

import fcntl
import functools
import hashlib
import mmap
import os
import platform
import re
import secrets
import shutil
import socket
import struct
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper.gate.decision import clock_offset
from chainshaper.linux.own_processes import tool_environment
from chainshaper.linux.processes import descendants, run_users
from chainshaper.linux.threads import innermost_id, list_threads, parents, read_proc
from chainshaper.sources.ebpf.trace_points import (
    Argument,
    TracePoint,
    TracingLibrary,
    event_table,
    version_of,
)
from chainshaper.sources.system import NEXT_HOST, info_of, own_pid_namespace
from chainshaper.values import events
from chainshaper.values.errors import InputError, OperationError, PlatformError
from chainshaper.values.events import EventTables
from chainshaper.values.files import own_cache, why_distrusted
from chainshaper.values.recording import RecordingInfo

SOURCE = Path(__file__).with_name("preload.c")

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
        ("unused", "<u8", 3),
    ]
)
_RING = np.dtype([("written", "<u8"), ("taken", "<u4"), ("unused", "<u4", 13)])
_MAGIC, _FORMAT = 0x63687368, 2
_TEXT, _LIBRARY, _FIRST_EVENT = 1, 2, 3
_TEXT_BYTES, _PLACES = 40, 16
_LARGEST = 1 << 30
_F_GET_SEALS, _F_SEAL_SHRINK = 1034, 2  # linux/fcntl.h
_THREAD_TIME = 2  # the value of callback_start and callback_end that is no argument
_CALL: dict[str, tuple[int, Literal["number", "gid"]]] = {  # where the values of a CALL are
    **{"rmw_client_handle": (0, "number"), "rmw_service_handle": (0, "number")},
    **{"request": (1, "number"), "response": (1, "number"), "client_gid": (2, "gid")},
    **{"sequence_number": (4, "number"), "source_timestamp": (5, "number")},
}

_NAME = re.compile(r"^  (?:EVENT|CREATION|CALL)\((\w+)", re.MULTILINE)


@functools.cache
def event_names() -> tuple[str, ...]:
    """The events in the order of their numbers, as the library's source has them."""
    return tuple(_NAME.findall(SOURCE.read_text("utf-8")))


class TracedProcess:
    """The memory of one process; ``lost`` counts what was overwritten.

    Nothing is locked: a reader copies what is new in a ring, then looks again how much has been
    written, and counts as lost what may have been overwritten meanwhile. ``pid`` is the process's
    number here, ``inner_pid`` what it calls itself in its container.

    Raises InputError: the descriptor is of no such memory, or of one that may shrink.
    """

    def __init__(self, descriptor: int, pid: int = 0) -> None:
        size, seals = os.fstat(descriptor).st_size, 0
        with suppress(OSError):  # no memfd
            seals = fcntl.fcntl(descriptor, _F_GET_SEALS)
        if not seals & _F_SEAL_SHRINK or not _HEADER.itemsize <= size <= _LARGEST:
            raise InputError("what was sent is no memory of a traced process")
        memory = mmap.mmap(descriptor, size, prot=mmap.PROT_READ)
        self.header: NDArray[Any] = np.frombuffer(memory, _HEADER, 1)
        magic, form, self.inner_pid, rings, records, objects, *_ = self.header[0].tolist()
        of_objects = _HEADER.itemsize + rings * _RING.itemsize
        of_records = of_objects + objects * RECORD.itemsize
        is_short = not records or size < of_records + rings * records * RECORD.itemsize
        if (magic, form) != (_MAGIC, _FORMAT) or is_short:
            raise InputError("what was sent is the memory of another version of chainshaper")
        self.pid = pid or self.inner_pid
        self._tids: dict[int, int] = {}
        self._rings = np.frombuffer(memory, _RING, rings, _HEADER.itemsize)
        self._objects = np.frombuffer(memory, RECORD, objects, of_objects)
        self._records = np.frombuffer(memory, RECORD, rings * records, of_records)
        self._records = self._records.reshape(rings, records)
        self._read = np.zeros(rings, np.uint64)
        self.lost = 0

    @property
    def dropped(self) -> int:
        """Events for which the process itself had no room."""
        return int(self.header["dropped"][0])

    def new_records(self) -> list[NDArray[Any]]:
        """What came into the rings since the last time, each ring's in the order of writing."""
        found = []
        for number in np.flatnonzero(self._rings["written"] != self._read):
            ring, read = self._records[number], int(self._read[number])
            written = int(self._rings["written"][number])
            if not read <= written < 1 << 62:  # the node has written where it should not
                self.lost += 1
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
                found.append(self._numbered(copied[whole - oldest :]))
        return found

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
        own = np.flatnonzero(records["event"] > _TEXT)
        texts: dict[int, dict[int, bytes]] = {}
        for at in np.flatnonzero(records["event"] == _TEXT):
            length, place = divmod(int(records["values"][at, 0]), _PLACES)
            said = texts.setdefault(int(np.searchsorted(own, at)) - 1, {})
            said[place] = (said.get(place, b"") + records["values"][at, 1:].tobytes())[:length]
        return self._numbered(records[own]), {
            number: {place: text.decode(errors="replace") for place, text in said.items()}
            for number, said in texts.items()
        }


def creation_tables(process: TracedProcess) -> tuple[dict[str, pl.DataFrame], TracingLibrary]:
    """The tables of what a process has created, and the tracing library behind ours."""
    objects, texts = process.objects()
    path = next((texts[int(n)][0] for n in np.flatnonzero(objects["event"] == _LIBRARY)), "")
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

            own, point = records.take(places), TracePoint(name, library.path, library)
            common = {one: np.ascontiguousarray(own[one]) for one in ("time", "tid", "cpu")}
            arguments = point.arguments
            if "sequence_number" in events.FIELDS[name]:
                known = [column for column in events.column_types(name) if column in _CALL]
                arguments = tuple(Argument(column, *_CALL[column]) for column in known)
            elif "thread_time" in events.column_types(name):
                arguments += (Argument("thread_time", _THREAD_TIME, "number"),)
            frame = pl.DataFrame({**common, "pid": pids[places]})
            tables[name] = event_table(point, arguments, frame, own["values"], said)
    return tables


VARIABLE = "CHAINSHAPER_TRACE"
_FILE = "libchainshaper_trace.so"
_BETWEEN_LOOKS_S = 0.1
_BETWEEN_SEARCHES_NS = 1_000_000_000
_OPTIONS = ("-O2", "-std=gnu11", "-shared", "-fPIC", "-ftls-model=initial-exec")
_LIBRARIES = ("-ldl", "-lpthread")
_REMEDY = "name another cache in $XDG_CACHE_HOME"
_CREDENTIALS = struct.Struct("iII")  # struct ucred: pid, uid, gid


def build_library(folder: Path) -> Path:
    """Compile the library into a folder. Raises: as :func:`compile_library`."""
    words = (*_OPTIONS, str(SOURCE), *_LIBRARIES)
    return compile_library("cc", words, folder / _FILE, ("--source preload", "--source lttng"))


def compile_library(
    compiler: Literal["cc", "c++"], words: Sequence[str], library: Path, options: tuple[str, str]
) -> Path:
    """Compile a library; ``options`` are the one that needs it and the one that does without.

    Raises PlatformError: there is no compiler, or it fails.
    """
    needs, without = options
    path = shutil.which(compiler, path=tool_environment()["PATH"])
    if path is None:
        package = {"cc": "gcc", "c++": "g++"}[compiler]
        raise PlatformError(
            f"`{needs}` needs a compiler ({compiler}), and there is none: install one (Debian and "
            f"Ubuntu: `apt-get install {package} libc6-dev`), or choose `{without}`"
        )
    library = library.absolute()
    command, environment = [path, "-o", str(library), *words], tool_environment()
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        last = "; ".join(done.stderr.splitlines()[-2:])
        raise PlatformError(f"{path} cannot compile {library.name}: {last}; see `{path} -v`")
    return library


def installed_library() -> Path:
    """The package's library, or the cache's, built at first use. Raises: as :func:`in_cache`."""
    if (shipped := SOURCE.with_name(_FILE)).exists():
        return shipped
    return in_cache(_FILE, [SOURCE.read_text("utf-8")], build_library)


def in_cache(name: str, sources: Iterable[str], build: Callable[[Path], Path]) -> Path:
    """A library of these sources in the user's cache, which ``build`` makes in a folder.

    Raises PlatformError: what ``build`` raises, or others may write to the cache.
    """
    content, cache = "\0".join([*sources, platform.machine()]).encode(), own_cache()
    library = cache / f"preload-{hashlib.sha256(content).hexdigest()[:16]}" / name
    existing = next(place for place in (cache, *cache.parents) if place.exists())
    if (reason := why_distrusted(existing)) is not None:
        raise PlatformError(f"no library is built in {cache}: {reason}; {_REMEDY}")
    if not library.exists():
        try:
            cache.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=cache) as folder:
                built = build(Path(folder))
                library.parent.mkdir(exist_ok=True)
                built.replace(library)  # whole, also where two of us build at once
        except OSError as error:
            why = f"{library} cannot be written ({error.strerror}): {_REMEDY}"
            raise PlatformError(why) from error
    if (reason := why_distrusted(library)) is not None:
        raise PlatformError(f"{library} is not loaded into nodes: {reason}; {_REMEDY}")
    return library


def preloading(library: Path) -> str:
    """`LD_PRELOAD` with the library in front of what it names. Raises PlatformError: it cannot."""
    if re.search(r"[\s:]", str(library)):
        why = f"{str(library)!r} has a space or a colon in it, so LD_PRELOAD cannot name it"
        raise PlatformError(f"{why}: {_REMEDY}")
    before = os.environ.get("LD_PRELOAD", "").split(":")
    return ":".join([str(library), *(one for one in before if one and one != str(library))])


NO_PROCESS = (
    "no process of these users runs with the library in front: set what `chainshaper watch "
    "--environment` prints before the application is started, or name its user (--user)"
)
_MEMORY = re.compile(r"/memfd:chainshaper-trace\b")


def memories(users: Collection[int], known: Collection[int]) -> Iterator[tuple[int, TracedProcess]]:
    """Processes of some users that have the library in front, but for those that are ``known``."""
    running = (int(name) for name in os.listdir("/proc") if name.isdigit())  # noqa: PTH208
    for pid in {*running}.difference(known):
        with suppress(OSError):  # it has ended, or may not be looked into
            if Path(f"/proc/{pid}").stat().st_uid not in users:
                continue
            own = innermost_id(read_proc(f"/proc/{pid}/status"))
            for descriptor in Path(f"/proc/{pid}/fd").iterdir():
                if _MEMORY.match(str(descriptor.readlink())):
                    with suppress(InputError), descriptor.open("rb") as file:
                        memory = TracedProcess(file.fileno(), pid)
                        if memory.inner_pid == own:  # else it is one that reads it, as we do
                            yield pid, memory
                            break


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
        self._found: set[int] = set()  # attached to, by the ids that they have here
        self._searched_ns = 0

    def start(self) -> Mapping[str, str]:
        """Wait for the processes that have the library, or take those that run with it."""
        self._clock_offset_ns = clock_offset()
        if self._attaches:
            self._search()
            if not self._processes:
                raise OperationError(f"{NO_PROCESS}, or attach with `--source ebpf`")
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
        return {"LD_PRELOAD": preloading(library), VARIABLE: name}

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
            file.unlink(missing_ok=True)  # the tables have all of it
            created, library = creation_tables(process)
            pids = np.full(records.size, process.pid, np.int32)
            versions.append(library.version)
            parts += (created, event_tables(records, pids, library))
        tables = joined_tables(parts)
        lost = sum(process.lost + process.dropped for process in self._processes)
        notes = [f"{self._failure}."] if self._failure else []
        if lost:
            notes.append(f"{lost} events were lost: recording did not run often enough for them.")
        facts = {"clock_offset_ns": self._clock_offset_ns, "notes": tuple(notes)}
        facts |= {"pid_namespace": own_pid_namespace()}
        return tables, info_of("preload", tables, versions, self._names, lost, **facts)

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

    def _welcome(self) -> None:
        """Take the memories that were sent, for as long as it is until the next look."""
        with suppress(TimeoutError):
            while not self._over.is_set():
                peer, _ = self._socket.accept()
                with peer:
                    self._take_memory(peer)

    def _search(self) -> None:
        """Processes with the library that are new, once a second."""
        if time.monotonic_ns() - self._searched_ns < _BETWEEN_SEARCHES_NS:
            return
        self._searched_ns = time.monotonic_ns()
        family = descendants(parents(), *self._pids)
        for pid, process in memories(self._users, self._found):
            if not self._pids or pid in family:
                self._found.add(pid)
                self._processes.append(process)

    def _take_memory(self, peer: socket.socket) -> None:
        """The memory of one process, which runs as one of the users that are recorded."""
        credentials = peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        pid, user, _ = _CREDENTIALS.unpack(credentials)
        peer.settimeout(_BETWEEN_LOOKS_S)
        try:
            _, descriptors, _, _ = socket.recv_fds(peer, 64, 1)
        except OSError:
            return
        for descriptor in descriptors:
            with suppress(InputError):
                if user in self._users:
                    process = TracedProcess(descriptor, pid)
                    self._processes.append(process)
                    with suppress(OSError):
                        self._names[process.pid] = Path(f"/proc/{pid}/comm").read_text().strip()
            os.close(descriptor)

    def _read_all(self) -> None:
        for place, process in enumerate(self._processes):
            if parts := process.new_records():
                with self._file(place).open("ab") as file:
                    file.writelines(part.tobytes() for part in parts)
