"""The doctor's findings as tables and as plain data."""

from typing import Any

import polars as pl
from rich.markup import escape
from rich.table import Table

from chainshaper.doctor import MachineReport
from chainshaper.durations import format_duration, milliseconds

__all__ = ["machine_json", "machine_tables", "stall_rows"]

COLOURS = {"good": "green", "limited": "yellow", "absent": "red"}


def stall_rows(report: MachineReport) -> list[dict[str, Any]]:
    """Per core: stalls seen, their total and longest duration (ns)."""
    rows = []
    for index, core in enumerate(report.stall_meter.cores):
        stalls = report.stalls.filter(pl.col("cpu") == core)["duration"]
        rows.append(
            {
                "core": core,
                "count": len(stalls),
                "longest_ns": int(stalls.max() or 0),  # type: ignore[arg-type]
                "total_ns": int(stalls.sum()),
                "median_wakeup_ns": report.stall_meter.median_lateness_ns[index],
            }
        )
    return rows


def machine_json(report: MachineReport) -> dict[str, Any]:
    """All checks and stalls as plain data."""
    return {
        "checks": [vars(check) for check in report.checks],
        "stalls": stall_rows(report),
        "watched_ns": report.watched_ns,
        "threshold_ns": report.stall_meter.threshold_ns,
        "realtime": report.stall_meter.realtime,
    }


def machine_tables(report: MachineReport) -> tuple[Table, Table]:
    """What the machine can do, and how it stalls."""
    abilities = Table(title="This machine", title_justify="left")
    for name in ("", "found", "for", "remedy"):
        abilities.add_column(name, overflow="fold")
    for check in report.checks:
        colour = COLOURS[check.state]
        found = f"[{colour}]{escape(check.found)}[/]"
        abilities.add_row(check.name, found, check.needed_for, escape(check.remedy))
    watched = format_duration(report.watched_ns)
    threshold = format_duration(report.stall_meter.threshold_ns)
    title = escape(f"Stalls longer than {threshold} in {watched} [ms]")
    stalls = Table(title=title, title_justify="left")
    for name in ("core", "stalls", "longest", "total", "median wake-up"):
        stalls.add_column(name, justify="right")
    for row in stall_rows(report):
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
