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
from cores import cores

from chainshaper.values.files import scratch_folder
from chainshaper.values.leftovers import claimed, clear_leftovers, leftover_text, leftovers

_FOLDER_WRITER = """
import sys, time
from pathlib import Path
from chainshaper.values.files import folder_beside
with folder_beside(Path(sys.argv[1])) as made:
    Path(made, "content").write_text("some")
    print(made, flush=True)
    time.sleep(1000)
"""
_FILE_WRITER = """
import sys, time
from pathlib import Path
from chainshaper.values.files import write_whole
output = Path(sys.argv[1])
def parts():
    yield b"half"
    print(*output.parent.glob(f".{output.name}.*"), flush=True)
    time.sleep(1000)
write_whole(output, parts())
"""
_SCRATCH_WRITER = """
import time
from chainshaper.values.files import scratch_folder
with scratch_folder() as made:
    (made / "content").write_text("some")
    print(made, flush=True)
    time.sleep(1000)
"""


def older(*paths: Path) -> None:
    """As if they had been made a minute ago."""
    for path in paths:
        os.utime(path, (time.time() - 60,) * 2)


def writing(
    output: Path, writer: str = _FOLDER_WRITER, **variables: str
) -> tuple[subprocess.Popen[str], Path]:
    """A process that writes an output, and the hidden folder or file that it fills."""
    process = subprocess.Popen(
        [sys.executable, "-c", writer, str(output)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **variables},
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


def test_a_hidden_file_of_a_killed_run_is_named_and_removed_and_not_one_that_is_written(
    tmp_path: Path,
) -> None:
    lives, filled = writing(tmp_path / "plan.yaml", _FILE_WRITER)
    dies, left = writing(tmp_path / "page.html", _FILE_WRITER)
    try:
        assert leftovers(tmp_path) == []
        dies.kill()
        dies.wait()
        assert leftovers(tmp_path) == leftovers(tmp_path, "page.html") == [left]
        removed, stays = clear_leftovers(tmp_path)
        assert (len(removed), stays) == (1, [])
        assert [*tmp_path.iterdir()] == [filled]
    finally:
        lives.kill()
        lives.wait()


def test_release_removes_what_killed_runs_left_among_temporary_files_and_in_the_cache(
    tmp_path: Path,
) -> None:
    """A sweep simulates in a folder there: it stood for ever when the sweep was killed."""
    temporary, cache, here = (tmp_path / name for name in ("tmp", "cache", "here"))
    for folder in (temporary, cache / "chainshaper", here):
        folder.mkdir(parents=True)
    dies, left = writing(here, _SCRATCH_WRITER, TMPDIR=str(temporary))
    lives, filled = writing(here, _SCRATCH_WRITER, TMPDIR=str(temporary))
    dies.kill()
    dies.wait()
    built = cache / "chainshaper" / ".preload-1.partial-a1"
    built.mkdir()
    older(left, built)
    try:
        with cores():  # a timed test beside this may have a crashed run, for which it looks
            said = subprocess.run(
                [sys.executable, "-m", "chainshaper", "release", "--crashed"],
                cwd=here,
                env={**os.environ, "TMPDIR": str(temporary), "XDG_CACHE_HOME": str(cache)},
                capture_output=True,
                text=True,
                check=False,
            )
        assert [*temporary.iterdir()] == [filled], said
        assert [*built.parent.iterdir()] == []
        assert str(built) in said.stdout
    finally:
        lives.kill()
        lives.wait()


def test_the_next_scratch_folder_removes_that_of_a_killed_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dies, left = writing(tmp_path, _SCRATCH_WRITER, TMPDIR=str(tmp_path))
    dies.kill()
    dies.wait()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with scratch_folder() as made:
        assert not left.exists()
        assert [*tmp_path.iterdir()] == [made]
    assert [*tmp_path.iterdir()] == []


def test_what_only_looks_like_it_stays(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "content").write_text("mine")
    (tmp_path / ".r.partial-link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / ".r.partial-file").write_text("a file")
    older(tmp_path / ".r.partial-file")
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


def test_an_output_may_have_any_name(tmp_path: Path) -> None:
    """A line feed ended the name, so that nothing named or removed what was left."""
    output = os.fsdecode(b"out\xfc)\n")
    left = tmp_path / f".{output}.partial-cz82e5z1"
    file = tmp_path / f".{output}.html.partial-0123abcd"
    left.mkdir()
    file.write_text("half")
    older(left, file)
    assert leftovers(tmp_path, output) == [left]
    removed, stays = clear_leftovers(tmp_path)
    assert (len(removed), stays, [*tmp_path.iterdir()]) == (2, [], [])


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
