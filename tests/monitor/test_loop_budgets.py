"""Limits for loops: proposed, met, broken, and of loops that a recording does not have."""

import json
from pathlib import Path

import pytest
import yaml
from command_line import called, refused
from loop_story import PID, first_sleep, loop_behind, turn
from story import OFFSET, Story

from chainshaper.monitor.budgets import (
    GRAIN_NS,
    AgeBudget,
    Budget,
    ChainBudget,
    LoopBudget,
    check_budget,
    load_budget,
    propose_budget,
    save_budget,
)
from chainshaper.values.recording import Recording, RecordingInfo, write_recording

MS = 1_000_000
INPUTS, WAKES = tuple(range(0, 2000, 200)), tuple(range(100, 2100, 100))
CHAIN = "/a../cmd"


def written(folder: Path, story: Story, chain: str = CHAIN) -> Recording:
    info = RecordingInfo(source="preload", clock_offset_ns=OFFSET, chain=chain)
    return write_recording(folder, story.tables(), info)


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A loop of 100 ms behind a sensor of 200 ms: ages 100 and 200 ms, each message twice."""
    return written(tmp_path_factory.mktemp("loop") / "calm", loop_behind(INPUTS, WAKES, unit=MS))


@pytest.fixture(scope="module")
def slow(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The same with a loop of 150 ms, whose sensor sends every 200 ms."""
    story = loop_behind(INPUTS, tuple(range(100, 2100, 150)), unit=MS)
    return written(tmp_path_factory.mktemp("loop") / "slow", story)


def test_limits_of_a_loop_are_what_was_measured_and_a_tenth_beyond(
    calm: Recording, tmp_path: Path
) -> None:
    budget = propose_budget(calm)
    (chain,), (loop,) = budget.chains, budget.loops
    age = chain.age_at_loop
    assert age is not None
    times = (age.minimum_ns, age.maximum_ns, age.jitter_ns, *age.percentiles.values())
    expected = (90 * MS, 220 * MS, 110 * MS, 165 * MS, 220 * MS)
    assert times == pytest.approx(expected, abs=GRAIN_NS), "limits are whole multiples of a grain"
    assert ([*age.percentiles], age.never, age.again) == (["50", "99"], 0.01, 1.0)
    assert (loop.node, loop.publishes, loop.start_jitter_ns) == ("/actor", "/cmd", None)
    assert loop.period_ns == pytest.approx(110 * MS, abs=GRAIN_NS)
    assert loop.shortest_period_ns == pytest.approx(90 * MS, abs=GRAIN_NS)
    assert loop.overruns == 0.01
    file = save_budget(budget, tmp_path / "budget.yaml")
    assert load_budget(file) == budget
    text = yaml.safe_load(file.read_text())
    assert text["loops"][0]["period"].endswith("ms")
    assert all(judged.met for judged in check_budget(calm, budget))


def test_a_loop_that_is_slower_breaks_its_limits(calm: Recording, slow: Recording) -> None:
    """It starts at 100, 250, 400 …: its data are between 50 and 200 ms old."""
    broken = {
        (judged.where, judged.figure): judged.text
        for judged in check_budget(slow, propose_budget(calm))
        if not judged.met
    }
    of_loop = broken["loop of /actor to /cmd", "period"]
    assert of_loop == "loop of /actor to /cmd: period 150 ms, budget 110 ms"
    lowest = broken["/a../cmd at its loop", "lowest age"]
    assert lowest == "/a../cmd at its loop: lowest age 50 ms, budget at least 90 ms"


def test_a_loop_that_is_faster_than_it_may_be(calm: Recording, slow: Recording) -> None:
    broken = [judged.figure for judged in check_budget(calm, propose_budget(slow))]
    assert "shortest period" in broken


def test_never_used_and_used_again_are_shares_of_messages(tmp_path: Path) -> None:
    """Three inputs within each 100 ms: the newest is used, two of three never."""
    inputs = tuple(at + more for at in range(0, 1000, 100) for more in (10, 20, 30))
    recording = written(
        tmp_path / "many", loop_behind(inputs, tuple(range(100, 1200, 100)), unit=MS)
    )
    age = AgeBudget(never=0.5, again=0.5)
    limits = Budget(chains=(ChainBudget(chain=CHAIN, age_at_loop=age),))
    never, again = check_budget(recording, limits)
    assert (never.met, never.text) == (
        False,
        "/a../cmd at its loop: never used 66.67%, budget 50.00%",
    )
    assert again.met


def test_overruns_are_a_share_of_instances(tmp_path: Path) -> None:
    story = Story()
    cmd = story.publisher(story.node("/actor", PID), "/cmd")
    first_sleep(story, 40, 99)
    for number, woke in enumerate(range(100, 1100, 100)):  # the second ends when the third is due
        ends = woke + (100 if number == 1 else 50)
        turn(story, woke, ends - 1, woke + 99, writes=((cmd, woke + 30),))
    limits = Budget(loops=(LoopBudget(node="/actor", overruns=0.05, start_jitter_ns=MS),))
    jitter, overruns = check_budget(written(tmp_path / "over", story, "/cmd../cmd"), limits)
    assert jitter.met and jitter.measured == 0
    assert not overruns.met and overruns.measured == pytest.approx(0.1)


def test_limits_of_what_a_recording_does_not_have_say_what_it_has(
    calm: Recording, tmp_path: Path
) -> None:
    other = LoopBudget(node="/motor", period_ns=MS)
    topic = LoopBudget(node="/actor", publishes="/brake", period_ns=MS)
    judged = check_budget(calm, Budget(loops=(other, topic)))
    for verdict in judged:
        assert not verdict.met
        assert "could not be measured; the recording has no such loop" in verdict.text
        assert "it has the loop of /actor to /cmd" in verdict.text and "--loop" in verdict.text
    age = AgeBudget(maximum_ns=MS)
    story = loop_behind((0,), (100, 200))
    drives, out = story.relay("/drive", 30, "/cmd", "/out")
    story.runs(drives, 135, 140, reads=130, writes=((out, 138),))
    behind_it = Budget(chains=(ChainBudget(chain="/cmd../out", age_at_loop=age),))
    (verdict,) = check_budget(written(tmp_path / "behind", story), behind_it)
    assert "no loop reads what this chain stores" in verdict.text and "NODE:end" in verdict.text


def test_a_loop_without_period_breaks_a_limit_for_it(tmp_path: Path) -> None:
    story = loop_behind((0,), (100, 200, 330, 700, 760, 1000, 1900))
    limits = Budget(loops=(LoopBudget(node="/actor", period_ns=MS),))
    (verdict,) = check_budget(written(tmp_path / "irregular", story), limits)
    assert not verdict.met and "sleeps irregularly, usually" in verdict.text
    assert "(p5)" in verdict.text and "(p95)" in verdict.text


def test_the_commands_and_a_fleet(calm: Recording, slow: Recording, tmp_path: Path) -> None:
    file, junit = tmp_path / "budget.yaml", tmp_path / "junit.xml"
    assert called("budget", calm.path, "-o", file).code == 0
    assert called("check", calm.path, "--budget", file).code == 0
    fleet = called("check", calm.path, slow.path, calm.path, slow.path, "--budget", file)
    assert fleet.code == 1
    assert "Recordings against the budget" in fleet.out and "150.000" in fleet.out
    values = called("check", slow.path, "--budget", file, "--junit", junit, "--json")
    assert values.code == 1
    rows = {(row["where"], row["what"]): row for row in json.loads(values.out)["limits"]}
    period = rows["loop of /actor to /cmd", "period"]
    assert (period["met"], period["found"], period["at_least"]) == (False, 150 * MS, False)
    assert rows["/a../cmd at its loop", "lowest age"]["at_least"] is True
    assert 'name="jitter of age"' in junit.read_text()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("loops: [{node: /a, period: 10}]", "write a number and a unit"),
        ("loops: [{node: /a, overruns: 200%}]", "less than or equal to 1"),
        ("loops: [{node: /a, rate: 100}]", "rate"),
        ("chains: [{chain: /a../b, age_at_loop: {maximum: soon}}]", "soon"),
    ],
)
def test_wrong_limits_are_refused_with_their_line(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "budget.yaml"
    file.write_text(f"format: 1\n{text}\n")
    said = refused(2, "check", tmp_path, "--budget", file)
    assert message in said and f"{file}:2" in said
