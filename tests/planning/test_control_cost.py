"""Slots that cost a controller least: against every placement, and what is said of them."""

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from chainshaper.control.plant_file import load_loop
from chainshaper.control.steady_state import LatencyCosts
from chainshaper.planning import PlanRequest, Profile, load_plan, plan_chain, save_plan
from chainshaper.planning.chain_plan import ChainPlan, publish_slots
from chainshaper.planning.control_cost import searched
from chainshaper.planning.plan import Plan
from chainshaper.robot.gate import IntoOpenSlot
from chainshaper.values.errors import InputError, OperationError

MS = 1_000_000
PENDULUM = """\
plant: {{transfer_function: {{numerator: [1], denominator: [1, 0, -9]}}}}
noise: {{process: 1, measurement: {noise}}}
cost: {{output: 1, input: {price}}}
controller: {{design: lqg, delay: {delay}}}
"""


def plant(folder: Path, delay: str, price: str = "0.01", noise: str = "0.001") -> str:
    path = folder / "plant.yaml"
    path.write_text(PENDULUM.format(delay=delay, price=price, noise=noise))
    return str(path)


def latencies(count: int, seed: int = 1) -> NDArray[np.int64]:
    return (np.random.default_rng(seed).triangular(33, 68, 85, count) * MS).astype(np.int64)


def planned(sample: NDArray[np.int64], **wishes: Any) -> ChainPlan:
    return plan_chain(Profile(sample, 100 * MS), PlanRequest(**wishes))


def left(sample: NDArray[np.int64], slots: tuple[tuple[int, int], ...], *, at_once: bool) -> Any:
    """When each output leaves, one by one."""
    published = []
    for latency in sample.tolist():
        for start, end in slots:
            if latency <= start:
                published.append(start)
                break
            if at_once and latency <= end:
                published.append(latency)
                break
    assert len(published) == len(sample)
    return np.array(published)


@pytest.mark.parametrize("into_open_slot", ["at-once", "next-slot"])
@pytest.mark.parametrize("bands", [2, 3])
@pytest.mark.parametrize(("delay", "seed"), [("10ms", 1), ("70ms", 2)])
def test_no_placement_on_the_grid_costs_less(
    bands: int, delay: str, seed: int, into_open_slot: IntoOpenSlot, tmp_path: Path
) -> None:
    file, sample = plant(tmp_path, delay), latencies(60, seed)
    plan = planned(sample, bands=bands, plant=file, grid_ns=2 * MS, into_open_slot=into_open_slot)
    costs = LatencyCosts(load_loop(file).loop(100 * MS))
    last = publish_slots(plan)[-1][1]
    at_once = into_open_slot == "at-once"
    least = np.inf
    for ends in combinations(range(2 * MS, last - MS, 2 * MS), bands - 1):
        slots = tuple((end - MS, end) for end in (*ends, last))
        if slots[0][0] <= sample.min() or (np.diff([*ends, last]) <= MS).any():
            continue
        least = min(least, costs.cost(left(sample, slots, at_once=at_once)))
    assert plan.control is not None
    assert plan.control.cost == pytest.approx(least, rel=1e-9)
    assert costs.cost(left(sample, publish_slots(plan), at_once=at_once)) == pytest.approx(
        plan.control.cost, rel=1e-9
    )


def test_no_long_slot_costs_less(tmp_path: Path) -> None:
    file, sample = plant(tmp_path, "75ms"), latencies(80, 3)
    plan = planned(sample, plant=file, grid_ns=MS)
    costs = LatencyCosts(load_loop(file).loop(100 * MS))
    starts = range(30 * MS, publish_slots(plan)[-1][1] - MS + 1, MS)
    least = min(costs.cost(np.maximum(sample, start)) for start in starts)
    assert plan.control is not None
    assert plan.control.alternatives["one long slot"] == pytest.approx(least, rel=1e-9)
    assert plan.control.unshaped == pytest.approx(costs.cost(sample), rel=1e-9)
    assert plan.control.cost == min(filter(None, plan.control.alternatives.values()))


def test_a_finer_grid_is_searched_from_a_coarser_one(tmp_path: Path) -> None:
    """On smooth costs it ends at the least of all placements."""

    def cost_of(rows: NDArray[np.int64]) -> NDArray[np.float64]:
        first, second = rows[:, 0], rows[:, 1]
        cost: NDArray[np.float64] = (first - 301.0) ** 2 + (second - 777.0) ** 2
        cost += 0.3 * (first - 301.0) * (second - 777.0)
        return cost

    assert searched(1000, 2, cost_of, most=500) == ((301, 777), 0.0)
    assert searched(1000, 2, lambda rows: np.full(len(rows), np.inf), most=500) is None
    assert searched(1, 2, cost_of) is None
    # A plan over a fine grid is not worse than that over a coarse one, of which all is tried.
    file, sample = plant(tmp_path, "70ms"), latencies(400, 5)
    coarse, fine = (planned(sample, bands=3, plant=file, grid_ns=g) for g in (MS, 10_000))
    assert coarse.control is not None
    assert fine.control is not None
    assert fine.control.cost <= coarse.control.cost


def test_shaping_that_is_not_worth_it_is_said_to_be_so(tmp_path: Path) -> None:
    """A slow controller suffers from the added delay more than from jitter."""
    plan = planned(latencies(500), plant=plant(tmp_path, "62ms"), grid_ns=MS)
    assert plan.control is not None
    assert not plan.control.worth
    assert plan.control.cost >= (plan.control.unshaped or 0) * 0.999


def test_a_fast_controller_that_counts_on_the_delay_is_worth_it(tmp_path: Path) -> None:
    file = plant(tmp_path, "62ms", price="0.000001", noise="0.000001")
    plan = planned(latencies(500), plant=file, redesign=True, grid_ns=MS)
    assert plan.control is not None
    assert plan.control.worth
    assert plan.control.chosen == "one slot, redesigned"
    ((start, _),) = publish_slots(plan)
    assert plan.control.delay_ns == start
    assert plan.control.cost < 0.7 * (plan.control.unshaped or 0)
    assert plan.control.alternatives["one slot"] is None, "with the controller as it is: unstable"
    path = tmp_path / "plan.yaml"
    save_plan(Plan.of(plan), path)
    (read,) = load_plan(path).chains
    assert read.control is not None
    assert read.control.cost == plan.control.cost
    assert read.control.delay_ns == start


def test_a_loop_that_is_unstable_with_any_slots_is_refused(tmp_path: Path) -> None:
    file = plant(tmp_path, "0ms", price="0.000001", noise="0.000001")
    with pytest.raises(OperationError, match="unstable with any slots"):
        planned(latencies(200), plant=file, grid_ns=MS)


@pytest.mark.parametrize(
    ("wishes", "reason"),
    [
        ({"redesign": True}, "add --plant"),
        ({"plant": "plant.yaml", "minimise": "gap"}, "leave out --minimise"),
        ({"plant": "plant.yaml", "policy": "server-per-chain"}, "--plant places latency bands"),
        ({"plant": "nothing.yaml"}, "cannot be read"),
    ],
)
def test_wishes_that_exclude_each_other_are_refused(wishes: dict[str, Any], reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        planned(latencies(50), **wishes)


def test_the_largest_gap_and_the_average_bound_the_placement(tmp_path: Path) -> None:
    file, sample = plant(tmp_path, "70ms"), latencies(300, 7)
    plan = planned(sample, bands=3, plant=file, grid_ns=MS, max_gap_ns=8 * MS)
    assert max(np.diff([end for _, end in publish_slots(plan)])) <= 8 * MS
    bound = planned(sample, bands=3, plant=file, grid_ns=MS, mean_at_most_ns=72 * MS)
    assert bound.predicted.mean_ns <= 72 * MS
