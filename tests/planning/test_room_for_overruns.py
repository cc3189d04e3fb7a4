"""Servers that stay open for overruns while a plan is in force."""

from typing import Any

import numpy as np
import pytest

from chainshaper.planning import Plan, plan_shaping, publish_slots, with_bands, with_sink
from chainshaper.planning.overruns import open_until_done
from chainshaper.planning.plan import revised

MS = 1_000_000
LATENCIES = np.array([25, 40, 58]) * MS


def planned(**changes: Any) -> Plan:
    """The chain in [0, 59) ms, its output in [59, 60) ms, of a cycle of 100 ms."""
    given = {"output": "/t5", "publisher": "/n5", "nodes": ["/n1", "/n5"], **changes}
    return plan_shaping(LATENCIES, 100 * MS, **given)


def slots(plan: Plan) -> dict[str, tuple[tuple[int, int], ...]]:
    return {s.name: tuple((a // MS, b // MS) for a, b in s.slots) for s in plan.servers}


def test_the_chain_may_finish_until_the_cycle_ends_and_the_plan_itself_stays() -> None:
    plan = planned()
    assert slots(plan) == {"chain": ((0, 59),), "output": ((59, 60),)}, "eq. 1 and 4"
    enforced = open_until_done(plan)
    assert slots(enforced) == {"chain": ((0, 100),), "output": ((59, 60),)}
    assert open_until_done(enforced) == enforced
    assert publish_slots(enforced) == publish_slots(plan), "outputs in time do not move"


def test_a_publishers_thread_may_send_late_outputs_below_its_executor() -> None:
    plan = planned(publication="asynchronous")
    enforced = open_until_done(with_bands(plan, LATENCIES, 2, grid_ns=MS))
    assert slots(enforced) == {"chain": ((0, 100),), "output": ((39, 40), (59, 100))}
    chain, output = enforced.servers
    assert output.priority > chain.priority, "it must not out-rank what holds its locks"


def test_all_servers_that_run_to_the_end_stay_open_also_for_further_sinks() -> None:
    enforced = open_until_done(with_sink(planned(), LATENCIES + 10 * MS, "/t9"))
    assert slots(enforced)["chain"] == ((0, 100),)
    assert slots(enforced)["output_chainshaper_t9"] == ((69, 70),)


@pytest.mark.parametrize("overrun", ["wait", "discard"])
def test_slots_only_stay_slots_only(overrun: Any) -> None:
    plan = planned(overrun=overrun)
    assert open_until_done(plan) == plan


def test_the_slot_of_another_server_is_respected() -> None:
    plan = planned()
    slot = ((75 * MS, 80 * MS),)
    other = plan.servers[0].model_copy(update={"name": "other", "slots": slot, "threads": ()})
    crowded = revised(plan, servers=(*plan.servers, other))
    assert slots(open_until_done(crowded)) == slots(crowded)
