"""Control groups of version 2, as far as stopping single threads needs them.

``cgroup.freeze`` stops every thread in a group on its way back to user space. A **threaded** group
has some threads of a process, if all groups that share it lie in one *threaded domain*: so it is
made directly beneath their present one, and keeps every limit.

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

Without it whoever moves a process to another group (a service manager, a container engine) waits
for a grace period of RCU, 10 to 30 ms, and blocks freezing meanwhile: a slot opens so much later.
"""
_BEFORE = "trusted.chainshaper.mount"
"""Attribute of the hierarchy's root: its mount options before runs of ours. All of these share it,
and none can lose it: it is in the kernel's memory, as the option is."""
_REMOUNT = 32
_MOUNT_FLAGS = {"rw": 0, "ro": 1, "nosuid": 2, "nodev": 4, "noexec": 8}
_MOUNT_FLAGS |= {"noatime": 1 << 10, "nodiratime": 1 << 11, "relatime": 1 << 21}
"""Of mount(2); an option that is none of them is the file system's own."""
_OCTAL = re.compile(rb"\\([0-3][0-7]{2})")
"""Blanks, line feeds, backslashes and number signs in names of mount points."""
_ATTEMPTS = 3
_THREADED_CONTROLLERS = {"cpu", "cpuset", "perf_event", "pids"}
_REMEDY = (
    "run as root, or start the application in a group that is yours "
    "(`systemd-run --user --scope`, or a unit with Delegate=yes)"
)


def mount_point() -> Path:
    """Where the version 2 hierarchy is mounted. Raises PlatformError: it is not."""
    return _mount()[0]


def mount_options() -> str:
    """The options of that mount. Raises PlatformError: there is none."""
    return _mount()[1]


def _mount() -> tuple[Path, str]:
    # Beside version 1 hierarchies it usually stands at /sys/fs/cgroup/unified.
    for line in filter(None, lines_of(read_proc(MOUNTS))):
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
    """Have the hierarchy mounted with these options, if the kernel knows and permits them."""
    names = options.split(",")
    flags = _REMOUNT | sum(_MOUNT_FLAGS.get(name, 0) for name in names)
    own = ",".join(name for name in names if name not in _MOUNT_FLAGS)
    folder = os.fsencode(mount_point())
    ctypes.CDLL(None).mount(b"none", folder, b"cgroup2", ctypes.c_ulong(flags), os.fsencode(own))


def make_moves_quick() -> None:
    """Have the hierarchy mounted with :data:`QUICK_MOVES` besides what it has."""
    if not moves_are_quick():
        before = mount_options()
        with contextlib.suppress(OSError):  # without the privilege there is no remounting either
            os.setxattr(mount_point(), _BEFORE, os.fsencode(before))
            remount(f"{before},{QUICK_MOVES}")


def restore_mount() -> None:
    """Undo :func:`make_moves_quick`, where a run of ours did it; harmless when repeated."""
    with contextlib.suppress(OSError):  # none did
        before = os.fsdecode(os.getxattr(mount_point(), _BEFORE))
        if moves_are_quick():
            remount(before)
        os.removexattr(mount_point(), _BEFORE)


def cgroup_of(tid: int) -> Path:
    """The folder of a thread's group. Raises OperationError: no thread. PlatformError: hidden."""
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
    """Make an empty threaded group directly beneath the group of the threads it is for. Raises
    OperationError: the name is taken. PlatformError: machine or privileges do not allow it.
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
    """What stands in the way of threaded groups: the kernel only says EOPNOTSUPP."""
    controllers = set(_read(parent / "cgroup.subtree_control").split()) - _THREADED_CONTROLLERS
    found = [f"it hands the controllers {', '.join(sorted(controllers))} down"] * bool(controllers)
    for child in sorted(parent.iterdir()):
        kind = _read(child / "cgroup.type").strip()
        if kind == "domain" and "populated 1" in _read(child / "cgroup.events"):
            found.append(f"its child {child.name} holds processes of its own")
    remedy = "run the application in a group of its own (a scope or unit)"
    return f": {found[0]}; {remedy}" if found else None


def move_thread(tid: int, folder: Path) -> bool:
    """Put a thread into a group; False when it has ended. Raises PlatformError, OperationError."""
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
    """The living threads of a group that can be seen from our process namespace."""
    return tuple(int(tid) for tid in _read(folder / "cgroup.threads").split() if tid != "0")


def has_unseen_threads(folder: Path) -> bool:
    """Whether there are others."""
    return "0" in _read(folder / "cgroup.threads").split()


def dissolve(folder: Path, within_s: float = 1.0) -> str | None:
    """Have a group's threads run in its parent, and remove it; what is left is said, not raised."""
    with contextlib.suppress(OSError):
        (folder / "cgroup.freeze").write_text("0")
    deadline = time.monotonic() + within_s
    reason = ""
    while folder.is_dir():
        # Again: children are born meanwhile, and a dying process holds its group a little longer.
        for tid in threads_in(folder):
            try:
                # Moving to a group that is not frozen thaws, whatever became of cgroup.freeze.
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
    """Put this process into a group of that name, out of reach of what befalls its present one, if
    it need not stay there, as in a container.
    """
    for folder in (folder for folder in _own_groups(name) for _ in range(_ATTEMPTS)):
        with contextlib.suppress(OSError):  # the last to leave may just be removing it
            folder.mkdir(exist_ok=True)
            (folder / "cgroup.procs").write_text(str(os.getpid()))
            return


def leave_own_group(name: str) -> None:
    """Go back to the group above, and remove ours if it is empty then."""
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
    """Where a group of ours may be, the best first: above our present one, and not beneath one with
    processes, which could have no threaded children then.
    """
    try:
        root, own = mount_point(), cgroup_of(os.getpid())
    except (OperationError, PlatformError):
        return []
    above = [folder for folder in (own, *own.parents) if folder.is_relative_to(root)]
    return [
        folder / name
        for folder in reversed(above)
        if not (folder / "cgroup.type").exists()  # the machine's own root, where all is allowed
        or (folder != own and not _read(folder / "cgroup.procs").strip())
    ]


def _read(path: Path) -> str:
    try:
        return text_of(read_proc(path))
    except OSError:  # gone, or a file that this kind of group does not have
        return ""
