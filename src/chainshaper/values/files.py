"""Files that may run here, and files that are written whole, and never over another.

Only files that root and the user of this process alone can change may run, as ssh asks of its keys.
A folder above may be writable by others where its sticky bit prevents them from replacing what is
in it, as in /tmp.

What we write may be asked for in a folder of another user (`sudo chainshaper record`), who may put
a link where a file of ours will be, or a folder of ours was. So all that is written is opened here:
links of other users are not followed, and nothing is written into that was there and is not ours.
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


_LONGEST_FILE = 512 << 20
SCRATCH = "chainshaper"
"""What :func:`scratch_folder` makes folders for: it names them."""
_FOLDER = os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


def open_regular(path: Path) -> int:
    """Open a file that a process of others has named. Raises OSError: no ordinary one."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(f"{path} is no ordinary file")
    return descriptor


def read_regular(path: Path, longest: int = _LONGEST_FILE) -> bytes:
    """The content of such a file. Raises OSError: also if it is longer."""
    with os.fdopen(open_regular(path), "rb") as file:
        content = file.read(longest + 1)
    if len(content) > longest:
        raise OSError(f"{path} has more than {longest} bytes")
    return content


_MOST_LINKS = 40  # as many as the kernel follows


def open_folder(folder: Path) -> int:
    """Open a folder that something is to be written into; only links of root and of our user lead
    there. Raises InputError: another user's does. OSError: there is no such folder.
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
            parts += reversed([one for one in target.parts if one != "/"])
        return os.open(".", _FOLDER, dir_fd=opened[-1])
    finally:
        for descriptor in opened:
            os.close(descriptor)


def open_output(path: Path, flags: int = os.O_WRONLY | os.O_EXCL, mode: int = 0o666) -> int:
    """Open a file to write into, a new one unless the ``flags`` of `open` say otherwise.

    Raises InputError: what is there is a link, no ordinary file, or not ours alone, and nothing of
    it is touched; or as :func:`open_folder`. OSError: as `open`.
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
    """The path, if it is not ``taken`` and its folder is there; asked before long work begins.

    Raises InputError: it is taken, its folder does not exist, or another user's link leads there.
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
    """The path, once it is sure that a file of this kind can be made there.

    Raises InputError: as :func:`free_place`, or it ends in none of ``endings``, if there are any.
    """
    path = Path(path)
    if endings and path.suffix not in endings:
        raise InputError(f"{path}: write to a file that ends in {' or '.join(endings)}")
    return free_place(path, path.exists())


def write_whole(path: Path, parts: Iterable[bytes]) -> Path:
    """Write beside the final place, then rename.

    Raises OperationError: it cannot be written; nothing is left behind. InputError: as
    :func:`open_folder`.
    """
    name = f".{path.name}.partial-{secrets.token_hex(4)}"
    folder: int | None = None
    try:
        folder = open_folder(path.absolute().parent)  # it stays the same, whatever is renamed
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        with os.fdopen(os.open(name, flags, 0o600, dir_fd=folder), "wb") as stream:
            claim(stream.fileno())  # until it has its name
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
    """A new folder to fill, and to rename to ``path``; if it is not, it is gone at the end."""
    name, parent = f".{path.name}.partial-", path.absolute().parent
    new = tempfile.TemporaryDirectory(prefix=name, dir=parent, ignore_cleanup_errors=True)
    with new as made, claimed(Path(made)):
        yield made


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A new folder for a while, among the machine's temporary ones; what a killed run has left of
    its own there, the next one removes, and `chainshaper release`.
    """
    place = Path(tempfile.gettempdir()).absolute()
    clear_leftovers(place, SCRATCH)
    with folder_beside(place / SCRATCH) as made:
        yield Path(made)


def clear_killed_runs(folder: Path) -> tuple[list[str], list[str]]:
    """Remove what killed runs have left in a folder, among temporary files and in our cache, as
    :func:`.clear_leftovers`.
    """
    removed, stays = clear_leftovers(folder)
    for place, name in ((Path(tempfile.gettempdir()).absolute(), SCRATCH), (own_cache(), None)):
        if place.is_dir() and not place.samefile(folder):
            more, still = clear_leftovers(place, name)
            removed += more
            stays += still
    return removed, stays


def rename_output(made: Path, path: Path) -> Path:
    """Put what we have made where it is to be. Raises: as :func:`open_folder`; OSError."""
    before, folder = open_folder(made.parent), open_folder(path.absolute().parent)
    try:
        os.rename(made.name, path.name, src_dir_fd=before, dst_dir_fd=folder)
    finally:
        os.close(before)
        os.close(folder)
    return path


def open_to_all(folder: Path) -> None:
    """Let everybody read a folder that we have made; never what a link in its place leads to.

    Raises OSError: it is no folder any more.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        os.fchmod(descriptor, 0o755)
    finally:
        os.close(descriptor)
