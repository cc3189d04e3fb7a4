"""Whatever happens while a plan is in force, nothing is left changed, and the reason is told.

The application is a node whose timer expires every 10 ms; its server is open for 30 ms of every
100 ms. Faults happen at random moments, drawn from a fixed seed for each kind of fault.
"""

import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
from applied_plans import (
    CLI,
    FREEZER,
    MS,
    applied,
    class_and_cores,
    command_line,
    ended,
    in_force,
    leftovers,
    needs_fifo,
    node_to_govern,
    one_server_plan,
    plan_for,
    processes_of,
    running_node,
    scheduling,
    server,
    started,
    verb,
)
from gated import cpu_ns, kill, needs_cgroups
from processes import wait_for

import chainshaper
from chainshaper.linux import cgroups
from chainshaper.planning import save_plan

pytestmark = [needs_fifo, needs_cgroups]


@pytest.mark.parametrize(
    ("number", "guardians", "reason"),
    [
        (signal.SIGKILL, None, "dispatcher of core {core} was killed by SIGKILL"),
        (signal.SIGSTOP, None, "dispatcher of core {core} hung, or was stopped"),
        (signal.SIGKILL, signal.SIGKILL, "dispatcher of core {core} was killed by SIGKILL"),
        (signal.SIGKILL, signal.SIGSTOP, "dispatcher of core {core} was killed by SIGKILL"),
    ],
)
def test_when_a_dispatcher_is_lost_the_run_ends_and_says_so(
    tmp_path: Path, number: signal.Signals, guardians: signal.Signals | None, reason: str
) -> None:
    """Also with both guardians: `apply` looks itself, every second."""
    chance = random.Random(f"{number} {guardians}")
    with in_force(tmp_path) as (governed, run):
        time.sleep(chance.uniform(0, 0.2))
        for pid in processes_of(run, "guardian") if guardians else ():
            kill(pid, guardians or 0)
        (pid,) = processes_of(run, "dispatcher")
        kill(pid, number)
        said = ended(run)
        assert run.returncode == 1
        assert reason.format(core=one_server_plan().servers[0].core) in said
        assert "everything is as it was before" in said
        governed.check_as_before()


def test_a_killed_run_is_undone_at_whatever_moment(tmp_path: Path) -> None:
    chance = random.Random("apply")
    with node_to_govern(tmp_path) as governed:
        for _ in range(4):
            with applied(one_server_plan(), tmp_path, *FREEZER) as run:
                time.sleep(chance.uniform(0, 0.2))
                run.kill()
                run.wait()
                governed.check_as_before()


@pytest.mark.parametrize("victim", ["apply", "guardian", "dispatcher"])
def test_what_is_killed_while_a_run_starts_leaves_nothing(tmp_path: Path, victim: str) -> None:
    chance = random.Random(f"{victim} at start")
    with node_to_govern(tmp_path) as governed:
        for _ in range(3):
            with started(one_server_plan(), tmp_path, *FREEZER) as run:
                wait_for(lambda: bool(processes_of(run, victim)), victim)
                time.sleep(chance.uniform(0, 0.8 if victim == "apply" else 0.2))
                for pid in processes_of(run, victim):
                    kill(pid)
                time.sleep(0.3)
                run.send_signal(signal.SIGINT)  # where that is no reason to end
                said = ended(run)
            assert "Traceback" not in said
            if run.returncode == 1:
                assert said.count("error:") == 1
            governed.check_as_before()


def test_a_stopped_run_goes_on_being_served_and_can_be_released(tmp_path: Path) -> None:
    with in_force(tmp_path) as (governed, run):
        run.send_signal(signal.SIGSTOP)
        ran = cpu_ns(governed.pid)
        wait_for(lambda: cpu_ns(governed.pid) > ran + 10 * MS, "some slots")
        assert verb("release").returncode == 0
        assert run.wait(timeout=20) == 0
        governed.check_as_before()


@pytest.mark.parametrize("back_end", ["freezer", "fifo"])
def test_lost_guardians_are_replaced_and_the_plan_stays_in_force(
    tmp_path: Path, back_end: str
) -> None:
    with in_force(tmp_path, "--backend", back_end, "--phase", "0ms") as (governed, run):
        lost = processes_of(run, "guardian")
        assert len(lost) == 2
        kill(lost[0], signal.SIGKILL)
        kill(lost[1], signal.SIGSTOP)
        wait_for(lambda: len(set(processes_of(run, "guardian")) - set(lost)) == 2, "others")
        assert scheduling(governed.pid) != governed.scheduling
        time.sleep(0.5)  # until they watch
        kill(processes_of(run, "guardian")[0], signal.SIGSTOP)
        run.kill()
        run.wait()
        governed.check_as_before()


def test_an_application_that_is_killed_ends_the_run_and_it_says_so(tmp_path: Path) -> None:
    """At a random moment: mostly its thread is frozen then."""
    chance = random.Random("application")
    for _ in range(2):
        with in_force(tmp_path) as (governed, run):
            time.sleep(chance.uniform(0, 0.2))
            governed.process.kill()
            governed.process.wait(timeout=20)
            said = ended(run)
        assert run.returncode == 1
        assert "the application has ended: no thread of the plan's nodes is left" in said
        assert not leftovers()


def test_a_stopped_application_is_nobodys_failure(tmp_path: Path) -> None:
    with node_to_govern(tmp_path) as governed:
        with applied(one_server_plan(), tmp_path, *FREEZER) as run:
            governed.process.send_signal(signal.SIGSTOP)
            time.sleep(0.5)
            run.send_signal(signal.SIGINT)
            assert run.wait(timeout=20) == 0
        wait_for(lambda: "State:\tT" in Path(f"/proc/{governed.pid}/status").read_text(), "a stop")
        governed.process.send_signal(signal.SIGCONT)
        governed.check_as_before()


def test_a_node_that_is_started_again_is_taken_in(tmp_path: Path) -> None:
    both = plan_for(server("first", "origin", (0, 30)), server("second", "other", (40, 70)))
    with node_to_govern(tmp_path) as governed, ExitStack() as stack:
        with running_node("other", tmp_path / "other") as other:
            run = stack.enter_context(applied(both, tmp_path, *FREEZER, "--json"))
            other.kill()
            other.wait()
        (tmp_path / "other").unlink()
        with running_node("other", tmp_path / "other") as again:
            before = scheduling(again.pid)
            wait_for(lambda: "chainshaper-" in cgroups.cgroup_of(again.pid).name, "its server")
            assert scheduling(again.pid) != before
            time.sleep(1.1)  # status is written every second
            said = verb("status", "--json").stdout
            run.send_signal(signal.SIGINT)
            assert run.wait(timeout=20) == 0
            governed.check_as_before()
            assert scheduling(again.pid) == before
    servers = json.loads(said)[0]["state"]["servers"]
    assert [one["threads"] for one in servers] == [[governed.pid], [again.pid]]


@pytest.mark.parametrize("removed", [True, False])
def test_a_cgroup_that_somebody_else_empties_or_removes_ends_the_run(
    tmp_path: Path, removed: bool
) -> None:
    with node_to_govern(tmp_path) as governed:
        with applied(one_server_plan(), tmp_path, *FREEZER) as run:
            group = cgroups.cgroup_of(governed.pid)
            assert group != governed.cgroup
            cgroups.move_thread(governed.pid, governed.cgroup)
            if removed:
                group.rmdir()
            said = ended(run)
        assert run.returncode == 1
        problem = r"(a cgroup of server \w+ was removed|thread \d+ was moved out)"
        assert re.search(f"the servers failed: {problem}", said)
        governed.check_as_before()


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_what_a_governed_node_has_forked_is_as_the_node_was_before(
    tmp_path: Path, end: signal.Signals
) -> None:
    trigger, output = tmp_path / "trigger", tmp_path / "pids"
    script = Path(__file__).with_name("forking_node.py")
    command = [sys.executable, str(script), str(trigger), str(output)]
    with subprocess.Popen([*command, "--ros-args", "-r", "__node:=origin"]) as parent:
        forked: list[int] = []
        try:
            home = cgroups.cgroup_of(parent.pid)
            wait_for(lambda: "ros-args" in command_line(parent.pid), "the node")
            before = class_and_cores(parent.pid)
            with applied(one_server_plan(), tmp_path, *FREEZER) as run:
                trigger.touch()
                wait_for(output.exists, "the processes to be forked")
                forked = [int(pid) for pid in output.read_text().split()]
                assert all(cgroups.cgroup_of(pid) != home for pid in forked)
                run.send_signal(end)
                run.wait(timeout=20)
            wait_for(lambda: not leftovers(), "the undoing")
            for pid in (parent.pid, *forked):
                assert class_and_cores(pid) == before
                assert cgroups.cgroup_of(pid) == home
        finally:
            for pid in (*forked, parent.pid):
                kill(pid)


@pytest.mark.parametrize(
    ("granted", "missing"),
    [
        ("", "CAP_DAC_OVERRIDE"),
        ("+sys_nice", "CAP_DAC_OVERRIDE"),
        ("+dac_override", "CAP_SYS_NICE"),
    ],
)
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give privileges away")
def test_without_the_privileges_nothing_is_changed_and_the_missing_one_is_named(
    tmp_path: Path, granted: str, missing: str
) -> None:
    with node_to_govern(tmp_path) as governed, tempfile.TemporaryDirectory() as readable:
        folder = Path(readable)
        folder.chmod(0o777)
        save_plan(one_server_plan(), folder / "plan.yaml")
        (folder / "plan.yaml").chmod(0o644)
        ambient = [f"--inh-caps=-all,{granted}", f"--ambient-caps=-all,{granted}"]
        dropped = [
            *("setpriv", "--reuid=65534", "--regid=65534", "--clear-groups"),
            *(ambient if granted else ["--inh-caps=-all"]),
        ]
        said = subprocess.run(
            [*dropped, *CLI, "apply", str(folder / "plan.yaml"), *FREEZER],
            env={**os.environ, "XDG_RUNTIME_DIR": readable, "HOME": readable},
            capture_output=True,
            text=True,
            check=False,
        )
        assert said.returncode == 3, said.stderr
        assert missing in said.stderr
        assert "run as root" in said.stderr
        assert not (folder / "chainshaper").exists()
        governed.check_as_before()


def test_steps_of_the_wall_clock_are_not_seen() -> None:
    """Setting the clock would disturb all else on the machine, so this is read from the source.

    `gate/decision.py` alone reads the wall clock, since messages are stamped with it; its tests
    step it.
    """
    package = Path(chainshaper.__file__).parent
    rooms = [*(package / room for room in ("enforcement", "gate", "linux"))]
    sources = [path for room in rooms for path in room.rglob("*.py")]
    sources += [package / "flow" / name for name in ("apply.py", "phase.py", "threads.py")]
    wall_clock = re.compile(
        r"CLOCK_REALTIME|\btime\.time(_ns)?\(|\bdatetime\b|\blocaltime|\bgmtime"
    )
    readers = {path.name for path in sources if wall_clock.search(path.read_text())}
    assert readers == {"decision.py"}
