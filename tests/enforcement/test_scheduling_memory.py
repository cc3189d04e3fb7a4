"""Threads of others get a class and cores, and get back what they had: whatever happens."""

import ctypes
import os
import random
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest
from actors import Actor, acting
from known import known
from processes import wait_for

from chainshaper.enforcement import journal as journal_module
from chainshaper.enforcement.journal import Journal, find_journals, open_journal
from chainshaper.enforcement.scheduling_memory import (
    change_all,
    look_alikes,
    note_descendants,
    release_threads,
    remembered_threads,
)
from chainshaper.linux.scheduling import (
    SchedulingRequest,
    SchedulingState,
    available_cores,
    may_use_fifo,
    set_state,
    state_of,
)
from chainshaper.linux.threads import RESET_ON_FORK, Reservation, find_thread, list_threads
from chainshaper.values.errors import OperationError

pytestmark = [
    pytest.mark.timed,
    pytest.mark.skipif(
        not may_use_fifo(),
        reason="SCHED_FIFO is not permitted here: run as root to have this tested",
    ),
]

FIRST, LAST = available_cores()[0], available_cores()[-1]
WANTED = SchedulingRequest(30, (LAST,))


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    return open_journal(tmp_path / "journals", "run")


def _states(actor: Actor) -> dict[str, SchedulingState]:
    return {name: state_of(tid) for name, tid in actor.tids.items()}


def test_class_and_cores_are_changed_and_put_back(tmp_path: Path, journal: Journal) -> None:
    with acting(tmp_path, "a", "b") as actor:
        os.sched_setscheduler(actor.tids["a"], os.SCHED_RR | RESET_ON_FORK, os.sched_param(7))
        os.setpriority(os.PRIO_PROCESS, actor.tids["b"], 5)
        before = _states(actor)
        change_all(journal, [(actor.thread("a"), WANTED)])
        change_all(
            journal, [(actor.thread("b"), SchedulingRequest(31, (FIRST,), takes_turns=True))]
        )
        a, b = state_of(actor.tids["a"]), state_of(actor.tids["b"])
        assert (a.scheduling_class.policy, a.scheduling_class.priority) == (os.SCHED_FIFO, 30)
        assert (b.scheduling_class.policy, b.scheduling_class.priority) == (os.SCHED_RR, 31)
        assert (a.cores, b.cores) == ((LAST,), (FIRST,))
        for _ in range(2):
            release_threads(journal)
            assert _states(actor) == before


def test_several_changes_go_back_to_what_was_there_at_first_but_what_is_others_stays(
    tmp_path: Path, journal: Journal
) -> None:
    theirs = (os.SCHED_RR, 5)
    with acting(tmp_path, "a", "b", "c", "ending") as actor:
        before, ended = _states(actor), actor.thread("ending")

        def wish(name: str, priority: int | None, *cores: int) -> None:
            change_all(journal, [(actor.thread(name), SchedulingRequest(priority, cores or None))])

        for wanted in ((30, LAST), (None, FIRST), (12,)):
            wish("a", *wanted)
        wish("b", 30, LAST)
        wish("c", 30, LAST)
        for name in "bc":
            os.sched_setscheduler(actor.tids[name], theirs[0], os.sched_param(theirs[1]))
        wish("c", 40)  # what they set between two changes is what was there
        change_all(journal, [(ended, WANTED)])
        actor.end("ending")
        change_all(journal, [(ended, WANTED)])
        release_threads(journal)
        after = {name: state_of(actor.tids[name]) for name in "abc"}
        assert after["a"] == before["a"]
        for name in "bc":
            now = after[name].scheduling_class
            assert (now.policy, now.priority) == theirs
            assert after[name].cores == before[name].cores, "the cores were ours still"
    release_threads(journal)


def test_a_thread_that_got_the_id_of_one_that_ended_is_not_touched(
    tmp_path: Path, journal: Journal
) -> None:
    with acting(tmp_path, "a") as actor:
        time.sleep(0.05)  # in ticks of 10 ms: it has not begun after the change, as heirs have
        change_all(journal, [(actor.thread("a"), WANTED)])
        text = journal.path.read_text()
        started = actor.thread("a").started
        journal.path.write_text(text.replace(f'"started": {started}', f'"started": {started - 1}'))
        changed = state_of(actor.tids["a"])
        release_threads(journal)
        assert state_of(actor.tids["a"]) == changed
        journal.path.write_text(text)


def test_what_threads_inherited_goes_back_to_what_their_parents_had(
    tmp_path: Path, journal: Journal
) -> None:
    with acting(tmp_path, "early") as actor:
        before = state_of(actor.pid)
        early = state_of(actor.tids["early"])
        time.sleep(0.05)  # starts are counted in ticks of 10 ms
        change_all(journal, [(actor.thread("main"), WANTED)])
        time.sleep(0.05)
        late, changed, own = (actor.begin(name) for name in ("late", "changed", "own"))  # by main
        child = actor.fork()
        for tid in (late, changed, own, child):
            assert state_of(tid).scheduling_class.priority == 30, "the kernel lets it inherit"
        change_all(journal, [(actor.thread("changed"), SchedulingRequest(29, (FIRST,)))])
        os.sched_setscheduler(own, os.SCHED_FIFO, os.sched_param(3))  # by itself, say
        release_threads(journal)
        for tid in (late, changed, child, actor.pid):
            assert state_of(tid) == before
        assert state_of(actor.tids["early"]) == early
        assert state_of(own).scheduling_class.priority == 3


_APPLIER = """
import random, sys, time
from chainshaper.enforcement.journal import open_journal
from chainshaper.linux.scheduling import available_cores
from chainshaper.enforcement.scheduling_memory import change_all
from chainshaper.linux.scheduling import SchedulingRequest
from chainshaper.linux.threads import list_threads

journal = open_journal(sys.argv[2])
cores = available_cores()
print("ready", flush=True)
while True:
    for thread in list_threads(int(sys.argv[1])):
        wanted = SchedulingRequest(random.randint(1, 20), (random.choice(cores),))
        change_all(journal, [(thread, wanted)])
"""


def test_killed_at_any_moment_it_leaves_nothing_that_cannot_be_put_back(tmp_path: Path) -> None:
    names = [f"thread{number}" for number in range(8)]
    with acting(tmp_path, *names) as actor:
        before = _states(actor)
        for attempt in range(6):
            folder = tmp_path / f"journals{attempt}"
            applier = subprocess.Popen(
                [sys.executable, "-c", _APPLIER, str(actor.pid), str(folder)],
                stdout=subprocess.PIPE,
            )
            known(applier.stdout).readline()
            time.sleep(random.uniform(0, 0.1))
            applier.kill()
            applier.communicate()
            (journal,) = find_journals(folder)
            assert journal.owner is None
            release_threads(journal)
            assert _states(actor) == before, f"attempt {attempt}"


def test_nothing_is_changed_when_it_cannot_be_written_down(
    tmp_path: Path, journal: Journal
) -> None:
    with acting(tmp_path, "a") as actor:
        before = _states(actor)
        journal.path.unlink()
        journal.path.mkdir()
        with pytest.raises(OperationError, match=r"so nothing is changed|cannot be read"):
            change_all(journal, [(actor.thread("a"), WANTED)])
        assert _states(actor) == before


def test_what_the_kernel_refuses_names_the_thread_and_what_was_wanted(
    tmp_path: Path, journal: Journal
) -> None:
    with acting(tmp_path, "a") as actor:
        tid = actor.tids["a"]
        with pytest.raises(OperationError, match=rf"thread {tid} \(a\).*SCHED_FIFO 500"):
            change_all(journal, [(actor.thread("a"), SchedulingRequest(500, None))])
        with pytest.raises(OperationError, match=r"cores 1023: Invalid argument"):
            change_all(journal, [(actor.thread("a"), SchedulingRequest(None, (1023,)))])
        before = _states(actor)
        release_threads(journal)
        assert _states(actor) == before


def test_after_a_boot_nothing_is_touched(
    tmp_path: Path, journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    with acting(tmp_path, "a") as actor:
        change_all(journal, [(actor.thread("a"), WANTED)])
        with monkeypatch.context() as another_boot:
            another_boot.setattr(journal_module, "boot_id", lambda: "another")
            release_threads(journal)
        assert state_of(actor.tids["a"]).scheduling_class.priority == 30


def _set_deadline(tid: int) -> bool:
    """Give a thread 1 ms of every 100 ms under SCHED_DEADLINE; False where that is refused."""
    if os.uname().machine != "x86_64":
        return False
    attributes = struct.pack("IIQiIQQQ", 48, 6, 0, 0, 0, 1_000_000, 100_000_000, 100_000_000)
    libc = ctypes.CDLL(None, use_errno=True)
    return bool(libc.syscall(314, tid, attributes, 0) == 0)  # sched_setattr


def test_sched_deadline_is_left_and_stays(tmp_path: Path, journal: Journal) -> None:
    with acting(tmp_path, "a", "b") as actor:
        if not _set_deadline(actor.tids["a"]):
            pytest.skip("SCHED_DEADLINE is not permitted here")
        thread = find_thread(actor.tids["a"])
        assert thread is not None
        assert thread.reservation == Reservation(1_000_000, 100_000_000, 100_000_000)
        assert thread.reservation.text == "1ms of 100ms"
        change_all(journal, [(actor.thread("a"), WANTED), (actor.thread("b"), WANTED)])
        assert state_of(actor.tids["a"]).scheduling_class.policy == 6
        assert [change.tid for change in remembered_threads(journal)] == [actor.tids["b"]]
        other = find_thread(actor.tids["b"])
        assert other is not None
        assert other.reservation is None
        release_threads(journal)
        # Somebody may also give it to a thread that we have changed.
        os.sched_setscheduler(actor.tids["a"], os.SCHED_OTHER, os.sched_param(0))
        change_all(journal, [(actor.thread("a"), SchedulingRequest(30, None))])
        assert _set_deadline(actor.tids["a"])
        release_threads(journal)
        assert state_of(actor.tids["a"]).scheduling_class.policy == 6


def test_a_state_can_be_set_as_long_as_a_thread_lives(tmp_path: Path) -> None:
    with acting(tmp_path, "a") as actor:
        tid = actor.tids["a"]
        before = state_of(tid)
        wanted = SchedulingState(before.scheduling_class, 3, (LAST,))
        set_state(tid, wanted)
        assert state_of(tid) == wanted
        actor.process.send_signal(signal.SIGKILL)
        wait_for(lambda: not Path(f"/proc/{actor.pid}/task/{tid}").exists(), "its end")
        with pytest.raises(ProcessLookupError):
            set_state(tid, before)


def test_many_threads_are_written_down_at_once_and_again_only_when_they_change(
    tmp_path: Path, journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[int] = []
    monkeypatch.setattr(os, "fsync", written.append)
    with acting(tmp_path, *(f"t{number}" for number in range(20))) as actor:
        wanted = [(thread, WANTED) for thread in list_threads(actor.pid)]
        change_all(journal, wanted)
        assert len(written) == 1
        change_all(journal, wanted)
        assert len(written) == 1


def test_a_descendant_is_known_by_what_was_written_down_when_its_parent_has_ended(
    tmp_path: Path, journal: Journal
) -> None:
    with acting(tmp_path) as actor:
        before = state_of(actor.pid)
        change_all(journal, [(actor.thread("main"), WANTED)])
        time.sleep(0.05)
        between = actor.fork()  # dies with its parent, unless that is told otherwise
        seen: set[tuple[int, int]] = set()
        for noted in ([], [between], [between]):
            seen = note_descendants(journal, seen)
            assert [entry["pid"] for entry in journal.entries("descendant")] == noted
        assert [entry["pid"] for entry in journal.entries("descendant")] == [between]
        text = journal.path.read_text()
        # As if it had lost its parent: the thread of the journal is another process's.
        journal.path.write_text(text.replace(f'"pid": {actor.pid}, "comm"', '"pid": 1, "comm"'))
        release_threads(journal)
        assert state_of(between) == before


def test_a_stranger_with_all_that_we_gave_is_named_and_left(
    tmp_path: Path, journal: Journal
) -> None:
    (tmp_path / "other").mkdir()
    with acting(tmp_path) as actor, acting(tmp_path / "other") as other:
        time.sleep(0.05)
        change_all(journal, [(actor.thread("main"), WANTED)])
        assert look_alikes(journal) == ()
        with subprocess.Popen(["sleep", "60"]) as stranger:
            set_state(stranger.pid, state_of(actor.pid))
            set_state(other.pid, state_of(actor.pid))  # older
            (named,) = look_alikes(journal)
            assert f"of process {stranger.pid} is left as it is: SCHED_FIFO 30" in named
            release_threads(journal)
            assert state_of(stranger.pid).scheduling_class.priority == 30
            assert state_of(other.pid).scheduling_class.priority == 30
            stranger.kill()
