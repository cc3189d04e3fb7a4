"""What is written in folders of others goes nowhere else, and into nothing that is not ours."""

import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from strangers import NOBODY, needs_root, open_folder

import chainshaper
from chainshaper.enforcement.journal import Journal, discard_journal, open_journal
from chainshaper.flow.sweep import finished_rows
from chainshaper.values.errors import ChainshaperError, InputError
from chainshaper.values.files import (
    folder_beside,
    free_place,
    open_output,
    rename_output,
    write_whole,
)

__all__ = ["open_folder"]

ABOUT = {"chain": "/t1../t5"}
SECRET = b"root:*:19000::::::\n"


def append(path: Path) -> None:
    os.close(open_output(path, os.O_WRONLY | os.O_APPEND))


def rewrite(path: Path) -> None:
    os.close(open_output(path, os.O_WRONLY | os.O_TRUNC))


def make(path: Path) -> None:
    os.close(open_output(path))


def sweep(path: Path) -> None:
    with finished_rows(path, ABOUT):
        pass


def whole(path: Path) -> None:
    write_whole(path, [b"ours"])


WAYS: tuple[Callable[[Path], None], ...] = (append, rewrite, make, sweep)
BY_WAY = pytest.mark.parametrize("write", WAYS, ids=lambda way: way.__name__)


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    file = tmp_path / "secret"
    file.write_bytes(SECRET)
    file.chmod(0o600)
    return file


@BY_WAY
def test_a_link_in_the_place_of_a_file_is_not_followed(
    write: Callable[[Path], None], tmp_path: Path, secret: Path
) -> None:
    (tmp_path / "out").mkdir()
    for target in (secret, tmp_path / "new"):
        place = tmp_path / "out" / f"to {target.name}"
        place.symlink_to(target)
        with pytest.raises((ChainshaperError, FileExistsError)):
            write(place)
    assert secret.read_bytes() == SECRET
    assert not (tmp_path / "new").exists()


def test_what_is_written_whole_takes_the_place_of_a_link(tmp_path: Path, secret: Path) -> None:
    (tmp_path / "out").symlink_to(secret)
    assert write_whole(tmp_path / "out", [b"ours"]).read_bytes() == b"ours"
    assert secret.read_bytes() == SECRET
    (tmp_path / "lost").symlink_to(tmp_path / "new")
    with pytest.raises(InputError, match="exists already and is not overwritten"):
        free_place(tmp_path / "lost", taken=False)


@needs_root
@pytest.mark.parametrize("write", [*WAYS, whole], ids=lambda way: way.__name__)
def test_no_link_of_another_user_leads_to_where_we_write(
    write: Callable[[Path], None], open_folder: Path
) -> None:
    (open_folder / "etc").mkdir()
    (open_folder / "mine").symlink_to("etc")
    (open_folder / "theirs").symlink_to("mine")
    os.chown(open_folder / "theirs", NOBODY, NOBODY, follow_symlinks=False)
    with pytest.raises(InputError, match="theirs is a link of nobody, and links of other users"):
        write(open_folder / "theirs" / "file")
    with pytest.raises(InputError, match="theirs is a link of nobody"):
        free_place(open_folder / "theirs" / "file", taken=False)
    assert list((open_folder / "etc").iterdir()) == []
    whole(open_folder / "etc" / ".." / "mine" / "file")
    assert (open_folder / "etc" / "file").read_bytes() == b"ours"


@needs_root
@BY_WAY
def test_nothing_is_written_into_a_file_of_another_or_of_two_names(
    write: Callable[[Path], None], open_folder: Path, tmp_path: Path
) -> None:
    theirs, twice = open_folder / "theirs", open_folder / "twice"
    for file in (theirs, twice):
        file.write_bytes(SECRET)
    os.chown(theirs, NOBODY, NOBODY)
    (open_folder / "again").hardlink_to(twice)
    os.mkfifo(open_folder / "fifo")
    for file in (theirs, twice, open_folder / "fifo"):
        with pytest.raises((ChainshaperError, OSError)):
            write(file)
    assert theirs.read_bytes() == twice.read_bytes() == SECRET


@needs_root
def test_a_folder_that_was_replaced_by_a_link_is_not_put_in_place(open_folder: Path) -> None:
    with folder_beside(open_folder / "recording") as made:
        partial = Path(made)
        (open_folder / "etc").mkdir()
        partial.rename(open_folder / "aside")
        partial.symlink_to("etc")
        os.chown(partial, NOBODY, NOBODY, follow_symlinks=False)
        with pytest.raises(InputError, match=r"is a link of nobody"):
            make(partial / "events.parquet")
        with pytest.raises(InputError, match=r"is a link of nobody"):
            rename_output(partial / "a", open_folder / "b")
        partial.unlink()
    assert list((open_folder / "etc").iterdir()) == []


@pytest.mark.parametrize("mine", [b"my notes, without an end", b'{"chain": "/t1../t', b""])
def test_rows_of_others_stay_and_a_first_line_that_a_crash_cut_is_written_anew(
    tmp_path: Path, mine: bytes
) -> None:
    path = tmp_path / "out.parquet.rows"
    path.write_bytes(mine)
    if b"notes" in mine:
        with pytest.raises(InputError, match="these are no rows of a sweep"):
            sweep(path)
        assert path.read_bytes() == mine
        return
    with finished_rows(path, ABOUT) as (rows, add):
        assert rows == {}
        add(0, {"mean_ns": 1})
    with finished_rows(path, ABOUT) as (rows, _):
        assert rows == {0: {"mean_ns": 1}}


def test_a_journal_that_is_a_link_is_nobodys(tmp_path: Path, secret: Path) -> None:
    journal = open_journal(tmp_path / "runs", "run")
    journal.path.unlink()
    journal.path.symlink_to(secret)
    planted = Journal(journal.path)
    with pytest.raises(ChainshaperError):
        planted.note("cgroup", path="a")
    with pytest.raises(ChainshaperError):
        planted.entries()
    discard_journal(planted)
    assert secret.read_bytes() == SECRET


_OPENS = re.compile(
    r"""(?<![\w.])open\([^)]*["'][wax]|\.open\([^)]*["'][wax]|\.write_(text|bytes)\(|\.touch\("""
    r"""|\bO_CREAT\b|\.tofile\(|\bnp\.save|copyfile\("""
)
_ELSEWHERE = {
    "values/files.py": "opens outputs",
    "linux/cgroups.py": "writes to files of the kernel",
    "enforcement/freezer.py": "writes to files of the kernel",
    "robot/schema_header.py": "is run where the package is built, for a file of the build",
    "sources/preload/events_header.py": "is run where the package is built, as the one above",
    "robot/handover.py": "has memory in a folder of mode 0700, whose owner it checks",
    "robot/python/node.py": "runs in ROS nodes, which have nothing of ours",
    "workload/described_node.py": "the same, and touches a file in a folder that is ours alone",
}


def test_no_other_module_opens_a_file_to_write_into() -> None:
    sources = Path(chainshaper.__file__).parent
    texts = {str(file.relative_to(sources)): file.read_text() for file in sources.rglob("*.py")}
    assert {name for name, text in texts.items() if _OPENS.search(text)} <= {*_ELSEWHERE}
