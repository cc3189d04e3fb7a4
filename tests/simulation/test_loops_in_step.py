"""Planned and simulated: the age of a loop's data is what the plan says, in all of its cycles.

A sensor every 20 ms, a filter that takes 2 to 8 ms, and a loop of another node that reads what the
filter publishes.
"""

from collections import Counter
from pathlib import Path
from typing import Any, Literal

import polars as pl
import pytest
from known import known
from schedules import MS, application

from chainshaper.analysis import analyse_latency
from chainshaper.analysis.data_age import DataAge
from chainshaper.flow.plan import plan_recording
from chainshaper.planning import ChainPlan, Plan, plan_warnings
from chainshaper.planning.chain_plan import PlannedLoop
from chainshaper.simulation import simulate
from chainshaper.simulation.system import build_system
from chainshaper.splicing.application import splice_application
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.recording import Recording
from chainshaper.workload.description import Application

CHAIN = """
chain: /scan../command
nodes:
  sensor:
    core: 2
    callbacks: [{timer: 20ms, publishes: [/scan], execution: {constant: 300us}}]
  filter:
    core: 2
    callbacks:
      - {subscription: /scan, publishes: [/filtered], execution: {uniform: [2ms, 8ms]}}
  controller:
    core: 3
    callbacks:
      - {loop: LOOP, phase: PHASE, core: 1, reads: [/filtered], execution: {constant: 200us},
         publishes: [/command]}
"""
PLANNED = 300  # cycles that are recorded to plan from
SHAPED = 1000  # cycles under the plan
JITTERED = {"delivery": {"uniform": ["100us", "400us"]}, "wake_up": {"uniform": ["10us", "60us"]}}
EXACT = {"delivery": {"constant": "200us"}, "wake_up": {"constant": "20us"}}
In = Literal["as planned", "in step", "loop moved"]
HOW: dict[In, dict[str, bool]] = {
    "as planned": {},
    "in step": {"in_step": True},
    "loop moved": {"move_loop": True},
}


def looping(loop: str, phase: str, **simulation: Any) -> Application:
    return application(CHAIN.replace("LOOP", loop).replace("PHASE", phase), **simulation)


def planned(described: Application, folder: Path, **wishes: Any) -> tuple[ChainPlan, PlannedLoop]:
    recording = simulate(described, folder / "unshaped", cycles=PLANNED)
    (plan,) = plan_recording(recording, **wishes).chains
    return plan, known(plan.loop)


def under(plan: ChainPlan, described: Application, folder: Path) -> Recording:
    folder.mkdir(exist_ok=True)
    return simulate(described, folder / "shaped", Plan.of(plan), cycles=SHAPED)


def ages_in(recording: Recording) -> DataAge:
    """What the loop worked with, up to the last message: behind it the timers have ended."""
    return known(analyse_latency(recording, "/scan../command").data_age)


def cycles_of(ages: DataAge) -> pl.DataFrame:
    """The loop's cycles with data, but for those at both ends, which have no message before."""
    cycles = ages.cycles.drop_nulls("age_at_loop_ns")
    return cycles.filter(pl.col("traversal").is_between(3, SHAPED - 4))


def between(percentiles: tuple[float, float], ages: pl.Series) -> tuple[int, int]:
    low, high = (ages.quantile(share / 100, "nearest") for share in percentiles)
    return int(known(low)), int(known(high))


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize(
    ("loop", "phase"), [("10ms", "9ms"), ("1ms", "300us"), ("40ms", "1ms"), ("20ms", "9.8ms")]
)
def test_the_age_at_the_loop_is_as_constant_as_planned(
    loop: str, phase: str, how: In, tmp_path: Path
) -> None:
    """Its spread is the jitter of the loop's start, whatever part of the cycles uses data again."""
    described = looping(loop, phase, **JITTERED)
    plan, stated = planned(described, tmp_path, **HOW[how])
    assert stated.age.constant
    assert plan.policy == "shaped"
    cycles = cycles_of(ages_in(under(plan, described, tmp_path)))
    first = cycles.filter(use=1)["age_at_loop_ns"]
    low, high = between((0.5, 99.5), first)
    assert high - low <= 150_000, "which the issue wants"
    # Of 1000 cycles some start a little sooner or later than 99 % of 300 recorded ones.
    apart = 10_000
    assert stated.age.first_ns[0] - apart <= low < high <= stated.age.first_ns[1] + apart
    every = cycles["age_at_loop_ns"]
    assert stated.age.every_ns[0] - apart <= every.min()  # type: ignore[operator]
    assert every.max() <= stated.age.every_ns[1] + apart  # type: ignore[operator]
    assert used_often(cycles) == stated.age.uses


def used_often(cycles: pl.DataFrame) -> tuple[int, int]:
    """In how many cycles a message was used, the fewest and the most; of those that came."""
    numbers: list[int] = cycles["traversal"].to_list()
    uses = Counter(numbers)
    came = range(min(numbers), max(numbers) + 1)
    return min(uses[number] for number in came), max(uses.values())


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize(
    ("loop", "phase"),
    [("10ms", "9ms"), ("1ms", "300us"), ("40ms", "1ms"), ("15ms", "2ms"), ("30ms", "3ms")],
)
def test_without_jitter_plan_and_simulation_are_equal(
    loop: str, phase: str, how: In, tmp_path: Path
) -> None:
    """To the nanosecond: ages at first uses, of all cycles, and how often messages are used."""
    if loop in ("15ms", "30ms") and how != "as planned":
        with pytest.raises(InputError, match=r"neither of the loop's period .* is a multiple"):
            planned(looping(loop, phase, **EXACT), tmp_path, **HOW[how])
        return
    described = looping(loop, phase, **EXACT)
    plan, stated = planned(described, tmp_path, **HOW[how])
    assert stated.jitter_ns == 0
    cycles = cycles_of(ages_in(under(plan, described, tmp_path)))
    first, every = cycles.filter(use=1)["age_at_loop_ns"], cycles["age_at_loop_ns"]
    assert (first.min(), first.max()) == stated.age.first_ns
    assert (every.min(), every.max()) == stated.age.every_ns
    assert used_often(cycles) == stated.age.uses
    assert stated.age.constant is (loop in ("10ms", "1ms", "40ms"))


def test_a_slot_that_straddles_the_loop_moves_to_where_ages_are_constant(tmp_path: Path) -> None:
    """At the place of the shortest latency, the age would be one of two, a cycle apart."""
    described = looping("20ms", "9.8ms", **JITTERED)
    plan, stated = planned(described, tmp_path)
    assert 0 < stated.moved_ns < MS
    (warning,) = (line for line in plan_warnings(plan) if "chance would decide" in line)
    assert "ms later" in warning
    by = stated.moved_ns
    servers = tuple(
        server.model_copy(
            update={"slots": tuple((max(0, start - by), end - by) for start, end in server.slots)}
        )
        for server in plan.servers
    )
    straddling = plan.model_copy(update={"servers": servers})
    two = cycles_of(ages_in(under(straddling, described, tmp_path)))["age_at_loop_ns"]
    low, high = between((0.5, 99.5), two)
    assert high - low > 19 * MS
    moved = cycles_of(ages_in(under(plan, described, tmp_path / "again")))["age_at_loop_ns"]
    low, high = between((0.5, 99.5), moved)
    assert high - low < 150_000


def test_where_no_slot_is_clear_of_the_loop_the_plan_is_refused(tmp_path: Path) -> None:
    """A loop of 1 ms whose data come within 0.9 ms to 2.2 ms of their slot: none is constant."""
    late = {**JITTERED, "delivery": {"uniform": ["900us", "2200us"]}}
    described = looping("1ms", "0ms", **late)
    with pytest.raises(OperationError, match=r"No later slot helps.*--chain /scan../filtered"):
        planned(described, tmp_path)
    with pytest.raises(InputError, match=r"--in-step: .* together no shorter than the 1 ms"):
        plan_recording(tmp_path / "unshaped", in_step=True)


def test_the_loop_runs_with_the_receivers_of_the_output(tmp_path: Path) -> None:
    """Of the simulated threads, its own is at the priority of the executor that stores for it."""
    described = looping("10ms", "9ms", **JITTERED)
    plan, stated = planned(described, tmp_path)
    place = known(known(plan.shaping_node).receivers_at)
    runs_at = known(stated.runs_at)
    assert (runs_at.core, runs_at.priority) == (1, place.priority)
    joint = Plan.of(plan)
    assert joint.loops_at == {"/controller": runs_at}
    spliced = splice_application(described, joint)
    raised = known(spliced.loop_scheduling_of("controller"))
    assert raised.priority == spliced.scheduling_of("controller").priority
    system = build_system(spliced, joint, follow_chain=False)
    roles = {system.threads[number].role for number in system.receivers}
    assert roles == {"executor", "loop"}
    together = looping("10ms", "9ms", **JITTERED).model_dump()
    nodes = together["nodes"]
    nodes["controller"]["callbacks"][0]["core"] = 2  # where the chain runs
    crowded = Application.model_validate(together)
    (tmp_path / "crowded").mkdir()
    plan, stated = planned(crowded, tmp_path / "crowded")
    node = known(plan.shaping_node)
    assert known(stated.runs_at).core == known(node.receivers_at).core
