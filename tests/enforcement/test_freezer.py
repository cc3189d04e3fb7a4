"""Threads of real processes stay inside the slots of their servers, on this machine's kernel."""

import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from gated import (
    CORE,
    MS,
    OTHER_CORE,
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
from processes import children_of, wait_for

from chainshaper.enforcement.freezer import Freezer
from chainshaper.enforcement.servers import ReservationServer, ServerTable
from chainshaper.linux.cgroups import (
    QUICK_MOVES,
    cgroup_of,
    make_moves_quick,
    mount_options,
    moves_are_quick,
    options_before_ours,
    remount,
    restore_mount,
)
from chainshaper.linux.runs import discard_journal, open_journal
from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.values.errors import InputError, OperationError, PlatformError

pytestmark = needs_cgroups

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
    begin = back_end.in_force_from()
    assert begin is not None
    time.sleep(max(0, begin - time.monotonic_ns()) / 1e9)
    return begin


def test_a_gated_thread_runs_inside_its_slots_only_and_its_siblings_run_on(tmp_path: Path) -> None:
    with stamping(tmp_path, 30) as spinner, freezer(tmp_path, server("a", (5, 12))) as back_end:
        back_end.assign(spinner.tid, "a")
        back_end.arm(0)
        begin = begun(back_end)
        gated, free = cpu_ns(spinner.tid), cpu_ns(spinner.other_tid)
        with ahead_of_others(spinner.tid):
            time.sleep(1.5)
            end = time.monotonic_ns()
        gated, free = cpu_ns(spinner.tid) - gated, cpu_ns(spinner.other_tid) - free
        counters = back_end.counters()["a"]
        assert back_end.failure() is None
        back_end.release()

        windows = spinner.windows(begin, end)
        assert len(windows) > 30
        assert share_inside(windows, ((5 * MS, 12 * MS),), CYCLE, 0) > 0.99
        assert gated < 0.5 * (end - begin), "7 ms of 20 ms are its own"
        assert free > 0, "its sibling was to run on"
        expected = (end - begin) // CYCLE
        assert counters.slots is not None
        assert 0.8 * expected <= counters.slots <= expected + 1


def test_two_servers_take_turns_on_one_core(tmp_path: Path) -> None:
    slots = {"a": ((0 * MS, 8 * MS),), "b": ((8 * MS, 14 * MS),)}
    with (
        stamping(tmp_path, 30) as first,
        stamping(tmp_path, 30) as second,
        freezer(tmp_path, server("a", (0, 8)), server("b", (8, 14))) as back_end,
    ):
        back_end.assign(first.tid, "a")
        back_end.assign(second.tid, "b")
        back_end.arm(3 * MS)
        begin = begun(back_end)
        with ahead_of_others(first.tid, second.tid):
            time.sleep(1.5)
            end = time.monotonic_ns()
        back_end.release()
        for name, spinner in (("a", first), ("b", second)):
            windows = spinner.windows(begin, end)
            assert len(windows) > 30
            assert share_inside(windows, slots[name], CYCLE, 3 * MS) > 0.99


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
                time.sleep(1.5)
                end = time.monotonic_ns()
        assert cgroup_of(inside.tid) == home
        assert (home / "cgroup.type").read_text() == "domain\n"
        for spinner in (inside, outside):
            windows = spinner.windows(begin, end)
            assert len(windows) > 30
            # The other core's thread leaves when the freezer reaches it, not with the interrupt.
            assert share_inside(windows, ((5 * MS, 12 * MS),), CYCLE, 0) > 0.95


@pytest.mark.parametrize("shift", [7 * MS, -6 * MS])
def test_another_anchor_moves_the_slots_and_lets_nothing_slip_between(
    tmp_path: Path, shift: int
) -> None:
    with stamping(tmp_path, 30) as spinner, freezer(tmp_path, server("a", (5, 12))) as back_end:
        back_end.assign(spinner.tid, "a")
        back_end.arm(0)
        begin = begun(back_end)
        with ahead_of_others(spinner.tid):
            time.sleep(0.7)
            back_end.arm(shift)
            moved = begun(back_end)
            time.sleep(1)
            end = time.monotonic_ns()
        back_end.release()

        assert (moved - shift) % CYCLE == 0
        old_cycles_end = moved - shift if shift > 0 else moved
        slots = ((5 * MS, 12 * MS),)
        before = spinner.windows(begin, old_cycles_end)
        assert len(before) > 20
        assert share_inside(before, slots, CYCLE, 0) > 0.99
        after = spinner.windows(moved, end)
        assert len(after) > 20
        assert share_inside(after, slots, CYCLE, shift) > 0.99
        between = spinner.windows(old_cycles_end, moved)
        assert sum(b - a for a, b in between) < MS, "no slot lies between"


def test_nothing_is_gated_before_arming_and_after_the_release(tmp_path: Path) -> None:
    with stamping(tmp_path, 20) as spinner:
        home = cgroup_of(spinner.tid)
        with freezer(tmp_path, server("a", (0, 1)), cycle=HALF) as back_end:
            back_end.assign(spinner.tid, "a")
            ran = cpu_ns(spinner.tid)
            wait_for(lambda: cpu_ns(spinner.tid) > ran + 20 * MS, "it to run unarmed")
            back_end.arm(time.monotonic_ns() + 400 * MS)
            begun(back_end)
            wait_for(lambda: stands_still(spinner.tid), "it to stop behind its slot")
            ran = cpu_ns(spinner.tid)
            back_end.release()
            back_end.release()
            assert cgroup_of(spinner.tid) == home
            wait_for(lambda: cpu_ns(spinner.tid) > ran + 20 * MS, "it to run released")
            with pytest.raises(OperationError, match="no longer in force: they were released"):
                back_end.assign(spinner.tid, "a")


def stands_still(tid: int) -> bool:
    ran = cpu_ns(tid)
    time.sleep(0.1)
    return cpu_ns(tid) == ran


def test_threads_join_and_change_servers_while_these_are_in_force(tmp_path: Path) -> None:
    servers = (server("open", (0, 10_000)), server("shut", (0, 1)))
    with stamping(tmp_path, 20) as spinner, freezer(tmp_path, *servers, cycle=HALF) as back_end:
        back_end.arm(time.monotonic_ns() + 310 * MS)
        begun(back_end)
        time.sleep(0.1)
        back_end.assign(spinner.tid, "shut")
        wait_for(lambda: stands_still(spinner.tid), "it to stop")
        back_end.assign(spinner.tid, "open")
        assert back_end.members() == {"open": (spinner.tid,), "shut": ()}
        ran = cpu_ns(spinner.tid)
        wait_for(lambda: cpu_ns(spinner.tid) > ran, "it to go on")
        back_end.assign(spinner.tid, "shut")
        wait_for(lambda: stands_still(spinner.tid), "it to stop again")
        assert back_end.failure() is None


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
        time.sleep(1.5)
        end = time.monotonic_ns()
        for spinner in (chain, output):
            os.sched_setscheduler(spinner.tid, os.SCHED_OTHER, os.sched_param(0))
        back_end.release()
        behind = chain.windows(begin, end)
        first = output.windows(begin, end)
        assert len(first) > 30
        assert len(behind) > 60, "interrupted once a cycle"
        assert share_inside(first, ((4 * MS, 8 * MS),), CYCLE, 0) > 0.99
        assert share_inside(behind, ((0, 4 * MS), (8 * MS, 12 * MS)), CYCLE, 0) > 0.97


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
            wait_for(lambda: (back_end.counters()["idle"].slots or 0) >= 50, "50 slots")
        busy, idle = back_end.counters()["busy"], back_end.counters()["idle"]
        assert busy.slots is not None
        assert busy.overruns is not None
        # A slot in which others kept the core from it altogether may find it elsewhere.
        assert busy.overruns > 0.5 * busy.slots
        assert idle.overruns == 0
        assert idle.late_entries is not None
        assert idle.longest_lateness_ns is not None
        assert (idle.late_entries > 0) == (idle.longest_lateness_ns > 100_000)


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
    found, ours = mount_options(), options_before_ours()
    plain = ",".join(name for name in found.split(",") if name != QUICK_MOVES)
    try:
        remount(f"{plain},{QUICK_MOVES}")
        allowed = moves_are_quick()
        restore_mount(plain)
        if not allowed or moves_are_quick():
            pytest.skip(f"this kernel, or our privileges, do not let us set {QUICK_MOVES}")
        yield plain
    finally:
        restore_mount(plain)
        if found != plain:
            remount(found) if ours is None else make_moves_quick(ours)
        assert mount_options() == found


def test_others_that_move_processes_make_nobody_wait_meanwhile(tmp_path: Path, plain: str) -> None:
    remount(f"{plain},{QUICK_MOVES}")
    with freezer(tmp_path / "theirs", server("a", (0, 1))) as back_end:
        back_end.release()
        assert moves_are_quick(), "somebody else wanted it so"
    remount(plain)
    with freezer(tmp_path / "ours", server("a", (0, 1))):
        assert mount_options() == f"{plain},{QUICK_MOVES}"
    with pytest.raises(PlatformError), freezer(tmp_path, server("a", (0, 1), core=99)):
        pass
    assert mount_options() == plain


def test_what_a_run_without_a_journal_left_mounted_is_not_taken_for_another_program_s(
    tmp_path: Path, plain: str
) -> None:
    make_moves_quick(plain)  # and nothing else says who did
    journal = open_journal(tmp_path)
    Freezer(ServerTable(CYCLE, (server("a", (0, 1)),)), journal).release()
    discard_journal(journal)
    assert mount_options() == plain


def test_the_last_of_two_runs_at_once_leaves_it_mounted_as_the_first_found_it(
    tmp_path: Path, plain: str
) -> None:
    table = ServerTable(CYCLE, (server("a", (0, 1)),))
    journals = [open_journal(tmp_path, name) for name in ("first", "second")]
    runs = [Freezer(table, journal) for journal in journals]
    for run, journal in zip(runs, journals, strict=True):
        run.release()
        discard_journal(journal)
    assert mount_options() == plain


def test_a_group_that_somebody_removes_is_told(tmp_path: Path) -> None:
    with stamping(tmp_path, 20) as spinner, freezer(tmp_path, server("a", (5, 12))) as back_end:
        back_end.assign(spinner.tid, "a")
        back_end.arm(0)
        begun(back_end)
        (folder,) = groups_left(os.getpid())
        (folder.parent / "cgroup.threads").write_text(str(spinner.tid))
        folder.rmdir()
        wait_for(lambda: back_end.failure() is not None, "the failure")
        removed = "a cgroup of server a was removed"
        wait_for(lambda: removed in str(back_end.failure()), "the reason")


def test_a_thread_that_somebody_moves_away_is_told(tmp_path: Path) -> None:
    with stamping(tmp_path, 20) as spinner, freezer(tmp_path, server("a", (5, 12))) as back_end:
        back_end.assign(spinner.tid, "a")
        assert back_end.failure() is None
        parent = cgroup_of(spinner.tid).parent
        (parent / "cgroup.threads").write_text(str(spinner.tid))
        assert f"thread {spinner.tid} was moved out" in str(back_end.failure())


def test_one_run_at_a_time_has_a_thread(tmp_path: Path) -> None:
    with sleeping() as pid, freezer(tmp_path, server("a", (5, 12))) as back_end:
        back_end.assign(pid, "a")
        journal = open_journal(tmp_path, "another")
        other = Freezer(ServerTable(CYCLE, (server("b", (0, 1)),)), journal)
        try:
            with pytest.raises(OperationError, match=f"thread {pid} is in .* of another run"):
                other.assign(pid, "b")
        finally:
            other.release()
        assert cgroup_of(pid) in groups_left(os.getpid()), "the first run's is still there"


def test_what_cannot_be_assigned_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    ended = subprocess.Popen(["true"])
    ended.wait()
    with freezer(tmp_path, server("a", (5, 12)), server("b", (12, 15))) as back_end:
        with pytest.raises(InputError, match="no server is named c: a, b are"):
            back_end.assign(os.getpid(), "c")
        back_end.assign(ended.pid, "a")
        assert groups_left(os.getpid()) == []


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
