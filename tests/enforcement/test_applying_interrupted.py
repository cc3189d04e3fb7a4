"""Threads that come and go keep no plan from coming into force; Ctrl-C ends it in every phase."""

import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest
from applied_plans import (
    applied,
    ended,
    leftovers,
    needs_fifo,
    one_server_plan,
    scheduling,
    started,
)
from processes import wait_for

from chainshaper.linux.runs import journals_folder
from chainshaper.linux.threads import list_threads
from chainshaper.planning import Plan

pytestmark = needs_fifo

FIFO = ("--backend", "fifo")
LONG_S = 100
"""What is interrupted would take so long by itself."""


@contextmanager
def churning(name: str, forks: bool) -> "Iterator[subprocess.Popen[bytes]]":
    script = Path(__file__).with_name("churning_node.py")
    command = [sys.executable, str(script), str(int(forks)), "--ros-args", "-r", f"__node:={name}"]
    with subprocess.Popen(command) as process:
        try:
            wait_for(lambda: len(list_threads(process.pid)) > 5, "threads that come and go")
            yield process
        finally:
            process.kill()


def open_files(pid: int) -> list[Path]:
    found = []
    for file in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(OSError):
            found.append(file.readlink())
    return found


def slow_plan() -> Plan:
    """Its chain begins once in ten seconds, so measuring where takes two minutes."""
    plan, cycle_ns = one_server_plan(), LONG_S * 100_000_000
    chain = plan.chain.model_copy(update={"period_ns": cycle_ns})
    return plan.model_copy(update={"chain": chain, "cycle_ns": cycle_ns})


@pytest.mark.parametrize("wait", ["0s", "30s"])
def test_threads_that_come_and_go_are_left_alone_and_named(tmp_path: Path, wait: str) -> None:
    with ExitStack() as stack:
        node = stack.enter_context(churning("origin", forks=True))
        stack.enter_context(churning("beside", forks=True))
        before = [one for one in scheduling(node.pid) if one[0] == node.pid]  # type: ignore[index]
        options = (*FIFO, "--phase", "0ms", "--wait", wait)
        run = stack.enter_context(applied(one_server_plan(), tmp_path, *options))
        threads = {one.comm: one for one in list_threads(node.pid)}
        assert threads["recvUC"].priority == 91, "one that stays has what the plan says"
        time.sleep(3.5)
        asked = time.monotonic()
        run.send_signal(signal.SIGINT)
        said = ended(run)
        assert run.returncode == 0, said
        assert time.monotonic() - asked < LONG_S / 4
        assert f"threads of process {node.pid} come and go" in said
        after = [one for one in scheduling(node.pid) if one[0] == node.pid]  # type: ignore[index]
        assert after == before
        assert all(one.priority == 0 for one in list_threads(node.pid))
    assert not leftovers()


@pytest.mark.parametrize("phase", ["claiming", "finding", "starting", "settling", "measuring"])
def test_ctrl_c_ends_it_in_every_phase(tmp_path: Path, phase: str) -> None:
    with ExitStack() as stack:
        plan, line = one_server_plan(), "finding the nodes"
        options = [*FIFO, "--wait", f"{LONG_S}s"]
        if phase == "claiming":
            journals_folder().mkdir(exist_ok=True)
            folder = os.open(journals_folder(), os.O_RDONLY | os.O_DIRECTORY)
            stack.callback(os.close, folder)
            fcntl.flock(folder, fcntl.LOCK_EX)
            line = ""
        if phase == "starting":
            options += ["--", "sleep", str(LONG_S)]
        if phase in ("settling", "measuring"):
            stack.enter_context(churning("origin", forks=False))
        if phase == "measuring":
            plan, line = slow_plan(), "measuring where in a cycle"
        run = stack.enter_context(started(plan, tmp_path, *options))
        assert run.stderr is not None
        if line:
            while line not in (said := run.stderr.readline()):
                assert said, "it ended"
        else:
            wait_for(lambda: journals_folder() in open_files(run.pid), "it to wait for the others")
        asked = time.monotonic()
        run.send_signal(signal.SIGINT)
        said = ended(run)
        assert time.monotonic() - asked < LONG_S / 4
        assert run.returncode == 1
        assert "Traceback" not in said
        assert "asked to end before the plan was in force" in said
    assert not leftovers()


def test_the_time_to_wait_is_not_exceeded_where_threads_come_and_go(tmp_path: Path) -> None:
    with churning("beside", forks=True):
        begun = time.monotonic()
        with started(one_server_plan(), tmp_path, *FIFO, "--wait", "2s") as run:
            said = ended(run)
        assert 2 <= time.monotonic() - begun < LONG_S / 2
        assert run.returncode == 1
        assert "node /origin of the plan is not running" in said
