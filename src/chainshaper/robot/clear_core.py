"""A core that is clear of other work while an output is delivered there.

DDS threads that receive outrank everything else on their core, but unless the kernel is fully
preemptible, an ordinary thread that is inside a system call ends that first, and a core that idles
has to wake up. So a thread of the lowest real-time priority watches the clock there around a
release: ordinary threads do not run meanwhile, and receiving ones preempt it within microseconds.
It is a process of its own, since within one of Python it would hold up the gate.
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
    """A process that has this function only, and a pipe to its standard input.

    It imports what it needs itself. It hears no Ctrl-C, and ends with who has the pipe.
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
    """Clear a core until the times (ns of CLOCK_MONOTONIC) that come on standard input."""
    import os
    import time

    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    os.sched_setaffinity(0, {core})
    while received := os.read(0, 8):
        until_ns = int.from_bytes(received, "little")
        while time.monotonic_ns() < until_ns:
            pass


class ClearCore:
    """A process that clears a core; none where SCHED_FIFO or the core is refused."""

    def __init__(self, core: int) -> None:
        self._process, self._times = started_beside(_clear, core)
        self.pid = self._process.pid

    def clear_until(self, time_ns: int) -> None:
        """Clear the core from now until then."""
        with suppress(BrokenPipeError):
            os.write(self._times, time_ns.to_bytes(8, "little"))

    def end(self) -> None:
        """Give the core back."""
        os.close(self._times)
        self._process.wait()
