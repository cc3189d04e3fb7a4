"""What killed runs leave beside outputs is named or removed; never what lives, or is of others."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_line import chainshaper

from chainshaper.values.leftovers import claimed, clear_leftovers, leftover_text, leftovers

_WRITER = """
import sys, time
from pathlib import Path
from chainshaper.values.files import folder_beside
with folder_beside(Path(sys.argv[1])) as made:
    Path(made, "content").write_text("some")
    print(made, flush=True)
    time.sleep(1000)
"""


def older(*folders: Path) -> None:
    """As if they had been made a minute ago."""
    for folder in folders:
        os.utime(folder, (time.time() - 60,) * 2)


def writing(output: Path) -> tuple[subprocess.Popen[str], Path]:
    """A process that writes an output, and the folder that it fills."""
    process = subprocess.Popen(
        [sys.executable, "-c", _WRITER, str(output)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    made = Path(process.stdout.readline().strip())
    older(made)
    return process, made


def test_of_a_killed_run_and_not_of_one_that_goes_on(tmp_path: Path) -> None:
    lives, filled = writing(tmp_path / "r")
    dies, left = writing(tmp_path / "r")
    try:
        assert leftovers(tmp_path) == []
        dies.send_signal(signal.SIGKILL)
        dies.wait()
        assert leftovers(tmp_path) == leftovers(tmp_path, "r") == [left]
        assert leftovers(tmp_path, "other") == []
        removed, stays = clear_leftovers(tmp_path)
        assert (len(removed), stays) == (1, [])
        assert str(left) in removed[0]
        assert not left.exists()
        assert (filled / "content").read_text() == "some"
    finally:
        lives.kill()
        lives.wait()


def test_what_only_looks_like_it_stays(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "content").write_text("mine")
    (tmp_path / ".r.partial-link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / ".r.partial-file").write_text("a file")
    young, traced, plain = (tmp_path / f".r.{n}" for n in ("partial-1", "tracing-2", "partials"))
    for folder in (young, traced, plain):
        folder.mkdir()
    older(traced, plain)
    removed, stays = clear_leftovers(tmp_path)
    assert removed == []
    assert stays == [leftover_text(traced)]
    assert "chainshaper info" in stays[0]
    assert len(list(tmp_path.iterdir())) == 6
    assert (tmp_path / "elsewhere" / "content").exists()
    with claimed(traced):
        assert leftovers(tmp_path) == []
    older(young)
    assert leftovers(tmp_path) == [young, traced]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder to another user")
def test_another_users_folder_is_not_ours_to_remove(tmp_path: Path) -> None:
    theirs = tmp_path / ".r.partial-1"
    theirs.mkdir()
    older(theirs)
    os.chown(theirs, 12345, 12345)
    assert leftovers(tmp_path) == []


def test_record_names_what_stands_beside_its_output(tmp_path: Path) -> None:
    left = tmp_path / ".rec.tracing-abc"
    left.mkdir()
    older(left)
    if shutil.which("true") is None:
        pytest.skip("no program to record")
    said = chainshaper("record", "-o", tmp_path / "rec", "--source", "preload", "--", "true")
    assert f"{left} was left by a run that was killed" in said.err
    assert left.exists()
