"""Who does what and gets which priority: by hand, by real processes, and what must always hold."""

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from actors import acting
from hypothesis import given
from hypothesis import strategies as st
from known import known

from chainshaper.enforcement.node_threads import (
    IN_ORDER,
    Allocation,
    NodeThread,
    RecordedProcess,
    RecordedThread,
    allocate,
    new_and_ended,
    with_gates,
)
from chainshaper.enforcement.planned_threads import first_planned, server_members
from chainshaper.enforcement.thread_scheduling import (
    DDS_PRIORITY,
    WantedScheduling,
    left_by_back_end,
    plan_scheduling,
    server_priorities,
    waiting_receivers,
)
from chainshaper.flow.anchoring import first_threads
from chainshaper.flow.plan_checks import check_publishers
from chainshaper.linux.processes import RunningProcess, read_process
from chainshaper.linux.scheduling import SchedulingRequest
from chainshaper.linux.threads import RunningThread, ThreadRole, gate_thread_name, role_of
from chainshaper.planning import plan_shaping
from chainshaper.planning.chain_plan import (
    LoopAge,
    PlannedLoop,
    ReceiverPlace,
    Server,
    ShapingNode,
    revised,
)
from chainshaper.planning.chain_plan import Thread as PlannedThread
from chainshaper.planning.plan import Plan
from chainshaper.planning.shaping import let_per_chain, over_cores
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.middleware import thread_work
from chainshaper.values.recording import EndpointInfo, Recording, RecordingInfo

MS = 1_000_000
CYCLONE = ("gc", "dq.builtins", "dq.user", "tev", "recv")


def _process(
    pid: int,
    command: str,
    *names: str,
    parent: int = 1,
    participates: bool = True,
    inner_pid: int | None = None,
) -> RunningProcess:
    """A process whose threads get the ids behind its own; in a container ids start from 1."""
    inner = pid if inner_pid is None else inner_pid
    threads = []
    for index, name in enumerate(("main", *names)):
        role, kind = role_of(name, is_main=index == 0), None if index == 0 else thread_work(name)
        thread = RunningThread(pid + index, pid, name, role, "SCHED_OTHER", 0, (0, 1), 10)
        threads.append(replace(thread, inner_tid=inner + index, kind=kind))
    return RunningProcess(pid, parent, tuple(command.split()), inner, participates, tuple(threads))


def _seen(pid: int, nodes: tuple[str, ...], *threads: RecordedThread) -> RecordedProcess:
    return RecordedProcess(pid, nodes, threads, seen_ns=time.monotonic_ns())


X = "talker --ros-args -r __node:=x"
BOX = ("/c", "/a", "/b")
RAN_A = RecordedThread(101, "executor", ("/a",))
RAN_BOTH = RecordedThread(102, "executor", ("/a", "/b"))
SENT = RecordedThread(103, "publisher", ())
OTHERS = _seen(100, ("/other",), RecordedThread(101, "executor", ("/other",)))
RAN_X = tuple(RecordedThread(tid, "executor", ("/x",)) for tid in (100, 101))
ENDED_BEFORE = RecordedProcess(100, ("/x",), RAN_X, 0)
EARLIER = [_seen(31, ("/d", "/e")), _seen(30, BOX, RecordedThread(30, "executor", ("/a",)))]


@pytest.mark.parametrize(
    ("process", "recorded", "expected", "known_by"),
    [
        (_process(1, X, "recv", "pool"), [], "executor/main dds/name unknown/", "command line"),
        (_process(1, "/opt/lib/talker"), [], "executor/main", "program's name"),
        (_process(1, "/bin/bash", participates=False), [], "unknown/", ""),
        # Fast DDS before 2.13 names no threads.
        (_process(1, X, "talker", "talker"), [], "executor/main unknown/ unknown/", "command line"),
        # A recording knows executors and publishers without names; main ran no callback.
        (
            _process(100, "container --ros-args -r __node:=c", *["container"] * 4),
            [_seen(100, BOX, RAN_A, RAN_BOTH, SENT)],
            "unknown/ executor/recording executor/recording publisher/recording unknown/",
            "recording",
        ),
        # In a container a recording counts in the container's own ids.
        (
            _process(9000, "talker", "talker", inner_pid=100),
            [_seen(100, ("/a",), RAN_A)],
            "unknown/ executor/recording",
            "recording",
        ),
        # It says nothing about another process with that id.
        (
            _process(100, X, "recv"),
            [OTHERS, ENDED_BEFORE],
            "executor/main dds/name",
            "command line",
        ),
        # An earlier run tells what a container's components are.
        (_process(70, "box --ros-args -r __node:=c"), EARLIER, "executor/main", "recording"),
    ],
)
def test_what_each_thread_of_a_process_does(
    process: RunningProcess, recorded: list[RecordedProcess], expected: str, known_by: str
) -> None:
    found = allocate([process], recorded)
    roles = [f"{t.thread.role}/{t.known_by.removesuffix(' thread')}" for t in found.threads]
    assert roles == expected.split()
    assert {t.nodes_known_by for t in found.threads} == {known_by}
    guess = "process 1 is called /talker after its program, which is a guess"
    guesses = [note for note in found.notes if guess in note]
    assert len(guesses) == (known_by == "program's name")


def test_the_nodes_of_a_process_and_of_its_threads() -> None:
    def nodes_of(process: RunningProcess, *recorded: RecordedProcess) -> list[tuple[str, ...]]:
        return [one.nodes for one in allocate([process], recorded).threads]

    assert nodes_of(_process(1, f"{X} -r __ns:=/y", "recv")) == [("/y/x",)] * 2
    assert nodes_of(_process(1, "two --ros-args -r a:__node:=x -r b:__node:=y")) == [("/x", "/y")]
    assert nodes_of(_process(70, "box --ros-args -r __node:=c"), *EARLIER) == [BOX]
    assert nodes_of(_process(1, "/bin/bash", participates=False)) == [()]
    seen = _seen(100, BOX, RAN_A, RAN_BOTH)
    assert nodes_of(_process(100, "c", "c", "c"), seen) == [BOX, ("/a",), ("/a", "/b")]


def test_a_program_that_names_its_nodes_in_its_code_is_known_by_an_earlier_run() -> None:
    """By its main thread, whose name the kernel cuts off; not where two programs have that name."""
    main = RecordedThread(100, "unknown", (), "all_nodes_in_on")
    ran = RecordedThread(101, "executor", ("/a", "/b"), "main")
    earlier = RecordedProcess(100, ("/a", "/b"), (main, ran), seen_ns=0)
    process = _process(700, "/opt/lib/all_nodes_in_one --ros-args -r a:out:=/other", "main")
    assert {t.nodes for t in allocate([process], [earlier]).threads} == {("/a", "/b")}
    twice = [earlier, replace(earlier, pid=200, threads=(replace(main, tid=200), ran))]
    assert {t.nodes for t in allocate([process], twice).threads} == {("/all_nodes_in_one",)}


TICKS, CHAIN = (("/x", "every 10ms"),), (("/x", "/t1"), ("/x", "every 100ms"))
GROUPS = (
    *(RecordedThread(100 + n, "unknown", ("/x",), "main") for n in (0, 2)),  # 101 has ended
    RecordedThread(103, "executor", ("/x",), "main", TICKS),
    RecordedThread(104, "dds", ("/x",), "recv"),
    RecordedThread(99, "executor", ("/x",), "main", CHAIN),  # ids began again
)
EARLIER_GROUPS = RecordedProcess(100, ("/x",), GROUPS, seen_ns=0)
"""A run that has ended, of a program with two callback groups on executors of their own."""


@pytest.mark.parametrize(
    ("names", "executors"),
    [
        (["main", "recv", "main", "main"], {703: TICKS, 704: CHAIN}),
        (["gc", "main", "main", "recv", "main"], {703: TICKS, 705: CHAIN}),
        (["main", "recv", "main"], {}),  # one has not started yet: nothing is sure
        (["main", "recv", "main", "main", "main"], {}),
    ],
)
def test_executors_are_told_apart_by_the_order_in_which_an_earlier_run_started_them(
    names: list[str], executors: dict[int, tuple[tuple[str, str], ...]]
) -> None:
    found = allocate([_process(700, X, *names)], [EARLIER_GROUPS])
    shown = {t.thread.tid: t.callbacks for t in found.threads if t.thread.role == "executor"}
    assert shown == executors
    sure = len(executors) > 1
    assert [note.endswith(IN_ORDER) for note in found.notes] == [True] * sure
    ticks = _plan(_server("ticks", PlannedThread(node="/x", callbacks=("every 10ms",))))
    if sure:
        (member,) = server_members(ticks, found)["ticks"]
        assert (member.thread.tid, member.known_by) == (703, "order of start")
        everything = _plan(_server("all", PlannedThread(node="/x")))
        assert len(server_members(everything, found)["all"]) == 2
        other = _plan(_server("other", PlannedThread(node="/x", callbacks=("/t2",))))
        with pytest.raises(OperationError, match=r"runs /t2 is not known \(known are .*/t1, every"):
            server_members(other, found)
    else:
        with pytest.raises(OperationError, match="no thread that is known to be its executor"):
            server_members(ticks, found)


LOOPING = RecordedProcess(
    100,
    ("/x",),
    (
        RecordedThread(100, "executor", ("/x",), "main"),
        RecordedThread(101, "dds", ("/x",), "recv"),
        RecordedThread(102, "loop", ("/x",), "main"),  # it has the name of the program, too
    ),
    seen_ns=0,
)


@pytest.mark.parametrize(
    ("names", "roles"),
    [
        (["recv", "main"], ["executor", "dds", "loop"]),
        (["gc", "main", "recv"], ["executor", "dds", "loop", "dds"]),
        (["recv"], ["executor", "dds"]),  # the loop has not begun
    ],
)
def test_the_thread_of_a_loop_is_known_by_an_earlier_run(
    names: list[str], roles: list[str]
) -> None:
    """It is a thread of its node, also where the main thread alone executes callbacks."""
    found = allocate([_process(700, X, *names)], [LOOPING])
    assert [listed.thread.role for listed in found.threads] == roles
    assert all(listed.nodes == ("/x",) for listed in found.threads if listed.thread.role == "loop")


RUN = _process(50, f"ros2 run p {X}", participates=False)
NODE = _process(100, X, "recv", parent=50)
SUDO = _process(50, f"sudo {X}", participates=False)
TASKSET = _process(60, f"taskset {X}", participates=False, parent=50)
INNERMOST = _process(70, X, participates=False, parent=60)


@pytest.mark.parametrize(
    ("processes", "nodes"),
    [
        ([RUN, NODE], {100}),  # the child takes part in DDS
        ([SUDO, TASKSET, INNERMOST], {70}),  # none takes part yet
        ([_process(100, X), _process(200, X)], {100, 200}),
    ],
)
def test_which_of_several_processes_is_the_node(
    processes: list[RunningProcess], nodes: set[int]
) -> None:
    found = allocate(processes)
    assert {t.thread.pid for t in found.threads if "/x" in t.nodes} == nodes
    ambiguous = ["node /x is ambiguous: processes 100, 200" in note for note in found.notes]
    assert ambiguous == [True] * (len(nodes) > 1)
    # Who runs whom counts also outside the processes that are asked for.
    assert bool(allocate(processes[:1], among=processes).threads[0].nodes) == (len(nodes) > 1)


def test_threads_that_appear_and_end_are_found_also_where_an_id_is_used_again() -> None:
    before = allocate([_process(100, "talker", "recv", "worker")])
    assert new_and_ended(before, before) == ((), ())
    main, recv, _ = before.threads
    reborn = replace(recv, thread=replace(recv.thread, started=99))
    new, ended = new_and_ended(before, Allocation((main, reborn), ()))
    assert ([t.thread.tid for t in new], [t.thread.tid for t in ended]) == ([101], [101, 102])


@pytest.mark.parametrize("started_later", [False, True])
def test_a_process_started_after_the_recording_is_not_in_it(
    tmp_path: Path, started_later: bool
) -> None:
    early = time.monotonic_ns()
    time.sleep(0.05)  # more than the tick in which the kernel tells a start
    with acting(tmp_path, "recv", "worker") as actor:
        process = known(read_process(actor.pid))
        seen_ns = early if started_later else time.monotonic_ns()
        threads = (RecordedThread(process.threads[1].inner_tid, "executor", ("/a",)),)
        recorded = RecordedProcess(process.inner_pid, ("/a",), threads, seen_ns)
        found = allocate([process], [recorded])
    assert (found.threads[0].nodes == ("/a",)) is not started_later


def _plan(*servers: Server) -> Plan:
    """A plan with these servers and nothing to publish."""
    plan = plan_shaping(np.array([5 * MS, 20 * MS]), 100 * MS)
    return Plan.of(revised(plan, servers=servers))


def _server(
    name: str, *threads: PlannedThread, core: int = 1, priority: int = 2, start: int = 0
) -> Server:
    slots = ((start * MS, (start + 1) * MS),)
    return Server(name=name, core=core, priority=priority, slots=slots, threads=threads)


def _node(
    name: str, pid: int, *roles: ThreadRole, cores: tuple[int, ...] = (0, 1)
) -> list[NodeThread]:
    threads = [
        RunningThread(pid + index, pid, role, role, "SCHED_OTHER", 0, cores, 1)
        for index, role in enumerate(roles)
    ]
    return [NodeThread(thread, (name,), "name", "command line") for thread in threads]


def _allocation(*nodes: list[NodeThread]) -> Allocation:
    return Allocation(tuple(thread for node in nodes for thread in node), ())


def _by_tid(wanted: tuple[WantedScheduling, ...]) -> dict[int, SchedulingRequest]:
    return {one.node_thread.thread.tid: one.scheduling for one in wanted}


def _text(wanted: tuple[WantedScheduling, ...]) -> str:
    """What threads get: ``TID:PRIORITY@CORES``, with ``-`` and ``*`` for what stays as it is."""
    found = []
    for tid, one in sorted(_by_tid(wanted).items()):
        priority = "-" if one.priority is None else one.priority
        found.append(f"{tid}:{priority}@{'+'.join(map(str, one.cores or '*'))}")
    return " ".join(found)


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
    wanted = _text(plan_scheduling(plan, allocation, (0, 1)))
    assert wanted == "100:85@1 101:90@0 200:87@1 201:90@0", "all others are left alone"


ZENOH = ("app-0", "net-0", "acc-0", "tx-0", "rx-0", "rx-1")


def test_on_zenoh_its_router_delivers_too(tmp_path: Path) -> None:
    """Real processes with threads of those names; of Cyclone DDS's nodes it is no part."""
    plan = _plan(_server("chain", EXECUTOR_A))
    router = tmp_path / "rmw_zenohd"
    for names in (ZENOH, CYCLONE):
        arguments = ("--ros-args", "-r", "__node:=a")
        with acting(tmp_path, *names, arguments=arguments) as node, acting(tmp_path, *ZENOH) as box:
            daemon = replace(known(read_process(box.pid)), command=(str(router),))
            found = allocate([known(read_process(node.pid)), daemon])
        wanted = _by_tid(plan_scheduling(plan, found, (0, 1)))
        comms = {one.thread.tid: one.thread.comm for one in found.threads}
        of_router = {one.tid for one in daemon.threads} & wanted.keys()
        assert {comms[tid] for tid in of_router} == (set(ZENOH) if names == ZENOH else set())
        receiving = {
            comms[tid] for tid, one in wanted.items() if one == SchedulingRequest(91, (0,))
        }
        assert receiving == ({"rx-0", "rx-1"} if names == ZENOH else {"recv"})
        assert not found.notes


def test_the_cycle_begins_with_the_first_node() -> None:
    """Not with one on a core of a lower number, nor with a shaping node, though it is due first."""
    named = {"output": "/out", "publisher": "/b", "nodes": ("/a", "/b")}
    plan = plan_shaping(np.array([5 * MS, 20 * MS]), 100 * MS, **named)  # type: ignore[arg-type]
    plan = over_cores(plan, {"/a": 1, "/b": 0})
    nodes = enumerate(("/b", "/chainshaper_out", "/a"))
    found = _allocation(*(_node(name, pid, "executor") for pid, name in nodes))
    for one in (plan, let_per_chain(plan)):
        assert [[thread.pid for thread in own] for own in first_threads(Plan.of(one), found)] == [
            [2]
        ]


def test_servers_that_are_scheduling_classes_get_ordinary_threads() -> None:
    plan = _plan(_server("chain", EXECUTOR_A, EXECUTOR_B))
    (real_time,) = _node("/a", 100, "executor")
    real_time = replace(
        real_time, thread=replace(real_time.thread, policy="SCHED_FIFO", priority=80)
    )
    allocation = _allocation([real_time], _node("/b", 200, "executor", "dds"))
    wanted = plan_scheduling(plan, allocation, (0, 1))
    # Real-time threads run above every server of sched_ext's.
    assert _text(left_by_back_end("scx", wanted)) == "100:0@1 200:-@1 201:90@0"
    assert _text(left_by_back_end("litmus", wanted)) == "100:-@1 200:-@1 201:90@0"
    assert left_by_back_end("freezer", wanted) == wanted
    assert SchedulingRequest(0, None).policy == os.SCHED_OTHER


NUMBERS = {"core": 1, "fifo_priority": 84, "spin_ns": 0, "pause_ns": 0}
GATE = ShapingNode.model_validate({"name": "gate", "input": "/i", "output": "/out", **NUMBERS})
SINK_LOOP = PlannedLoop(  # it reads the gate's output
    node="/sink",
    thread="control_loop",
    topic="/out",
    period_ns=10 * MS,
    samples=1,
    delivery_ns=(0, 0, 0),
    lead_ns=0,
    age=LoopAge(first_ns=(0, 0), every_ns=(0, 0), constant=True, uses=(1, 1)),
)


def test_who_receives_the_output_stands_below_all_servers_on_the_gates_core() -> None:
    node = GATE.model_copy(update={"receivers": ("/sink", "/a", "/absent")})
    chain = _server("chain", EXECUTOR_A, priority=2)
    bare = _plan(chain, _server("output", node.thread, priority=1, start=1)).chains[0]
    plan = Plan.of(revised(bare, shaping_node=node))
    gate, sink = _node("/gate", 100, "executor"), _node("/sink", 300, "executor", "dds", "unknown")
    receiving = replace(sink[1], thread=replace(sink[1].thread, kind="receive"))
    allocation = _allocation(gate, _node("/a", 200, "executor"), [sink[0], receiving, sink[2]])
    wanted = plan_scheduling(plan, allocation, (0, 1))
    # 200 is in the chain, and so not below it; 301 is waited for, so above other DDS threads.
    assert _text(wanted) == "100:87@1 200:85@1 300:83@1 301:91@0"
    more_cores = _by_tid(plan_scheduling(plan, allocation, (0, 1, 2, 3)))
    assert more_cores[301] == SchedulingRequest(91, (0,)), "the core that is kept clear for them"
    assert 300 not in _by_tid(left_by_back_end("scx", wanted)), "it would outrank the servers"
    (gate_thread,) = (one.scheduling for one in wanted if one.node_thread.thread.tid == 100)
    free = _by_tid(left_by_back_end("scx", wanted, plan.free_threads))
    assert (free[100], free[200].priority) == (gate_thread, None), "no back end keeps it"
    assert more_cores[300] == SchedulingRequest(83, (1,)), (
        "it rests while one chain's output is received"
    )
    for own_cores, stays in (((0,), True), ((0, 1), False)):
        by_hand = replace(sink[0], thread=replace(sink[0].thread, priority=30, cores=own_cores))
        placed = _allocation(gate, _node("/a", 200, "executor"), [by_hand, receiving])
        scheduled = _by_tid(plan_scheduling(plan, placed, (0, 1)))
        assert scheduled.get(300) == (None if stays else SchedulingRequest(83, (1,)))
        assert scheduled[301] == SchedulingRequest(91, (0,))
    other = _server("other", PlannedThread(node="/b"), core=2, priority=2)
    several = Plan(chains=(plan.chains[0], _plan(other).chains[0]))
    both = _allocation(gate, _node("/a", 200, "executor"), _node("/b", 400, "executor"), sink)
    for cores, core, notes in (((0, 1, 2), 0, 0), ((1, 2), 1, 1)):
        found = plan_scheduling(several, both, cores)
        assert _by_tid(found)[300] == SchedulingRequest(83, (core,))
        assert len(waiting_receivers(several, found)) == notes
        assert not waiting_receivers(several, left_by_back_end("scx", found))
    alone = Plan.of(revised(bare, shaping_node=GATE))
    assert set(_by_tid(plan_scheduling(alone, allocation, (0, 1)))) == {100, 200}


def test_receivers_of_one_process_take_turns_and_stand_below_its_loop() -> None:
    """As the executors of a ros2_control node, whose loop has priority 50 by itself."""
    node = GATE.model_copy(update={"receivers": ("/sink",)})
    chain = _server("chain", EXECUTOR_A, priority=2)
    bare = _plan(chain, _server("output", node.thread, priority=1, start=1)).chains[0]
    loop = SINK_LOOP.model_copy(update={"realtime_priority": 50})
    nodes = _node("/gate", 100, "executor"), _node("/a", 200, "executor")
    sink = _node("/sink", 300, "executor", "executor")
    for read_by, priority in ((None, 83), (loop, 49)):
        plan = Plan.of(revised(bare, shaping_node=node, loop=read_by))
        wanted = _by_tid(plan_scheduling(plan, _allocation(*nodes, sink), (0, 1)))
        assert wanted[300] == wanted[301] == SchedulingRequest(priority, (1,), takes_turns=True)
        assert wanted[300].policy == os.SCHED_RR
        alone = _by_tid(plan_scheduling(plan, _allocation(*nodes, sink[:1]), (0, 1)))
        assert alone[300] == SchedulingRequest(priority, (1,)), "nothing else has its place"


def test_threads_of_a_multi_threaded_executor_in_a_server_take_turns() -> None:
    """Four of rclcpp's with a callback that sleeps longer than its timer's period, at one priority
    on one core: 19 instances, then none, under SCHED_FIFO; 286 in 4 s under SCHED_RR; else 732.
    """
    plan = _plan(_server("chain", EXECUTOR_A, PlannedThread(node="/b"), priority=2))
    both = _node("/a", 200, "executor", "executor"), _node("/b", 300, "executor")
    wanted = _by_tid(plan_scheduling(plan, _allocation(*both), (0, 1)))
    assert wanted[200] == wanted[201]
    assert [wanted[tid].takes_turns for tid in (200, 300)] == [True, False], "/b has one thread"


def test_receivers_with_a_place_stand_above_the_chain_and_behind_its_gates() -> None:
    """87 and 86 for outputs, and 84 for the chain, with room for publishers in between."""
    place = ReceiverPlace(core=1, priority=1, time_ns=MS)
    chain = _server("chain", EXECUTOR_A, priority=2)
    bare = _plan(chain, _server("output", GATE.thread, priority=1, start=1)).chains[0]
    gate, sink = _node("/gate", 100, "executor"), _node("/sink", 300, "executor")
    allocation = _allocation(gate, _node("/a", 200, "executor"), sink)
    for core in (1, 2):
        own = {"receivers": ("/sink",), "receivers_at": place.model_copy(update={"core": core})}
        plan = Plan.of(revised(bare, shaping_node=GATE.model_copy(update=own)))
        wanted = plan_scheduling(plan, allocation, (0, 1, 2))
        assert _text(wanted) == f"100:87@1 200:84@1 300:86@{core}"
        assert 300 in _by_tid(left_by_back_end("scx", wanted)), "above the servers, as planned"
        assert not waiting_receivers(plan, wanted)
    missing = plan_scheduling(plan, allocation, (0, 1))
    assert _by_tid(missing)[300] == SchedulingRequest(86, (1,)), "there is no core 2"


def test_the_thread_of_a_loop_that_reads_the_output_is_raised_unless_it_raised_itself() -> None:
    """It stands where receivers with a place do, on the core that the plan has for it."""
    place = ReceiverPlace(core=2, priority=1, time_ns=MS)
    loop = SINK_LOOP.model_copy(update={"runs_at": place})
    chain = _server("chain", EXECUTOR_A, priority=2)
    bare = _plan(chain, _server("output", GATE.thread, priority=1, start=1)).chains[0]
    gate, first = _node("/gate", 100, "executor"), _node("/a", 200, "executor")
    main, other = _node("/sink", 300, "executor", "unknown")
    for named, priority, seen in (
        ("control_loop", 0, "301:86@2"),
        ("control_loop", 86, "301:86@2"),  # as we have raised it
        ("control_loop", 50, ""),  # it has raised itself
        ("helper", 0, ""),
    ):
        thread = replace(other.thread, comm=named, priority=priority)
        allocation = _allocation(gate, first, [main, replace(other, thread=thread)])
        plan = Plan.of(revised(bare, shaping_node=GATE, loop=loop))
        wanted = _text(plan_scheduling(plan, allocation, (0, 1, 2)))
        assert wanted.strip() == f"100:87@1 200:84@1 {seen}".strip()
    by_itself = Plan.of(
        revised(bare, shaping_node=GATE, loop=loop.model_copy(update={"runs_at": None}))
    )
    allocation = _allocation(gate, first, [main, replace(other, thread=thread)])
    assert 301 not in _by_tid(plan_scheduling(by_itself, allocation, (0, 1, 2)))


def test_a_gate_inside_the_chain_stands_behind_that_of_its_output() -> None:
    """LET per callback: 87 and 86 for gates, 85 for who receives the output, 83 for the chain."""
    place = ReceiverPlace(core=1, priority=1, time_ns=MS)
    output = GATE.model_copy(update={"receivers": ("/sink",), "receivers_at": place})
    inner = GATE.model_copy(update={"name": "inner", "input": "/j", "output": "/inside"})
    servers = (
        _server("chain", EXECUTOR_A, priority=2),
        _server("output", output.thread, priority=1, start=1),
        _server("inside", inner.thread, priority=1, start=2),
    )
    nodes = {"shaping_node": output, "further_shaping_nodes": (inner,)}
    bare = _plan(*servers).chains[0]
    allocation = _allocation(
        _node("/gate", 100, "executor"),
        _node("/inner", 150, "executor"),
        _node("/a", 200, "executor"),
        _node("/sink", 300, "executor"),
    )
    plan = Plan.of(revised(bare, policy="let-per-callback", **nodes))
    wanted = _text(plan_scheduling(plan, allocation, (0, 1)))
    assert wanted == "100:87@1 150:86@1 200:83@1 300:85@1"
    sinks = Plan.of(revised(bare, **nodes))
    wanted = _text(plan_scheduling(sinks, allocation, (0, 1)))
    assert wanted == "100:87@1 150:87@1 200:84@1 300:86@1", "both are outputs"


def test_a_gate_in_a_container_is_known_by_its_threads_name() -> None:
    """Of a component, as of a library before rmw: the container's other threads stay its nodes'."""
    main, other = _node("/a", 100, "executor", "unknown")
    named = replace(other, thread=replace(other.thread, comm=gate_thread_name("gate")))
    found = with_gates(Allocation((main, named), ()), [GATE]).threads
    assert [(one.thread.tid, one.thread.role, one.nodes) for one in found] == [
        (100, "executor", ("/a",)),
        (101, "executor", ("/gate",)),
    ]


def test_best_effort_runs_under_the_fair_class_and_equal_servers_take_turns() -> None:
    last = _server("last", PlannedThread(node="/noise"), priority=3)
    apart = _plan(
        _server("chain", EXECUTOR_A, priority=1),
        _server("other", EXECUTOR_B, priority=1, start=1),
        last.model_copy(update={"best_effort": True}),
    )
    turns = Plan.of(revised(apart.chains[0], equal_priorities="round-robin"))
    nodes = [_node(name, tid, "executor") for name, tid in (("/a", 1), ("/b", 2), ("/noise", 3))]
    for plan, turn in ((apart, False), (turns, True)):
        real_time = SchedulingRequest(87, (1,), turn)
        wanted = _by_tid(plan_scheduling(plan, _allocation(*nodes), (0, 1)))
        assert wanted == {1: real_time, 2: real_time, 3: SchedulingRequest(0, (1,))}


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
    # 201 has not 87, as its server would; 203 would be outranked on core 1; and 300 stays below.
    wanted = "100:85@1 200:84@1 201:83@1 202:90@0 203:-@0 300:82@1"
    assert _text(plan_scheduling(plan, allocation, (0, 1))) == wanted


def test_what_fast_dds_sends_late_is_sent_by_a_thread_that_lets_others_run() -> None:
    """Above its siblings on a core, it would spin for ever for a lock that they want to release."""
    plan = _plan(_server("chain", EXECUTOR_A, EXECUTOR_B))
    resending = _node("/b", 200, "executor", "dds", "dds")
    resending[1] = replace(resending[1], thread=replace(resending[1].thread, kind="resend"))
    allocation = _allocation(_node("/a", 100, "executor"), resending)
    wanted = _text(plan_scheduling(plan, allocation, (0, 1)))
    assert wanted == "100:87@1 200:86@1 201:0@0 202:90@0"


def test_threads_of_a_server_stand_in_the_plans_order_those_of_a_node_together() -> None:
    plan = _plan(_server("chain", EXECUTOR_A, EXECUTOR_B, PlannedThread(node="/c")))
    allocation = _allocation(
        _node("/c", 300, "executor"),
        _node("/b", 200, "executor"),
        _node("/a", 100, "executor", "executor"),
    )
    wanted = _text(plan_scheduling(plan, allocation, (0, 1)))
    assert wanted == "100:87@1 101:87@1 200:86@1 300:85@1"


def test_a_publisher_on_a_core_of_its_own_has_its_servers_priority() -> None:
    output = _server("output", PUBLISHER_B, priority=1, core=2)
    plan = _plan(_server("chain", EXECUTOR_B, priority=2, core=1), output)
    allocation = _allocation(_node("/b", 200, "executor", "publisher"))
    assert _by_tid(plan_scheduling(plan, allocation, (0, 1, 2)))[201] == SchedulingRequest(87, (2,))


def test_without_a_free_core_dds_threads_stay_where_they_are_but_above() -> None:
    plan = _plan(_server("x", EXECUTOR_A, core=0), _server("y", EXECUTOR_B, core=1))
    allocation = _allocation(_node("/a", 100, "executor", "dds"), _node("/b", 200, "executor"))
    assert _by_tid(plan_scheduling(plan, allocation, (0, 1)))[101] == SchedulingRequest(90, None)


ALONE = _node("/b", 200, "executor", "publisher", "unknown", cores=(1,))
UNKNOWN = _node("/b", 200, "executor", "unknown")
OTHER = _node("/other", 100, "executor")
TWICE = [*_node("/a", 100, "executor"), *_node("/a", 200, "executor")]


@pytest.mark.parametrize(
    ("planned", "threads", "reason"),
    [
        (PUBLISHER_B, ALONE, r"thread 200 \(executor\).*core 1 only.*taskset"),
        (EXECUTOR_A, OTHER, "/a of the plan is not running.*running: /other"),
        (EXECUTOR_A, [], "no node of the plan runs, nor any other: start the robot first"),
        (PUBLISHER_B, UNKNOWN, "process 200 .* asynchronous publisher.*threads 200"),
        (EXECUTOR_A, TWICE, "/a is ambiguous: processes 100, 200 all have it"),
    ],
)
def test_what_cannot_be_planned_is_named_with_the_remedy(
    planned: PlannedThread, threads: list[NodeThread], reason: str
) -> None:
    with pytest.raises(OperationError, match=reason):
        plan_scheduling(_plan(_server("server", planned)), _allocation(threads), (0, 1))


def test_what_an_executor_that_we_had_raised_starts_leaves_the_publishers_core() -> None:
    *others, late = _node("/b", 200, "executor", "publisher", "unknown")
    late = replace(late, thread=replace(late.thread, cores=(1,), priority=85))
    plan = _plan(_server("server", PUBLISHER_B))
    wanted = _by_tid(plan_scheduling(plan, _allocation([*others, late]), (0, 1)))
    assert wanted[202] == SchedulingRequest(0, (0,)), "it inherited both"


def test_nodes_that_share_an_executor_are_one_thread_of_one_server() -> None:
    shared = [replace(one, nodes=("/a", "/b")) for one in _node("/a", 100, "executor")]
    together = _plan(_server("chain", EXECUTOR_A, EXECUTOR_B))
    assert _text(plan_scheduling(together, _allocation(shared), (0, 1))) == "100:87@1"
    apart = _plan(_server("one", EXECUTOR_A), _server("two", EXECUTOR_B, start=1))
    with pytest.raises(OperationError, match=r"thread 100 .* /a, /b,.* servers one and two"):
        server_members(apart, _allocation(shared))


def test_more_priorities_than_there_are_are_refused() -> None:
    """Between 87 and 2, with one below each server's for a publisher."""
    assert server_priorities({2: 1, 1: 2}) == {1: (87, 86), 2: (84,)}
    assert server_priorities(dict.fromkeys(range(1, 44), 1))[43] == (3,)
    assert server_priorities({1: 1, 2: 200})[2] == tuple(range(85, 2, -1)), "the last share one"
    many = server_priorities(dict.fromkeys(range(20), 3))
    assert {len(own) for own in many.values()} == {3}
    assert {len(own) for own in server_priorities(dict.fromkeys(range(30), 3)).values()} == {1}
    with pytest.raises(InputError, match="44 different server priorities do not fit below 90"):
        server_priorities(dict.fromkeys(range(1, 45), 1))


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
    first = first_planned(plan.chains[0])

    def begins(one: WantedScheduling) -> int:
        return first is not None and first.node in one.node_thread.nodes

    assert len({one.node_thread.thread.tid for one in wanted}) == len(wanted), "one wish per thread"
    for one in wanted:
        priority, role = one.scheduling.priority, one.node_thread.thread.role
        assert (role == "dds") == (priority == DDS_PRIORITY)
        if role == "dds" or priority is None or one.server is None:
            continue
        assert 1 <= priority < 89
        for other in wanted:
            if other.server is None or other.scheduling.priority is None:
                continue
            if ranks[one.server] < ranks[other.server] and role != "publisher":
                assert priority > other.scheduling.priority
            if role == other.node_thread.thread.role == "executor" and one.server == other.server:
                above = begins(one) - begins(other)
                assert priority - other.scheduling.priority == above
    after = {one.node_thread.thread.tid: one.scheduling for one in wanted}
    for one in wanted:
        if one.node_thread.thread.role != "publisher":
            continue
        for sibling in allocation.threads:
            same_process = sibling.thread.pid == one.node_thread.thread.pid
            if not same_process or sibling.thread.role == "publisher":
                continue
            new = after.get(sibling.thread.tid, SchedulingRequest(None, None))
            if set(new.cores or sibling.thread.cores) & set(one.scheduling.cores or ()):
                assert known(one.scheduling.priority) < known(new.priority)


@pytest.mark.parametrize(
    ("mode", "said"),
    [
        ("ASYNCHRONOUS", "/debug, /rosout of /b, /beside will be delayed as well"),
        ("AUTO", "/debug (if asynchronous), /rosout (if asynchronous) of /b, /beside will be"),
        ("SYNCHRONOUS", "/b publishes /out synchronously"),
        ("/out /debug", "/debug of /beside will be delayed as well"),
        ("/debug", "/b publishes /out synchronously"),  # the thread there is sends others' only
    ],
)
def test_how_a_process_publishes_is_looked_up_before_its_publisher_is_gated(
    mode: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if mode.startswith("/"):  # the topics of which a file of profiles makes writers asynchronous
        mode_of = "<qos><publishMode><kind>ASYNCHRONOUS</kind></publishMode></qos>"
        writers = [f'<data_writer profile_name="{t}">{mode_of}</data_writer>' for t in mode.split()]
        (tmp_path / "profiles.xml").write_text(
            f'<dds xmlns="http://www.eprosima.com"><profiles>{"".join(writers)}</profiles></dds>'
        )
        monkeypatch.setenv("RMW_FASTRTPS_USE_QOS_FROM_XML", "1")
        monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(tmp_path / "profiles.xml"))
    monkeypatch.setenv("RMW_FASTRTPS_PUBLICATION_MODE", mode)
    values: dict[str, Any] = {"output": "/out", "publisher": "/b", "publication": "asynchronous"}
    plan = Plan.of(plan_shaping(np.array([5 * MS, 20 * MS]), 100 * MS, **values))
    names = [("/b", "/out"), ("/b", "/rosout"), ("/beside", "/debug"), ("/other", "/rosout")]
    ends = [EndpointInfo(node=n, topic=t, kind="publisher", depth=5) for n, t in names]
    arguments = ("--ros-args", "-r", "b:__node:=b", "-r", "c:__node:=beside")
    with acting(tmp_path, *CYCLONE, "dds.asyn.0.0", arguments=arguments) as actor:

        def checked() -> list[str]:
            info = RecordingInfo(source="lttng", clock_offset_ns=0, endpoints=tuple(ends))
            process = known(read_process(actor.pid))
            found = allocate([process])
            server_members(plan, found)
            return check_publishers(plan, found, [Recording(tmp_path, info, {})])

        # What sends again for synchronous writers is no asynchronous publisher.
        with pytest.raises(OperationError, match="RMW_FASTRTPS_PUBLICATION_MODE is ASYNCHRONOUS"):
            checked()
        actor.begin("dds.asyn.0.1")
        if "synchronously" in said:
            with pytest.raises(InputError, match=said):
                checked()
            return
        (warning,) = checked()
        assert warning.startswith(said)
        ends[0] = ends[0].model_copy(update={"depth": 1})
        plan = Plan.of(revised(plan.chains[0], cycle_ns=300 * MS))
        with pytest.raises(InputError, match="history of 1, but 3 messages"):
            checked()
