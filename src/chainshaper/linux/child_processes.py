"""Start and end child processes: chainshaper's own, and the user's command.

**Chainshaper's own** processes often have more rights than the users who can write into the folder
in which they are started. So their Python is isolated (``-I``). It gets the package and, behind all
other folders, those of the libraries that it needs, if only root and this user can change them.

**The user's command**, such as `ros2 launch …`, is asked to end by SIGINT. Each of its processes
must get that once, since a second one kills a node that is shutting down. A command in a terminal
expects that the terminal signals its whole process group; any other command passes the signal on
to its processes by itself. Then whatever has not ended gets SIGINT, SIGTERM and at last SIGKILL,
the whole group at once.

All child processes have sessions of their own, so that Ctrl-C reaches this process only.
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
"""What processes import that simulate, or have DDS; all others need the standard library only."""

PATIENCE_S = 15.0
"""How long a command may take to end after a signal.

`ros2 launch` itself gives its nodes 5 s after SIGINT, and 5 s after SIGTERM.
"""

_ORPHANS_S = 1.0  # how long the processes of a command may take to end when it has

_LOOK_S = 0.05  # between two looks whether a command has ended
_PACKAGE = Path(__file__).resolve().parents[1]
_START = (
    "import importlib.util as u, runpy, sys; package, folders, module = sys.argv[1:4]; "
    "del sys.argv[1:4]; sys.path += [f for f in folders.split(':') if f and f not in sys.path]; "
    "s = u.spec_from_file_location('chainshaper', package) if package else None; "
    "m = s and sys.modules.setdefault('chainshaper', u.module_from_spec(s)); "
    "s and s.loader.exec_module(m); "
    "from chainshaper.vendored_packages import use_vendored; use_vendored(); "
    "runpy.run_module(module, run_name='__main__', alter_sys=True)"
)


def module_command(module: str, libraries: Sequence[str] = ()) -> list[str]:
    """Return the command that runs a module as a process of our own.

    It finds the ``libraries`` where this process does. Raises OperationError: others may change our
    package, and an isolated Python finds no other.
    """
    searched = (*site.getsitepackages(), str(Path(os.__file__).parent))  # by an isolated Python
    package, reason = str(_PACKAGE / "__init__.py"), why_distrusted(_PACKAGE)
    if reason is not None:
        if not package.startswith(searched):
            raise OperationError(
                f"chainshaper's own processes do not run from {_PACKAGE.parent}: {reason}; see "
                "that only root and you can write there, or install chainshaper elsewhere"
            )
        package = ""  # this Python finds it anyway, as whoever installed it has decided
    folders = []
    for spec in map(importlib.util.find_spec, libraries):
        if spec is not None and spec.origin is not None:
            folder = Path(spec.origin).parents[1 if spec.submodule_search_locations else 0]
            if not str(folder).startswith(searched) and why_distrusted(folder) is None:
                folders.append(str(folder))
    return [sys.executable, "-I", "-c", _START, package, ":".join(dict.fromkeys(folders)), module]


def start_module(
    module: str,
    *arguments: str,
    stdin: int = subprocess.DEVNULL,
    stdout: int = subprocess.PIPE,
    stderr: int = subprocess.PIPE,
    pass_fds: Collection[int] = (),
) -> "subprocess.Popen[bytes]":
    """Start a module as a process of our own, by default with pipes from its output and errors.

    ``stdin``, ``stdout``, ``stderr`` and ``pass_fds`` are as for Popen.
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
    """Return the folders in PYTHONPATH, without those that depend on the current folder."""
    return [*filter(os.path.isabs, os.environ.get("PYTHONPATH", "").split(os.pathsep))]


def tool_environment() -> dict[str, str]:
    """Return our environment for tools that we run; its PATH has no relative folder."""
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
    """Start the user's command; it gets a SIGINT if this process is killed.

    ``environment`` is added to ours; it prints to the descriptor ``stdout``. Raises InputError: as
    :func:`check_command`. OperationError: the kernel refuses to run it.
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
    """Make a new process react to signals as one that was started from a terminal."""
    # A background job of a script ignores SIGINT, and what it starts inherits that.
    for number in (signal.SIGINT, signal.SIGQUIT):
        signal.signal(number, signal.SIG_DFL)
    signalled_with_parent(parent, signal.SIGINT)


def end_command(started: subprocess.Popen[bytes], patience_s: float = PATIENCE_S) -> None:
    """End the user's command and its process group; ``patience_s`` is waited after each signal.

    The first SIGINT goes where the command expects it (see above), all later signals to the group.
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
    """Whether the command relies on a terminal to signal the processes that it has started.

    `ros2 launch` does so where its input is a terminal, unless an option says that it has none.
    """
    words = started.args if isinstance(started.args, Sequence) else ()
    return os.isatty(0) and not {"--noninteractive", "-n"}.intersection(map(str, words))


def _asked_first(started: subprocess.Popen[bytes]) -> list[int]:
    """Return pidfds of the processes that get the first SIGINT: the command, and what it waits for.

    A process that does nothing but wait for another one, as a shell script does, passes no signal
    on. So the process that it waits for gets one, too, and so on.
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
    """Return the child for which a process waits, by id and start; None: it does not wait so.

    It waits if it is blocked until a child ends, and has a single child in the group.
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
    """Wait until the command and its group have ended, or for ``patience_s``.

    ``orphans_s``: how long to wait at most when the command has ended, and its group has not.
    """
    deadline = time.monotonic() + patience_s
    while not _over(started) and time.monotonic() < deadline:
        if orphans_s is not None and started.poll() is not None:
            deadline, orphans_s = min(deadline, time.monotonic() + orphans_s), None
        time.sleep(_LOOK_S)


def _signal_group(started: subprocess.Popen[bytes], number: int) -> None:
    """Signal the command's process group, and no other that has its number by now."""
    if started.returncode is None:  # not waited for yet, so the number is still the command's
        with contextlib.suppress(ProcessLookupError):
            os.killpg(started.pid, number)
        return
    stats = dict(all_stats())
    if started.pid in stats:  # another process has the number, so nothing is left of the group
        return
    for pid, fields in stats.items():
        group, session, started_at = int(fields[2]), int(fields[3]), int(fields[19])
        if group == session == started.pid:
            pidfd = open_process(pid, started_at)
            if pidfd is not None:
                with contextlib.suppress(OSError):  # it has ended, or is another user's
                    signal.pidfd_send_signal(pidfd, number)
                os.close(pidfd)


def _over(started: subprocess.Popen[bytes]) -> bool:
    """Whether the command has ended, and no process of its group runs (zombies do not)."""
    return started.poll() is not None and not any(_running_in(started.pid))


def _running_in(group: int) -> Iterator[tuple[int, list[bytes]]]:
    """Yield the processes of a group, without zombies, with the fields of :func:`.all_stats`."""
    for pid, fields in all_stats():
        if fields[0] not in (b"Z", b"X") and int(fields[2]) == group:
            yield pid, fields


def end_in_words(code: int) -> str:
    """Say what a return code of `subprocess` means: ``ended with code 3``, ``was killed by …``."""
    if code >= 0:
        return f"ended with code {code}"
    with contextlib.suppress(ValueError):
        return f"was killed by {signal.Signals(-code).name}"
    return f"was killed by signal {-code}"  # most real-time signals have no name of their own


def what_happened(process: "subprocess.Popen[Any]") -> str | None:
    """Say why a child process does not work any more; None: it does."""
    options = os.WEXITED | os.WSTOPPED | os.WNOHANG | os.WNOWAIT
    try:
        state = os.waitid(os.P_PID, process.pid, options)
    except ChildProcessError:
        return "ended"
    if state is None:
        return None
    done = {os.CLD_EXITED: "ended with status", os.CLD_STOPPED: "was stopped by signal"}
    return f"{done.get(state.si_code, 'was killed by signal')} {state.si_status}"
