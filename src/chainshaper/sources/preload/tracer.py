"""The tracer: it collects memories of traced processes, and reads them ten times a second."""

import os
import secrets
import socket
import struct
import threading
import time
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import polars as pl

from chainshaper.linux.processes import descendants, run_users
from chainshaper.linux.threads import parents
from chainshaper.robot.clocks import clock_offset
from chainshaper.sources.preload import named_loops
from chainshaper.sources.preload.in_front import VARIABLE, in_front, installed_library
from chainshaper.sources.preload.memory import RECORD, TracedProcess
from chainshaper.sources.preload.running import NO_PROCESS, left_out, memories, name_of
from chainshaper.sources.preload.tables import creation_tables, event_tables, joined_tables
from chainshaper.sources.system import info_of, own_pid_namespace
from chainshaper.values.errors import InputError, OperationError, text_of
from chainshaper.values.events import EventTables
from chainshaper.values.files import open_output
from chainshaper.values.recording import RecordingInfo

_BETWEEN_LOOKS_S = 0.1
_BETWEEN_SEARCHES_NS = 1_000_000_000
_CREDENTIALS = struct.Struct("iII")  # struct ucred: pid, uid, gid


class PreloadTracer:
    """Records with the library in front: a :class:`~chainshaper.sources.Tracer`.

    A thread of its own reads the memories, until ``stop``. ``loops`` are names of nodes and of
    threads.

    Raises InputError: a loop cannot have such a name.
    """

    def __init__(
        self,
        folder: Path,
        command: Sequence[str],
        pids: Sequence[int],
        users: Collection[int] | None = None,
        loops: Sequence[str] = (),
    ) -> None:
        self._loops, self._loops_text = loops, named_loops.names_text(loops)
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
        self._known: set[int] = set()  # processes attached to or refused, by the ids they have here
        self._searched_ns = 0

    def start(self) -> Mapping[str, str]:
        """Wait for the processes that have the library, or take those that run with it."""
        self._clock_offset_ns = clock_offset()
        if self._attaches:
            self._search()
            if not self._processes:
                why = "; ".join(sentence.rstrip(".") for sentence in self._refused) or NO_PROCESS
                raise OperationError(f"{why}, or attach with `--source ebpf`")
            self._refuse_unnamed()
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
        return {**in_front(library), VARIABLE: name, named_loops.VARIABLE: self._loops_text}

    def _refuse_unnamed(self) -> None:
        """Refuse loops that the processes were not started with: only then their sleeps are seen.

        Raises InputError.
        """
        created = [creation_tables(process)[0] for process in self._processes if self._loops]
        if missing := named_loops.not_named(self._loops, joined_tables(created)):
            raise InputError(
                f"no process that runs has met the loop {', '.join(missing)}: names are read when a"
                f" process starts, so start the robot behind `{named_loops.STARTED_SO}`; or the"
                " name is wrong: `chainshaper graph` shows nodes, `ps -eLo pid,comm` threads"
            )

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
        parts, versions = list[dict[str, pl.DataFrame]](), list[str | None]()
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
        notes += named_loops.notes(self._loops, tables)
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
        """Take the memories that processes send, until the next look.

        A process that connects all the time does not keep the others' memories from being read.
        """
        until = time.monotonic() + _BETWEEN_LOOKS_S
        with suppress(TimeoutError):
            while not self._over.is_set() and time.monotonic() < until:
                peer, _ = self._socket.accept()
                with peer:
                    self._take_memory(peer)

    def _search(self) -> None:
        """Look for new processes with the library, once a second."""
        if time.monotonic_ns() - self._searched_ns < _BETWEEN_SEARCHES_NS:
            return
        self._searched_ns = time.monotonic_ns()
        family = descendants(parents(), *self._pids)

        def refuse(pid: int, why: str) -> None:
            if not self._pids or pid in family:
                self._known.add(pid)
                self._refused.append(why)

        for pid, process in memories(self._users, self._known, refuse):
            if not self._pids or pid in family:
                self._known.add(pid)
                self._processes.append(process)

    def _take_memory(self, peer: socket.socket) -> None:
        """Take the memory that a process of a recorded user sends."""
        credentials = peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        pid, user, _ = _CREDENTIALS.unpack(credentials)
        if user not in self._users:
            return
        peer.settimeout(_BETWEEN_LOOKS_S)
        try:
            message, descriptors, _, _ = socket.recv_fds(peer, 64, 1)
        except OSError:
            return
        sent_name = text_of(message.partition(b"\0")[0])
        for descriptor in descriptors:
            try:
                process = TracedProcess(descriptor, pid)
            except (InputError, OSError) as error:
                self._refused.append(left_out(pid, error, sent_name))
            else:
                self._processes.append(process)
                self._names[process.pid] = sent_name
                with suppress(OSError):  # it has ended
                    self._names[process.pid] = name_of(pid)
            os.close(descriptor)

    def _read_all(self) -> None:
        for place, process in enumerate(self._processes):
            if parts := process.new_records():
                flags = os.O_WRONLY | os.O_APPEND
                with os.fdopen(open_output(self._file(place), flags), "ab") as file:
                    file.writelines(part.tobytes() for part in parts)
