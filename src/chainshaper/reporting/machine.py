"""The doctor's findings as tables and as plain data."""

from typing import Any

import polars as pl
from rich.table import Table

from chainshaper.reporting.cells import terminal_table
from chainshaper.reporting.terminal import plain
from chainshaper.values.durations import format_duration, milliseconds
from chainshaper.values.machine import MachineReport
from chainshaper.values.recording import StallMeterInfo

__all__ = ["machine_json", "machine_tables", "stall_rows"]

COLOURS = {"good": "green", "limited": "yellow", "absent": "red"}


def stall_rows(meter: StallMeterInfo, stalls: pl.DataFrame) -> list[dict[str, Any]]:
    """Per core: stalls seen, of the columns ``cpu, duration``; their total and longest (ns)."""
    rows = []
    for core, usual in zip(meter.cores, meter.median_lateness_ns, strict=True):
        own = stalls.filter(cpu=core)["duration"].to_list()
        counts = {"core": core, "count": len(own), "longest_ns": max(own, default=0)}
        rows.append({**counts, "total_ns": sum(own), "median_wakeup_ns": usual})
    return rows


def machine_json(report: MachineReport) -> dict[str, Any]:
    """All checks and stalls as plain data."""
    return {
        "checks": [vars(check) for check in report.checks],
        "stalls": stall_rows(report.stall_meter, report.stalls),
        "watched_ns": report.watched_ns,
        "threshold_ns": report.stall_meter.threshold_ns,
        "realtime": report.stall_meter.realtime,
    }


def machine_tables(report: MachineReport) -> tuple[Table, Table]:
    """What the machine can do, and how it stalls."""
    abilities = terminal_table("This machine", ("", "found", "for", "remedy"))
    for check in report.checks:
        found = plain(check.found, COLOURS[check.state])
        abilities.add_row(check.name, found, check.needed_for, check.remedy)
    watched = format_duration(report.watched_ns)
    threshold = format_duration(report.stall_meter.threshold_ns)
    title = f"Stalls longer than {threshold} in {watched} [ms]"
    figures = ("core", "stalls", "longest", "total", "median wake-up")
    stalls = terminal_table(title, (), figures)
    for row in stall_rows(report.stall_meter, report.stalls):
        stalls.add_row(
            str(row["core"]),
            str(row["count"]),
            milliseconds(row["longest_ns"]),
            milliseconds(row["total_ns"]),
            milliseconds(row["median_wakeup_ns"]),
        )
    if not report.stall_meter.realtime:
        stalls.caption = "taken without SCHED_FIFO: ordinary scheduling is among these stalls"
    return abilities, stalls
