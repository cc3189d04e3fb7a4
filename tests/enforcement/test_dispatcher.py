"""When servers open and close, and the process of a core that opens and closes them."""

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain, takewhile
from pathlib import Path

import pytest
from gated import (
    CORE,
    MS,
    ahead_of_others,
    kill,
    needs_cgroups,
    own_cgroup,
    share_inside,
    sleeping,
    stamping,
)
from hypothesis import given
from hypothesis import strategies as st
from processes import wait_for

from chainshaper.enforcement.freezer import (
    Anchoring,
    Freezer,
    first_anchoring,
    next_anchoring,
)
from chainshaper.enforcement.servers import ReservationServer, ServerTable
from chainshaper.enforcement.slot_dispatcher import (
    PRIORITY,
    Boundary,
    boundaries_of,
    instants,
    moved,
    overrun,
)
from chainshaper.linux import cgroups
from chainshaper.linux.runs import discard_journal, open_journal
from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.linux.threads import list_threads

Slots = tuple[tuple[tuple[int, int], ...], ...]


@st.composite
def tables(draw: st.DrawFn) -> tuple[int, Slots]:
    """A cycle time and the slots of up to three servers, which may overlap each other."""
    cycle = draw(st.integers(2, 30))
    slots = []
    for _ in range(draw(st.integers(1, 3))):
        cuts = sorted(draw(st.sets(st.integers(0, cycle), min_size=2, max_size=6)))
        slots.append(tuple(zip(cuts[::2], cuts[1::2], strict=False)))
    return cycle, tuple(slots)


def open_at(instant: int, cycle: int, slots: Slots) -> frozenset[int]:
    return frozenset(
        server
        for server, own in enumerate(slots)
        if any(start <= instant % cycle < end for start, end in own)
    )


def walk(stream: list[tuple[int, Boundary]], until: int) -> dict[int, frozenset[int]]:
    """What a dispatcher that follows the boundaries has open at each instant."""
    found = {}
    for (at, boundary), following in zip(stream, [*stream[1:], (until, None)], strict=True):
        found.update(dict.fromkeys(range(at, following[0]), boundary.open))
    return found


def test_a_shared_boundary_closes_one_server_and_opens_the_other() -> None:
    # R_m [0, 60), its output's server [60, 70): one instant, never both.
    assert boundaries_of(100, (((0, 60),), ((60, 70),))) == (
        Boundary(0, frozenset({0}), frozenset({0})),
        Boundary(60, frozenset({1}), frozenset({1})),
        Boundary(70, frozenset(), frozenset()),
    )


def test_a_slot_that_ends_with_the_cycle_goes_over_into_one_that_begins_it() -> None:
    own = frozenset({0})
    assert boundaries_of(100, (((0, 20), (80, 100)),)) == (
        Boundary(0, own, own),
        Boundary(20, frozenset(), frozenset()),
        Boundary(80, own, own),
    )


def test_nobody_wakes_up_where_nothing_changes() -> None:
    ahead = instants(boundaries_of(100, (((20, 60),),)), 100, 1000)
    assert [at for at, _ in takewhile(lambda item: item[0] < 1300, ahead)] == [
        *(1000, 1020, 1060),  # at 1000 cycles of another anchor may have ended
        *(1120, 1160),
        *(1220, 1260),
    ]


def test_a_server_that_is_open_throughout_is_never_closed() -> None:
    assert [b.open for b in boundaries_of(100, (((0, 100),),))] == [{0}]


def test_a_server_without_slots_is_never_opened() -> None:
    assert [b.open for b in boundaries_of(100, ((),))] == [frozenset()]


@given(tables(), st.integers(-50, 50))
def test_servers_are_open_exactly_inside_their_slots(table: tuple[int, Slots], begin: int) -> None:
    cycle, slots = table
    until = begin + 3 * cycle
    ahead = instants(boundaries_of(cycle, slots), cycle, begin)
    stream = list(takewhile(lambda item: item[0] < until, ahead))
    assert walk(stream, until) == {t: open_at(t - begin, cycle, slots) for t in range(begin, until)}
    started = [(at, server) for at, boundary in stream for server in boundary.starts]
    assert sorted(started) == sorted(
        (begin + k * cycle + start, server)
        for k in range(3)
        for server, own in enumerate(slots)
        for start, _ in own
    )


@given(tables(), st.integers(-200, 200), st.integers(-200, 200), st.integers(-300, 300))
def test_moving_to_another_anchor_lets_no_thread_slip_between(
    table: tuple[int, Slots], old: int, new: int, earliest: int
) -> None:
    cycle, slots = table
    boundaries = boundaries_of(cycle, slots)
    before = first_anchoring(old, cycle, earliest - 50)
    anchoring = next_anchoring(before, new, cycle, earliest)
    turn = min(anchoring.begin_ns, anchoring.end_ns)

    assert turn >= earliest
    assert (anchoring.begin_ns - new) % cycle == 0
    assert (anchoring.end_ns - old) % cycle == 0
    assert abs(anchoring.begin_ns - anchoring.end_ns) <= cycle // 2
    assert turn - max(earliest, before.begin_ns) < 3 * cycle, "it takes its time"

    until = anchoring.begin_ns + 2 * cycle
    ahead = moved(instants(boundaries, cycle, before.begin_ns), anchoring, boundaries, cycle)
    expected = {}
    for t in range(before.begin_ns, until):
        if t < turn:
            expected[t] = open_at(t - old, cycle, slots)
        elif t < anchoring.begin_ns:
            expected[t] = frozenset()
        else:
            expected[t] = open_at(t - new, cycle, slots)
    stream = list(takewhile(lambda item: item[0] < until, ahead))
    if turn >= before.begin_ns:
        assert walk(stream, until) == expected


def test_a_move_that_is_overtaken_by_another_leaves_only_the_last() -> None:
    boundaries = boundaries_of(100, (((0, 60),),))
    ahead = moved(instants(boundaries, 100, 0), Anchoring(230, 200), boundaries, 100)
    upcoming = next(ahead)
    ahead = moved(chain([upcoming], ahead), Anchoring(410, 430), boundaries, 100)
    times = [at for at, _ in takewhile(lambda item: item[0] < 600, ahead)]
    assert times == [0, 60, 100, 160, 200, 230, 290, 330, 390, 410, 470, 510, 570]


def test_the_first_cycle_begins_as_soon_as_it_may() -> None:
    assert first_anchoring(30, 100, 950) == Anchoring(1030, 1030)
    assert first_anchoring(30, 100, 1030) == Anchoring(1030, 1030)
    assert first_anchoring(5_030, 100, 950) == Anchoring(1030, 1030), "an anchor yet to come"


pytestmark = needs_cgroups

CYCLE = 20 * MS
CAP_SYS_NICE = 23


@contextmanager
def freezer(folder: Path, cycle: int, *slots: tuple[tuple[int, int], ...]) -> Iterator[Freezer]:
    servers = tuple(
        ReservationServer(f"server-{number}", CORE, 1, own) for number, own in enumerate(slots)
    )
    journal = open_journal(folder)
    back_end = Freezer(ServerTable(cycle, servers), journal)
    try:
        yield back_end
    finally:
        back_end.release()
        discard_journal(journal)


def dispatcher_of(back_end: Freezer) -> int:
    return back_end.dispatchers[CORE]


def frozen(folder: Path) -> bool:
    return "frozen 1" in (folder / "cgroup.events").read_text()


def test_it_runs_on_the_core_that_it_gates_above_everything_there(tmp_path: Path) -> None:
    if not may_use_fifo():
        pytest.skip("SCHED_FIFO is not permitted (CAP_SYS_NICE)")
    with freezer(tmp_path, CYCLE, ((0, 5 * MS),)) as back_end:
        (thread,) = list_threads(dispatcher_of(back_end))
        assert (thread.policy, thread.priority, thread.cores) == ("SCHED_FIFO", PRIORITY, (CORE,))
        assert thread.comm == f"dispatcher/{CORE}"
        status = Path(f"/proc/{thread.pid}/status").read_text()
        locked = next(line for line in status.splitlines() if line.startswith("VmLck"))
        assert int(locked.split()[1]) > 0, "its memory may be swapped out"


def test_what_a_terminal_sends_is_not_for_them(tmp_path: Path) -> None:
    with freezer(tmp_path, CYCLE, ((0, 5 * MS),)) as back_end:
        dispatcher = dispatcher_of(back_end)
        assert os.getsid(dispatcher) != os.getsid(0)
        for number in (signal.SIGINT, signal.SIGHUP):
            kill(dispatcher, number)
        time.sleep(0.2)
        assert back_end.failure() is None
        assert dispatcher_of(back_end) == dispatcher


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
        assert owner.stdin is not None
        assert owner.stdout is not None
        with owner, owner.stdin:
            *_, dispatcher = owner.stdout.readline().split()
            assert list_threads(int(dispatcher))[0].policy == "SCHED_OTHER"
            begin = time.monotonic_ns()
            time.sleep(1)
            end = time.monotonic_ns()
        windows = spinner.windows(begin, end)
        ran = sum(b - a for a, b in windows)
        assert 0 < ran < 0.8 * (end - begin), "half of the time is its own"


def test_after_a_stall_what_should_be_open_by_then_counts(tmp_path: Path) -> None:
    slots = ((5 * MS, 12 * MS),)
    with stamping(tmp_path, 30) as spinner, freezer(tmp_path, CYCLE, slots) as back_end:
        back_end.assign(spinner.tid, "server-0")
        back_end.arm(0)
        wait_for(lambda: (back_end.counters()["server-0"].slots or 0) >= 20, "20 slots")
        before = back_end.counters()["server-0"]
        dispatcher = dispatcher_of(back_end)
        kill(dispatcher, signal.SIGSTOP)  # for less than what passes for hung
        time.sleep(0.15)
        kill(dispatcher, signal.SIGCONT)
        resumed = time.monotonic_ns()
        with ahead_of_others(spinner.tid):
            time.sleep(1)
            end = time.monotonic_ns()
        after = back_end.counters()["server-0"]
        assert back_end.failure() is None
        back_end.release()

        assert before.slots is not None
        assert after.slots is not None
        # Slots that passed meanwhile are not opened belatedly, one after the other.
        assert after.slots - before.slots <= (end - resumed) // CYCLE + 3
        windows = spinner.windows(resumed + CYCLE, end)
        assert len(windows) > 20
        assert share_inside(windows, slots, CYCLE, 0) > 0.99


def test_an_entry_that_comes_late_is_counted_with_its_lateness(tmp_path: Path) -> None:
    # Slots of 95 % of a cycle: whenever the dispatcher comes back it enters one late.
    with freezer(tmp_path, 100 * MS, ((0, 95 * MS),)) as back_end:
        back_end.arm(0)
        wait_for(lambda: (back_end.counters()["server-0"].slots or 0) >= 2, "slots")
        before = back_end.counters()["server-0"]
        for _ in range(3):
            kill(dispatcher_of(back_end), signal.SIGSTOP)
            time.sleep(0.15)  # one slot's start lies in it at least
            kill(dispatcher_of(back_end), signal.SIGCONT)
            time.sleep(0.2)
        after = back_end.counters()["server-0"]
        assert back_end.failure() is None
        assert before.late_entries is not None
        assert after.late_entries is not None
        assert after.longest_lateness_ns is not None
        assert after.late_entries > before.late_entries
        assert after.longest_lateness_ns > MS


def test_thirty_two_servers_share_a_core(tmp_path: Path) -> None:
    slots = [((number * MS, (number + 1) * MS),) for number in range(32)]
    with freezer(tmp_path, 40 * MS, *slots) as back_end:
        back_end.arm(0)
        time.sleep(1.5)
        opened = [counters.slots for counters in back_end.counters().values()]
        assert back_end.failure() is None
        assert min(opened) > 10  # type: ignore[type-var, operator]
        assert max(opened) - min(opened) <= 3  # type: ignore[type-var, operator]


def test_boundaries_without_room_between_them_leave_it_a_sign_of_life(tmp_path: Path) -> None:
    slots = [((number * MS // 4, (number + 1) * MS // 4),) for number in range(8)]
    with sleeping() as pid, freezer(tmp_path, 2 * MS, *slots) as back_end:
        back_end.arm(0)
        time.sleep(1.5)
        back_end.assign(pid, "server-3")  # and it answers
        assert back_end.failure() is None


def test_where_a_frozen_thread_was_tells_whether_it_wanted_to_run(tmp_path: Path) -> None:
    with own_cgroup("overrun") as home, stamping(tmp_path, 20) as spinner, sleeping() as sleeper:
        folders, threads = {}, {}
        for name, pid in (("busy", spinner.tid), ("idle", sleeper)):
            (home / "cgroup.procs").write_text(str(pid))
            folders[name] = cgroups.make_threaded_child(home, name)
            cgroups.move_thread(pid, folders[name])
            threads[name] = os.open(folders[name] / "cgroup.threads", os.O_RDONLY)
        wait_for(lambda: overrun([threads["busy"]]) is None, "it to run")
        for folder in folders.values():
            (folder / "cgroup.freeze").write_text("1")
            wait_for(lambda: frozen(folder), "the freezer")  # noqa: B023
        assert overrun([threads["busy"]]) is True
        assert overrun([threads["idle"]]) is False
        assert overrun([threads["idle"], threads["busy"]]) is True
        for folder in folders.values():
            assert cgroups.dissolve(folder) is None
        assert overrun(threads.values()) is False, "the groups are gone"
        for file in threads.values():
            os.close(file)


def test_what_it_writes_to_is_on_no_disk(tmp_path: Path) -> None:
    """A store to a page that is being written back would wait for the disk."""
    with freezer(tmp_path, CYCLE, ((0, 5 * MS),)) as back_end:
        maps = Path(f"/proc/{dispatcher_of(back_end)}/maps").read_text().splitlines()
        shared = [
            line for line in maps if line.split()[1].startswith("rw") and "s" in line.split()[1]
        ]
        assert len(shared) == 1
        assert "/memfd:counters" in shared[0]
