"""The journal: on disk before anything is changed, and readable whatever happened."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from chainshaper.linux import runs as module
from chainshaper.linux.runs import (
    Journal,
    discard_journal,
    find_journals,
    journals_folder,
    open_journal,
    process_of,
    remembered_journal,
)
from chainshaper.values.errors import OperationError, PlatformError


def test_what_is_noted_can_be_read_back_in_order(tmp_path: Path) -> None:
    journal = open_journal(tmp_path, "run")
    journal.note("cgroup", path="/sys/fs/cgroup/a", type="domain")
    journal.note("plugin", previous="Linux")
    journal.note("cgroup", path="/sys/fs/cgroup/b", type="threaded")
    again = Journal(tmp_path / "run" / "journal.jsonl")
    assert [entry["kind"] for entry in again.entries()] == ["opened", "cgroup", "plugin", "cgroup"]
    assert [entry["path"] for entry in again.entries("cgroup")] == [
        "/sys/fs/cgroup/a",
        "/sys/fs/cgroup/b",
    ]
    assert again.owner == os.getpid()
    assert not again.outdated


def test_only_its_owner_may_read_it(tmp_path: Path) -> None:
    journal = open_journal(tmp_path / "new" / "folder", "run")
    assert journal.path.stat().st_mode & 0o077 == 0
    assert journal.path.parent.stat().st_mode & 0o077 == 0


def test_a_line_that_a_crash_cut_off_is_left_out(tmp_path: Path) -> None:
    journal = open_journal(tmp_path, "run")
    journal.note("cgroup", path="a")
    whole = journal.path.read_bytes()
    line = json.dumps({"kind": "cgroup", "path": "b"}).encode()
    for end in range(len(line) + 1):
        journal.path.write_bytes(whole + line[:end])
        assert [entry["path"] for entry in journal.entries("cgroup")] == ["a"]


def test_what_was_cut_off_does_not_spoil_what_is_noted_behind_it(tmp_path: Path) -> None:
    journal = open_journal(tmp_path, "run")
    with journal.path.open("ab") as stream:
        stream.write(b'{"kind": "cgr')
    journal.note("cgroup", path="b")
    assert [entry["path"] for entry in journal.entries("cgroup")] == ["b"]


@pytest.mark.parametrize("line", ["hello", "[1]", '"kind"', "{}", '{"path": 1}'])
def test_what_is_no_line_of_a_journal_is_passed_over_and_named(tmp_path: Path, line: str) -> None:
    journal = open_journal(tmp_path, "run")
    with journal.path.open("a") as stream:
        stream.write(line + "\n")
    journal.note("cgroup", path="b")
    assert [entry["kind"] for entry in journal.entries()] == ["opened", "cgroup"]
    known = {"opened": process_of, "cgroup": lambda entry: entry["path"]}
    assert journal.strange_lines(known) == ((2, line),)
    assert journal.strange_lines({"opened": process_of})[1][0] == 3, "of no kind that is known"
    assert journal.read("cgroup", lambda entry: entry["type"]) == (), "it has no such field"
    assert journal.owner == os.getpid()


def test_many_changes_are_one_write(tmp_path: Path) -> None:
    journal = open_journal(tmp_path, "run")
    journal.note_all("cgroup", ({"path": str(number)} for number in range(3)))
    assert [entry["path"] for entry in journal.entries("cgroup")] == ["0", "1", "2"]


def test_a_journal_whose_folder_is_removed_stays_known_to_those_who_have_it_open(
    tmp_path: Path,
) -> None:
    journal = open_journal(tmp_path, "run")
    journal.note("cgroup", path="a")
    shutil.rmtree(journal.path.parent)
    assert [entry["path"] for entry in journal.entries("cgroup")] == ["a"]
    assert Journal(journal.path).entries() == ()
    journal.note("cgroup", path="b")
    assert [entry["path"] for entry in Journal(journal.path).entries("cgroup")] == ["a", "b"]
    shutil.rmtree(journal.path.parent)
    assert journal.keep()
    assert [entry["path"] for entry in Journal(journal.path).entries("cgroup")] == ["a", "b"]
    assert journal.path.stat().st_mode & 0o077 == 0


def test_a_journal_that_was_discarded_is_not_written_again(tmp_path: Path) -> None:
    journal = open_journal(tmp_path, "run")
    other = remembered_journal(journal.path)
    discard_journal(journal)
    assert not other.keep()
    assert other.entries() == ()
    assert not journal.path.exists()


def test_a_second_journal_of_the_same_run_is_refused(tmp_path: Path) -> None:
    open_journal(tmp_path, "run")
    with pytest.raises(OperationError, match="exists: that run is going on, or has crashed"):
        open_journal(tmp_path, "run")


def test_a_full_disk_is_named_before_anything_is_changed(full_disk: Path) -> None:
    with pytest.raises(OperationError, match="No space left on device"):
        journal = open_journal(full_disk, "run")
        for _ in range(10_000):
            journal.note("cgroup", path="a" * 1000)


def test_a_journal_from_before_the_machine_booted_has_nothing_to_undo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = open_journal(tmp_path, "run")
    monkeypatch.setattr(module, "boot_id", lambda: "another boot")
    assert journal.outdated
    assert journal.owner is None


def test_a_journal_whose_owner_was_killed_is_nobodys(tmp_path: Path) -> None:
    program = (
        "import os, signal, sys\n"
        "from chainshaper.linux.runs import open_journal\n"
        "open_journal(sys.argv[1], 'killed').note('cgroup', path='a')\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=False)
    (journal,) = find_journals(tmp_path)
    assert journal.path.parent.name == "killed"
    assert journal.owner is None
    assert [entry["path"] for entry in journal.entries("cgroup")] == ["a"]


def test_discarding_removes_the_file_and_its_folder_unless_there_is_more(tmp_path: Path) -> None:
    for others in (False, True):
        journal = open_journal(tmp_path, "run")
        folder = journal.path.parent
        if others:
            (folder / "counters").touch()
        discard_journal(journal)
        discard_journal(journal)
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
