"""`chainshaper threads`: the threads of processes that really run."""

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from actors import acting
from command_line import Running, called, json_of, refused
from small_chain import DDS_CORE, EXECUTOR_CORE, NODES, PERIOD_NS, small_chain_text
from story import OFFSET, Story

from chainshaper import find_threads
from chainshaper.flow import threads
from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.planning import ChainPlan, Plan, save_plan
from chainshaper.values.recording import RecordingInfo, write_recording

pytestmark = pytest.mark.timed

CYCLONE = ("gc", "dq.builtins", "dq.user", "tev", "recv")


@pytest.fixture(scope="module")
def application(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """The small chain while it runs; its output is published asynchronously."""
    folder = tmp_path_factory.mktemp("application")
    file = folder / "application.yaml"
    file.write_text(small_chain_text(publication="asynchronous"))
    cycles = str(60_000_000_000 // PERIOD_NS)
    running = Running.start("run", file, "-o", folder / "recording", "--cycles", cycles)
    try:
        running.wait_until_it_says("recording")
        yield running
    finally:
        running.process.terminate()
        running.end()


def _of(found: Any, node: str, role: str) -> list[dict[str, Any]]:
    return [t for t in found["threads"] if node in t["nodes"] and t["role"] == role]


def test_the_nodes_of_a_running_application_are_found(application: Running) -> None:
    found = json_of("threads", str(application.process.pid))
    for name in NODES:
        pid = application.nodes()[name]
        (executor,) = _of(found, f"/{name}", "executor")
        assert (executor["pid"], executor["tid"], executor["comm"]) == (pid, pid, name)
        assert executor["known_by"] == "main thread"
        assert executor["nodes_known_by"] == "command line"
        kinds = {thread["dds_kind"] for thread in _of(found, f"/{name}", "dds")}
        assert {"receive", "event", "delivery", "discovery"} <= kinds
    (publisher,) = _of(found, "/third", "publisher")
    assert publisher["known_by"] == "name"
    assert all(not _of(found, f"/{name}", "publisher") for name in NODES if name != "third")
    launcher = [t for t in found["threads"] if t["pid"] == application.process.pid]
    assert {thread["role"] for thread in launcher} == {"unknown"}

    if may_use_fifo():
        (executor,) = _of(found, "/first", "executor")
        assert (executor["policy"], executor["priority"]) == ("SCHED_FIFO", 80)
        assert executor["cores"] == [EXECUTOR_CORE]
        for thread in _of(found, "/first", "dds"):
            assert (thread["policy"], thread["priority"]) == ("SCHED_FIFO", 90)
            assert thread["cores"] == [DDS_CORE]
    everything = json_of("threads")["threads"]  # all that looks like DDS
    assert {f"/{name}" for name in NODES} <= {node for one in everything for node in one["nodes"]}


def test_a_plan_shows_the_nodes_of_its_servers(
    application: Running, plan: ChainPlan, tmp_path: Path
) -> None:
    save_plan(Plan.of(plan), tmp_path / "plan.yaml")
    found = json_of("threads", tmp_path / "plan.yaml")
    shown = {node for thread in found["threads"] for node in thread["nodes"]}
    assert shown == {"/first", "/second", "/third"}
    assert plan.shaping_node is not None
    (missing,) = found["notes"]
    assert f"node /{plan.shaping_node.name} of server output is not running" in missing
    finished = called("threads", str(application.process.pid))
    assert finished.code == 0
    (line,) = [line for line in finished.out.splitlines() if "dds.asyn" in line]
    assert "publisher" in line
    assert "DDS receive" in finished.out
    with acting(tmp_path, *CYCLONE, program="talker.py") as actor:
        finished = called("threads", str(actor.pid))
    assert "/talker" in finished.out
    assert f"note: process {actor.pid} is called /talker after its program" in finished.err


def test_a_recording_tells_nodes_and_executors(tmp_path: Path) -> None:
    """A container with an executor of several threads, whose names say nothing."""
    with acting(tmp_path, *CYCLONE, "w1", "w2", "w3", program="container") as actor:
        story, now = Story(), time.monotonic_ns()
        left = story.node("/front/left", actor.pid, now)
        right = story.node("/right", actor.pid, now)
        for node, tids in ((left, ("w1", "w2")), (right, ("w2",))):
            timer = story.timer(node, time=now)
            for tid in tids:
                story.start(timer, now + 1, actor.tids[tid])
                story.end(timer, now + 2, actor.tids[tid])
        info = RecordingInfo(source="lttng", clock_offset_ns=OFFSET)
        recording = write_recording(tmp_path / "recording", story.tables(), info)
        found = json_of("threads", str(actor.pid), "--recording", recording.path)
        assert {t["comm"]: t["nodes"] for t in found["threads"] if t["role"] == "executor"} == {
            "w1": ["/front/left"],
            "w2": ["/front/left", "/right"],
        }
        roles = {t["tid"]: t["role"] for t in found["threads"]}
        assert roles[actor.pid] == roles[actor.tids["w3"]] == "unknown"
        assert {t["nodes_known_by"] for t in found["threads"]} == {"recording"}
    with acting(tmp_path, *CYCLONE) as stranger:
        found = json_of("threads", str(stranger.pid), "--recording", recording.path)
        assert "none of these processes is in the recording" in " ".join(found["notes"])


@pytest.mark.parametrize(
    ("host", "time_ns", "message"),
    [
        ("elsewhere", 1, "was taken on elsewhere"),
        (os.uname().nodename, 2**61, "is from before this machine booted"),
    ],
)
def test_a_recording_of_another_machine_or_boot_says_nothing(
    host: str, time_ns: int, message: str, tmp_path: Path
) -> None:
    story = Story()
    story.node("/a", os.getpid(), time_ns)
    info = RecordingInfo(source="lttng", clock_offset_ns=OFFSET, host=host)
    recording = write_recording(tmp_path / "recording", story.tables(), info)
    found = find_threads(os.getpid(), recording)
    assert any(message in note for note in found.notes)
    assert all("/a" not in thread.nodes for thread in found.threads)


def test_nothing_found_is_said_and_what_is_no_process_and_no_plan_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "no process 4194305: it has ended" in refused(2, "threads", "4194305")
    assert "plan.yaml: cannot be read" in refused(2, "threads", tmp_path / "plan.yaml")
    assert "REC" not in refused(2, "threads", "1", "--recording", tmp_path / "nothing")
    monkeypatch.setattr(threads, "list_processes", tuple)
    finished = called("threads")
    assert finished.code == 0
    assert "note: no process looks like an application of ROS 2 or DDS" in finished.err
