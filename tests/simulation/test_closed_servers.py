"""The paper's time-driven servers (section 2.5, table 1): closed outside of their slots."""

import numpy as np
import pytest
from schedules import MS

from chainshaper.flow.demonstration import synthetic_chain
from chainshaper.planning import CallbackTimes, ChainPlan, Plan, plan_shaping
from chainshaper.planning.chain_plan import revised
from chainshaper.planning.shaping import server_per_callback
from chainshaper.simulation import simulate_latencies
from chainshaper.workload.description import Application, ExecutionTime, load_application

NODES = tuple(f"/node{number}" for number in range(1, 6))


def _under_load(load_ms: int) -> Application:
    """The synthetic chain beside interference of so much per 100 ms, at its priority."""
    described = load_application(synthetic_chain())
    nodes = dict(described.nodes)
    other = nodes["interference"]
    times = ExecutionTime(constant_ns=load_ms * MS)
    callback = other.callbacks[0].model_copy(update={"execution": times})
    nodes["interference"] = other.model_copy(update={"callbacks": (callback,), "priority": 97})
    return described.model_copy(update={"nodes": nodes})


def _five_servers() -> ChainPlan:
    """[0, 16), [16, 32), … [64, 80) ms."""
    latencies = np.array([70 * MS, 71 * MS])
    shaped = plan_shaping(
        latencies, 100 * MS, output="/t5", publisher=NODES[-1], nodes=NODES, core=1
    )
    times = [
        CallbackTimes(node, 1, 5 * MS, 10 * MS, 16 * MS, (number - 1,) if number else ())
        for number, node in enumerate(NODES)
    ]
    return revised(server_per_callback(shaped, times), slot_ends="closed")


@pytest.mark.parametrize("load_ms", [0, 20, 40])
def test_closed_servers_make_a_chain_independent_of_interference(load_ms: int) -> None:
    """About 80 ms at most with a jitter of about 10 ms, whatever runs beside the chain."""
    described, plan = _under_load(load_ms), _five_servers()
    assert [server.slots[0] for server in plan.servers[:5]] == [
        (start * MS, (start + 16) * MS) for start in range(0, 80, 16)
    ]
    alone = simulate_latencies(_under_load(0), Plan.of(plan), cycles=500)
    beside = simulate_latencies(described, Plan.of(plan), cycles=500)
    assert alone.tolist() == beside.tolist()
    assert beside.max() / MS == pytest.approx(79, abs=1)
    assert np.ptp(beside) / MS == pytest.approx(10, abs=0.5)
