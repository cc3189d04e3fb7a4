"""Files that may run here, and files that are written whole, and never over another.

Only files that root and the user of this process alone can change may run, as ssh asks of its keys.
A folder above may be writable by others where its sticky bit prevents them from replacing what is
in it, as in /tmp.
"""

import grp
import os
import pwd
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.leftovers import claimed


def why_distrusted(path: str | Path) -> str | None:
    """Why others may change a file, a folder or what leads there; None if they cannot."""
    place = Path(os.path.realpath(path))
    for part in (place, *place.parents):
        try:
            state = part.lstat()
        except OSError as error:
            return f"{part}: {error.strerror}"
        if state.st_uid not in (0, os.geteuid()):
            return f"{part} belongs to {_user(state.st_uid)}"
        if part != place and state.st_mode & stat.S_ISVTX:
            continue
        of_group = state.st_mode & stat.S_IWGRP and not _is_own_group(state.st_gid, state.st_uid)
        if of_group or state.st_mode & stat.S_IWOTH:
            return f"{part} is writable by others than {_user(state.st_uid)}"
    return None


def own_cache() -> Path:
    """Our folder in the user's cache, which need not be there; links to it are followed.

    Where the cache that the environment names is another user's (`sudo -E`), it is our own.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not cache.is_absolute():  # and is to be ignored, as its specification has it
        cache = Path(os.path.expanduser("~/.cache"))  # noqa: PTH111 - the other raises without one
    existing = next(place for place in (cache, *cache.parents) if os.path.exists(place))  # noqa: PTH110
    if why_distrusted(existing) is not None:
        with suppress(KeyError):  # a user without a name
            cache = Path(pwd.getpwuid(os.geteuid()).pw_dir, ".cache")
    return Path(os.path.realpath(cache / "chainshaper"))


def _user(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"user {uid}"


def _is_own_group(gid: int, uid: int) -> bool:
    """Whether a group is its user's own and has no other member, as Debian makes one for each."""
    try:
        user, group = pwd.getpwuid(uid), grp.getgrgid(gid)
    except KeyError:
        return False
    own = user.pw_gid == gid and group.gr_name == user.pw_name
    return own and {*group.gr_mem} <= {user.pw_name}


def free_place(path: Path, taken: bool) -> Path:
    """The path, if it is not ``taken`` and its folder is there; asked before long work begins.

    Raises InputError: it is taken, or its folder does not exist.
    """
    if taken:
        raise InputError(
            f"{path} exists already and is not overwritten: name another, or remove it"
        )
    if not (folder := path.absolute().parent).is_dir():
        raise InputError(f"{folder}: no such folder to write {path.name} into")
    return path


def new_file(path: str | Path, endings: tuple[str, ...] = ()) -> Path:
    """The path, once it is sure that a file of this kind can be made there.

    Raises InputError: as :func:`free_place`, or it ends in none of ``endings``, if there are any.
    """
    path = Path(path)
    if endings and path.suffix not in endings:
        raise InputError(f"{path}: write to a file that ends in {' or '.join(endings)}")
    return free_place(path, path.exists())


def write_whole(path: Path, parts: Iterable[bytes]) -> Path:
    """Write beside the final place, then rename.

    Raises OperationError: it cannot be written; nothing is left behind.
    """
    partial: Path | None = None
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.partial-", dir=path.absolute().parent)
        partial = Path(name)
        with os.fdopen(handle, "wb") as stream:
            stream.writelines(parts)
            stream.flush()
            os.fsync(stream.fileno())
            os.fchmod(stream.fileno(), 0o644)  # the name may be a link of a folder's owner by now
        partial.rename(path)
    except BaseException as error:  # Ctrl-C among them
        if partial is not None:
            partial.unlink(missing_ok=True)
        if not isinstance(error, OSError):
            raise
        raise OperationError(f"{path}: the file cannot be written: {error.strerror}") from error
    return path


@contextmanager
def folder_beside(path: Path) -> Iterator[str]:
    """A new folder to fill, and to rename to ``path``; if it is not, it is gone at the end."""
    name, parent = f".{path.name}.partial-", path.absolute().parent
    new = tempfile.TemporaryDirectory(prefix=name, dir=parent, ignore_cleanup_errors=True)
    with new as made, claimed(Path(made)):
        yield made


def open_to_all(folder: Path) -> None:
    """Let everybody read a folder that we have made; never what a link in its place leads to.

    Raises OSError: it is no folder any more.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        os.fchmod(descriptor, 0o755)
    finally:
        os.close(descriptor)
