"""Overruns, asynchronous publishers, and servers as they are carried out."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bare_plans import MS, slots_ms
from hypothesis import given, settings
from hypothesis import strategies as st
from known import known
from small_chain import small_chain_plan

from chainshaper.enforcement.litmus import litmus_commands
from chainshaper.flow.plan_checks import refuse_unfit
from chainshaper.flow.server_tables import server_table
from chainshaper.planning import (
    PlanRequest,
    Profile,
    load_plan,
    plan_application,
    plan_chain,
    plan_shaping,
    plan_warnings,
    publish_slots,
    save_plan,
)
from chainshaper.planning.bands import with_bands, with_long_slot
from chainshaper.planning.chain_plan import (
    ChainPlan,
    messages_waiting,
    output_server,
    publisher_servers,
    revised,
    with_slots,
)
from chainshaper.planning.overruns import (
    Writer,
    check_publication,
    cycles_until_output,
    open_until_done,
    output_lifespan,
    publication_warnings,
)
from chainshaper.planning.plan import Plan
from chainshaper.planning.plan import open_until_done as carried_out
from chainshaper.planning.shaping import (
    let_per_chain,
    server_per_chain,
    with_best_effort,
    with_sink,
)
from chainshaper.values.errors import InputError

LATENCIES = np.array([26, 40, 50, 58]) * MS


def asynchronous(**changes: Any) -> ChainPlan:
    """The paper's section 5.2: the chain in [0, 59) ms, its publisher in [59, 60) ms."""
    given: dict[str, Any] = {"output": "/t5", "publisher": "/n5", "nodes": ["/n1", "/n5"]}
    given |= {"core": 0, "publication": "asynchronous", "overrun": "wait", **changes}
    return plan_shaping(LATENCIES, 100 * MS, **given)


def planned(**changes: Any) -> ChainPlan:
    """The same with a shaping node, and late outputs at once."""
    return asynchronous(**{"publication": "synchronous", "overrun": "publish", **changes})


def _moved(plan: ChainPlan, *slots_ns: tuple[int, int], **changes: object) -> ChainPlan:
    """The plan with other slots for the publisher's server."""
    (_, server, _), *_ = publisher_servers(plan)
    changed = server.model_copy(update={"slots": slots_ns or server.slots, **changes})
    others = [changed if one is server else one for one in plan.servers]
    return revised(plan, servers=tuple(others))


LAST = (59 * MS, 60 * MS)


def test_a_slot_in_which_a_send_may_be_cut_off_is_refused() -> None:
    assert slots_ms(asynchronous()) == {"chain": [(0, 59)], "output": [(59, 60)]}
    for length in (1, 250_000, MS - 1):
        with pytest.raises(InputError, match=r"too short .* block the whole process; make it 1 ms"):
            asynchronous(publish_slot_ns=length)
    # Sends that were measured count four times.
    assert asynchronous(longest_send_ns=250_000).evidence.longest_send_ns == 250_000
    with pytest.raises(InputError, match=r"the longest took 251 us.*make it 1\.004 ms or longer"):
        asynchronous(longest_send_ns=251_000)
    asynchronous(longest_send_ns=2_500_000, publish_slot_ns=10 * MS)


def test_a_publisher_that_out_ranks_its_executor_is_refused() -> None:
    inside = (40 * MS, 41 * MS)
    said = r"out-rank its executor.*'chain' runs at priority 2 .* \[40 ms, 41 ms\).*above 2"
    with pytest.raises(InputError, match=said):
        _moved(asynchronous(), inside, LAST)
    _moved(asynchronous(), inside, LAST, priority=3)
    _moved(asynchronous(), inside, LAST, core=1)
    _moved(asynchronous(nodes=["/n1"]), inside)  # another node's executor may be out-ranked
    # L̲ is 26 ms: before it nothing is handed over, and who out-ranks whom is of no consequence.
    _moved(asynchronous(), (25 * MS, 26 * MS), LAST)
    with pytest.raises(InputError, match="out-rank"):
        _moved(asynchronous(), (25 * MS, 26 * MS + 1))


def test_schedules_put_the_publisher_below_its_executor_where_they_overlap() -> None:
    for plan, priority in (
        (with_bands(asynchronous(), LATENCIES, 2), 3),
        (with_long_slot(asynchronous(), LATENCIES, 40 * MS), 3),
        (with_bands(asynchronous(), LATENCIES, 1), 1),
    ):
        assert known(output_server(plan)).priority == priority
    assert publish_slots(let_per_chain(asynchronous())) == ((0, MS),)
    with pytest.raises(InputError, match="wait or discard, or plan with --publication synchronous"):
        let_per_chain(asynchronous(overrun="publish"))


def test_a_history_that_is_too_shallow_is_refused() -> None:
    plan = asynchronous(output_depth=3)
    (_, server, _), *_ = publisher_servers(plan)
    assert messages_waiting(plan, server) == 1
    assert messages_waiting(plan, server.model_copy(update={"slots": ((0, 100 * MS),)})) == 1
    # One slot in three cycles: closed for 299 ms, so three messages may come in one stretch.
    rare = revised(plan, cycle_ns=300 * MS)
    assert messages_waiting(rare, server) == 3
    shallow = plan.chain.model_copy(update={"output_depth": 2})
    with pytest.raises(InputError, match=r"history of 2 is too shallow.*3 messages.*depth of 4"):
        revised(plan, cycle_ns=300 * MS, chain=shallow)
    check_publication(rare, [Writer("/n5", "/t5", 3, True)])
    with pytest.raises(InputError, match=r"history of 2, but 3 messages.*depth of 4"):
        check_publication(rare, [Writer("/n5", "/t5", 2, True)])


OUTPUT = Writer("/n5", "/t5", depth=10, asynchronous=True)


def test_an_application_that_fits_is_accepted_and_other_writers_are_named() -> None:
    others = [Writer("/n5", "/log", 10, False), Writer("/n1", "/t1", 10, True)]
    assert check_publication(asynchronous(), [OUTPUT, *others]) == []
    assert check_publication(asynchronous(), [Writer("/n5", "/t5")]) == [], "what is not known"
    assert check_publication(planned(), []) == publication_warnings(planned()) == []
    others = [Writer("/n5", "/rosout", 10, True), Writer("/n5", "/debug", 10, True)]
    (warning,) = check_publication(asynchronous(), [OUTPUT, *others])
    assert warning.startswith("/debug, /rosout of /n5 will be delayed as well")
    # One thread sends for all nodes of a process.
    placed = [replace(one, process=7) for one in (OUTPUT, Writer("/box", "/rosout", 10, True))]
    placed += [Writer("/n6", "/t6", process=7), Writer("/n7", "/t7", 10, True, process=8)]
    (warning,) = check_publication(asynchronous(), placed)
    assert warning.startswith("/rosout, /t6 (if asynchronous) of /box, /n6 will be delayed")
    for writer, said in (
        (Writer("/n4", "/t5", 10, True), "but /n5 does not publish it: plan again"),
        (Writer("/n5", "/t5", 10, False), "publishes /t5 synchronously.*would hold nothing"),
    ):
        with pytest.raises(InputError, match=said):
            check_publication(asynchronous(), [writer])


def test_the_plan_itself_warns_of_what_it_cannot_see() -> None:
    (warning,) = publication_warnings(asynchronous(publish_slot_ns=10 * MS))
    assert "/rosout" in warning
    narrow = publication_warnings(asynchronous())
    assert narrow[0] == warning
    assert narrow[1].startswith("a slot of 1 ms that opens late")
    assert publication_warnings(asynchronous(overrun="publish")) == [warning], "it stays open"
    assert set(narrow) <= set(plan_warnings(asynchronous()))
    let = revised(let_per_chain(asynchronous()), overrun="discard")
    for plan, said in (
        (asynchronous(output_depth=1), "no room for an output that overran"),
        (asynchronous(overrun="discard"), "if /t5 has a lifespan of 60 ms"),
        (let, "none will be discarded"),
    ):
        assert said in publication_warnings(plan)[-1]


def test_the_lifespan_is_worked_out_by_hand() -> None:
    assert output_lifespan(asynchronous()) is None, "they wait"
    assert output_lifespan(planned(overrun="discard")) is None, "the gate does it"
    discarding = asynchronous(overrun="discard")
    assert output_lifespan(discarding) == 60 * MS
    assert output_lifespan(revised(let_per_chain(asynchronous()), overrun="discard")) is None
    first, last = publish_slots(banded := with_bands(discarding, LATENCIES, 2))
    assert output_lifespan(banded) == max(first[1], last[1] - first[1])


@settings(max_examples=50, deadline=None)
@given(st.data())
def test_a_lifespan_tells_overruns_from_outputs_that_are_in_time(data: st.DataObject) -> None:
    """A model of DDS: who waits for a slot for longer than the lifespan is discarded."""
    drawn = data.draw(st.lists(st.integers(1, 80), min_size=2, max_size=9))
    latencies = np.array(sorted(drawn)) * MS
    given: dict[str, Any] = {"output": "/t5", "publisher": "/n5", "publication": "asynchronous"}
    plan = plan_shaping(latencies, 100 * MS, overrun="discard", publish_slot_ns=2 * MS, **given)
    if data.draw(st.booleans()):
        plan = with_bands(plan, latencies, "auto")
    lifespan, slots, cycle = output_lifespan(plan), publish_slots(plan), plan.cycle_ns
    assert lifespan is not None
    assert cycles_until_output(plan) == 0

    def waits(latency: int) -> int:
        """From being handed over to the next slot."""
        following = [*slots, *((start + cycle, end + cycle) for start, end in slots)]
        return next(max(0, start - latency) for start, end in following if latency < end)

    in_time = data.draw(st.integers(0, slots[-1][1] - 1))
    assert waits(in_time) <= lifespan
    told_apart_until = cycle + slots[0][0] - lifespan
    if slots[-1][1] < told_apart_until:
        overrun = data.draw(st.integers(slots[-1][1], told_apart_until - 1))
        assert waits(overrun) > lifespan


@pytest.mark.parametrize(
    ("wishes", "overrun"),
    [
        ({}, "publish"),
        ({"publication": "asynchronous"}, "publish"),
        ({"publication": "asynchronous", "policy": "let-per-chain"}, "wait"),
        ({"overrun": "discard"}, "discard"),
        ({"policy": "one-long-slot", "overrun": "publish", "slot_start_ns": 40 * MS}, "publish"),
    ],
)
def test_a_request_carries_what_becomes_of_overruns(wishes: Any, overrun: str) -> None:
    profile = Profile(LATENCIES, 100 * MS, nodes=("/n1", "/n5"), topics=("/t1", "/t5"))
    assert plan_chain(profile, PlanRequest(**wishes)).overrun == overrun


def test_the_chain_may_finish_until_the_cycle_ends_and_the_plan_itself_stays() -> None:
    plan = planned()
    assert slots_ms(plan) == {"chain": [(0, 59)], "output": [(59, 60)]}, "eq. 1 and 4"
    enforced = open_until_done(plan)
    assert slots_ms(enforced) == {"chain": [(0, 100)], "output": [(59, 60)]}
    assert open_until_done(enforced) == enforced
    assert publish_slots(enforced) == publish_slots(plan), "outputs in time do not move"
    # All servers that run to the end stay open, also for further sinks.
    further = open_until_done(with_sink(plan, LATENCIES + 10 * MS, "/t9"))
    assert slots_ms(further)["chain"] == [(0, 100)]
    assert slots_ms(further)["output_chainshaper_t9"] == [(69, 70)]
    # So they do whatever becomes of the output; an asynchronous publisher sends in slots only.
    for overrun in ("wait", "discard"):
        in_slots = open_until_done(planned(overrun=overrun, publication="asynchronous"))
        assert slots_ms(in_slots) == {"chain": [(0, 100)], "output": [(59, 60)]}
    # What has no slot behind the chain's stays: a server for what runs beside it, LET.
    assert open_until_done(server_per_chain(plan)) == server_per_chain(plan)
    assert open_until_done(let_per_chain(plan)) == let_per_chain(plan)


def test_the_slots_of_other_servers_are_left_out_where_a_chain_may_finish() -> None:
    plan = planned()

    def with_other(begin: int, end: int, **changes: int) -> ChainPlan:
        slot = ((begin * MS, end * MS),)
        other = plan.servers[0].model_copy(update={"name": "other", "slots": slot, "threads": ()})
        return revised(plan, servers=(*plan.servers, other.model_copy(update=changes)))

    split = open_until_done(with_other(75, 80))
    assert slots_ms(split)["chain"] == [(0, 75), (80, 100)]
    assert open_until_done(split) == split
    assert slots_ms(open_until_done(with_other(59, 80)))["chain"] == [(0, 59), (80, 100)]
    for elsewhere in (with_other(75, 80, core=1), with_other(75, 80, priority=3)):
        assert slots_ms(open_until_done(elsewhere))["chain"] == [(0, 100)]


def test_a_publishers_thread_may_send_late_outputs_below_its_executor() -> None:
    plan = planned(publication="asynchronous")
    enforced = open_until_done(with_bands(plan, LATENCIES, 2, grid_ns=MS))
    assert slots_ms(enforced) == {"chain": [(0, 100)], "output": [(39, 40), (59, 100)]}
    chain, output = enforced.servers
    assert output.priority > chain.priority, "it must not out-rank what holds its locks"
    # What is best effort on that core runs behind both, and prevents neither.
    beside = open_until_done(with_best_effort([plan], {"/logger": 0})[0])
    assert slots_ms(beside) == {
        "chain": [(0, 100)],
        "output": [(59, 100)],
        "best_effort_core0": [(0, 100)],
    }
    assert [server.priority for server in beside.servers] == [2, 3, 4]


# Servers as they are carried out ----------------------------------------------------------------


def in_slots(overrun: str = "wait", **wishes: Any) -> ChainPlan:
    values = {"spin_ns": MS, "pause_ns": 2 * MS, "shaping_thread": "in-slots", **wishes}
    return small_chain_plan(10 * MS, 20 * MS, overrun=overrun, **values)


def open_in_ms(plan: ChainPlan, name: str = "output") -> list[tuple[float, float]]:
    (server,) = [s for s in carried_out(Plan.of(plan)).servers if s.name == name]
    return [(start / MS, end / MS) for start, end in server.slots]


def test_a_shaping_nodes_server_opens_early_enough_for_its_gate() -> None:
    """4 ms to take the message, 1 to watch; behind the slot the pause, and 2 ms for its notes."""
    late = in_slots()
    assert open_in_ms(late) == [(16, 26)]
    assert open_in_ms(in_slots("publish")) == [(16, 50)], "what is late may leave at once"
    for first_ms, opened in ((10, [(5, 15), (16, 26)]), (15, [(10, 26)])):
        bands = {"output": [(first_ms * MS, first_ms * MS + MS), (21 * MS, 22 * MS)]}
        assert open_in_ms(revised(late, servers=with_slots(late.servers, bands))) == opened
    assert open_in_ms(let_per_chain(late)) == [(0, 5), (45, 50)], "around the end of the cycle"
    assert open_in_ms(revised(late, offset_ns=30 * MS)) == [(0, 6), (46, 50)]


def test_every_back_end_has_the_server_when_its_node_runs_in_slots() -> None:
    free, bound = Plan.of(in_slots(shaping_thread="free")), Plan.of(in_slots())
    assert [s.name for s in server_table(free).servers] == ["chain"]
    assert [t.node for t in free.free_threads] == ["/chainshaper_t3"]
    assert not bound.free_threads
    commands = litmus_commands(server_table(bound), {"chain": [7], "output": [8]}, anchor_ns=0)
    assert [" ".join(command) for command in commands[1:]] == [
        "resctl -n 1001 -t table-driven -c 1 -m 50 -q 2 [0,21)",
        "resctl -n 1002 -t table-driven -c 1 -m 50 -q 1 [16,26)",
        "resctl -a 7 -r 1001 -c 1",
        "resctl -a 8 -r 1002 -c 1",
    ]
    with pytest.raises(InputError, match=r"shaping_thread: in-slots, but .* no shaping node"):
        revised(in_slots(), shaping_node=None)


PROFILE = Profile(
    latencies_ns=np.array([10 * MS, 20 * MS]),
    period_ns=50 * MS,
    nodes=("/first", "/second"),
    topics=("/t1", "/t3"),
    core_of={"/first": 1, "/second": 1},
    cores={"/first": 1, "/second": 1, "/noise": 2},
)


def test_best_effort_comes_behind_all_others_in_a_server_that_is_always_open(
    tmp_path: Path,
) -> None:
    """On its own core, where it has one; else on the chain's (R_m' and R_int)."""
    plan = plan_chain(PROFILE, PlanRequest(best_effort=("noise", "/logger")))
    assert [(s.name, s.core, s.priority) for s in plan.servers if s.best_effort] == [
        ("best_effort_core1", 1, 3),
        ("best_effort_core2", 2, 3),
    ]
    save_plan(Plan.of(plan), tmp_path / "plan.yaml")
    assert load_plan(tmp_path / "plan.yaml") == Plan.of(plan)
    short = revised(plan, servers=with_slots(plan.servers, {"best_effort_core1": [(0, 45 * MS)]}))
    assert open_in_ms(short, "best_effort_core1") == [(0, 45)], "overruns are the chain's"
    better = [s.model_copy(update={"priority": 2}) if s.best_effort else s for s in plan.servers]
    with pytest.raises(InputError, match="best effort comes behind all others: write more than 2"):
        revised(plan, servers=tuple(better))
    with pytest.raises(InputError, match="/second is in the server 'chain'"):
        plan_chain(PROFILE, PlanRequest(best_effort=("/second",)))
    other = replace(
        PROFILE, nodes=("/third",), topics=("/u",), core_of={"/third": 1}, begins=(9, "")
    )
    both, _ = plan_application([PROFILE, other], PlanRequest(best_effort=("/logger",)))
    assert [len(s.threads) for s in both.servers if s.best_effort] == [1], "one for all chains"
    # Also behind the other chain's publisher, which is then ranked below its executor.
    elsewhere = replace(other, core_of={"/third": 2})
    request = PlanRequest(best_effort=("/noise",), publication="asynchronous")
    gated = carried_out(plan_application([PROFILE, elsewhere], request)[0])
    on_core = [s for chain in gated.chains for s in chain.servers if s.core == 2]
    ranks = [(s.priority, s.best_effort) for s in on_core]
    assert sorted(ranks) == [(2, False), (3, False), (4, True)]


def test_servers_of_one_priority_overlap_only_where_they_take_turns() -> None:
    """Eq. 3: R_m°'s priority is R_m's; R_m stays open behind R_m°'s slot for what overruns."""
    plan = plan_chain(PROFILE, PlanRequest(equal_priorities="round-robin", epsilon_ns=MS))
    assert [(s.name, s.priority) for s in plan.servers] == [("chain", 1), ("output", 1)]
    assert open_in_ms(plan, "chain") == [(0, 50)]
    apart = revised(plan, equal_priorities="apart")
    assert open_in_ms(apart, "chain") == [(0, 21), (22, 50)]
    with pytest.raises(InputError, match="overlaps"):
        revised(apart, servers=with_slots(plan.servers, {"chain": [(0, 40 * MS)]}))
    refuse_unfit(Plan.of(plan), "freezer")
    with pytest.raises(InputError, match=r"under the back end scx .* \(--backend freezer\)"):
        refuse_unfit(Plan.of(plan), "scx")


def test_closed_servers_are_open_in_their_slots_only(tmp_path: Path) -> None:
    """As the paper's; what only sets priorities cannot close them."""
    closed = plan_chain(PROFILE, PlanRequest(slot_ends="closed", epsilon_ns=MS))
    open_for_long = plan_chain(PROFILE, PlanRequest(epsilon_ns=MS))
    assert closed.servers == open_for_long.servers
    assert open_in_ms(closed, "chain") == [(0, 21)]
    assert open_in_ms(open_for_long, "chain") == [(0, 50)]
    both, _ = plan_application([PROFILE], PlanRequest(slot_ends="closed", epsilon_ns=MS))
    assert [chain.slot_ends for chain in both.chains] == ["closed"]
    save_plan(Plan.of(closed), tmp_path / "closed.yaml")
    assert load_plan(tmp_path / "closed.yaml") == Plan.of(closed)
    for back_end in ("freezer", "scx", "litmus"):
        refuse_unfit(Plan.of(closed), back_end)
    with pytest.raises(InputError, match=r"back end fifo sets priorities only.*closed"):
        refuse_unfit(Plan.of(closed), "fifo")
