"""Processes as /proc shows them, by real ones."""

import os
from pathlib import Path

from actors import acting

from chainshaper.linux.processes import (
    descendants,
    find_applications,
    list_processes,
    read_process,
)
from chainshaper.linux.threads import parents

CYCLONE = ("gc", "dq.builtins", "dq.user", "tev", "recv")


def test_a_process_shows_its_command_line_and_threads(tmp_path: Path) -> None:
    arguments = ("--ros-args", "-p", "text:=two words")
    with acting(tmp_path, *CYCLONE, arguments=arguments) as actor:
        process = read_process(actor.pid)
    assert process is not None
    assert process.command[-3:] == arguments
    assert process.parent == os.getpid()
    assert process.inner_pid == actor.pid or process.inner_pid < actor.pid
    assert {thread.comm for thread in process.threads[1:]} == set(CYCLONE)
    assert process.threads[0].tid == actor.pid


def test_threads_that_only_dds_has_tell_a_participant(tmp_path: Path) -> None:
    for names, participates in ((CYCLONE, True), (("gc", "lease"), False), ((), False)):
        with acting(tmp_path, *names) as actor:
            process = read_process(actor.pid)
            assert process is not None
            assert process.participates is participates
            assert bool(find_applications([process])) is participates


def test_a_forked_helper_takes_no_part_whatever_its_command_line_says(tmp_path: Path) -> None:
    arguments = ("--ros-args", "-r", "__node:=talker")
    with acting(tmp_path, *CYCLONE, arguments=arguments) as actor:
        helper = read_process(actor.fork())
        node = read_process(actor.pid)
    assert helper is not None
    assert node is not None
    assert helper.command == node.command
    assert (helper.participates, node.participates) == (False, True)


def test_descendants_are_children_and_theirs(tmp_path: Path) -> None:
    with acting(tmp_path) as actor:
        child = actor.fork()
        assert descendants(parents(), actor.pid) == {actor.pid, child}
        assert {actor.pid, child} <= descendants(parents(), os.getpid())
    assert descendants({2: 1, 3: 2, 4: 3, 5: 1}, 2) == {2, 3, 4}


def test_what_is_gone_is_no_process() -> None:
    pid = os.posix_spawn("/bin/true", ["true"], {})
    os.waitpid(pid, 0)
    assert read_process(pid) is None


def test_the_kernels_own_threads_are_no_processes() -> None:
    assert 2 not in {process.pid for process in list_processes() if not process.command}
    assert all(process.command for process in list_processes())
