"""The age of a loop's data beside what its plan promises: worked by hand, and simulated."""

import runpy
from pathlib import Path
from typing import Any

import pytest
from command_line import called, json_of
from known import known
from loop_story import loop_behind
from story import OFFSET, Story

from chainshaper import simulate
from chainshaper.analysis import analyse_latency, data_flow
from chainshaper.planning.chain_plan import LoopAge, PlannedLoop, revised
from chainshaper.planning.plan import Plan
from chainshaper.planning.plan_file import load_plan
from chainshaper.reporting.latency import verdict
from chainshaper.values.events import EventTables
from chainshaper.verify.ages import JudgedAge, judge_age
from chainshaper.verify.measure import measure_latency
from chainshaper.workload.description import load_application

TURNS = (1060, 1160, 1260, 1360)
"""Behind messages of 1000 and 1200: their ages at the loop are 60, 160, 60 and 160."""


def planned(first: tuple[int, int], every: tuple[int, int], **values: Any) -> PlannedLoop:
    age = LoopAge(first_ns=first, every_ns=every, constant=True, uses=(2, 2))
    about: dict[str, Any] = {"node": "/actor", "topic": "/a", "period_ns": 100, "samples": 1}
    return PlannedLoop(**{**about, "delivery_ns": (0, 0, 0), "lead_ns": 0, "age": age, **values})


def judged(story: Story, loop: PlannedLoop) -> JudgedAge:
    tables: EventTables = story.tables()
    analysis = analyse_latency(data_flow(tables, OFFSET), "/a../cmd")
    return judge_age(analysis.chain.spec, loop, known(analysis.data_age), tables)


def test_all_cycles_count() -> None:
    story = loop_behind((1000, 1200), TURNS)
    kept = judged(story, planned((55, 65), (55, 165)))
    assert (kept.first.count, kept.every.count, kept.outside, kept.ambiguous) == (2, 4, 0, 0)
    assert (kept.first.min_ns, kept.first.max_ns) == (60, 60)
    assert (kept.every.min_ns, kept.every.max_ns) == (60, 160)
    assert kept.kept and kept.before == kept.never_used == 0
    older = judged(story, planned((55, 65), (55, 159)))
    assert older.outside == 2, "the repeats of both messages"
    late = judged(story, planned((55, 59), (55, 165)))
    assert late.outside == 2, "the first uses of both"


def test_a_promise_is_broken_by_more_cycles_than_chance_has_elsewhere() -> None:
    """Of 200 cycles 3 may be elsewhere, and 5 more by chance (three standard errors of 1.7)."""
    sent = tuple(range(1000, 21_000, 200))
    turns = tuple(at + 60 + late for at in sent for late in (0, 100))
    assert judged(loop_behind(sent, turns), planned((55, 65), (55, 165))).kept
    for late_ones, is_kept in ((4, True), (5, False)):
        late = {at + 60 for at in sent[10 : 10 + late_ones]}
        shifted = tuple(turn + 10 if turn in late or turn - 100 in late else turn for turn in turns)
        seen = judged(loop_behind(sent, shifted), planned((55, 65), (55, 165)))
        assert seen.outside == 2 * late_ones, "the first use, and the repeat"
        assert seen.kept == is_kept
    assert "in 10 of 200 cycles" in seen.broken[0]
    assert "at the first use 0.000 to 0.000 ms, promised" in seen.broken[0]


def test_a_cycle_of_which_the_message_is_not_known_breaks_nothing_and_is_said() -> None:
    """A message comes 5 behind the wake-up: the loop has it, or the one before."""
    story = loop_behind((1000, 1200, 1355), TURNS)
    seen = judged(story, planned((55, 65), (55, 159)))
    assert seen.ambiguous == 1
    assert seen.outside == 1, "1160's; what is in 1360's is not known"
    assert "(1 ambiguous" in seen.text


def test_messages_that_are_not_used_though_they_should_be_are_said() -> None:
    story = loop_behind((1000, 1200, 1230), TURNS)
    seen = judged(story, planned((20, 65), (20, 165)))
    assert seen.never_used == 1
    assert "1 messages never used" in seen.text
    slower = planned((20, 65), (20, 165))
    slower = slower.model_copy(update={"age": slower.age.model_copy(update={"uses": (0, 1)})})
    assert judged(story, slower).never_used == 0


def test_cycles_before_the_loop_is_moved_do_not_count() -> None:
    story = loop_behind((1000, 1200), TURNS)
    moved = {"request": 1, "asked": 5, "added": 5, "kept": 5, "why": 1}
    story.event("loop_moved", 1100, 20, 22, **moved)
    loop = planned((55, 65), (55, 165), in_step="loop", move_ns=5)
    seen = judged(story, loop)
    assert (seen.before, seen.every.count, seen.first.count) == (1, 3, 1)
    assert "1 before they were in step" in seen.text
    assert judged(story, loop.model_copy(update={"in_step": None, "move_ns": None})).before == 0


def test_in_step_the_spread_at_the_first_use_is_promised_too() -> None:
    story = loop_behind((1000, 1200), (1060, 1160, 1265, 1365))
    loop = planned((55, 65), (55, 165), in_step="loop", move_ns=5)
    assert judged(story, loop).kept
    narrow = judged(story, planned((61, 64), (55, 165), in_step="loop", move_ns=5))
    assert not narrow.kept and "spreads over" in narrow.broken[-1]


@pytest.fixture(scope="module")
def in_step(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Plan]:
    """The example's chain of 20 ms and its loop of 10 ms, moved, simulated with its plan."""
    folder = tmp_path_factory.mktemp("in_step")
    example = Path(__file__).parents[2] / "examples" / "write_loop.py"
    runpy.run_path(str(example))["main"](str(folder / "loop"))
    words = (folder / "loop", "--chain", "/scan../command")
    assert called("describe", *words, "-o", folder / "app.yaml").code == 0
    assert called("plan", *words, "--move-loop", "-o", folder / "plan.yaml").code == 0
    plan, described = load_plan(folder / "plan.yaml"), load_application(folder / "app.yaml")
    return simulate(described, folder / "sim", plan, cycles=100).path, plan


def test_the_verdict_is_of_the_whole_chain(in_step: tuple[Path, Plan]) -> None:
    """Whether it is named to the topic or through the loop, the promise of both is judged."""
    path, plan = in_step
    loop = known(plan.chains[0].loop)
    for chain in (known(plan.chains[0].chain.spec), known(loop.chain)):
        measured = measure_latency(path, chain)
        met, text = verdict(measured)
        assert met, text
        age = known(measured.age)
        assert age.kept and age.outside == 0 and age.every.count > 100
        assert age.promised_first_ns == loop.age.first_ns
        assert "age of /controller's data at the first use" in text
    shown = json_of("latency", path, "--chain", known(loop.chain))
    assert shown["promise"]["met"] and shown["promise"]["age"]["kept"]
    assert shown["promise"]["age"]["first"]["max_ns"] == shown["promise"]["age"]["first"]["min_ns"]


def test_a_plan_that_promised_other_ages_is_not_met(in_step: tuple[Path, Plan]) -> None:
    path, plan = in_step
    loop = known(plan.chains[0].loop)
    later = tuple(ns + 500_000 for ns in loop.age.first_ns)
    age = loop.age.model_copy(update={"first_ns": later})
    update = {"age": age, "age_at_any_phase": age}
    wrong = Plan.of(revised(plan.chains[0], loop=loop.model_copy(update=update)))
    met, text = verdict(measure_latency(path, loop.chain, wrong))
    assert met is False
    assert "promise broken" in text and "outside of what is promised" in text
