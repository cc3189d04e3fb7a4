"""Nodes in containers: two of them call themselves alike, and stay apart in a recording."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import pytest
from command_line import called, json_of
from containers import contained, in_container, needs_namespaces
from known import known
from traced_program import built, skip_without_bpftrace

import chainshaper as cs
from chainshaper.flow.recorded_processes import recorded_processes
from chainshaper.linux.processes import RunningProcess, user_of
from chainshaper.sources.preload import installed_library
from chainshaper.sources.system import NEXT_HOST

pytestmark = [needs_namespaces, pytest.mark.waiting]

ROUNDS = "100000"  # of the program: it runs until its container is left, however slow all else is


def _running(
    stack: ExitStack,
    command: Sequence[str],
    environment: Mapping[str, str] | None = None,
    *,
    user: bool = False,
    overlaid: Path | None = None,
) -> RunningProcess:
    """The program in a container, once its objects are there."""
    container = contained(command, environment, user=user, overlaid=overlaid)
    started, process = stack.enter_context(container)
    assert known(started.stdout).readline() == "ready\n"
    known(started.stdin).write("\n")
    known(started.stdin).flush()
    return process


def _recorded(output: Path, source: str, processes: Sequence[RunningProcess]) -> set[int]:
    """Record processes for a second; their ids."""
    words = [word for process in processes for word in ("--pid", str(process.pid))]
    made = called("record", "--source", source, "-o", output, "--duration", "600ms", *words)
    assert made.code == 0, made.err
    return {process.pid for process in processes}


def _assert_apart(recording: Path, pids: set[int]) -> None:
    """Both have the numbers that they have here."""
    tables = cs.open_recording(recording).events
    started = tables["callback_start"]
    assert set(started["pid"]) == pids
    assert set(started["tid"]) == pids, "their main threads"
    for pid in pids:
        rows = [row for row in json_of("callbacks", recording, "--json") if row["pid"] == pid]
        assert [row["tids"] for row in rows] == [[pid], [pid]]


def test_two_containers_are_recorded_by_the_library_in_front(tmp_path: Path) -> None:
    """In one of them root is another user than here."""
    environment = {"LD_PRELOAD": str(installed_library())}
    command = built().command("chain", ROUNDS, "--ros-args")
    with ExitStack() as both:
        inside = [_running(both, command, environment, user=user) for user in (False, True)]
        assert [process.inner_pid for process in inside] == [1, 1]
        assert {user_of(process.pid) for process in inside} == {0}
        pids = _recorded(tmp_path / "rec", "preload", inside)
        _assert_apart(tmp_path / "rec", pids)
        recording = cs.open_recording(tmp_path / "rec")
        recorded, _ = recorded_processes(recording)
        assert {process.pid for process in recorded if process.numbered_here} == pids
        threads = cs.find_threads(recording=recording).threads
        roles = {(t.thread.pid, t.thread.tid, t.thread.role, t.known_by) for t in threads}
        assert {role for role in roles if role[0] in pids} == {
            (pid, pid, "executor", "recording") for pid in pids
        }


def test_a_command_that_starts_a_container_is_recorded(tmp_path: Path) -> None:
    command = in_container(built().command("chain", "5"))
    made = called("record", "--source", "preload", "-o", tmp_path / "rec", "--", *command)
    assert made.code == 0, made.err
    started = cs.open_recording(tmp_path / "rec").events["callback_start"]
    assert set(started["pid"]) != {1}
    assert set(started["pid"]) == set(started["tid"].unique()) or (started["tid"] > NEXT_HOST).all()


def test_two_containers_are_recorded_by_ebpf(tmp_path: Path) -> None:
    skip_without_bpftrace()
    command = built().command("chain", ROUNDS, "--ros-args", "-r", "__node:=both")
    with ExitStack() as both:
        inside = [_running(both, command) for _ in range(2)]
        pids = _recorded(tmp_path / "rec", "ebpf", inside)
        assert set(cs.open_recording(tmp_path / "rec").events["callback_start"]["pid"]) == pids
        recording = cs.open_recording(tmp_path / "rec")
        threads = cs.find_threads(recording=recording).threads
        assert {t.thread.pid for t in threads if t.known_by == "recording"} == pids


def test_containers_of_one_image_are_recorded_once_each_by_ebpf(tmp_path: Path) -> None:
    """Both see the image's file through an overlay of their own, as Docker has it: one inode."""
    skip_without_bpftrace()
    program = built()
    command = program.command("chain", ROUNDS, "--ros-args", "-r", "__node:=both")
    with ExitStack() as both:
        inside = [_running(both, command, overlaid=program.prefix) for _ in range(2)]
        _recorded(tmp_path / "rec", "ebpf", inside)
    tables = cs.open_recording(tmp_path / "rec").events
    for process in inside:
        marks = [
            (time, name)
            for name in ("callback_start", "callback_end")
            for time in tables[name].filter(pid=process.pid)["time"]
        ]
        assert len(marks) > 10
        assert all(mark[1] != following[1] for mark, following in pairwise(sorted(marks))), (
            "each once"
        )
