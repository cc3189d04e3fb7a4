"""Chains longer than their period, simulated: once a cycle, in order, at a constant latency."""

from pathlib import Path

import pytest
from schedules import MS, application

from chainshaper import plan_recording, simulate
from chainshaper.planning import PlanRequest
from chainshaper.planning.overruns import cycles_until_output
from chainshaper.verify.measure import measure_latency
from chainshaper.verify.predictions import judge_prediction
from chainshaper.workload.description import Application

TAKE = 10_000  # ns


def chain(executions: list[str], cores: list[int]) -> Application:
    """A node per execution time, on these cores, every 100 ms; and one that gets the output."""
    nodes = []
    for number, (execution, core) in enumerate(zip(executions, cores, strict=True)):
        trigger = f"subscription: /t{number - 1}" if number else "timer: 100ms"
        nodes.append(
            f"  n{number}: {{core: {core}, callbacks: [{{{trigger}, execution: {execution},"
            f" publishes: [/t{number}]}}]}}"
        )
    last = f"/t{len(executions) - 1}"
    listener = f"  actuator: {{core: 9, callbacks: [{{subscription: {last}}}]}}"
    text = "\n".join([f"chain: /t0..{last}", "nodes:", *nodes, listener])
    return application(text, take={"constant": f"{TAKE}ns"})


LONG = ["{uniform: [20ms, 30ms]}", "{uniform: [30ms, 50ms]}", "{uniform: [25ms, 40ms]}"]
LONGER = [*LONG, "{uniform: [35ms, 42ms]}", "{uniform: [60ms, 78ms]}"]
"""Up to 1.2 and 2.4 times the period."""


@pytest.mark.parametrize(
    ("executions", "recorded_on", "cores", "cycles_later"),
    [
        ([*LONG, "{uniform: [30ms, 40ms]}"], [1, 1, 2, 2], None, 1),
        (LONGER, [1, 1, 2, 3, 4], (1, 2, 3), 2),
        (LONGER, [1, 2, 3, 4, 5], (6, 7, 8), 2),
    ],
)
def test_outputs_leave_once_a_cycle_in_order(
    tmp_path: Path,
    executions: list[str],
    recorded_on: list[int],
    cores: tuple[int, ...] | None,
    cycles_later: int,
) -> None:
    described = chain(executions, recorded_on)
    profile = simulate(described, tmp_path / "profile", cycles=300)
    request = PlanRequest(policy="pipelined", cores=cores, epsilon_ns=15 * MS)
    plan = plan_recording(profile, request=request)
    measured = measure_latency(profile).analysis.statistics.max_ns
    assert plan.evidence.max_latency_ns == measured, "nothing overlapped on any core"
    assert cycles_until_output(plan) == cycles_later

    shaped = simulate(described, tmp_path / "shaped", plan, cycles=1000)
    analysis = measure_latency(shaped).analysis
    held = judge_prediction(plan, analysis)
    assert held.mean.holds and held.max.holds and held.jitter.holds
    figures = analysis.statistics
    assert (figures.count, figures.incomplete, figures.late) == (1000, 0, 0)
    assert analysis.traversals["latency_ns"].unique().to_list() == [measured + 15 * MS]
    ends = analysis.traversals["end"].diff().drop_nulls()
    assert ends.unique().to_list() == [100 * MS], "once a cycle, in order"


def test_a_recording_in_which_instances_piled_up_tells_the_same(tmp_path: Path) -> None:
    """On one core, 10 instances of 1.6 periods wait for each other: they say what each took."""
    constant = ["{constant: 40ms}"] * 4
    described = chain(constant, [1, 1, 1, 1])
    piled_up = simulate(described, tmp_path / "piled_up", cycles=10)
    assert measure_latency(piled_up).analysis.statistics.max_ns > 300 * MS  # type: ignore[operator]
    request = PlanRequest(policy="pipelined", cores=(1, 2))
    plan = plan_recording(piled_up, request=request)
    assert 160 * MS <= plan.evidence.min_latency_ns <= plan.evidence.max_latency_ns
    assert plan.evidence.max_latency_ns <= 160 * MS + 10 * TAKE, "but for what is taken between"

    shaped = simulate(described, tmp_path / "shaped", plan, cycles=100)
    analysis = measure_latency(shaped).analysis
    assert analysis.statistics.late == 0
    assert analysis.traversals["latency_ns"].unique().to_list() == [plan.predicted.max_ns - MS]
