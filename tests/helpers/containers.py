"""Processes in namespaces of their own, as containers have them, without a container engine."""

import os
import shutil
import signal
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from processes import children_of, wait_for

from chainshaper.linux.processes import RunningProcess, read_process

__all__ = ["contained", "in_container", "needs_namespaces"]

_OPTIONS = ("--pid", "--mount", "--ipc", "--fork", "--kill-child", "--mount-proc")
_AS_USER = ("--user", "--map-root-user")
_OWN_MEMORY = "mount -t tmpfs none /dev/shm && mkdir -p /run && mount -t tmpfs none /run"
_LAYERS = '"lowerdir=$0,upperdir=/run/up,workdir=/run/work"'
_IMAGE = f'mkdir /run/up /run/work && mount -t overlay none -o {_LAYERS} "$0" && '
needs_namespaces = pytest.mark.skipif(
    os.geteuid() != 0 or shutil.which("unshare") is None,
    reason="namespaces of processes need root and unshare",
)


def in_container(
    command: Sequence[str], *, user: bool = False, overlaid: Path | None = None
) -> list[str]:
    """The command with pids, mounts and memory of its own; ``user``: where it is root as well.

    ``overlaid`` is a folder that it sees through an overlay of its own, as files of an image.
    """
    script = f'{_OWN_MEMORY}; {_IMAGE if overlaid else ""}exec "$@"'
    user_too = _AS_USER if user else ()
    return ["unshare", *_OPTIONS, *user_too, "sh", "-c", script, str(overlaid or "sh"), *command]


@contextmanager
def contained(
    command: Sequence[str],
    environment: Mapping[str, str] | None = None,
    *,
    user: bool = False,
    overlaid: Path | None = None,
) -> Iterator[tuple["subprocess.Popen[str]", RunningProcess]]:
    """A container with a command, until it is left: `unshare`, and the process as seen here."""
    started = subprocess.Popen(
        in_container(command, user=user, overlaid=overlaid),
        env={**os.environ, **(environment or {})},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        running: list[RunningProcess] = []

        def runs() -> bool:
            assert started.poll() is None, "no such namespaces can be made here"
            inside = [read_process(pid) for pid in children_of(started.pid)]
            running[:] = [
                process for process in inside if process and process.command == tuple(command)
            ]
            return bool(running)

        wait_for(runs, "the command in its container")
        yield started, running[0]
    finally:
        for pid in children_of(started.pid):  # process 1 in there: all others end with it
            os.kill(pid, signal.SIGKILL)
        started.communicate()
