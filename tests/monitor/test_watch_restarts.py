"""Watching an application whose processes die and begin again, in simulated time.

Records come from the simulated application of `benchmarks/watch_week.py`, read by the real watch.
"""

import importlib.util
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from chainshaper.monitor import watch as watch_module
from chainshaper.monitor.budgets import Budget, ChainBudget, broken_limits
from chainshaper.monitor.watch import SECOND, Seen, Watch
from chainshaper.values import events

BENCHMARK = Path(__file__).parents[2] / "benchmarks/watch_week.py"
CHAINS = ("/a1../a5", "/b1../b5")
BUDGET = Budget(chains=(ChainBudget(chain=CHAINS[0], missing=0.05),))


class Simulated:
    """The application, the watch of it, and which processes are gone."""

    def __init__(self, week: ModuleType, rate: int) -> None:
        self.week, self.application = week, week.Application(rate)
        self.passed_ns, self.gone, self.stay = 0, set[int](), False
        self.watch: Watch

    def attach(self) -> None:
        self.watch = Watch(CHAINS, users=())

    def go_on(self, seconds: int, look: bool = True) -> list[Seen]:
        seen = []
        for _ in range(seconds // 2):
            self.application.advance(self.passed_ns, 1 << 60)
            self.passed_ns += self.week.BLOCK_NS
            if look:
                seen.append(self.watch.look())
        return seen

    def begun(self, seen: Seen) -> int:
        """How many cycles, fifty and twenty a second, began and are over in a look."""
        return int(70 * (seen.at_ns - 2 * SECOND - self.week.START_NS) // SECOND)

    def kill(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """End the third process: neither it nor those behind it run any more."""
        self.gone.add(self.application.running[2].pid)
        for process in self.application.running[2:]:
            monkeypatch.setattr(process, "write", lambda *_: None)

    def start_again(self) -> None:
        for number in range(2, 6):
            self.application.running[number] = self.application._process(number)

    def memories(self, users: Any, known: Any, _: Any = None) -> Iterator[tuple[int, Any]]:
        return self.application.memories(users, {*known, *self.gone})  # type: ignore[no-any-return]

    def path(self, text: str) -> Any:
        exists = self.application.path(text).exists() and text[6:] not in map(str, self.gone)
        return SimpleNamespace(exists=lambda: self.stay or exists)


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch) -> "Callable[..., Simulated]":
    spec = importlib.util.spec_from_file_location("watch_week", BENCHMARK)
    assert spec is not None
    assert spec.loader is not None
    week = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(week)

    def begin(rate: int = 1000, attach: bool = True) -> Simulated:
        watched = Simulated(week, rate)
        clock = SimpleNamespace(monotonic_ns=lambda: watched.application.now)
        monkeypatch.setattr(watch_module, "time", clock)
        monkeypatch.setattr(watch_module, "clock_offset", lambda: watched.application.offset)
        monkeypatch.setattr(watch_module, "memories", watched.memories)
        monkeypatch.setattr(watch_module, "Path", watched.path)
        if attach:
            watched.attach()
        return watched

    return begin


def counted(seen: Seen) -> dict[str, int]:
    return {name: sum(c.counted[name] for c in seen.chains) for name in ("complete", "incomplete")}


def test_cycles_that_never_arrive_are_counted_while_a_node_is_dead_and_once_after(
    simulated: "Callable[..., Simulated]", monkeypatch: pytest.MonkeyPatch
) -> None:
    watched = simulated()
    before = watched.go_on(20)[-1]
    assert not broken_limits(BUDGET, before)
    complete = watched.application.cycles["complete"]
    watched.kill(monkeypatch)
    dead = watched.go_on(70)
    lost = watched.application.cycles["complete"] - complete
    first = next(seen for seen in dead if broken_limits(BUDGET, seen))
    assert first.at_ns < before.at_ns + 10 * SECOND
    for seen in (first, dead[-1]):  # as long as it is dead
        (missing,) = broken_limits(BUDGET, seen)
        assert missing.figure == "missing"
    assert "no path leads" in (missing.because or "")
    rates = [counted(b)["incomplete"] - counted(a)["incomplete"] for a, b in pairwise(dead[5:])]
    assert set(rates) == {2 * 70}, "fifty and twenty cycles a second"
    assert [chain.hops for chain in dead[-1].chains] == [(), ()], "of the last minute"
    watched.start_again()
    assert not any(chain.problem for chain in watched.go_on(20)[-1].chains)
    watched.application.advance(watched.passed_ns, watched.passed_ns)
    watched.application.now += 2 * watched.watch.longest_ns
    found = counted(watched.watch.look())
    assert sum(found.values()) == watched.application.cycles.total(), "each is counted once"
    assert found["complete"] == pytest.approx(watched.application.cycles["complete"] - lost, abs=4)
    assert len(watched.watch.processes) == 6, "those that have ended are left"


def test_a_node_that_is_started_again_is_no_second_path(
    simulated: "Callable[..., Simulated]",
) -> None:
    watched = simulated()
    seen = watched.go_on(10)
    watched.start_again()
    seen += watched.go_on(20)
    assert not any(chain.problem for look in seen[2:] for chain in look.chains)
    assert counted(seen[-1])["incomplete"] <= watched.application.cycles["incomplete"] + 4
    assert sum(counted(seen[-1]).values()) == pytest.approx(watched.begun(seen[-1]), abs=2)


def look_at_two_that_run(watched: Simulated) -> Seen:
    """Start nodes again beside those that run, which stay; return the last look at both."""
    watched.go_on(10)
    watched.stay = True
    watched.start_again()
    return watched.go_on(4)[-1]


def test_two_that_run_with_the_same_names_stay_unclear(
    simulated: "Callable[..., Simulated]",
) -> None:
    watched = simulated()
    unclear = look_at_two_that_run(watched)
    assert "paths match" in (unclear.chains[0].problem or "")
    assert counted(unclear)["incomplete"] <= watched.application.cycles["incomplete"] + 4


def test_what_was_before_the_watch_is_none_of_it(
    simulated: "Callable[..., Simulated]", tmp_path: Path
) -> None:
    """Rings have run over long before: nothing is lost, and nodes are known all the same."""
    watched = simulated(20_000, attach=False)
    watched.go_on(12, look=False)
    watched.attach()
    began = watched.application.now
    seen = watched.go_on(6)[-1]
    assert seen.lost == 0
    assert seen.chains[0].problem is None
    assert counted(seen)["complete"] > 100
    tables = watched.watch.save(tmp_path / "flight").events
    assert min(int(tables[o]["time"][0]) for o in tables.keys() - events.CREATION) >= began
    assert tables["rcl_node_init"]["time"][0] < began


def test_a_look_that_is_held_up_counts_no_cycle_whose_events_it_has_not_read(
    simulated: "Callable[..., Simulated]", monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a busy machine nobody knows how long it takes from the last record to the clock."""
    watched = simulated()
    watched.go_on(10)
    read = watched.watch.read

    def held_up() -> None:
        read()
        watched.go_on(6, look=False)

    incomplete = watched.application.cycles["incomplete"]
    with monkeypatch.context() as patch:
        patch.setattr(watched.watch, "read", held_up)
        assert counted(watched.watch.look())["incomplete"] <= incomplete
    watched.go_on(4)
    assert counted(watched.go_on(2)[-1])["incomplete"] <= watched.application.cycles["incomplete"]


@pytest.mark.parametrize("every", [4, 20])
def test_looks_that_come_late_count_all_cycles_and_the_recorder_has_those_of_the_last(
    simulated: "Callable[..., Simulated]", tmp_path: Path, every: int
) -> None:
    watched = simulated()
    watched.go_on(20)
    for _ in range(20 // every):
        watched.go_on(every, look=False)
        watched.watch.read()
        before = watched.watch._over_ns
        seen = watched.watch.look()
    assert sum(counted(seen).values()) == pytest.approx(watched.begun(seen), abs=2)
    tables = watched.watch.save(tmp_path / "flight").events
    first = min(int(tables[one]["time"][0]) for one in tables.keys() - events.CREATION)
    since = min(watched.application.now - 10 * SECOND, before)
    assert since <= first < since + SECOND // 10


def test_one_of_two_that_run_with_the_same_name_can_be_watched(
    simulated: "Callable[..., Simulated]",
) -> None:
    watched = simulated()
    problem = look_at_two_that_run(watched).chains[0].problem or ""
    assert "(write /a1../a2../a_2@" in problem, (
        "of several nodes twice no way point alone is enough"
    )
    running = watched.application.running[2:6]
    nodes = [f"/a_{number}@{process.pid}" for number, process in enumerate(running, start=2)]
    topics = ["/a3", "/a4", "/a5"]
    points = [point for both in zip(nodes, topics, strict=False) for point in both]
    watched.watch = Watch(["..".join(("/a1", *points))], users=())
    (named,) = watched.go_on(10)[-1].chains
    assert named.problem is None
    assert named.counted["complete"] > 100
