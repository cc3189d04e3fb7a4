"""Room for outputs that come behind the slot they were due in."""

import numpy as np
import pytest

from chainshaper.planning import Plan, plan_shaping, publish_slots
from chainshaper.planning.overruns import with_room_for_overruns
from chainshaper.planning.plan import revised

MS = 1_000_000


def planned(longest_ns: int) -> Plan:
    """A margin of 0.5 ms and a slot of 1 ms behind the longest latency, of a cycle of 100 ms."""
    return plan_shaping(
        np.array([25 * MS, longest_ns]),
        100 * MS,
        spec="/t1../t5",
        output="/t5",
        publisher="/node5",
        nodes=["/node1", "/node5"],
        epsilon_ns=MS // 2,
    )


@pytest.mark.parametrize(("start", "end"), [(59, 69), (95, 100), (99, 100)])
def test_it_is_a_tenth_of_the_cycle_and_ends_with_it(start: int, end: int) -> None:
    plan = planned(start * MS - MS // 2)
    assert publish_slots(plan) == ((start * MS, (start + 1) * MS),)
    wide = with_room_for_overruns(plan)
    assert publish_slots(wide) == ((start * MS, end * MS),)
    chain, _ = wide.servers
    assert chain.slots == ((0, end * MS),), "the chain can finish meanwhile"
    assert wide.predicted == plan.predicted, "outputs in time do not move"
    assert with_room_for_overruns(wide) == wide


@pytest.mark.parametrize("overrun", ["discard", "publish"])
def test_what_is_discarded_or_published_at_once_needs_none(overrun: str) -> None:
    plan = revised(planned(50 * MS), overrun=overrun)
    assert with_room_for_overruns(plan) == plan


def test_a_slot_of_somebody_else_is_respected() -> None:
    plan = planned(50 * MS)
    chain, output = plan.servers
    slot = ((55 * MS, 60 * MS),)
    other = output.model_copy(update={"name": "other", "slots": slot, "threads": ()})
    crowded = revised(plan, servers=(chain, output, other))
    assert with_room_for_overruns(crowded) == crowded
