"""Processes that run with the tracing library in front: found in `/proc`, by their memory."""

import mmap
import os
import re
import stat
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from chainshaper.linux.threads import innermost_id, read_proc
from chainshaper.sources.preload.memory import HEAD_BYTES, RefusedMemoryError, TracedProcess
from chainshaper.values.errors import InputError, text_of

NO_PROCESS = (
    "nothing is being traced: no process of these users runs with the library in front. Start "
    "the robot with `chainshaper watch -- ros2 launch …`, or set what `chainshaper watch "
    "--environment` prints before it is started, or name its user (--user)"
)
_MEMORY = re.compile(rb"/memfd:chainshaper-trace\b")


def memories(
    users: Collection[int],
    known: Collection[int],
    refused: Callable[[int, str], None] = lambda *_: None,
) -> Iterator[tuple[int, TracedProcess]]:
    """Yield processes of some users that have the library in front, without those ``known``.

    Each is yielded with its id. ``refused`` gets the id of each whose memory cannot be read, and a
    sentence that names the process and says why.
    """
    running = (int(name) for name in os.listdir("/proc") if name.isdigit())  # noqa: PTH208
    for pid in {*running}.difference(known):
        with suppress(OSError):  # it has ended, or may not be looked into
            if Path(f"/proc/{pid}").stat().st_uid not in users:
                continue
            inner_pid = innermost_id(read_proc(f"/proc/{pid}/status"))
            for descriptor in Path(f"/proc/{pid}/fd").iterdir():
                with suppress(OSError):  # it is closed meanwhile, or may not be opened
                    memory = _memory_of(descriptor, pid)
                    # Another process's memory is open in one that reads it, as we do.
                    if memory is None or memory.inner_pid != inner_pid:
                        continue
                    if isinstance(memory, RefusedMemoryError):
                        refused(pid, left_out(pid, memory))
                    else:
                        yield pid, memory
                    break


def name_of(pid: int) -> str:
    """Return the name of a program that runs. Raises OSError: it has ended."""
    return text_of(read_proc(f"/proc/{pid}/comm").removesuffix(b"\n"))


def left_out(pid: int, why: Exception, sent_name: str = "") -> str:
    """Return a sentence that names a process of which nothing is recorded.

    ``sent_name`` is what the process said that its program is called, for one that has ended.
    """
    name = sent_name
    with suppress(OSError):  # it has ended
        name = name_of(pid)
    called = f" ({name})" if name else ""
    return f"nothing of process {pid}{called} is recorded: {why}."


@contextmanager
def _regular(descriptor: Path) -> Iterator[Path | None]:
    """Give a path by which a memory that a process has open may be opened; None: it is none.

    Anything may have the name of a memory, and opening a pipe or a device may wait for ever or do
    something: so the file is looked at before. Raises OSError.
    """
    if not _MEMORY.match(os.fsencode(descriptor.readlink())):
        yield None
        return
    place = os.open(descriptor, os.O_PATH | os.O_CLOEXEC)
    try:
        is_regular = stat.S_ISREG(os.fstat(place).st_mode)
        yield Path(f"/proc/self/fd/{place}") if is_regular else None
    finally:
        os.close(place)


def memory_to_write(pid: int) -> tuple[mmap.mmap, TracedProcess] | None:
    """Map the head of a process's memory, to be written, and open the memory; None: it has none.

    Raises OSError: it has ended, or may not be looked into or written to.
    """
    inner_pid = innermost_id(read_proc(f"/proc/{pid}/status"))
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError, InputError), _regular(descriptor) as path:
            if path is None:
                continue
            with path.open("r+b") as file:
                process = TracedProcess(file.fileno(), pid)
                if process.inner_pid == inner_pid:
                    return mmap.mmap(file.fileno(), HEAD_BYTES), process
    return None


def _memory_of(descriptor: Path, pid: int) -> TracedProcess | RefusedMemoryError | None:
    """Return the memory behind an open file of a process, in `/proc`; None: it is another file.

    Raises OSError.
    """
    with _regular(descriptor) as path:
        if path is None:
            return None
        try:
            with path.open("rb") as file:
                return TracedProcess(file.fileno(), pid)
        except RefusedMemoryError as refused:
            return refused
        except InputError:
            return None
