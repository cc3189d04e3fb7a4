"""A root session daemon that is a user's, and its user's own view of it."""

import os
import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from processes import wait_for

__all__ = ["lttng", "sessions", "users_daemon"]


@contextmanager
def users_daemon(home: Path) -> Iterator[dict[str, str]]:
    """Have one, started unless it is there; the environment of somebody who uses it."""
    if os.geteuid() != 0:
        pytest.skip("only root can start the session daemon that traces everybody")
    environment = {**os.environ, "LTTNG_HOME": str(home)}
    running = lttng(environment, "list").returncode == 0
    daemon = None if running else subprocess.Popen(["lttng-sessiond", "--quiet"], env=environment)
    try:
        wait_for(lambda: lttng(environment, "list").returncode == 0, "the session daemon")
        yield environment
    finally:
        if daemon is not None:
            daemon.terminate()
            daemon.wait(20)


def lttng(environment: dict[str, str], *arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run `lttng` as the daemon's user."""
    command = ["lttng", "--no-sessiond", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def sessions(environment: dict[str, str]) -> list[str]:
    """The names of all sessions."""
    told = lttng(environment, "--mi=xml", "list").stdout
    return sorted(re.findall(r"<session>\s*<name>(.*?)</name>", told))
