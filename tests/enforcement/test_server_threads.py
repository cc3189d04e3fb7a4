"""From a plan's servers to threads and priorities: by hand, and what must always hold."""

import os
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chainshaper.enforcement.threads import (
    DDS_PRIORITY,
    Allocation,
    NodeThread,
    WantedScheduling,
    left_by_back_end,
    plan_scheduling,
    server_members,
    server_priorities,
)
from chainshaper.linux.scheduling import Scheduling
from chainshaper.linux.threads import Thread, ThreadRole
from chainshaper.planning import Plan, plan_shaping
from chainshaper.planning.plan import Server, ShapingNode, revised
from chainshaper.planning.plan import Thread as PlannedThread
from chainshaper.values.errors import InputError, OperationError

MS = 1_000_000


def _plan(*servers: Server) -> Plan:
    """A plan with these servers and nothing to publish."""
    plan = plan_shaping(np.array([5 * MS, 20 * MS]), 100 * MS)
    return revised(plan, servers=servers)


def _server(
    name: str, *threads: PlannedThread, core: int = 1, priority: int = 2, start: int = 0
) -> Server:
    slots = ((start * MS, (start + 1) * MS),)
    return Server(name=name, core=core, priority=priority, slots=slots, threads=threads)


def _node(
    name: str, pid: int, *roles: ThreadRole, cores: tuple[int, ...] = (0, 1)
) -> list[NodeThread]:
    threads = [
        Thread(
            tid=pid + index,
            pid=pid,
            comm=role,
            role=role,
            policy="SCHED_OTHER",
            priority=0,
            cores=cores,
            started=1,
        )
        for index, role in enumerate(roles)
    ]
    return [NodeThread(thread, (name,), "name", "command line") for thread in threads]


def _allocation(*nodes: list[NodeThread]) -> Allocation:
    return Allocation(tuple(thread for node in nodes for thread in node), ())


def _by_tid(wanted: tuple[WantedScheduling, ...]) -> dict[int, Scheduling]:
    return {one.thread.thread.tid: one.wanted for one in wanted}


EXECUTOR_A, EXECUTOR_B = PlannedThread(node="/a"), PlannedThread(node="/b")
PUBLISHER_B = PlannedThread(node="/b", role="publisher")


def test_servers_stand_below_dds_in_the_order_of_their_priority() -> None:
    plan = _plan(
        _server("chain", EXECUTOR_A, priority=2), _server("output", EXECUTOR_B, priority=1)
    )
    allocation = _allocation(
        _node("/a", 100, "executor", "dds", "unknown"),
        _node("/b", 200, "executor", "dds"),
        _node("/elsewhere", 300, "executor", "dds"),
    )
    assert _by_tid(plan_scheduling(plan, allocation, (0, 1))) == {
        200: Scheduling(87, (1,)),
        100: Scheduling(85, (1,)),
        101: Scheduling(90, (0,)),
        201: Scheduling(90, (0,)),
        # Best effort, unknown threads and other processes are left alone.
    }


def test_servers_that_are_scheduling_classes_get_ordinary_threads() -> None:
    plan = _plan(_server("chain", EXECUTOR_A, EXECUTOR_B))
    (real_time,) = _node("/a", 100, "executor")
    real_time = replace(
        real_time, thread=replace(real_time.thread, policy="SCHED_FIFO", priority=80)
    )
    allocation = _allocation([real_time], _node("/b", 200, "executor", "dds"))
    wanted = plan_scheduling(plan, allocation, (0, 1))
    dds = Scheduling(90, (0,))
    assert _by_tid(left_by_back_end("scx", wanted)) == {
        100: Scheduling(0, (1,)),  # real-time threads run above every server of sched_ext's
        200: Scheduling(None, (1,)),
        201: dds,
    }
    assert _by_tid(left_by_back_end("litmus", wanted)) == {
        100: Scheduling(None, (1,)),
        200: Scheduling(None, (1,)),
        201: dds,
    }
    assert left_by_back_end("freezer", wanted) == wanted
    assert Scheduling(0, None).policy == os.SCHED_OTHER


def test_who_receives_the_output_stands_below_all_servers_on_the_gates_core() -> None:
    node = ShapingNode(
        name="gate",
        input="/out_tmp",
        output="/out",
        core=1,
        fifo_priority=84,
        spin_ns=0,
        pause_ns=0,
        receivers=("/sink", "/a", "/absent"),
    )
    chain = _server("chain", EXECUTOR_A, priority=2)
    plan = revised(
        _plan(chain, _server("output", node.thread, priority=1, start=1)), shaping_node=node
    )
    gate, sink = _node("/gate", 100, "executor"), _node("/sink", 300, "executor", "dds", "unknown")
    receiving = replace(sink[1], thread=replace(sink[1].thread, kind="receive"))
    allocation = _allocation(gate, _node("/a", 200, "executor"), [sink[0], receiving, sink[2]])
    wanted = plan_scheduling(plan, allocation, (0, 1))
    assert _by_tid(wanted) == {
        100: Scheduling(87, (1,)),
        200: Scheduling(85, (1,)),  # in the chain, and so not below it
        300: Scheduling(83, (1,)),
        301: Scheduling(91, (0,)),  # waited for, so above other DDS threads
    }
    more_cores = _by_tid(plan_scheduling(plan, allocation, (0, 1, 2, 3)))
    assert more_cores[301] == Scheduling(91, (0,)), "the core that is kept clear for them"
    assert 300 not in _by_tid(left_by_back_end("scx", wanted)), "it would outrank the servers"
    alone = revised(plan, shaping_node=node.model_copy(update={"receivers": ()}))
    assert set(_by_tid(plan_scheduling(alone, allocation, (0, 1)))) == {100, 200}


def test_several_threads_of_a_server_take_turns() -> None:
    plan = _plan(_server("chain", EXECUTOR_A, EXECUTOR_B))
    allocation = _allocation(_node("/a", 100, "executor", "executor"), _node("/b", 200, "executor"))
    assert set(_by_tid(plan_scheduling(plan, allocation, (0, 1))).values()) == {
        Scheduling(87, (1,), takes_turns=True)
    }


def test_an_asynchronous_publisher_stands_below_its_siblings_on_its_core() -> None:
    plan = _plan(
        _server("chain", EXECUTOR_A, EXECUTOR_B, priority=2),
        _server("output", PUBLISHER_B, priority=1, start=1),
        _server("rest", PlannedThread(node="/c"), priority=9),
    )
    allocation = _allocation(
        _node("/a", 100, "executor"),
        _node("/b", 200, "executor", "publisher", "dds", "unknown"),
        _node("/c", 300, "executor"),
    )
    wanted = _by_tid(plan_scheduling(plan, allocation, (0, 1)))
    assert wanted[200] == Scheduling(85, (1,), takes_turns=True)
    assert wanted[201] == Scheduling(84, (1,)), "not 87, which its server would have"
    assert wanted[300] == Scheduling(83, (1,)), "the next server stays below it"
    assert wanted[202] == Scheduling(90, (0,))
    assert wanted[203] == Scheduling(None, (0,)), "it would be outranked on core 1"


def test_a_publisher_on_a_core_of_its_own_keeps_its_servers_priority() -> None:
    plan = _plan(
        _server("chain", EXECUTOR_B, priority=2, core=1),
        _server("output", PUBLISHER_B, priority=1, core=2),
    )
    allocation = _allocation(_node("/b", 200, "executor", "publisher"))
    assert _by_tid(plan_scheduling(plan, allocation, (0, 1, 2)))[201] == Scheduling(87, (2,))


def test_a_sibling_that_cannot_leave_the_publishers_core_is_named() -> None:
    plan = _plan(_server("output", PUBLISHER_B))
    allocation = _allocation(_node("/b", 200, "executor", "publisher", "unknown", cores=(1,)))
    with pytest.raises(OperationError, match=r"thread 200 \(executor\).*core 1 only.*taskset"):
        plan_scheduling(plan, allocation, (0, 1))


def test_without_a_free_core_dds_threads_stay_where_they_are_but_above() -> None:
    plan = _plan(_server("x", EXECUTOR_A, core=0), _server("y", EXECUTOR_B, core=1))
    allocation = _allocation(_node("/a", 100, "executor", "dds"), _node("/b", 200, "executor"))
    assert _by_tid(plan_scheduling(plan, allocation, (0, 1)))[101] == Scheduling(90, None)


def test_a_node_that_is_not_running_is_named_with_those_that_are() -> None:
    allocation = _allocation(_node("/other", 100, "executor"))
    with pytest.raises(OperationError, match=r"/a of the plan is not running.*running: /other"):
        server_members(_plan(_server("chain", EXECUTOR_A)), allocation)
    with pytest.raises(OperationError, match="running: no node"):
        server_members(_plan(_server("chain", EXECUTOR_A)), _allocation())


def test_a_publisher_that_is_not_recognised_is_named_with_how_to_look() -> None:
    plan = _plan(_server("output", PUBLISHER_B))
    allocation = _allocation(_node("/b", 200, "executor", "unknown"))
    with pytest.raises(OperationError, match=r"process 200 .* asynchronous publisher.*threads 200"):
        server_members(plan, allocation)


def test_of_two_processes_that_are_one_node_none_is_chosen() -> None:
    plan = _plan(_server("chain", EXECUTOR_A))
    allocation = _allocation(_node("/a", 100, "executor"), _node("/a", 200, "executor"))
    with pytest.raises(OperationError, match="/a is ambiguous: processes 100, 200 all have it"):
        server_members(plan, allocation)


def test_nodes_that_share_an_executor_are_one_thread_of_one_server() -> None:
    shared = [
        NodeThread(one.thread, ("/a", "/b"), one.known_by, one.nodes_known_by)
        for one in _node("/a", 100, "executor")
    ]
    together = _plan(_server("chain", EXECUTOR_A, EXECUTOR_B))
    assert _by_tid(plan_scheduling(together, _allocation(shared), (0, 1))) == {
        100: Scheduling(87, (1,))
    }
    apart = _plan(_server("one", EXECUTOR_A), _server("two", EXECUTOR_B, start=1))
    with pytest.raises(OperationError, match=r"thread 100 .* /a, /b,.* servers one and two"):
        server_members(apart, _allocation(shared))


def test_more_priorities_than_there_are_are_refused() -> None:
    assert min(server_priorities(range(1, 44)).values()) == 3
    with pytest.raises(InputError, match="44 different server priorities do not fit below 90"):
        server_priorities(range(1, 45))


@st.composite
def applications(draw: st.DrawFn) -> tuple[Plan, Allocation]:
    """Nodes with executors, publishers and DDS threads, spread over servers on two cores."""
    count = draw(st.integers(1, 5))
    nodes: list[list[NodeThread]] = []
    servers: list[Server] = []
    for number in range(count):
        name = f"/n{number}"
        roles: list[ThreadRole] = ["executor", "dds"]
        roles += draw(st.lists(st.sampled_from(["publisher", "unknown", "executor"]), max_size=3))
        nodes.append(_node(name, 100 * (number + 1), *roles, cores=(0, 1, 2)))
        for role in ("executor", "publisher"):
            if role in roles and draw(st.booleans()):
                start = len(servers)
                priority = draw(st.integers(1, 12))
                core = draw(st.integers(1, 2))
                thread = PlannedThread.model_validate({"node": name, "role": role})
                server = _server(f"s{start}", thread, core=core, priority=priority, start=start)
                servers.append(server)
    if not servers:
        servers.append(_server("s", PlannedThread(node="/n0")))
    return _plan(*servers), _allocation(*nodes)


@given(applications())
def test_whatever_the_plan_the_order_of_priorities_holds(
    application: tuple[Plan, Allocation],
) -> None:
    plan, allocation = application
    wanted = plan_scheduling(plan, allocation, (0, 1, 2))
    ranks = {server.name: server.priority for server in plan.servers}
    assert len({one.thread.thread.tid for one in wanted}) == len(wanted), "one wish per thread"
    for one in wanted:
        priority, role = one.wanted.priority, one.thread.thread.role
        assert (role == "dds") == (priority == DDS_PRIORITY)
        if role == "dds" or priority is None or one.server is None:
            continue
        assert 1 <= priority < 88
        for other in wanted:
            if other.server is None or other.wanted.priority is None:
                continue
            if ranks[one.server] < ranks[other.server] and role != "publisher":
                assert priority > other.wanted.priority
            if role == other.thread.thread.role == "executor" and one.server == other.server:
                assert one.wanted == other.wanted
    after = {one.thread.thread.tid: one.wanted for one in wanted}
    for one in wanted:
        if one.thread.thread.role != "publisher":
            continue
        for sibling in allocation.threads:
            same_process = sibling.thread.pid == one.thread.thread.pid
            if not same_process or sibling.thread.role == "publisher":
                continue
            new = after.get(sibling.thread.tid, Scheduling(None, None))
            if set(new.cores or sibling.thread.cores) & set(one.wanted.cores or ()):
                assert new.priority is not None
                assert one.wanted.priority is not None
                assert one.wanted.priority < new.priority


def test_reasons_are_given_for_every_wish() -> None:
    plan = _plan(_server("chain", EXECUTOR_A))
    wanted = plan_scheduling(plan, _allocation(_node("/a", 100, "executor", "dds")), (0, 1))
    assert [one.reason for one in wanted] == [
        "server priority 2",
        "DDS threads deliver for the servers",
    ]
