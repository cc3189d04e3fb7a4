"""Threads that appear while a plan is in force, on a run whose processes and servers stand in."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import pytest
from applied_plans import one_server_plan, plan_for, server

from chainshaper.enforcement.back_ends import Choice
from chainshaper.enforcement.servers import ServerCounters
from chainshaper.enforcement.threads import Allocation, NodeThread
from chainshaper.enforcement.undoing import RunState
from chainshaper.flow import apply as applying
from chainshaper.flow import threads
from chainshaper.flow.apply import _Run
from chainshaper.flow.phase import Phase
from chainshaper.linux.threads import Thread
from chainshaper.planning.application_plan import combined, whole
from chainshaper.planning.plan import revised
from chainshaper.values.errors import OperationError, PlatformError

MS = 1_000_000


def node(tid: int, name: str = "/origin") -> NodeThread:
    """The executor of a node's process, which has no other thread."""
    thread = Thread(tid, tid, "node", "executor", "SCHED_OTHER", 0, (0,), started=tid)
    return NodeThread(thread, (name,), "main thread", "command line")


def found(*tids: int) -> Allocation:
    return Allocation(tuple(map(node, tids)), ())


class Watch:
    """A watch over where a thread begins, that sees nothing."""

    looks, latest_ns, surely_ns, look_soon = 0, None, None, False

    def __init__(
        self, _: int, tids: Sequence[int], __: int, expected_ns: int, *___: Any, **____: Any
    ):
        self.watched, self.ended = (*tids, expected_ns), False

    def end(self) -> None:
        self.ended = True


TIMERS = {7: 5 * MS, 8: 61 * MS}  # where they expire in each 100 ms, by their threads


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> _Run:
    """A run of the freezer on node 7, whose slot opens 2 ms behind its timer."""
    journal: Any = SimpleNamespace(path=tmp_path / "journal", read=lambda *_: ())
    plan = whole(one_server_plan())
    run = _Run(plan, plan, Choice("freezer", ""), journal, (), frozenset(), Event())
    monkeypatch.setattr(applying, "change_all", lambda *_: None)
    monkeypatch.setattr(applying, "note_descendants", lambda *_: set())
    monkeypatch.setattr(applying, "DriftWatch", Watch)
    monkeypatch.setattr(
        threads, "measure_phase", lambda _, tids, *__, **___: Phase(TIMERS[tids[0]], 0)
    )
    run.found = found(7)
    run.begin_state((), "")
    run.find_anchor(None, lambda *_: None)
    run.drift_watches()  # it knows who begins the chain
    return run


def servers(assign: Callable[[int, str, int], None], arm: Callable[[int], None]) -> Any:
    counters: dict[str, ServerCounters] = {}
    return SimpleNamespace(assign=assign, arm=arm, counters=lambda: counters, failure=lambda: None)


@pytest.mark.parametrize("error", [OperationError, PlatformError])
def test_a_thread_that_cannot_be_put_into_its_server_is_named_and_ends_no_plan(
    run: _Run, monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    """As in a container that began later, whose cgroups are not to be seen."""

    def assign(tid: int, _: str, __: int) -> None:
        raise error(f"thread {tid} is in the cgroup /../x")

    monkeypatch.setattr(run, "find", lambda: found(8))
    new, untaken = run.look_again(servers(assign, lambda _: None), ())
    assert [one.thread.tid for one in new] == [8]
    assert untaken == "threads that have appeared are as they were: thread 8 is in the cgroup /../x"
    assert [one.thread.tid for one in run.found.threads] == [7], "it is tried again"


def test_slots_count_from_the_new_timer_of_a_first_node_that_is_started_again(
    run: _Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It expires at 61 ms instead of 5: they had stayed at 7, and nobody had looked any more."""
    done: list[tuple[str, int]] = []
    here = servers(
        lambda tid, _, __: done.append(("assigned", tid)), lambda at: done.append(("armed", at))
    )
    monkeypatch.setattr(applying, "_LOOK_S", 0.001)
    monkeypatch.setattr(applying, "put_back", lambda *_: None)
    monkeypatch.setattr(run, "find", lambda: found(8))
    monkeypatch.setattr(run, "tell", lambda _: done.append(("told", run.begins(0))))
    run.assign(here)
    watches: list[Any] = []
    states: list[RunState] = []

    def watch(state: RunState) -> None:
        states.append(state)
        watches.extend(one for one in run.drifts if one not in watches)
        if len(states) == 4:
            run.stop.set()

    run.watch_over(here, watch)
    assert done == [("assigned", 7), ("armed", 63 * MS), ("told", 63 * MS), ("assigned", 8)]
    assert [one.watched for one in watches] == [(7, 7 * MS), (8, 63 * MS)]
    assert [one.ended for one in watches] == [True, False]
    assert {state.anchor_ns for state in states[1:]} == {63 * MS}
    (note,) = states[-1].notes
    assert "was started again: slots count from its new timer since" in note
    run.put_back()
    assert watches[1].ended, "a program that goes on would keep it"


def test_a_thread_more_in_the_executor_that_begins_is_no_other_beginning(
    run: _Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As rclpy's pool gets: the slots, which stop its other threads, stay where they are."""
    assigned: list[int] = []
    here = servers(lambda tid, _, __: assigned.append(tid), lambda _: pytest.fail("slots moved"))
    pool = tuple(replace(node(tid), thread=replace(node(tid).thread, pid=7)) for tid in (7, 8))
    monkeypatch.setattr(run, "find", lambda: Allocation(pool, ()))
    assert run.look_again(here, ())[1] == ""
    assert 8 in assigned
    assert run.anchor_ns == 7 * MS


def test_a_first_node_that_is_started_again_without_a_timer_yet_is_looked_at_again(
    run: _Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It runs freely until then: in its server it would begin with the slot, wherever that is."""
    assigned: list[int] = []
    here = servers(lambda tid, _, __: assigned.append(tid), lambda _: None)
    monkeypatch.setattr(run, "find", lambda: found(8))

    def measure(*_: Any, **__: Any) -> Phase:
        raise OperationError("thread 8 does not wake up once in every 100 ms")

    with monkeypatch.context() as until:
        until.setattr(threads, "measure_phase", measure)
        assert "thread 8 does not wake up" in run.look_again(here, ())[1]
    assert (assigned, run.anchor_ns) == ([], 7 * MS)
    assert run.look_again(here, ())[1] == ""
    assert (assigned, run.anchor_ns) == ([8], 63 * MS)


def test_of_two_chains_only_the_timer_that_is_new_is_measured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The other's thread is stopped outside its slots, and begins with these."""
    measured: list[int] = []
    one, other = (
        revised(plan_for(server(name, name, (0, 20))), offset_ns=at * MS)
        for name, at in (("a", 0), ("b", 50))
    )
    plan = combined([one, other])
    start = Allocation((node(7, "/a"), node(9, "/b")), ())
    phases = [Phase(5 * MS, 0), Phase(58 * MS, 0)]

    def measure(_: int, tids: Sequence[int], *__: Any, **___: Any) -> Phase:
        measured.extend(tids)
        return phases[1]

    monkeypatch.setattr(threads, "measure_phase", measure)
    again = Allocation((node(7, "/a"), node(8, "/b")), ())
    known = dict(enumerate(phases))
    given, anchor_ns, waits_ns, _ = threads.carried_out(plan, start, None, known=known)
    assert (anchor_ns, waits_ns) == (10 * MS, [5 * MS, 2 * MS])
    del known[1]
    assert threads.carried_out(given, again, None, known=known)[1:3] == (anchor_ns, waits_ns)
    assert measured == [8]
