"""Runs: the journal on disk before anything is changed, and since when each governs whom."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
from applied_plans import needs_fifo
from gated import needs_cgroups
from known import known
from processes import wait_for
from small_chain import EXECUTOR_CORE, small_chain_plan, small_chain_text
from strangers import needs_root, open_folder, strange

from chainshaper import measure_latency, open_recording, save_plan
from chainshaper.enforcement import journal as module
from chainshaper.enforcement.journal import (
    Governed,
    Journal,
    LockHolder,
    all_runs_locked,
    discard_journal,
    find_journals,
    governing,
    in_force_throughout,
    journals_folder,
    locked,
    open_journal,
    process_of,
    remembered_journal,
)
from chainshaper.enforcement.servers import ServerCounters
from chainshaper.enforcement.undoing import (
    PATIENCE_S,
    RunState,
    ServerState,
    claim_run,
    find_runs,
    remove_run,
    save_run_state,
)
from chainshaper.planning import ChainPlan, Plan
from chainshaper.values.errors import OperationError, PlatformError

pytestmark = pytest.mark.timed

__all__ = ["open_folder"]


def paths(journal: Journal) -> list[str]:
    return [entry["path"] for entry in journal.entries("cgroup")]


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    return open_journal(tmp_path, "run")


def test_what_is_noted_can_be_read_back_in_order(tmp_path: Path) -> None:
    journal = open_journal(tmp_path / "new" / "folder", "run")
    journal.note("cgroup", path="/sys/fs/cgroup/a", type="domain")
    journal.note("plugin", previous="Linux")
    journal.note("cgroup", *({"path": str(number)} for number in range(2)))
    again = Journal(journal.path)
    kinds = [entry["kind"] for entry in again.entries()]
    assert kinds == ["opened", "cgroup", "plugin", "cgroup", "cgroup"]
    assert paths(again) == ["/sys/fs/cgroup/a", "0", "1"]
    assert (again.owner, again.outdated) == (os.getpid(), False)
    for path in (journal.path, journal.path.parent):
        assert path.stat().st_mode & 0o077 == 0, "its owner alone may read it"


def test_a_line_that_a_crash_cut_off_is_left_out_and_spoils_nothing_behind_it(
    journal: Journal,
) -> None:
    journal.note("cgroup", path="a")
    whole = journal.path.read_bytes()
    line = json.dumps({"kind": "cgroup", "path": "b"}).encode()
    for end in range(len(line) + 1):
        journal.path.write_bytes(whole + line[:end])
        assert paths(journal) == ["a"]
    journal.note("cgroup", path="c")
    assert paths(journal) == ["a", "c"]


@pytest.mark.parametrize("line", ["hello", "[1]", '"kind"', "{}", '{"path": 1}'])
def test_what_is_no_line_of_a_journal_is_passed_over_and_named(journal: Journal, line: str) -> None:
    with journal.path.open("a") as stream:
        stream.write(line + "\n")
    journal.note("cgroup", path="b")
    assert [entry["kind"] for entry in journal.entries()] == ["opened", "cgroup"]
    known = {"opened": process_of, "cgroup": lambda entry: entry["path"]}
    assert list(journal.strange_lines(known)) == [(2, line)]
    _, (number, _) = journal.strange_lines({"opened": process_of})
    assert number == 3, "of no kind that is known"
    assert journal.read("cgroup", lambda entry: entry["type"]) == (), "it has no such field"
    assert journal.owner == os.getpid()


def test_a_journal_whose_folder_is_removed_stays_known_to_those_who_have_it_open(
    journal: Journal,
) -> None:
    journal.note("cgroup", path="a")
    shutil.rmtree(journal.path.parent)
    assert paths(journal) == ["a"]
    assert Journal(journal.path).entries() == ()
    journal.note("cgroup", path="b")
    assert paths(Journal(journal.path)) == ["a", "b"]
    shutil.rmtree(journal.path.parent)
    assert journal.keep()
    assert paths(Journal(journal.path)) == ["a", "b"]
    assert journal.path.stat().st_mode & 0o077 == 0


def test_a_second_journal_of_the_same_run_is_refused_and_one_from_before_a_boot_has_no_owner(
    journal: Journal, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(OperationError, match="exists: that run is going on, or has crashed"):
        open_journal(tmp_path, "run")
    monkeypatch.setattr(module, "boot_id", lambda: "another boot")
    assert journal.outdated
    assert journal.owner is None


def test_a_full_disk_is_named_before_anything_is_changed(full_disk: Path) -> None:
    with pytest.raises(OperationError, match="No space left on device"):
        journal = open_journal(full_disk, "run")
        for _ in range(10_000):
            journal.note("cgroup", path="a" * 1000)


def test_a_journal_whose_owner_was_killed_is_nobodys(tmp_path: Path) -> None:
    program = (
        "import os, signal, sys\n"
        "from chainshaper.enforcement.journal import open_journal\n"
        "open_journal(sys.argv[1], 'killed').note('cgroup', path='a')\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=False)
    (journal,) = find_journals(tmp_path)
    assert (journal.name, journal.owner, paths(journal)) == ("killed", None, ["a"])


def test_discarding_removes_the_file_and_its_folder_unless_there_is_more(tmp_path: Path) -> None:
    for others in (False, True):
        journal = open_journal(tmp_path, "run")
        folder = journal.path.parent
        if others:
            (folder / "counters").touch()
        other = remembered_journal(journal.path)
        discard_journal(journal)
        discard_journal(journal)
        assert not other.keep(), "nor is it written again"
        assert other.entries() == ()
        assert folder.exists() is others
        assert find_journals(tmp_path) == ()


def test_journals_lie_where_they_vanish_with_the_boot(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert journals_folder() == Path("/run/chainshaper")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/1000")
    assert journals_folder() == Path("/run/user/1000/chainshaper")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    with pytest.raises(PlatformError, match="XDG_RUNTIME_DIR is not set"):
        journals_folder()


MS = 1_000_000


def _run(folder: Path, name: str, in_force_ns: int | None) -> Journal:
    """A run that governs this very process."""
    journal = open_journal(folder, name)
    server = ServerState("chain", 0, 1, ((0, 1),), (os.getpid(),), "freezer", ServerCounters())
    which = (name, os.getpid(), "plan.yaml", (), "freezer", "")
    state = RunState(*which, 0, 10, servers=(server,), in_force_ns=in_force_ns)
    save_run_state(journal.path.parent, state)
    return journal


def test_who_governs_a_process_is_seen_and_when_it_ended(tmp_path: Path) -> None:
    mine = {os.getpid()}
    assert governing(mine, 1, folder=tmp_path) == ()
    journal = _run(tmp_path, "one", in_force_ns=100)
    (journal.path.parent / "plan.json").write_text('{"chain": 1}')
    assert governing({1}, 150, folder=tmp_path) == (), "other processes are"
    seen = governing(mine, 150, folder=tmp_path)
    assert seen == (Governed("one", 100, 150, None, {"chain": 1}),)
    _run(tmp_path, "not yet", in_force_ns=None)
    assert len(governing(mine, 160, seen, tmp_path)) == 1
    # It says that it ends; or is gone without a word.
    ((_, state),) = [one for one in find_runs(tmp_path) if one[0].path == journal.path]
    save_run_state(journal.path.parent, replace(known(state), ended_ns=190))
    assert governing(mine, 200, seen, tmp_path)[0].until_ns == 190
    remove_run(journal)
    (gone,) = governing(mine, 300, seen, tmp_path)
    assert (gone.until_ns, gone.seen_ns) == (150, 150)


def test_of_several_plans_the_time_counts_in_which_all_were_in_force() -> None:
    early = Governed("a", 100, 500, 200, {"plan": "a"})
    whole = Governed("b", 150, 500, None, {"plan": "b"})
    later = Governed("c", 300, 500, 450, {"plan": "c"})
    assert in_force_throughout(()) is None
    for runs, expected in (
        ((early,), (100, 200, {"plan": "a"})),
        ((early, whole), (150, 200, None)),
        ((early, later), (300, 450, {"plan": "c"})),  # one after the other
        ((whole, later), (300, 450, None)),
    ):
        found = known(in_force_throughout(runs))
        assert (found.since_ns, found.until_ns, found.plan) == expected


@needs_fifo
@needs_cgroups
def test_applied_and_released_in_the_midst_of_a_recording(tmp_path: Path) -> None:
    """Cycles before and behind leave as they are ready, those between in the slot."""
    application, file = tmp_path / "app.yaml", tmp_path / "plan.yaml"
    application.write_text(small_chain_text(publication="asynchronous"))
    plan = _asynchronous_plan()
    save_plan(Plan.of(plan), file)
    command = [sys.executable, "-m", "chainshaper"]
    output = tmp_path / "rec"
    run = [*command, "run", str(application), "-o", str(output), "--cycles", "160"]
    recorder = subprocess.Popen(run, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    words = [*command, "apply", str(file), "--backend", "freezer", "--wait", "20s"]
    governor = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        said: list[str] = []
        while not said or (said[-1] and not said[-1].startswith("in force with freezer")):
            said.append(known(governor.stderr).readline())
        assert said[-1], said
        time.sleep(2)
        governor.send_signal(signal.SIGINT)
        assert governor.wait(timeout=30) == 0
        _, problems = recorder.communicate(timeout=60)
        assert recorder.returncode == 0, problems
    finally:
        for process in (governor, recorder):
            process.kill()
            process.wait()
    recording = open_recording(output)
    spell = known(recording.info.in_force)
    assert known(recording.info.plan)["chain"] == plan.model_dump(mode="json")["chain"]
    measured = measure_latency(recording)
    starts = measured.analysis.traversals["start"]
    assert 0 < len(starts) < 160
    assert (starts >= spell.since_ns).all()
    assert (starts < known(spell.until_ns)).all()
    assert min(measured.left_out.before_ns, measured.left_out.after_ns) > 0
    # In force, no output leaves before the slot: that is 2 ms behind the timer at the earliest.
    shortest = known(measured.analysis.statistics.min_ns)
    assert shortest > 25 * MS - 3 * MS
    unknown = recording.info.model_copy(update={"in_force": None})
    whole = measure_latency(replace(recording, info=unknown))
    assert (whole.analysis.statistics.min_ns or 0) < shortest
    assert measured.prediction is not None
    assert measured.prediction.mean.measured_ns is not None


def _asynchronous_plan() -> ChainPlan:
    return small_chain_plan(
        4 * MS, 24 * MS, publication="asynchronous", publish_slot_ns=10 * MS, core=EXECUTOR_CORE
    )


def _never(holder: LockHolder | None, waited_s: float) -> None:
    raise AssertionError((holder, waited_s))


def test_a_lock_that_was_removed_is_not_taken(tmp_path: Path) -> None:
    """Who waits for the lock of a folder that is made anew waits for the new one."""
    seen: list[LockHolder | None] = []

    def waiting(holder: LockHolder | None, _: float) -> None:
        seen.append(holder)
        if len(seen) == 2:
            stack.close()

    with ExitStack() as stack:
        stack.enter_context(all_runs_locked(tmp_path, _never))
        with all_runs_locked(tmp_path, waiting):
            (lock,) = tmp_path.iterdir()
            assert lock.stat().st_mode & 0o777 == 0o700
    assert [one and one.pid for one in seen] == [os.getpid()] * 2
    assert list(tmp_path.iterdir()) == []


def test_each_holder_is_waited_for_by_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two processes have the lock one after the other: the wait for the second begins anew."""
    first, second = (LockHolder(pid, 1, os.geteuid()) for pid in (4_000_001, 4_000_002))
    waits: dict[LockHolder | None, list[float]] = {first: [], second: []}
    monkeypatch.setattr(
        module, "_holder_of", lambda _: second if max([0.0, *waits[first]]) > 0.3 else first
    )

    def waiting(holder: LockHolder | None, waited_s: float) -> None:
        waits[holder].append(waited_s)
        if holder == second:
            stack.close()

    with ExitStack() as stack:
        stack.enter_context(locked(tmp_path, _never))
        with locked(tmp_path, waiting):
            assert max(waits[first]) > 0.3 > waits[second][0]


@needs_root
def test_a_stranger_that_has_the_folder_locked_is_not_waited_for(open_folder: Path) -> None:
    program = (
        "import fcntl, os, sys, time\n"
        "fcntl.flock(os.open(sys.argv[1], os.O_RDONLY), fcntl.LOCK_EX); time.sleep(60)\n"
    )
    # The folder of all runs is there for everybody to read, so everybody can lock it.
    with strange(["/usr/bin/python3", "-c", program, str(open_folder)]) as stranger:
        lock = f" {stranger.pid} "
        wait_for(lambda: lock in Path("/proc/locks").read_text(), "the stranger to have it locked")
        refused = rf"process {stranger.pid} of another user \(nobody"
        with pytest.raises(OperationError, match=refused), locked(open_folder, _never):
            pass
        begun = time.monotonic()
        open_folder.chmod(0o755)
        claim_run({0}, {"/n"}, open_folder)
        assert time.monotonic() - begun < PATIENCE_S / 2
        assert stranger.poll() is None


_UNDOES = """
import os, sys
from pathlib import Path
from chainshaper.enforcement import undoing
from chainshaper.enforcement.journal import find_journals
undoing.PATIENCE_S = 0.4
(journal,) = find_journals(sys.argv[1])
print(journal.path.parent.stat().st_ino, flush=True)
print(undoing.undo_run(journal), flush=True)
"""
_HAS_LOCKED = (
    "import fcntl, os, sys, time\n"
    "fcntl.flock(os.open(sys.argv[1], os.O_RDONLY), fcntl.LOCK_EX); print(flush=True)\n"
    "time.sleep(60)\n"
)


@needs_root
def test_undoing_ends_who_hangs_with_the_lock_and_no_stranger(tmp_path: Path) -> None:
    """A stranger has a file of the same number locked, on another device."""
    program = """
set -e
mkdir runs others
mount -t tmpfs none runs; mount -t tmpfs none others
"$0" -c "from chainshaper.enforcement.journal import open_journal; open_journal('runs', 'crashed')"
wanted=$(stat -c %i runs/crashed)
touch others/x
while [ "$(stat -c %i others/x)" != "$wanted" ]; do
    [ "$(stat -c %i others/x)" -lt "$wanted" ]; mv others/x others/$RANDOM$RANDOM; touch others/x
done
"$0" -c "$2" others/x & stranger=$!
"$0" -c "$2" runs/crashed & hangs=$!
while [ $(grep -c "FLOCK.*:$wanted " /proc/locks) -lt 2 ]; do sleep 0.05; done
"$0" -c "$1" runs
kill -0 $stranger && echo "the stranger lives"; kill $stranger
kill -0 $hangs 2>/dev/null || echo "who hung was ended"
[ -z "$(ls -A runs)" ] && echo "undone"
"""
    words = ["unshare", "--mount", "bash", "-c", program, sys.executable, _UNDOES, _HAS_LOCKED]
    done = subprocess.run(words, capture_output=True, check=False, cwd=tmp_path, text=True)
    _, *said = filter(None, done.stdout.split("\n"))
    assert said == ["()", "the stranger lives", "who hung was ended", "undone"], done
