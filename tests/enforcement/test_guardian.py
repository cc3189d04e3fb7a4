"""Whoever of a run's processes dies, hangs or is stopped: no thread stays frozen, or changed.

Threads are gated by slots of 2 ms in a cycle of a minute, so within a test only the restoring can
make them run again.
"""

import os
import random
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TypeAlias, cast

import pytest
from applied_plans import Governed, needs_fifo, node_to_govern
from gated import CORE, ahead_of_others, cpu_ns, groups_left, kill, needs_cgroups, own_cgroup
from known import known
from odd_names import ODD_NAMES, process_named
from processes import is_alive, wait_for
from strangers import needs_root

from chainshaper.enforcement.freezer import CoreNumbers, CounterPage, run_of
from chainshaper.enforcement.guardian import GROUP, _Watch, let_go
from chainshaper.enforcement.journal import Journal, find_journals
from chainshaper.enforcement.thread_scheduling import _BEST_SERVER_PRIORITY, DDS_PRIORITY
from chainshaper.enforcement.undoing import undo_run
from chainshaper.linux.cgroups import cgroup_of, mount_options, mount_point
from chainshaper.linux.scheduling import available_cores, state_of
from chainshaper.linux.threads import list_threads

pytestmark = [pytest.mark.timed, needs_cgroups, needs_fifo]

MINUTE = 60_000
OWNER = Path(__file__).with_name("servers_owner.py")
KILL, STOP = signal.SIGKILL, signal.SIGSTOP


@dataclass
class Run:
    """An owner in a process of its own, the processes it has, and the node that it governs."""

    owner: subprocess.Popen[str]
    guardians: list[int]
    dispatchers: list[int]
    runs: Path
    node: Governed

    def ask(self, line: str) -> str:
        assert self.owner.stdin is not None
        self.owner.stdin.write(line + "\n")
        self.owner.stdin.flush()
        return known(self.owner.stdout).readline().strip()

    def is_frozen(self) -> bool:
        groups = groups_left(self.owner.pid)
        return any("frozen 1" in (group / "cgroup.events").read_text() for group in groups)

    def pids(self, name: str) -> list[int]:
        """``owner``, ``guardian`` (the first), ``guardians`` (both) or ``dispatcher``."""
        one = {"owner": [self.owner.pid], "guardian": self.guardians[:1]}
        return {**one, "guardians": self.guardians, "dispatcher": self.dispatchers}[name]

    def wait_until_restored(self) -> None:
        """The node runs, where it was, as it was, and no group is left."""
        wait_for(lambda: groups_left(self.owner.pid) == [], "its group to be removed")
        ran = cpu_ns(self.node.pid)
        wait_for(lambda: cpu_ns(self.node.pid) > ran, "the node to run again")
        wait_for(lambda: state_of(self.node.pid).scheduling_class.priority == 0, "its class")
        assert list(map(str, list_threads(self.node.pid)))
        assert cgroup_of(self.node.pid) == self.node.cgroup

    def end(self) -> None:
        """End all that is left, and see that nothing is."""
        ours = [self.owner.pid, *self.guardians, *self.dispatchers]
        for pid in ours:
            kill(pid)
        self.owner.wait()
        wait_for(lambda: not any(map(is_alive, ours)), "our processes to end")
        for journal in find_journals(self.runs):
            assert undo_run(journal) == ()
        # We may have killed the one that was just removing the folder, which was empty then.
        assert not [path for path in self.runs.rglob("*") if path.is_file()]
        assert groups_left(self.owner.pid) == []


@contextmanager
def run_on(
    node: Governed,
    back_end: str = "freezer",
    cycle_ms: int = MINUTE,
    slot_ms: int = 2,
    *,
    inside: tuple[str, ...] = (),
) -> Iterator[Run]:
    runs = node.folder / f"runs-{time.monotonic_ns()}"
    arguments = (back_end, runs, CORE, cycle_ms, slot_ms, node.pid)
    with subprocess.Popen(
        [*inside, sys.executable, str(OWNER), *map(str, arguments)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=(node.folder / "said").open("w"),
        text=True,
    ) as owner:
        try:
            said = known(owner.stdout).readline()
            assert said.startswith("in force"), (node.folder / "said").read_text()
            first, second, *dispatchers = map(int, said.split()[3:])
            run = Run(owner, [first, second], dispatchers, runs, node)
            try:
                if cycle_ms == MINUTE and back_end == "freezer":
                    wait_for(run.is_frozen, "the node to be frozen")
                yield run
            finally:
                run.end()
        finally:
            kill(owner.pid)


@pytest.fixture(autouse=True)
def mounted_as_before() -> Iterator[None]:
    before = mount_options()
    yield
    wait_for(lambda: mount_options() == before, "the former mount options")


@pytest.fixture
def node(tmp_path: Path) -> Iterator[Governed]:
    with node_to_govern(tmp_path) as governed:
        yield governed


Faults: TypeAlias = tuple[tuple[str, signal.Signals], ...]
FAULTS: tuple[Faults, ...] = (
    (("owner", signal.SIGTERM),),
    (("dispatcher", STOP),),
    (("owner", KILL), ("guardian", KILL)),
    (("owner", KILL), ("guardian", STOP)),
    (("owner", KILL), ("guardians", KILL)),
    (("owner", KILL), ("guardians", STOP)),
    (("owner", KILL), ("dispatcher", KILL)),
    (("owner", KILL), ("dispatcher", STOP)),
    (("owner", STOP), ("dispatcher", KILL)),
    (("owner", STOP), ("dispatcher", STOP)),
    (("dispatcher", KILL), ("guardian", KILL)),
    (("dispatcher", KILL), ("guardian", STOP)),
    (("dispatcher", STOP), ("guardian", KILL)),
    (("dispatcher", STOP), ("guardian", STOP)),
)
"""All pairs that take the servers away, and what is more than killing one. With ``fifo``, which has
no dispatcher, those without one do, and an owner that is lost together with both guardians leaves
the class to `release`."""


@pytest.mark.parametrize("back_end", ["freezer", "fifo"])
def test_whichever_two_are_killed_or_stopped_all_is_as_before(
    tmp_path: Path, back_end: str
) -> None:
    """Several runs at a time, each with a node of its own."""

    def lose(faults: Faults) -> None:
        name = f"node{FAULTS.index(faults)}"
        (tmp_path / name).mkdir()
        with node_to_govern(tmp_path / name, name) as node, run_on(node, back_end) as run:
            assert state_of(node.pid).scheduling_class.priority > 0
            lost = [(pid, number) for whose, number in faults for pid in run.pids(whose)]
            if len(lost) > 1:  # at one instant: none is to react to what befell the other
                for pid, _ in lost:
                    kill(pid, STOP)
            for pid, number in lost:
                kill(pid, number)
            run.wait_until_restored()

    without = {"dispatcher", "guardians"} if back_end == "fifo" else set()
    with ThreadPoolExecutor(max_workers=4) as several:
        wanted = [one for one in FAULTS if without.isdisjoint(name for name, _ in one)]
        list(several.map(lose, wanted))


@needs_root
@pytest.mark.parametrize("lost", [("owner",), ("owner", "dispatcher"), ("dispatcher",)])
def test_names_that_are_no_text_appear_while_servers_are_in_force(
    node: Governed, tmp_path: Path, lost: tuple[str, ...]
) -> None:
    """Somebody mounts something, makes groups and starts programs that no encoding can read."""
    with run_on(node, inside=("unshare", "--mount")) as run, ExitStack() as undo:
        for number, name in enumerate(ODD_NAMES):
            folder = tmp_path / f"{number}{os.fsdecode(name.replace(b'/', b''))}"
            folder.mkdir()
            there = ("nsenter", "--mount", f"--target={run.owner.pid}")
            subprocess.run([*there, "mount", "-t", "tmpfs", "none", folder], check=True)
            undo.enter_context(process_named(name))
            if b"\n" not in name:
                undo.enter_context(own_cgroup(folder.name))
        for pid in [pid for name in lost for pid in run.pids(name)]:
            kill(pid)
        run.wait_until_restored()


@pytest.mark.parametrize(("name", "number"), [("guardian", KILL), ("guardians", STOP)])
def test_what_loses_guardians_only_goes_on_being_served(
    node: Governed, name: str, number: signal.Signals
) -> None:
    with run_on(node) as run:
        for pid in run.pids(name):
            kill(pid, number)
        time.sleep(0.6)
        assert run.is_frozen()
        assert run.ask("failure") == "None"


def test_an_owner_that_raises_leaves_nothing_and_a_dispatcher_that_ends_thaws_first(
    node: Governed,
) -> None:
    with run_on(node) as run:
        assert run.ask("raise") == ""
        assert run.owner.wait(timeout=20) == 1
        run.wait_until_restored()
    with run_on(node) as run:
        for pid in run.guardians:  # they cannot help
            kill(pid, STOP)
        kill(run.dispatchers[0], signal.SIGTERM)
        wait_for(lambda: not run.is_frozen(), "the thread to be thawed")


def test_threads_of_a_silent_dispatcher_are_let_go_first_and_closed_again_if_it_comes_back(
    node: Governed,
) -> None:
    with run_on(node) as run:
        groups = groups_left(run.owner.pid)
        # It has to go on before guardians give it up, 0.4 s later: others must not delay that.
        with (groups[0] / "cgroup.events").open() as events, ahead_of_others(os.getpid()):
            changes = select.poll()
            changes.register(events, select.POLLPRI)
            kill(run.dispatchers[0], STOP)
            while run.is_frozen():
                assert changes.poll(20_000), "the thread was not let go"
                events.read()
            kill(run.dispatchers[0], signal.SIGCONT)
        wait_for(run.is_frozen, "it to be closed again")
        (journal,) = find_journals(run.runs)
        freezer = known(run_of(journal))
        let_go(journal, CounterPage(freezer.page, freezer.table), CORE)  # as the slower of two may
        wait_for(run.is_frozen, "it to be closed again")
        assert groups_left(run.owner.pid) == groups
        assert run.ask("failure") == "None"


def test_guardians_are_out_of_reach_of_what_befalls_the_owner(node: Governed) -> None:
    """They have a session and a cgroup of their own, and hear no terminal; and elsewhere than the
    dispatcher they are below DDS, which delivers outputs there, and above all servers.
    """
    with run_on(node) as run:
        for pid in run.guardians:
            assert os.getsid(pid) == pid
            assert cgroup_of(pid) == mount_point() / GROUP
            for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
                kill(pid, number)
        time.sleep(0.2)
        assert all(map(is_alive, run.guardians))
        assert run.ask("failure") == "None"
        if len(available_cores()) > 1:
            elsewhere = range(_BEST_SERVER_PRIORITY + 1, DDS_PRIORITY)
            wait_for(lambda: {*map(priority_of, run.guardians)} <= {*elsewhere}, "their class")
            assert not any(CORE in os.sched_getaffinity(pid) for pid in run.guardians)


def test_guardians_are_above_a_dispatcher_that_they_share_a_core_with(node: Governed) -> None:
    """One that spins would keep them from it for good."""
    available = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {CORE})
    try:
        with run_on(node) as run:
            time.sleep(0.2)
            assert all(priority_of(one) > priority_of(run.dispatchers[0]) for one in run.guardians)
    finally:
        os.sched_setaffinity(0, available)


def priority_of(pid: int) -> int:
    (thread,) = list_threads(pid)
    return thread.priority


def test_once_it_knows_all_dispatchers_a_journal_that_grows_is_read_no_more() -> None:
    """It does so above all servers, and an application's helpers make the journal long."""

    def read(*_: object) -> tuple[str, ...]:
        raise AssertionError("it was read")

    watch, reading = object.__new__(_Watch), SimpleNamespace(size=lambda: 1, read=read)
    watch.journal, watch.read_until, watch.beats = cast("Journal", reading), 0, {CORE: (7, 0)}
    watch.page = cast("CounterPage", SimpleNamespace(cores={CORE: None}))
    assert watch.look_for_dispatchers() is False
    watch.page.cores[CORE + 1] = CoreNumbers()
    with pytest.raises(AssertionError):
        watch.look_for_dispatchers()


@pytest.mark.parametrize("victim", ["owner", "dispatcher"])
def test_killed_at_any_moment_of_a_cycle_they_leave_nothing(node: Governed, victim: str) -> None:
    chance = random.Random(victim)
    for _ in range(2):
        with run_on(node, cycle_ms=20, slot_ms=8) as run:
            time.sleep(chance.uniform(0, 0.1))
            kill(run.pids(victim)[0])
            run.wait_until_restored()
