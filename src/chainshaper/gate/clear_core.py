"""A core that is clear of other work while an output is delivered there.

DDS threads that receive outrank everything else on their core, but unless the kernel is fully
preemptible, an ordinary thread that is inside a system call goes on until it is through with it,
and a core that idles has to wake up first. So a thread of the lowest real-time priority watches the
clock there, from somewhat before a release until the output is delivered: ordinary threads do not
run meanwhile, and receiving ones preempt it within microseconds. It is a process of its own, since
within one of Python it would hold up the gate.
"""

import inspect
import os
import subprocess
import sys
from contextlib import suppress


def _clear(core: int) -> None:
    """Clear a core until the times (ns of CLOCK_MONOTONIC) that come on standard input."""
    import os  # this function is all that its process has
    import time

    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    os.sched_setaffinity(0, {core})
    while received := os.read(0, 8):
        until_ns = int.from_bytes(received, "little")
        while time.monotonic_ns() < until_ns:
            pass


class ClearCore:
    """A process that clears a core; none where SCHED_FIFO or the core is refused.

    It ends with the one that made it, and hears no Ctrl-C.
    """

    def __init__(self, core: int) -> None:
        program = f"{inspect.getsource(_clear)}\n_clear({core})"
        times, self._times = os.pipe()
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", program],
            stdin=times,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        os.close(times)
        self.pid = self._process.pid

    def clear_until(self, time_ns: int) -> None:
        """Clear the core from now until then."""
        with suppress(BrokenPipeError):
            os.write(self._times, time_ns.to_bytes(8, "little"))

    def end(self) -> None:
        """Give the core back."""
        os.close(self._times)
        self._process.wait()
