"""What is in a recording: events, losses, clock, system; as tables and as plain data."""

from typing import Any

from rich.table import Table

from chainshaper.reporting.terminal import PlainTable
from chainshaper.values.recording import INFO_FILE, Recording, event_counts

__all__ = ["contents_json", "contents_table"]


def contents_json(recording: Recording) -> dict[str, Any]:
    """Counts per event, what was lost, the clock, and the system that was recorded."""
    info = recording.info
    return {
        "source": info.source,
        "events": dict(event_counts(recording).iter_rows()),
        "lost": info.lost,
        "clock_offset_ns": info.clock_offset_ns,
        "distribution": info.distribution,
        "rmw": info.rmw,
        "hosts": [host for host in info.host.split(", ") if host],
        "kernel": info.kernel,
        "processes": {str(pid): name for pid, name in info.processes.items()},
        "notes": [*info.notes, *_without_checksums(recording)],
    }


def _without_checksums(recording: Recording) -> list[str]:
    """Said of a recording from before there were checksums; a tracer's trace never has any."""
    if recording.info.checksums is not None or not (recording.path / INFO_FILE).is_file():
        return []
    return [
        "this recording has no checksums, so that damage to its files may go unseen: `chainshaper"
        " convert` writes one that has"
    ]


def contents_table(recording: Recording) -> tuple[Table, Table]:
    """The system that was recorded, and how often each event happened."""
    contents = contents_json(recording)
    system = PlainTable(title=str(recording.path), title_justify="left", show_header=False)
    system.add_column("")
    system.add_column("", overflow="fold")
    system.add_row("source", contents["source"])
    system.add_row("distribution", contents["distribution"] or "unknown")
    system.add_row("RMW", contents["rmw"] or "unknown")
    system.add_row("hosts", ", ".join(contents["hosts"]) or "unknown")
    system.add_row("clock offset", f"{contents['clock_offset_ns']} ns to CLOCK_REALTIME")
    for pid, name in contents["processes"].items():
        system.add_row(f"process {pid}", name)
    counts = PlainTable(title="Events", title_justify="left", show_footer=True)
    counts.add_column("event", "together")
    counts.add_column("count", f"{sum(contents['events'].values()):,}", justify="right")
    for name, count in contents["events"].items():
        counts.add_row(name, f"{count:,}")
    return system, counts
