"""Bands and the long slot on a whole plan."""

from importlib.util import find_spec

import numpy as np
import pytest

from chainshaper.planning.bands import choose_bands, with_bands, with_long_slot
from chainshaper.planning.baselines import server_per_chain
from chainshaper.planning.plan import Plan, publish_slots
from chainshaper.planning.shaping import plan_shaping
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.plan_choices import Solver

MS = 1_000_000
LATENCIES = (np.random.default_rng(3).triangular(33, 68, 85, 2000) * MS).astype(np.int64)


def _plan() -> Plan:
    return plan_shaping(LATENCIES, 100 * MS, output="/t5", publisher="/n5", nodes=["/n5"])


def test_bands_replace_the_publish_slot_and_nothing_else() -> None:
    plan = _plan()
    banded = with_bands(plan, LATENCIES, 3)
    assert len(publish_slots(banded)) == 3
    assert publish_slots(banded)[-1] == publish_slots(plan)[-1]
    assert banded.servers[0] == plan.servers[0]
    assert banded.predicted.max_ns == plan.predicted.max_ns
    assert banded.predicted.mean_ns < plan.predicted.mean_ns
    assert sum(banded.predicted.shares) == pytest.approx(1)
    first, last = publish_slots(banded)[0], publish_slots(banded)[-1]
    assert banded.predicted.jitter_ns == last[1] - first[0]
    unchanged = {"servers", "predicted"}
    assert banded.model_dump(exclude=unchanged) == plan.model_dump(exclude=unchanged)


def test_solvers_agree_in_order() -> None:
    if find_spec("pyswarms") is None:
        pytest.skip("pyswarms is not installed")
    solvers: list[Solver] = ["exact", "pso", "random"]
    exact, swarm, drawn = (
        with_bands(_plan(), LATENCIES, 4, solver=solver, seed=1).predicted.mean_ns
        for solver in solvers
    )
    assert exact <= swarm <= drawn


def test_auto_takes_a_number_of_bands_from_the_curve() -> None:
    curve = choose_bands(_plan(), LATENCIES).curve
    auto = with_bands(_plan(), LATENCIES, "auto")
    bands = len(publish_slots(auto))
    assert 2 <= bands <= 6
    assert auto.predicted.mean_ns == round(curve[bands - 1].mean_ns)


def test_goals_and_limits_reach_the_placement() -> None:
    ends = [end for _, end in publish_slots(with_bands(_plan(), LATENCIES, 4, max_gap_ns=5 * MS))]
    assert max(np.diff(ends)) <= 5 * MS
    shared = with_bands(_plan(), LATENCIES, 4, max_share=0.3)
    assert max(shared.predicted.shares) <= 0.3
    least = with_bands(_plan(), LATENCIES, 3).predicted
    calm = with_bands(
        _plan(), LATENCIES, 3, minimise="jitter", mean_at_most_ns=least.mean_ns + 2 * MS
    ).predicted
    assert calm.jitter_ns < least.jitter_ns
    assert calm.mean_ns <= least.mean_ns + 2 * MS
    with pytest.raises(OperationError, match=r"30\.0% of the executions"):
        with_bands(_plan(), LATENCIES, 3, max_share=0.3)
    with pytest.raises(InputError, match="needs the exact solver"):
        with_bands(_plan(), LATENCIES, 3, solver="pso", mean_at_most_ns=80 * MS)
    with pytest.raises(InputError, match="only the exact solver"):
        with_bands(_plan(), LATENCIES, "auto", solver="random")


def test_one_long_slot_trades_jitter_for_the_average() -> None:
    latencies = np.array([40, 61, 70, 85]) * MS
    plan = plan_shaping(latencies, 100 * MS, output="/t5")
    long = with_long_slot(plan, latencies, 62 * MS)
    assert long.policy == "one-long-slot"
    assert publish_slots(long) == ((62 * MS, 87 * MS),)
    assert long.predicted.mean_ns == (62 + 62 + 70 + 85) * MS // 4
    assert long.predicted.jitter_ns == 25 * MS  # as the paper's three bands, earlier on average
    for start in (-1, 86 * MS + 1):
        with pytest.raises(InputError, match="may start from 0ms to 86ms"):
            with_long_slot(plan, latencies, start)


def test_a_plan_without_publish_slot_has_no_bands() -> None:
    bare = server_per_chain(_plan())
    with pytest.raises(InputError, match="server-per-chain has no publish slot"):
        with_bands(bare, LATENCIES, 2)
    with pytest.raises(InputError, match="no publish slot"):
        with_long_slot(bare, LATENCIES, 0)
