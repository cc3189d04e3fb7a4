"""What this machine can do for latency shaping, and how badly it stalls. Nothing is changed."""

import importlib.metadata
import os
import platform
import resource
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

from chainshaper.enforcement.back_ends import offered_back_ends
from chainshaper.linux.child_processes import tool_environment
from chainshaper.linux.processes import guessed_name, list_processes
from chainshaper.linux.scheduling import available_cores, may_use_fifo, throttle_fraction
from chainshaper.linux.threads import foreign_realtime_processes
from chainshaper.values.errors import text_of
from chainshaper.values.middleware import (
    DEFAULT_MIDDLEWARE,
    MIDDLEWARE_LIMITS,
    Middleware,
    limit_by_settings,
    middleware_of,
)
from chainshaper.values.recording import Check, MachineReport, State


def examine_machine(watch_ns: int = 5_000_000_000) -> MachineReport:
    """Examine this machine; watching it for stalls takes ``watch_ns``."""
    from chainshaper.workload.stall_meter import measure_stalls

    realtime = may_use_fifo()
    stalls, meter = measure_stalls(available_cores(), watch_ns, realtime)
    checks = (*_scheduling_checks(realtime), *_tool_checks())
    return MachineReport(checks, stalls, meter, watch_ns)


def _scheduling_checks(realtime: bool) -> Iterator[Check]:
    """Yield checks of cores and of real-time threads, which are permitted if ``realtime``."""
    cores, throttled = available_cores(), throttle_fraction()
    lockable, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    foreign, limits = foreign_realtime_processes(), "in /etc/security/limits.conf"
    text = f"{len(cores)} ({', '.join(map(str, cores))}), kernel {platform.release()}"
    good, remedy = text if len(cores) >= 2 else None, "use a machine with two cores or more"
    yield _check("cores", "DDS threads beside executors", good, "limited", text, remedy)
    purpose = "measuring and shaping with real-time scheduling"
    good = "permitted" if realtime else None
    remedy = f"run as root, or give your user an rtprio limit of 98 {limits}"
    yield _check("SCHED_FIFO", purpose, good, "absent", "not permitted", remedy)
    purpose, good = "cores that real-time threads fill", "off" if throttled >= 1.0 else None
    text = f"real-time threads are stopped at {throttled:.0%} of a core"
    remedy = "stay below it, or: sysctl kernel.sched_rt_runtime_us=-1"
    yield _check("real-time throttling", purpose, good, "limited", text, remedy)
    unlimited = os.geteuid() == 0 or lockable == resource.RLIM_INFINITY
    purpose, good = "no page faults while a gate waits", "permitted" if unlimited else None
    text, remedy = f"up to {lockable // 1024} KiB", f"give your user an unlimited one {limits}"
    yield _check("memory locking", purpose, good, "limited", text, remedy)
    name, purpose = "other real-time processes", "undisturbed measurements"
    remedy = "end them while you measure, unless they belong to the application"
    good = None if foreign else "none"
    yield _check(name, purpose, good, "limited", ", ".join(foreign), remedy)


def _tool_checks() -> Iterator[Check]:
    """Yield checks of DDS, back ends, tracers and compilers."""
    yield _dds()
    yield from _middleware()
    for offer in offered_back_ends():  # what `chainshaper apply` can use here, strongest first
        missing, _, remedy = (offer.missing or "").partition(": ")
        good = "can be used" if offer.missing is None else None
        yield _check(f"back end {offer.name}", offer.strength, good, "absent", missing, remedy)
    yield _bpftrace()
    for name, purpose, remedy in (
        ("lttng", "recording ROS 2 with LTTng", "apt install lttng-tools"),
        ("cc", "recording by the library in front of ROS 2", "apt install gcc libc6-dev"),
        ("c++", "plans with `--publication in-process`", "apt install g++"),
        ("ros2", "shaping ROS 2 applications", "install ROS 2, and source its setup.bash"),
    ):
        yield _check(name, purpose, shutil.which(name), "absent", "not found", remedy)


def _bpftrace() -> Check:
    """Check whether bpftrace is there and works: without tracefs it finds no trace points."""
    name, purpose, environment = "bpftrace", "recording ROS 2 without LTTng", tool_environment()
    path = shutil.which(name, path=environment["PATH"])
    if path is None:
        return _check(name, purpose, None, "absent", "not found", "apt install bpftrace")
    if os.geteuid() != 0:
        return _check(name, purpose, None, "limited", "needs root", "run as root, with sudo")
    trial = [path, "-e", "BEGIN { exit(); } tracepoint:sched:sched_switch { }"]
    try:
        run = subprocess.run(trial, capture_output=True, check=False, timeout=30, env=environment)
        good = path if run.returncode == 0 else None
        problems = [
            line for line in text_of(run.stderr).splitlines() if "RLIMIT_MEMLOCK" not in line
        ]
    except subprocess.TimeoutExpired:
        good, problems = None, ["it did not end within 30 s"]
    remedy = "mount -t tracefs tracefs /sys/kernel/tracing"
    if Path("/sys/kernel/tracing/events").is_dir():
        remedy = "see what bpftrace says: a kernel with BTF and uprobes is needed"
    text = f"does not work: {problems[0] if problems else 'no reason given'}"
    return _check(name, purpose, good, "limited", text, remedy)


def _dds() -> Check:
    """Check whether Cyclone DDS is installed and can be loaded."""
    good, problem = None, ""
    try:
        version = importlib.metadata.version("cyclonedds")
        from chainshaper.workload import dds  # noqa: F401 - loading it is the check

        good = version
    except Exception as error:
        problem = str(error)
    remedy = (
        "ROS 2 applications need none; else use Python 3.10 to 3.13 on x86-64, for which a wheel "
        "exists, or `pip install cyclonedds` with CYCLONEDDS_HOME naming a Cyclone DDS 11"
    )
    purpose = "the live workload and `chainshaper demo`"
    return _check("Cyclone DDS for Python", purpose, good, "absent", problem, remedy)


def _middleware() -> Iterator[Check]:
    """Yield a check of the middleware that the environment chooses; without ROS 2, none."""
    distribution = os.environ.get("ROS_DISTRO")
    rmw = os.environ.get("RMW_IMPLEMENTATION")
    if not rmw:
        if not distribution:
            return
        rmw = DEFAULT_MIDDLEWARE.rmw
    good, limited = None, f"{rmw} is not known"
    middleware = middleware_of(rmw)
    if middleware is not None:
        limit = limit_by_settings(middleware, distribution, os.environ)
        if limit is None:
            good = rmw
        else:
            limited = MIDDLEWARE_LIMITS[limit]
    purpose = "delivery threads, in their place beside a chain"
    remedy = "RMW_IMPLEMENTATION=rmw_cyclonedds_cpp, or measure what `shape` makes of it"
    yield _check("middleware", purpose, good, "limited", limited, remedy)
    if middleware is not None and middleware.routers:
        yield _router(middleware)


def _router(middleware: Middleware) -> Check:
    """Check whether a router runs by which nodes on this middleware find each other."""
    running = (
        f"{name.removeprefix('/')} (process {process.pid})"
        for process in list_processes()
        if (name := guessed_name(process.command)) in middleware.routers
    )
    remedy = "unless nodes are configured to find each other otherwise: ros2 run rmw_zenoh_cpp "
    remedy += "rmw_zenohd"
    purpose, good = "nodes that find each other", next(running, None)
    return _check("router", purpose, good, "limited", "none runs on this machine", remedy)


def _check(  # noqa: PLR0917 - a check's columns
    name: str, purpose: str, good: str | None, state: State, bad: str, remedy: str
) -> Check:
    """Return a check: ``good`` says what is there; None: ``bad`` says it, and why not all works."""
    if good is None:
        return Check(name, state, bad, purpose, remedy)
    return Check(name, "good", good, purpose)
