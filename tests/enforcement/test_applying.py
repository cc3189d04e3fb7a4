"""A plan in force on running processes, and everything as it was when it ends, however it ends."""

import fcntl
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from applied_plans import (
    CYCLE,
    MS,
    NODE,
    applied,
    ended,
    leftovers,
    needs_fifo,
    node_command,
    one_server_plan,
    plan_for,
    running_node,
    scheduling,
    server,
    started,
    verb,
)
from gated import needs_cgroups
from processes import wait_for

from chainshaper.linux.runs import journals_folder
from chainshaper.linux.threads import list_threads
from chainshaper.planning import Plan, save_plan

pytestmark = needs_fifo


def windows(output: Path) -> np.ndarray:
    lines = [line.split() for line in output.read_text().splitlines()]
    return np.array([[int(v) for v in line] for line in lines if len(line) == 2], dtype=np.int64)


@needs_cgroups
def test_a_node_runs_inside_its_slots_and_is_as_before_afterwards(tmp_path: Path) -> None:
    """Its timer expires ten times per cycle; in force, it computes in the slot's 30 ms only."""
    output = tmp_path / "windows"
    plan = plan_for(server("first", "origin", (0, 30)), server("second", "other", (40, 70)))
    with (
        running_node("origin", tmp_path / "origin"),
        running_node("other", output, period=10 * MS, busy=2 * MS) as node,
    ):
        before = scheduling(node.pid)
        with applied(plan, tmp_path, "--backend", "freezer", "--json") as run:
            time.sleep(1.0)
            begun = time.monotonic_ns()
            time.sleep(3.0)
            ended = time.monotonic_ns()
            status = json.loads(verb("status", "--json").stdout)
            run.send_signal(signal.SIGINT)
            stdout, _ = run.communicate(timeout=30)
            assert run.returncode == 0
        assert scheduling(node.pid) == before
        state = json.loads(stdout)
    assert [one["alive"] for one in status] == [True]
    assert status[0]["state"]["back_end"] == "freezer"
    assert state["servers"][1]["counters"]["slots"] > 20
    seen = windows(output)
    seen = seen[(seen[:, 0] > begun) & (seen[:, 1] < ended)]
    phases = (seen - state["anchor_ns"]) % CYCLE
    inside = (phases[:, 0] >= 39 * MS) & (phases[:, 0] < 71 * MS)
    assert len(seen) > 20
    assert inside.mean() > 0.95
    assert not leftovers()


@needs_cgroups
def test_a_killed_run_is_undone_without_anybody_asking(tmp_path: Path) -> None:
    output = tmp_path / "windows"
    with running_node("origin", output) as node:
        before = scheduling(node.pid)
        with applied(one_server_plan(), tmp_path) as run:
            assert scheduling(node.pid) != before
            run.kill()
            run.wait()
            wait_for(lambda: scheduling(node.pid) == before and not leftovers(), "the undoing")
        grown = output.stat().st_size
        wait_for(lambda: output.stat().st_size > grown, "the node to run on")


@needs_cgroups
def test_when_everything_of_ours_is_killed_release_undoes_it(tmp_path: Path) -> None:
    with running_node("origin", tmp_path / "windows") as node:
        before = scheduling(node.pid)
        with applied(one_server_plan(), tmp_path, "--backend", "freezer") as run:
            for pid in [*_processes_of("chainshaper.enforcement"), run.pid]:
                os.kill(pid, signal.SIGKILL)
            run.wait()
            assert "crashed" in verb("status").stdout
            assert verb("release").returncode == 0
            assert scheduling(node.pid) == before
            assert not leftovers()
    assert "nothing was left behind" in verb("release").stdout


def test_release_ends_a_run_that_is_in_force(tmp_path: Path) -> None:
    with running_node("origin", tmp_path / "windows") as node:
        before = scheduling(node.pid)
        with applied(one_server_plan(), tmp_path, "--backend", "fifo") as run:
            assert verb("release").returncode == 0
            assert run.wait(timeout=20) == 0
        assert scheduling(node.pid) == before


def test_a_command_is_started_governed_and_ended(tmp_path: Path) -> None:
    output = tmp_path / "windows"
    plan = one_server_plan()
    talking = ("sh", "-c", 'echo so says the command; exec "$@"', "sh")
    command = [*talking, *node_command("origin", output)]
    with applied(plan, tmp_path, "--backend", "fifo", "--json", "--", *command) as run:
        assert "FIFO" in str(
            [t.policy for p in _processes_of(str(output)) for t in list_threads(p)]
        )
        run.send_signal(signal.SIGTERM)
        stdout, _ = run.communicate(timeout=40)
        assert run.returncode == 0
    assert not _processes_of(str(NODE))
    assert json.loads(stdout)["command"] == command, "what the command says goes elsewhere"


def test_a_command_that_fails_is_reported_and_so_is_one_without_the_nodes(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    save_plan(one_server_plan(), path)
    ended = verb("apply", path, "--backend", "fifo", "--", "false")
    assert ended.returncode == 1
    assert "ended with code 1 before all nodes" in ended.stderr
    absent = verb("apply", path, "--backend", "fifo")
    assert absent.returncode == 1
    assert "/origin" in absent.stderr
    assert verb("apply", path, "--backend", "magic").returncode == 2
    assert not [one for one in leftovers() if "chainshaper-" in one.name]


def _processes_of(text: str) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                command = (entry / "cmdline").read_bytes().decode(errors="replace")
            except OSError:
                continue
            if text in command and "\0apply\0" not in command:
                found.append(int(entry.name))
    return found


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


STEP_NS = 2_000_000_000


def _step(by_ns: int) -> None:
    now = time.clock_gettime_ns(time.CLOCK_REALTIME)
    time.clock_settime_ns(time.CLOCK_REALTIME, now + by_ns)


@needs_cgroups
@pytest.mark.skipif(
    "CHAINSHAPER_STEP_CLOCK" not in os.environ,
    reason="it steps this machine's clock: set CHAINSHAPER_STEP_CLOCK=1 where that may be done",
)
def test_slots_stay_where_they_are_when_the_wall_clock_steps(tmp_path: Path) -> None:
    output = tmp_path / "windows"
    plan = plan_for(server("first", "origin", (0, 30)), server("second", "other", (40, 70)))
    with (
        running_node("origin", tmp_path / "origin"),
        running_node("other", output, period=10 * MS, busy=2 * MS),
        applied(plan, tmp_path, "--backend", "freezer", "--json") as run,
    ):
        begun = time.monotonic_ns()
        for _ in range(6):
            for by_ns in (STEP_NS, -STEP_NS):
                _step(by_ns)
                time.sleep(0.4)
        ended = time.monotonic_ns()
        run.send_signal(signal.SIGINT)
        stdout, _ = run.communicate(timeout=30)
        assert run.returncode == 0
    state = json.loads(stdout)
    seen = windows(output)
    seen = seen[(seen[:, 0] > begun) & (seen[:, 1] < ended)]
    phases = (seen - state["anchor_ns"]) % CYCLE
    inside = (phases[:, 0] >= 39 * MS) & (phases[:, 0] < 71 * MS)
    assert len(seen) > 20
    assert inside.mean() > 0.95
    assert state["failure"] is None
    assert not leftovers()
