"""Check which files may be run, and write files whole, and never over another.

A file may be run only if nobody but root and the user of this process can change it, as ssh asks of
its keys. A folder above it may be writable by others if its sticky bit prevents them from replacing
what is in it, as in /tmp.

Output may be asked for in a folder of another user (`sudo chainshaper record`). That user may put a
link where a file of ours will be, or where a folder of ours was. So all output is opened here:
links of other users are not followed, and nothing is written into a file that is not ours.
"""

import errno
import grp
import os
import pwd
import secrets
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.leftovers import claim, claimed, clear_leftovers


def why_distrusted(path: str | Path) -> str | None:
    """Say why others may change a file or folder, or what leads there; None: they cannot."""
    real = Path(os.path.realpath(path))
    for part in (real, *real.parents):
        try:
            state = part.lstat()
        except OSError as error:
            return f"{part}: {error.strerror}"
        if state.st_uid not in (0, os.geteuid()):
            return f"{part} belongs to {_user(state.st_uid)}"
        if part != real and state.st_mode & stat.S_ISVTX:
            continue
        group_writes = (state.st_mode & stat.S_IWGRP) != 0
        if group_writes and _is_private_group(state.st_gid, state.st_uid):
            group_writes = False
        if group_writes or state.st_mode & stat.S_IWOTH:
            return f"{part} is writable by others than {_user(state.st_uid)}"
    return None


def own_cache() -> Path:
    """Return chainshaper's folder in the user's cache, which need not exist; links are followed.

    Where others may change the cache that the environment names (`sudo -E`), it is in the home of
    our own user.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not cache.is_absolute():  # to be ignored, as its specification says
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


def _is_private_group(gid: int, uid: int) -> bool:
    """Whether a group has a user as its only member, such as Debian makes for each user."""
    try:
        user, group = pwd.getpwuid(uid), grp.getgrgid(gid)
    except KeyError:
        return False
    if user.pw_gid != gid or group.gr_name != user.pw_name:
        return False
    return set(group.gr_mem) <= {user.pw_name}


_LONGEST_FILE = 512 << 20  # bytes
SCRATCH = "chainshaper"
"""The name from which the names of :func:`scratch_folder` are made."""
_FOLDER = os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


def open_regular(path: Path) -> int:
    """Open a file that another user's process has named. Raises OSError: it is no ordinary file."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(f"{path} is no ordinary file")
    return descriptor


def read_regular(path: Path, longest: int = _LONGEST_FILE) -> bytes:
    """Read a file that another user's process has named.

    Raises OSError: it is no ordinary file, or longer than ``longest`` bytes.
    """
    with os.fdopen(open_regular(path), "rb") as file:
        content = file.read(longest + 1)
    if len(content) > longest:
        raise OSError(f"{path} has more than {longest} bytes")
    return content


_MOST_LINKS = 40  # as many as the kernel follows


def open_folder(folder: Path) -> int:
    """Open a folder that something is to be written into, following links of root and our user.

    Raises InputError: a link of another user leads there. OSError: there is no such folder.
    """
    links, parts = 0, [*reversed(folder.absolute().parts)]
    opened = [os.open(parts.pop(), _FOLDER)]
    try:
        while parts:
            part = parts.pop()
            flags = os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC
            opened.append(os.open(part, flags, dir_fd=opened[-1]))
            state = os.fstat(opened[-1])
            if not stat.S_ISLNK(state.st_mode):
                continue
            if state.st_uid not in (0, os.geteuid()):
                raise InputError(
                    f"{folder}: {part} is a link of {_user(state.st_uid)}, and links of other users"
                    " are not followed where we write: name what it leads to"
                )
            if (links := links + 1) > _MOST_LINKS:
                raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
            target = Path(os.readlink("", dir_fd=opened[-1]))
            opened.append(os.open("/", _FOLDER) if target.is_absolute() else os.dup(opened[-2]))
            parts += reversed([name for name in target.parts if name != "/"])
        return os.open(".", _FOLDER, dir_fd=opened[-1])
    finally:
        for descriptor in opened:
            os.close(descriptor)


def open_output(path: Path, flags: int = os.O_WRONLY | os.O_EXCL, mode: int = 0o666) -> int:
    """Open a file to write into; it must be new, unless the ``flags`` of `open` say otherwise.

    Raises InputError: what is there is a link, no ordinary file, or not ours alone; it is left as
    it was. Or as :func:`open_folder`. OSError: as `open`.
    """
    folder = open_folder(path.absolute().parent)
    flags |= os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        try:
            return os.open(path.name, flags | os.O_CREAT | os.O_EXCL, mode, dir_fd=folder)
        except FileExistsError:
            if flags & os.O_EXCL:
                raise
        descriptor = os.open(path.name, flags & ~os.O_TRUNC, dir_fd=folder)
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        raise InputError(f"{path} is a link, and not written through: remove it") from None
    finally:
        os.close(folder)
    state = os.fstat(descriptor)
    if not stat.S_ISREG(state.st_mode) or state.st_uid != os.geteuid() or state.st_nlink > 1:
        os.close(descriptor)
        raise InputError(
            f"{path} is not a file of {_user(os.geteuid())}'s alone, so nothing is written into it:"
            " name another, or remove it"
        )
    if flags & os.O_TRUNC:
        os.ftruncate(descriptor, 0)
    return descriptor


def free_place(path: Path, taken: bool) -> Path:
    """Return the path if something new can be made there; to be asked before long work begins.

    Raises InputError: it is ``taken``, its folder does not exist, or another user's link leads
    there.
    """
    if taken or path.is_symlink():
        raise InputError(
            f"{path} exists already and is not overwritten: name another, or remove it"
        )
    if not (folder := path.absolute().parent).is_dir():
        raise InputError(f"{folder}: no such folder to write {path.name} into")
    with suppress(OSError):  # no permission, which is said when it is written
        os.close(open_folder(folder))
    return path


def new_file(path: str | Path, endings: tuple[str, ...] = ()) -> Path:
    """Return the path if a new file of this kind can be made there.

    Raises InputError: as :func:`free_place`; or it ends in none of ``endings`` (none: all are
    right).
    """
    path = Path(path)
    if endings and path.suffix not in endings:
        raise InputError(f"{path}: write to a file that ends in {' or '.join(endings)}")
    return free_place(path, path.exists())


def write_whole(path: Path, parts: Iterable[bytes]) -> Path:
    """Write a file beside its final place, then rename it.

    Raises OperationError: it cannot be written; nothing is left behind. InputError: as
    :func:`open_folder`.
    """
    name = f".{path.name}.partial-{secrets.token_hex(4)}"
    folder: int | None = None
    try:
        folder = open_folder(path.absolute().parent)  # open, so that nobody can exchange it
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        with os.fdopen(os.open(name, flags, 0o600, dir_fd=folder), "wb") as stream:
            claim(stream.fileno())  # see `leftovers`
            stream.writelines(parts)
            stream.flush()
            os.fsync(stream.fileno())
            os.fchmod(stream.fileno(), 0o644)
            os.rename(name, path.name, src_dir_fd=folder, dst_dir_fd=folder)
    except BaseException as error:  # Ctrl-C among them
        if folder is not None:
            with suppress(OSError):  # it was not made, or it is in its place
                os.unlink(name, dir_fd=folder)
        if not isinstance(error, OSError):
            raise
        raise OperationError(f"{path}: the file cannot be written: {error.strerror}") from error
    finally:
        if folder is not None:
            os.close(folder)
    return path


@contextmanager
def folder_beside(path: Path) -> Iterator[str]:
    """Make a folder to be filled and renamed to ``path``; if it is not renamed, it is removed."""
    name, parent = f".{path.name}.partial-", path.absolute().parent
    new = tempfile.TemporaryDirectory(prefix=name, dir=parent, ignore_cleanup_errors=True)
    with new as made, claimed(Path(made)):
        yield made


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Make a folder for the context, among the machine's temporary ones.

    What killed runs have left there is removed first; `chainshaper release` removes it, too.
    """
    temporary = Path(tempfile.gettempdir()).absolute()
    clear_leftovers(temporary, SCRATCH)
    with folder_beside(temporary / SCRATCH) as made:
        yield Path(made)


def clear_killed_runs(folder: Path) -> tuple[list[str], list[str]]:
    """Remove what killed runs have left in a folder, among temporary files and in our cache.

    Returns what :func:`.clear_leftovers` does.
    """
    removed, stays = clear_leftovers(folder)
    temporary = Path(tempfile.gettempdir()).absolute()
    for elsewhere, output in ((temporary, SCRATCH), (own_cache(), None)):
        if elsewhere.is_dir() and not elsewhere.samefile(folder):
            removed_there, stays_there = clear_leftovers(elsewhere, output)
            removed += removed_there
            stays += stays_there
    return removed, stays


def rename_output(made: Path, path: Path) -> Path:
    """Move what we have made to its final place.

    Raises InputError: as :func:`open_folder`. OSError: as `os.rename`.
    """
    before, folder = open_folder(made.parent), open_folder(path.absolute().parent)
    try:
        os.rename(made.name, path.name, src_dir_fd=before, dst_dir_fd=folder)
    finally:
        os.close(before)
        os.close(folder)
    return path


def open_to_all(folder: Path) -> None:
    """Let everybody read a folder that we have made.

    Raises OSError: it is no folder any more, such as a link that somebody has put in its place.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        os.fchmod(descriptor, 0o755)
    finally:
        os.close(descriptor)
