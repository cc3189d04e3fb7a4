"""Tracing with LTTng: our recording session, and the session daemon that it needs.

If root's session daemon runs already, and we may use it (as root, or in the group `tracing`), we
add a session to it. That daemon traces the processes of all users, and the kernel, so we leave
other applications' events out of the tables.

Otherwise we start a daemon. It listens in a new home directory, which is the command's
`LTTNG_HOME`, so it traces the command alone. Root's run directory is always /var/run/lttng; so for
a daemon of root, and its clients, another directory is mounted there, in mount namespaces of their
own. Where root may not mount, there can be a single recording at a time.

If we are killed, the kernel ends the daemon that we have started. A shell that waits for our end
destroys our sessions in root's daemon, and removes the home directory.

Upstream: lttng(1), lttng-sessiond(8), lttng-enable-channel(1); lttng-tools, `utils_get_rundir`;
lttng-ust, `setup_local_apps`; `tracetools_trace` of ros2_tracing.
"""

import os
import shlex
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import polars as pl

from chainshaper.linux.child_processes import is_installed, tool_environment
from chainshaper.linux.processes import descendants, process_folder, run_users, user_in
from chainshaper.linux.scheduling import signalled_with_parent
from chainshaper.linux.threads import parents, read_proc
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError, PlatformError
from chainshaper.values.events import EventTables
from chainshaper.values.files import open_output
from chainshaper.values.recording import RecordingInfo

EVENTS = "ros2:*,ros2_caret:*,dds:*"
"""Everything that `tracetools` of any distribution, CARET, and a traced Cyclone DDS emit."""
MARK = "CHAINSHAPER_RECORDING"
"""A variable of the command and of all that it starts, by which we recognise its processes."""

MIB = 1 << 20
DEFAULT_BUFFER = 4 * MIB
_SUB_BUFFERS = 4
_SMALLEST = _SUB_BUFFERS * 4096
_ENLARGED_BY = 4
_ANSWER_S, _START_S = 60.0, 15.0

_PACKAGES = (
    "install LTTng (Debian and Ubuntu: `apt-get install lttng-tools liblttng-ust-dev`), or record "
    "with `--source ebpf`, which needs neither"
)
_RUN_DIRECTORY = Path("/var/run/lttng")
_APART = (
    *("unshare", "--mount", "--propagation=slave", "sh", "-c"),
    f'mkdir -p {_RUN_DIRECTORY} && mount --bind "$0" {_RUN_DIRECTORY} && exec "$@"',
)
_AFTERWARDS = """
read -r _
for name in $(timeout 60 lttng --no-sessiond --mi xml list | grep -o "$0-[0-9]*"); do
    timeout 60 lttng --no-sessiond destroy "$name"
done
rm -rf "$LTTNG_HOME"
"""


class LttngSession:
    """Records with LTTng: a :class:`~chainshaper.sources.Tracer`.

    * ``buffer``: the size of the ring buffer of each core in bytes (:func:`buffer_size`).
    * ``home``: a new directory; names of sessions begin with its unique name.
    * ``daemon``: the session daemon, where we have started it.
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
        self._folder, self._buffer = folder, buffer_size(wanted=buffer)
        self._users = run_users() if users is None else users
        self.home = Path()
        self.daemon: subprocess.Popen[bytes] | None = None
        self._environment: Mapping[str, str] = {}
        self._inside: tuple[str, ...] = ()  # what commands begin with that see its run directory
        self._afterwards: subprocess.Popen[bytes] | None = None  # clears up when we are gone
        self._kernel = False
        self._strangers: set[int] = set()
        self._sessions: list[str] = []
        self._notes: list[str] = []

    def start(self) -> Mapping[str, str]:
        if not is_installed("lttng"):
            raise PlatformError(f"the command `lttng` is not there: {_PACKAGES}")
        # Sockets lie in it, whose paths may have 108 characters only: not beside the recording.
        self.home = Path(tempfile.mkdtemp(prefix="chainshaper-lttng-"))
        self._environment = {**tool_environment(), "LTTNG_HOME": str(self.home)}
        self._afterwards = subprocess.Popen(
            ["sh", "-c", _AFTERWARDS, self.home.name],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            **{**self._apart(), "stdin": subprocess.PIPE},  # ends with us, however that happens
        )
        answers = self._answers()
        if not answers or _hears_one_command_only():
            self._start_daemon(another=answers)
        try:
            self._ask("list", "--kernel")
            self._kernel = True
        except OperationError as error:
            reason = str(error).partition("failed: ")[2]
            self._notes.append(
                f"no execution times, since LTTng cannot record sched_switch here: {reason}. It "
                "needs its kernel modules (`apt-get install lttng-modules-dkms`), and root or the "
                "group `tracing`; `--source ebpf` needs root only."
            )
        self._ask("start", self._new_session())
        # A process that starts waits that long (ms) for the session daemon, which may be busy.
        environment = {"LTTNG_UST_REGISTER_TIMEOUT": "30000", MARK: self._sessions[0]}
        if self.daemon is not None:
            environment["LTTNG_HOME"] = str(self.home)
        return environment

    def failure(self) -> str | None:
        """Look whether the daemon is there and the session loses nothing; enlarge the buffers."""
        if not self._sessions:
            return None
        self._look_for_strangers()
        try:
            answer = self._ask("list", self._sessions[-1])
            counts = [
                element.text
                for kind in ("discarded_events", "lost_packets")
                for element in answer.iterfind(f".//{{*}}{kind}")
            ]
            if sum(int(count or 0) for count in counts):
                self._enlarge()
        except OperationError as error:
            if self.daemon is not None and self.daemon.poll() is not None:
                return f"the LTTng session daemon ended with code {self.daemon.returncode}"
            return str(error)
        return None

    def stop(self) -> None:
        """Stop the session; LTTng waits until its buffers are on disk.

        If that fails, a note says so: the events on disk can be used anyway.
        """
        if self._sessions:
            self._look_for_strangers()
            try:
                self._ask("stop", self._sessions[-1])
            except OperationError as error:
                self._notes.append(f"the last events may be missing: {error}.")

    def remove(self) -> None:
        if self._afterwards is None:
            return
        for name in self._sessions:
            with suppress(OperationError):
                self._ask("destroy", name)
        if self.daemon is not None:
            self.daemon.terminate()
            with suppress(subprocess.TimeoutExpired):
                self.daemon.wait(_START_S)
            self.daemon.kill()
            self.daemon.wait()
        self._afterwards.communicate()
        self._afterwards = None

    def recording(self) -> tuple[EventTables, RecordingInfo]:
        tables: EventTables = {}
        if any(self._folder.rglob("metadata")):
            from chainshaper.sources.lttng.trace import open_lttng_trace

            trace = open_lttng_trace([self._folder])
            tables, info = _without_processes(self._strangers, trace.events, trace.info)
        if not any(table.height for table in tables.values()):
            shutil.rmtree(self._folder)  # other applications' events are in it at most
            self._folder.mkdir()
            raise OperationError(
                "no process with LTTng trace points was seen: is tracing compiled into this ROS 2 "
                "(`ros2 run tracetools status`), and do the nodes run as your user, here and not "
                "in a container? `--source ebpf` does not need LTTng"
            )
        notes = [*info.notes, *self._notes]
        if lost := sum(info.lost.values()):
            larger = self._buffer
            if len(self._sessions) == 1:  # else it was enlarged already
                larger *= _ENLARGED_BY
            remedy = f"Record again with `--buffer {max(1, larger // MIB)}` (MiB a core)."
            notes.append(f"{lost} events were lost: buffers were too small. {remedy}")
        return tables, info.model_copy(update={"notes": tuple(notes)})

    def written(self) -> None:
        """What was traced stays beside the tables."""

    def _apart(self) -> dict[str, Any]:
        """Return how commands run: in a session of their own, since we react to Ctrl-C."""
        return {"env": self._environment, "stdin": subprocess.DEVNULL, "start_new_session": True}

    def _ask(self, *arguments: str) -> ElementTree.Element:
        """Return the answer of `lttng ARGUMENTS`. Raises OperationError, in its words: it fails."""
        command = [*self._inside, "lttng", "--no-sessiond", "--mi", "xml", *arguments]
        options = {**self._apart(), "capture_output": True, "timeout": _ANSWER_S}
        shown = f"`{shlex.join(('lttng', *arguments))}`"
        try:
            run = subprocess.run(
                command, encoding="utf-8", errors="replace", check=False, **options
            )
            if run.returncode == 0:
                return ElementTree.fromstring(run.stdout)  # noqa: S314 - LTTng's own, no stranger's
        except (OSError, subprocess.TimeoutExpired) as error:
            raise OperationError(f"{shown} does not answer: {error}") from None
        except ElementTree.ParseError as error:
            raise OperationError(f"{shown} answers no XML: {error}") from None
        problem = run.stderr.strip().rpartition("\n")[2].removeprefix("Error: ")
        raise OperationError(f"{shown} failed: {problem or f'exit code {run.returncode}'}")

    def _answers(self) -> bool:
        """Return whether a session daemon answers."""
        with suppress(OperationError):
            self._ask("list")
            return True
        return False

    def _start_daemon(self, *, another: bool) -> None:
        """Start a daemon of ours, with a run directory of its own if there is ``another``."""
        if os.getuid() == 0:  # all other users' is in the home directory anyway
            (self.home / "run").mkdir()
            inside = (*_APART, str(self.home / "run"))
            with suppress(OSError, subprocess.CalledProcessError):  # no `unshare` here
                trial = {**self._apart(), "capture_output": True}
                subprocess.run([*inside, "true"], check=True, **trial)
                self._inside = inside
        if another and not self._inside:
            raise PlatformError(
                "another recording runs, and LTTng makes one at a time where root may not mount: "
                "wait for its end, or permit mounting (Docker: `--privileged`)"
            )
        if not is_installed("lttng-sessiond"):
            raise PlatformError(
                "no LTTng session daemon runs, and `lttng-sessiond` is not there: " + _PACKAGES
            )
        log_file, sockets = self.home / "daemon.log", self.home / ".lttng"
        sockets.mkdir()
        for version in range(5, 20):  # applications look for one with their ABI's version
            (sockets / f"lttng-ust-sock-{version}").symlink_to("applications")
        applications = f"--apps-sock={sockets / 'applications'}"
        with os.fdopen(open_output(log_file), "wb") as log:
            self.daemon = subprocess.Popen(
                [*self._inside, "lttng-sessiond", "--quiet", applications],
                stdout=log,
                stderr=log,
                # It ends in order, with its consumers, should we be killed.
                preexec_fn=partial(signalled_with_parent, os.getpid(), signal.SIGINT),  # noqa: PLW1509 - one call
                **self._apart(),
            )
        deadline = time.monotonic() + _START_S
        while not self._answers():
            if self.daemon.poll() is not None or time.monotonic() > deadline:
                reason = log_file.read_text(errors="replace").strip().rpartition("\n")[2]
                reason = reason or "it says nothing"
                raise OperationError(f"the LTTng session daemon does not start: {reason}")
            time.sleep(0.05)

    def _look_for_strangers(self) -> None:
        """Note which other processes run, if the daemon is not ours and so traces all of them.

        Processes of the command descend from us, or have our mark, if their parent is gone.
        """
        if self.daemon is None:
            parent_of, mark = parents(), f"{MARK}={self._sessions[0]}"
            unrelated = parent_of.keys() - descendants(parent_of, os.getpid())
            strangers = {pid for pid in unrelated if not _is_marked(pid, mark, self._users)}
            self._strangers = (self._strangers | strangers) - (parent_of.keys() - strangers)

    def _new_session(self) -> str:
        """Prepare a session with buffers of the present size; return its name."""
        number = len(self._sessions) + 1
        name = f"{self.home.name}-{number}"
        answer = self._ask("version")
        version = [int(answer.findtext(f".//{{*}}{part}") or 0) for part in ("major", "minor")]
        # LTTng 2.15 began to write CTF 2, which no analysis reads yet.
        old_format = ("--trace-format=ctf-1.8",) if version >= [2, 15] else ()
        output = self._folder.absolute() / f"session-{number}"
        self._ask("create", name, f"--output={output}", *old_format)
        self._sessions.append(name)
        size = f"--subbuf-size={self._buffer // _SUB_BUFFERS}"
        # The application need not wake the consumer, which looks every 200 ms.
        channel: tuple[str, ...] = (size, f"--num-subbuf={_SUB_BUFFERS}", f"--session={name}")
        channel += ("--discard", "--switch-timer=0", "--read-timer=200000", "events")
        of_channel = (f"--session={name}", "--channel=events")
        self._ask("enable-channel", "--userspace", "--buffers-uid", *channel)
        self._ask("enable-event", "--userspace", *of_channel, EVENTS)
        contexts = ("--type=procname", "--type=vpid", "--type=vtid")
        self._ask("add-context", "--userspace", *of_channel, *contexts)
        if self._kernel:
            self._ask("enable-channel", "--kernel", *channel)
            self._ask("enable-event", "--kernel", *of_channel, "sched_switch")
        return name

    def _enlarge(self) -> None:
        """Go on in a new session with larger buffers, if there is room.

        Buffers of a session that runs cannot become larger.
        """
        before, larger = self._buffer, buffer_size(wanted=self._buffer * _ENLARGED_BY)
        if larger <= before:
            return
        former, self._buffer = self._sessions[-1], larger
        try:
            successor = self._new_session()
        except OperationError:
            self._sessions.sort(key=former.__eq__)  # the last one is the session that runs
            raise
        stopped = time.monotonic_ns()
        self._ask("stop", former, "--no-wait")
        self._ask("start", successor)
        gap = time.monotonic_ns() - stopped
        self._ask("destroy", former)  # once all of it is on disk
        self._notes.append(
            f"events were lost, so the buffers were enlarged from {before >> 10} KiB to "
            f"{larger >> 10} KiB a core; nothing was recorded for {duration_text(round(gap, -6))}."
        )


def _hears_one_command_only() -> bool:
    """Whether the root daemon that runs is another recording's: no other application finds it."""
    with suppress(OSError, ValueError):
        pid = int((_RUN_DIRECTORY / "lttng-sessiond.pid").read_text())
        return b"--apps-sock=" in read_proc(f"/proc/{pid}/cmdline")
    return False


def buffer_size(
    wanted: int | None = None, free: int | None = None, cores: int | None = None
) -> int:
    """Return the size of each core's ring buffer in bytes, a power of two: as wanted, if possible.

    The buffers of all cores get half of the ``free`` bytes of /dev/shm at most.
    """
    cores = cores or os.sysconf("SC_NPROCESSORS_CONF")
    if free is None:
        free = shutil.disk_usage("/dev/shm").free if Path("/dev/shm").is_dir() else 0  # noqa: S108
    size = min(wanted or DEFAULT_BUFFER, max(_SMALLEST, free // 2 // cores))
    return max(_SMALLEST, 1 << (size.bit_length() - 1))


def _is_marked(pid: int, mark: str, users: Collection[int]) -> bool:
    """Return whether a process of these users has the mark; other users can write it as well."""
    with suppress(OSError), process_folder(pid) as folder:  # else it has ended, or is another's
        marked = mark.encode() in read_proc("environ", folder).split(b"\0")
        return marked and user_in(folder) in users
    return False


def _without_processes(
    strangers: Collection[int], tables: EventTables, info: RecordingInfo
) -> tuple[EventTables, RecordingInfo]:
    """Leave processes that are not the command's out of the tables and their description."""
    traced = (frame["pid"].drop_nulls().unique() for frame in tables.values())
    foreign = sorted({pid for pids in traced for pid in pids} & set(strangers))
    if not foreign:
        return tables, info
    is_ours = ~pl.col("pid").is_in(foreign).fill_null(False)
    remaining = {name: frame.filter(is_ours) for name, frame in tables.items()}
    names = ", ".join(f"{pid} {info.processes.get(pid, '')}".strip() for pid in foreign)
    note = f"processes that the command has not started are left out: {names}."
    counts = {
        name if name == "sched_switch" else f"ros2:{name}": frame.height
        for name, frame in remaining.items()
    }
    facts = {
        "processes": {pid: name for pid, name in info.processes.items() if pid not in foreign},
        "notes": (*info.notes, note),
        "trace_events": counts,
    }
    return remaining, info.model_copy(update=facts)
