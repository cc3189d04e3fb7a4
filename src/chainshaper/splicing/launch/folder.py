"""The folder that spliced launch files stand in: whole or absent, and known as ours.

A manifest, `splice.json`, names every file with its hash, so that the folder can be replaced or
removed again as long as nobody has changed it. What running and building leave there does not
count as a change: Python's caches, logs of the shaping nodes, colcon's folders.
"""

import hashlib
import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.whole_file import open_to_all

__all__ = ["LOGS", "NODES", "Manifest", "new_folder", "original_of", "remove_folder", "usable"]

MANIFEST = "splice.json"
NODES = "shaping_nodes"
LOGS = "logs"
_FORMAT = 1
_DERIVED = {LOGS, *(f"{NODES}/{name}" for name in ("build", "install", "log"))}
_AWKWARD = "\"'\\$&<>#\n\r\t"


@dataclass(frozen=True)
class Manifest:
    """What was written: the original of each copy, and the hash of each file (SHA-256).

    Into copies that have a throttler, ``throttled``, a plan is spliced as into any other file.
    """

    copies: Mapping[str, str]
    files: Mapping[str, str]
    throttled: bool = False


def usable(folder: Path) -> Path:
    """The absolute path of the folder to write, once it is sure that nothing would be lost.

    Raises:
        InputError: it holds something that is not ours, or was changed; its path cannot stand in
            launch files.
    """
    folder = folder.absolute()
    if any(character in str(folder) for character in _AWKWARD):
        raise InputError(
            f"{folder}: launch files could not name this folder, because of one of {_AWKWARD[:9]}"
            " in its path: choose another"
        )
    if not folder.parent.is_dir():
        raise InputError(f"{folder.parent}: no such folder to write {folder.name} into")
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        _refuse_changed(folder, "not overwritten: name another, or remove it")
    return folder


def _refuse_changed(folder: Path, consequence: str) -> None:
    manifest = _manifest(folder)
    if manifest is None:
        raise InputError(
            f"{folder} was not written by `chainshaper splice`, so it is {consequence}"
        )
    found = _hashes(folder)
    changed = sorted(
        name for name, digest in found.items() if manifest.files.get(name, "") != digest
    )
    if changed:
        raise InputError(
            f"{folder}: {', '.join(changed)} was changed or added since it was written, so it is"
            f" {consequence}"
        )


def _manifest(folder: Path) -> Manifest | None:
    try:
        values = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        if values["format"] == _FORMAT:
            throttled = bool(values.get("throttled"))
            return Manifest(dict(values["copies"]), dict(values["files"]), throttled)
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return None


def _hashes(folder: Path) -> dict[str, str]:
    """The hash of every file that counts, by its path below the folder."""
    found: dict[str, str] = {}
    for path in folder.rglob("*"):
        name = path.relative_to(folder)
        derived = "__pycache__" in name.parts or not _DERIVED.isdisjoint(map(str, name.parents))
        if path.is_file() and not derived and str(name) != MANIFEST:
            found[str(name)] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def original_of(file: Path, *, throttled: bool = False) -> Path:
    """The launch file that a copy of ours was made from; any other file is its own original.

    With ``throttled`` a copy that has a throttler is an original too.
    """
    manifest = _manifest(file.absolute().parent)
    if manifest is None or file.name not in manifest.copies or (throttled and manifest.throttled):
        return file
    return original_of(Path(manifest.copies[file.name]), throttled=throttled)


@contextmanager
def new_folder(folder: Path, copies: dict[str, str], *, throttled: bool = False) -> Iterator[Path]:
    """A folder to fill, which takes the place of ``folder`` when all went well.

    ``copies`` is to be filled as well: the original of each copy of a launch file.

    Raises:
        OperationError: it cannot be written; nothing is left behind, an older one stays.
    """
    partial: Path | None = None
    try:
        partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.partial-", dir=folder.parent))
        yield partial
        (partial / LOGS).mkdir()
        files = _hashes(partial)
        manifest = {
            "format": _FORMAT,
            "throttled": throttled,
            "copies": copies,
            "files": files,
        }
        (partial / MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
        open_to_all(partial)
        older = _manifest(folder)
        if (
            older is None
            or (older.copies, older.files) != (copies, files)
            or _hashes(folder) != files
        ):
            _replace(folder, partial)
    except OSError as error:
        raise OperationError(f"{folder}: cannot be written: {error}") from error
    finally:
        if partial is not None and partial.exists():
            shutil.rmtree(partial, ignore_errors=True)


def _replace(folder: Path, new: Path) -> None:
    """Put a new folder in the place of an older one of ours, which comes back if that fails."""
    if not folder.exists():
        new.rename(folder)
        return
    aside = Path(tempfile.mkdtemp(prefix=f".{folder.name}.older-", dir=folder.parent))
    folder.rename(aside)
    try:
        new.rename(folder)
    except OSError:
        aside.rename(folder)
        raise
    shutil.rmtree(aside, ignore_errors=True)


def remove_folder(folder: Path) -> None:
    """Remove a folder of ours, all of it or nothing.

    Raises:
        InputError: it is not ours, or something in it was changed or added since.
        OperationError: it cannot be removed.
    """
    folder = folder.absolute()
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, so there is nothing to undo")
    _refuse_changed(folder, "not removed: move away what you need, and remove the rest")
    try:
        aside = Path(tempfile.mkdtemp(prefix=f".{folder.name}.older-", dir=folder.parent))
        folder.rename(aside)
        shutil.rmtree(aside)
    except OSError as error:
        raise OperationError(f"{folder}: cannot be removed: {error}") from error
