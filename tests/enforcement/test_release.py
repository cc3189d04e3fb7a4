"""`status` and `release` do what they can, whoever died; a second plan for a core is refused."""

import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from applied_plans import (
    FREEZER,
    MODULES,
    applied,
    applied_here,
    ended,
    in_force,
    leftovers,
    needs_fifo,
    node_to_govern,
    one_server_plan,
    plan_for,
    processes_of,
    running_node,
    scheduling,
    server,
    started,
    wait_until_in_force,
)
from command_line import called
from gated import OTHER_CORE, cpu_ns, groups_left, kill, needs_cgroups, own_cgroup
from known import known
from processes import wait_for

from chainshaper.enforcement import undoing
from chainshaper.enforcement.guardian import GROUP
from chainshaper.enforcement.journal import find_journals
from chainshaper.linux import child_processes
from chainshaper.linux.cgroups import cgroup_of, mount_options, mount_point
from chainshaper.linux.scheduling import state_of
from chainshaper.linux.threads import list_threads

pytestmark = [pytest.mark.timed, needs_fifo, needs_cgroups]


def ours(run: "subprocess.Popen[str]") -> list[int]:
    return [pid for name in MODULES for pid in processes_of(run, name)]


def kill_all(run: "subprocess.Popen[str]") -> None:
    """Without any of them seeing another die."""
    pids = [*ours(run), run.pid]
    for number in (signal.SIGSTOP, signal.SIGKILL):
        for pid in pids:
            kill(pid, number)
    run.wait()


def test_what_a_killed_run_and_its_stopped_processes_left_is_undone(tmp_path: Path) -> None:
    with in_force(tmp_path) as (governed, run):
        left = ours(run)
        for pid in left:
            kill(pid, signal.SIGSTOP)
        run.kill()
        run.wait()
        assert "crashed" in called("status").out
        done = called("release")
        assert done.code == 0, done.err
        governed.check_as_before()
        assert not [pid for pid in left if Path(f"/proc/{pid}/exe").exists()]


def test_a_run_whose_folder_is_removed_has_it_again_and_can_be_released_though_it_is_stopped(
    tmp_path: Path,
) -> None:
    with in_force(tmp_path) as (governed, run):
        (journal,) = find_journals()
        shutil.rmtree(journal.path.parent)
        wait_for(journal.path.exists, "the journal to be written again")
        assert str(run.pid) in called("status").out
        run.send_signal(signal.SIGSTOP)
        ran = cpu_ns(governed.pid)
        wait_for(lambda: cpu_ns(governed.pid) > ran + 10_000_000, "some slots")
        assert called("release").code == 0
        assert run.wait(timeout=20) == 0
        governed.check_as_before()


def test_without_a_journal_threads_run_again_and_what_cannot_be_put_back_is_named(
    tmp_path: Path,
) -> None:
    mounted = mount_options()
    with in_force(tmp_path) as (governed, run):
        kill_all(run)
        for journal in find_journals():
            shutil.rmtree(journal.path.parent)
        (group,) = groups_left(run.pid)
        assert f"{group} was left by a run whose journal is gone" in called("status").err
        done = called("release")
        assert f"{group}, of a run whose journal is gone: its threads run again" in done.out
        assert done.code == 1
        assert f"thread {governed.pid}" in done.err
        assert f"chrt --other --pid 0 {governed.pid}" in done.err
        assert cgroup_of(governed.pid) == governed.cgroup
        ran = cpu_ns(governed.pid)
        wait_for(lambda: cpu_ns(governed.pid) > ran, "the node to run on")
        assert mount_options() == mounted
        assert "nothing was left behind" in called("release").out


def test_a_strange_line_of_a_journal_is_named_and_all_else_undone(tmp_path: Path) -> None:
    with in_force(tmp_path) as (governed, run):
        (journal,) = find_journals()
        with journal.path.open("a") as file:
            file.write('hello\n{"kind": "scheduling", "tid": "x"}\n{"kind": "freezer"}\n')
        seen = called("status")
        assert seen.code == 0
        assert seen.err.count("is not a line of a journal") == 3
        kill_all(run)
        done = called("release")
        assert done.code == 1
        assert "'hello'" in done.err
        assert "Traceback" not in done.err
        governed.check_as_before()
        assert "nothing was left behind" in called("release").out


def test_a_full_disk_does_not_end_a_plan_in_force(full_disk: Path, tmp_path: Path) -> None:
    filling = full_disk / "filling"
    filling.unlink()
    plan = one_server_plan()
    with node_to_govern(tmp_path) as governed:
        with applied_here(plan, full_disk, back_end="freezer", phase_ns=0) as seen:
            with pytest.raises(OSError, match="No space left"):
                filling.write_bytes(bytes(1_000_000))
            looks = len(seen)
            wait_for(lambda: len(seen) >= looks + 3, "the run to go on")
            assert scheduling(governed.pid) != governed.scheduling
            assert any("No space left" in note for note in seen[-1].notes)
        filling.unlink()
        assert list(full_disk.iterdir()) == []
        governed.check_as_before()


@pytest.mark.skipif(
    (mount_point() / "cgroup.type").exists(), reason="the hierarchy's root is not to be seen here"
)
def test_killing_a_whole_cgroup_leaves_guardians_to_undo_the_run(tmp_path: Path) -> None:
    with own_cgroup("owner") as group, in_force(tmp_path) as (governed, run):
        assert all(cgroup_of(pid).name == GROUP for pid in processes_of(run, "guardian"))
        for pid in (run.pid, *processes_of(run, "dispatcher")):
            (group / "cgroup.procs").write_text(str(pid))
        (group / "cgroup.kill").write_text("1")
        run.wait(timeout=20)
        governed.check_as_before()


SLOW = """
import signal, sys, time
from pathlib import Path
from chainshaper.enforcement.journal import discard_journal, open_journal

journal = open_journal(Path(sys.argv[1]))

def end(*_):
    time.sleep(1)
    discard_journal(journal)
    sys.exit(7)

signal.signal(signal.SIGTERM, end)
print("ready", flush=True)
time.sleep(60)
"""


def test_a_run_that_is_ending_its_command_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed, it would leave the command running. What ending one takes: three times 0.5 s here."""
    monkeypatch.setattr(undoing, "PATIENCE_S", 0.2)
    monkeypatch.setattr(child_processes, "PATIENCE_S", 0.5)
    command = [sys.executable, "-c", SLOW, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as owner:
        assert known(owner.stdout).readline() == b"ready\n"
        (journal,) = find_journals(tmp_path)
        assert undoing.end_run(journal) == ()
        assert owner.wait(timeout=20) == 7


def test_what_a_node_forks_under_fifo_is_put_back_and_found_although_its_parent_has_ended(
    tmp_path: Path,
) -> None:
    trigger, output = tmp_path / "trigger", tmp_path / "pids"
    script = Path(__file__).with_name("forking_node.py")
    command = [sys.executable, str(script), str(trigger), str(output), "dds"]
    with subprocess.Popen([*command, "--ros-args", "-r", "__node:=origin"]) as parent:
        forked: list[int] = []
        try:
            wait_for(lambda: len(list_threads(parent.pid)) == 2, "the node")
            before = state_of(parent.pid)
            with applied(one_server_plan(), tmp_path, "--backend", "fifo", "--phase", "0ms") as run:
                trigger.touch()
                wait_for(output.exists, "the processes to be forked")
                child, daemon = forked = [int(pid) for pid in output.read_text().split()]
                inherited = state_of(child)
                assert inherited == state_of(daemon) != before
                (journal,) = find_journals()
                wait_for(lambda: bool(journal.entries("descendant")), "the child to be seen")
                parent.kill()
                parent.wait()
                said = run.communicate(timeout=30)[1]
            assert state_of(child) == before, "it was written down while that showed"
            assert state_of(daemon) == inherited, "nothing has ever shown whose it is"
            assert f"thread {daemon}" in said
        finally:
            for pid in (*forked, parent.pid):
                kill(pid)


def test_of_two_runs_for_one_core_or_node_the_second_is_refused_others_do_not_mind_each_other(
    tmp_path: Path,
) -> None:
    (tmp_path / "second").mkdir()
    with node_to_govern(tmp_path) as governed, running_node("other", tmp_path / "other") as beside:
        before = scheduling(beside.pid)
        with applied(one_server_plan(), tmp_path, *FREEZER) as first:
            for node, core, shared in (
                ("other", None, f"of process {first.pid} governs core"),
                ("origin", OTHER_CORE, "node /origin already"),
            ):
                plan = plan_for(server("second", node, (40, 70), core=core))
                with started(plan, tmp_path / "second", "--backend", "fifo") as second:
                    said = ended(second)
                assert second.returncode == 1
                assert shared in said
                assert "chainshaper release" in said
                assert scheduling(beside.pid) == before
            if one_server_plan().servers[0].core != OTHER_CORE:
                plan = plan_for(server("second", "other", (40, 70), core=OTHER_CORE))
                with applied(plan, tmp_path / "second", *FREEZER) as second:
                    second.send_signal(signal.SIGINT)
                    assert second.wait(timeout=20) == 0
                assert scheduling(beside.pid) == before
            first.send_signal(signal.SIGINT)
            assert first.wait(timeout=20) == 0
        governed.check_as_before()


def test_of_runs_that_start_at_the_same_instant_exactly_one_is_in_force(tmp_path: Path) -> None:
    with node_to_govern(tmp_path) as governed:
        with (
            started(one_server_plan(), tmp_path, *FREEZER) as one,
            started(one_server_plan(), tmp_path, *FREEZER) as other,
        ):
            wait_for(
                lambda: one.poll() is not None or other.poll() is not None,
                "one of them to be refused",
            )
            winner, loser = (one, other) if other.poll() is not None else (other, one)
            assert loser.returncode == 1
            assert f"of process {winner.pid} governs" in ended(loser)
            wait_until_in_force(winner)
            winner.send_signal(signal.SIGINT)
            assert winner.wait(timeout=20) == 0
        governed.check_as_before()


def test_a_run_takes_over_from_one_that_was_killed_with_all_its_processes(tmp_path: Path) -> None:
    with in_force(tmp_path) as (governed, first):
        kill_all(first)
        assert leftovers()
        with applied(one_server_plan(), tmp_path, *FREEZER) as second:
            second.send_signal(signal.SIGINT)
            assert second.wait(timeout=20) == 0
        governed.check_as_before()
