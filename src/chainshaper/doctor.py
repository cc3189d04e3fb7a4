"""What this machine can do for latency shaping, and how badly it stalls.

Each check names what was found and, where something is missing, the remedy. Nothing is changed.
"""

import importlib.metadata
import os
import platform
import resource
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

import polars as pl

from chainshaper.enforcement.back_ends import offered_back_ends
from chainshaper.enforcement.realtime import available_cores, may_use_fifo, throttle_fraction
from chainshaper.enforcement.threads.listing import foreign_realtime_processes
from chainshaper.recording import StallMeterInfo

__all__ = ["Check", "MachineReport", "examine_machine"]

State: TypeAlias = Literal["good", "limited", "absent"]


@dataclass(frozen=True)
class Check:
    """One ability: ``needed_for`` says what goes without it, ``remedy`` what would bring it."""

    name: str
    state: State
    found: str
    needed_for: str
    remedy: str = ""


@dataclass(frozen=True)
class MachineReport:
    """All checks, and the stalls seen while watching every core (`machine_stall` table)."""

    checks: tuple[Check, ...]
    stalls: pl.DataFrame
    stall_meter: StallMeterInfo
    watched_ns: int


def examine_machine(watch_ns: int = 5_000_000_000) -> MachineReport:
    """Examine this machine; the stalls take ``watch_ns``."""
    from chainshaper.workload.stall_watch import measure_stalls

    realtime = may_use_fifo()
    stalls, meter = measure_stalls(available_cores(), watch_ns, realtime)
    checks = (
        _cores(),
        _fifo(realtime),
        _throttling(),
        _memory_lock(),
        _other_realtime(),
        _dds(),
        *_back_ends(),
        _tool("bpftrace", "recording ROS 2 without LTTng", "apt install bpftrace"),
        _tool("lttng", "recording ROS 2 with LTTng", "apt install lttng-tools"),
        _tool("ros2", "shaping ROS 2 applications", "install ROS 2, and source its setup.bash"),
    )
    return MachineReport(checks, stalls, meter, watch_ns)


def _cores() -> Check:
    cores = available_cores()
    text = f"{len(cores)} ({', '.join(map(str, cores))}), kernel {platform.release()}"
    purpose = "DDS threads beside executors"
    if len(cores) >= 2:
        return Check("cores", "good", text, purpose)
    return Check("cores", "limited", text, purpose, "use a machine with two cores or more")


def _fifo(realtime: bool) -> Check:
    purpose = "measuring and shaping with real-time scheduling"
    if realtime:
        return Check("SCHED_FIFO", "good", "permitted", purpose)
    return Check(
        "SCHED_FIFO",
        "absent",
        "not permitted",
        purpose,
        "run as root, or give your user an rtprio limit of 98 in /etc/security/limits.conf",
    )


def _throttling() -> Check:
    share = throttle_fraction()
    purpose = "cores that real-time threads fill"
    if share >= 1.0:
        return Check("real-time throttling", "good", "off", purpose)
    return Check(
        "real-time throttling",
        "limited",
        f"real-time threads are stopped at {share:.0%} of a core",
        purpose,
        "stay below it, or: sysctl kernel.sched_rt_runtime_us=-1",
    )


def _memory_lock() -> Check:
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    purpose = "no page faults while a gate waits"
    if os.geteuid() == 0 or soft == resource.RLIM_INFINITY:
        return Check("memory locking", "good", "permitted", purpose)
    return Check(
        "memory locking",
        "limited",
        f"up to {soft // 1024} KiB",
        purpose,
        "give your user an unlimited memlock limit in /etc/security/limits.conf",
    )


def _other_realtime() -> Check:
    others = foreign_realtime_processes()
    purpose = "undisturbed measurements"
    if not others:
        return Check("other real-time processes", "good", "none", purpose)
    return Check(
        "other real-time processes",
        "limited",
        ", ".join(others),
        purpose,
        "end them while you measure, unless they belong to the application",
    )


def _dds() -> Check:
    purpose = "the live workload and `chainshaper demo`"
    try:
        version = importlib.metadata.version("cyclonedds")
        from chainshaper.workload import dds  # noqa: F401 - loading it is the check
    except Exception as error:
        return Check(
            "Cyclone DDS for Python",
            "absent",
            str(error),
            purpose,
            "use Python 3.10 to 3.13 on x86-64, for which a wheel exists",
        )
    return Check("Cyclone DDS for Python", "good", version, purpose)


def _back_ends() -> Iterator[Check]:
    """What `chainshaper apply` can use here, strongest first."""
    for offer in offered_back_ends():
        name = f"back end {offer.name}"
        if offer.missing is None:
            yield Check(name, "good", "can be used", offer.strength)
        else:
            found, _, remedy = offer.missing.partition(": ")
            yield Check(name, "absent", found, offer.strength, remedy)


def _tool(name: str, purpose: str, remedy: str) -> Check:
    path = shutil.which(name)
    if path is not None:
        return Check(name, "good", path, purpose)
    return Check(name, "absent", "not found", purpose, remedy)
