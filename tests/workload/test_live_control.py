"""A robot whose plant is a live node: what it measures is what is computed, and reports show it."""

from pathlib import Path

import pytest
from command_line import json_of
from small_chain import DDS_CORE, EXECUTOR_CORE

import chainshaper as cs
from chainshaper.flow.demonstration import run_demo
from chainshaper.reporting.live_control import live_costs
from chainshaper.values.recording import Recording
from chainshaper.verify.live_control import live_cost

pytestmark = pytest.mark.timed

ROBOT = Path(__file__).parents[2] / "examples" / "balancing_robot.yaml"
CYCLES = 200


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example's file, for the cores of this machine."""
    text = ROBOT.read_text()
    text = text.replace("{core: 1, priority: 80}", f"{{core: {EXECUTOR_CORE}, priority: 80}}")
    text = text.replace("{core: 0, priority: 90}", f"{{core: {DDS_CORE}, priority: 90}}")
    path = tmp_path_factory.mktemp("robot") / "robot.yaml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def live(robot: Path) -> Recording:
    application = cs.load_application(robot)
    return cs.run_application(application, robot.parent / "live", cycles=CYCLES)


def test_the_measured_cost_is_the_computed_one(live: Recording) -> None:
    cost = live_cost(live)
    assert cost is not None
    assert CYCLES <= cost.cycles <= CYCLES + 1
    assert cost.copies == 64
    # Twice the interval of 95 %: one run of a thousand is beyond it.
    assert abs(cost.measured - cost.computed) < 2 * cost.margin


def test_the_plant_is_sampled_and_driven_when_the_trace_says_so(
    live: Recording, robot: Path
) -> None:
    """The cost of the chain's latencies is that of the plant's own instants, nearly."""
    cost = live_cost(live)
    assert cost is not None
    values = json_of("control", robot, live.path, "--at", "receiver")
    (of_trace,) = values["recordings"]
    assert of_trace["cost"] == pytest.approx(cost.computed, rel=0.05)


def test_the_demonstration_shows_the_cost_before_and_after(robot: Path, tmp_path: Path) -> None:
    shown = run_demo(tmp_path / "demo", application=robot, cycles=60)
    if shown.comparison is None:
        pytest.skip(f"this machine was too busy to plan: {shown.unplanned}")
    before, after = live_costs(shown.comparison.measurements)
    assert before is not None
    assert after is not None
    page = (tmp_path / "demo" / "report.html").read_text()
    assert "The same controller: cost" in page or "the same controller: cost" in page
    assert "computed for the same instants" in page
