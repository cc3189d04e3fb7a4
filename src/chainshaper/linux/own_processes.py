"""Processes that we start, ours and the user's: how they start, how they end.

A process of ours often has more rights than whoever fills the folder that it is started in. So its
Python is isolated (``-I``), and gets back our package, and behind all other folders those of the
libraries that it needs, if root and we alone can change them.

All have sessions of their own: Ctrl-C reaches us alone. The user's command, such as `ros2 launch
…`, is asked to end by a SIGINT that reaches each of its processes once: a node that gets a second
one while it shuts down is killed by it. A command in a terminal expects that the terminal signals
the whole process group; any other hands the signal on by itself. What does not end gets SIGINT,
SIGTERM and then SIGKILL, the whole group at once.
"""

import contextlib
import importlib.util
import os
import shutil
import signal
import site
import subprocess
import sys
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from chainshaper.linux.scheduling import signalled_with_parent
from chainshaper.linux.threads import all_stats, open_process, read_proc
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.files import why_distrusted

LIBRARIES = ("cyclonedds", "numpy", "polars", "pydantic", "yaml")
"""What processes import that simulate, or have DDS; all others need Python alone."""

PATIENCE_S = 15.0
"""`ros2 launch` itself gives its nodes 5 s after SIGINT, and 5 s after SIGTERM."""

_ORPHANS_S = 1.0  # what a command that has ended leaves behind may be about to end as well

_LOOK_S = 0.05
_PACKAGE = Path(__file__).resolve().parents[1]
_START = (
    "import importlib.util as u, runpy, sys; package, folders, module = sys.argv[1:4]; "
    "del sys.argv[1:4]; sys.path += [f for f in folders.split(':') if f and f not in sys.path]; "
    "s = u.spec_from_file_location('chainshaper', package) if package else None; "
    "m = s and sys.modules.setdefault('chainshaper', u.module_from_spec(s)); "
    "s and s.loader.exec_module(m); "
    "runpy.run_module(module, run_name='__main__', alter_sys=True)"
)


def module_command(module: str, libraries: Sequence[str] = ()) -> list[str]:
    """How a module runs as a process of ours, with ``libraries`` found where this process does.
    Raises OperationError: others may change the package, and an isolated Python has no other.
    """
    own = (*site.getsitepackages(), str(Path(os.__file__).parent))  # where it looks anyway
    package, reason = str(_PACKAGE / "__init__.py"), why_distrusted(_PACKAGE)
    if reason is not None:
        if not package.startswith(own):
            raise OperationError(
                f"chainshaper's own processes do not run from {_PACKAGE.parent}: {reason}; see "
                "that only root and you can write there, or install chainshaper elsewhere"
            )
        package = ""  # whoever installed this Python has it find the package, and answers for that
    folders = []
    for found in map(importlib.util.find_spec, libraries):
        if found is not None and found.origin is not None:
            place = Path(found.origin).parents[1 if found.submodule_search_locations else 0]
            if not str(place).startswith(own) and why_distrusted(place) is None:
                folders.append(str(place))
    return [sys.executable, "-I", "-c", _START, package, ":".join(dict.fromkeys(folders)), module]


def start_module(
    module: str,
    *arguments: str,
    stdin: int = subprocess.DEVNULL,
    stdout: int = subprocess.PIPE,
    stderr: int = subprocess.PIPE,
    pass_fds: Collection[int] = (),
) -> "subprocess.Popen[bytes]":
    """Start a module as a process of ours; we read its output and errors by default.

    ``stdin``, ``stdout`` and ``stderr`` are as for Popen; it gets the descriptors ``pass_fds`` too.
    """
    return subprocess.Popen(
        [*module_command(module), *arguments],
        start_new_session=True,
        stdin=stdin,
        stdout=stdout,
        stderr=stderr,
        pass_fds=tuple(pass_fds),
    )


def named_folders() -> list[str]:
    """The folders that PYTHONPATH names, but for those that mean the current one."""
    return [*filter(os.path.isabs, os.environ.get("PYTHONPATH", "").split(os.pathsep))]


def tool_environment() -> dict[str, str]:
    """Our environment, for tools that we run: their programs are in no current folder."""
    folders = filter(os.path.isabs, os.environ.get("PATH", "").split(os.pathsep))
    return {**os.environ, "PATH": os.pathsep.join(folders) or os.defpath}


def is_installed(tool: str) -> bool:
    """Whether :func:`tool_environment` has this program."""
    return shutil.which(tool, path=tool_environment()["PATH"]) is not None


def check_command(command: Sequence[str]) -> None:
    """See that a command can be started. Raises InputError: no such program, or not executable."""
    if shutil.which(command[0]) is None:
        if os.sep in command[0] and Path(command[0]).is_file():
            raise InputError(f"{command[0]} is not executable: give it the permission (`chmod +x`)")
        raise InputError(f"{command[0]}: no such command; try `source /opt/ros/…/setup.bash` first")


def start_command(
    command: Sequence[str], environment: Mapping[str, str] | None = None, stdout: int | None = None
) -> subprocess.Popen[bytes]:
    """Start the command with ``environment`` added to ours, printing to the descriptor ``stdout``;
    should we be killed, it gets a SIGINT. Raises InputError: as :func:`check_command`.
    OperationError: the kernel refuses to run it.
    """
    check_command(command)
    try:
        return subprocess.Popen(
            command,
            env={**os.environ, **(environment or {})},
            stdout=stdout,
            start_new_session=True,
            preexec_fn=partial(_as_from_a_terminal, os.getpid()),  # noqa: PLW1509 - one call
        )
    except OSError as error:
        raise OperationError(f"{command[0]} cannot be started: {error.strerror}") from error


def _as_from_a_terminal(parent: int) -> None:
    # A background job of a script ignores SIGINT, and whatever it starts inherits that.
    for number in (signal.SIGINT, signal.SIGQUIT):
        signal.signal(number, signal.SIG_DFL)
    signalled_with_parent(parent, signal.SIGINT)


def end_command(started: subprocess.Popen[bytes], patience_s: float = PATIENCE_S) -> None:
    """End the command and its process group; ``patience_s`` is waited between the signals.

    The first SIGINT goes where the command expects it (see above); all later ones to the group.
    """
    if started.poll() is None and not _relies_on_terminal(started):
        for pidfd in _asked_first(started):
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(pidfd, signal.SIGINT)
            os.close(pidfd)
        _await_end(started, patience_s, orphans_s=min(patience_s, _ORPHANS_S))
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        if _over(started):
            return
        _signal_group(started, number)
        _await_end(started, patience_s)


def _relies_on_terminal(started: subprocess.Popen[bytes]) -> bool:
    """Whether the command leaves it to its terminal to signal the processes that it has started, as
    `ros2 launch` does where its input is one, unless it is told that it has none.
    """
    words = started.args if isinstance(started.args, Sequence) else ()
    return os.isatty(0) and not {"--noninteractive", "-n"}.intersection(map(str, words))


def _asked_first(started: subprocess.Popen[bytes]) -> list[int]:
    """The command as a pidfd. Where it does nothing but wait for another process, as a shell
    script does, that one too, and so on: who waits hands no signal on.
    """
    pidfds, pid = list[int](), started.pid
    pidfd: int | None = os.pidfd_open(pid)
    while pidfd is not None:
        pidfds.append(pidfd)
        child = _waited_for(pid, started.pid)
        if child is None:
            break
        pid, pidfd = child[0], open_process(*child)
    return pidfds


def _waited_for(pid: int, group: int) -> tuple[int, int] | None:
    """The id and start of the only child of a process that is blocked until a child ends, None
    where it is not.
    """
    try:
        if read_proc(f"/proc/{pid}/wchan") != b"do_wait":
            return None
    except OSError:
        return None
    children = [
        (child, int(fields[19])) for child, fields in _running_in(group) if int(fields[1]) == pid
    ]
    return children[0] if len(children) == 1 else None


def _await_end(
    started: subprocess.Popen[bytes], patience_s: float, orphans_s: float | None = None
) -> None:
    """Wait until the command and its group have ended, or for ``patience_s``; where the command
    has ended, for ``orphans_s`` only, if that is given.
    """
    deadline = time.monotonic() + patience_s
    while not _over(started) and time.monotonic() < deadline:
        if orphans_s is not None and started.poll() is not None:
            deadline, orphans_s = min(deadline, time.monotonic() + orphans_s), None
        time.sleep(_LOOK_S)


def _signal_group(started: subprocess.Popen[bytes], number: int) -> None:
    """Signal the command's process group, and no other that has its number by now."""
    if started.returncode is None:  # it has not been waited for: the number is its own
        with contextlib.suppress(ProcessLookupError):
            os.killpg(started.pid, number)
        return
    stats = dict(all_stats())
    if started.pid in stats:  # another's, so nothing is left of the group
        return
    for pid, (_, _, group, session, *others) in stats.items():
        if int(group) == int(session) == started.pid:
            pidfd = open_process(pid, int(others[15]))
            if pidfd is not None:
                with contextlib.suppress(OSError):  # it has ended, or is another user's
                    signal.pidfd_send_signal(pidfd, number)
                os.close(pidfd)


def _over(started: subprocess.Popen[bytes]) -> bool:
    """Whether it has ended, and no process of its group runs any more (zombies do not)."""
    return started.poll() is not None and not any(_running_in(started.pid))


def _running_in(group: int) -> Iterator[tuple[int, list[bytes]]]:
    """The processes of a group with their fields of /proc/PID/stat, but zombies."""
    for pid, fields in all_stats():
        if fields[0] not in (b"Z", b"X") and int(fields[2]) == group:
            yield pid, fields


def end_in_words(code: int) -> str:
    """A return code of `subprocess`: ``ended with code 3``, ``was killed by SIGSEGV``."""
    if code >= 0:
        return f"ended with code {code}"
    with contextlib.suppress(ValueError):
        return f"was killed by {signal.Signals(-code).name}"
    return f"was killed by signal {-code}"  # most real-time signals have no name of their own


def what_happened(process: "subprocess.Popen[Any]") -> str | None:
    """Why a child of ours is not at work any more, None while it is."""
    options = os.WEXITED | os.WSTOPPED | os.WNOHANG | os.WNOWAIT
    try:
        state = os.waitid(os.P_PID, process.pid, options)
    except ChildProcessError:
        return "ended"
    if state is None:
        return None
    done = {os.CLD_EXITED: "ended with status", os.CLD_STOPPED: "was stopped by signal"}
    return f"{done.get(state.si_code, 'was killed by signal')} {state.si_status}"
