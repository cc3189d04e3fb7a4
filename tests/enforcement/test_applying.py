"""A plan in force on running processes: whatever happens meanwhile, all is as before afterwards.

The node's timer expires every 10 ms; its server is open for 30 ms of every 100 ms. Faults happen at
random moments, drawn from a fixed seed for each kind of fault.
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
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from applied_plans import (
    CLI,
    CYCLE,
    FREEZER,
    MS,
    NODE,
    applied,
    class_and_cores,
    command_line,
    ended,
    in_force,
    leftovers,
    needs_fifo,
    node_command,
    node_to_govern,
    one_server_plan,
    plan_for,
    processes_of,
    running_node,
    scheduling,
    server,
    started,
)
from command_line import called, chainshaper
from gated import kill, needs_cgroups
from known import known
from processes import wait_for

from chainshaper import __file__ as package_file
from chainshaper.enforcement.journal import all_runs_locked, journals_folder
from chainshaper.linux import cgroups
from chainshaper.linux.threads import list_threads, parents
from chainshaper.planning import ChainPlan, Plan, plan_shaping, save_plan
from chainshaper.robot.handover import page_folders

pytestmark = [pytest.mark.timed, needs_fifo, needs_cgroups]
FIFO = ("--backend", "fifo")


def share_in_the_second_slot(output: Path, begun: int, ended: int, anchor_ns: int) -> float:
    """Of when a node ran between two instants; a slot of [40, 70) ms, and one more at its ends."""
    lines = [line.split() for line in output.read_text().splitlines()]
    seen = np.array([[int(v) for v in line] for line in lines if len(line) == 2], dtype=np.int64)
    seen = seen[(seen[:, 0] > begun) & (seen[:, 1] < ended)]
    phases = (seen - anchor_ns) % CYCLE
    assert len(seen) > 20
    return float(((phases[:, 0] >= 39 * MS) & (phases[:, 0] < 71 * MS)).mean())


BOTH = plan_for(server("first", "origin", (0, 30)), server("second", "other", (40, 70)))


def test_a_node_runs_inside_its_slots_and_is_as_before_afterwards(tmp_path: Path) -> None:
    """Its timer expires ten times per cycle; in force, it computes in the slot's 30 ms only."""
    output = tmp_path / "windows"
    with (
        running_node("origin", tmp_path / "origin"),
        running_node("other", output, period=10 * MS, busy=2 * MS) as node,
    ):
        before = scheduling(node.pid)
        with applied(BOTH, tmp_path, "--backend", "freezer", "--json") as run:
            begun = time.monotonic_ns() + 1_000 * MS
            time.sleep(3.0)
            ended = time.monotonic_ns()
            (status,) = json.loads(called("status", "--json").out)
            run.send_signal(signal.SIGINT)
            stdout, _ = run.communicate(timeout=30)
            assert run.returncode == 0
        assert scheduling(node.pid) == before
        state = json.loads(stdout)
    assert (status["alive"], status["state"]["back_end"]) == (True, "freezer")
    assert state["servers"][1]["counters"]["slots"] > 20
    assert share_in_the_second_slot(output, begun, ended, state["anchor_ns"]) > 0.95
    assert not leftovers()


def test_a_command_is_started_governed_and_ended(tmp_path: Path) -> None:
    output = tmp_path / "windows"
    page = "from chainshaper.robot.handover import open_page; open_page('of_a_command', '/out')"
    shaping = 'echo so says the command; "$0" -c "$1"; shift; exec "$@"'
    command = ["sh", "-c", shaping, sys.executable, page, *node_command("origin", output)]
    with applied(one_server_plan(), tmp_path, *FIFO, "--json", "--", *command) as run:
        threads = [t for p in _processes_of(str(output)) for t in list_threads(p)]
        assert "SCHED_FIFO" in [t.policy for t in threads]
        run.send_signal(signal.SIGTERM)
        stdout, _ = run.communicate(timeout=40)
        assert run.returncode == 0
    assert not _processes_of(str(NODE))
    assert json.loads(stdout)["command"] == command, "what the command says goes elsewhere"
    pages = [page for folder in page_folders() for page in Path(folder).glob("of_a_command.*")]
    assert not pages, "of outputs that it shaped"


KILLED = ("sh", "-c", "kill -9 $$")


def test_a_command_that_fails_is_reported_and_so_is_one_without_the_nodes(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    save_plan(Plan.of(one_server_plan()), path)
    for words, how in (("false",), "ended with code 1"), (KILLED, "was killed by SIGKILL"):
        ended = called("apply", path, *FIFO, "--", *words)
        assert ended.code == 1
        assert f"the command {how} before all nodes" in ended.err
    named = {"output": "/out", "publisher": "/origin", "nodes": ("/origin",)}
    shaped = plan_shaping(np.array([8, 12]) * MS, 50 * MS, **named)  # type: ignore[arg-type]
    save_plan(Plan.of(shaped), tmp_path / "shaped.yaml")
    command = ("timeout", "3", *node_command("origin", tmp_path / "windows"))
    without = chainshaper("apply", tmp_path / "shaped.yaml", *FIFO, "--", *command)
    assert without.code == 1
    assert "shaping node /chainshaper_out is not running, all other nodes are" in without.err
    absent = called("apply", path, *FIFO)
    assert absent.code == 1
    assert "/origin" in absent.err
    assert called("apply", path, "--backend", "magic").code == 2
    assert not [one for one in leftovers() if "chainshaper-" in one.name]


def _processes_of(text: str) -> list[int]:
    lines = {pid: command_line(pid) for pid in parents()}
    return [pid for pid, line in lines.items() if text in line and "\0apply\0" not in line]


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


def slow_plan() -> ChainPlan:
    """Its chain begins once in ten seconds, so measuring where takes two minutes."""
    plan, cycle_ns = one_server_plan(), LONG_S * 100_000_000
    chain = plan.chain.model_copy(update={"period_ns": cycle_ns})
    return plan.model_copy(update={"chain": chain, "cycle_ns": cycle_ns})


def test_threads_that_come_and_go_are_left_alone_and_named(tmp_path: Path) -> None:
    with ExitStack() as stack:
        node = stack.enter_context(churning("origin", forks=True))
        stack.enter_context(churning("beside", forks=True))
        before = [one for one in scheduling(node.pid) if one[0] == node.pid]  # type: ignore[index]
        options = (*FIFO, "--phase", "0ms", "--wait", "30s")
        run = stack.enter_context(applied(one_server_plan(), tmp_path, *options))
        threads = {one.comm: one for one in list_threads(node.pid)}
        assert threads["recvUC"].priority == 91, "one that stays has what the plan says"
        wait_for(lambda: "come and go" in called("status", "--json").out, "several looks")
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


@pytest.mark.parametrize("phase", ["claiming", "starting", "settling", "measuring"])
def test_ctrl_c_ends_it_in_every_phase(tmp_path: Path, phase: str) -> None:
    with ExitStack() as stack:
        plan, line = one_server_plan(), "finding the nodes"
        options = [*FIFO, "--wait", f"{LONG_S}s"]
        if phase == "claiming":
            journals_folder().mkdir(exist_ok=True)
            stack.enter_context(all_runs_locked(journals_folder(), lambda *_: None))
            line = ""
        if phase == "starting":
            options += ["--", "sleep", str(LONG_S)]
        if phase in ("settling", "measuring"):
            stack.enter_context(churning("origin", forks=False))
        if phase == "measuring":
            plan, line = slow_plan(), "measuring where in a cycle"
        run = stack.enter_context(started(plan, tmp_path, *options))
        if line:
            while line not in (said := known(run.stderr).readline()):
                assert said, "it ended"
        else:
            lock = journals_folder() / ".lock"
            wait_for(lambda: lock in open_files(run.pid), "it to wait for the others")
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
        assert "no node of the plan runs" in said


@pytest.mark.parametrize(
    ("number", "guardians", "reason"),
    [
        (signal.SIGSTOP, None, "dispatcher of core {core} hung, or was stopped"),
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


@pytest.mark.parametrize("victim", ["apply", "guardian", "dispatcher"])
def test_what_is_killed_while_a_run_starts_leaves_nothing(tmp_path: Path, victim: str) -> None:
    chance = random.Random(f"{victim} at start")
    with node_to_govern(tmp_path) as governed:
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


def test_lost_guardians_are_replaced_and_the_plan_stays_in_force(tmp_path: Path) -> None:
    with in_force(tmp_path) as (governed, run):
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
    """Mostly its thread is frozen then."""
    with in_force(tmp_path) as (governed, run):
        governed.process.kill()
        governed.process.wait(timeout=20)
        said = ended(run)
    assert run.returncode == 1
    assert "the application has ended: no thread of the plan's nodes is left" in said
    assert not leftovers()


def test_a_stopped_application_is_nobodys_failure(tmp_path: Path) -> None:
    with in_force(tmp_path) as (governed, run):
        governed.process.send_signal(signal.SIGSTOP)
        time.sleep(0.5)
        run.send_signal(signal.SIGINT)
        assert run.wait(timeout=20) == 0
        wait_for(lambda: "State:\tT" in Path(f"/proc/{governed.pid}/status").read_text(), "a stop")
        governed.process.send_signal(signal.SIGCONT)
        governed.check_as_before()


def test_a_node_that_is_started_again_is_taken_in(tmp_path: Path) -> None:
    with node_to_govern(tmp_path) as governed, ExitStack() as stack:
        with running_node("other", tmp_path / "other") as other:
            run = stack.enter_context(applied(BOTH, tmp_path, *FREEZER, "--json"))
            other.kill()
            other.wait()
        (tmp_path / "other").unlink()
        with running_node("other", tmp_path / "other") as again:
            before = scheduling(again.pid)
            wait_for(lambda: "chainshaper-" in cgroups.cgroup_of(again.pid).name, "its server")
            assert scheduling(again.pid) != before
            time.sleep(1.1)  # status is written every second
            said = called("status", "--json").out
            run.send_signal(signal.SIGINT)
            assert run.wait(timeout=20) == 0
            governed.check_as_before()
            assert scheduling(again.pid) == before
    state = json.loads(said)[0]["state"]
    assert [one["threads"] for one in state["servers"]] == [[governed.pid], [again.pid]]
    assert any("slots stay where --phase puts them" in note for note in state["notes"])


def test_what_a_governed_node_has_forked_is_as_the_node_was_before(tmp_path: Path) -> None:
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
                run.kill()
                run.wait(timeout=20)
            wait_for(lambda: not leftovers(), "the undoing")
            for pid in (parent.pid, *forked):
                assert class_and_cores(pid) == before
                assert cgroups.cgroup_of(pid) == home
        finally:
            for pid in (*forked, parent.pid):
                kill(pid)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give privileges away")
def test_without_the_privileges_nothing_is_changed_and_the_missing_one_is_named(
    tmp_path: Path,
) -> None:
    with node_to_govern(tmp_path) as governed, tempfile.TemporaryDirectory() as readable:
        folder = Path(readable)
        folder.chmod(0o777)
        save_plan(Plan.of(one_server_plan()), folder / "plan.yaml")
        (folder / "plan.yaml").chmod(0o644)
        for granted, missing in (
            ("", "CAP_DAC_OVERRIDE"),
            ("+sys_nice", "CAP_DAC_OVERRIDE"),
            ("+dac_override", "CAP_SYS_NICE"),
        ):
            ambient = [f"--inh-caps=-all,{granted}", f"--ambient-caps=-all,{granted}"]
            dropped = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups"]
            dropped += ambient if granted else ["--inh-caps=-all"]
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

    `robot/clocks.py` alone reads the wall clock, since messages are stamped with it; its tests
    step it.
    """
    package = Path(package_file).parent
    rooms = [*(package / room for room in ("enforcement", "linux"))]
    sources = [path for room in rooms for path in room.rglob("*.py")]
    sources += (package / "robot").glob("*.py")
    sources += [package / "flow" / name for name in ("apply.py", "phase.py", "threads.py")]
    sources += (package / "flow" / "plan_in_force").glob("*.py")
    wall_clock = re.compile(
        r"time\.CLOCK_REALTIME|import .*CLOCK_REALTIME"
        r"|\btime\.time(_ns)?\(|\bdatetime\b|\blocaltime|\bgmtime"
    )
    readers = {path.name for path in sources if wall_clock.search(path.read_text())}
    assert readers == {"clocks.py"}


def _step(by_ns: int) -> None:
    now = time.clock_gettime_ns(time.CLOCK_REALTIME)
    time.clock_settime_ns(time.CLOCK_REALTIME, now + by_ns)


@pytest.mark.skipif(
    "CHAINSHAPER_STEP_CLOCK" not in os.environ,
    reason="it steps this machine's clock: set CHAINSHAPER_STEP_CLOCK=1 where that may be done",
)
def test_slots_stay_where_they_are_when_the_wall_clock_steps(tmp_path: Path) -> None:
    output = tmp_path / "windows"
    with (
        running_node("origin", tmp_path / "origin"),
        running_node("other", output, period=10 * MS, busy=2 * MS),
        applied(BOTH, tmp_path, "--backend", "freezer", "--json") as run,
    ):
        begun = time.monotonic_ns()
        for by_ns in (2_000 * MS, -2_000 * MS) * 6:
            _step(by_ns)
            time.sleep(0.4)
        over = time.monotonic_ns()
        run.send_signal(signal.SIGINT)
        stdout, _ = run.communicate(timeout=30)
    state = json.loads(stdout)
    assert share_in_the_second_slot(output, begun, over, state["anchor_ns"]) > 0.95
    assert (run.returncode, state["failure"]) == (0, None)
    assert not leftovers()
