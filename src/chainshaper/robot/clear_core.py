"""A core that is clear of other work while an output is delivered there.

The DDS threads that receive outrank everything else on their core. But unless the kernel is fully
preemptible, an ordinary thread inside a system call completes that call first, and an idle core has
to wake up. So around a release a thread of the lowest real-time priority watches the clock on that
core: ordinary threads do not run meanwhile, and receiving threads preempt it within microseconds.
It is a process of its own, because a thread of the gate's Python process would delay the gate.
"""

import inspect
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any


def started_beside(
    function: Callable[..., None], *arguments: Any
) -> tuple["subprocess.Popen[bytes]", int]:
    """Start a process that runs this function only; return it with a pipe to its standard input.

    The function imports what it needs itself. The process gets no Ctrl-C from the terminal, and
    ends when its standard input does.
    """
    program = f"{inspect.getsource(function)}\n{function.__name__}{arguments!r}"
    reading, writing = os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", program],
        stdin=reading,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    os.close(reading)
    return process, writing


def _clear(core: int) -> None:
    """Keep a core clear until the times that come on standard input (ns of CLOCK_MONOTONIC)."""
    import os
    import time

    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    os.sched_setaffinity(0, {core})
    while received := os.read(0, 8):
        until_ns = int.from_bytes(received, "little")
        while time.monotonic_ns() < until_ns:
            pass


class ClearCore:
    """A process that keeps a core clear; it ends where SCHED_FIFO or the core is refused."""

    def __init__(self, core: int) -> None:
        self._process, self._times = started_beside(_clear, core)
        self.pid = self._process.pid

    def clear_until(self, until_ns: int) -> None:
        """Keep the core clear from now until this time (ns of CLOCK_MONOTONIC)."""
        with suppress(BrokenPipeError):
            os.write(self._times, until_ns.to_bytes(8, "little"))

    def end(self) -> None:
        """Give the core back."""
        os.close(self._times)
        self._process.wait()
