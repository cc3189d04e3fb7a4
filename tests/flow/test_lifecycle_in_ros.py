"""A lifecycle node that is shaped: cycles without it count apart, and nothing is late after."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import polars as pl
import pytest
from command_line import called, json_of
from roles import role
from ros2 import ros2_environment

import chainshaper as cs

pytestmark = pytest.mark.timed

LAUNCH = Path(__file__).parents[1] / "roles/managed.launch.py"
WHILE_SHAPED = """
set -m
ros2 launch {launch} &
until "{python}" -m chainshaper status --json | grep -q '"in_force_ns": *[0-9]'; do sleep 0.3; done
sleep 2
for to in {changes}; do ros2 lifecycle set /managed $to; sleep 1; done
sleep 3
kill -INT %1
wait
"""


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """What was recorded of the launch file, unshaped; what is started has its environment."""
    folder = tmp_path_factory.mktemp("lifecycle") / "before"
    with mock.patch.dict(os.environ, {**ros2_environment(), "ROLE": str(role()), "PERIOD": "100"}):
        words = ("record", "--source", "preload", "-o", folder, "--duration", "8s", "--")
        made = called(*words, "ros2", "launch", LAUNCH)
        assert made.code == 0, made.err
        yield folder


@pytest.mark.ros2("rclcpp_lifecycle", "launch_ros")
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("where", "changes"),
    [
        ("node", "deactivate activate"),
        ("in-process", "deactivate activate"),
        ("in-process", "deactivate cleanup configure activate"),  # another publisher
    ],
)
def test_a_node_that_is_made_inactive_is_shaped_again_when_it_is_active(
    before: Path, tmp_path: Path, where: str, changes: str
) -> None:
    plan, spliced, after = (tmp_path / name for name in ("plan.yaml", "spliced", "after"))
    publication = ("--publication", "in-process") if where == "in-process" else ()
    # The slot lies in the middle of the cycle, whatever else the machine did meanwhile.
    wishes = ("--percentile", "50", "--epsilon", "40ms", "--publish-slot", "1ms", *publication)
    planned = called("plan", before, "--chain", "/source../t2", *wishes, "-o", plan)
    assert planned.code == 0, planned.err
    made = called("splice", plan, LAUNCH, "-o", spliced)
    assert made.code == 0, made.err
    launch = spliced / LAUNCH.name
    script = WHILE_SHAPED.format(changes=changes, launch=launch, python=sys.executable)
    apply = (sys.executable, "-m", "chainshaper", "apply", plan, "--wait", "15s", "--")
    record = ("record", "--source", "preload", "-o", after, "--duration", "90s", "--")
    recorded = called(*record, *apply, "bash", "-c", script)
    assert recorded.code == 0, recorded.err
    chain = "/source../chainshaper_t2../t2" if where == "node" else "/source../t2"
    found = json_of("latency", after, "--chain", chain, "--json")
    assert found["incomplete_by_reason"]["inactive"] > 10
    assert found["incomplete"] <= 3, found["incomplete_by_reason"]
    assert found["late"] <= found["count"] / 10
    (log,) = (one for one in (spliced / "logs").glob("*.csv") if "standby" not in one.name)
    rows = cs.read_gate_log(log).sort("arrival").with_columns(gap=pl.col("arrival").diff())
    (again,) = rows.with_row_index("place").filter(pl.col("gap") > 1_000_000_000)["place"]
    shaped = rows.slice(again)
    assert len(shaped) > 15
    assert shaped["anchor"].unique().to_list() == ["stamp"]
    in_time = (shaped["cycles_waited"] == 0).to_numpy()
    assert in_time[0], "the first one leaves in its own cycle"
    assert in_time.mean() > 0.9
