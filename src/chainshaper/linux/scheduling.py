"""Real-time scheduling of this process: what it may have, and taking it.

Everything here concerns the calling process or thread only. SCHED_FIFO needs CAP_SYS_NICE or an
RLIMIT_RTPRIO, locked memory CAP_IPC_LOCK or an RLIMIT_MEMLOCK.
"""

import ctypes
import gc
import os
import signal
import threading
from pathlib import Path

from chainshaper.values.errors import PlatformError

__all__ = [
    "available_cores",
    "check_cores",
    "lock_memory",
    "may_use_fifo",
    "set_thread_name",
    "signalled_with_parent",
    "stop_garbage_collection",
    "throttle_fraction",
]

_libc = ctypes.CDLL(None, use_errno=True)
_MCL_CURRENT, _MCL_FUTURE = 1, 2
_PR_SET_PDEATHSIG, _PR_SET_NAME = 1, 15
_THROTTLE_RUNTIME = Path("/proc/sys/kernel/sched_rt_runtime_us")
_THROTTLE_PERIOD = Path("/proc/sys/kernel/sched_rt_period_us")


def may_use_fifo() -> bool:
    """Whether SCHED_FIFO is permitted, found by asking for it on a thread that ends at once."""
    permitted = False

    def ask() -> None:
        nonlocal permitted
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
            permitted = True
        except OSError:
            permitted = False

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    return permitted


def available_cores() -> tuple[int, ...]:
    """The cores this process may run on, ascending."""
    return tuple(sorted(os.sched_getaffinity(0)))


def check_cores(cores: dict[int, str]) -> None:
    """Refuse cores that this machine or process does not have.

    ``cores`` maps each core to what asked for it, for the message.

    Raises:
        PlatformError: a core is not available.
    """
    available = available_cores()
    for core, user in sorted(cores.items()):
        if core not in available:
            raise PlatformError(
                f"core {core}, which {user} asks for, is not available: this process may use "
                f"{', '.join(map(str, available))}; name one of those"
            )


def lock_memory() -> bool:
    """Keep all pages of this process in memory, now and later; False when not permitted."""
    return bool(_libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) == 0)


def stop_garbage_collection() -> None:
    """No garbage collection from here on: a full collection pauses a process for milliseconds."""
    gc.collect()
    gc.freeze()
    gc.disable()


def signalled_with_parent(parent_pid: int, number: signal.Signals) -> None:
    """Have the kernel send this process a signal when its parent dies, however that happens."""
    _libc.prctl(_PR_SET_PDEATHSIG, number, 0, 0, 0)
    if os.getppid() != parent_pid:  # it died before the request was in force
        os.kill(os.getpid(), number)


def set_thread_name(name: str) -> None:
    """Name the calling thread as `ps` and /proc show it (15 bytes at most)."""
    _libc.prctl(_PR_SET_NAME, name.encode()[:15], 0, 0, 0)


def throttle_fraction() -> float:
    """Share of a core that SCHED_FIFO may use before the kernel stops it; 1.0 is no limit."""
    try:
        runtime = int(_THROTTLE_RUNTIME.read_text())
        period = int(_THROTTLE_PERIOD.read_text())
    except (OSError, ValueError):
        return 1.0
    return 1.0 if runtime < 0 else runtime / period
