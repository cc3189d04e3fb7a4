"""A plan in force, from here, on nodes in containers that call themselves alike."""

import json
import signal
from contextlib import ExitStack
from functools import partial
from itertools import pairwise
from pathlib import Path

import pytest
from applied_plans import (
    FREEZER,
    MS,
    applied,
    leftovers,
    needs_fifo,
    node_command,
    plan_for,
    scheduling,
    server,
)
from command_line import called
from containers import contained, needs_namespaces
from gated import needs_cgroups, own_cgroup
from processes import wait_for

from chainshaper.enforcement.freezer import stray_groups
from chainshaper.linux.threads import list_threads, start_of

pytestmark = [needs_fifo, needs_cgroups, needs_namespaces, pytest.mark.timed]
PLAN = plan_for(server("first", "origin", (0, 30)), server("second", "other", (40, 70)))


def _has_lines(output: Path) -> bool:
    return output.exists() and output.stat().st_size > 0


def _slots() -> int:
    """How many slots the second container's server has had."""
    (status,) = json.loads(called("status", "--json").out)
    return int(status["state"]["servers"][1]["counters"]["slots"])


def test_threads_of_two_containers_are_governed_and_released(tmp_path: Path) -> None:
    """Each is process 1 in its container; one is governed in each slot, both are as before."""
    with ExitStack() as both:
        pids = {}
        for name, busy in (("origin", MS), ("other", 2 * MS)):
            output = tmp_path / name
            command = node_command(name, output, period=10 * MS, busy=busy)
            _, process = both.enter_context(contained(command, user=name == "other"))
            assert process.inner_pid == 1
            wait_for(partial(_has_lines, output), name)
            pids[name] = process.pid
        before = {name: scheduling(pid) for name, pid in pids.items()}
        with applied(PLAN, tmp_path, *FREEZER, "--json") as run:
            wait_for(lambda: _slots() > 8, "nine slots")
            policies = {name: list_threads(pid)[0].policy for name, pid in pids.items()}
            assert policies == dict.fromkeys(pids, "SCHED_FIFO")
            released = called("release", "--crashed")
            assert (released.code, run.poll()) == (0, None), "what is in force stays so"
            run.send_signal(signal.SIGINT)
            run.communicate(timeout=30)
            assert run.returncode == 0
        lines = (tmp_path / "other").read_text().splitlines()[:-1]
        starts = [int(line.split()[0]) for line in lines]  # the slot may end while it computes
        pauses = [after - before for before, after in pairwise(starts)]
        assert sum(pause > 60 * MS for pause in pauses) > 8, "closed for 70 ms in every cycle"
        assert {name: scheduling(pid) for name, pid in pids.items()} == before
    wait_for(lambda: not leftovers(), "runs and cgroups to be removed")


def test_what_a_run_in_a_container_has_in_force_is_no_stray() -> None:
    """It calls itself process 1, as another program does here."""
    with own_cgroup("inside") as home:
        with contained(["sleep", "60"]) as (_, process):
            started = start_of(process.pid, process.pid)
            group = home / f"chainshaper-{process.inner_pid}.{started}.9-0-first"
            group.mkdir()
            assert process.inner_pid == 1
            assert group not in stray_groups(())
        assert group in stray_groups(())
        group.rmdir()
