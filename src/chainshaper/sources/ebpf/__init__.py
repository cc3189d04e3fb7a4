"""Tracing with eBPF: bpftrace sets uprobes on the library that every ROS 2 node has.

A uprobe belongs to a file: it is set before the first process maps the file, and it also traces
processes that run already (`docs/record_ebpf.md`). bpftrace sets and removes probes one after the
other, so events before the last one is set, or after the first one is removed, are left out.

Upstream: bpftrace(8); `src/bpftrace.cpp` of bpftrace 0.17 to 0.26.
"""

import os
import re
import signal
import subprocess
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl

from chainshaper.linux.child_processes import is_installed, tool_environment
from chainshaper.linux.processes import descendants, run_users, user_name, user_of
from chainshaper.linux.scheduling import signalled_with_parent
from chainshaper.linux.threads import parents, read_proc, read_stat, status_field
from chainshaper.robot.clocks import clock_offset
from chainshaper.sources.ebpf import trace_points as tp
from chainshaper.sources.ebpf.functions import callback_functions
from chainshaper.sources.ebpf.late_attachment import ADDED, with_found_objects, with_functions
from chainshaper.sources.system import info_of, own_pid_namespace
from chainshaper.sources.tracing_library import (
    LIBRARY,
    TracingLibrary,
    installed_libraries,
    mapped_libraries,
)
from chainshaper.values import events
from chainshaper.values.errors import InputError, OperationError, PlatformError
from chainshaper.values.events import EventTables
from chainshaper.values.files import open_output, open_regular, write_whole
from chainshaper.values.recording import RecordingInfo

_ATTACHED = "__BPFTRACE_NOTIFY_PROBES_ATTACHED"
"""A variable that has bpftrace print this same word when all probes are set."""
_PAGES = "BPFTRACE_PERF_RB_PAGES"
_SETTINGS = {
    _ATTACHED: "1",
    _PAGES: "1024",  # 4 MiB (a core, before 0.21): some 50,000 events
    "BPFTRACE_MAP_KEYS_MAX": "65536",  # until 0.18; its name since then:
    "BPFTRACE_MAX_MAP_KEYS": "65536",
    "BPFTRACE_MAX_PROBES": "4096",
    "BPFTRACE_MAX_BPF_PROGS": "4096",
    "BPFTRACE_CACHE_USER_SYMBOLS": "0",
}
_LOST = re.compile(rb"^Lost (\d+) events", re.MULTILINE)
_NICE = 10
_SHORTEST_SUSPENSION_NS = 1_000_000
_START_S, _READ_S, _STOP_S = 120.0, 10.0, 60.0
"""The most time that bpftrace gets to set its probes, to read its buffers, and to end."""
_LOOK_S = 0.02
"""Between two looks at a bpftrace that is waited for."""
_CAP_SYS_ADMIN, _CAP_PERFMON, _CAP_BPF = 21, 38, 39
_FIRST_PID_NAMESPACE = 4026531836  # linux/proc_ns.h: PROC_PID_INIT_INO


class EbpfTracer:
    """Records with bpftrace: a :class:`~chainshaper.sources.Tracer`."""

    def __init__(
        self,
        folder: Path,
        command: Sequence[str],
        pids: Sequence[int],
        users: Collection[int] | None = None,
    ) -> None:
        files = ("events.bt", "events.txt", "bpftrace.log")
        self._script, self._events, self._log = map(folder.absolute().joinpath, files)
        self._attaches, self._pids = not command, tuple(pids)
        self._users = run_users() if users is None else users
        self._open: dict[Path, int] = {}  # library → our descriptor of it
        self._points: tuple[tp.TracePoint, ...] = ()
        self._bpftrace: subprocess.Popen[bytes] | None = None
        self._began_ns = 0  # when all probes were set, ns of CLOCK_MONOTONIC
        self._ended_ns: int | None = None  # when the first probe began to be removed
        self._ahead_ns = 0  # CLOCK_BOOTTIME, which bpftrace reads, minus CLOCK_MONOTONIC
        self._clock_offset_ns = 0
        self._notes: list[str] = []
        self._printed: tp.Printed | None = None
        self._functions: dict[tuple[int, int], str] = {}  # see `callback_functions`

    def start(self) -> Mapping[str, str]:
        _check_privileges()
        if not is_installed("bpftrace"):
            raise PlatformError(
                "bpftrace is not installed: install it (Debian and Ubuntu: `apt-get install "
                "bpftrace`; 0.17 or later), or record with `--source lttng`"
            )
        self._points = tp.trace_points(self._libraries())
        for file in dict.fromkeys(point.file for point in self._points):
            try:
                self._open[file] = open_regular(file)
            except OSError as error:
                raise OperationError(f"{file}: cannot be traced: {error}") from error
        # The script that root runs names our descriptors: the owner of a folder chooses its path,
        # and may later put another file there.
        descriptors = Path(f"/proc/{os.getpid()}/fd")
        points = [
            replace(point, file=descriptors / str(self._open[point.file])) for point in self._points
        ]
        script = tp.bpftrace_script(
            points, self._traced(), users=self._users, attached=self._attaches
        )
        write_whole(self._script, [script.encode()])
        self._clock_offset_ns, self._ahead_ns = clock_offset(), _boot_time_ahead()
        write_whole(self._log, [])
        write_whole(self._events, [tp.HEADER.encode()])
        flags = os.O_WRONLY | os.O_APPEND
        outputs = [os.fdopen(open_output(f, flags), "ab") for f in (self._events, self._log)]
        with outputs[0] as printed, outputs[1] as log:
            self._bpftrace = subprocess.Popen(
                ["bpftrace", "-B", "full", str(self._script)],
                env={**_SETTINGS, **tool_environment()},
                stdin=subprocess.DEVNULL,
                stdout=printed,
                stderr=log,
                start_new_session=True,  # Ctrl-C does not reach it: we end it ourselves
                preexec_fn=partial(_in_the_background, os.getpid()),  # noqa: PLW1509
            )
        self._wait_until_attached(self._bpftrace)
        self._began_ns = time.monotonic_ns()
        return {}

    def failure(self) -> str | None:
        code = None if self._bpftrace is None else self._bpftrace.poll()
        if code is None:
            return None
        return f"bpftrace ended with code {code}: {self._complaint()}"

    def stop(self) -> None:
        if self._bpftrace is None or self._ended_ns is not None:
            return
        self._ended_ns = time.monotonic_ns()
        if _boot_time_ahead() - self._ahead_ns > _SHORTEST_SUSPENSION_NS:
            self._notes.append("the machine was suspended meanwhile: times after it are too late.")
        bpftrace, deadline = f"/proc/{self._bpftrace.pid}", time.monotonic() + _READ_S
        with suppress(OSError):  # it has ended
            time.sleep(_LOOK_S)
            # When it is told to end, it throws away what it has not read; it sleeps once it has
            # read everything.
            while read_stat(bpftrace)[1][0] == b"R" and time.monotonic() < deadline:
                time.sleep(_LOOK_S)
        self._bpftrace.send_signal(signal.SIGINT)
        try:
            self._bpftrace.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            late = f"bpftrace (process {self._bpftrace.pid}) did not end within {_STOP_S:.0f} s"
            self._notes.append(f"{late} and was killed: the last events are missing.")
            self._kill()
        with suppress(OSError, pl.exceptions.PolarsError):  # `recording` says what is wrong
            self._printed = tp.read_printed(self._events, self._points, self._ahead_ns)
            # Functions are in the memory of the application, so now, while it runs.
            callbacks = _callbacks(self._printed.tables)
            self._functions = callback_functions(
                (pid, callback)
                for pid, callback in callbacks
                if self._pids or user_of(pid) in self._users
            )

    def _kill(self) -> None:
        """Kill bpftrace; the kernel removes its probes with it."""
        if self._bpftrace is not None and self._bpftrace.poll() is None:
            self._bpftrace.kill()
            self._bpftrace.wait()

    def remove(self) -> None:
        self._kill()
        while self._open:
            os.close(self._open.popitem()[1])

    def recording(self) -> tuple[EventTables, RecordingInfo]:
        try:
            printed = self._printed or tp.read_printed(self._events, self._points, self._ahead_ns)
            lost = lost_events(self._events, self._log)
        except (OSError, pl.exceptions.PolarsError) as error:
            unread = "what bpftrace wrote cannot be read"
            raise OperationError(f"{self._events}: {unread}: {error}") from error
        ended = self._ended_ns or time.monotonic_ns()
        all_probes_set = pl.col("time").is_between(self._began_ns, ended)
        traced = ((name, table.filter(all_probes_set)) for name, table in printed.tables.items())
        tables: EventTables = {name: table for name, table in traced if table.height}
        notes = [*self._notes, *self._about(tables, printed, lost)]
        if self._attaches:
            tables, further = with_found_objects(tables, printed.handles, self._began_ns)
            notes += further
        tables = with_functions(tables, self._functions, self._began_ns)
        # Process → the name of its main thread as `sched_switch` has it.
        switches = events.table(tables, "sched_switch").select("next_tid", "next_comm")
        names = dict(switches.unique("next_tid", keep="last").iter_rows())
        emitting = (table["pid"] for name, table in tables.items() if name != "sched_switch")
        commands = {pid: names.get(pid) or "" for pids in emitting for pid in pids.unique()}
        versions = [point.tracing_library.version for point in self._points[:1]]
        facts: dict[str, Any] = {"rmw": printed.rmw, "notes": tuple(notes)}
        facts |= {"clock_offset_ns": self._clock_offset_ns, "pid_namespace": _FIRST_PID_NAMESPACE}
        return tables, info_of("ebpf", tables, versions, commands, lost, **facts)

    def written(self) -> None:
        """What bpftrace wrote stays beside the tables."""

    def _libraries(self) -> tuple[TracingLibrary, ...]:
        """Return the libraries to set probes on; raise PlatformError if there is none to trace."""
        libraries = self._mapped() if self._attaches else installed_libraries(os.environ)
        if not libraries:
            raise PlatformError(
                f"no {LIBRARY} in AMENT_PREFIX_PATH, LD_LIBRARY_PATH or /opt/ros: source the "
                "setup.bash of ROS 2; attach to an application in a container (no COMMAND)"
            )
        if not tp.trace_points(libraries):
            paths = ", ".join(str(library.path) for library in libraries)
            raise PlatformError(
                f"{paths}: exports no trace point: this ROS 2 was built without tracing "
                "(TRACETOOLS_DISABLED): build tracetools with it, or install ROS 2's packages"
            )
        return libraries

    def _mapped(self) -> tuple[TracingLibrary, ...]:
        """Return the libraries that the processes to attach to have mapped.

        Raises InputError: a process that was named neither has one nor has started one that has.
        OperationError: no process has one.
        """
        parent_of = parents()
        family = descendants(parent_of, *self._pids)
        mapped = mapped_libraries(
            pid for pid in parent_of if pid in family or user_of(pid) in self._users
        )
        unsuited = [pid for pid in self._pids if not descendants(parent_of, pid) & mapped.keys()]
        if unsuited:
            raise InputError(
                f"process {', '.join(map(str, unsuited))} neither uses {LIBRARY} nor has "
                "started what does: give processes of nodes (`chainshaper threads` lists them)"
            )
        wanted = family if self._pids else mapped.keys()
        libraries = dict.fromkeys(
            library for pid in mapped if pid in wanted for library in mapped[pid]
        )
        if not libraries:
            users = ", ".join(map(user_name, sorted(self._users)))
            raise OperationError(
                f"no process of {users} uses {LIBRARY}, so there is no ROS 2 node to attach to: "
                "start the application, give its COMMAND behind `--`, or name its --user"
            )
        return tuple(libraries)

    def _traced(self) -> tuple[int, ...]:
        """Return the processes that events are limited to, with all that they start.

        Empty: events are not limited to processes.
        """
        if self._attaches and not self._pids:
            return ()
        if own_pid_namespace() != _FIRST_PID_NAMESPACE:
            self._notes.append(
                "in a container bpftrace cannot tell processes apart: all of the same users on the "
                "machine that use the same libraries were recorded, by the machine's numbers."
            )
            return ()
        # The application does not run yet: it will be what we start.
        return tuple(sorted(descendants(parents(), *(self._pids or (os.getpid(),)))))

    def _wait_until_attached(self, bpftrace: "subprocess.Popen[bytes]") -> None:
        deadline = time.monotonic() + _START_S
        files = (self._log, self._events)  # since 0.23 it says so on its standard output
        while not any(_ATTACHED.encode() in file.read_bytes() for file in files):
            if bpftrace.poll() is not None:
                raise PlatformError(
                    f"bpftrace cannot trace here: {self._complaint()}; it needs a kernel with BPF, "
                    "uprobes and tracefs, and CAP_BPF, CAP_PERFMON and CAP_SYS_ADMIN (in a "
                    "container: `docker run --privileged --pid host`)"
                )
            if time.monotonic() > deadline:
                late = f"bpftrace did not set its probes within {_START_S:.0f} s"
                raise OperationError(f"{late}: {self._complaint()}")
            time.sleep(_LOOK_S)

    def _complaint(self) -> str:
        """Return what bpftrace says is wrong, as a single line."""
        log = self._log.read_text(errors="replace").splitlines()
        lines = [line.strip() for line in log if line.strip() and _ATTACHED not in line]
        errors = [line for line in lines if "ERROR" in line and "RLIMIT_MEMLOCK" not in line]
        return "; ".join(errors or lines[-1:]).replace("ERROR: ", "") or "it does not say why"

    def _about(self, tables: EventTables, printed: tp.Printed, lost: int) -> Iterator[str]:
        """Yield the notes on what is missing in the recording."""
        if not tables:
            libraries = dict.fromkeys(str(point.file) for point in self._points)
            yield f"no event was traced: nothing that ran has called {', '.join(libraries)}."
        unknown = set(_callbacks(tables)) - self._functions.keys()
        if unknown and "rclcpp_callback_register" not in tables:
            reason = "the application had ended, or its files were stripped"
            yield f"{len(unknown)} callbacks' functions have no name: {reason}."
        if lost:
            pages = os.environ.get(_PAGES, _SETTINGS[_PAGES])
            yield (
                f"{lost} events were lost: bpftrace could not keep up. Record again with larger "
                f"buffers ({_PAGES}, a power of two above {pages}), or leave it a less busy core."
            )
        if printed.cut_names:
            yield f"{printed.cut_names} names are longer than {tp.TEXT_BYTES} bytes and cut."


def lost_events(*paths: Path) -> int:
    """Count the events that bpftrace says, in these files, it has lost."""
    texts = (path.read_bytes() for path in paths if path.is_file())
    return sum(int(match[1]) for text in texts for match in _LOST.finditer(text))


def _in_the_background(parent_pid: int) -> None:
    """Make a new process end with its parent, and never pre-empt the threads that it traces."""
    signalled_with_parent(parent_pid, signal.SIGINT)
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    os.nice(_NICE)


def _callbacks(tables: EventTables) -> Iterator[tuple[int, int]]:
    """Yield (process, callback) of callbacks that were added, or that ran; some of them twice."""
    for name in (*ADDED, "callback_start"):
        yield from events.table(tables, name).select("pid", "callback").unique().iter_rows()


def _check_privileges() -> None:
    """Raise PlatformError where we may not trace.

    bpftrace would also refuse, but it would not say which other ways there are.
    """
    (granted,) = status_field(read_proc("/proc/self/status"), "CapEff", base=16)
    sufficient = all(granted >> capability & 1 for capability in (_CAP_BPF, _CAP_PERFMON))
    if not (sufficient or granted >> _CAP_SYS_ADMIN & 1):
        raise PlatformError(
            "tracing with eBPF needs root, or bpftrace 0.25 and the capabilities CAP_BPF, "
            "CAP_PERFMON, CAP_DAC_READ_SEARCH and CAP_DAC_OVERRIDE: start the application as "
            "yourself, then attach to it with `sudo chainshaper record --source ebpf -o REC "
            "--duration 30s`; or record with `--source lttng`, which needs neither"
        )


def _boot_time_ahead() -> int:
    """Return CLOCK_BOOTTIME minus CLOCK_MONOTONIC (ns): how long the machine was suspended."""
    ahead = clock_offset(time.CLOCK_BOOTTIME)
    return ahead if ahead > _SHORTEST_SUSPENSION_NS else 0
