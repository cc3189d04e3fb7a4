"""Threads that appear while a plan is in force, on a run whose processes and servers stand in."""

from collections.abc import Callable
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import pytest
from applied_plans import one_server_plan

from chainshaper.enforcement.back_ends import Choice
from chainshaper.enforcement.threads import Allocation, NodeThread
from chainshaper.flow import apply as applying
from chainshaper.flow.apply import _Run
from chainshaper.linux.threads import Thread
from chainshaper.planning.application_plan import whole
from chainshaper.values.errors import OperationError, PlatformError

MS = 1_000_000


def node(tid: int, name: str = "/origin") -> NodeThread:
    """The executor of a node's process, which has no other thread."""
    thread = Thread(tid, tid, "node", "executor", "SCHED_OTHER", 0, (0,), started=tid)
    return NodeThread(thread, (name,), "main thread", "command line")


def found(*tids: int) -> Allocation:
    return Allocation(tuple(map(node, tids)), ())


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> _Run:
    """A run of the freezer on node 7; the timer expired at 5 ms of 100, the slot opens at 7."""
    journal: Any = SimpleNamespace(path=tmp_path / "journal", read=lambda *_: ())
    plan = whole(one_server_plan())
    run = _Run(plan, plan, Choice("freezer", ""), journal, (), frozenset(), Event())
    monkeypatch.setattr(applying, "change_all", lambda *_: None)
    monkeypatch.setattr(applying, "note_descendants", lambda *_: None)
    run.found = found(7)
    run.begin_state((), "")
    run.find_anchor(5 * MS, lambda *_: None)
    return run


def servers(assign: Callable[[int, str], None], arm: Callable[[int], None]) -> Any:
    return SimpleNamespace(assign=assign, arm=arm)


@pytest.mark.parametrize("error", [OperationError, PlatformError])
def test_a_thread_that_cannot_be_put_into_its_server_is_named_and_ends_no_plan(
    run: _Run, monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    """As in a container that began later, whose cgroups are not to be seen."""

    def assign(tid: int, _: str) -> None:
        raise error(f"thread {tid} is in the cgroup /../x")

    monkeypatch.setattr(run, "find", lambda: found(8))
    new, untaken = run.look_again(servers(assign, lambda _: None), ())
    assert [one.thread.tid for one in new] == [8]
    assert untaken == "threads that have appeared are as they were: thread 8 is in the cgroup /../x"
    assert [one.thread.tid for one in run.found.threads] == [7], "it is tried again"
