"""A plan in force on running processes, and everything as it was when it ends, however it ends."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
from applied_plans import (
    CLI,
    CYCLE,
    MS,
    NODE,
    applied,
    leftovers,
    needs_fifo,
    node_command,
    plan_for,
    running_node,
    scheduling,
    server,
)
from gated import needs_cgroups
from processes import wait_for

from chainshaper.linux.scheduling import available_cores
from chainshaper.linux.threads import list_threads
from chainshaper.planning import save_plan


def windows(output: Path) -> np.ndarray:
    lines = [line.split() for line in output.read_text().splitlines()]
    return np.array([[int(v) for v in line] for line in lines if len(line) == 2], dtype=np.int64)


@needs_fifo
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
            status = json.loads(subprocess.check_output([*CLI, "status", "--json"]))
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


@needs_fifo
@needs_cgroups
def test_a_killed_run_is_undone_without_anybody_asking(tmp_path: Path) -> None:
    output = tmp_path / "windows"
    with running_node("origin", output) as node:
        before = scheduling(node.pid)
        with applied(plan_for(server("first", "origin", (0, 30))), tmp_path) as run:
            assert scheduling(node.pid) != before
            run.kill()
            run.wait()
            wait_for(lambda: scheduling(node.pid) == before and not leftovers(), "the undoing")
        grown = output.stat().st_size
        wait_for(lambda: output.stat().st_size > grown, "the node to run on")


@needs_fifo
@needs_cgroups
def test_when_everything_of_ours_is_killed_release_undoes_it(tmp_path: Path) -> None:
    with running_node("origin", tmp_path / "windows") as node:
        before = scheduling(node.pid)
        plan = plan_for(server("first", "origin", (0, 30)))
        with applied(plan, tmp_path, "--backend", "freezer") as run:
            for pid in [*_processes_of("chainshaper.enforcement"), run.pid]:
                os.kill(pid, signal.SIGKILL)
            run.wait()
            crashed = subprocess.run(
                [*CLI, "status"], capture_output=True, text=True, check=True
            ).stdout
            assert "crashed" in crashed
            subprocess.run([*CLI, "release"], check=True, capture_output=True)
            assert scheduling(node.pid) == before
            assert not leftovers()
    said = subprocess.run([*CLI, "release"], capture_output=True, text=True, check=True).stdout
    assert "nothing was left behind" in said


@needs_fifo
def test_release_ends_a_run_that_is_in_force(tmp_path: Path) -> None:
    with running_node("origin", tmp_path / "windows") as node:
        before = scheduling(node.pid)
        plan = plan_for(server("first", "origin", (0, 30)))
        with applied(plan, tmp_path, "--backend", "fifo") as run:
            subprocess.run([*CLI, "release"], check=True, capture_output=True)
            assert run.wait(timeout=20) == 0
        assert scheduling(node.pid) == before


@needs_fifo
def test_a_command_is_started_governed_and_ended(tmp_path: Path) -> None:
    output = tmp_path / "windows"
    plan = plan_for(server("first", "origin", (0, 30)))
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


@needs_fifo
def test_a_command_that_fails_is_reported_and_so_is_one_without_the_nodes(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    save_plan(plan_for(server("first", "origin", (0, 30))), path)
    ended = subprocess.run(
        [*CLI, "apply", str(path), "--backend", "fifo", "--", "false"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 1
    assert "ended with code 1 before all nodes" in ended.stderr
    absent = subprocess.run(
        [*CLI, "apply", str(path), "--backend", "fifo"], capture_output=True, text=True, check=False
    )
    assert absent.returncode == 1
    assert "/origin" in absent.stderr
    wrong = subprocess.run(
        [*CLI, "apply", str(path), "--backend", "magic"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert wrong.returncode == 2
    assert not [one for one in leftovers() if "chainshaper-" in one.name]


def test_litmus_commands_are_printed_on_any_kernel(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    save_plan(plan_for(server("first", "origin", (0, 30))), path)
    said = subprocess.run(
        [*CLI, "apply", str(path), "--backend", "litmus", "--dry-run"],
        capture_output=True,
        text=True,
        check=True,
    )
    core = available_cores()[-1]
    number = core * 1000 + 1
    assert said.stdout.splitlines() == [
        "setsched P-RES",
        f"resctl -n {number} -t table-driven -c {core} -m 100 -q 1 '[0,30)'",
        f"resctl -a TID:/origin -r {number} -c {core}",
    ]


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
