"""Processes of another user: what they say of themselves gives them nothing, nor runs as us."""

import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest
from applied_plans import applied_here, needs_fifo, plan_for, running_node, server
from command_line import called, json_of, refused
from known import known
from processes import wait_for
from strangers import NOBODY, named, needs_root, open_folder, strange

from chainshaper import find_threads
from chainshaper.linux.processes import read_process, run_users, user_of
from chainshaper.linux.threads import has_ended, list_threads, start_of
from chainshaper.planning import ChainPlan, Plan, save_plan
from chainshaper.sources import ros
from chainshaper.sources.ros import environment_of, own_environment, start_with_rclpy
from chainshaper.values.errors import InputError, OperationError

__all__ = ["open_folder"]
pytestmark = [pytest.mark.timed, needs_root]

EVIL = """#!/bin/sh
cat /proc/self/status > {ran}.partial
ls -l /proc/self/fd >> {ran}.partial
mv {ran}.partial {ran}
"""


def trap(folder: Path) -> tuple[dict[str, str], Path]:
    """An environment whose `ros2` is run by a program of its owner's, and what that leaves."""
    ran, evil = folder / "ran", folder / "evil"
    evil.write_text(EVIL.format(ran=ran))
    (folder / "ros2").write_text(f"#!{evil}\n")
    for file in (evil, folder / "ros2"):
        file.chmod(0o755)
    return {"PATH": f"{folder}:/usr/bin:/bin", "AMENT_PREFIX_PATH": str(folder)}, ran


def is_asleep(pid: int) -> bool:
    return "clock_nanosleep" in Path(f"/proc/{pid}/wchan").read_text()


def realtime(pid: int) -> list[str]:
    return [t.comm for t in list_threads(pid) if t.policy != "SCHED_OTHER"]


@needs_fifo
def test_nothing_of_a_strangers_environment_runs_unless_its_user_is_named_and_then_as_that_user(
    plan: ChainPlan, tmp_path: Path, open_folder: Path
) -> None:
    environment, ran = trap(open_folder)
    nodes = [thread.node[1:] for one in plan.servers for thread in one.threads]
    shaping = known(plan.shaping_node).name
    with (
        strange(named(*(node for node in nodes if node != shaping)), environment) as others,
        strange(named(shaping), environment) as gate,
    ):
        own_threads = [realtime(one.pid) for one in (others, gate)]
        with (
            pytest.raises(OperationError, match="left alone, since users run them whom this run"),
            applied_here(plan, tmp_path / "runs", phase_ns=0),
        ):
            pass
        assert not ran.exists()
        assert [realtime(one.pid) for one in (others, gate)] == own_threads == [[], []]
        with applied_here(plan, tmp_path / "runs", phase_ns=0, users=["nobody"]):
            wait_for(ran.exists, "what the nodes' user wants to be run")
            assert realtime(others.pid)
            assert realtime(gate.pid), "the shaping node has its server's priority, too"
    lines = ran.read_text().splitlines()
    status = dict(line.split(":\t", 1) for line in lines if ":\t" in line)
    assert set(status["Uid"].split()) == {str(NOBODY)}
    assert set(status["Gid"].split()) == {str(NOBODY)}
    assert set(status["Groups"].split()) <= {str(NOBODY)}
    assert status["NoNewPrivs"] == "1"
    assert {int(status[f"Cap{which}"], 16) for which in ("Prm", "Eff", "Inh", "Amb")} == {0}
    files = [line.split(" -> ")[1] for line in lines if " -> " in line]
    assert all(name.startswith(("/memfd:", "/proc/", str(ran))) or "ros/script.py" in name
               for name in files), files  # fmt: skip


@needs_fifo
def test_a_name_that_a_stranger_repeats_neither_blocks_nor_is_governed_ever(
    tmp_path: Path,
) -> None:
    plan = plan_for(server("first", "origin", (0, 30)), server("second", "other", (40, 70)))
    with (
        running_node("other", tmp_path / "other"),
        strange(named("origin", "other")) as stranger,
    ):
        with (
            running_node("origin", tmp_path / "origin") as node,
            applied_here(plan, tmp_path / "runs", phase_ns=0) as states,
        ):
            wait_for(lambda: bool(realtime(node.pid)), "the plan's node to be governed")
            (line,) = [note for note in states[-1].notes if str(stranger.pid) in note]
            assert "/origin, /other (process" in line
            assert "of nobody)" in line
            assert "\n" not in line
            node.send_signal(signal.SIGKILL)
            node.wait()
            gone = states[-1]
            wait_for(lambda: not states[-1].servers[0].threads, "the end of the node to be seen")
            wait_for(lambda: states[-1] is not gone, "another look")
            assert realtime(stranger.pid) == []
            (tmp_path / "origin").unlink()
            with running_node("origin", tmp_path / "origin") as again:
                wait_for(lambda: bool(realtime(again.pid)), "the node to be taken in again")
                assert [note for note in states[-1].notes if str(stranger.pid) in note] == [line]
                assert realtime(stranger.pid) == []
        assert realtime(stranger.pid) == []


def test_every_verb_that_finds_by_name_takes_processes_of_the_users_that_it_names(
    tmp_path: Path,
) -> None:
    plan_file = tmp_path / "plan.yaml"
    save_plan(Plan.of(plan_for(server("first", "strange_origin", (0, 30)))), plan_file)

    def nodes(*arguments: str | Path) -> set[str]:
        return {n for t in json_of("threads", *arguments)["threads"] for n in t["nodes"]}

    with strange(named("strange_origin")) as stranger:
        for where in ([], [plan_file]):
            assert "/strange_origin" not in nodes(*where)
            notes = json_of("threads", *where)["notes"]
            assert any(f"/strange_origin (process {stranger.pid} of nobody)" in n for n in notes)
            assert "/strange_origin" in nodes(*where, "--user", "nobody", "--user", "root")
        assert "/strange_origin" in nodes(str(stranger.pid)), "who names a process, means it"
        arguments = ("apply", plan_file, "--dry-run", "--backend", "fifo")
        assert f"(process {stranger.pid} of nobody)" in refused(1, *arguments)
        shown = called(*arguments, "--user", str(NOBODY))
        assert shown.code == 0, shown
        assert "no user is named 'nosuch'" in refused(2, *arguments, "--user", "nosuch")


def test_the_users_of_a_run_are_who_launched_it_and_root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SUDO_UID", "1234")
    assert run_users() == {0, 1234}
    for odd in ("", "-1", "root", "1 2"):
        monkeypatch.setenv("SUDO_UID", odd)
        assert run_users() == {0}
    assert run_users(["nobody", "7", 8]) == {NOBODY, 7, 8}, "those alone"
    monkeypatch.setenv("SUDO_UID", "1234")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(os, "getuid", lambda: 1000)
    assert run_users() == {0, 1000}, "anybody can set a variable"
    with pytest.raises(InputError, match="no user is named"):
        run_users(["nosuch"])


def test_a_program_that_runs_as_another_than_who_started_it_is_no_users(
    open_folder: Path,
) -> None:
    """As `sudo` does while it asks for a password: all its ids are root's, its words are not."""
    perl = shutil.which("perl")
    if perl is None:
        pytest.skip("no perl to become a set-user-ID program")
    copy = Path(shutil.copy(perl, open_folder / "perl"))
    copy.chmod(0o4755)
    environment, ran = trap(open_folder)
    command = [str(copy), "-e", "$< = $>; sleep 600", "node", "--ros-args", "-r", "__node:=carried"]
    with strange(command, environment) as process:

        def is_root() -> bool:
            return "Uid:\t0\t0\t0\t0\n" in Path(f"/proc/{process.pid}/status").read_text()

        wait_for(lambda: is_root() or is_asleep(process.pid), "the program to become root")
        if not is_root():
            pytest.skip("set-user-ID programs do not work in this folder")
        assert user_of(process.pid) is None
        found = known(read_process(process.pid))
        assert found.user is None
        assert all("/carried" not in thread.nodes for thread in find_threads().threads)
        with pytest.raises(OperationError, match="started by another user than runs it"):
            environment_of(process.pid)
    assert not ran.exists()


@pytest.mark.parametrize("options", [["--mount"], ["--user", "--map-root-user"]])
def test_an_environment_from_a_namespace_of_its_own_is_not_used(options: list[str]) -> None:
    """Its paths lead elsewhere here; and who is root in there is a stranger all the same."""
    user = 0 if options == ["--mount"] else NOBODY
    command = ["unshare", *options, "/bin/sh", "-c", "echo ready; read -r _"]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, user=user, group=user, cwd="/"
    )
    try:
        if known(process.stdout).readline() != b"ready\n":
            pytest.skip("no such namespace can be made here")
        assert user_of(process.pid) == user
        with pytest.raises(OperationError, match="in a container or a namespace of its own"):
            environment_of(process.pid)
    finally:
        process.kill()
        process.communicate()


def test_what_a_stranger_has_run_is_bounded_in_time_and_in_what_it_prints(
    open_folder: Path,
) -> None:
    """It prints without end, and what it has started holds on to our files."""
    environment, _ = trap(open_folder)
    (open_folder / "evil").write_text("#!/bin/sh\nsleep 600 & echo $!; exec cat /dev/zero\n")
    with strange(["/bin/sleep", "600"], environment) as process:
        script = start_with_rclpy(environment_of(process.pid), ros.__file__)
        wait_for(script.is_over, "it to have printed all that it may")
        begun = time.monotonic()
        printed, problem = script.end()
        assert time.monotonic() - begun < 10
        assert len(printed) <= ros._MOST_PRINTED
        assert problem is not None
        (open_folder / "evil").write_text("#!/bin/sh\nsleep 601 & echo $! > $0.pid; wait\n")
        (open_folder / "evil.pid").touch()
        (open_folder / "evil.pid").chmod(0o666)
        script = start_with_rclpy(environment_of(process.pid), ros.__file__)
        pid_file = open_folder / "evil.pid"
        wait_for(lambda: pid_file.read_text().endswith("\n"), "a child of it")
        child = int(pid_file.read_text())
        started = known(start_of(child, child))
        _, problem = script.end()
        assert problem == "ROS 2 did not answer within 0 s"
        wait_for(lambda: has_ended(child, started), "the child to be killed")


def test_a_pipe_in_place_of_a_strangers_ros2_delays_nothing(open_folder: Path) -> None:
    os.mkfifo(open_folder / "ros2", 0o777)
    (open_folder / "ros2").chmod(0o777)
    with strange(["/bin/sleep", "600"], {"PATH": f"{open_folder}:/usr/bin:/bin"}) as process:
        script = start_with_rclpy(environment_of(process.pid), ros.__file__)
        problem = script.end(30)[1]
    assert problem == "ModuleNotFoundError: No module named 'chainshaper'", "Python was found"


def test_who_may_not_become_the_nodes_user_runs_nothing_of_its(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with strange(["/bin/sleep", "600"]) as process:
        monkeypatch.setattr(os, "geteuid", lambda: 1000)
        with pytest.raises(OperationError, match="run chainshaper as that user, or as root"):
            environment_of(process.pid)
    assert own_environment().user == 1000
    monkeypatch.undo()
    with (
        strange(["/bin/sleep", "600"], user=4_000_000) as process,
        pytest.raises(OperationError, match=r"user 4000000 .* is not in this machine's user data"),
    ):
        environment_of(process.pid)
