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
def folder(tmp_path: Path) -> Path:
    """A package with a kernel."""
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "__init__.py").touch()
    (tmp_path / "made" / "summing.py").write_text(_KERNEL.format(more=""))
    return tmp_path


def called(folder: Path, **environment: str) -> str:
    path = os.pathsep.join((str(folder), str(Path(chainshaper.__file__).parents[1])))
    named = {"PYTHONPATH": path, "XDG_CACHE_HOME": str(folder / "cache"), **environment}
    command = [sys.executable, "-c", _CALL]
    found = subprocess.run(
        command, env={**os.environ, **named}, capture_output=True, text=True, check=False
    )
    assert found.returncode == 0, (found.returncode, found.stderr)
    return found.stdout.strip()


def test_the_compiler_is_needed_once_and_again_when_the_source_changed(folder: Path) -> None:
    assert called(folder) == "10 [ 1  3  6 10] True"
    assert called(folder) == "10 [ 1  3  6 10] False"
    (folder / "made" / "summing.py").write_text(_KERNEL.format(more="+ 1"))
    assert called(folder) == "11 [ 1  3  6 10] True"
    assert len(list((folder / "made" / "__pycache__").glob("*.o"))) == 1


def test_code_goes_to_the_users_cache_where_the_package_cannot_be_written(folder: Path) -> None:
    (folder / "made" / "__pycache__").touch()  # a file, which takes no other
    assert called(folder).endswith("True")
    assert len(list((folder / "cache" / "chainshaper").glob("made.summing.total-*.o"))) == 1
    assert called(folder).endswith("False")


def test_without_any_folder_every_process_compiles(folder: Path) -> None:
    (folder / "made" / "__pycache__").touch()
    (folder / "cache").touch()
    assert called(folder) == called(folder) == "10 [ 1  3  6 10] True"


def cut_in_half(file: Path) -> None:
    os.truncate(file, file.stat().st_size // 2)


def altered(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def emptied(file: Path) -> None:
    file.write_bytes(b"")


def of_an_older_source(file: Path) -> None:
    """Whole, and ours, but not what its new name says."""
    (file.parents[1] / "summing.py").write_text(_KERNEL.format(more="+ 5"))
    loading._digest.cache_clear()
    file.rename(file.with_name(f"made.summing.total-{loading._digest(file.parents[1])}.o"))


def writable_by_others(file: Path) -> None:
    file.chmod(0o666)


def in_a_folder_of_others(file: Path) -> None:
    file.parent.chmod(0o777)


def of_another_user(file: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("giving a file to another user needs root")
    os.chown(file, NOBODY, -1)


@pytest.mark.parametrize(
    "spoil",
    [
        *(cut_in_half, altered, emptied, of_an_older_source),
        *(writable_by_others, in_a_folder_of_others, of_another_user),
    ],
)
def test_code_that_is_not_as_we_wrote_it_is_made_anew(
    folder: Path, spoil: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
    assert compiles_here(monkeypatch)
    assert not compiles_here(monkeypatch)
    spoil(next((folder / "made" / "__pycache__").glob("*.o")))
    assert compiles_here(monkeypatch)
    assert not compiles_here(monkeypatch)


def compiles_here(monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether a process that begins here and now, so to speak, needs the compiler."""
    with monkeypatch.context() as patched:
        for name in ("made", "made.summing"):
            patched.delitem(sys.modules, name, raising=False)
        importlib.invalidate_caches()
        loading._digest.cache_clear()
        compiler = mock.Mock(wraps=loading._compiled)
        patched.setattr(loading, "_compiled", compiler)
        numbers = np.arange(1, 5)
        assert loading.kernel.__wrapped__("made.summing", "total")(numbers.ctypes.data, 4) >= 10
        assert numbers.tolist() == [1, 3, 6, 10]
    return compiler.called


@pytest.mark.skipif(os.geteuid() != 0, reason="another user's folder needs root")
def test_root_runs_no_code_from_the_cache_of_another_user(folder: Path) -> None:
    """`sudo -E` keeps XDG_CACHE_HOME and HOME; what lies there may be anybody's program."""
    (folder / "made" / "__pycache__").touch()
    assert called(folder).endswith("True")
    cache = folder / "cache"
    planted = next((cache / "chainshaper").glob("*.o"))
    for place in (cache, cache / "chainshaper", planted):
        os.chown(place, NOBODY, -1)
    before = planted.read_bytes(), planted.stat().st_mtime_ns
    own = Path(pwd.getpwuid(0).pw_dir, ".cache", "chainshaper", planted.name)
    own.unlink(missing_ok=True)
    try:
        assert called(folder) == "10 [ 1  3  6 10] True"
        assert own.exists()
        assert (planted.read_bytes(), planted.stat().st_mtime_ns) == before
        # The same by HOME, and by a link of theirs that leads to ours.
        (folder / ".cache").symlink_to("cache")
        os.chown(folder / ".cache", NOBODY, -1, follow_symlinks=False)
        planted.write_bytes(b"evil")
        assert called(folder, XDG_CACHE_HOME="", HOME=str(folder)) == "10 [ 1  3  6 10] False"
    finally:
        own.unlink(missing_ok=True)
