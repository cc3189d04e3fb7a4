"""Whoever of the freezer's processes dies, hangs or is stopped: no thread stays frozen.

Threads are gated by slots of 2 ms in a cycle of a minute, so within a test nothing but the
restoring can make them run again.
"""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from gated import CORE, MS, Stamping, cpu_ns, groups_left, kill, needs_cgroups, stamping
from processes import children_of, wait_for

from chainshaper.enforcement.freezer.cgroups import cgroup_of, mount_options
from chainshaper.enforcement.freezer.state import clean_up, load_state
from chainshaper.errors import OperationError

pytestmark = needs_cgroups

MINUTE = 60_000


@dataclass
class Run:
    """An owner in a process of its own, the processes it has, and the thread that it gates."""

    owner: subprocess.Popen[str]
    supervisor: int
    dispatchers: list[int]
    folder: Path
    spinner: Stamping
    home: Path
    mounted: str  # how the hierarchy was

    def ask(self, line: str) -> str:
        assert self.owner.stdin is not None
        assert self.owner.stdout is not None
        self.owner.stdin.write(line + "\n")
        self.owner.stdin.flush()
        return self.owner.stdout.readline().strip()

    def is_frozen(self) -> bool:
        (group,) = groups_left(self.owner.pid)
        return "frozen 1" in (group / "cgroup.events").read_text()

    def wait_until_restored(self) -> None:
        """The thread runs, where it was, no group is left and none of the processes but owner.

        The hierarchy is mounted as before.
        """
        ran = cpu_ns(self.spinner.tid)
        wait_for(lambda: cpu_ns(self.spinner.tid) > ran, "the thread to run again")
        wait_for(lambda: groups_left(self.owner.pid) == [], "its group to be removed")
        assert cgroup_of(self.spinner.tid) == self.home
        wait_for(lambda: mount_options() == self.mounted, "the former mount options")
        wait_for(
            lambda: not any(map(alive, [self.supervisor, *self.dispatchers])),
            "our processes to end",
        )


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in {"Z", "X"}


@contextmanager
def run_of(
    folder: Path, cycle_ms: int = MINUTE, slot_ms: int = 2, frozen: bool = True
) -> Iterator[Run]:
    with stamping(folder, 60) as spinner:
        home, mounted = cgroup_of(spinner.tid), mount_options()
        script = Path(__file__).with_name("freezer_owner.py")
        arguments = [folder / "run", CORE, cycle_ms, slot_ms, spinner.tid]
        owner = subprocess.Popen(
            [sys.executable, str(script), *map(str, arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        run = None
        try:
            assert owner.stdout is not None
            said = owner.stdout.readline()
            assert said.startswith("in force"), owner.stderr and owner.stderr.read()
            supervisor = int(said.split()[-1])
            run = Run(
                owner, supervisor, children_of(supervisor), folder / "run", spinner, home, mounted
            )
            assert len(run.dispatchers) == 1
            if frozen:
                wait_for(run.is_frozen, "the thread to be frozen")
            yield run
        finally:
            ours = [owner.pid, *([run.supervisor, *run.dispatchers] if run else [])]
            for pid in ours:
                kill(pid)
            owner.wait()
            wait_for(lambda: not any(map(alive, ours)), "our processes to end")
            clean_up(folder / "run")
            assert groups_left(owner.pid) == []
            for stream in (owner.stdin, owner.stdout, owner.stderr):
                assert stream is not None
                stream.close()


def test_a_release_restores_everything(tmp_path: Path) -> None:
    with run_of(tmp_path) as run:
        assert run.ask("failure") == "None"
        assert run.owner.stdin is not None
        run.owner.stdin.close()
        assert run.owner.wait(timeout=30) == 0
        run.wait_until_restored()
        assert load_state(run.folder) is None


def test_a_killed_dispatcher_is_told_and_leaves_nothing_frozen(tmp_path: Path) -> None:
    with run_of(tmp_path) as run:
        kill(run.dispatchers[0])
        run.wait_until_restored()
        wait_for(lambda: run.ask("failure") != "None", "the failure")
        assert f"dispatcher of core {CORE} was killed by SIGKILL" in run.ask("failure")


def test_a_dispatcher_that_is_asked_to_end_thaws_first(tmp_path: Path) -> None:
    with run_of(tmp_path) as run:
        kill(run.supervisor, signal.SIGSTOP)  # it cannot help
        kill(run.dispatchers[0], signal.SIGTERM)
        wait_for(lambda: not run.is_frozen(), "the thread to be thawed")
        kill(run.supervisor, signal.SIGCONT)
        run.wait_until_restored()


def test_a_stopped_dispatcher_is_taken_for_hung(tmp_path: Path) -> None:
    with run_of(tmp_path) as run:
        kill(run.dispatchers[0], signal.SIGSTOP)
        run.wait_until_restored()
        wait_for(lambda: run.ask("failure") != "None", "the failure")
        assert f"dispatcher of core {CORE} hung" in run.ask("failure")


def test_threads_of_a_silent_dispatcher_are_let_go_first_and_closed_again_if_it_comes_back(
    tmp_path: Path,
) -> None:
    with run_of(tmp_path) as run:
        (group,) = groups_left(run.owner.pid)
        kill(run.dispatchers[0], signal.SIGSTOP)
        wait_for(lambda: not run.is_frozen(), "the thread to be let go", pause=0.001)
        kill(run.dispatchers[0], signal.SIGCONT)
        wait_for(run.is_frozen, "it to be closed again")
        assert groups_left(run.owner.pid) == [group]
        assert run.ask("failure") == "None"


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_an_owner_that_dies_without_a_release_leaves_nothing(
    tmp_path: Path, number: signal.Signals
) -> None:
    with run_of(tmp_path) as run:
        kill(run.owner.pid, number)
        run.owner.wait(timeout=20)
        run.wait_until_restored()
        assert load_state(run.folder) is None
        assert "the owner" in (run.folder / "freezer.log").read_text()


def test_an_owner_that_raises_leaves_nothing(tmp_path: Path) -> None:
    with run_of(tmp_path) as run:
        assert run.ask("raise") == ""
        assert run.owner.wait(timeout=20) == 1
        run.wait_until_restored()


def test_an_owner_that_is_stopped_goes_on_being_served(tmp_path: Path) -> None:
    with run_of(tmp_path) as run:
        kill(run.owner.pid, signal.SIGSTOP)
        time.sleep(1)
        assert run.is_frozen()
        assert all(map(alive, [run.supervisor, *run.dispatchers]))
        kill(run.owner.pid, signal.SIGCONT)
        assert run.ask("failure") == "None"


def test_a_killed_supervisor_takes_the_servers_with_it(tmp_path: Path) -> None:
    with run_of(tmp_path) as run:
        kill(run.supervisor)
        run.wait_until_restored()
        wait_for(lambda: run.ask("failure") != "None", "the failure")
        told = run.ask("failure")
        assert "supervisor" in told


def test_a_stopped_supervisor_is_replaced_by_nobody_and_ended(tmp_path: Path) -> None:
    with run_of(tmp_path) as run:
        kill(run.supervisor, signal.SIGSTOP)
        run.wait_until_restored()
        wait_for(lambda: run.ask("failure") != "None", "the failure")


def test_owner_and_supervisor_killed_together_leave_it_to_the_dispatcher(tmp_path: Path) -> None:
    with run_of(tmp_path) as run:
        kill(run.owner.pid)
        kill(run.supervisor)
        run.wait_until_restored()


def test_dispatcher_and_supervisor_killed_together_leave_it_to_the_owner(tmp_path: Path) -> None:
    with run_of(tmp_path) as run:
        kill(run.supervisor)
        kill(run.dispatchers[0])
        run.wait_until_restored()


def test_what_is_left_when_all_are_killed_at_once_is_cleaned_up(tmp_path: Path) -> None:
    with run_of(tmp_path) as run:
        ours = [run.owner.pid, run.supervisor, *run.dispatchers]
        for pid in ours:  # nobody sees the others die
            kill(pid, signal.SIGSTOP)
        with pytest.raises(OperationError, match=f"process {run.owner.pid} enforces servers"):
            clean_up(run.folder)
        for pid in ours:
            kill(pid)
        run.owner.wait()
        wait_for(lambda: not any(map(alive, ours)), "their end")
        assert run.is_frozen()

        (group,) = groups_left(run.owner.pid)
        assert clean_up(run.folder) == (group,)
        run.wait_until_restored()
        assert clean_up(run.folder) == (), "once more does no harm"


def test_the_next_run_restores_what_it_finds(tmp_path: Path) -> None:
    with run_of(tmp_path) as run:
        ours = [run.owner.pid, run.supervisor, *run.dispatchers]
        for pid in ours:
            kill(pid, signal.SIGSTOP)
        for pid in ours:
            kill(pid)
        run.owner.wait()
        wait_for(lambda: not any(map(alive, ours)), "their end")
        assert run.is_frozen()
        script = Path(__file__).with_name("freezer_owner.py")
        arguments = [str(run.folder), str(CORE), "20", "10", str(run.spinner.tid)]
        following = subprocess.run(
            [sys.executable, str(script), *arguments],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert following.returncode == 0, following.stderr
        run.wait_until_restored()


def test_a_process_that_is_killed_while_frozen_is_no_failure(tmp_path: Path) -> None:
    with run_of(tmp_path) as run:
        run.spinner.process.kill()
        run.spinner.process.wait(timeout=20)
        assert run.ask("failure") == "None"
        assert run.owner.stdin is not None
        run.owner.stdin.close()
        assert run.owner.wait(timeout=20) == 0
        assert groups_left(run.owner.pid) == []


@pytest.mark.parametrize("victim", ["owner", "supervisor", "dispatcher"])
def test_killed_at_any_moment_of_a_cycle_they_leave_nothing(tmp_path: Path, victim: str) -> None:
    chance = random.Random(victim)
    for attempt in range(4):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        with run_of(folder, cycle_ms=20, slot_ms=8, frozen=False) as run:
            time.sleep(chance.uniform(0, 0.1))
            pids = {"owner": run.owner.pid, "supervisor": run.supervisor}
            kill(pids.get(victim, run.dispatchers[0]))
            if victim == "owner":
                run.owner.wait()
            run.wait_until_restored()


def test_killed_while_the_servers_are_made_the_owner_leaves_nothing(tmp_path: Path) -> None:
    chance = random.Random(7)
    with stamping(tmp_path, 60) as spinner:
        home = cgroup_of(spinner.tid)
        script = Path(__file__).with_name("freezer_owner.py")
        for attempt in range(8):
            folder = tmp_path / str(attempt)
            arguments = [folder, CORE, MINUTE, 2, spinner.tid]
            owner = subprocess.Popen(
                [sys.executable, str(script), *map(str, arguments)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
            )
            time.sleep(chance.uniform(0.1, 1.2))
            children = [
                pid for child in children_of(owner.pid) for pid in [child, *children_of(child)]
            ]
            kill(owner.pid)
            owner.wait()
            assert owner.stdin is not None
            owner.stdin.close()
            wait_for(lambda: not any(map(alive, children)), "our processes to end")  # noqa: B023
            assert groups_left(owner.pid) == []
            assert cgroup_of(spinner.tid) == home
        ran = cpu_ns(spinner.tid)
        wait_for(lambda: cpu_ns(spinner.tid) > ran + MS, "the thread to run")


def test_a_state_that_says_nothing_is_told_what_to_do_about(tmp_path: Path) -> None:
    assert clean_up(tmp_path) == ()
    (tmp_path / "freezer.json").write_text('{"owner": 1}')
    with pytest.raises(OperationError, match=r"freezer.json does not say .* chainshaper-\*"):
        clean_up(tmp_path)
    (tmp_path / "freezer.json").write_text(
        f'{{"owner": {os.getpid()}, "table": {{"cycle_ns": 1, "servers": []}}, '
        '"groups": [{"folder": "/sys/fs/cgroup/chainshaper-not-there", "server": "a"}]}'
    )
    assert clean_up(tmp_path) == ()
    assert not (tmp_path / "freezer.json").exists()
