"""Processes that may belong to a ROS 2 or DDS application, found in /proc.

A process takes part in DDS when it has the threads that every participant has, one that receives
or one for timed events, by the names of a DDS implementation. Fast DDS before 2.13 and others do
not name theirs: there a mapped library together with further threads has to do. That tells a node
from what only carries its command line: `ros2 run`, `gdb --args`, or a forked helper (which has
its parent's command line, but none of its parent's threads).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from chainshaper.linux.node_names import takes_ros_arguments
from chainshaper.linux.threads import (
    Thread,
    innermost_id,
    list_threads,
    parents,
    read_proc,
)
from chainshaper.linux.users import process_folder, user_in

__all__ = ["Process", "descendants", "find_applications", "list_processes", "read_process"]

_LIBRARIES_WITHOUT_NAMED_THREADS = (
    b"/libfastrtps.so",
    b"/libfastdds.so",
    b"/libnddscore.so",
    b"/libgurumdds.so",
    b"/librmw_zenoh_cpp.so",
)


@dataclass(frozen=True)
class Process:
    """A process at one instant; ``inner_pid`` is its id in its own pid namespace.

    ``user`` is whose it is, None if no single user's (:mod:`.users`).
    """

    pid: int
    parent: int
    command: tuple[str, ...]
    inner_pid: int
    participates: bool  # in DDS
    threads: tuple[Thread, ...]
    user: int | None = None


def list_processes(pids: Iterable[int] | None = None) -> tuple[Process, ...]:
    """Processes with a command line (kernel threads have none), by id; all if none are given."""
    found = (read_process(pid) for pid in sorted(parents() if pids is None else pids))
    return tuple(process for process in found if process is not None)


def read_process(pid: int) -> Process | None:
    """A process, None when it is gone, dead, or the kernel's own."""
    try:
        with process_folder(pid) as folder:
            user = user_in(folder)
            command = read_proc("cmdline", folder)
            if not command:
                return None
            status = read_proc("status", folder).decode(errors="replace")
            threads = list_threads(pid)
            # It is the same process still, and the same user's: its id is no other's by now.
            if not threads or user_in(folder) != user:
                return None
    except OSError:
        return None
    parent = next(line.split()[1] for line in status.splitlines() if line.startswith("PPid:"))
    return Process(
        pid=pid,
        parent=int(parent),
        command=tuple(command.rstrip(b"\0").decode(errors="replace").split("\0")),
        inner_pid=innermost_id(status) or pid,
        participates=_participates(pid, threads),
        threads=threads,
        user=user,
    )


def descendants(parent_of: Mapping[int, int], pid: int) -> frozenset[int]:
    """A process and all its children, theirs and so on; ``parent_of`` maps each to its parent."""
    family, grown = {pid}, True
    while grown:
        more = {child for child, parent in parent_of.items() if parent in family} - family
        family |= more
        grown = bool(more)
    return frozenset(family)


def find_applications(processes: Iterable[Process]) -> tuple[Process, ...]:
    """Those that look like applications of ROS 2 or DDS."""
    return tuple(
        process
        for process in processes
        if process.participates or takes_ros_arguments(process.command)
    )


def _participates(pid: int, threads: tuple[Thread, ...]) -> bool:
    if any(thread.kind in ("receive", "event") for thread in threads):
        return True
    if len(threads) == 1:
        return False
    try:
        mapped = read_proc(f"/proc/{pid}/maps")
    except OSError:
        return False  # another user's: its threads' names are all there is to see
    return any(library in mapped for library in _LIBRARIES_WITHOUT_NAMED_THREADS)
