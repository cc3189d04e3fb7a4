"""Slots that follow a timer: an hour of a timer that is some ppm off, as a drift watch sees it."""

import random
import time
from collections.abc import Callable
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


@pytest.mark.parametrize("ppm", [0, 0.5, 5, -5, 50, -50])
def test_slots_stay_by_their_timer_for_an_hour(ppm: float) -> None:
    """50 ppm off it moves by 180 ms in that time."""
    waits, track, moves = waits_of(ppm)
    assert min(waits[6:]) > -1.6 * MS, "of which 1 ms is in the margin"
    assert min(waits[:6]) > -2 * MS, "before the rate is known"
    assert max(waits) < 3 * MS
    assert abs(track.rate * 1e6 - ppm) < 0.5
    if abs(ppm) < 1:
        assert moves < 50, "where nothing drifts, slots hardly move"


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("ppm", [0, 50, -50])
def test_a_thread_that_takes_a_while_to_be_let_go_is_no_timer(ppm: float, seed: int) -> None:
    """As on a virtual machine, where such threads had moved slots by 10 ms in a minute."""
    waits, track, _ = waits_of(ppm, let_go=(300_000, 90_000), seed=seed)
    assert min(waits) > -2.5 * MS
    assert max(waits) < 4 * MS
    assert abs(track.rate * 1e6 - ppm) < 2


@pytest.mark.parametrize("ppm", [0, 50, -50])
def test_a_busy_machine_is_no_timer(ppm: float) -> None:
    """Half of the time threads begin up to 2 ms late: an hour of it had moved slots by 4.4 s."""
    waits, track, _ = waits_of(
        ppm, busy=lambda now, noise: (now // (300 * S)) % 2 * noise.randrange(2 * MS)
    )
    assert min(waits) > -5 * MS
    assert max(waits) < 12 * MS
    assert abs(track.rate * 1e6 - ppm) < 15


def test_without_looking_a_timer_that_falls_behind_is_followed() -> None:
    waits, _, _ = waits_of(50, looks=False)
    assert min(waits) > -1.2 * MS
    assert waits_of(0, looks=False)[2] == 0


@pytest.mark.parametrize("measured", [True, False])
@pytest.mark.parametrize("back_end", ["scx", "litmus", "freezer", "fifo"])
def test_every_back_end_that_gates_follows_a_phase_that_was_measured(
    tmp_path: Path, back_end: str, measured: bool
) -> None:
    plan, armed = whole(one_server_plan()), list[int]()
    seen = {"latest_ns": MS, "looks": 1, "expect": lambda _: None}
    here: Any = SimpleNamespace(path=tmp_path / "j", strangers=None, arm=armed.append, **seen)
    run = _Run(plan, plan, Choice(back_end, ""), here, (), frozenset(), Event())
    run.waits_ns, run.found = [0] * measured, here
    run.begin_state((), "")
    moved = next(run.follow(here, [here]))
    assert bool(moved) == (measured and back_end != "fifo")
    assert armed == [moved % plan.cycle_ns] * bool(moved)


def test_a_timer_that_comes_earlier_is_not_counted_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """-50 ppm are -0.5 ms in the 10 s until the first look. Slots move there, and what was seen is
    none of it any more: it had been told as 1 ms.
    """
    (chain,) = whole(one_server_plan()).chains
    server = chain.servers[0].model_copy(update={"slots": ((0, 100 * MS),)})  # nothing stops it
    plan, looks = whole(chain.model_copy(update={"servers": (server,)})), iter([-MS // 2])

    def look(_: DriftWatch, _near: int | None, _expected: int) -> int:
        for seen in looks:
            return seen
        raise OperationError("the thread has ended")

    monkeypatch.setattr(DriftWatch, "_look", look)
    monkeypatch.setattr(DriftWatch, "EVERY_S", 0.0)
    watch = DriftWatch(1, [1], 100 * MS, 48 * MS)
    wait_for(lambda: watch.looks == 1, "the look")
    here: Any = SimpleNamespace(path=tmp_path / "j", strangers=None, arm=lambda _: None)
    run = _Run(plan, plan, Choice("freezer", ""), here, (), frozenset(), Event())
    run.waits_ns, run.anchor_ns, run.found = [LEAD_NS], 50 * MS, here
    run.begin_state((), "")
    moved_ns = next(run.follow(here, [watch]))
    assert moved_ns == run.anchor_ns - 50 * MS == -MS // 2
    assert moved_ns + known(watch.surely_ns) == -MS // 2


def test_a_run_that_is_to_end_while_its_slots_move_has_not_failed(tmp_path: Path) -> None:
    """Re-arming waits for answers; asked to end meanwhile, it gives up with an error of its own."""
    plan, stop = whole(one_server_plan()), Event()

    def arm(_: int) -> None:
        raise OperationError("the run was asked to end")

    seen = {"latest_ns": MS, "looks": 1, "expect": lambda _: None}
    here: Any = SimpleNamespace(path=tmp_path / "j", strangers=None, arm=arm, **seen)
    run = _Run(plan, plan, Choice("freezer", ""), here, (), frozenset(), stop)
    run.waits_ns, run.found = [0], here
    run.begin_state((), "")
    with pytest.raises(OperationError):
        next(run.follow(here, [here]))
    stop.set()
    following = run.follow(here, [here])
    assert next(following) == 0, "they stay where they were"
    next(following)
    assert run.state.anchor_ns is None


@pytest.mark.parametrize(
    ("slots", "early_ns"),
    [([(0, 30)], 0), ([(0, 100)], 3 * MS), ([(0, 20), (40, 100)], 3 * MS), ([(10, 100)], 0)],
)
def test_a_chain_begins_with_its_timer_unless_its_server_is_closed_then(
    tmp_path: Path, slots: list[tuple[int, int]], early_ns: int
) -> None:
    """Nodes that publish in slots get that instant: outputs without a stamp came 2 ms late."""
    (chain,) = whole(one_server_plan()).chains
    longer = tuple((start * MS, end * MS) for start, end in slots)
    server = chain.servers[0].model_copy(update={"slots": longer})
    plan = whole(chain.model_copy(update={"servers": (server,), "cycle_ns": 100 * MS}))
    here: Any = SimpleNamespace(path=tmp_path / "j", strangers=None)
    run = _Run(plan, plan, Choice("freezer", ""), here, (), frozenset(), Event())
    run.waits_ns, run.anchor_ns = [3 * MS], 50 * MS
    assert run.early(0) == early_ns
    assert run.begins(0) == 50 * MS - early_ns


def test_under_priorities_alone_each_chain_begins_with_its_own_timer(tmp_path: Path) -> None:
    """Slots of chains that share a core wait for the latest timer: 2 ms by themselves, or more."""
    plan = whole(one_server_plan())
    here: Any = SimpleNamespace(path=tmp_path / "j", strangers=None)
    run = _Run(plan, plan, Choice("fifo", ""), here, (), frozenset(), Event())
    assert run.early(0) == LEAD_NS
    run.waits_ns, run.anchor_ns = [22 * MS], 50 * MS
    assert (run.early(0), run.begins(0)) == (22 * MS, 28 * MS)


@pytest.mark.parametrize(("end", "slots"), [(30, ((0, 30 * MS),)), (100, ())])
def test_short_runs_are_looked_at_where_no_server_stops_a_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: int, slots: tuple[tuple[int, int], ...]
) -> None:
    """What a server has stopped wakes up for short; so does a sensor that only publishes."""
    (chain,) = whole(one_server_plan()).chains
    server = chain.servers[0].model_copy(update={"slots": ((0, end * MS),)})
    plan = whole(chain.model_copy(update={"servers": (server,), "cycle_ns": 100 * MS}))
    here: Any = SimpleNamespace(path=tmp_path / "j", strangers=None)
    run = _Run(plan, plan, Choice("freezer", ""), here, (), frozenset(), Event())
    run.waits_ns, run.found = [3 * MS], here
    governed = SimpleNamespace(name=server.name, threads=(7,))
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
    plan = whole(revised(small_chain_plan(10 * MS, 20 * MS), shaping_thread=thread))
    here: Any = SimpleNamespace(path=tmp_path / "j", strangers=None)
    run = _Run(plan, open_until_done(plan), Choice("freezer", ""), here, (), frozenset(), Event())
    run.found, run.servers = here, object.__new__(Freezer)
    changed: list[Any] = []
    in_force = 10**15 // (50 * MS) * 50 * MS + 7 * MS
    monkeypatch.setattr(Freezer, "change", lambda _, table, anchor: changed.append((table, anchor)))
    monkeypatch.setattr(Freezer, "in_force_from", lambda _: in_force)
    run.begin_state((), "")
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
