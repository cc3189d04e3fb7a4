"""A kicker: on PREEMPT_RT, the process that makes one core decide at each slot boundary.

    python -m chainshaper.enforcement.scx.kicker CORE DESCRIPTOR

PREEMPT_RT kernels refuse BPF timers. Instead, a SCHED_FIFO thread of the lowest priority sleeps on
the core until the next boundary. Waking up, it pushes whatever ran there back to its queue; asleep
again, it leaves a core that has to look at the table. The policy's own program `table_boundary`
computes boundaries, and writes down when the kicker has promised to be back: a little after each
boundary, so that it does not delay the threads that wait for one.

One process per core, because a thread of the loader would wait for the interpreter's lock, without
children, files or output of its own. It ends by itself when the loader has gone.
"""

import ctypes
import os
import subprocess
import sys

from chainshaper.enforcement.scx.libbpf import ProgramRun
from chainshaper.enforcement.scx.table import INSTANT, WAKE
from chainshaper.linux.own_processes import module_command
from chainshaper.linux.scheduling import lock_memory, set_thread_name, stop_garbage_collection
from chainshaper.values.errors import OperationError

PRIORITY = 1
_CLOCK_MONOTONIC, _TIMER_ABSTIME = 1, 1


def start_kicker(core: int, program: int) -> subprocess.Popen[bytes]:
    """Start the kicker of a core; returns when it is at work.

    ``program`` is the file descriptor of `table_boundary`. Raises OperationError: it cannot be
    started.
    """
    process = subprocess.Popen(
        [*module_command(__name__), str(core), str(program)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        pass_fds=(program,),
        start_new_session=True,  # Ctrl-C is for the loader, which ends the kicker last
    )
    if not process.stdout or not process.stdout.readline():
        _, said = process.communicate()
        reason = said.decode(errors="replace").strip().rpartition("\n")[2]
        raise OperationError(f"the kicker of core {core} cannot start: {reason}")
    return process


def main(core: int, program: int) -> None:
    """Kick the core at each boundary until the loader has gone."""
    loader = os.getppid()
    set_thread_name(f"kicker/{core}")
    # The class first: moved to a busy core as SCHED_OTHER, it might not run again to ask for it.
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    os.sched_setaffinity(0, {core})
    lock_memory()
    stop_garbage_collection()
    sleep = ctypes.CDLL(None).clock_nanosleep
    boundary = ProgramRun(program, WAKE.size)
    until = ctypes.c_void_p(ctypes.addressof(boundary.context))
    once_more = ctypes.c_void_p(ctypes.addressof(boundary.context) + INSTANT.size)
    boundary()
    sys.stdout.write("at work\n")
    sys.stdout.close()
    # From here on each microsecond delays the threads that wait for a slot to begin.
    parent, plan, (descriptor, options) = os.getppid, boundary.function, boundary.arguments
    while parent() == loader:
        plan(descriptor, options)
        sleep(_CLOCK_MONOTONIC, _TIMER_ABSTIME, until, None)
        sleep(_CLOCK_MONOTONIC, _TIMER_ABSTIME, once_more, None)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
