"""Processes that read the clock without pause while they are gated, and what their readings say.

A spinner notes when it ran, as windows without a gap. Compared with the slots in which it should
have run: `enter` is its first reading behind a slot's start, `leave` its last one behind a slot's
end (negative: before it), `leakage` the share of its time outside of slots.
"""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from chainshaper.enforcement.servers import ReservationServer
from chainshaper.linux.scheduling import available_cores

__all__ = ["Exactness", "compare_with_slots", "load_beside", "read_windows", "spinners"]

Times = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

NEAR_NS = 1_000_000
GAP_NS = 200_000
_PRIORITY = 50


@dataclass(frozen=True)
class Exactness:
    """Times in ns, one per slot; the masks tell where a stall of the machine was near."""

    enter: Times
    leave: Times
    enter_disturbed: Mask
    leave_disturbed: Mask
    leakage: float


@contextlib.contextmanager
def spinners(
    folder: Path, names: tuple[str, ...], core: int, seconds: float, *, fifo: bool
) -> Iterator[dict[str, int]]:
    """Spinners that begin when the block ends, for ``seconds``; their process ids by name.

    Each writes its windows to the file of its name in ``folder``. ``fifo`` makes them SCHED_FIFO.
    """
    started: list[subprocess.Popen[str]] = []
    try:
        for name in names:
            arguments = [str(folder / name), str(core), str(seconds), str(int(fifo))]
            process = subprocess.Popen(
                [sys.executable, __file__, *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            started.append(process)
            if process.stdout is None or not process.stdout.readline():
                raise SystemExit(f"spinner {name} has not started")
        yield {name: process.pid for name, process in zip(names, started, strict=True)}
        for process in started:
            print("go", file=process.stdin, flush=True)
        for process in started:
            process.wait(timeout=seconds + 30)
    finally:
        for process in started:
            process.kill()
            process.wait()


@contextlib.contextmanager
def load_beside(wanted: bool) -> Iterator[None]:
    """Two processes per core that compute, of no priority."""
    command = [sys.executable, "-c", "x = list(range(200_000))\nwhile True: sorted(x)"]
    count = 2 * len(available_cores()) if wanted else 0
    busy = [subprocess.Popen(command) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def read_windows(log: Path) -> Times:
    """Rows of first and last reading (ns), without the first and the last window."""
    return np.array(json.loads(log.read_text())[1:-1], dtype=np.int64).reshape(-1, 2)


def compare_with_slots(
    server: ReservationServer, cycle_ns: int, anchor_ns: int, windows: Times, stalls: Times
) -> Exactness:
    """Compare windows with the slot of a server that has one; ``stalls`` are rows of start, length.

    A window belongs to the cycle in whose slot it began, or up to 1 ms before it.
    """
    ((start, end),) = server.slots
    number = (windows[:, 0] - anchor_ns - start + NEAR_NS) // cycle_ns
    opened, closed = (anchor_ns + number * cycle_ns + instant for instant in (start, end))
    _, first = np.unique(number, return_index=True)
    last = np.append(first[1:], len(number)) - 1
    outside = np.maximum(0, opened - windows[:, 0]) + np.maximum(0, windows[:, 1] - closed)
    return Exactness(
        enter=(windows[:, 0] - opened)[first],
        leave=(windows[:, 1] - closed)[last],
        enter_disturbed=_near_a_stall(opened[first], stalls),
        leave_disturbed=_near_a_stall(closed[last], stalls),
        leakage=float(outside.sum() / (windows[:, 1] - windows[:, 0]).sum()),
    )


def _near_a_stall(instants: Times, stalls: Times) -> Mask:
    """Which instants a stall was near: as far as its own length before and 1 ms behind."""
    begin, length = stalls[:, 0], stalls[:, 1]
    near = (instants[:, None] >= begin - NEAR_NS) & (instants[:, None] <= begin + length + NEAR_NS)
    return np.asarray(near.any(axis=1))


def _spin(log: Path, core: int, seconds: float, fifo: bool) -> None:
    """Note when this process runs; SCHED_FIFO before the core, and an end whatever happens."""
    if fifo:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    print("ready", flush=True)
    sys.stdin.readline()  # until it is gated: it would keep the core from everybody
    os.sched_setaffinity(0, {core})
    clock = time.monotonic_ns
    windows = []
    first = last = clock()
    end = last + int(seconds * 1e9)
    while last < end:
        now = clock()
        if now - last > GAP_NS:
            windows.append((first, last))
            first = now
        last = now
    log.write_text(json.dumps(windows))


if __name__ == "__main__":
    if len(sys.argv) != 5:
        sys.exit("enter_exit.py beside this file starts it; run that one")
    _spin(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]), sys.argv[4] == "1")
