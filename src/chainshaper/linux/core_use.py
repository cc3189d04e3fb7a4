"""Which threads used a core: what the kernel counts for each thread, seen twice.

Everybody may read how long a thread has run, how long it has waited for a core, and on which core
it ran last (`schedstat` and `stat`, proc(5)). So between two looks it is known which threads used
which core for how long. At which instants only the kernel's own events show, which need root
(`chainshaper record --source ebpf`).
"""

import os
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from chainshaper.linux.threads import read_proc, read_stat

_KEPT = 64  # spans between two looks
_LEAST_NS = 100_000  # a thread that ran for less between two looks is left out
_CORE = 36  # the place of a thread's core in the fields of `read_stat`


@dataclass(frozen=True)
class Used:
    """How long a thread ran between two looks, and waited for a core. Times are in ns."""

    tid: int
    name: str
    core: int  # where it ran last
    ran_ns: int
    waited_ns: int


class CoreUse:
    """Follows how long all threads of this machine run; :meth:`look` now and then."""

    def __init__(self) -> None:
        self._looked_ns = 0
        self._counts: dict[int, tuple[int, int]] = {}  # by thread: ran and waited (ns)
        self._spans: deque[tuple[int, int, list[Used]]] = deque(maxlen=_KEPT)

    def look(self) -> None:
        """Read the counts of all threads."""
        now, counts, used = time.monotonic_ns(), dict[int, tuple[int, int]](), list[Used]()
        for pid in (name for name in os.listdir("/proc") if name.isdigit()):  # noqa: PTH208
            with suppress(OSError):  # it has ended
                for tid in os.listdir(f"/proc/{pid}/task"):  # noqa: PTH208
                    self._read(f"/proc/{pid}/task/{tid}", counts, used)
        if self._looked_ns:
            self._spans.append((self._looked_ns, now, used))
        self._counts, self._looked_ns = counts, now

    def _read(self, folder: str, counts: dict[int, tuple[int, int]], used: list[Used]) -> None:
        """Read a thread's counts, and append what it used if it ran since the last look."""
        tid = int(folder.rpartition("/")[2])
        with suppress(OSError, ValueError):  # it has ended, or this kernel counts nothing
            ran, waited = map(int, read_proc(f"{folder}/schedstat").split()[:2])
            counts[tid] = ran, waited
            ran_before, waited_before = self._counts.get(tid, (0, 0))
            if self._looked_ns and ran - ran_before >= _LEAST_NS:
                name, fields = read_stat(folder)
                core = int(fields[_CORE])
                used.append(Used(tid, name, core, ran - ran_before, waited - waited_before))

    def between(self, since_ns: int, until_ns: int) -> tuple[int, dict[int, Used]]:
        """Return what threads used in the looks' spans that touch a time, by thread.

        The first value is how long these spans last (ns); 0: there was no look then.
        """
        lasted, by_thread = 0, dict[int, Used]()
        for begun, ended, used in self._spans:
            if ended <= since_ns or begun >= until_ns:
                continue
            lasted += ended - begun
            for each in used:
                before = by_thread.get(each.tid)
                ran, waited = (before.ran_ns, before.waited_ns) if before else (0, 0)
                total = (each.ran_ns + ran, each.waited_ns + waited)
                by_thread[each.tid] = Used(each.tid, each.name, each.core, *total)
        return lasted, by_thread


def strangers_are_hidden() -> bool:
    """Return whether /proc hides the processes of other users (its option `hidepid`)."""
    return not Path("/proc/1").exists()
