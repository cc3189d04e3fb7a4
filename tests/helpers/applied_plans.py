"""Plans put in force by `chainshaper apply` on real processes, and what must be true afterwards."""

import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from bare_plans import bare_plan
from gated import cpu_ns, groups_left, own_cgroup
from known import known
from processes import children_of, wait_for

from chainshaper.enforcement.journal import find_journals
from chainshaper.enforcement.undoing import RunState
from chainshaper.flow.apply import apply_plan
from chainshaper.linux import cgroups
from chainshaper.linux.processes import descendants
from chainshaper.linux.scheduling import available_cores, may_use_fifo
from chainshaper.linux.threads import list_threads, parents, start_of
from chainshaper.planning import ChainPlan, Plan, save_plan
from chainshaper.planning.chain_plan import Server, Thread
from chainshaper.values.errors import ChainshaperError

MS = 1_000_000
CYCLE = 100 * MS
NODE = Path(__file__).with_name("ticking_node.py")
CLI = [sys.executable, "-m", "chainshaper"]
needs_fifo = pytest.mark.skipif(not may_use_fifo(), reason="SCHED_FIFO is not permitted")


MODULES = {
    "guardian": "chainshaper.enforcement.guardian",
    "dispatcher": "chainshaper.enforcement.slot_dispatcher",
}
FREEZER = ("--backend", "freezer", "--phase", "0ms")


def plan_for(*servers: Server) -> ChainPlan:
    return bare_plan(None, CYCLE, *servers)


def server(name: str, node: str, *slots: tuple[int, int], core: int | None = None) -> Server:
    return Server(
        name=name,
        core=available_cores()[-1] if core is None else core,
        priority=1,
        slots=tuple((start * MS, end * MS) for start, end in slots),
        threads=(Thread(node=f"/{node}"),),
    )


def node_command(name: str, output: Path, period: int = CYCLE, busy: int = 5 * MS) -> list[str]:
    arguments = [str(period), str(busy), str(output)]
    return [sys.executable, str(NODE), *arguments, "--ros-args", "-r", f"__node:={name}"]


@contextmanager
def running_node(name: str, output: Path, **options: int) -> Iterator[subprocess.Popen[bytes]]:
    with subprocess.Popen(node_command(name, output, **options)) as process:
        wait_for(lambda: output.exists() and output.stat().st_size > 0, f"node {name}")
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def started(plan: ChainPlan, folder: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """`chainshaper apply` as its own process, just started."""
    path = folder / "plan.yaml"
    path.unlink(missing_ok=True)
    save_plan(Plan.of(plan), path)
    with subprocess.Popen(
        [*CLI, "apply", str(path), *options],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def applied(plan: ChainPlan, folder: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """`chainshaper apply` as its own process, in force."""
    with started(plan, folder, *options) as process:
        wait_until_in_force(process)
        yield process


@contextmanager
def applied_here(
    plan: ChainPlan, runs: Path, stop: threading.Event | None = None, **changed: Any
) -> Iterator[list[RunState]]:
    """Put a plan in force by a thread of this process; yield what was seen of its state.

    The back end is `fifo`, unless ``changed`` says else.

    Raises:
        ChainshaperError: it does not come into force, or fails while it is.
    """
    states: list[RunState] = []
    failures: list[ChainshaperError] = []
    stop = stop or threading.Event()
    options = {"back_end": "fifo", "stop": stop, "watch": states.append, "folder": runs, **changed}

    def run() -> None:
        try:
            apply_plan(Plan.of(plan), **options)
        except ChainshaperError as error:
            failures.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        wait_for(lambda: bool(states or failures), "the plan to come into force")
        if not failures:
            yield states
    finally:
        stop.set()
        thread.join(30)
        assert not thread.is_alive()
    if failures:
        raise failures[0]


def wait_until_in_force(process: subprocess.Popen[str]) -> None:
    lines: list[str] = []
    while not lines or not lines[-1].startswith("in force"):
        lines.append(known(process.stderr).readline())
        assert lines[-1], f"it ended: {''.join(lines)}"


def scheduling(pid: int) -> list[object]:
    return [(t.tid, t.policy, t.priority, t.cores) for t in list_threads(pid)]


def leftovers() -> list[Path]:
    """Groups and runs that are on this machine, those of living processes of others apart."""
    ours = {None, *descendants(parents(), os.getpid())}
    runs = [journal.path.parent for journal in find_journals() if journal.owner in ours]
    names = ((group, re.match(r"chainshaper-(\d+)", group.name)) for group in groups_left())
    owners = {group: int(name[1]) for group, name in names if name is not None}
    gone = (g for g, pid in owners.items() if pid in ours or start_of(pid, pid) is None)
    return [*runs, *(group for group in gone if not cgroups.has_unseen_threads(group))]


@dataclass(frozen=True)
class Governed:
    """A node that is to be governed, and how everything about it was before."""

    process: subprocess.Popen[bytes]
    folder: Path
    scheduling: list[object]
    cgroup: Path
    kind: str

    @property
    def pid(self) -> int:
        return self.process.pid

    def check_as_before(self) -> None:
        """It runs, as it did, where it did; nothing of ours is left on the machine."""
        wait_for(lambda: not leftovers(), "runs and cgroups to be removed")
        assert scheduling(self.pid) == self.scheduling
        assert cgroups.cgroup_of(self.pid) == self.cgroup
        assert (self.cgroup / "cgroup.type").read_text() == self.kind
        ran = cpu_ns(self.pid)
        wait_for(lambda: cpu_ns(self.pid) > ran, "the node to run on")


@contextmanager
def node_to_govern(folder: Path, name: str = "origin") -> Iterator[Governed]:
    """A node in a cgroup of its own; its timer expires every 10 ms."""
    with (
        own_cgroup(f"node-{name}") as cgroup,
        running_node(name, folder / name, period=10 * MS, busy=MS) as process,
    ):
        (cgroup / "cgroup.procs").write_text(str(process.pid))
        kind = (cgroup / "cgroup.type").read_text()
        yield Governed(process, folder, scheduling(process.pid), cgroup, kind)


def class_and_cores(pid: int) -> list[tuple[str, int, tuple[int, ...]]]:
    return [(t.policy, t.priority, t.cores) for t in list_threads(pid)]


def one_server_plan() -> ChainPlan:
    return plan_for(server("first", "origin", (0, 30)))


@contextmanager
def in_force(folder: Path, *options: str) -> Iterator[tuple[Governed, subprocess.Popen[str]]]:
    """A node and :func:`one_server_plan` in force on it, by the freezer unless options say else."""
    with (
        node_to_govern(folder) as governed,
        applied(one_server_plan(), folder, *(options or FREEZER)) as run,
    ):
        yield governed, run


def processes_of(run: subprocess.Popen[str], name: str) -> list[int]:
    """Processes of a run by what they do; `apply` itself is the run."""
    if name == "apply":
        return [run.pid]
    return [pid for pid in children_of(run.pid) if MODULES[name] in command_line(pid)]


def command_line(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace")
    except OSError:
        return ""


def ended(run: subprocess.Popen[str]) -> str:
    """What a run messages when it ended."""
    _, messages = run.communicate(timeout=60)
    return messages
