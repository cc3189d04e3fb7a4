"""Who does what: by evidence worked out by hand, and by real processes."""

import time
from pathlib import Path

import pytest
from actors import acting

from chainshaper.enforcement.threads import (
    Allocation,
    NodeThread,
    RecordedProcess,
    RecordedThread,
    allocate,
    new_and_ended,
)
from chainshaper.linux.processes import Process, read_process
from chainshaper.linux.threads import Thread, dds_kind, role_of

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
