"""Slots that follow a timer, an hour of one that is some ppm off, and threads that come later."""

import random
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any, cast

import pytest
from applied_plans import one_server_plan, plan_for, server
from known import known
from processes import wait_for
from small_chain import small_chain_plan

from chainshaper.enforcement.back_ends import Choice
from chainshaper.enforcement.freezer import Freezer
from chainshaper.enforcement.node_threads import Allocation, NodeThread
from chainshaper.enforcement.servers import ServerCounters
from chainshaper.enforcement.undoing import RunState, SlotMove
from chainshaper.flow import anchoring, apply
from chainshaper.flow.background import Background
from chainshaper.flow.drift import AHEAD_NS, ONCE_MORE_NS, SlotFollower, TimerTrack
from chainshaper.flow.phase import DriftWatch, Phase
from chainshaper.flow.plan_in_force import origins, supervision
from chainshaper.flow.plan_in_force import threads as run_threads
from chainshaper.flow.plan_in_force.anchor import AnchoredPlan
from chainshaper.flow.plan_in_force.followers import Followers
from chainshaper.flow.plan_in_force.loops import LoopsInStep
from chainshaper.flow.plan_in_force.origins import OriginWatches, follow_timer
from chainshaper.flow.plan_in_force.phases import PhaseMessages
from chainshaper.flow.plan_in_force.supervision import Supervision
from chainshaper.flow.plan_in_force.threads import RunThreads, assign_threads
from chainshaper.linux.threads import RunningThread
from chainshaper.planning.adaptation import Tail
from chainshaper.planning.chain_plan import ChainPlan, revised
from chainshaper.planning.plan import Plan, open_until_done
from chainshaper.reporting.overviews import servers_table
from chainshaper.splicing.shaped_outputs import FollowedOutput
from chainshaper.values.errors import InputError, OperationError, PlatformError

MS, S = 1_000_000, 1_000_000_000
LEAD_NS, LOOK_NS, NOISE_NS = 2 * MS, 10 * S, 30_000


def waits_of(
    ppm: float,
    *,
    looks: bool = True,
    busy: Callable[[int, random.Random], int] = lambda *_: 0,
    let_go: tuple[int, int] = (0, 0),
    seed: int = 1,
) -> tuple[list[int], TimerTrack, int]:
    """How long before its slot the timer expires, look by look for an hour, and how often the
    slots have moved. A thread that waits begins as its slot opens, so long after it as its being
    ``let_go`` takes (mean, standard deviation), else with its timer, and later on a ``busy``
    machine.
    """
    noise, track = random.Random(seed), TimerTrack(LEAD_NS, 0, 100 * MS, looks=looks)
    waits, moves, now_ns = [], 0, 0
    while now_ns < 3600 * S:
        now_ns += LOOK_NS // 5 if track.is_unsure else LOOK_NS
        opens_ns = track.opens_ns
        waits.append(opens_ns + LEAD_NS - round(ppm * now_ns / 1e6))
        late_ns = round(noise.gauss(0, NOISE_NS)) + busy(now_ns, noise)
        late_ns += round(noise.gauss(*let_go)) if waits[-1] > 0 else 0
        moves += track.saw(max(0, -waits[-1]) + late_ns, now_ns) != opens_ns
    return waits, track, moves


def half_busy(now_ns: int, noise: random.Random) -> int:
    """Half of the time threads begin up to 2 ms late: an hour of it had moved slots by 4.4 s."""
    return (now_ns // (300 * S)) % 2 * noise.randrange(2 * MS)


LET_GO = {"let_go": (300_000, 90_000)}  # on a virtual machine this had moved slots by 10 ms


@pytest.mark.parametrize(
    ("how", "ppm", "least", "most", "exact"),
    [
        *(({}, ppm, -2, 3, 0.5) for ppm in (0, 0.5, 5, -5, 50, -50)),  # 50 ppm: 180 ms in an hour
        *(({**LET_GO, "seed": n}, ppm, -2.5, 4, 2) for n in range(20) for ppm in (0, 50, -50)),
        *(({"busy": half_busy}, ppm, -5, 12, 15) for ppm in (0, 50, -50)),
    ],
)
def test_slots_stay_by_their_timer_for_an_hour(
    how: dict[str, Any], ppm: float, least: float, most: float, exact: float
) -> None:
    waits, track, moves = waits_of(ppm, **how)
    assert least * MS < min(waits) <= max(waits) < most * MS
    assert abs(track.rate * 1e6 - ppm) < exact
    if not how:
        assert min(waits[6:]) > -1.6 * MS, "once the rate is known; 1 ms is in the margin"
    if not how and abs(ppm) < 1:
        assert moves < 50, "where nothing drifts, slots hardly move"


def test_without_looking_a_timer_that_falls_behind_is_followed() -> None:
    waits, _, _ = waits_of(50, looks=False)
    assert min(waits) > -1.2 * MS
    assert waits_of(0, looks=False)[2] == 0


def run_of(
    folder: Path,
    plan: ChainPlan,
    back_end: str = "freezer",
    waits_ns: Sequence[int] = (),
    slots: tuple[tuple[int, int], ...] | None = None,
    **seen: Any,
) -> tuple[Supervision, Any]:
    """A run that has begun, with others' ``slots``, and what stands for all else that it sees."""
    if slots is not None:
        server = plan.servers[0].model_copy(update={"slots": slots})
        plan = plan.model_copy(update={"servers": (server,), "cycle_ns": 100 * MS})
    here: Any = SimpleNamespace(path=folder / "j", strangers=None, **{"threads": (), **seen})
    joint, stop = Plan.of(plan), Event()

    def go_on() -> None:
        if stop.is_set():
            raise OperationError("the run was asked to end")

    anchored = AnchoredPlan(joint, open_until_done(joint), back_end, 50 * MS, [*waits_ns])
    run = Supervision(
        anchored=anchored,
        threads=RunThreads(here, (), frozenset(), latest=here),
        report=apply._begin_report(here, Choice(back_end, ""), joint, (), ""),
        phases=PhaseMessages(),
        followers=Followers(anchored, here),
        loops=LoopsInStep(),
        origins=OriginWatches(),
        servers=here,
        stop=stop,
        go_on=go_on,
    )
    return run, here


def following(run: Supervision, servers: Any, watches: list[Any]) -> Iterator[int]:
    return follow_timer(run.anchored, servers, watches, run.report, run.stop)


def find_anchor(run: Supervision, phase_ns: int | None) -> None:
    apply._find_anchor(
        run.anchored,
        run.threads,
        run.report,
        phase_ns,
        go_on=run.go_on,
        progress=lambda *_: None,
    )


MOVED: dict[str, Any] = {
    "latest_ns": MS,
    "looks": 1,
    "expect": lambda _: None,
    "slots_wait": False,
}


@pytest.mark.parametrize("measured", [True, False])
@pytest.mark.parametrize("back_end", ["scx", "litmus", "freezer", "fifo"])
def test_every_back_end_that_gates_follows_a_phase_that_was_measured(
    tmp_path: Path, back_end: str, measured: bool
) -> None:
    armed = list[int]()
    waits = [0] * measured
    run, here = run_of(tmp_path, one_server_plan(), back_end, waits, **MOVED, arm=armed.append)
    moved = next(following(run, here, [here]))
    assert bool(moved) == (measured and back_end != "fifo")
    assert armed == [(50 * MS + moved) % run.anchored.plan.cycle_ns] * bool(moved)


def test_a_timer_that_comes_earlier_is_not_counted_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """-50 ppm are -0.5 ms in the 10 s until the first look. Slots move there, and what was seen is
    none of it any more: it had been told as 1 ms.
    """
    looks = iter([-MS // 2])

    def look(_: DriftWatch, _near: int | None, _expected: int, _cycles: int) -> int:
        for seen in looks:
            return seen
        raise OperationError("the thread has ended")

    monkeypatch.setattr(DriftWatch, "_look", look)
    monkeypatch.setattr(DriftWatch, "EVERY_S", 0.0)
    watch = DriftWatch(1, [1], 100 * MS, 48 * MS)
    wait_for(lambda: watch.looks == 1, "the look")
    open_ = ((0, 100 * MS),)  # nothing stops it
    run, here = run_of(
        tmp_path, one_server_plan(), waits_ns=[LEAD_NS], slots=open_, arm=lambda _: None
    )
    moved_ns = next(following(run, here, [watch]))
    assert moved_ns == run.anchored.anchor_ns - 50 * MS == -MS // 2
    assert moved_ns + known(watch.surely_ns) == -MS // 2


def test_a_look_during_which_slots_moved_is_soon_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Slots open earlier until their timer is seen: seconds, not two times ten of them."""
    expected_by, watches = list[int](), list[DriftWatch]()

    def look(_: DriftWatch, _near: int | None, expected: int, _cycles: int) -> int:
        expected_by.append(expected)
        if len(expected_by) == 2:
            watches[0].expect(expected - MS)  # slots move meanwhile
        if len(expected_by) == 3:
            raise OperationError("the thread has ended")
        return 0

    monkeypatch.setattr(DriftWatch, "_look", look)
    monkeypatch.setattr(DriftWatch, "EVERY_S", 1e6)
    monkeypatch.setattr(DriftWatch, "SOON_S", 0.01)
    watches.append(DriftWatch(1, [1], 100 * MS, 48 * MS))
    watches[0].look_soon = True
    wait_for(lambda: watches[0].looks == 1, "the first look")
    watches[0].look_soon = True
    wait_for(lambda: len(expected_by) == 3, "the look to be repeated")
    assert expected_by == [48 * MS, 48 * MS, 47 * MS]
    assert watches[0].looks == 1, "what was seen while slots moved counts for nothing"


def test_a_run_says_while_its_slots_open_early(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From before they do, until three cycles behind the look that has seen the timer."""
    now = [1_000 * S]
    monkeypatch.setattr("time.monotonic_ns", lambda: now[0])
    early_as_armed = list[bool]()

    def arm(_: int) -> None:
        early_as_armed.append(begun.anchored.opens_early)

    begun, here = run_of(tmp_path, one_server_plan(), waits_ns=[LEAD_NS], **MOVED, arm=arm)
    moves, seen = following(begun, here, [here]), list[tuple[int, bool, bool]]()
    # The slot let it go; half a minute later the timer is looked for, and 0.4 ms earlier again,
    # which is when it is where it was: 2 ms before the slot.
    for looks, begins_ns in enumerate((0, 0, AHEAD_NS, AHEAD_NS + ONCE_MORE_NS), start=1):
        now[0] += 30 * S
        here.looks, here.latest_ns, here.slots_wait = looks, begins_ns, False
        seen.append((next(moves), begun.anchored.opens_early, here.slots_wait))
    first = -LEAD_NS - AHEAD_NS
    assert seen[:3] == [(0, False, False), (first, True, True), (first - ONCE_MORE_NS, True, True)]
    assert abs(seen[3][0]) < MS and seen[3][1:] == (True, False)
    assert early_as_armed == [True, True, True]
    now[0] += 3 * begun.anchored.plan.cycle_ns
    assert not begun.anchored.opens_early


def test_slots_that_open_early_wait_for_a_short_look(monkeypatch: pytest.MonkeyPatch) -> None:
    """The chain began 2 ms sooner for 10 of 40 s; where nothing is seen, looks are as always."""
    looked, watches = list[int](), list[DriftWatch]()

    def look(_: DriftWatch, _near: int | None, _expected: int, cycles: int) -> int | None:
        looked.append(cycles)
        if len(looked) == 4:
            raise OperationError("the thread has ended")
        if len(looked) == 2:
            watches[0].slots_wait = True
            watches[0].expect(47 * MS)  # slots move during the short look
        return None if len(looked) == 3 else 0

    monkeypatch.setattr(DriftWatch, "_look", look)
    monkeypatch.setattr(DriftWatch, "EVERY_S", 1e6)
    watches.append(DriftWatch(1, [1], 100 * MS, 48 * MS))
    watches[0].look_soon = True
    wait_for(lambda: watches[0].looks == 1, "the first look")
    assert not watches[0].slots_wait
    watches[0].slots_wait = True
    wait_for(lambda: len(looked) == 4, "looks until it is seen")
    assert looked == [8, 4, 4, 8]
    assert watches[0].looks == 1


def test_a_run_that_is_to_end_while_its_slots_move_has_not_failed(tmp_path: Path) -> None:
    """Re-arming waits for answers; asked to end meanwhile, it gives up with an error of its own."""

    def arm(_: int) -> None:
        raise OperationError("the run was asked to end")

    run, here = run_of(tmp_path, one_server_plan(), waits_ns=[0], **MOVED, arm=arm)
    with pytest.raises(OperationError):
        next(following(run, here, [here]))
    run.stop.set()
    moves = following(run, here, [here])
    assert next(moves) == 0, "they stay where they were"
    next(moves)
    assert run.report.state.anchor_ns is None


@pytest.mark.parametrize(
    ("back_end", "slots", "wait", "early"),
    [
        ("freezer", [(0, 30)], 3, 0),
        ("freezer", [(0, 100)], 3, 3),
        ("freezer", [(0, 20), (40, 100)], 3, 3),
        ("freezer", [(10, 100)], 3, 0),
        # Under priorities alone: slots of chains that share a core wait for the latest timer.
        ("fifo", [(0, 30)], 22, 22),
        ("fifo", [(0, 30)], None, LEAD_NS // MS),
    ],
)
def test_a_chain_begins_with_its_timer_unless_its_server_is_closed_then(
    tmp_path: Path, back_end: str, slots: list[tuple[int, int]], wait: int | None, early: int
) -> None:
    """Nodes that publish in slots get that instant: outputs without a stamp came 2 ms late."""
    longer = tuple((start * MS, end * MS) for start, end in slots)
    waits = [] if wait is None else [wait * MS]
    run, _ = run_of(tmp_path, one_server_plan(), back_end, waits, longer)
    assert run.anchored.early(0) == early * MS
    assert run.anchored.begins(0) == (50 - early) * MS


@pytest.mark.parametrize(("end", "slots"), [(30, ((0, 30 * MS),)), (100, ())])
def test_short_runs_are_looked_at_where_no_server_stops_a_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: int, slots: tuple[tuple[int, int], ...]
) -> None:
    """What a server has stopped wakes up for short; so does a sensor that only publishes."""
    plan = one_server_plan()
    run, _ = run_of(tmp_path, plan, waits_ns=[3 * MS], slots=((0, end * MS),))
    governed = SimpleNamespace(name=plan.servers[0].name, threads=(7,))
    run.report.state = SimpleNamespace(servers=[governed], anchor_ns=0)  # type: ignore[assignment]
    first = SimpleNamespace(pid=7, tid=7, identity=(7, 1))
    watched: list[Any] = []
    monkeypatch.setattr(anchoring, "first_threads", lambda *_: [(first,)])
    monkeypatch.setattr(origins, "DriftWatch", lambda *given, **_: watched.append(given[-1]))
    run.origins.start(run.anchored, run.threads.latest, run.report)
    assert watched == [slots]


def test_a_place_that_another_chain_has_is_why_slots_do_not_follow() -> None:
    """It had been a traceback, and no word of it in the run."""

    def refuse(_: int) -> int:
        raise InputError("there is another chain's slot")

    follower = object.__new__(SlotFollower)
    follower._thread = Background("", follower._follow, "following")
    follower._chain, follower._planned_ns = cast("ChainPlan", SimpleNamespace(cycle_ns=MS)), 0
    tail = SimpleNamespace(start_ns=0)
    tail.add = lambda seen_ns: setattr(tail, "start_ns", seen_ns)
    follower._tail, follower._put_in_force = cast("Tail", tail), refuse
    follower._output = cast("FollowedOutput", SimpleNamespace(latencies=lambda: [MS]))
    follower._thread.run()
    assert str(follower.failure) == "there is another chain's slot"


@pytest.mark.parametrize("thread", ["free", "in-slots"])
def test_servers_and_gate_move_with_the_same_cycle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, thread: str
) -> None:
    """Cycles of 50 ms begin at 7 ms; R_m [0, 21 ms) is open to their end, R_m° [21, 22) is not."""
    run, _ = run_of(tmp_path, revised(small_chain_plan(10 * MS, 20 * MS), shaping_thread=thread))
    plan, run.followers.servers = run.anchored.given, object.__new__(Freezer)
    changed: list[Any] = []
    in_force = 10**15 // (50 * MS) * 50 * MS + 7 * MS
    monkeypatch.setattr(Freezer, "change", lambda _, table, anchor: changed.append((table, anchor)))
    monkeypatch.setattr(Freezer, "in_force_from", lambda _: in_force)
    find_anchor(run, 5 * MS)  # the timer expires 2 ms before its slot
    run.report.state = replace(run.report.state, anchor_ns=7 * MS)
    from_ns = run.followers.move_slots(0, 3 * MS)
    assert from_ns % (50 * MS) == (7 - 25) * MS % (50 * MS), "half a cycle before one begins"
    if thread == "free":
        assert not changed, "only the gate moves"
        assert from_ns > time.monotonic_ns() + 50 * MS, "announced"
    else:
        ((table, anchor),) = changed
        assert anchor == 7 * MS
        assert {s.name: s.slots for s in table.servers}["output"] == ((19 * MS, 50 * MS),)
        assert from_ns == in_force - 25 * MS, "with the first cycle that the servers have so"
    move = SlotMove(from_ns, "/t1..", 3 * MS, 24 * MS, "its promise did not hold any more")
    follower: Any = SimpleNamespace(moves=(move,), failure=OperationError("gone"), end=lambda: None)
    run.followers.running[0] = follower
    run.followers.show(run.report)
    assert run.report.state.moves == (move,)
    slots = {one.name: one.slots for one in run.report.state.servers}
    assert slots["chain"] == ((0, 50 * MS),)
    assert (
        slots["output"] == ((19 * MS, 50 * MS),) if thread == "in-slots" else ((24 * MS, 25 * MS),)
    )
    assert run.report.state.notes[-1] == "slots are as planned, and do not follow any more: gone"
    assert not run.followers.running
    assert run.anchored.plan == open_until_done(plan)
    if thread == "in-slots":
        assert {s.name: s.slots for s in changed[-1][0].servers}["output"] == ((16 * MS, 50 * MS),)
    assert "begins at 24 ms now: its promise did not hold" in str(
        servers_table(run.report.state).caption
    )


# Threads that appear while a plan is in force.


def node(tid: int, name: str = "/origin") -> NodeThread:
    """The executor of a node's process, which has no other thread."""
    thread = RunningThread(tid, tid, "node", "executor", "SCHED_OTHER", 0, (0,), started=tid)
    return NodeThread(thread, (name,), "main thread", "command line")


def found(*tids: int) -> Allocation:
    return Allocation(tuple(map(node, tids)), ())


class Watch:
    """A watch over where a thread begins, that sees nothing."""

    looks, latest_ns, surely_ns, failure = 0, None, None, None
    look_soon = slots_wait = False

    def __init__(
        self, _: int, tids: Sequence[int], __: int, expected_ns: int, *___: Any, **____: Any
    ):
        self.watched, self.ended = (*tids, expected_ns), False

    def end(self) -> None:
        self.ended = True


TIMERS = {7: 5 * MS, 8: 61 * MS}  # where they expire in each 100 ms, by their threads


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Supervision:
    """A run of the freezer on node 7, whose slot opens 2 ms behind its timer."""
    run, _ = run_of(tmp_path, one_server_plan(), read=lambda *_: ())
    monkeypatch.setattr(run_threads, "change_all", lambda *_: None)
    monkeypatch.setattr(supervision, "note_descendants", lambda *_: set())
    monkeypatch.setattr(origins, "DriftWatch", Watch)
    monkeypatch.setattr(
        anchoring, "measure_phase", lambda _, tids, *__, **___: Phase(TIMERS[tids[0]], 0)
    )
    run.threads.latest = found(7)
    find_anchor(run, None)
    run.origins.start(run.anchored, run.threads.latest, run.report)
    run.origins.watches.clear()  # it knows who begins the chain, and watches anew
    return run


def servers(assign: Callable[[int, str, int], None], arm: Callable[[int], None]) -> Any:
    counters: dict[str, ServerCounters] = {}
    return SimpleNamespace(assign=assign, arm=arm, counters=lambda: counters, failure=lambda: None)


@pytest.mark.parametrize("error", [OperationError, PlatformError])
def test_a_thread_that_cannot_be_put_into_its_server_is_named_and_ends_no_plan(
    run: Supervision, monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    """As in a container that began later, whose cgroups are not to be seen."""

    def assign(tid: int, _: str, __: int) -> None:
        raise error(f"thread {tid} is in the cgroup /../x")

    monkeypatch.setattr(run.threads, "find", lambda _: found(8))
    run.servers = servers(assign, lambda _: None)
    new, untaken = run.look_again(())
    assert [one.thread.tid for one in new] == [8]
    assert untaken == "threads that have appeared are as they were: thread 8 is in the cgroup /../x"
    assert [one.thread.tid for one in run.threads.latest.threads] == [7], "it is tried again"


def test_slots_count_from_the_new_timer_of_a_first_node_that_is_started_again(
    run: Supervision, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It expires at 61 ms instead of 5: they had stayed at 7, and nobody had looked any more."""
    done: list[tuple[str, int]] = []
    run.servers = servers(
        lambda tid, _, __: done.append(("assigned", tid)), lambda at: done.append(("armed", at))
    )
    monkeypatch.setattr(supervision, "LOOK_S", 0.001)
    monkeypatch.setattr(apply, "put_back", lambda *_: None)
    monkeypatch.setattr(run.threads, "find", lambda _: found(8))
    monkeypatch.setattr(
        run.phases, "send", lambda *_: done.append(("told", run.anchored.begins(0)))
    )
    assign_threads(run.threads, run.anchored, run.servers, run.report, run.go_on)
    watches: list[Any] = []
    states: list[RunState] = []

    def watch(state: RunState) -> None:
        states.append(state)
        watches.extend(one for one in run.origins.watches if one not in watches)
        if len(states) == 4:
            run.stop.set()

    run.watch_over(watch)
    assert done == [("assigned", 7), ("armed", 63 * MS), ("told", 63 * MS), ("assigned", 8)]
    assert [one.watched for one in watches] == [(7, 7 * MS), (8, 63 * MS)]
    assert [one.ended for one in watches] == [True, False]
    assert {state.anchor_ns for state in states[1:]} == {63 * MS}
    (note,) = states[-1].notes
    assert "was started again: slots count from its new timer since" in note
    apply._Run(run.threads.journal, origins=run.origins).put_back()
    assert watches[1].ended, "a program that goes on would keep it"


def test_a_thread_more_in_the_executor_that_begins_is_no_other_beginning(
    run: Supervision, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As rclpy's pool gets: the slots, which stop its other threads, stay where they are."""
    assigned: list[int] = []
    run.servers = servers(
        lambda tid, _, __: assigned.append(tid), lambda _: pytest.fail("slots moved")
    )
    pool = tuple(replace(node(tid), thread=replace(node(tid).thread, pid=7)) for tid in (7, 8))
    monkeypatch.setattr(run.threads, "find", lambda _: Allocation(pool, ()))
    assert run.look_again(())[1] == ""
    assert 8 in assigned
    assert run.anchored.anchor_ns == 7 * MS


def test_a_first_node_that_is_started_again_without_a_timer_yet_is_looked_at_again(
    run: Supervision, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It runs freely until then: in its server it would begin with the slot, wherever that is."""
    assigned: list[int] = []
    run.servers = servers(lambda tid, _, __: assigned.append(tid), lambda _: None)
    monkeypatch.setattr(run.threads, "find", lambda _: found(8))

    def measure(*_: Any, **__: Any) -> Phase:
        raise OperationError("thread 8 does not wake up at one place of the cycle 100 ms")

    with monkeypatch.context() as until:
        until.setattr(anchoring, "measure_phase", measure)
        assert "thread 8 does not wake up" in run.look_again(())[1]
    assert (assigned, run.anchored.anchor_ns) == ([], 7 * MS)
    assert run.look_again(())[1] == ""
    assert (assigned, run.anchored.anchor_ns) == ([8], 63 * MS)


def test_of_two_chains_only_the_timer_that_is_new_is_measured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The other's thread is stopped outside its slots, and begins with these."""
    measured: list[int] = []
    one, other = (
        revised(plan_for(server(name, name, (0, 20))), offset_ns=at * MS)
        for name, at in (("a", 0), ("b", 50))
    )
    plan = Plan.of(one, other)
    start = Allocation((node(7, "/a"), node(9, "/b")), ())
    phases = [Phase(5 * MS, 0), Phase(58 * MS, 0)]

    def measure(_: int, tids: Sequence[int], *__: Any, **___: Any) -> Phase:
        measured.extend(tids)
        return phases[1]

    monkeypatch.setattr(anchoring, "measure_phase", measure)
    again = Allocation((node(7, "/a"), node(8, "/b")), ())
    known = dict(enumerate(phases))
    given, anchor_ns, waits_ns, _ = anchoring.carried_out(plan, start, None, known=known)
    assert (anchor_ns, waits_ns) == (10 * MS, [5 * MS, 2 * MS])
    del known[1]
    assert anchoring.carried_out(given, again, None, known=known)[1:3] == (anchor_ns, waits_ns)
    assert measured == [8]


def test_a_thread_that_fails_while_it_looks_or_follows_says_why(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: object) -> int:
        raise ZeroDivisionError("nothing to divide by")

    monkeypatch.setattr(DriftWatch, "_look", fail)
    monkeypatch.setattr(DriftWatch, "EVERY_S", 0.0)
    watch = DriftWatch(1, [1], 100 * MS, 48 * MS)
    wait_for(lambda: watch.failure is not None, "the watch to end")
    why = "looking for it has failed (ZeroDivisionError: nothing to divide by)"
    assert str(watch.failure) == why
    follower = SlotFollower.__new__(SlotFollower)
    follower._thread = Background("", follower._follow, "following")
    follower._chain, follower._tail = (
        cast("ChainPlan", SimpleNamespace(cycle_ns=1)),
        cast("Tail", None),
    )
    follower._thread.run()
    assert str(follower.failure).startswith("following has failed (AttributeError: ")
