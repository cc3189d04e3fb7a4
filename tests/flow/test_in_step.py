"""Outputs and loops in step: clocks that drift for half an hour, restarts, places out of reach."""

import random
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any, cast

import pytest
from known import known
from pydantic import TypeAdapter
from small_chain import small_chain_plan

from chainshaper.analysis.loop_rates import LoopRate
from chainshaper.enforcement.journal import STATE_FILE
from chainshaper.enforcement.undoing import LoopState, RunState, save_run_state
from chainshaper.flow import apply, in_step
from chainshaper.flow.in_step import InStep, OwnStarts, loops_in_step, next_move
from chainshaper.monitor import watch as watch_module
from chainshaper.monitor.watch import Seen, Watch, _values
from chainshaper.monitor.watched_loops import LoopNow
from chainshaper.planning.chain_plan import (
    ChainPlan,
    LoopAge,
    PlannedLoop,
    loop_common_ns,
    publish_slots,
    revised,
)
from chainshaper.planning.plan import Plan
from chainshaper.reporting.overviews import servers_table, watch_tables
from chainshaper.sources.preload import LoopMoved, named_loops
from chainshaper.values.errors import InputError, PlatformError

MS, S = 1_000_000, 1_000_000_000
LEAD = 1 * MS
LOOK_S = 0.5  # of the time in the tests' worlds
AGE = LoopAge(first_ns=(0, 0), every_ns=(0, 0), constant=True, uses=(1, 1))


def plan_in_step(moves: str, period_ns: int = 10 * MS, latest_ns: int = 45 * MS) -> ChainPlan:
    """The small chain, every 50 ms, with a loop."""
    chain = small_chain_plan(10 * MS, 20 * MS)
    starts_ns = publish_slots(chain)[0][0], latest_ns
    loop = PlannedLoop(
        node="/controller",
        topic="/t3",
        period_ns=period_ns,
        samples=1,
        delivery_ns=(0, 0, 0),
        lead_ns=LEAD,
        in_step=cast("Any", moves),
        starts_ns=starts_ns if moves == "output" else None,
        move_ns=0 if moves == "loop" else None,
        age=AGE,
    )
    return revised(chain, loop=loop)


@dataclass
class World:
    """A chain and a loop whose clocks differ, as they are seen from look to look (ns)."""

    plan: ChainPlan
    ppm: float
    first_ns: int = 1_000 * S + 3_456_789
    work_ns: int = 0  # of the loop; it leaves instances out where a move leaves it too little time
    now_ns: int = 1_000 * S
    moved_ns: int = 0  # the output's slots
    kept_ns: int = 0  # what is added to the loop's sleeps
    asked: list[int] = field(default_factory=list)
    moves: list[LoopMoved] = field(default_factory=list)
    given_back: int = 0
    turn_ns: int = 0  # is not seen
    alive: bool = True
    early_ns: int = 0  # the chain begins so much sooner, for its timer to be seen
    draw: random.Random = field(default_factory=lambda: random.Random(1))
    tid: int = 7

    @property
    def period_ns(self) -> float:
        assert self.plan.loop is not None and self.plan.loop.period_ns is not None
        return self.plan.loop.period_ns * (1 + self.ppm * 1e-6)

    def own_start(self, instant_ns: int) -> int:
        """The latest start of the loop by itself before an instant."""
        turns = (instant_ns - self.first_ns) // self.period_ns
        return round(self.first_ns + turns * self.period_ns)

    # As the output that is followed

    def origins(self, cycle_ns: int) -> list[int]:
        begun = self.now_ns - self.now_ns % cycle_ns - self.early_ns
        return [begun + self.draw.randrange(20_000)]

    def move_output(self, by_ns: int, _: int) -> None:
        self.moved_ns = by_ns
        self.asked.append(by_ns)

    # As the loop that is followed

    @property
    def is_there(self) -> bool:
        return self.alive

    def seen(self) -> tuple[list[int], list[LoopMoved]]:
        since, starts = self.now_ns - round(LOOK_S * S), list[int]()
        start = self.own_start(self.now_ns)
        while start > since - self.kept_ns:
            starts.insert(0, start + self.kept_ns + self.draw.randrange(20_000))
            start = round(start - self.period_ns)
        moves, self.moves = self.moves, []
        return [at for at in starts if since < at <= self.now_ns], moves

    def move(self, move_ns: int, period_ns: int) -> int:
        assert 0 <= move_ns < period_ns
        number = len(self.asked) + 1
        self.asked.append(move_ns)
        added = move_ns - self.kept_ns
        self.moves.append(LoopMoved(self.now_ns, number, move_ns, added, move_ns, "kept"))
        self.kept_ns = move_ns
        if move_ns + self.work_ns > self.period_ns:
            back = LoopMoved(self.now_ns + 1, number, move_ns, -move_ns, 0, "rate changed")
            self.moves.append(back)
            self.given_back += 1
            self.kept_ns = 0
        return number

    def renew(self) -> None: ...
    def close(self) -> None: ...

    # What comes of it

    def off_ns(self) -> int:
        """How far the loop's next start is from the lead behind the output."""
        slot = publish_slots(self.plan)[0][0] + self.moved_ns
        cycle = self.now_ns - self.now_ns % self.plan.cycle_ns
        lead = self.own_start(self.now_ns) + self.kept_ns - cycle - slot - LEAD
        step = loop_common_ns(self.plan)
        return (lead + step // 2) % step - step // 2


class _Output:
    """In place of FollowedOutput."""

    def __init__(self, world: World) -> None:
        self.origins, self.move = world.origins, world.move_output

    def close(self) -> None: ...


@pytest.fixture
def follow(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[World], InStep]]:
    """Makes what keeps a world in step; it looks only when it is asked to."""
    made = list[InStep]()

    def make(world: World) -> InStep:
        monkeypatch.setattr(InStep, "_follow", lambda _: None)
        monkeypatch.setattr(in_step, "LOOK_S", LOOK_S)
        monkeypatch.setattr(in_step, "FollowedOutput", lambda *_: _Output(world))
        found = lambda: cast("Any", world) if world.alive else None  # noqa: E731
        early = lambda: world.early_ns > 0  # noqa: E731
        kept = InStep(world.plan, (), found, lambda _: world.now_ns, begins_early=early)
        made.append(kept)
        return kept

    yield make
    for kept in made:
        kept.end()


def run(world: World, kept: InStep, seconds: float) -> list[int]:
    """How far off the loop was, look by look."""
    off = list[int]()
    for _ in range(round(seconds / LOOK_S)):
        world.now_ns += round(LOOK_S * S)
        kept.look()
        off.append(world.off_ns())
    return off


@pytest.mark.parametrize("ppm", [-50.0, 0.0, 50.0])
@pytest.mark.parametrize(("period_ns", "seconds"), [(10 * MS, 1800), (MS, 120), (100 * MS, 600)])
def test_a_loop_that_is_moved_stays_in_step(
    follow: Callable[..., InStep], ppm: float, period_ns: int, seconds: int
) -> None:
    world = World(plan_in_step("loop", period_ns), ppm)
    kept = follow(world)
    run(world, kept, 10)
    assert kept.is_in_step
    moved = len(world.asked)
    off = run(world, kept, seconds)
    assert max(map(abs, off)) < 75_000
    assert world.moved_ns == 0  # the output stays
    # 50 ppm are 90 ms in half an hour; where nothing drifts, nothing is moved.
    assert len(world.asked) - moved < (20 if ppm == 0 else 90 * MS // in_step.TOLERANCE_NS + 50)
    assert all(0 <= asked < world.period_ns for asked in world.asked)


@pytest.mark.parametrize("ppm", [-50.0, 50.0])
def test_an_output_that_is_moved_leaves_the_lead_before_the_loop(
    follow: Callable[..., InStep], ppm: float
) -> None:
    world = World(plan_in_step("output"), ppm)
    kept = follow(world)
    run(world, kept, 10)
    off = run(world, kept, 1800)
    assert max(map(abs, off)) < 75_000
    assert world.kept_ns == 0  # the loop stays
    # Never before the planned slot, by when all of the chain has come; it moves in small steps,
    # and, at the end of its range, by one step of the loop.
    assert min(world.asked) >= 0 and max(world.asked) <= 24 * MS
    steps = [abs(after - before) for before, after in pairwise(world.asked)]
    large = [step for step in steps if step > 100_000]
    assert all(abs(step - 10 * MS) < 200_000 for step in large)
    assert len(large) <= 10


def test_a_loop_that_has_no_time_left_is_late_by_no_more_than_its_work(
    follow: Callable[..., InStep],
) -> None:
    """It works for 2 of 10 ms: it cannot be moved by 8 to 10, and then starts by itself."""
    world = World(plan_in_step("loop"), -50.0, work_ns=2 * MS)
    kept = follow(world)
    off = run(world, kept, 900)
    assert 1 <= world.given_back <= 20
    late = [each for each in off[20:] if abs(each) > 75_000]
    assert all(0 <= each <= 2 * MS + 75_000 for each in late)
    assert len(late) < 0.35 * len(off)


def test_a_loop_that_was_started_again_is_measured_again(follow: Callable[..., InStep]) -> None:
    world = World(plan_in_step("loop"), 0.0)
    kept = follow(world)
    run(world, kept, 10)
    before = world.kept_ns
    world.alive = False
    run(world, kept, 2)
    assert not kept.has_loop and not kept.is_in_step
    world.alive, world.first_ns, world.kept_ns = True, world.first_ns + 4 * MS, 0
    off = run(world, kept, 10)
    assert abs(off[-1]) < 75_000
    assert world.kept_ns != before
    whys = [step.why for step in kept.steps]
    assert sum("has ended" in why for why in whys) == 1
    assert sum("was measured" in why for why in whys) == 2


def test_before_an_instance_in_the_next_cycle_the_output_leaves_at_the_latest(
    follow: Callable[..., InStep],
) -> None:
    start = publish_slots(small_chain_plan(10 * MS, 20 * MS))[0][0]
    world = World(plan_in_step("output", latest_ns=start + MS), 0.0)
    kept = follow(world)
    run(world, kept, 10)
    assert world.moved_ns == MS and kept.is_in_step
    assert world.off_ns() != 0


@pytest.mark.parametrize("moves", ["loop", "output"])
def test_nothing_moves_while_a_chain_begins_early_for_its_timer_to_be_seen(
    follow: Callable[..., InStep], moves: str
) -> None:
    """The output had gone with its chain, 2 ms sooner, and missed its turn for seconds behind it:
    90 ms old, then 92, then 100.
    """
    world = World(plan_in_step(moves), 0.0)
    kept = follow(world)
    run(world, kept, 10)
    asked, off = len(world.asked), world.off_ns()
    world.early_ns = 2 * MS
    run(world, kept, 5)
    world.early_ns = 0
    run(world, kept, 10)
    assert len(world.asked) == asked
    assert world.off_ns() == off
    assert kept.is_in_step and kept.state.misses == 0


def test_next_move_by_brute_force() -> None:
    draw = random.Random(7)
    for _ in range(3_000):
        step, most = draw.randrange(2, 30), draw.randrange(60)
        least = draw.randrange(-20, 20)
        most += least
        now, wanted = draw.randrange(-20, 80), draw.randrange(-90, 90)
        fitting = [move for move in range(least, most + 1) if (move - wanted) % step == 0]
        moved = next_move(now, wanted, step, (least, most), otherwise_ns=99)
        if not fitting:
            assert moved == 99
            continue
        assert moved in fitting
        nearest = min(fitting, key=lambda move, now=now: abs(move - now))  # type: ignore[misc]
        if least <= now <= most and abs(nearest - now) <= step // 2:
            assert abs(moved - now) == abs(nearest - now)


def test_own_starts_are_those_without_moves() -> None:
    own = OwnStarts()
    first = LoopMoved(100, 1, 30, 30, 0, "asked")
    assert own.of([90, 150], [first]) == [90, 120]
    back = LoopMoved(205, 2, 0, -30, 0, "over")
    assert own.of([200, 210], [back]) == [170, 210]
    assert own.of([300], []) == [300]


def test_a_plan_that_is_in_step_does_not_follow_latencies() -> None:
    plan = Plan.of(plan_in_step("output"))
    assert [place for place, _, _ in loops_in_step(plan)] == [0]
    with pytest.raises(InputError, match="in step with a loop"):
        loops_in_step(plan, adapt=True)
    assert not loops_in_step(Plan.of(small_chain_plan(10 * MS, 20 * MS)), adapt=True)


@pytest.mark.parametrize("path", ["/opt/library.so", "/opt/a path/library.so"])
def test_what_apply_starts_is_beneath_the_library_where_a_loop_is_in_step(
    monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    """LD_PRELOAD names no path with a space: an output follows its loop without the library."""
    monkeypatch.setattr(named_loops, "installed_library", lambda: Path(path))
    monkeypatch.setenv("CHAINSHAPER_LOOPS", "/other")
    monkeypatch.delenv("LD_PRELOAD", raising=False)
    by_name = Plan.of(with_thread(plan_in_step("output"), "control"))
    if " " in path:
        assert apply._in_front_of_loops(by_name) == {}
        for plan in (plan_in_step("loop"), plan_in_step("output")):  # the latter has no name
            with pytest.raises(PlatformError, match="space"):
                apply._in_front_of_loops(Plan.of(plan))
        return
    variables = apply._in_front_of_loops(by_name)
    assert variables["LD_PRELOAD"] == path
    assert variables["CHAINSHAPER_LOOPS"] == "/other,/controller"
    assert apply._in_front_of_loops(Plan.of(small_chain_plan(10 * MS, 20 * MS))) == {}


def with_thread(chain: ChainPlan, name: str) -> ChainPlan:
    """The plan where the loop's thread has a name, by which it is known from outside."""
    assert chain.loop is not None
    return revised(chain, loop=chain.loop.model_copy(update={"thread": name}))


@pytest.mark.parametrize("moves", ["loop", "output"])
def test_how_both_are_is_measured(follow: Callable[..., InStep], moves: str) -> None:
    """Phase error and drift are those of the world, but for what its starts spread (20 us)."""
    world = World(plan_in_step(moves), 50.0)
    kept = follow(world)
    run(world, kept, 1)
    assert not kept.state.in_step and kept.state.waits_for == kept.waits_for
    run(world, kept, 60)
    state = kept.state
    assert state.in_step and state.is_there and state.waits_for is None
    assert known(state.error_ns) == pytest.approx(world.off_ns(), abs=20_000)
    assert known(state.drift_ppm) == pytest.approx(50, abs=1)
    assert state.moved_ns == (world.kept_ns if moves == "loop" else world.moved_ns)
    assert state.starts > 1000 and state.misses == 0
    # It is started again elsewhere: until that is noticed its starts are off by more than the lead.
    before, world.first_ns = state.starts, world.first_ns + 4 * MS
    run(world, kept, 0.5)
    assert 0 < kept.state.misses <= kept.state.starts - before + 1
    world.alive = False
    run(world, kept, 1)
    assert not kept.state.is_there
    assert "no such loop is seen to sleep" in kept.state.text


def test_a_run_shows_how_both_are_while_they_are_looked_at(follow: Callable[..., InStep]) -> None:
    """A real run had ended with "deque mutated during iteration": two threads, many starts."""
    world = World(plan_in_step("loop"), 50.0)
    kept, over, shown = follow(world), Event(), list[int]()

    def show() -> None:
        while not over.is_set():
            shown.append(kept.state.misses)

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    with ThreadPoolExecutor(1) as others:
        showing = others.submit(show)
        try:
            run(world, kept, 30)
        finally:
            over.set()
            sys.setswitchinterval(interval)
        showing.result()
    assert len(shown) > 100 and kept.state.starts > 1000


def loop_state(**values: Any) -> LoopState:
    known_values: dict[str, Any] = {
        "chain": "/scan../command",
        "loop": "/controller",
        "moves": "loop",
        "lead_ns": MS,
        "is_there": True,
        "in_step": True,
        "waits_for": None,
        "moved_ns": 3 * MS,
        "error_ns": -12_000,
        "drift_ppm": 50.0,
        "age_ns": 21 * MS,
        "starts": 6000,
        "misses": 0,
    }
    return LoopState(**{**known_values, **values})


def test_a_run_keeps_it_for_status(tmp_path: Path) -> None:
    state = RunState("1", 1, "plan.yaml", (), "fifo", "", 0, 20 * MS, loops=(loop_state(),))
    state = replace(state, anchor_ns=0)
    save_run_state(tmp_path, state)
    again = TypeAdapter(RunState).validate_json((tmp_path / STATE_FILE).read_bytes())
    assert again == state
    said = (
        "/scan../command and the loop of /controller are in step: lead 1 ms, off by -0.012 ms,"
        " drift +50.0 ppm, loop moved by 3 ms, 0 of 6000 starts missed in the last minute"
    )
    assert said == state.loops[0].text
    assert said in str(servers_table(state).caption)


@pytest.mark.parametrize(
    ("values", "level"),
    [
        ({}, 0),
        ({"misses": 2}, 1),
        ({"in_step": False, "waits_for": "the loop's phase is being measured"}, 1),
        ({"in_step": False, "is_there": False, "waits_for": "no such loop is seen to sleep"}, 2),
    ],
)
def test_its_status_is_published(values: dict[str, Any], level: int) -> None:
    state = loop_state(**values)
    rate = LoopRate("/controller", ("/command",), (7,), 6000, 10 * MS, None, None)
    loops = (LoopNow("loop of /controller to /command", rate, 4, None),)
    seen = Seen(0, {}, 0, (), loops=loops, in_step=(state,))
    (status,) = seen.as_diagnostics()
    assert status["name"] == "chainshaper: /scan../command and the loop of /controller in step"
    assert (status["level"], status["message"]) == (level, state.text)
    assert status["values"] == {
        "lead [ms]": "1.000",
        "phase error [ms]": "-0.012",
        "moved by [ms]": "3.000",
        "age of its data [ms]": "21.000",
        "drift [ppm]": "50.0",
        "moved": "loop",
        "starts in the last minute": "6000",
        "misses in the last minute": str(state.misses),
        "misses of its rate in the last minute": "4",
    }
    both = {"chain": "/scan../command", "loop": "/controller", "moves": "loop"}
    measured = {name: value for name, value, about in _values(seen) if about == both}
    assert measured == {
        "loop.in_step": float(state.in_step),
        "loop.step_lead": pytest.approx(1e-3),
        "loop.step_error": pytest.approx(-12e-6),
        "loop.step_moved": pytest.approx(3e-3),
        "loop.step_drift": pytest.approx(50e-6),
        "loop.step_starts": 6000.0,
        "loop.step_misses": float(state.misses),
    }
    assert seen.as_json()["in_step"][0]["error_ns"] == -12_000
    assert "in step" in str(watch_tables(seen)[-1].columns[0].title)


def test_a_watch_sees_what_runs_keep_in_step(monkeypatch: pytest.MonkeyPatch) -> None:
    state = RunState("1", 1, "plan.yaml", (), "fifo", "", 0, 20 * MS, loops=(loop_state(),))
    runs = [
        (SimpleNamespace(owner=1), state),
        (SimpleNamespace(owner=None), state),  # it has crashed
        (SimpleNamespace(owner=1), None),
    ]
    monkeypatch.setattr(watch_module, "find_runs", lambda: runs)
    assert Watch([], users=()).look().in_step == (loop_state(),)
