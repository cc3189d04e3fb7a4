"""Overruns and asynchronous publishers: what would be destructive is refused, the rest is said."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chainshaper.planning import (
    Plan,
    PlanRequest,
    Profile,
    let_per_callback,
    let_per_chain,
    load_plan,
    plan_chain,
    plan_shaping,
    plan_warnings,
    publish_slots,
    save_plan,
    with_bands,
    with_long_slot,
    with_sink,
)
from chainshaper.planning.overruns import (
    Writer,
    check_publication,
    cycles_until_output,
    open_until_done,
    output_lifespan,
    publication_warnings,
    refuse_offset,
)
from chainshaper.planning.plan import messages_waiting, output_server, publisher_servers, revised
from chainshaper.values.errors import InputError

MS = 1_000_000
LATENCIES = np.array([26, 40, 50, 58]) * MS


def asynchronous(**changes: Any) -> Plan:
    """The paper's section 5.2: the chain in [0, 59) ms, its publisher in [59, 60) ms."""
    given: dict[str, Any] = {"output": "/t5", "publisher": "/n5", "nodes": ["/n1", "/n5"]}
    given |= {"core": 0, "publication": "asynchronous", "overrun": "wait", **changes}
    return plan_shaping(LATENCIES, 100 * MS, **given)


def _publishing(plan: Plan, **changes: object) -> tuple[object, ...]:
    """The plan's servers, with the publisher's changed."""
    (number, server, _), *_ = publisher_servers(plan)
    changed = server.model_copy(update=changes)
    return tuple(changed if n == number else other for n, other in enumerate(plan.servers))


def test_the_papers_configuration_is_right() -> None:
    plan = asynchronous()
    assert [server.slots for server in plan.servers] == [((0, 59 * MS),), ((59 * MS, 60 * MS),)]
    assert plan.overrun == "wait"


@pytest.mark.parametrize("length", [1, 250_000, MS - 1])
def test_a_slot_in_which_a_send_may_be_cut_off_is_refused(length: int) -> None:
    with pytest.raises(InputError, match=r"too short .* block the whole process; make it 1ms"):
        asynchronous(publish_slot_ns=length)


def test_sends_that_were_measured_count_four_times() -> None:
    assert asynchronous(longest_send_ns=250_000).evidence.longest_send_ns == 250_000
    with pytest.raises(InputError, match=r"the longest took 251us.*make it 1\.004ms or longer"):
        asynchronous(longest_send_ns=251_000)
    asynchronous(longest_send_ns=2_500_000, publish_slot_ns=10 * MS)


def test_a_publisher_that_out_ranks_its_executor_is_refused() -> None:
    plan = asynchronous()
    inside = {"slots": ((40 * MS, 41 * MS), (59 * MS, 60 * MS))}
    said = r"out-rank its executor.*'chain' runs at priority 2 .* \[40ms, 41ms\).*above 2"
    with pytest.raises(InputError, match=said):
        revised(plan, servers=_publishing(plan, **inside))
    revised(plan, servers=_publishing(plan, **inside, priority=3))
    revised(plan, servers=_publishing(plan, **inside, core=1))


def test_before_the_shortest_latency_nothing_is_handed_over() -> None:
    """L̲ is 26 ms: who out-ranks whom until then is of no consequence."""
    plan = asynchronous()
    revised(plan, servers=_publishing(plan, slots=((25 * MS, 26 * MS), (59 * MS, 60 * MS))))
    with pytest.raises(InputError, match="out-rank"):
        revised(plan, servers=_publishing(plan, slots=((25 * MS, 26 * MS + 1),)))


def test_another_nodes_executor_may_be_out_ranked() -> None:
    plan = asynchronous(nodes=["/n1"])
    revised(plan, servers=_publishing(plan, slots=((40 * MS, 41 * MS),)))


def test_bands_and_long_slots_put_the_publisher_below_its_executor() -> None:
    for plan in (
        with_bands(asynchronous(), LATENCIES, 2),
        with_long_slot(asynchronous(), LATENCIES, 40 * MS),
    ):
        server = output_server(plan)
        assert server is not None
        assert server.priority == 3
    (single,) = [s for s in with_bands(asynchronous(), LATENCIES, 1).servers if s.name == "output"]
    assert single.priority == 1, "behind its executor's slot there is nobody to be below"


def test_logical_execution_time_goes_with_asynchronous_publication() -> None:
    assert publish_slots(let_per_chain(asynchronous())) == ((0, MS),)
    assert publish_slots(let_per_callback(asynchronous(), ["/t1", "/t5"], ["/n1", "/n5"])) == (
        (0, MS),
    )


@pytest.mark.parametrize(
    ("slots", "held"),
    [
        (((59, 60),), 1),  # closed for 99 ms: one message
        (((30, 31), (59, 60)), 1),
        (((0, 100),), 1),  # never closed, but the model knows no less than one
    ],
)
def test_messages_waiting_in_one_stretch(slots: tuple[tuple[int, int], ...], held: int) -> None:
    plan = asynchronous()
    (_, server, _), *_ = publisher_servers(plan)
    in_ns = tuple((start * MS, end * MS) for start, end in slots)
    assert messages_waiting(plan, server.model_copy(update={"slots": in_ns})) == held


def test_a_history_that_is_too_shallow_is_refused() -> None:
    plan = asynchronous(output_depth=3)
    # One slot in three cycles: closed for 299 ms, so three messages may come in one stretch.
    (_, server, _), *_ = publisher_servers(revised(plan, cycle_ns=300 * MS))
    assert messages_waiting(revised(plan, cycle_ns=300 * MS), server) == 3
    shallow = plan.chain.model_copy(update={"output_depth": 2})
    with pytest.raises(InputError, match=r"history of 2 is too shallow.*3 messages.*depth of 4"):
        revised(plan, cycle_ns=300 * MS, chain=shallow)


def test_under_let_a_gated_thread_cannot_publish_at_once() -> None:
    assert asynchronous(overrun="publish").overrun == "publish"
    with pytest.raises(InputError, match="wait or discard, or plan with --publication synchronous"):
        let_per_chain(asynchronous(overrun="publish"))


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ("59ms, 60ms", "59ms, 59.2ms", r"servers\[1\].slots\[0\]: the slot \[59ms, 59.2ms\)"),
        ("59ms, 60ms", "30ms, 60ms", r"servers\[1\].priority: the publisher thread of /n5"),
        ("overrun: wait", "overrun: drop", r"overrun: .*'wait', 'discard' or 'publish'"),
        ("output_depth: 10", "output_depth: 0", r"chain.output_depth: "),
    ],
)
def test_a_hand_edited_plan_is_refused_by_line_and_key(
    right: str, wrong: str, said: str, tmp_path: Path
) -> None:
    path = tmp_path / "plan.yaml"
    save_plan(asynchronous(output_depth=10), path)
    text = path.read_text()
    assert text.count(right) == 1
    assert load_plan(path) == asynchronous(output_depth=10)
    path.write_text(text.replace(right, wrong))
    with pytest.raises(InputError) as refused:
        load_plan(path)
    assert re.search(said, str(refused.value)), str(refused.value)
    assert re.match(rf"{path}:\d+: ", str(refused.value))


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


def planned(**changes: Any) -> Plan:
    """The chain in [0, 59) ms, its output in [59, 60) ms, of a cycle of 100 ms."""
    return asynchronous(**{"publication": "synchronous", "overrun": "publish", **changes})


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


def test_an_offset_is_refused_where_the_chains_timer_starts_its_cycles() -> None:
    refuse_offset(planned())
    with pytest.raises(InputError, match=r"offset: 7ms cannot be carried out here.*so much later"):
        refuse_offset(revised(planned(), offset_ns=7 * MS))
