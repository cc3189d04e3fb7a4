"""R_m and R_m° of a plan in force together, by the freezer, on a live chain."""

import sys
from pathlib import Path

import polars as pl
from applied_plans import MS, leftovers, needs_fifo
from calm_runs import calm_run
from gated import needs_cgroups
from small_chain import EXECUTOR_CORE, small_chain_plan, small_chain_text

from chainshaper import apply_plan, measure_latency, open_recording
from chainshaper.enforcement.undoing import RunState
from chainshaper.planning import save_plan
from chainshaper.values.recording import Recording


@needs_fifo
@needs_cgroups
def test_a_shaping_node_kept_in_its_server_publishes_when_its_gate_says(tmp_path: Path) -> None:
    plan = small_chain_plan(
        4 * MS, 24 * MS, core=EXECUTOR_CORE, overrun="publish", shaping_thread="in-slots"
    )
    states: list[RunState] = []

    def run(place: Path) -> Recording:
        (place / "app.yaml").write_text(small_chain_text())
        save_plan(plan, place / "plan.yaml")
        words = ("shape", place / "app.yaml", place / "plan.yaml", "-o", place / "rec")
        command = [sys.executable, "-m", "chainshaper", *map(str, words), "--cycles", "120"]
        states.append(apply_plan(plan, command, back_end="freezer").state)
        return open_recording(place / "rec")

    measured = measure_latency(calm_run(run, tmp_path)).analysis
    assert [one.kept_by for one in states[-1].servers] == ["freezer", "freezer"]
    # Open early enough, and for what is late.
    assert states[-1].servers[1].slots == ((20 * MS, 50 * MS),)
    assert measured.statistics.incomplete <= 1, "a frozen node loses nothing"
    calm = measured.traversals.filter(~pl.col("disturbed"))["latency_ns"]
    assert calm.quantile(0.9) - calm.quantile(0.1) < MS // 2  # type: ignore[operator]
    assert abs(calm.median() - 25 * MS) < MS // 2  # type: ignore[operator]
    assert not leftovers()
