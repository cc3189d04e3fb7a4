"""What a sweep found: a table for the terminal, and a figure."""

from pathlib import Path
from typing import Any

import polars as pl
from rich.table import Table

from chainshaper.reporting.cells import ABSENT, ms, terminal_table
from chainshaper.reporting.figures import new_figure, save_figure
from chainshaper.values.durations import format_duration
from chainshaper.values.safe_text import shown

__all__ = ["draw_sweep", "sweep_table"]

MOST_ROWS = 50
MOST_LINES = 12
_FIGURES = {
    "mean_ns": "average",
    "max_ns": "maximum",
    "jitter_ns": "jitter",
    "band_jitter_ns": "jitter\nin a band",
    "late": "late",
    "incomplete": "no output",
}


def sweep_table(frame: pl.DataFrame) -> Table:
    """The axes and the most important figures of each point, those of many only for the first."""
    axes = _axes(frame)
    names = [_name(name) for name in (*axes, *_FIGURES.values())]
    table = terminal_table("Simulated end-to-end latency [ms]", (), names)
    for row in frame.head(MOST_ROWS).to_dicts():
        values = [_value(name, row[name]) for name in axes]
        if row["error"] is None:
            table.add_row(*values, *(_figure(name, row[name]) for name in _FIGURES))
        else:
            table.add_row(*values, "failed")
    if frame.height > MOST_ROWS:
        table.caption = f"the first {MOST_ROWS} of {frame.height} points"
    return table


def draw_sweep(frame: pl.DataFrame, path: Path) -> Path:
    """Average and jitter over the first axis, a line for each combination of the others.

    Raises:
        OperationError: the picture cannot be written.
    """
    first, *others = _axes(frame)
    places = {value: place for place, value in enumerate(frame[first].unique(maintain_order=True))}
    figure, panels = new_figure(panels=2)
    lines = frame.partition_by(others, maintain_order=True) if others else [frame]
    for points in lines[:MOST_LINES]:
        name = ", ".join(f"{_name(axis)} {_value(axis, points[axis][0])}" for axis in others)
        for axes, column in zip(panels, ("mean_ns", "jitter_ns"), strict=True):
            # A point that failed has no value: the line has a gap there.
            heights = (points[column] / 1e6).to_list()
            axes.plot([places[value] for value in points[first]], heights, "o-", label=name)
    for axes, title in zip(panels, ("average latency", "jitter, max − min"), strict=True):
        axes.set_xticks(list(places.values()), [_value(first, value) for value in places])
        axes.set(xlabel=_name(first), ylabel=f"{title} [ms]")
        axes.set_ylim(bottom=0)
    if others:
        more = f" (the first {MOST_LINES} of {len(lines)})" if len(lines) > MOST_LINES else ""
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", title=more)
    return save_figure(figure, path)


def _axes(frame: pl.DataFrame) -> list[str]:
    """Axes stand before what all sweeps have; a seed that is varied is one of them."""
    return frame.columns[: frame.columns.index("cycles")]


def _name(column: str) -> str:
    return column.removesuffix("_ns")


def _value(name: str, value: Any) -> str:
    if value is None:
        return ABSENT
    return format_duration(value) if name.endswith("_ns") else shown(str(value))


def _figure(name: str, value: Any) -> str:
    return ms(value) if value is None or name.endswith("_ns") else str(value)
