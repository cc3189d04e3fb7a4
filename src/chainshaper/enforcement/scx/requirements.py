"""What the sched_ext back end needs of this machine, and what of it is missing."""

import os
import resource
from pathlib import Path

from chainshaper.enforcement.scx.libbpf import load_libbpf
from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.values.errors import PlatformError

__all__ = ["is_realtime_kernel", "missing", "scheduler_in_force"]

SCHED_EXT = Path("/sys/kernel/sched_ext")
KERNEL_TYPES = Path("/sys/kernel/btf/vmlinux")
STATUS = Path("/proc/self/status")

_CAPABILITIES = {"CAP_IPC_LOCK": 14, "CAP_SYS_ADMIN": 21, "CAP_PERFMON": 38, "CAP_BPF": 39}


def missing() -> str | None:
    """Why sched_ext servers cannot be had here, with the remedy; None when they can."""
    if not SCHED_EXT.is_dir():
        return (
            "this kernel has no sched_ext: use Linux 6.12 or newer built with "
            "CONFIG_SCHED_CLASS_EXT, such as Debian's from 6.16 on"
        )
    if not KERNEL_TYPES.exists():
        return (
            f"this kernel does not describe its types ({KERNEL_TYPES} is absent): use one built "
            "with CONFIG_DEBUG_INFO_BTF"
        )
    try:
        load_libbpf()
    except PlatformError as error:
        return str(error)
    lacking = _lacking_privileges()
    if lacking:
        return (
            f"this process lacks {' and '.join(lacking)}: run as root, or give it these "
            "capabilities (AmbientCapabilities= of a systemd unit, or capsh --addamb=)"
        )
    scheduler = scheduler_in_force()
    if scheduler is not None:
        return f"sched_ext scheduler {scheduler} is in force, and there can be one only: end it"
    return None


def is_realtime_kernel() -> bool:
    """Whether this is a PREEMPT_RT kernel, which refuses BPF timers."""
    return "PREEMPT_RT" in os.uname().version


def scheduler_in_force() -> str | None:
    """The name of the sched_ext scheduler that is loaded, None when there is none."""
    try:
        if (SCHED_EXT / "state").read_text().strip() == "disabled":
            return None
        return (SCHED_EXT / "root" / "ops").read_text().strip()
    except OSError:
        return None


def _lacking_privileges() -> list[str]:
    held = _held_capabilities()
    lacking = []
    if "CAP_SYS_ADMIN" not in held:
        lacking += [name for name in ("CAP_BPF", "CAP_PERFMON") if name not in held]
    if is_realtime_kernel():
        if not may_use_fifo():
            lacking.append("CAP_SYS_NICE")
        limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
        if "CAP_IPC_LOCK" not in held and limit != resource.RLIM_INFINITY:
            lacking.append("CAP_IPC_LOCK")
    return lacking


def _held_capabilities() -> set[str]:
    for line in STATUS.read_text().splitlines():
        if line.startswith("CapEff:"):
            mask = int(line.split()[1], 16)
            return {name for name, bit in _CAPABILITIES.items() if mask >> bit & 1}
    return set()
