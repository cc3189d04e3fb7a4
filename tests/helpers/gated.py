"""Real processes to be gated, and what must be true of the machine afterwards."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from known import known
from processes import wait_for

from chainshaper.linux.cgroups import cgroup_of, mount_point
from chainshaper.linux.scheduling import available_cores, may_use_fifo
from chainshaper.values.errors import PlatformError

MS = 1_000_000
CORE = available_cores()[-1]
OTHER_CORE = available_cores()[0]


def why_no_cgroups() -> str:
    """Empty where threads of this process could be put into cgroups of ours."""
    try:
        root = mount_point()
        trial = cgroup_of(os.getpid()) / f"trial-{os.getpid()}"
        trial.mkdir()
        (trial / "cgroup.type").write_text("threaded")
    except PlatformError as error:
        return str(error)
    except OSError as error:
        return f"threaded cgroups cannot be made under {root}: {error}"
    finally:
        with contextlib.suppress(OSError, UnboundLocalError):
            trial.rmdir()
    return ""


needs_cgroups = pytest.mark.skipif(bool(why_no_cgroups()), reason=why_no_cgroups() or "-")


@dataclass
class Stamping:
    """A running `stamping_process.py`."""

    process: subprocess.Popen[bytes]
    output: Path

    @property
    def tid(self) -> int:
        """Its main thread, which notes when it runs."""
        return self.process.pid

    @property
    def other_tid(self) -> int:
        tids = [int(entry.name) for entry in Path(f"/proc/{self.tid}/task").iterdir()]
        return max(tid for tid in tids if tid != self.tid)

    def windows(self, after_ns: int, before_ns: int) -> list[tuple[int, int]]:
        """When its main thread ran, between two instants; ends it."""
        self.process.terminate()
        assert self.process.wait(timeout=60) == 0
        windows = json.loads(self.output.read_text())
        return [(start, end) for start, end in windows if after_ns <= start and end <= before_ns]


@contextlib.contextmanager
def stamping(
    folder: Path, seconds: float, core: int = CORE, *, with_another: bool = False
) -> Iterator[Stamping]:
    output = folder / f"windows-{time.monotonic_ns()}.json"
    script = Path(__file__).with_name("stamping_process.py")
    other_core = [str(OTHER_CORE)] if with_another else []
    process = subprocess.Popen(
        [sys.executable, str(script), str(seconds), str(output), str(core), *other_core],
        stdout=subprocess.PIPE,
    )
    try:
        assert known(process.stdout).readline() == b"ready\n"
        yield Stamping(process, output)
    finally:
        process.kill()
        process.wait()


@contextlib.contextmanager
def sleeping() -> Iterator[int]:
    """A process that only waits; its id."""
    process = subprocess.Popen(["sleep", "60"])
    try:
        wait_for(lambda: Path(f"/proc/{process.pid}/comm").read_text() == "sleep\n", "sleep")
        yield process.pid
    finally:
        process.kill()
        process.wait()


@contextlib.contextmanager
def ahead_of_others(*tids: int) -> Iterator[None]:
    """Gated threads get their slots whatever else runs on this machine, where that is permitted."""
    permitted = may_use_fifo()
    for tid in tids if permitted else ():
        os.sched_setscheduler(tid, os.SCHED_FIFO, os.sched_param(1))
    try:
        yield
    finally:
        for tid in tids if permitted else ():
            with contextlib.suppress(ProcessLookupError):
                os.sched_setscheduler(tid, os.SCHED_OTHER, os.sched_param(0))


def cpu_ns(tid: int) -> int:
    """CPU time of a thread so far."""
    return int(Path(f"/proc/{tid}/schedstat").read_text().split()[0])


def share_inside(
    windows: list[tuple[int, int]], slots: tuple[tuple[int, int], ...], cycle: int, anchor: int
) -> float:
    """How much of the time in which a thread ran lay inside the slots, the odd cycle left out.

    The tenth of the cycles in which it ran longest outside is dropped: that the machine stood
    still at a boundary is not the dispatcher's doing. Slots are widened by 2 % of themselves.
    """
    outside: dict[int, int] = {}
    total = 0
    for start, end in windows:
        number, begin = divmod(start - anchor, cycle)
        length = end - start
        inside = sum(
            max(0, min(begin + length, b + margin + k) - max(begin, a - margin + k))
            for a, b in slots
            for margin in [(b - a) // 50]
            for k in (0, cycle)
        )
        outside[number] = outside.get(number, 0) + max(0, length - inside)
        total += length
    least = sorted(outside.values())[: max(1, len(outside) * 9 // 10)]
    return 1 - sum(least) / max(1, total)


def groups_left(owner_pid: int | None = None) -> list[Path]:
    """Cgroups that a run of this owner, or of any, has not removed."""
    name = "chainshaper-*" if owner_pid is None else f"chainshaper-{owner_pid}.*"
    while True:
        with contextlib.suppress(FileNotFoundError):  # one was removed while we looked: once more
            return sorted(mount_point().rglob(name))


def kill(pid: int, number: int = signal.SIGKILL) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


@contextlib.contextmanager
def own_cgroup(name: str) -> Iterator[Path]:
    """A group of the test's own, removed with all beneath it."""
    folder = mount_point() / f"{name}-{os.getpid()}"
    folder.mkdir()
    try:
        yield folder
    finally:
        for child in sorted(folder.rglob("cgroup.procs"), reverse=True):
            with contextlib.suppress(OSError):
                child.parent.rmdir()
        with contextlib.suppress(OSError):
            folder.rmdir()
