"""Asynchronous publication and the application: writers, warnings, lifespans."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_publisher_threads import LATENCIES, MS, asynchronous

from chainshaper.planning import (
    PlanRequest,
    Profile,
    let_per_chain,
    plan_chain,
    plan_shaping,
    plan_warnings,
    with_bands,
)
from chainshaper.planning.overruns import (
    Writer,
    check_publication,
    cycles_until_output,
    output_lifespan,
    publication_warnings,
)
from chainshaper.planning.plan import publish_slots, revised
from chainshaper.values.errors import InputError

OUTPUT = Writer("/n5", "/t5", depth=10, asynchronous=True)
SYNCHRONOUS = plan_shaping(LATENCIES, 100 * MS, output="/t5", publisher="/n5", nodes=["/n5"])


def test_an_application_that_fits_is_accepted() -> None:
    others = [Writer("/n5", "/log", 10, False), Writer("/n1", "/t1", 10, True)]
    assert check_publication(asynchronous(), [OUTPUT, *others]) == []
    assert check_publication(asynchronous(), [Writer("/n5", "/t5")]) == [], "what nobody knows"


def test_a_plan_with_a_shaping_node_asks_nothing() -> None:
    assert check_publication(SYNCHRONOUS, []) == []
    assert publication_warnings(SYNCHRONOUS) == []


@pytest.mark.parametrize(
    ("writer", "said"),
    [
        (Writer("/n4", "/t5", 10, True), "but /n5 does not publish it: plan again"),
        (Writer("/n5", "/t5", 10, False), "publishes /t5 synchronously.*would hold nothing"),
    ],
)
def test_an_application_that_publishes_otherwise_is_refused(writer: Writer, said: str) -> None:
    with pytest.raises(InputError, match=said):
        check_publication(asynchronous(), [writer])


def test_a_history_that_is_too_shallow_for_the_slots_is_refused() -> None:
    rare = revised(asynchronous(), cycle_ns=300 * MS)
    check_publication(rare, [Writer("/n5", "/t5", 3, True)])
    with pytest.raises(InputError, match=r"history of 2, but 3 messages.*depth of 4"):
        check_publication(rare, [Writer("/n5", "/t5", 2, True)])


def test_other_asynchronous_writers_of_the_process_are_named() -> None:
    others = [Writer("/n5", "/rosout", 10, True), Writer("/n5", "/debug", 10, True)]
    (warning,) = check_publication(asynchronous(), [OUTPUT, *others])
    assert warning.startswith("/debug, /rosout of /n5 will be delayed as well")


def test_the_plan_itself_warns_of_what_it_cannot_see() -> None:
    (warning,) = publication_warnings(asynchronous(publish_slot_ns=10 * MS))
    assert "/rosout" in warning
    narrow = publication_warnings(asynchronous())
    assert narrow[0] == warning
    assert narrow[1].startswith("a slot of 1ms that opens late")
    assert publication_warnings(asynchronous(overrun="publish")) == [warning], "it stays open"
    assert set(narrow) <= set(plan_warnings(asynchronous()))
    shallow = asynchronous(output_depth=1)
    assert "no room for an output that overran" in publication_warnings(shallow)[-1]
    discarding = asynchronous(overrun="discard")
    assert "if /t5 has a lifespan of 60ms" in publication_warnings(discarding)[-1]
    let = revised(let_per_chain(asynchronous()), overrun="discard")
    assert output_lifespan(let) is None
    assert "none will be discarded" in publication_warnings(let)[-1]


def test_the_lifespan_is_worked_out_by_hand() -> None:
    assert output_lifespan(asynchronous()) is None, "they wait"
    assert output_lifespan(revised(SYNCHRONOUS, overrun="discard")) is None, "the gate does it"
    discarding = asynchronous(overrun="discard")
    assert output_lifespan(discarding) == 60 * MS
    banded = with_bands(discarding, LATENCIES, 2)
    first, last = publish_slots(banded)
    assert output_lifespan(banded) == max(first[1], last[1] - first[1])


@given(st.data())
def test_a_lifespan_tells_overruns_from_outputs_that_are_in_time(data: st.DataObject) -> None:
    """A model of DDS: who waits for a slot for longer than the lifespan is discarded."""
    latencies = np.array(sorted(data.draw(st.lists(st.integers(1, 80), min_size=2, max_size=9))))
    plan = plan_shaping(
        latencies * MS,
        100 * MS,
        output="/t5",
        publisher="/n5",
        publication="asynchronous",
        overrun="discard",
        publish_slot_ns=2 * MS,
    )
    if data.draw(st.booleans()):
        plan = with_bands(plan, latencies * MS, "auto")
    lifespan, slots, cycle = output_lifespan(plan), publish_slots(plan), plan.cycle_ns
    assert lifespan is not None
    assert cycles_until_output(plan) == 0

    def waits(latency: int) -> int:
        """From being handed over to the next slot."""
        for start, end in (*slots, *((start + cycle, end + cycle) for start, end in slots)):
            if latency < end:
                return max(0, start - latency)
        raise AssertionError("beyond the next cycle")

    in_time = data.draw(st.integers(0, slots[-1][1] - 1))
    assert waits(in_time) <= lifespan
    told_apart_until = cycle + slots[0][0] - lifespan
    if slots[-1][1] < told_apart_until:
        overrun = data.draw(st.integers(slots[-1][1], told_apart_until - 1))
        assert waits(overrun) > lifespan


def test_a_request_carries_what_becomes_of_overruns() -> None:
    profile = Profile(LATENCIES, 100 * MS, nodes=("/n1", "/n5"), topics=("/t1", "/t5"))
    assert plan_chain(profile).overrun == "publish"
    asynchronous = PlanRequest(publication="asynchronous")
    assert plan_chain(profile, asynchronous).overrun == "publish"
    let = replace(asynchronous, policy="let-per-chain")
    assert plan_chain(profile, let).overrun == "wait"
    assert plan_chain(profile, PlanRequest(overrun="discard")).overrun == "discard"
    for policy in ("let-per-chain", "one-long-slot"):
        start = 40 * MS if policy == "one-long-slot" else None
        request = PlanRequest(policy=policy, overrun="publish", slot_start_ns=start)
        assert plan_chain(profile, request).overrun == "publish"
