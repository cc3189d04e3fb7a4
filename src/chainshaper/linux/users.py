"""Which user runs a process, and whose processes a run takes for nodes of its plan.

Every user of the machine can start a process whose command line, threads and environment say what a
node's say. Only the kernel says who runs a process, so a run names users.

A process is a user's when that user both runs it, by all four of its user ids, and has started its
program. `sudo`, `su` and every other set-user-ID program carry the command line and the environment
of another user than the one they run as: they are no user's, until they start another program. Root
may start programs for all. In a user namespace of its own a process has the user id that it has
outside: a stranger stays a stranger. Who is root in a container without one is root here as well.

Upstream: proc(5), credentials(7), getauxval(3), user_namespaces(7).
"""

import os
import pwd
import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress

from chainshaper.linux.threads import read_proc
from chainshaper.values.errors import InputError

_AT_UID = 11
_AUXILIARY = struct.Struct("@NN")


def run_users(named: Collection[str | int] = ()) -> frozenset[int]:
    """The ids of users whose processes a run takes, by their names or numbers.

    By default: who has launched us, also by way of `sudo`, and root. Raises InputError: there is no
    such user.
    """
    if named:
        return frozenset(_user_id(one) for one in named)
    launched = {os.getuid(), os.geteuid(), 0}
    behind_sudo = os.environ.get("SUDO_UID", "")
    if os.geteuid() == 0 and behind_sudo.isdecimal():
        launched.add(int(behind_sudo))
    return frozenset(launched)


def _user_id(named: str | int) -> int:
    if isinstance(named, int) or named.isdecimal():
        return int(named)
    try:
        return pwd.getpwnam(named).pw_uid
    except KeyError:
        raise InputError(
            f"no user is named {named!r} on this machine: give a name of `getent passwd`, or a "
            "number"
        ) from None


def user_name(user: int | None) -> str:
    """What a user is called here; the number where it has no name."""
    if user is None:
        return "several users"
    with suppress(KeyError):
        return pwd.getpwuid(user).pw_name
    return str(user)


@contextmanager
def process_folder(pid: int) -> Iterator[int]:
    """A process's folder in /proc, open: what is read from it is never another process's.

    Raises OSError: there is no such process.
    """
    folder = os.open(f"/proc/{pid}", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield folder
    finally:
        os.close(folder)


def user_of(pid: int) -> int | None:
    """The user whose process this is; None if it is no single user's, or gone."""
    with suppress(OSError), process_folder(pid) as folder:
        return user_in(folder)
    return None


def user_in(folder: int) -> int | None:
    """The same from a process's open folder. Raises OSError: the process has ended."""
    status = read_proc("status", folder)
    line = next(line for line in status.splitlines() if line.startswith(b"Uid:"))
    user, *others = (int(number) for number in line.split()[1:])
    if any(other != user for other in others):
        return None
    started_by = _started_by(folder)
    if started_by is None:
        # It may not be looked at. What is root's by its ids may be a set-user-ID program.
        return None if user == 0 and os.geteuid() == 0 else user
    return user if started_by in (user, 0) else None


def _started_by(folder: int) -> int | None:
    """Who was its real user when it began its program: who chose command line and environment."""
    try:
        auxiliary = read_proc("auxv", folder)
    except OSError:
        return None
    whole = len(auxiliary) - len(auxiliary) % _AUXILIARY.size
    entries = _AUXILIARY.iter_unpack(auxiliary[:whole])
    return next((value for kind, value in entries if kind == _AT_UID), None)
