"""The user's command, such as `ros2 launch …`: started by us, and ended as its terminal would.

It gets a session of its own: Ctrl-C then reaches us alone, and we end it when we are done with it.
A background job of a script ignores SIGINT, and whatever it starts inherits that: `ros2 launch`
would never stop. So the command starts with the default again.

It ends by SIGINT to its whole process group, which is what Ctrl-C does and what `ros2 launch` and
every node understand as the order to shut down; then by SIGTERM, then by SIGKILL. What the command
leaves behind in its group when it ends itself is ended too.
"""

import contextlib
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from chainshaper.linux.scheduling import signalled_with_parent
from chainshaper.linux.threads import read_proc
from chainshaper.values.errors import InputError, OperationError

__all__ = ["check_command", "end_command", "start_command"]

PATIENCE_S = 15.0
"""`ros2 launch` itself gives its nodes 5 s after SIGINT, and 5 s after SIGTERM."""

_LOOK_S = 0.05


def check_command(command: Sequence[str]) -> None:
    """See that a command can be started, before anything is done for it.

    Raises:
        InputError: there is no such program, or it may not be executed.
    """
    if shutil.which(command[0]) is not None:
        return
    if Path(command[0]).is_file() and os.sep in command[0]:
        raise InputError(f"{command[0]} is not executable: give it the permission (`chmod +x`)")
    raise InputError(
        f"{command[0]}: no such command; is its name right, and is the ROS 2 environment sourced "
        "(`source /opt/ros/…/setup.bash`)?"
    )


def start_command(
    command: Sequence[str],
    environment: Mapping[str, str] | None = None,
    stdout: int | None = None,
) -> subprocess.Popen[bytes]:
    """Start the command with ``environment`` added to ours.

    What it prints goes to the file descriptor ``stdout``, or where ours goes. Should we be killed,
    it gets a SIGINT as from its terminal.

    Raises:
        InputError: see :func:`check_command`.
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
    for number in (signal.SIGINT, signal.SIGQUIT):
        signal.signal(number, signal.SIG_DFL)
    signalled_with_parent(parent, signal.SIGINT)


def end_command(started: subprocess.Popen[bytes], patience_s: float = PATIENCE_S) -> None:
    """End the command and its process group; ``patience_s`` is waited between the signals."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        if _over(started):
            return
        with contextlib.suppress(ProcessLookupError):
            os.killpg(started.pid, number)
        deadline = time.monotonic() + patience_s
        while not _over(started) and time.monotonic() < deadline:
            time.sleep(_LOOK_S)


def _over(started: subprocess.Popen[bytes]) -> bool:
    """Whether it has ended, and nobody of its group runs any more (the dead await a parent)."""
    if started.poll() is None:
        return False
    for entry in os.scandir("/proc"):
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                stat = read_proc(f"/proc/{entry.name}/stat")
                state, _, group = stat[stat.rindex(b")") + 2 :].split()[:3]
                if int(group) == started.pid and state not in (b"Z", b"X"):
                    return False
    return True
