"""Machine code that is kept on disk: found again, made anew, and never in the way."""

import importlib
import os
import pwd
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

import chainshaper
from chainshaper.values import compiled as loading

NOBODY = pwd.getpwnam("nobody").pw_uid
EXECUTABLE = sys.executable

_KERNEL = """
from chainshaper.values.compiled.memory import compiled, get, put

@compiled()
def total(table, count):
    sum = 0
    for index in range(count):
        sum += get(table, index)
        put(table, index, sum)
    return sum {more}
"""
_CALL = """
import sys
import numpy as np
from chainshaper.values.compiled import kernel
numbers = np.arange(1, 5)
print(kernel("made.summing", "total")(numbers.ctypes.data, 4), numbers, "numba" in sys.modules)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with a kernel, beside the user's cache."""
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "__init__.py").touch()
    (tmp_path / "made" / "summing.py").write_text(_KERNEL.format(more=""))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path


@pytest.fixture
def compiles(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], bool]:
    """Whether a process that begins here and now, so to speak, needs the compiler."""

    def call() -> bool:
        with monkeypatch.context() as patched:
            for name in ("made", "made.summing"):
                patched.delitem(sys.modules, name, raising=False)
            importlib.invalidate_caches()
            loading._digest.cache_clear()
            if sys.executable == EXECUTABLE:  # a process that imports Numba for each takes its time
                patched.setattr(loading, "_compiled_apart", lambda *_: b"")
            compiler = mock.Mock(wraps=loading.compiled_here)
            patched.setattr(loading, "compiled_here", compiler)
            numbers = np.arange(1, 5)
            assert loading.kernel.__wrapped__("made.summing", "total")(numbers.ctypes.data, 4) >= 10
            assert numbers.tolist() == [1, 3, 6, 10]
        return compiler.called

    return call


def test_the_compiler_runs_once_elsewhere_and_again_when_the_source_changed(
    folder: Path, compiles: Callable[[], bool]
) -> None:
    path = os.pathsep.join((str(folder), str(Path(chainshaper.__file__).parents[1])))
    environment = {**os.environ, "PYTHONPATH": path}
    (folder / "call.py").write_text(_CALL)
    anybodys = folder / "anybodys"  # nothing is imported from where it is called
    anybodys.mkdir()
    (anybodys / "hashlib.py").write_text("raise SystemExit('imported from the current folder')")
    for _ in range(2):
        command = [sys.executable, str(folder / "call.py")]
        found = subprocess.run(
            command, env=environment, cwd=anybodys, capture_output=True, text=True, check=True
        )
        assert found.stdout.strip() == "10 [ 1  3  6 10] False"  # Numba's memory is not ours
    assert not compiles()
    (folder / "made" / "summing.py").write_text(_KERNEL.format(more="+ 1"))
    assert compiles()
    assert len(list((folder / "made" / "__pycache__").glob("*.o"))) == 1


def test_a_process_compiles_itself_where_it_can_start_no_other(
    folder: Path, compiles: Callable[[], bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    for command in ("", "/bin/false"):  # inside another program; one that cannot do it
        monkeypatch.setattr(sys, "executable", command)
        assert compiles()
        next((folder / "made" / "__pycache__").glob("*.o")).unlink()


def test_code_goes_to_the_users_cache_where_the_package_cannot_be_written(
    folder: Path, compiles: Callable[[], bool]
) -> None:
    (folder / "made" / "__pycache__").touch()  # a file, which takes no other
    assert [compiles(), compiles()] == [True, False]
    assert len(list((folder / "cache" / "chainshaper").glob("made.summing.total-*.o"))) == 1


def test_without_any_folder_every_process_compiles(
    folder: Path, compiles: Callable[[], bool]
) -> None:
    (folder / "made" / "__pycache__").touch()
    (folder / "cache").touch()
    assert [compiles(), compiles()] == [True, True]


def altered(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def of_an_older_source(file: Path) -> None:
    """Whole, and ours, but not what its new name says."""
    (file.parents[1] / "summing.py").write_text(_KERNEL.format(more="+ 5"))
    loading._digest.cache_clear()
    file.rename(file.with_name(f"made.summing.total-{loading._digest(file.parents[1])}.o"))


def of_another_user(file: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("giving a file to another user needs root")
    os.chown(file, NOBODY, -1)


SPOILT: dict[str, Callable[[Path], object]] = {
    "cut in half": lambda file: os.truncate(file, file.stat().st_size // 2),
    "altered": altered,
    "emptied": lambda file: file.write_bytes(b""),
    "of an older source": of_an_older_source,
    "writable by others": lambda file: file.chmod(0o666),
    "in a folder of others": lambda file: file.parent.chmod(0o777),
    "of another user": of_another_user,
}


@pytest.mark.parametrize("how", SPOILT)
def test_code_that_is_not_as_we_wrote_it_is_made_anew(
    folder: Path, compiles: Callable[[], bool], how: str
) -> None:
    assert [compiles(), compiles()] == [True, False]
    SPOILT[how](next((folder / "made" / "__pycache__").glob("*.o")))
    assert [compiles(), compiles()] == [True, False]


@pytest.mark.skipif(os.geteuid() != 0, reason="another user's folder needs root")
def test_root_runs_no_code_from_the_cache_of_another_user(
    folder: Path, compiles: Callable[[], bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`sudo -E` keeps XDG_CACHE_HOME and HOME; what lies there may be anybody's program."""
    (folder / "made" / "__pycache__").touch()
    assert compiles()
    cache = folder / "cache"
    planted = next((cache / "chainshaper").glob("*.o"))
    for place in (cache, cache / "chainshaper", planted):
        os.chown(place, NOBODY, -1)
    before = planted.read_bytes(), planted.stat().st_mtime_ns
    own = Path(pwd.getpwuid(0).pw_dir, ".cache", "chainshaper", planted.name)
    own.unlink(missing_ok=True)
    try:
        assert compiles()
        assert own.exists()
        assert (planted.read_bytes(), planted.stat().st_mtime_ns) == before
        # The same by HOME, and by a link of theirs that leads to ours.
        (folder / ".cache").symlink_to("cache")
        os.chown(folder / ".cache", NOBODY, -1, follow_symlinks=False)
        planted.write_bytes(b"evil")
        monkeypatch.setenv("XDG_CACHE_HOME", "")
        monkeypatch.setenv("HOME", str(folder))
        assert not compiles()
    finally:
        own.unlink(missing_ok=True)
