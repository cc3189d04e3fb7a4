"""Splicing the shaping node into a description: one publisher remapped, one node added."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from known import known
from small_chain import EXECUTOR_CORE, small_chain

from chainshaper import shape_application
from chainshaper.planning import ChainPlan, Plan, plan_shaping, publish_slots
from chainshaper.planning.chain_plan import revised
from chainshaper.planning.overruns import Writer
from chainshaper.planning.shaping import let_per_callback
from chainshaper.splicing.application import splice_application, writers_of
from chainshaper.values.errors import InputError
from chainshaper.workload.description import Application, NodeDescription, TopicDescription

NODES = ("first", "second", "third")


@pytest.fixture
def application(tmp_path: Path) -> Application:
    return small_chain(tmp_path, publication="asynchronous")


def test_the_publisher_is_remapped_and_the_shaping_node_takes_its_place(
    application: Application, plan: ChainPlan
) -> None:
    before = application.model_dump_json()
    spliced = splice_application(application, Plan.of(plan))
    assert application.model_dump_json() == before, "the given one is left as it is"
    assert spliced.nodes["third"].callbacks[0].publishes == ("/t3_tmp",)
    shaping = spliced.nodes["chainshaper_t3"]
    (callback,) = shaping.callbacks
    assert (callback.subscription, callback.publishes) == ("/t3_tmp", ("/t3",))
    assert (shaping.core, shaping.priority) == (EXECUTOR_CORE, 84)
    gate = known(callback.gate)
    assert (gate.slots, gate.gate().cycle_ns) == (publish_slots(plan), 50_000_000)
    assert (gate.gate().anchor, gate.spin_ns, gate.pause_ns) == ("stamp", 1_000_000, 2_000_000)
    asynchronous = TopicDescription(publication="asynchronous")
    assert spliced.topic("/t3_tmp") == spliced.topic("/t3") == asynchronous
    for name in ("first", "second", "actuator"):
        assert spliced.nodes[name] == application.nodes[name]
    assert (spliced.chain, spliced.seed) == (application.chain, application.seed)
    assert Application.model_validate(spliced.model_dump()) == spliced
    for overrun in ("wait", "discard", "publish"):
        treated = splice_application(application, Plan.of(revised(plan, overrun=overrun)))
        assert known(treated.nodes["chainshaper_t3"].callbacks[0].gate).gate().overrun == overrun


def _changed(plan: ChainPlan, **changes: object) -> ChainPlan:
    assert plan.shaping_node is not None
    return plan.model_copy(update={"shaping_node": plan.shaping_node.model_copy(update=changes)})


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"output": "/t9"}, "publishes /t9, but the chain's output is /t3"),
        ({"name": "second"}, "has a node 'second' already.*change it in the plan"),
        ({"input": "/t1"}, "publishes /t1 already.*change `shaping_node.input` in the plan"),
        ({"fifo_priority": 98}, "cannot be run: priority: 98 should be less than or equal to 97"),
        ({"pause_ns": 50_000_000}, "cannot be run: pause: must be shorter than the cycle"),
        ({"spin_ns": 60_000_000}, "cannot be run: spin: must be shorter than the cycle"),
    ],
)
def test_a_plan_that_does_not_fit_is_refused(
    application: Application, plan: ChainPlan, changes: dict[str, object], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        splice_application(application, Plan.of(_changed(plan, **changes)))


def test_what_has_no_shaping_node_or_two_publishers_is_refused(
    application: Application, plan: ChainPlan
) -> None:
    bare = plan_shaping(np.array([5_000_000, 20_000_000]), plan.cycle_ns)
    with pytest.raises(InputError, match="no `shaping_node`, so there is nothing to splice"):
        splice_application(application, Plan.of(bare))
    nodes = {**application.nodes, "fourth": application.nodes["third"]}
    both = application.model_copy(update={"nodes": nodes})
    with pytest.raises(InputError, match="which third, fourth of the application publishes"):
        splice_application(both, Plan.of(plan))


def _asynchronous(**changes: Any) -> ChainPlan:
    return plan_shaping(
        np.array([5_000_000, 20_000_000]),
        50_000_000,
        **{
            "output": "/t3",
            "publisher": "/third",
            "nodes": tuple(f"/{node}" for node in NODES),
            "publication": "asynchronous",
            "publish_slot_ns": 10_000_000,
            **changes,
        },
    )


def test_a_gated_publisher_needs_no_node_and_discards_by_a_lifespan(
    application: Application,
) -> None:
    assert splice_application(application, Plan.of(_asynchronous())) == application
    discarding = _asynchronous(overrun="discard")
    spliced = splice_application(application, Plan.of(discarding))
    assert spliced.topic("/t3").lifespan_ns == 31_000_000
    assert application.topic("/t3").lifespan_ns is None
    assert Application.model_validate(spliced.model_dump()) == spliced
    shorter = spliced.topic("/t3").model_copy(update={"lifespan_ns": 9_000_000})
    own = application.model_copy(update={"topics": {"/t3": shorter}})
    shortest = splice_application(own, Plan.of(discarding)).topic("/t3")
    assert shortest.lifespan_ns == 9_000_000, "the application's own is stricter"


def test_a_gated_publisher_has_to_publish_asynchronously(
    application: Application, tmp_path: Path
) -> None:
    writers = [Writer(f"/{node}", f"/t{n}", 10, n == 3) for n, node in enumerate(NODES, start=1)]
    assert writers_of(application) == writers
    with pytest.raises(InputError, match="/third publishes /t3 synchronously"):
        splice_application(small_chain(tmp_path), Plan.of(_asynchronous()))


def test_every_topic_of_let_per_callback_gets_a_gate_of_its_own(
    application: Application, plan: ChainPlan
) -> None:
    spliced = splice_application(
        application, Plan.of(let_per_callback(plan, ["/t1", "/t2", "/t3"]))
    )
    gates = {
        callback.publishes[0]: callback.gate
        for _, callback in spliced.callbacks()
        if callback.gate is not None
    }
    due = {topic: (gate.gate().due_cycles, gate.slots) for topic, gate in gates.items()}
    ms = 1_000_000
    assert due == {
        "/t1": (1, ((2 * ms, 3 * ms),)),
        "/t2": (2, ((1 * ms, 2 * ms),)),
        "/t3": (3, ((0, 1 * ms),)),
    }
    published = [topic for _, callback in spliced.callbacks() for topic in callback.publishes]
    assert sorted(published) == ["/t1", "/t1_tmp", "/t2", "/t2_tmp", "/t3", "/t3_tmp"]


def test_a_plan_is_for_its_own_chain_and_period_also_where_the_application_names_another(
    application: Application, plan: ChainPlan, tmp_path: Path
) -> None:
    timer = {"timer": "20ms", "execution": {"constant": "1ms"}, "publishes": ["/image"]}
    camera = NodeDescription.model_validate({"callbacks": [timer]}, strict=False)
    beside = application.model_copy(update={"nodes": {"camera": camera, **application.nodes}})
    other = beside.model_copy(update={"chain": "/image../image"})
    assert (
        splice_application(other, Plan.of(plan)).nodes
        == splice_application(beside, Plan.of(plan)).nodes
    )
    named = revised(plan, chain=plan.chain.model_copy(update={"spec": "/image../t3"}))
    with pytest.raises(InputError, match=r"period 50 ms, but /image../t3 of 'small chain' has 20"):
        splice_application(beside, Plan.of(named))
    chain = plan.chain.model_copy(update={"period_ns": 60_000_000})
    slower = revised(plan, chain=chain, cycle_ns=60_000_000)
    with pytest.raises(InputError, match=r"period 60 ms, but /t1../t3 of 'small chain' has 50 ms"):
        shape_application(application, Plan.of(slower), tmp_path / "rec")
    assert not (tmp_path / "rec").exists(), "before anything starts"
