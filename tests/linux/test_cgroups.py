"""Threads in cgroups of their own, on this machine's kernel."""

import os
import subprocess
from pathlib import Path

import pytest
from gated import cpu_ns, needs_cgroups, own_cgroup, sleeping, stamping
from known import known
from processes import wait_for

from chainshaper.linux import cgroups
from chainshaper.linux.threads import has_ended, start_of
from chainshaper.values.errors import OperationError, PlatformError

pytestmark = [pytest.mark.timed, needs_cgroups]


def kind(folder: Path) -> str:
    return (folder / "cgroup.type").read_text().strip()


def freeze(child: Path) -> None:
    (child / "cgroup.freeze").write_text("1")
    wait_for(lambda: "frozen 1" in (child / "cgroup.events").read_text(), "the freezer")


def test_one_thread_stops_while_the_others_of_its_process_run_on(tmp_path: Path) -> None:
    with own_cgroup("one-thread") as home, stamping(tmp_path, 20, with_another=True) as spinner:
        (home / "cgroup.procs").write_text(str(spinner.tid))
        assert kind(home) == "domain"
        child = cgroups.make_threaded_child(home, "gated")
        assert cgroups.move_thread(spinner.tid, child)
        assert (kind(child), kind(home)) == ("threaded", "domain threaded")
        assert cgroups.threads_in(child) == (spinner.tid,)
        assert cgroups.cgroup_of(spinner.tid) == child
        assert cgroups.cgroup_of(spinner.other_tid) == home
        freeze(child)

        stopped, running = cpu_ns(spinner.tid), cpu_ns(spinner.other_tid)
        wait_for(lambda: cpu_ns(spinner.other_tid) > running + 50_000_000, "the other thread")
        assert cpu_ns(spinner.tid) == stopped

        for _ in range(2):  # twice does no harm
            assert cgroups.dissolve(child) is None
        wait_for(lambda: cpu_ns(spinner.tid) > stopped, "the thread to go on")
        assert cgroups.cgroup_of(spinner.tid) == home
        assert kind(home) == "domain"
        assert not child.exists()


def test_a_process_that_is_killed_while_frozen_ends_and_does_not_hold_its_group() -> None:
    with own_cgroup("zombie") as home:
        process = subprocess.Popen(["sleep", "60"])
        (home / "cgroup.procs").write_text(str(process.pid))
        child = cgroups.make_threaded_child(home, "gated")
        cgroups.move_thread(process.pid, child)
        freeze(child)
        born = known(start_of(process.pid, process.pid))
        assert not has_ended(process.pid, born)
        process.kill()
        wait_for(lambda: has_ended(process.pid, born), "its end")
        assert cgroups.dissolve(child) is None, "it is a zombie"
    assert process.wait(timeout=20) == -9
    assert has_ended(process.pid, born)


def test_controllers_that_rule_threads_out_are_named() -> None:
    with own_cgroup("controllers") as home:
        offered = set((home / "cgroup.controllers").read_text().split())
        root = home.parent / "cgroup.subtree_control"
        lent = set((home.parent / "cgroup.controllers").read_text().split()) - offered
        domain = sorted((offered | lent) - {"cpu", "cpuset", "perf_event", "pids"})
        if not domain:
            pytest.skip("no domain controller is available in cgroup v2 here")
        if domain[0] in lent:
            root.write_text(f"+{domain[0]}")
        try:
            (home / "cgroup.subtree_control").write_text(f"+{domain[0]}")
            with pytest.raises(PlatformError, match=rf"{home}.*controllers {domain[0]} .*scope"):
                cgroups.make_threaded_child(home, "gated")
            assert not (home / "gated").exists()
            (home / "cgroup.subtree_control").write_text(f"-{domain[0]}")
        finally:
            if domain[0] in lent:
                root.write_text(f"-{domain[0]}")


def test_processes_beneath_the_group_rule_threads_out_and_are_named() -> None:
    with own_cgroup("populated") as home, sleeping() as pid:
        inhabited = home / "inhabited"
        inhabited.mkdir()
        (inhabited / "cgroup.procs").write_text(str(pid))
        with pytest.raises(PlatformError, match="its child inhabited holds processes"):
            cgroups.make_threaded_child(home, "gated")
        assert not (home / "gated").exists()
        (home.parent / "cgroup.procs").write_text(str(pid))


def test_what_the_kernel_refuses_is_said() -> None:
    with own_cgroup("foreign") as home, sleeping() as pid:
        child = cgroups.make_threaded_child(home, "gated")
        with pytest.raises(OperationError, match=rf"thread {pid} cannot be moved.*not supported"):
            cgroups.move_thread(pid, child)  # it is of another domain
        with pytest.raises(OperationError, match=r"exists already.*chainshaper release"):
            cgroups.make_threaded_child(home, "gated")
        assert child.is_dir()
        if Path("/proc/2/comm").read_text().strip() == "kthreadd":
            with pytest.raises(OperationError, match="thread 2 cannot be moved"):
                cgroups.move_thread(2, child)
        assert cgroups.dissolve(child) is None


def test_threads_that_have_ended_are_told_from_those_that_never_were() -> None:
    with own_cgroup("ended") as home:
        process = subprocess.Popen(["true"])
        process.wait()
        child = cgroups.make_threaded_child(home, "gated")
        assert cgroups.move_thread(process.pid, child) is False
        with pytest.raises(OperationError, match=f"no thread {process.pid}"):
            cgroups.cgroup_of(process.pid)
        assert start_of(process.pid, process.pid) is None
        assert has_ended(process.pid, 0)


def test_without_the_privilege_the_remedy_is_named() -> None:
    if os.geteuid() != 0:
        pytest.skip("dropping privileges needs root")
    with own_cgroup("privilege") as home, sleeping() as pid:
        (home / "cgroup.procs").write_text(str(pid))
        child = cgroups.make_threaded_child(home, "gated")
        os.seteuid(65534)
        try:
            with pytest.raises(PlatformError, match=r"Permission denied.*Delegate=yes"):
                cgroups.make_threaded_child(home, "another")
            with pytest.raises(PlatformError, match=r"thread .*Permission denied.*Delegate=yes"):
                cgroups.move_thread(pid, child)
        finally:
            os.seteuid(0)


def test_a_machine_without_the_hierarchy_is_told_how_to_mount_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mounts = tmp_path / "mounts"
    with own_cgroup("elsewhere") as home, sleeping() as pid:
        (home / "cgroup.procs").write_text(str(pid))
        monkeypatch.setattr(cgroups, "MOUNTS", mounts)
        mounts.write_text("cgroup /sys/fs/cgroup/cpu cgroup rw,cpu 0 0\n")
        with pytest.raises(PlatformError, match="mount -t cgroup2"):
            cgroups.mount_point()
        mounts.write_text("none /with\\040blank cgroup2 rw 0 0\n")
        assert cgroups.mount_point() == Path("/with blank")
        mounts.write_text(f"none {tmp_path} cgroup2 rw 0 0\n")  # its group is outside of that
        with pytest.raises(PlatformError, match=rf"thread {pid} .*elsewhere-.*container"):
            cgroups.cgroup_of(pid)
