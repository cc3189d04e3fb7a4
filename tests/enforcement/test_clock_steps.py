"""The wall clock steps while a plan is in force: slots are counted on a clock that does not."""

import json
import os
import signal
import time
from pathlib import Path

import pytest
from applied_plans import CYCLE, MS, applied, leftovers, needs_fifo, plan_for, running_node, server
from gated import needs_cgroups
from test_applying import windows

STEP_NS = 2_000_000_000


def _step(by_ns: int) -> None:
    now = time.clock_gettime_ns(time.CLOCK_REALTIME)
    time.clock_settime_ns(time.CLOCK_REALTIME, now + by_ns)


@needs_fifo
@needs_cgroups
@pytest.mark.skipif(
    "CHAINSHAPER_STEP_CLOCK" not in os.environ,
    reason="it steps this machine's clock: set CHAINSHAPER_STEP_CLOCK=1 where that may be done",
)
def test_slots_stay_where_they_are_when_the_wall_clock_steps(tmp_path: Path) -> None:
    output = tmp_path / "windows"
    plan = plan_for(server("first", "origin", (0, 30)), server("second", "other", (40, 70)))
    with (
        running_node("origin", tmp_path / "origin"),
        running_node("other", output, period=10 * MS, busy=2 * MS),
        applied(plan, tmp_path, "--backend", "freezer", "--json") as run,
    ):
        begun = time.monotonic_ns()
        for _ in range(6):
            for by_ns in (STEP_NS, -STEP_NS):
                _step(by_ns)
                time.sleep(0.4)
        ended = time.monotonic_ns()
        run.send_signal(signal.SIGINT)
        stdout, _ = run.communicate(timeout=30)
        assert run.returncode == 0
    state = json.loads(stdout)
    seen = windows(output)
    seen = seen[(seen[:, 0] > begun) & (seen[:, 1] < ended)]
    phases = (seen - state["anchor_ns"]) % CYCLE
    inside = (phases[:, 0] >= 39 * MS) & (phases[:, 0] < 71 * MS)
    assert len(seen) > 20
    assert inside.mean() > 0.95
    assert state["failure"] is None
    assert not leftovers()
