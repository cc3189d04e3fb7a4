"""Gating one thread of a live run with `cgroup.freeze`, as simply as it can be done.

A thread of this process opens and closes the slots: good enough to see whether the application
stands it, and independent of the back end that does it well.
"""

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from chainshaper.enforcement.slot_dispatcher import PRIORITY
from chainshaper.linux.threads import list_threads
from chainshaper.robot.clocks import sleep_until
from chainshaper.workload.live import Enforcement, StartedNodes


def need_threaded_cgroups() -> Path:
    """The group in which this process is; a machine that has no such thing skips the test."""
    mounts = [line.split() for line in Path("/proc/mounts").read_text().splitlines()]
    roots = [Path(mount[1]) for mount in mounts if mount[2] == "cgroup2"]
    paths = [
        line[3:] for line in Path("/proc/self/cgroup").read_text().splitlines() if line[:3] == "0::"
    ]
    if not roots or not paths:
        pytest.skip("no cgroup v2 hierarchy is mounted here, so no thread can be frozen")
    group = roots[0] / paths[0].lstrip("/")
    if not os.access(group, os.W_OK):
        pytest.skip(f"no permission to make a cgroup in {group}, so no thread can be frozen")
    return group


def freezing_publisher_of(node: str, slot: tuple[int, int], cycle_ns: int) -> Enforcement:
    """Let the publisher thread of ``node`` run in ``slot`` of every cycle only (ns)."""

    @contextmanager
    def in_force(started: StartedNodes) -> Iterator[None]:
        (thread,) = (t for t in list_threads(started.pids[node]) if t.role == "publisher")
        home = need_threaded_cgroups()
        group = home / f"frozen-test-{thread.tid}"
        group.mkdir()
        over = threading.Event()
        gating = threading.Thread(
            target=_open_and_close, args=(group, slot, cycle_ns, started.anchor_ns, over)
        )
        try:
            (group / "cgroup.type").write_text("threaded")
            (group / "cgroup.threads").write_text(str(thread.tid))
            (group / "cgroup.freeze").write_text("1")
            gating.start()
            yield
        finally:
            over.set()
            if gating.ident is not None:
                gating.join()
            (group / "cgroup.freeze").write_text("0")
            if list_threads(started.pids[node]):
                (home / "cgroup.threads").write_text(str(thread.tid))
            group.rmdir()

    return in_force


def _open_and_close(
    group: Path, slot: tuple[int, int], cycle_ns: int, anchor_ns: int, over: threading.Event
) -> None:
    freeze = os.open(group / "cgroup.freeze", os.O_WRONLY)
    with suppress(PermissionError):  # what else runs on this machine must not move the slots
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    anchor_ns -= max(0, anchor_ns - time.monotonic_ns()) // cycle_ns * cycle_ns
    try:
        while not over.is_set():
            sleep_until(anchor_ns + slot[0])
            os.pwrite(freeze, b"0", 0)
            # This process may have been kept from running: a slot that opens late ends later.
            opened_ns = max(anchor_ns + slot[0], time.monotonic_ns())
            sleep_until(opened_ns + slot[1] - slot[0])
            os.pwrite(freeze, b"1", 0)
            anchor_ns += cycle_ns
    finally:
        os.close(freeze)
