"""Who does what and gets which priority: by hand, by real processes, and what must always hold."""

import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from actors import acting
from hypothesis import given
from hypothesis import strategies as st

from chainshaper.enforcement.threads import (
    DDS_PRIORITY,
    Allocation,
    NodeThread,
    RecordedProcess,
    RecordedThread,
    WantedScheduling,
    allocate,
    left_by_back_end,
    new_and_ended,
    plan_scheduling,
    server_members,
    server_priorities,
)
from chainshaper.linux.processes import Process, read_process
from chainshaper.linux.scheduling import Scheduling
from chainshaper.linux.threads import Thread, ThreadRole, dds_kind, role_of
from chainshaper.planning import Plan, plan_shaping
from chainshaper.planning.plan import Server, ShapingNode, revised
from chainshaper.planning.plan import Thread as PlannedThread
from chainshaper.values.errors import InputError, OperationError

CYCLONE = ("gc", "dq.builtins", "dq.user", "tev", "recv")


def _process(
    pid: int,
    command: str,
    *names: str,
    parent: int = 1,
    participates: bool = True,
    inner_pid: int | None = None,
) -> Process:
    """A process whose threads get the ids behind its own; in a container ids start from 1."""
    inner = pid if inner_pid is None else inner_pid
    threads = tuple(
        Thread(
            tid=pid + index,
            pid=pid,
            comm=name,
            role=role_of(name, is_main=index == 0),
            policy="SCHED_OTHER",
            priority=0,
            cores=(0, 1),
            started=10,
            inner_tid=inner + index,
            kind=None if index == 0 else dds_kind(name),
        )
        for index, name in enumerate(("main", *names))
    )
    return Process(
        pid=pid,
        parent=parent,
        command=tuple(command.split()),
        inner_pid=inner,
        participates=participates,
        threads=threads,
    )


def _seen(pid: int, nodes: tuple[str, ...], *threads: RecordedThread) -> RecordedProcess:
    return RecordedProcess(pid, nodes, threads, seen_ns=time.monotonic_ns())


def _roles(allocation: Allocation) -> list[tuple[str, str, str]]:
    return [(t.thread.comm, t.thread.role, t.known_by) for t in allocation.threads]


def test_a_named_node_executes_on_its_main_thread() -> None:
    found = allocate([_process(100, "talker --ros-args -r __node:=x -r __ns:=/y", "recv", "pool")])
    assert _roles(found) == [
        ("main", "executor", "main thread"),
        ("recv", "dds", "name"),
        ("pool", "unknown", ""),
    ]
    assert {t.nodes for t in found.threads} == {("/y/x",)}
    assert {t.nodes_known_by for t in found.threads} == {"command line"}
    assert found.notes == ()


def test_a_name_guessed_from_the_program_is_said_to_be_a_guess() -> None:
    found = allocate([_process(100, "/opt/lib/talker", "recv")])
    assert found.threads[0].nodes == ("/talker",)
    assert found.threads[0].nodes_known_by == "program's name"
    assert "process 100 is called /talker after its program, which is a guess" in found.notes[0]


def test_a_process_without_ros_or_dds_executes_nothing() -> None:
    found = allocate([_process(100, "/bin/bash", participates=False)])
    assert _roles(found) == [("main", "unknown", "")]
    assert found.threads[0].nodes == ()
    assert found.notes == ()


def test_unnamed_fast_dds_threads_stay_unknown() -> None:
    """Fast DDS before 2.13: all threads carry the process's name."""
    found = allocate([_process(100, "talker --ros-args -r __node:=x", *["talker"] * 6)])
    assert [role for _, role, _ in _roles(found)] == ["executor", *["unknown"] * 6]


def test_a_recording_tells_executors_and_publishers_without_names() -> None:
    process = _process(100, "container --ros-args -r __node:=c", *["container"] * 4)
    seen = _seen(
        100,
        ("/c", "/a", "/b"),
        RecordedThread(101, "executor", ("/a",)),
        RecordedThread(102, "executor", ("/a", "/b")),
        RecordedThread(103, "publisher", ()),
    )
    found = allocate([process], [seen])
    assert [(t.thread.tid, t.thread.role, t.nodes, t.known_by) for t in found.threads] == [
        (100, "unknown", ("/c", "/a", "/b"), ""),  # it ran no callback, others did
        (101, "executor", ("/a",), "recording"),
        (102, "executor", ("/a", "/b"), "recording"),
        (103, "publisher", ("/c", "/a", "/b"), "recording"),
        (104, "unknown", ("/c", "/a", "/b"), ""),
    ]
    assert {t.nodes_known_by for t in found.threads} == {"recording"}


def test_a_recording_in_a_container_counts_in_its_own_ids() -> None:
    process = _process(9000, "talker", "talker", inner_pid=7)
    found = allocate([process], [_seen(7, ("/a",), RecordedThread(8, "executor", ("/a",)))])
    assert [(t.thread.tid, t.thread.role) for t in found.threads] == [
        (9000, "unknown"),
        (9001, "executor"),
    ]


def test_a_recording_of_another_process_with_that_id_says_nothing() -> None:
    process = _process(100, "talker --ros-args -r __node:=x", "recv")
    other_name = _seen(100, ("/other",), RecordedThread(101, "executor", ("/other",)))
    ended_before = RecordedProcess(100, ("/x",), (RecordedThread(101, "executor", ("/x",)),), 0)
    for seen in (other_name, ended_before):
        found = allocate([process], [seen])
        assert found.threads[0].nodes == ("/x",)
        assert found.threads[0].nodes_known_by == "command line"
        assert found.threads[1].thread.role == "dds"


def test_an_earlier_run_tells_what_a_containers_components_are() -> None:
    container = _process(70, "container --ros-args -r __node:=box", *CYCLONE)
    earlier = _seen(30, ("/box", "/first", "/second"), RecordedThread(30, "executor", ("/first",)))
    found = allocate([container], [earlier]).threads
    assert found[0].nodes == ("/box", "/first", "/second")
    assert (found[0].thread.role, found[0].nodes_known_by) == ("executor", "recording")
    stranger = _seen(31, ("/other", "/third"))
    assert allocate([container], [stranger]).threads[0].nodes == ("/box",)


def test_two_processes_with_one_name_are_a_note_and_nobody_is_chosen() -> None:
    line = "talker --ros-args -r __node:=x"
    found = allocate([_process(100, line, "recv"), _process(200, line, "recv")])
    assert [t.nodes for t in found.threads] == [("/x",)] * 4
    assert "node /x is ambiguous: processes 100, 200 all have it" in found.notes[0]


def test_what_runs_a_node_is_not_the_node() -> None:
    """`ros2 run` and its child have the same arguments; the child takes part in DDS."""
    runner = _process(50, "python3 ros2 run p talker --ros-args -r __node:=x", participates=False)
    node = _process(100, "talker --ros-args -r __node:=x", "recv", parent=50)
    found = allocate([runner, node])
    assert {t.thread.pid for t in found.threads if "/x" in t.nodes} == {100}
    assert found.notes == ()


def test_of_those_that_do_not_take_part_yet_the_innermost_is_the_node() -> None:
    line = "--ros-args -r __node:=x"
    outer = _process(50, f"sudo talker {line}", participates=False)
    middle = _process(60, f"taskset talker {line}", participates=False, parent=50)
    node = _process(70, f"talker {line}", participates=False, parent=60)
    found = allocate([outer, middle, node])
    assert {t.thread.pid for t in found.threads if "/x" in t.nodes} == {70}


def test_who_runs_whom_is_seen_also_outside_the_processes_asked_for() -> None:
    runner = _process(50, "ros2 run --ros-args -r __node:=x", participates=False)
    node = _process(100, "talker --ros-args -r __node:=x", "recv", parent=50)
    found = allocate([runner], among=[runner, node])
    assert [(t.thread.pid, t.nodes) for t in found.threads] == [(50, ())]


def test_several_nodes_of_one_process_share_its_threads() -> None:
    found = allocate([_process(100, "two --ros-args -r a:__node:=x -r b:__node:=y", "recv")])
    assert {t.nodes for t in found.threads} == {("/x", "/y")}


def test_threads_that_appear_and_end_are_found_by_looking_again(tmp_path: Path) -> None:
    arguments = ("--ros-args", "-r", "__node:=talker")
    with acting(tmp_path, *CYCLONE, "worker", arguments=arguments) as actor:

        def look() -> Allocation:
            process = read_process(actor.pid)
            assert process is not None
            return allocate([process])

        before = look()
        assert new_and_ended(before, look()) == ((), ())
        begun = actor.begin("dds.asyn.0.1")
        actor.end("worker")
        new, ended = new_and_ended(before, look())
    assert [(t.thread.tid, t.thread.role, t.nodes) for t in new] == [
        (begun, "publisher", ("/talker",))
    ]
    assert [t.thread.comm for t in ended] == ["worker"]


def test_an_id_that_is_used_again_is_another_thread() -> None:
    """Ids alone would say that nothing has changed."""
    before = allocate([_process(100, "talker", "recv")])
    reborn = [
        t
        if t.thread.tid == 100
        else NodeThread(
            thread=Thread(**{**vars(t.thread), "started": 99}),
            nodes=t.nodes,
            known_by=t.known_by,
            nodes_known_by=t.nodes_known_by,
        )
        for t in before.threads
    ]
    new, ended = new_and_ended(before, Allocation(tuple(reborn), ()))
    assert [t.thread.tid for t in new] == [101]
    assert [t.thread.tid for t in ended] == [101]


@pytest.mark.parametrize("started_later", [False, True])
def test_a_process_started_after_the_recording_is_not_in_it(
    tmp_path: Path, started_later: bool
) -> None:
    early = time.monotonic_ns()
    time.sleep(0.05)  # more than the tick in which the kernel tells a start
    with acting(tmp_path, "recv", "worker") as actor:
        process = read_process(actor.pid)
        assert process is not None
        seen_ns = early if started_later else time.monotonic_ns()
        threads = (RecordedThread(process.threads[1].inner_tid, "executor", ("/a",)),)
        recorded = RecordedProcess(process.inner_pid, ("/a",), threads, seen_ns)
        found = allocate([process], [recorded])
    assert (found.threads[0].nodes == ("/a",)) is not started_later


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
