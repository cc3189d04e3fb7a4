"""The paper's profiling condition on real processes that are named like nodes."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from command_line import called, json_of, refused
from lttng_node import LTTNG, chain_command, required_node
from processes import wait_for

from chainshaper import InputError, OperationError, PlanRequest, open_recording
from chainshaper.enforcement.node_threads import RecordedProcess, RecordedThread, allocate
from chainshaper.flow import profiling_condition as condition_module
from chainshaper.flow.profiling_condition import (
    chain_nodes,
    executors_of,
    profiled_cores,
    profiling_condition,
)
from chainshaper.linux.processes import list_processes
from chainshaper.linux.scheduling import SchedulingState, available_cores, may_use_fifo, state_of
from chainshaper.linux.threads import RunningThread, list_threads

pytestmark = [
    pytest.mark.timed,
    pytest.mark.skipif(not may_use_fifo(), reason="SCHED_FIFO is not permitted here"),
]


@pytest.fixture(scope="module")
def node() -> Path:
    return required_node()


@pytest.fixture(scope="module")
def nodes(node: Path) -> Iterator[dict[str, int]]:
    """Two nodes that run, with threads named as Cyclone DDS names its own."""
    started = {
        name: subprocess.Popen(
            [node, "flood", "1000000", "10000", "--ros-args", "-r", f"__node:={name}"]
        )
        for name in ("front", "rear")
    }
    pids = {f"/{name}": process.pid for name, process in started.items()}
    try:
        for pid in pids.values():
            wait_for(lambda pid=pid: len(_dds(pid)) == 2, "the node's threads")  # type: ignore[misc]
        yield pids
    finally:
        for process in started.values():
            process.kill()
            process.wait()


def _dds(pid: int) -> list[RunningThread]:
    return [thread for thread in list_threads(pid) if thread.role == "dds"]


def _states(nodes: dict[str, int]) -> dict[int, SchedulingState]:
    return {t.tid: state_of(t.tid) for pid in nodes.values() for t in list_threads(pid)}


def test_the_chains_threads_are_high_and_apart_and_afterwards_as_before(
    nodes: dict[str, int], tmp_path: Path
) -> None:
    core = available_cores()[-1]
    others = [one for one in available_cores() if one != core]
    before = _states(nodes)
    with profiling_condition(["/front"], folder=tmp_path) as see_to_it:
        assert not see_to_it(list_processes(nodes.values()))  # it was not yet
        assert see_to_it(list_processes(nodes.values()))
        executor = list_threads(nodes["/front"])[0]
        assert (executor.policy, executor.priority) == ("SCHED_FIFO", 87)
        assert executor.cores == (core,)
        for thread in _dds(nodes["/front"]):
            assert thread.priority == (91 if thread.kind == "receive" else 90)
            assert thread.policy == "SCHED_FIFO"
            assert list(thread.cores) == (others or [core])
        rear = {t.tid: state_of(t.tid) for t in list_threads(nodes["/rear"])}
        assert rear == {tid: before[tid] for tid in rear}
        (run,) = tmp_path.iterdir()
        assert (run / "journal.jsonl").is_file()
    assert _states(nodes) == before
    assert list(tmp_path.iterdir()) == []


def test_cores_ranks_and_best_effort_are_those_that_are_named(
    nodes: dict[str, int], tmp_path: Path
) -> None:
    last, (front, rear) = available_cores()[-1], nodes
    before = _states(nodes)

    def executors(names: Any, cores: Any, **how: Any) -> list[RunningThread]:
        with profiling_condition(names, cores, tmp_path, **how) as see_to_it:
            see_to_it(list_processes(nodes.values()))
            found = [list_threads(pid)[0] for pid in nodes.values()]
        assert _states(nodes) == before
        return found

    own = dict(zip(nodes, available_cores(), strict=False))
    apart = executors(own, own)[: len(own)]
    assert [(one.priority, one.cores) for one in apart] == [(87, (core,)) for core in own.values()]
    same = {front: last, rear: last}  # earlier stages of a pipeline on a core are more urgent
    first, second = executors(same, same, before={front: 0, rear: 1})
    assert first.priority > second.priority
    assert first.cores == second.cores == (last,)
    first, second = executors([front], last, best_effort={rear: last})
    assert (first.policy, first.cores) == ("SCHED_FIFO", (last,))
    assert (second.policy, second.cores) == ("SCHED_OTHER", (last,))


def test_all_is_as_before_when_the_run_fails(nodes: dict[str, int], tmp_path: Path) -> None:
    before = _states(nodes)
    with pytest.raises(ZeroDivisionError), profiling_condition(folder=tmp_path) as see_to_it:
        see_to_it(list_processes(nodes.values()))
        assert _states(nodes) != before
        raise ZeroDivisionError
    assert _states(nodes) == before


def test_what_starts_the_nodes_is_not_profiled_with_them(node: Path, tmp_path: Path) -> None:
    """Without names all nodes are meant; `ros2 launch`, which is a node too, is not."""
    command = f"{node} flood 1000000 10000 --ros-args -r __node:=one; true"
    launcher = subprocess.Popen(["sh", "-c", command])
    try:
        wait_for(lambda: len(_family(launcher.pid)) == 2, "the node")
        child = next(pid for pid in _family(launcher.pid) if pid != launcher.pid)
        wait_for(lambda: len(_dds(child)) == 2, "its threads")
        with profiling_condition(folder=tmp_path) as see_to_it:
            see_to_it(list_processes(_family(launcher.pid)))
            assert list_threads(child)[0].policy == "SCHED_FIFO"
            assert list_threads(launcher.pid)[0].policy == "SCHED_OTHER"
    finally:
        for pid in _family(launcher.pid):
            os.kill(pid, 9)
        launcher.wait()


def _family(pid: int) -> list[int]:
    children = Path(f"/proc/{pid}/task/{pid}/children")
    return [pid, *map(int, children.read_text().split())]


def test_a_node_that_does_not_appear_is_named(
    nodes: dict[str, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(condition_module, "START_NS", 0)
    with (
        pytest.raises(OperationError, match=r"node /lost has not .* running: /front, /rear"),
        profiling_condition(["/front", "/lost"], folder=tmp_path) as see_to_it,
    ):
        time.sleep(0.001)
        see_to_it(list_processes(nodes.values()))
    # One that was there and is gone ends nothing: what was recorded is of use.
    with profiling_condition(["/front"], folder=tmp_path) as see_to_it:
        running = list_processes(nodes.values())
        assert [see_to_it(running), see_to_it(running), see_to_it(())] == [False, True, False]


def test_an_executor_that_had_several_threads_has_them_again() -> None:
    program = "import threading; threading.Thread(target=input, daemon=True).start(); input()"
    command = [sys.executable, "-c", program, "--ros-args", "-r", "__node:=box"]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
        wait_for(lambda: len(list_threads(process.pid)) == 2, "the threads")
        running = list_processes([process.pid])
        comm = running[0].threads[0].comm
        threads = [RecordedThread(number, "executor", ("/part",), comm) for number in (1, 2)]
        for count in (1, 2):
            earlier = [RecordedProcess(1, ("/box", "/part"), (*threads[:count],), seen_ns=0)]
            found = allocate(running, earlier)
            for nodes in (frozenset(["/part"]), frozenset[str]()):
                assert len(executors_of(found, nodes, running)) == count
        assert executors_of(found, frozenset(["/other"]), running) == []
        process.communicate(b"\n\n")


def test_profile_records_the_chain_under_its_condition(node: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    command = chain_command(node, 100_000)
    run = called("record", "--json", *LTTNG, "-o", first, "--duration", "1s", "--", *command)
    assert json.loads(run.out)["exit_code"] is None  # it was ended
    # The application was there to be asked; who answers is no ROS 2.
    notes = open_recording(first).info.notes
    assert any("types and QoS of topics could not be asked for" in note for note in notes)
    assert chain_nodes(open_recording(first), "/x../y") == ("/source", "/relay")
    _, cores = profiled_cores(open_recording(first), ["/x../y"], PlanRequest())
    assert cores == {"/source": available_cores()[-1], "/relay": available_cores()[-1]}
    with pytest.raises(InputError, match="/nowhere"):
        chain_nodes(open_recording(first), "/x../nowhere")
    chain: tuple[str | Path, ...] = ("--chain", "/x../y", "--like", first)
    unknown = "--best-effort /source2: no node of the recording, name /source"
    beside = ("--best-effort", "source2")
    assert unknown in refused(2, "profile", "-o", second, *chain, *beside, "--", *command)
    arguments = ("-o", second, *chain, "--duration", "2s", "--", *command)
    assert called("profile", *LTTNG, *arguments).code == 0
    recording = open_recording(second)
    executors = [thread for thread in recording.info.threads if thread.role == "executor"]
    assert {thread.policy for thread in executors} == {"SCHED_FIFO"}
    assert {thread.cores for thread in executors} == {(available_cores()[-1],)}
    assert recording.info.realtime is True
    # Objects are from before the priorities were in force, what happened is from after that.
    created = recording.events["rcl_node_init"]["time"]
    happened = recording.events["callback_start"]["time"]
    assert int(happened.min()) - int(created.max()) > 400_000_000  # type: ignore[arg-type]
    # The two seconds are those in which they were: what came before does not count.
    assert int(happened.max()) - int(happened.min()) > 1_700_000_000  # type: ignore[arg-type]
    assert any("were left out: the scheduling was not in force" in n for n in recording.info.notes)
    assert json_of("latency", second)["count"] > 0  # it names its chain itself


def test_profile_says_what_it_needs(tmp_path: Path) -> None:
    path, command = tmp_path / "rec", ("--", "sleep", "1")
    for options, reason in {
        ("--cores", "0,4000"): "core 4000, which the chain asks for, is not available",
        ("--cores", "0,0"): "names a core twice",
        ("--cores", "0,1", "--core", "1"): "give one of them",
        ("--cores", ",".join(map(str, available_cores()))): "add --chain and --like",
        ("--best-effort", "/beside"): "--best-effort is beside a chain",
    }.items():
        assert reason in refused(
            3 if "4000" in reason else 2, "profile", "-o", path, *options, *command
        )
    assert "no such folder" in refused(
        2, "profile", "-o", path, "--chain", "/a../b", "--like", tmp_path / "no", *command
    )
    assert list(tmp_path.iterdir()) == []
