"""Chains of 1.6 and 2.4 periods on two cores, live over DDS: constant, once a cycle, in order."""

from pathlib import Path

import polars as pl
import pytest
from applied_plans import leftovers, needs_fifo
from calm_runs import calm_run
from gated import needs_cgroups

from chainshaper import load_application, plan_recording, run_application, shape_application
from chainshaper.linux.scheduling import available_cores
from chainshaper.planning import PlanRequest
from chainshaper.planning.overruns import cycles_until_output
from chainshaper.planning.plan import publish_slots
from chainshaper.verify.measure import measure_latency

ROOT = Path(__file__).parents[2]
MS = 1_000_000
PERIOD_NS = 100 * MS


@needs_fifo
@needs_cgroups
@pytest.mark.skipif(len(available_cores()) < 2, reason="needs two cores")
@pytest.mark.parametrize(
    ("example", "cores", "stages"),
    [("pipeline", None, [1, 0]), ("pipeline_waiting", (0, 1, 0), [1, 0, 0])],
)
def test_a_chain_of_several_periods_is_constant(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    example: str,
    cores: tuple[int, ...] | None,
    stages: list[int],
) -> None:
    cycles_later = len(stages) - 1
    monkeypatch.chdir(ROOT)  # where examples.waiting is found
    application = load_application(ROOT / f"examples/{example}.yaml")
    profile = calm_run(
        lambda place: run_application(application, place / "profile", cycles=20), tmp_path
    )
    request = PlanRequest(policy="pipelined", cores=cores, epsilon_ns=6 * MS)
    plan = plan_recording(profile, request=request)
    assert [server.core for server in plan.servers[:-1]] == stages
    assert cycles_until_output(plan) == cycles_later
    ((start, _),) = publish_slots(plan)

    folder = tmp_path / "shaped"
    folder.mkdir()
    shaped = calm_run(
        lambda place: shape_application(application, plan, place / "rec", cycles=28), folder
    )
    analysis = measure_latency(shaped).analysis
    latencies = analysis.traversals.filter(~pl.col("disturbed"))["latency_ns"]
    planned = latencies - cycles_later * PERIOD_NS - start
    assert planned.min() >= 0
    assert (planned < MS).sum() >= 0.9 * latencies.len() > 12
    ends = analysis.traversals["end"].drop_nulls().diff().drop_nulls()
    assert ends.min() > 0  # type: ignore[operator]
    assert not leftovers()
