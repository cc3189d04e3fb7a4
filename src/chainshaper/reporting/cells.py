"""How values stand in the cells of tables, on the terminal and in the report."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.table import Table

from chainshaper.planning.plan import Server
from chainshaper.reporting.terminal import PlainTable
from chainshaper.values.durations import format_duration, milliseconds

__all__ = [
    "ABSENT",
    "FIGURES",
    "YES_NO",
    "count",
    "min_mean_max",
    "ms",
    "percent",
    "slot_ms",
    "slots_ms",
    "terminal_table",
    "thread_nodes",
    "trigger",
]

ABSENT = "–"
YES_NO: dict[bool | None, str] = {True: "yes", False: "no"}
FIGURES = (
    ("average", "mean_ns"),
    ("minimum", "min_ns"),
    ("maximum", "max_ns"),
    ("jitter (max − min)", "jitter_ns"),
    ("spread p0.5–p99.5", "spread_ns"),
)
"""What tables say of latencies, and the fields of their statistics."""


def terminal_table(title: str, texts: Iterable[str], figures: Iterable[str] = ()) -> Table:
    """An empty table: columns of texts, folded where there is no room, then of figures."""
    table = PlainTable(title=title, title_justify="left")
    for name in texts:
        table.add_column(name, overflow="fold")
    for name in figures:
        table.add_column(name, justify="right")
    return table


def ms(nanoseconds: float | None) -> str:
    """Milliseconds, where there are any."""
    return ABSENT if nanoseconds is None else milliseconds(nanoseconds)


def count(number: int | None) -> str:
    """A number, where it is known."""
    return ABSENT if number is None else str(number)


def min_mean_max(times: Mapping[str, float] | None) -> list[str]:
    """Three cells of a struct of times, where there is one."""
    return [ms(None if times is None else times[name]) for name in ("min", "mean", "max")]


def percent(share: float | None) -> str:
    """A share of one, where there is any."""
    return ABSENT if share is None else f"{share:.1%}"


def slot_ms(start_ns: int, end_ns: int) -> str:
    """``[64.213, 65.213)``."""
    return f"[{milliseconds(start_ns)}, {milliseconds(end_ns)})"


def slots_ms(slots: Sequence[tuple[int, int]]) -> str:
    """Several of them."""
    return " ".join(slot_ms(*slot) for slot in slots)


def thread_nodes(server: Server) -> str:
    """Whose threads a server lets run."""
    return ", ".join(
        thread.node + (" (publisher)" if thread.role == "publisher" else "")
        for thread in server.threads
    )


def trigger(callback: Mapping[str, Any]) -> str:
    """What starts a callback, of a row of callback statistics: ``timer every 100ms``."""
    period = callback["period_ns"]
    what = callback["topic"] if period is None else f"every {format_duration(period)}"
    return f"{callback['kind']} {what or ''}".rstrip()
