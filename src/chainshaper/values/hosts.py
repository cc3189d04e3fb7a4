"""Hosts: what makes processes, threads and cores of several computers different from each other.

A recording of one host has the numbers that its kernel gave. In a joint recording of several hosts
each host's numbers are moved by a stride of its own: a process's number then says its host, too.
So whatever is a key with a process (an object's handle, a thread, a ring buffer) has the host in
it, in every table. Instants are converted to the clock of the first host, the reference.
"""

from typing import TypeAlias, TypeVar

import polars as pl
from pydantic import BaseModel

Number = TypeVar("Number", int, pl.Expr, pl.Series)
Interval: TypeAlias = tuple[int, int]

HOST_STRIDE = 100_000_000
"""Between the numbers of two hosts' processes and threads; containers take `NEXT_HOST` below it."""
CORE_STRIDE = 10_000
"""Between the numbers of two hosts' cores."""
MOST_HOSTS = 20
"""So many strides fit into the 32 bits of a process's number."""


class ClockStep(BaseModel, frozen=True):
    """A host's clock jumped ``by_ns`` against the reference, between two of its times (ns)."""

    since_ns: int
    until_ns: int
    by_ns: int


class HostInfo(BaseModel, frozen=True):
    """A host of a joint recording, and what is known of its clock.

    The offset is its CLOCK_MONOTONIC less the reference's, both as recorded. Of the reference, all
    of it is 0.
    """

    name: str
    kernel: str
    messages_there: int = 0  # that this host took from others; bounds of the offset from above
    messages_back: int = 0  # that others took from it; bounds from below
    offset_ns: Interval = (0, 0)  # at the middle of the recording
    width_ns: int = 0  # of the interval of its clock, the median over time
    drift_ppm: tuple[float, float] = (0.0, 0.0)  # least and most of all pieces
    steps: tuple[ClockStep, ...] = ()
    claimed_ns: int | None = None  # the same offset as the wall clocks have it
    claim_is: str = ""  # "within", "wrong", or "taken": it is all that bounds one side


def host_of(number: Number) -> Number:
    """Return which host a process or a thread belongs to, from 0."""
    return number // HOST_STRIDE


def process_text(pid: int, hosts: tuple[HostInfo, ...]) -> str:
    """Text for a process: its number, behind its host's name where there are several."""
    if not hosts:
        return str(pid)
    return f"{hosts[host_of(pid)].name}:{pid % HOST_STRIDE}"
