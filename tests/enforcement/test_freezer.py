"""Threads of real processes stay inside the slots of their servers, on this machine's kernel."""

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from gated import (
    CORE,
    MS,
    OTHER_CORE,
    Stamping,
    ahead_of_others,
    cpu_ns,
    groups_left,
    kill,
    needs_cgroups,
    own_cgroup,
    share_inside,
    sleeping,
    stamping,
)
from known import known
from processes import children_of, is_alive, wait_for

from chainshaper.enforcement.freezer import Freezer
from chainshaper.enforcement.journal import discard_journal, open_journal
from chainshaper.enforcement.servers import ReservationServer, ServerTable
from chainshaper.enforcement.slot_dispatcher import PRIORITY, overrun
from chainshaper.linux import cgroups
from chainshaper.linux.cgroups import (
    QUICK_MOVES,
    cgroup_of,
    dissolve,
    make_moves_quick,
    make_threaded_child,
    mount_options,
    move_thread,
    moves_are_quick,
    remount,
    threads_in,
)
from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.linux.threads import list_threads
from chainshaper.values.errors import InputError, OperationError, PlatformError

pytestmark = [pytest.mark.timed, needs_cgroups]
CAP_SYS_NICE = 23

CYCLE = 20 * MS
HALF = 10_000 * MS


def server(
    name: str, *slots: tuple[int, int], core: int = CORE, priority: int = 1
) -> ReservationServer:
    return ReservationServer(name, core, priority, tuple((a * MS, b * MS) for a, b in slots))


@contextmanager
def freezer(folder: Path, *servers: ReservationServer, cycle: int = CYCLE) -> Iterator[Freezer]:
    """Servers in force; afterwards nothing of them is left, whatever the test did to them."""
    mounted, journal = mount_options(), open_journal(folder)
    try:
        back_end = Freezer(ServerTable(cycle, servers), journal)
        assert set(back_end.dispatchers.values()) <= set(children_of(os.getpid()))
        try:
            yield back_end
        finally:
            back_end.release()
        assert set(back_end.dispatchers.values()).isdisjoint(children_of(os.getpid()))
    finally:
        assert groups_left(os.getpid()) == []
        assert mount_options() == mounted
        discard_journal(journal)
    assert not journal.path.parent.exists()


def begun(back_end: Freezer) -> int:
    """Wait until the servers are in force, and give the start of their first cycle."""
    begin = known(back_end.in_force_from())
    time.sleep(max(0, begin - time.monotonic_ns()) / 1e9)
    return begin


def inside_its_slots(
    spinner: Stamping, begin: int, end: int, *slots: tuple[int, int], anchor: int = 0
) -> float:
    """Which share of the time in which it ran lay inside slots (ms); most cycles had one."""
    windows = spinner.windows(begin, end)
    assert len(windows) > 0.7 * (end - begin) / CYCLE
    return share_inside(windows, tuple((a * MS, b * MS) for a, b in slots), CYCLE, anchor)


def test_gated_threads_run_inside_their_slots_only_and_their_siblings_run_on(
    tmp_path: Path,
) -> None:
    with (
        stamping(tmp_path, 30, with_another=True) as first,
        stamping(tmp_path, 30) as second,
        freezer(tmp_path, server("a", (0, 7)), server("b", (7, 13))) as back_end,
    ):
        back_end.assign(first.tid, "a")
        back_end.assign(second.tid, "b")
        back_end.arm(3 * MS)
        begin = begun(back_end)
        gated, free = cpu_ns(first.tid), cpu_ns(first.other_tid)
        with ahead_of_others(first.tid, second.tid):
            time.sleep(0.6)
            end = time.monotonic_ns()
        gated, free = cpu_ns(first.tid) - gated, cpu_ns(first.other_tid) - free
        slots = back_end.counters()["a"].slots
        assert back_end.failure() is None
        back_end.release()

        assert inside_its_slots(first, begin, end, (0, 7), anchor=3 * MS) > 0.99
        assert inside_its_slots(second, begin, end, (7, 13), anchor=3 * MS) > 0.99
        assert gated < 0.5 * (end - begin), "7 ms of 20 ms are its own"
        assert free > 0, "its sibling was to run on"
        assert 0.8 <= known(slots) / ((end - begin) // CYCLE) <= 1.1


def test_processes_of_one_server_are_opened_and_closed_together(tmp_path: Path) -> None:
    with (
        own_cgroup("unit") as home,
        stamping(tmp_path, 30) as inside,
        stamping(tmp_path, 30, OTHER_CORE) as outside,
    ):
        # One lives in a unit of its own, the other in the group that this test is in.
        (home / "cgroup.procs").write_text(str(inside.tid))
        with freezer(tmp_path, server("a", (5, 12))) as back_end:
            back_end.assign(inside.tid, "a")
            back_end.assign(outside.tid, "a")
            assert sorted(back_end.members()["a"]) == sorted([inside.tid, outside.tid])
            assert len(groups_left(os.getpid())) == 2
            assert cgroup_of(inside.tid).parent == home
            back_end.arm(0)
            begin = begun(back_end)
            with ahead_of_others(inside.tid, outside.tid):
                time.sleep(0.6)
                end = time.monotonic_ns()
        assert cgroup_of(inside.tid) == home
        assert (home / "cgroup.type").read_text() == "domain\n"
        for spinner in (inside, outside):
            # The other core's thread leaves when the freezer reaches it, not with the interrupt.
            assert inside_its_slots(spinner, begin, end, (5, 12)) > 0.95


def test_another_anchor_or_other_slots_come_at_the_end_of_a_cycle_and_nothing_slips_between(
    tmp_path: Path,
) -> None:
    """Forward, which closes for a while, and back, which cuts a cycle short; then other slots."""
    with stamping(tmp_path, 30) as spinner, freezer(tmp_path, server("a", (5, 12))) as back_end:
        back_end.assign(spinner.tid, "a")
        since: list[int] = []
        for anchor in (0, 7 * MS, MS, None):
            if anchor is None:
                back_end.change(ServerTable(CYCLE, (server("a", (12, 17)),)), MS)
            else:
                back_end.arm(anchor)
            since.append(begun(back_end))
            assert (since[-1] - (MS if anchor is None else anchor)) % CYCLE == 0
            with ahead_of_others(spinner.tid):
                time.sleep(0.5)
        end = time.monotonic_ns()
        back_end.release()
        closed = since[1] - 7 * MS
        assert inside_its_slots(spinner, since[0], closed, (5, 12)) > 0.99
        between = spinner.windows(closed, since[1])
        assert sum(b - a for a, b in between) < MS, "no slot lies between"
        assert inside_its_slots(spinner, since[1], since[2], (5, 12), anchor=7 * MS) > 0.98
        assert inside_its_slots(spinner, since[2], since[3], (5, 12), anchor=MS) > 0.99
        assert inside_its_slots(spinner, since[3], end, (12, 17), anchor=MS) > 0.95


def stands_still(tid: int) -> bool:
    ran = cpu_ns(tid)
    time.sleep(0.1)
    return cpu_ns(tid) == ran


def test_a_thread_joins_and_changes_servers_and_is_gated_while_they_are_in_force_only(
    tmp_path: Path,
) -> None:
    servers = (server("open", (0, 10_000)), server("shut", (0, 1)))
    with stamping(tmp_path, 20) as spinner, freezer(tmp_path, *servers, cycle=HALF) as back_end:
        home = cgroup_of(spinner.tid)

        def wait_until_it_runs(when: str) -> None:
            ran = cpu_ns(spinner.tid)
            wait_for(lambda: cpu_ns(spinner.tid) > ran + 20 * MS, f"it to run {when}")

        back_end.assign(spinner.tid, "shut")
        wait_until_it_runs("unarmed")
        back_end.arm(time.monotonic_ns() + 310 * MS)
        begun(back_end)
        wait_for(lambda: stands_still(spinner.tid), "it to stop behind its slot")
        back_end.assign(spinner.tid, "open")
        assert back_end.members() == {"open": (spinner.tid,), "shut": ()}
        wait_until_it_runs("in another server")
        back_end.assign(spinner.tid, "shut")
        wait_for(lambda: stands_still(spinner.tid), "it to stop again")
        assert back_end.failure() is None
        for _ in range(2):
            back_end.release()
        assert cgroup_of(spinner.tid) == home
        wait_until_it_runs("released")
        with pytest.raises(OperationError, match="no longer in force: they were released"):
            back_end.assign(spinner.tid, "shut")


def test_a_slot_that_ends_while_a_thread_computes_is_an_overrun(tmp_path: Path) -> None:
    servers = (server("busy", (0, 6)), server("idle", (10, 14)))
    with (
        stamping(tmp_path, 10) as spinner,
        sleeping() as sleeper,
        freezer(tmp_path, *servers) as back_end,
    ):
        back_end.assign(spinner.tid, "busy")
        back_end.assign(sleeper, "idle")
        back_end.arm(0)
        begun(back_end)
        with ahead_of_others(spinner.tid):
            wait_for(lambda: (back_end.counters()["idle"].slots or 0) >= 30, "30 slots")
        busy, idle = back_end.counters()["busy"], back_end.counters()["idle"]
        # A slot in which others kept the core from it altogether may find it elsewhere.
        assert known(busy.overruns) > 0.5 * known(busy.slots)
        assert idle.overruns == 0
        assert (known(idle.late_entries) > 0) == (known(idle.longest_lateness_ns) > 100_000)


def test_threads_that_end_inside_and_outside_their_slots_are_no_failure(tmp_path: Path) -> None:
    with ExitStack() as stack:
        spinners = [stack.enter_context(stamping(tmp_path, 1.5)) for _ in range(2)]
        back_end = stack.enter_context(freezer(tmp_path, server("a", (0, 10))))
        for spinner in spinners:
            back_end.assign(spinner.tid, "a")
        back_end.arm(0)
        begun(back_end)
        spinners[1].process.kill()  # inside a slot or frozen, as it comes
        for spinner in spinners:
            spinner.process.wait(timeout=20)
        assert back_end.members() == {"a": ()}
        assert back_end.failure() is None


@pytest.fixture
def plain() -> Iterator[str]:
    """The mount options without the one that freezers set; afterwards they are as they were."""
    found = mount_options()
    cgroups.restore_mount()
    theirs = moves_are_quick()  # not by a run of ours, then
    plain = ",".join(name for name in mount_options().split(",") if name != QUICK_MOVES)
    try:
        remount(plain)
        make_moves_quick()
        allowed = moves_are_quick()
        cgroups.restore_mount()
        if not allowed or moves_are_quick():
            pytest.skip(f"this kernel, or our privileges, do not let us set {QUICK_MOVES}")
        yield plain
    finally:
        cgroups.restore_mount()
        if found != mount_options():
            remount(found) if theirs else make_moves_quick()
        assert mount_options() == found


def test_others_that_move_processes_make_nobody_wait_meanwhile(tmp_path: Path, plain: str) -> None:
    make_moves_quick()  # as a run left it whose journal is gone
    journal = open_journal(tmp_path)
    Freezer(ServerTable(CYCLE, (server("a", (0, 1)),)), journal).release()
    discard_journal(journal)
    assert mount_options() == plain
    with sleeping() as pid:
        remount(f"{plain},{QUICK_MOVES}")
        with freezer(tmp_path / "theirs", server("a", (0, 1))) as back_end:
            back_end.assign(pid, "a")
            back_end.release()
            assert moves_are_quick(), "somebody else wanted it so"
        remount(plain)
        with freezer(tmp_path / "ours", server("a", (0, 1))) as back_end:
            back_end.assign(pid, "a")
            assert mount_options() == f"{plain},{QUICK_MOVES}"
        assert mount_options() == plain


def test_the_last_of_two_runs_at_once_leaves_it_mounted_as_the_first_found_it(
    tmp_path: Path, plain: str
) -> None:
    table = ServerTable(CYCLE, (server("a", (0, 1)),))
    with sleeping() as one, sleeping() as other:
        journals = [open_journal(tmp_path, name) for name in ("first", "second")]
        runs = [Freezer(table, journal) for journal in journals]
        try:
            for run, pid in zip(runs, (one, other), strict=True):
                run.assign(pid, "a")
            runs[0].release()
            assert moves_are_quick(), "the second is in force still"
        finally:
            for run, journal in zip(runs, journals, strict=True):
                run.release()
                discard_journal(journal)
        assert mount_options() == plain


def test_a_thread_that_is_moved_away_is_told(tmp_path: Path) -> None:
    with stamping(tmp_path, 20) as spinner, freezer(tmp_path, server("a", (5, 12))) as back_end:
        back_end.assign(spinner.tid, "a")
        back_end.arm(0)
        begun(back_end)
        assert back_end.failure() is None
        (folder,) = groups_left(os.getpid())
        (folder.parent / "cgroup.threads").write_text(str(spinner.tid))
        moved = f"thread {spinner.tid} was moved out"
        assert moved in str(back_end.failure())
        folder.rmdir()
        assert moved in str(back_end.failure())


def test_a_container_that_ends_takes_its_group_along_and_the_next_of_its_name_is_gated(
    tmp_path: Path,
) -> None:
    """As a service manager or a container engine removes it, while its sibling goes on."""
    with (
        own_cgroup("container") as home,
        stamping(tmp_path, 30, OTHER_CORE) as sibling,
        freezer(tmp_path, server("a", (5, 12)), server("b", (0, 7), core=OTHER_CORE)) as back_end,
    ):
        back_end.assign(sibling.tid, "b")
        back_end.arm(0)
        for name in ("first", "second"):
            place = tmp_path / name
            place.mkdir()
            with stamping(place, 30) as inside:
                (home / "cgroup.procs").write_text(str(inside.tid))
                back_end.assign(inside.tid, "a")
                begun(back_end)
                begin = time.monotonic_ns()
                with ahead_of_others(inside.tid, sibling.tid):
                    time.sleep(0.4)
                    end = time.monotonic_ns()
                assert inside_its_slots(inside, begin, end, (5, 12)) > 0.99
            (own,) = [one for one in groups_left(os.getpid()) if one.parent == home]
            wait_for(lambda: not threads_in(own), "its end")  # noqa: B023 - in this round
            own.rmdir()
            home.rmdir()
            assert back_end.failure() is None
            assert back_end.members() == {"a": (), "b": (sibling.tid,)}
            home.mkdir()
        assert inside_its_slots(sibling, begin, end, (0, 7)) > 0.99


def test_what_cannot_be_assigned_is_refused_or_passed_over_and_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = subprocess.Popen(["true"])
    ended.wait()
    servers = (server("a", (5, 12)), server("b", (12, 15)))
    with sleeping() as pid, sleeping() as ending, freezer(tmp_path, *servers) as back_end:
        with pytest.raises(InputError, match="no server is named c: a, b are"):
            back_end.assign(os.getpid(), "c")
        back_end.assign(ended.pid, "a")

        def ends(tid: int) -> Path:
            kill(tid)
            wait_for(lambda: not is_alive(tid), "its end")
            raise PlatformError(f"thread {tid} is in a cgroup that is gone")

        with monkeypatch.context() as while_it_is_looked_up:
            while_it_is_looked_up.setattr(cgroups, "cgroup_of", ends)
            back_end.assign(ending, "a")
        assert groups_left(os.getpid()) == []
        back_end.assign(pid, "a")
        other = Freezer(ServerTable(CYCLE, servers[1:]), open_journal(tmp_path, "another"))
        try:
            with pytest.raises(OperationError, match=f"thread {pid} is in .* of another run"):
                other.assign(pid, "b")
        finally:
            other.release()
        assert cgroup_of(pid) in groups_left(os.getpid()), "the first run's is still there"


def test_a_core_that_the_machine_lacks_is_named_and_nothing_stays_behind(tmp_path: Path) -> None:
    beyond = server("a", (0, 1), core=1000)
    named = pytest.raises(PlatformError, match="core 1000, which a server of the plan asks for")
    with named, freezer(tmp_path, beyond):
        pass


def test_a_dispatcher_that_is_killed_as_soon_as_it_runs_is_named(tmp_path: Path) -> None:
    with sleeping() as pid, freezer(tmp_path, server("a", (0, 1))) as back_end:
        kill(back_end.dispatchers[CORE])
        with pytest.raises(OperationError, match=r"dispatcher of core \d+ was killed"):
            while True:
                back_end.assign(pid, "a")


def frozen(folder: Path) -> bool:
    return "frozen 1" in (folder / "cgroup.events").read_text()


def test_a_dispatcher_runs_above_everything_on_its_core_and_hears_no_terminal(
    tmp_path: Path,
) -> None:
    if not may_use_fifo():
        pytest.skip("SCHED_FIFO is not permitted (CAP_SYS_NICE)")
    with freezer(tmp_path, server("a", (0, 5))) as back_end:
        (thread,) = list_threads(back_end.dispatchers[CORE])
        assert (thread.policy, thread.priority, thread.cores) == ("SCHED_FIFO", PRIORITY, (CORE,))
        assert thread.comm == f"dispatcher/{CORE}"
        status = Path(f"/proc/{thread.pid}/status").read_text()
        locked = next(line for line in status.splitlines() if line.startswith("VmLck"))
        assert int(locked.split()[1]) > 0, "its memory may be swapped out"
        # A store to a page that is being written back would wait for the disk.
        maps = [line.split() for line in Path(f"/proc/{thread.pid}/maps").read_text().splitlines()]
        (shared,) = [line for line in maps if line[1] == "rw-s"]
        assert shared[5] == "/memfd:counters"
        assert os.getsid(thread.pid) != os.getsid(0)
        for number in (signal.SIGINT, signal.SIGHUP):
            kill(thread.pid, number)
        time.sleep(0.2)
        assert back_end.failure() is None


def test_without_the_class_it_gates_as_well_as_it_can(tmp_path: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("dropping one capability needs root")
    libc = ctypes.CDLL(None)

    def drop() -> None:  # PR_CAPBSET_DROP: root does not get it back with the exec
        libc.prctl(24, CAP_SYS_NICE, 0, 0, 0)

    with stamping(tmp_path, 30) as spinner:
        script = Path(__file__).with_name("servers_owner.py")
        arguments = ["freezer", tmp_path, CORE, 40, 20, spinner.tid]
        owner = subprocess.Popen(
            [sys.executable, str(script), *map(str, arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            preexec_fn=drop,  # noqa: PLW1509 - the child execs at once
        )
        with owner, known(owner.stdin):
            *_, dispatcher = known(owner.stdout).readline().split()
            assert list_threads(int(dispatcher))[0].policy == "SCHED_OTHER"
            begin = time.monotonic_ns()
            time.sleep(0.6)
            end = time.monotonic_ns()
        windows = spinner.windows(begin, end)
        ran = sum(b - a for a, b in windows)
        assert 0 < ran < 0.8 * (end - begin), "half of the time is its own"


def test_after_a_stall_what_should_be_open_by_then_counts(tmp_path: Path) -> None:
    with stamping(tmp_path, 30) as spinner, freezer(tmp_path, server("a", (5, 12))) as back_end:
        back_end.assign(spinner.tid, "a")
        back_end.arm(0)
        wait_for(lambda: (back_end.counters()["a"].slots or 0) >= 20, "20 slots")
        before = back_end.counters()["a"]
        dispatcher = back_end.dispatchers[CORE]
        kill(dispatcher, signal.SIGSTOP)  # for less than what passes for hung
        time.sleep(0.15)
        kill(dispatcher, signal.SIGCONT)
        resumed = time.monotonic_ns()
        with ahead_of_others(spinner.tid):
            time.sleep(0.6)
            end = time.monotonic_ns()
        after = back_end.counters()["a"]
        assert back_end.failure() is None
        back_end.release()

        # Slots that passed meanwhile are not opened belatedly, one after the other.
        assert known(after.slots) - known(before.slots) <= (end - resumed) // CYCLE + 3
        assert inside_its_slots(spinner, resumed + CYCLE, end, (5, 12)) > 0.99


def test_boundaries_without_room_between_them_leave_it_a_sign_of_life(tmp_path: Path) -> None:
    servers = [
        ReservationServer(f"s{number}", CORE, 1, ((number * MS // 4, (number + 1) * MS // 4),))
        for number in range(8)
    ]
    with sleeping() as pid, freezer(tmp_path, *servers, cycle=2 * MS) as back_end:
        back_end.arm(0)
        time.sleep(0.8)
        back_end.assign(pid, "s3")  # and it answers
        assert back_end.failure() is None


def test_where_a_frozen_thread_was_tells_whether_it_wanted_to_run(tmp_path: Path) -> None:
    with own_cgroup("overrun") as home, stamping(tmp_path, 20) as spinner, sleeping() as sleeper:
        folders, threads = {}, {}
        for name, pid in (("busy", spinner.tid), ("idle", sleeper)):
            (home / "cgroup.procs").write_text(str(pid))
            folders[name] = make_threaded_child(home, name)
            move_thread(pid, folders[name])
            threads[name] = os.open(folders[name] / "cgroup.threads", os.O_RDONLY)
        began = cpu_ns(spinner.tid)  # behind the system call that said that it was ready
        wait_for(lambda: cpu_ns(spinner.tid) > began + 20 * MS, "it to compute")
        assert overrun([threads["busy"]]) is None
        for folder in folders.values():
            (folder / "cgroup.freeze").write_text("1")
            wait_for(lambda: frozen(folder), "the freezer")  # noqa: B023
        assert overrun([threads["busy"]]) is True
        assert overrun([threads["idle"]]) is False
        assert overrun([threads["idle"], threads["busy"]]) is True
        for folder in folders.values():
            assert dissolve(folder) is None
        assert overrun(threads.values()) is False, "the groups are gone"
        for file in threads.values():
            os.close(file)


def test_where_servers_overlap_the_better_priority_runs(tmp_path: Path) -> None:
    if not may_use_fifo():
        pytest.skip("SCHED_FIFO is not permitted (CAP_SYS_NICE)")
    servers = (server("chain", (0, 12), priority=2), server("output", (4, 8), priority=1))
    with (
        stamping(tmp_path, 30) as chain,
        stamping(tmp_path, 30) as output,
        freezer(tmp_path, *servers) as back_end,
    ):
        back_end.assign(chain.tid, "chain")
        back_end.assign(output.tid, "output")
        back_end.arm(0)
        begin = begun(back_end)
        # The classes are the thread allocator's business.
        os.sched_setscheduler(chain.tid, os.SCHED_FIFO, os.sched_param(10))
        os.sched_setscheduler(output.tid, os.SCHED_FIFO, os.sched_param(20))
        begin = time.monotonic_ns()
        time.sleep(1)
        end = time.monotonic_ns()
        for spinner in (chain, output):
            os.sched_setscheduler(spinner.tid, os.SCHED_OTHER, os.sched_param(0))
        back_end.release()
        behind = chain.windows(begin, end)
        first = output.windows(begin, end)
        assert len(first) > 20
        assert len(behind) > 40, "interrupted once a cycle"
        assert share_inside(first, ((4 * MS, 8 * MS),), CYCLE, 0) > 0.99
        assert share_inside(behind, ((0, 4 * MS), (8 * MS, 12 * MS)), CYCLE, 0) > 0.97


def test_an_entry_that_comes_late_is_counted_with_its_lateness(tmp_path: Path) -> None:
    # Slots of 95 % of a cycle: whenever the dispatcher comes back it enters one late.
    with freezer(tmp_path, server("a", (0, 95)), cycle=100 * MS) as back_end:
        back_end.arm(0)
        wait_for(lambda: (back_end.counters()["a"].slots or 0) >= 2, "slots")
        before = back_end.counters()["a"]
        for _ in range(2):
            kill(back_end.dispatchers[CORE], signal.SIGSTOP)
            time.sleep(0.15)  # one slot's start lies in it at least
            kill(back_end.dispatchers[CORE], signal.SIGCONT)
            time.sleep(0.2)
        after = back_end.counters()["a"]
        assert back_end.failure() is None
        assert known(after.late_entries) > known(before.late_entries)
        assert known(after.longest_lateness_ns) > MS


def test_thirty_two_servers_share_a_core(tmp_path: Path) -> None:
    servers = [server(f"s{number}", (number, number + 1)) for number in range(32)]
    with freezer(tmp_path, *servers, cycle=40 * MS) as back_end:
        back_end.arm(0)
        time.sleep(1)
        opened = [counters.slots for counters in back_end.counters().values()]
        assert back_end.failure() is None
        assert min(opened) > 10  # type: ignore[type-var, operator]
        assert max(opened) - min(opened) <= 3  # type: ignore[type-var, operator]
