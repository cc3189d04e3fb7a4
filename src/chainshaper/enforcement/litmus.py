"""The back end `litmus`: the paper's own servers, where the kernel is LITMUS^RT.

The P-RES plugin implements table-driven reservations (paper, section 2.2.1). All is done with the
tools of LITMUS^RT, by commands that can be printed instead.

* A reservation cannot be changed, listed or deleted. All are deleted together when another plugin
  is activated, which the kernel refuses while a thread is under SCHED_LITMUS. So another anchor
  makes new reservations, to which threads move one by one. Each runs freely for the two
  milliseconds that its command takes.
* Threads are attached one by one, and after DDS has created its threads, since a new thread runs in
  the reservation of the thread that created it. They are detached by giving them another class.
* Intervals ascend and are half-open, since `resctl` takes `[2,86] [86,87]` for overlapping. They
  count from time zero of CLOCK_MONOTONIC, so slots are turned by the anchor (:func:`turned`).

Upstream: liblitmus, `bin/resctl.c`, `doc/howto-use-resctl.md`, `doc/table-driven-scheduling.md`;
LITMUS^RT, `litmus/reservations/alloc.c`.
"""

import os
import subprocess
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from chainshaper.enforcement.journal import Journal
from chainshaper.enforcement.scheduling_memory import note_scheduling, release_threads
from chainshaper.enforcement.servers import BackEnd, ReservationServer, ServerTable, server_named
from chainshaper.linux.child_processes import is_installed, tool_environment
from chainshaper.linux.scheduling import SchedulingClass, SchedulingRequest, apply_scheduling
from chainshaper.linux.threads import find_thread, read_proc
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError, PlatformError, text_of

NOTE = "litmus-plugin"
Command = tuple[str, ...]
SCHED_LITMUS = 7
_PROC = Path("/proc/litmus")
_COMMAND_S = 10.0  # how long a command may take
_MOST_INTERVALS = 1024  # of a reservation
_SHORTEST_NS = 2  # interval
_PLUGIN = "P-RES"
_NO_PLUGIN = "Linux"


def missing(proc: Path = _PROC) -> str | None:
    """Say why the kernel has no LITMUS^RT servers, with the remedy; None: it has them."""
    if proc.is_dir():
        return None
    return (
        f"this kernel ({os.uname().release}) is not LITMUS^RT, there is no {proc}: boot one "
        "(https://litmus-rt.org), or use `--backend auto`; `--dry-run` prints the commands"
    )


class Litmus(BackEnd):
    """A table of servers in force as reservations; see :class:`.servers.BackEnd`.

    Raises PlatformError: the kernel is not LITMUS^RT, or its tools are not installed.
    OperationError: another program uses the plugin. InputError: as :func:`litmus_commands`.
    """

    def __init__(self, table: ServerTable, journal: Journal, proc: Path = _PROC) -> None:
        if (reason := missing(proc)) is not None:
            raise PlatformError(reason)
        for tool in ("setsched", "resctl"):
            if not is_installed(tool):
                raise PlatformError(f"{tool} is not on $PATH: build liblitmus, and add its folder")
        if _active_plugin(proc) == _PLUGIN:
            raise OperationError(
                f"the plugin {_PLUGIN} is active already, perhaps with others' reservations, which"
                f" go with ours: when they are not needed, `setsched {_NO_PLUGIN}`"
            )
        litmus_commands(table, {}, anchor_ns=0)  # raises InputError for a table that cannot be
        super().__init__(table)
        self._journal = journal
        self._proc = proc
        self._members: dict[int, ReservationServer] = {}  # by thread id
        self._ids: dict[str, int] = {}  # of reservations, by server name; empty before `arm`
        self._generation = 0  # how often reservations were made

    def assign(self, tid: int, server: str, place: int = 0) -> None:  # noqa: ARG002 - turns
        self._members[tid] = server_named(self._table, server)
        if self._ids:
            self._attach(tid)

    def arm(self, anchor_ns: int) -> None:
        moving = bool(self._ids)
        if not moving:
            self._journal.note(NOTE, previous=_active_plugin(self._proc), proc=str(self._proc))
            _run(("setsched", _PLUGIN))
        ids = _reservation_ids(self._table, self._generation)
        self._generation += 1
        for server in self._table.servers:
            _run(create_command(ids[server.name], server, self._table.cycle_ns, anchor_ns))
        self._ids = ids
        if moving:
            for thread in filter(None, map(find_thread, self._members)):
                apply_scheduling(thread, SchedulingRequest(0, None))
        self._attach(*self._members)
        self._since_ns = time.monotonic_ns()

    def failure(self) -> str | None:
        if not self._ids or (active := _active_plugin(self._proc)) == _PLUGIN:
            return None
        return f"the scheduler plugin was changed from {_PLUGIN} to {active}"

    def release(self) -> None:
        self._ids = {}
        release_threads(self._journal)
        restore_plugin(self._journal)

    def _attach(self, *tids: int) -> None:
        """Attach threads to the reservations of their servers; ended ones are passed over."""
        reserved = SchedulingClass(SCHED_LITMUS, 0, reset_on_fork=False)
        changes = [
            (thread, partial(replace, scheduling_class=reserved, cores=(self._members[tid].core,)))
            for tid in tids
            if (thread := find_thread(tid)) is not None
        ]
        for thread, _ in note_scheduling(self._journal, changes):
            server = self._members[thread.tid]
            try:
                _run(_attach_command(thread.tid, self._ids[server.name], server.core))
            except OperationError:
                if find_thread(thread.tid) is not None:
                    raise


def read_note(entry: Mapping[str, Any]) -> tuple[str, Path]:
    """Return what a journal's entry says: the plugin before ours, and LITMUS^RT's folder."""
    return str(entry["previous"]), Path(entry["proc"])


def restore_plugin(journal: Journal) -> None:
    """Activate the plugin that was active before ours; harmless when repeated.

    To be called when all threads are restored. Raises OperationError: the kernel refuses, as it
    does while one is under SCHED_LITMUS.
    """
    notes = journal.read(NOTE, read_note)
    if journal.outdated or not notes:
        return
    previous, proc = notes[0]
    if _active_plugin(proc) == _PLUGIN:
        _run(("setsched", _NO_PLUGIN))
        if previous != _NO_PLUGIN:
            _run(("setsched", previous))


def _active_plugin(proc: Path) -> str:
    """Return the name of the active plugin. Raises PlatformError: it cannot be read."""
    try:
        return text_of(read_proc(proc / "active_plugin")).strip()
    except OSError as error:
        raise PlatformError(
            f"{proc / 'active_plugin'} cannot be read ({error.strerror}): is this kernel LITMUS^RT?"
        ) from error


def _run(command: Command) -> None:
    """Run a command of LITMUS^RT. Raises OperationError: it fails, with what it said."""
    text = f"`{' '.join(command)}`"
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            check=False,
            env=tool_environment(),
            timeout=_COMMAND_S,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise OperationError(f"{text} cannot be run: {error}") from error
    if done.returncode:
        said = text_of(done.stderr + done.stdout).strip().splitlines()
        reason = said[0] if said else f"exit code {done.returncode}"
        raise OperationError(f"{text}: {reason}; `dmesg` has LITMUS^RT's own words")


def litmus_commands(
    table: ServerTable, members: Mapping[str, Sequence[int | str]], anchor_ns: int
) -> tuple[Command, ...]:
    """Return all commands that put a table in force, in order.

    ``members`` are, by server, the ids of threads, or texts for threads that do not run yet. Raises
    InputError: LITMUS^RT cannot have such a table.
    """
    ids, servers = _reservation_ids(table), table.servers
    create = (
        create_command(ids[server.name], server, table.cycle_ns, anchor_ns) for server in servers
    )
    attach = (
        _attach_command(tid, ids[server.name], server.core)
        for server in servers
        for tid in members.get(server.name, ())
    )
    return (("setsched", _PLUGIN), *create, *attach)


def _reservation_ids(table: ServerTable, generation: int = 0) -> dict[str, int]:
    """Return an id for each server, `core x 1000 + index`, different in every generation."""
    first = generation * len(table.servers) + 1
    return {
        server.name: server.core * 1000 + index
        for index, server in enumerate(table.servers, start=first)
    }


def create_command(
    number: int, server: ReservationServer, cycle_ns: int, anchor_ns: int
) -> Command:
    """Return the command that makes a reservation with cycles from ``anchor_ns`` on.

    Raises InputError: the server has too many slots, or too short ones.
    """
    slots = turned(server.slots, cycle_ns, anchor_ns)
    if len(slots) > _MOST_INTERVALS:
        most = f"LITMUS^RT takes {_MOST_INTERVALS}: use a shorter cycle, or another back end"
        raise InputError(f"server {server.name} has {len(slots)} slots, and {most}")
    for start, end in server.slots:
        if end - start < _SHORTEST_NS:
            raise InputError(
                f"server {server.name}: the slot at {duration_text(start)} is shorter than "
                f"{_SHORTEST_NS} ns, the least that LITMUS^RT takes: make it longer"
            )
    intervals = [f"[{milliseconds_text(start)},{milliseconds_text(end)})" for start, end in slots]
    identified = ("resctl", "-n", str(number), "-t", "table-driven", "-c", str(server.core))
    return (*identified, "-m", milliseconds_text(cycle_ns), "-q", str(server.priority), *intervals)


def _attach_command(tid: int | str, number: int, core: int) -> Command:
    return ("resctl", "-a", str(tid), "-r", str(number), "-c", str(core))


def milliseconds_text(duration_ns: int) -> str:
    """Return the shortest text in milliseconds that `resctl` turns into exactly this duration.

    `resctl` makes a C double of it, multiplies it by a million and drops the fraction.

    >>> milliseconds_text(86_500_000)
    '86.5'
    """
    whole, fraction = divmod(duration_ns, 1_000_000)
    text = f"{whole}.{fraction:06d}".rstrip("0").removesuffix(".")
    if int(float(text) * 1_000_000) != duration_ns:
        text = f"{whole}.{fraction:06d}5"  # half a nanosecond more, which is dropped
    return text


def turned(
    slots: Iterable[tuple[int, int]], cycle_ns: int, anchor_ns: int
) -> tuple[tuple[int, int], ...]:
    """Return slots, counted from an anchor, as counted from time zero instead; ascending.

    A slot across the end of the cycle becomes two. A piece that is too short for the kernel is left
    out.

    >>> turned([(10, 30)], cycle_ns=100, anchor_ns=1080)
    ((0, 10), (90, 100))
    """
    pieces = []
    for start, end in slots:
        first = (start + anchor_ns) % cycle_ns
        last = first + end - start
        pieces += [(first, min(last, cycle_ns)), (0, max(0, last - cycle_ns))]
    return tuple(sorted(piece for piece in pieces if piece[1] - piece[0] >= _SHORTEST_NS))
