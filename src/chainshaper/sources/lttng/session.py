"""Tracing with LTTng: a recording session of our own, from its buffers to the trace on disk.

Events go through ring buffers in shared memory, one per core and user, from which a consumer
daemon writes them to disk. When a buffer is full, events are discarded and counted. `ros2 trace`
has 64 KiB a core; here it is 4 MiB where there is that much shared memory: at 60 bytes an event,
70,000 events a core that the consumer, an ordinary thread beside real-time ones, may be late with.

When events are lost all the same, tracing moves to a session with buffers four times as large while
the application runs on: LTTng cannot add buffers to a session that has been started. What was lost
until then stays lost and is counted, and what happens between the two sessions (some milliseconds)
is not recorded, which a note says.

A session daemon that ran before ours may trace other applications too (:mod:`.daemon`). What they
did is left out of the tables: a second run of the same nodes would make two of every chain. A
process is the command's if it descends from us, or has a mark of ours in its environment: a
daemon process, whose parent is gone, still has that, and what `sudo` starts, which has lost it,
descends.

`sched_switch`, for execution times, comes from the kernel tracer where there is one and we may use
it.

Upstream: lttng-enable-channel(1), `tracetools_trace` of ros2_tracing (events, contexts, buffers).
"""

import os
import shutil
import time
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import polars as pl

from chainshaper.linux.processes import descendants
from chainshaper.linux.threads import parents, read_proc
from chainshaper.linux.processes import process_folder, run_users, user_in
from chainshaper.sources.lttng.daemon import Lttng, connect
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.events import EventTables
from chainshaper.values.recording import RecordingInfo

__all__ = ["LttngSession", "buffer_size"]

EVENTS = ("ros2:*", "ros2_caret:*", "dds:*")
"""Everything that `tracetools` of any distribution, CARET, and a traced Cyclone DDS emit."""
CONTEXTS = ("procname", "vpid", "vtid")
REGISTER_TIMEOUT_MS = 30_000
"""A starting process waits that long for the session daemon, which many may keep busy at once."""

MARK = "CHAINSHAPER_RECORDING"
"""In the environment of the command, and of everything that it starts."""

MIB = 1 << 20
DEFAULT_BUFFER = 4 * MIB
_SUB_BUFFERS = 4
_SMALLEST = _SUB_BUFFERS * 4096
_ENLARGED_BY = 4


class LttngSession:
    """Records with LTTng: a :class:`~chainshaper.sources.Tracer`.

    ``buffer`` is the size of the ring buffer of each core in bytes; by default what is enough for
    most applications and fits into the machine's shared memory.
    """

    def __init__(
        self,
        folder: Path,
        command: Sequence[str],
        pids: Sequence[int],
        buffer: int | None = None,
        users: Collection[int] | None = None,
    ) -> None:
        if pids or not command:
            raise InputError(
                "LTTng does not trace processes that run already: give the COMMAND that starts "
                "the application behind `--`, or attach with `--source ebpf`"
            )
        self._folder = folder
        self._buffer = buffer_size(wanted=buffer)
        self._users = run_users() if users is None else users
        self._lttng: Lttng | None = None
        self._kernel = False
        self._strangers: set[int] = set()
        self._sessions: list[str] = []
        self._notes: list[str] = []

    def start(self) -> Mapping[str, str]:
        """Have a session daemon, and a session that is on."""
        self._lttng = connect()
        self._kernel = self._kernel_tracer(self._lttng)
        self._lttng.ask("start", self._new_session(self._lttng))
        timeout = str(REGISTER_TIMEOUT_MS)
        environment = {"LTTNG_UST_REGISTER_TIMEOUT": timeout, MARK: self._sessions[0]}
        return {**environment, **self._lttng.environment}

    def failure(self) -> str | None:
        """Look whether the daemon is there and the session loses nothing; enlarge the buffers."""
        if self._lttng is None:
            return None
        self._look_for_strangers(self._lttng)
        try:
            if self._discarded(self._lttng):
                self._enlarge(self._lttng)
        except OperationError as error:
            daemon = self._lttng.daemon
            if daemon is not None and daemon.poll() is not None:
                return f"the LTTng session daemon ended with code {daemon.returncode}"
            return str(error)
        return None

    def stop(self) -> None:
        """Stop the session; LTTng waits until its buffers are on disk."""
        if self._lttng is not None and self._sessions:
            self._look_for_strangers(self._lttng)
            self._lttng.ask("stop", self._sessions[-1])

    def remove(self) -> None:
        """Destroy the sessions, and end the daemon if it is ours."""
        if self._lttng is None:
            return
        for name in self._sessions:
            with suppress(OperationError):
                self._lttng.ask("destroy", name)
        self._lttng.close()
        self._lttng = None

    def recording(self) -> tuple[EventTables, RecordingInfo]:
        """The trace that was written."""
        tables: EventTables = {}
        if any(self._folder.rglob("metadata")):
            from chainshaper.sources.lttng.trace import open_lttng_trace

            trace = open_lttng_trace([self._folder])
            tables, info = _without_processes(self._strangers, trace.events, trace.info)
        if not any(tables[name].height for name in tables):
            shutil.rmtree(self._folder)  # other applications' events are in it at most
            self._folder.mkdir()
            raise OperationError(
                "no process with LTTng trace points was seen: is tracing compiled into this ROS 2 "
                "(`ros2 run tracetools status`), and do the nodes run as your user, here and not "
                "in a container? `--source ebpf` does not need LTTng"
            )
        notes = [*info.notes, *self._notes]
        if lost := sum(info.lost.values()):
            larger = self._buffer * (1 if len(self._sessions) > 1 else _ENLARGED_BY)
            notes.append(
                f"{lost} events were lost: buffers were too small. Record again with `--buffer "
                f"{max(1, larger // MIB)}` (MiB a core)."
            )
        return tables, info.model_copy(update={"notes": tuple(notes)})

    def _look_for_strangers(self, lttng: Lttng) -> None:
        """Note who else runs, if the daemon is not ours and so hears every application."""
        if lttng.daemon is None:
            others, own = _processes_apart(f"{MARK}={self._sessions[0]}", self._users)
            self._strangers = (self._strangers | others) - own

    def _kernel_tracer(self, lttng: Lttng) -> bool:
        try:
            lttng.ask("list", "--kernel")
        except OperationError as error:
            reason = str(error).partition("failed: ")[2]
            self._notes.append(
                f"no execution times, since LTTng cannot record sched_switch here: {reason}. It "
                "needs its kernel modules (`apt-get install lttng-modules-dkms`), and root or the "
                "group `tracing`; `--source ebpf` needs root only."
            )
            return False
        return True

    def _new_session(self, lttng: Lttng) -> str:
        """Prepare a session with buffers of the present size; its name."""
        number = len(self._sessions) + 1
        name = f"{lttng.home.name}-{number}"
        output = self._folder.absolute() / f"session-{number}"
        # LTTng 2.15 began to write CTF 2, which no analysis reads yet.
        old_format = ("--trace-format=ctf-1.8",) if _version(lttng) >= (2, 15) else ()
        lttng.ask("create", name, f"--output={output}", *old_format)
        self._sessions.append(name)
        size = f"--subbuf-size={self._buffer // _SUB_BUFFERS}"
        # The application need not wake the consumer, which looks every 200 ms.
        channel: tuple[str, ...] = (size, f"--num-subbuf={_SUB_BUFFERS}", f"--session={name}")
        channel += ("--discard", "--switch-timer=0", "--read-timer=200000", "events")
        of_channel = (f"--session={name}", "--channel=events")
        lttng.ask("enable-channel", "--userspace", "--buffers-uid", *channel)
        lttng.ask("enable-event", "--userspace", *of_channel, ",".join(EVENTS))
        contexts = [f"--type={context}" for context in CONTEXTS]
        lttng.ask("add-context", "--userspace", *of_channel, *contexts)
        if self._kernel:
            lttng.ask("enable-channel", "--kernel", *channel)
            lttng.ask("enable-event", "--kernel", *of_channel, "sched_switch")
        return name

    def _discarded(self, lttng: Lttng) -> int:
        answer = lttng.ask("list", self._sessions[-1])
        kinds = ("discarded_events", "lost_packets")
        counts = (found.text for kind in kinds for found in answer.iterfind(f".//{{*}}{kind}"))
        return sum(int(count or 0) for count in counts)

    def _enlarge(self, lttng: Lttng) -> None:
        """Go on in a session with larger buffers, if there is room for it."""
        before, larger = self._buffer, buffer_size(wanted=self._buffer * _ENLARGED_BY)
        if larger <= before:
            return
        former, self._buffer = self._sessions[-1], larger
        successor = self._new_session(lttng)
        stopped = time.monotonic_ns()
        lttng.ask("stop", former, "--no-wait")
        lttng.ask("start", successor)
        gap = time.monotonic_ns() - stopped
        lttng.ask("destroy", former)  # once all of it is on disk
        self._notes.append(
            f"events were lost, so the buffers were enlarged from {before >> 10} KiB to "
            f"{larger >> 10} KiB a core while the application ran; nothing was recorded for "
            f"{format_duration(round(gap, -6))} meanwhile."
        )


def buffer_size(
    wanted: int | None = None, free: int | None = None, cores: int | None = None
) -> int:
    """The ring buffer of each core in bytes: what is wanted, as far as shared memory goes.

    The buffers of all cores get half of the ``free`` bytes of /dev/shm at most; with more, LTTng
    could not make them, and would record nothing. A power of two.
    """
    cores = cores or os.sysconf("SC_NPROCESSORS_CONF")
    if free is None:
        free = shutil.disk_usage("/dev/shm").free if Path("/dev/shm").is_dir() else 0  # noqa: S108
    affordable = max(_SMALLEST, free // 2 // cores)
    size = min(wanted or DEFAULT_BUFFER, affordable)
    return max(_SMALLEST, 1 << (size.bit_length() - 1))


def _version(lttng: Lttng) -> tuple[int, int]:
    answer = lttng.ask("version")
    major, minor = (answer.findtext(f".//{{*}}{name}") for name in ("major", "minor"))
    return int(major or 0), int(minor or 0)


def _processes_apart(mark: str, users: Collection[int]) -> tuple[set[int], set[int]]:
    """The living processes that others have started, and those that we have.

    The ``mark`` counts in processes of these ``users``: others can read and write it as well.
    """
    parent_of = parents()
    unrelated = set(parent_of) - descendants(parent_of, os.getpid())
    others = {pid for pid in unrelated if not _is_marked(pid, mark, users)}
    return others, set(parent_of) - others


def _is_marked(pid: int, mark: str, users: Collection[int]) -> bool:
    try:
        with process_folder(pid) as folder:
            marked = mark.encode() in read_proc("environ", folder).split(b"\0")
            return marked and user_in(folder) in users
    except OSError:  # it has ended, or is another user's
        return False


def _without_processes(
    strangers: Collection[int], tables: EventTables, info: RecordingInfo
) -> tuple[EventTables, RecordingInfo]:
    """The events without those of processes that are none of the command's, if there are any."""
    traced = (frame["pid"].drop_nulls().unique() for frame in tables.values())
    foreign = sorted({pid for pids in traced for pid in pids} & set(strangers))
    if not foreign:
        return tables, info
    is_own = ~pl.col("pid").is_in(foreign).fill_null(False)
    own = {name: frame.filter(is_own) for name, frame in tables.items()}
    names = ", ".join(f"{pid} {info.processes.get(pid, '')}".strip() for pid in foreign)
    note = f"processes that the command has not started are left out: {names}."
    facts = {
        "processes": {pid: name for pid, name in info.processes.items() if pid not in foreign},
        "notes": (*info.notes, note),
        "trace_events": {
            name if name == "sched_switch" else f"ros2:{name}": frame.height
            for name, frame in own.items()
        },
    }
    return own, info.model_copy(update=facts)
