"""Processes of another user, started by root: the user `nobody`, who may do nothing special."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

NOBODY = 65534
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root starts others' processes")
_SLEEPS = "while :; do sleep 0.05; done"


def named(*nodes: str) -> list[str]:
    """A command that does nothing but say it is these nodes."""
    rules = [word for node in nodes for word in ("-r", f"program_{node}:__node:={node}")]
    return ["/bin/sh", "-c", _SLEEPS, "node", "--ros-args", *rules]


@contextmanager
def strange(
    command: Sequence[str], environment: Mapping[str, str] | None = None, user: int = NOBODY
) -> Iterator["subprocess.Popen[bytes]"]:
    """A process of `nobody`, killed at the end with what it started."""
    process = subprocess.Popen(
        command,
        env={"PATH": "/usr/bin:/bin", **(environment or {})},
        user=user,
        group=user,
        extra_groups=[],
        cwd="/",
        start_new_session=True,
    )
    try:
        yield process
    finally:
        os.killpg(process.pid, 9)
        process.wait()


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that everybody may enter, unlike those of pytest, and `nobody` may write to."""
    folder = Path(tempfile.mkdtemp(prefix="strangers-"))
    folder.chmod(0o777)
    try:
        yield folder
    finally:
        shutil.rmtree(folder)
