"""The paper's servers as they are: R_m° in force, R_m' and R_int, and turns at equal priority.

Worked by hand for the small chain: L̄ = 20 ms, ε = 1 ms, Δ = 1 ms, cycle 50 ms, so R_m is [0, 21)
and R_m° is [21, 22); the gate watches the clock for 1 ms and pauses for 2 ms.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_chain import small_chain_plan

from chainshaper.enforcement.litmus import litmus_commands
from chainshaper.flow.threads import refuse_unfit, server_table
from chainshaper.planning import (
    PlanRequest,
    Profile,
    load_plan,
    plan_application,
    plan_chain,
    save_plan,
)
from chainshaper.planning.application_plan import open_until_done, whole
from chainshaper.planning.plan import Plan, revised, with_slots
from chainshaper.planning.shaping import let_per_chain
from chainshaper.values.errors import InputError

MS = 1_000_000


def in_slots(overrun: str = "wait", **wishes: Any) -> Plan:
    values = {"spin_ns": MS, "pause_ns": 2 * MS, "shaping_thread": "in-slots", **wishes}
    return small_chain_plan(10 * MS, 20 * MS, overrun=overrun, **values)


def open_in_ms(plan: Plan, name: str = "output") -> list[tuple[float, float]]:
    (server,) = [s for s in open_until_done(whole(plan)).servers if s.name == name]
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
    free, bound = whole(in_slots(shaping_thread="free")), whole(in_slots())
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
    save_plan(plan, tmp_path / "plan.yaml")
    assert load_plan(tmp_path / "plan.yaml") == plan
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
    gated = open_until_done(plan_application([PROFILE, elsewhere], request)[0])
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
    refuse_unfit(whole(plan), "freezer")
    with pytest.raises(InputError, match=r"under the back end scx .* \(--backend freezer\)"):
        refuse_unfit(whole(plan), "scx")
