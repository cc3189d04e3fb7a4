"""Slots that follow a timer: an hour of a timer that is some ppm off, as a drift watch sees it."""

import random
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any, cast

import pytest
from applied_plans import one_server_plan
from known import known
from processes import wait_for
from small_chain import small_chain_plan

from chainshaper.enforcement.back_ends import Choice
from chainshaper.enforcement.freezer import Freezer
from chainshaper.enforcement.undoing import SlotMove
from chainshaper.flow import apply as applying
from chainshaper.flow import threads
from chainshaper.flow.apply import _Run
from chainshaper.flow.drift import SlotFollower, TimerTrack
from chainshaper.flow.phase import DriftWatch
from chainshaper.planning.application_plan import open_until_done, whole
from chainshaper.planning.margins import Tail
from chainshaper.planning.plan import Plan, revised
from chainshaper.reporting.overviews import servers_table
from chainshaper.splicing.shaped_outputs import FollowedOutput
from chainshaper.values.errors import InputError, OperationError

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
    plan: Plan,
    back_end: str = "freezer",
    waits_ns: Sequence[int] = (),
    slots: tuple[tuple[int, int], ...] | None = None,
    **seen: Any,
) -> tuple[_Run, Any]:
    """A run that has begun, with others' ``slots``, and what stands for all else that it sees."""
    if slots is not None:
        server = plan.servers[0].model_copy(update={"slots": slots})
        plan = plan.model_copy(update={"servers": (server,), "cycle_ns": 100 * MS})
    here: Any = SimpleNamespace(path=folder / "j", strangers=None, **seen)
    joint = whole(plan)
    run = _Run(joint, open_until_done(joint), Choice(back_end, ""), here, (), frozenset(), Event())
    run.waits_ns, run.found, run.anchor_ns = [*waits_ns], here, 50 * MS
    run.begin_state((), "")
    return run, here


MOVED: dict[str, Any] = {"latest_ns": MS, "looks": 1, "expect": lambda _: None}


@pytest.mark.parametrize("measured", [True, False])
@pytest.mark.parametrize("back_end", ["scx", "litmus", "freezer", "fifo"])
def test_every_back_end_that_gates_follows_a_phase_that_was_measured(
    tmp_path: Path, back_end: str, measured: bool
) -> None:
    armed = list[int]()
    waits = [0] * measured
    run, here = run_of(tmp_path, one_server_plan(), back_end, waits, **MOVED, arm=armed.append)
    moved = next(run.follow(here, [here]))
    assert bool(moved) == (measured and back_end != "fifo")
    assert armed == [(50 * MS + moved) % run.plan.cycle_ns] * bool(moved)


def test_a_timer_that_comes_earlier_is_not_counted_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """-50 ppm are -0.5 ms in the 10 s until the first look. Slots move there, and what was seen is
    none of it any more: it had been told as 1 ms.
    """
    looks = iter([-MS // 2])

    def look(_: DriftWatch, _near: int | None, _expected: int) -> int:
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
    moved_ns = next(run.follow(here, [watch]))
    assert moved_ns == run.anchor_ns - 50 * MS == -MS // 2
    assert moved_ns + known(watch.surely_ns) == -MS // 2


def test_a_run_that_is_to_end_while_its_slots_move_has_not_failed(tmp_path: Path) -> None:
    """Re-arming waits for answers; asked to end meanwhile, it gives up with an error of its own."""

    def arm(_: int) -> None:
        raise OperationError("the run was asked to end")

    run, here = run_of(tmp_path, one_server_plan(), waits_ns=[0], **MOVED, arm=arm)
    with pytest.raises(OperationError):
        next(run.follow(here, [here]))
    run.stop.set()
    following = run.follow(here, [here])
    assert next(following) == 0, "they stay where they were"
    next(following)
    assert run.state.anchor_ns is None


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
    assert run.early(0) == early * MS
    assert run.begins(0) == (50 - early) * MS


@pytest.mark.parametrize(("end", "slots"), [(30, ((0, 30 * MS),)), (100, ())])
def test_short_runs_are_looked_at_where_no_server_stops_a_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: int, slots: tuple[tuple[int, int], ...]
) -> None:
    """What a server has stopped wakes up for short; so does a sensor that only publishes."""
    plan = one_server_plan()
    run, _ = run_of(tmp_path, plan, waits_ns=[3 * MS], slots=((0, end * MS),))
    governed = SimpleNamespace(name=plan.servers[0].name, threads=(7,))
    run.state = SimpleNamespace(servers=[governed], anchor_ns=0)  # type: ignore[assignment]
    first = SimpleNamespace(pid=7, tid=7, identity=(7, 1))
    watched: list[Any] = []
    monkeypatch.setattr(threads, "first_threads", lambda *_: [(first,)])
    monkeypatch.setattr(applying, "DriftWatch", lambda *given, **_: watched.append(given[-1]))
    run.drift_watches()
    assert watched == [slots]


def test_a_place_that_another_chain_has_is_why_slots_do_not_follow() -> None:
    """It had been a traceback, and no word of it in the run."""

    def refuse(_: int) -> int:
        raise InputError("there is another chain's slot")

    follower = object.__new__(SlotFollower)
    follower._cores, follower._stop, follower.failure = (), Event(), None
    follower._chain, follower._planned_ns = cast("Plan", SimpleNamespace(cycle_ns=MS)), 0
    tail = SimpleNamespace(start_ns=0)
    tail.saw = lambda seen_ns: setattr(tail, "start_ns", seen_ns)
    follower._tail, follower._put_in_force = cast("Tail", tail), refuse
    follower._output = cast("FollowedOutput", SimpleNamespace(latencies=lambda: [MS]))
    follower._follow()
    assert str(follower.failure) == "there is another chain's slot"


@pytest.mark.parametrize("thread", ["free", "in-slots"])
def test_servers_and_gate_move_with_the_same_cycle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, thread: str
) -> None:
    """Cycles of 50 ms begin at 7 ms; R_m [0, 21 ms) is open to their end, R_m° [21, 22) is not."""
    run, _ = run_of(tmp_path, revised(small_chain_plan(10 * MS, 20 * MS), shaping_thread=thread))
    plan, run.servers = run.given, object.__new__(Freezer)
    changed: list[Any] = []
    in_force = 10**15 // (50 * MS) * 50 * MS + 7 * MS
    monkeypatch.setattr(Freezer, "change", lambda _, table, anchor: changed.append((table, anchor)))
    monkeypatch.setattr(Freezer, "in_force_from", lambda _: in_force)
    run.find_anchor(5 * MS, lambda *_: None)  # the timer expires 2 ms before its slot
    run.state = replace(run.state, anchor_ns=7 * MS)
    from_ns = run.move_slots(0, 3 * MS)
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
    run.followers[0] = follower
    run.show_moves()
    assert run.state.moves == (move,)
    slots = {one.name: one.slots for one in run.state.servers}
    assert slots["chain"] == ((0, 50 * MS),)
    assert (
        slots["output"] == ((19 * MS, 50 * MS),) if thread == "in-slots" else ((24 * MS, 25 * MS),)
    )
    assert run.state.notes[-1] == "slots are as planned, and do not follow any more: gone"
    assert not run.followers
    assert run.plan == open_until_done(plan)
    if thread == "in-slots":
        assert {s.name: s.slots for s in changed[-1][0].servers}["output"] == ((16 * MS, 50 * MS),)
    assert "begins at 24 ms now: its promise did not hold" in str(servers_table(run.state).caption)
