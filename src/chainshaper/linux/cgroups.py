"""Control groups of version 2, as far as stopping single threads needs them.

``cgroup.freeze`` stops every thread in a group on its way back to user space. A **threaded** group
may have some threads of a process only, if all groups that share the process are in the same
*threaded domain*. So it is made directly beneath the threads' present group, whose limits hold on.

Upstream: Documentation/admin-guide/cgroup-v2.rst of the kernel, "Threads" and "Mounting".
"""

import contextlib
import ctypes
import errno
import os
import re
import time
from pathlib import Path

from chainshaper.linux.threads import lines_of, read_proc
from chainshaper.values.errors import OperationError, PlatformError, text_of

MOUNTS = Path("/proc/mounts")
QUICK_MOVES = "favordynmods"
"""A mount option since Linux 6.0.

Without it, moving a process to another group, as service managers and container engines do, waits
for a grace period of RCU, 10 to 30 ms. Freezing waits as well meanwhile, so a slot opens later.
"""
_BEFORE = "trusted.chainshaper.mount"
"""An extended attribute of the hierarchy's root, with its mount options before the first run.

All runs share it. It is in the kernel's memory, so it lasts as long as the mount option.
"""
_REMOUNT = 32
_MOUNT_FLAGS = {"rw": 0, "ro": 1, "nosuid": 2, "nodev": 4, "noexec": 8}
_MOUNT_FLAGS |= {"noatime": 1 << 10, "nodiratime": 1 << 11, "relatime": 1 << 21}
"""Flags of mount(2), by option; all other options are the file system's."""
_OCTAL = re.compile(rb"\\([0-3][0-7]{2})")
"""How blanks, line feeds, backslashes and number signs are written in names of mount points."""
_ATTEMPTS = 3  # at entering a group that another process may be removing
_THREADED_CONTROLLERS = {"cpu", "cpuset", "perf_event", "pids"}
_REMEDY = (
    "run as root, or start the application in a group that is yours "
    "(`systemd-run --user --scope`, or a unit with Delegate=yes)"
)


def mount_point() -> Path:
    """Return where the version 2 hierarchy is mounted. Raises PlatformError: it is not."""
    return _mount()[0]


def mount_options() -> str:
    """Return its mount options. Raises PlatformError: it is not mounted."""
    return _mount()[1]


def _mount() -> tuple[Path, str]:
    """Return mount point and options; beside version 1 it is usually /sys/fs/cgroup/unified."""
    for line in lines_of(read_proc(MOUNTS)):
        _, folder, kind, options, *_ = line.split(b" ")
        if kind == b"cgroup2":
            folder = _OCTAL.sub(lambda escaped: bytes([int(escaped[1], 8)]), folder)
            return Path(os.fsdecode(folder)), os.fsdecode(options)
    raise PlatformError(
        "no cgroup v2 hierarchy is mounted here, so threads cannot be frozen: "
        "`mount -t cgroup2 none /sys/fs/cgroup/unified`"
    )


def moves_are_quick() -> bool:
    """Whether the hierarchy is mounted with :data:`QUICK_MOVES`."""
    return QUICK_MOVES in mount_options().split(",")


def remount(options: str) -> None:
    """Mount the hierarchy with these options, if the kernel knows and permits them."""
    names = options.split(",")
    flags = _REMOUNT | sum(_MOUNT_FLAGS.get(name, 0) for name in names)
    of_file_system = ",".join(name for name in names if name not in _MOUNT_FLAGS)
    ctypes.CDLL(None).mount(
        b"none",
        os.fsencode(mount_point()),
        b"cgroup2",
        ctypes.c_ulong(flags),
        os.fsencode(of_file_system),
    )


def make_moves_quick() -> None:
    """Add :data:`QUICK_MOVES` to the hierarchy's mount options."""
    if not moves_are_quick():
        before = mount_options()
        with contextlib.suppress(OSError):  # who may not write the attribute may not remount either
            os.setxattr(mount_point(), _BEFORE, os.fsencode(before))
            remount(f"{before},{QUICK_MOVES}")


def restore_mount() -> None:
    """Undo :func:`make_moves_quick`, if a run has called it; harmless when repeated."""
    with contextlib.suppress(OSError):  # there is no attribute: no run has
        before = os.fsdecode(os.getxattr(mount_point(), _BEFORE))
        if moves_are_quick():
            remount(before)
        os.removexattr(mount_point(), _BEFORE)


def cgroup_of(tid: int) -> Path:
    """Return the folder of a thread's group.

    Raises OperationError: there is no such thread. PlatformError: the group is not visible here.
    """
    try:
        lines = lines_of(read_proc(f"/proc/{tid}/cgroup"))
    except OSError:
        raise OperationError(f"there is no thread {tid}: it has ended, or never was") from None
    path = next((os.fsdecode(line[3:]) for line in lines if line.startswith(b"0::")), "")
    root = mount_point()
    folder = root / path.lstrip("/")
    # A thread outside our cgroup namespace shows as "/../…", or as a path that is not here.
    if not path or ".." in folder.parts or not folder.is_dir():
        raise PlatformError(
            f"thread {tid} is in the cgroup {path or '(none)'}, which is not to be seen under "
            f"{root}: run on the host, or in the thread's own container"
        )
    return folder


def make_threaded_child(parent: Path, name: str) -> Path:
    """Make an empty threaded group directly beneath the group of the threads it is for.

    Raises OperationError: the name is taken. PlatformError: machine or privileges do not allow it.
    """
    folder = parent / name
    try:
        folder.mkdir()
    except FileExistsError:
        raise OperationError(f"{folder} exists already: `chainshaper release` removes it") from None
    except OSError as error:
        raise PlatformError(
            f"no cgroup can be made in {parent} ({error.strerror}): {_REMEDY}"
        ) from error
    try:
        (folder / "cgroup.type").write_text("threaded")
    except OSError as error:
        folder.rmdir()
        raise PlatformError(
            f"threads of the cgroup {parent} cannot be frozen one by one"
            f"{_obstacle(parent) or f' ({error.strerror}): {_REMEDY}'}"
        ) from error
    return folder


def _obstacle(parent: Path) -> str | None:
    """Say why a group can have no threaded children, for which the kernel only says EOPNOTSUPP."""
    obstacles = []
    controllers = set(_read(parent / "cgroup.subtree_control").split()) - _THREADED_CONTROLLERS
    if controllers:
        obstacles.append(f"it hands the controllers {', '.join(sorted(controllers))} down")
    for child in sorted(parent.iterdir()):
        kind = _read(child / "cgroup.type").strip()
        if kind == "domain" and "populated 1" in _read(child / "cgroup.events"):
            obstacles.append(f"its child {child.name} holds processes of its own")
    remedy = "run the application in a group of its own (a scope or unit)"
    return f": {obstacles[0]}; {remedy}" if obstacles else None


def move_thread(tid: int, folder: Path) -> bool:
    """Put a thread into a group; return False if it has ended.

    Raises PlatformError: we may not. OperationError: the kernel refuses for another reason.
    """
    try:
        (folder / "cgroup.threads").write_text(str(tid))
    except ProcessLookupError:
        return False
    except OSError as error:
        refused = f"thread {tid} cannot be moved to the cgroup {folder} ({error.strerror})"
        if error.errno in {errno.EACCES, errno.EPERM, errno.EROFS}:
            raise PlatformError(f"{refused}: {_REMEDY}") from error
        raise OperationError(f"{refused}: is it the kernel's, or has it been moved?") from error
    return True


def threads_in(folder: Path) -> tuple[int, ...]:
    """Return the living threads of a group, without those that our pid namespace does not show."""
    return tuple(int(tid) for tid in _read(folder / "cgroup.threads").split() if tid != "0")


def has_unseen_threads(folder: Path) -> bool:
    """Whether a group has threads that our pid namespace does not show (the kernel writes 0)."""
    return "0" in _read(folder / "cgroup.threads").split()


def dissolve(folder: Path, within_s: float = 1.0) -> str | None:
    """Move a group's threads to its parent, where they run, and remove it.

    Returns what is left, in words; None: nothing. This raises no exception.
    """
    with contextlib.suppress(OSError):
        (folder / "cgroup.freeze").write_text("0")
    deadline = time.monotonic() + within_s
    reason = ""
    while folder.is_dir():
        # Again and again: threads start meanwhile, and a process that ends keeps its group a while.
        for tid in threads_in(folder):
            try:
                # In a group that is not frozen a thread runs, even if thawing has failed.
                move_thread(tid, folder.parent)
            except (OperationError, PlatformError) as error:
                reason = str(error)
        try:
            folder.rmdir()
        except FileNotFoundError:
            return None
        except OSError as error:
            reason = reason or os.strerror(error.errno or 0)
            if time.monotonic() > deadline:
                return f"the cgroup {folder} is left behind: {reason}"
            time.sleep(0.001)
    return None


def enter_own_group(name: str) -> None:
    """Move this process to a group of that name, so that ending its present group spares it.

    It stays where it is if it may not leave, as in a container.
    """
    for folder in _own_groups(name):
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(OSError):  # a process that leaves it may be removing it
                folder.mkdir(exist_ok=True)
                (folder / "cgroup.procs").write_text(str(os.getpid()))
                return


def leave_own_group(name: str) -> None:
    """Move this process to the group above, and remove the group of that name if it is empty."""
    with contextlib.suppress(OSError, OperationError, PlatformError):
        folder = cgroup_of(os.getpid())
        if folder.name == name:
            (folder.parent / "cgroup.procs").write_text(str(os.getpid()))
            folder.rmdir()


def remove_own_group(name: str) -> None:
    """Remove the group of that name, unless other processes are in it."""
    for folder in _own_groups(name):
        with contextlib.suppress(OSError):
            folder.rmdir()


def _own_groups(name: str) -> list[Path]:
    """Return where a group of that name for this process may be, the best place first.

    It is above the present group, and its parent has no processes, since that could have no
    threaded children then.
    """
    try:
        root, present = mount_point(), cgroup_of(os.getpid())
    except (OperationError, PlatformError):
        return []
    above = [folder for folder in (present, *present.parents) if folder.is_relative_to(root)]
    return [
        folder / name
        for folder in reversed(above)
        if not (folder / "cgroup.type").exists()  # the machine's root, where all is allowed
        or (folder != present and not _read(folder / "cgroup.procs").strip())
    ]


def _read(path: Path) -> str:
    """Read a file of a group; empty: there is none."""
    try:
        return text_of(read_proc(path))
    except OSError:  # gone, or a file that this kind of group does not have
        return ""
