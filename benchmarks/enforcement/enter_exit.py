"""How exactly each back end lets threads in and out of their slots, and what that costs.

    python benchmarks/enforcement/enter_exit.py [--slots N] [--back-end NAME]

One table: every back end that this machine offers, with and without two busy processes per core
beside it, up to 32 servers. A thread that reads the clock without pause is gated, and tells when it
ran (`gated_spinners.py`). For the back ends that are not measured a line says why.

Machine stalls are watched from another core meanwhile: `max*` leaves out the slots at whose start
or end one was under way. All figures are of one machine in one session: compare rows, not machines.
Nothing is asserted; the figures to reach stand in the last row.
"""

import argparse
import contextlib
import os
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from gated_spinners import Exactness, compare_with_slots, load_beside, read_windows, spinners
from rich.console import Console
from rich.table import Table

from chainshaper.enforcement.back_ends import gates, make_back_end, offered_back_ends
from chainshaper.enforcement.freezer import Freezer
from chainshaper.enforcement.journal import discard_journal, open_journal
from chainshaper.enforcement.servers import BackEnd, ReservationServer, ServerTable
from chainshaper.linux.scheduling import available_cores, may_use_fifo
from chainshaper.workload.stall_meter import measure_stalls

MS = 1_000_000
CORE, OTHER_CORE = available_cores()[-1], available_cores()[0]
ELSEWHERE = {
    "scx": "measured in deterministic virtual time by `make test-kernel`; docs/servers_scx.md has "
    "the figures",
}
"""Where to find the figures of a back end that this machine lacks."""


@dataclass(frozen=True)
class Case:
    """A table to measure with, and which of its servers' threads are started.

    ``back_ends`` are those that it makes sense for (None: all).
    """

    title: str
    table: ServerTable
    threads: tuple[str, ...]
    back_ends: tuple[str, ...] | None = None

    @property
    def measured(self) -> ReservationServer:
        """The server whose thread is looked at: the last one."""
        return next(s for s in self.table.servers if s.name == self.threads[-1])


@dataclass(frozen=True)
class Outcome:
    """What one case has shown; ``cost_per_slot`` is CPU time (ns), None inside the kernel."""

    case: str
    back_end: str
    loaded: bool
    exactness: Exactness
    late_entries: int | None
    cost_per_slot: float | None
    longest_stall_ns: int


def cases() -> tuple[Case, ...]:
    """From one server on a core that is idle before its slot, to 32 without a pause."""

    def server(name: str, start: int, end: int, core: int = CORE) -> ReservationServer:
        return ReservationServer(name, core, 1, ((start * MS, end * MS),))

    turns = ServerTable(10 * MS, (server("a", 1, 5), server("b", 5, 9)))
    many = ServerTable(40 * MS, tuple(server(f"s{n}", n, n + 1) for n in range(32)))
    # A freezer's dispatcher may sit on another core than the threads; kernels have no dispatcher.
    apart = ServerTable(10 * MS, (server("a", 3, 7, OTHER_CORE),))
    return (
        Case("idle before", ServerTable(10 * MS, (server("a", 3, 7),)), ("a",)),
        Case("taking turns", turns, ("a", "b")),
        Case("32 servers", many, ("s14", "s15", "s16")),
        Case("from another core", apart, ("a",), ("freezer",)),
    )


@contextlib.contextmanager
def in_hand(back_end: str, table: ServerTable, folder: Path) -> Iterator[BackEnd]:
    """The servers of a table, released when the block ends."""
    journal = open_journal(folder)
    servers = make_back_end(back_end, table, journal)
    try:
        yield servers
    finally:
        servers.release()
        discard_journal(journal)


def measure(back_end: str, case: Case, slots: int, loaded: bool, folder: Path) -> Outcome:
    """Gate the spinners of a case for so many cycles; ``folder`` is for what they write."""
    seconds = (slots + 5) * case.table.cycle_ns / 1e9
    # The kernel's own servers take threads of the fair class; freezing holds any.
    fifo = back_end == "freezer" and may_use_fifo()
    with in_hand(back_end, case.table, folder) as servers:
        with (
            load_beside(loaded),
            ThreadPoolExecutor() as pool,
            spinners(folder, case.threads, CORE, seconds, fifo=fifo) as pids,
        ):
            for name, pid in pids.items():
                servers.assign(pid, name)
            servers.arm(0)
            _await_first_cycle(servers)
            watching = pool.submit(measure_stalls, [OTHER_CORE], int(seconds * 1e9), may_use_fifo())
            spent, opened = _spent(servers, case.measured.core), _slots_opened(servers)
        found = watching.result()[0]
        spent = _spent(servers, case.measured.core) - spent
        opened = _slots_opened(servers) - opened
        late = servers.counters()[case.measured.name].late_entries
    stalls = found.select("time", "duration").to_numpy()
    windows = read_windows(folder / case.threads[-1])
    return Outcome(
        case=case.title,
        back_end=back_end,
        loaded=loaded,
        exactness=compare_with_slots(case.measured, case.table.cycle_ns, 0, windows, stalls),
        late_entries=late,
        cost_per_slot=spent / max(1, opened) if spent else None,
        longest_stall_ns=int(stalls[:, 1].max(initial=0)),
    )


def _await_first_cycle(servers: BackEnd) -> None:
    """The freezer is in force from the next cycle on, the others when `arm` returns."""
    begin = servers.in_force_from() if isinstance(servers, Freezer) else None
    time.sleep(max(0, (begin or 0) - time.monotonic_ns()) / 1e9)


def _spent(servers: BackEnd, core: int) -> int:
    """CPU time (ns) of the process that opens and closes slots on a core; 0 where there is none."""
    if not isinstance(servers, Freezer):
        return 0
    return int(Path(f"/proc/{servers.dispatchers[core]}/schedstat").read_text().split()[0])


def _slots_opened(servers: BackEnd) -> int:
    return sum(counters.slots or 0 for counters in servers.counters().values())


def table_of(outcomes: list[Outcome]) -> Table:
    """One row per back end, case and load; times in µs."""
    table = Table(title="Enter and exit error [µs]")
    table.add_column("")
    names = ["", "slots", *_headings("enter"), *_headings("exit"), "leakage\n[%]"]
    for name in (*names[1:], "late\n> 100 µs", "CPU time\nper slot", "longest\nstall"):
        table.add_column(name, justify="right")
    for one in outcomes:
        exact = one.exactness
        table.add_row(
            f"{one.back_end}, {one.case}{', loaded' * one.loaded}",
            str(len(exact.enter)),
            *_figures(exact.enter, exact.enter_disturbed),
            *_figures(exact.leave, exact.leave_disturbed),
            f"{100 * exact.leakage:.3f}",
            "–" if one.late_entries is None else str(one.late_entries),
            "–" if one.cost_per_slot is None else f"{one.cost_per_slot / 1000:.1f}",
            f"{one.longest_stall_ns / 1000:.0f}",
        )
    table.add_section()
    table.add_row("to reach: freezer, same core", "", "≤ 50", *[""] * 3, "≤ 10", *[""] * 3, "< 1.5")
    return table


def _headings(of_what: str) -> list[str]:
    return [f"{of_what}\n{figure}" for figure in ("p50", "p99", "max", "max*")]


def _figures(values: np.ndarray, disturbed: np.ndarray) -> list[str]:
    """Median, 99th percentile, maximum, and the maximum of those that no stall was near."""
    calm = values[~disturbed]
    figures = [*np.percentile(values, (50, 99)), values.max()]
    return [f"{v / 1000:.1f}" for v in figures] + [f"{calm.max() / 1000:.1f}" if len(calm) else "–"]


def main() -> None:
    parser = argparse.ArgumentParser(description="Enter and exit errors of the back ends.")
    parser.add_argument("--slots", type=int, default=500, help="slots per row")
    parser.add_argument("--back-end", help="only this one")
    options = parser.parse_args()
    wanted = [o for o in offered_back_ends() if options.back_end in (None, o.name)]
    if not wanted:
        parser.error(f"no back end {options.back_end!r}")
    chosen, lines = [], []
    for offer in wanted:
        if not gates(offer.name):
            lines.append(f"{offer.name}: does not gate, so it has neither enter nor exit")
        elif offer.missing is None:
            chosen.append(offer.name)
        else:
            where = ELSEWHERE.get(offer.name)
            lines.append(f"{offer.name}: {offer.missing}" + (f"; {where}" if where else ""))
    outcomes = []
    with tempfile.TemporaryDirectory(prefix="chainshaper-benchmark-") as name:
        for back_end in chosen:
            for case in (c for c in cases() if c.back_ends is None or back_end in c.back_ends):
                for loaded in (False, True):
                    outcomes.append(measure(back_end, case, options.slots, loaded, Path(name)))
    if outcomes:
        Console(width=160).print(table_of(outcomes))
    for line in (*lines, f"loaded: two busy processes per core; load now {os.getloadavg()[0]:.1f}"):
        print(line)


if __name__ == "__main__":
    main()
