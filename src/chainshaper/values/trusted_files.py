"""Whose files may run here: those that only root and the user of this process can change.

This is what ssh asks of its keys. A folder above may be writable by others where its sticky bit
keeps them from replacing what is in it, as in /tmp.
"""

import grp
import os
import pwd
import stat
from pathlib import Path

__all__ = ["why_distrusted"]


def why_distrusted(path: str | Path) -> str | None:
    """Why others may change a file, a folder or what leads there; None if they cannot.

    A name that others wrote is in the reason: it is shown as any other.
    """
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
    return (
        user.pw_gid == gid and group.gr_name == user.pw_name and {*group.gr_mem} <= {user.pw_name}
    )
