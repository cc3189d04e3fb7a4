"""Figures: latency per cycle, its distribution with the publish slots, figure 7, sweeps.

The colours differ for colour-blind readers and in grey print as well.
"""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from chainshaper.planning import BandChoice
from chainshaper.planning.overruns import slots_of_latency
from chainshaper.reporting.latency import write_comparison_json
from chainshaper.reporting.overviews import sweep_axes, sweep_value
from chainshaper.values.errors import InputError, OperationError, shown
from chainshaper.values.files import new_file, why_distrusted, write_whole
from chainshaper.verify.measure import Comparison, Measurement

COLOURS = ("#d95f02", "#1b6ca8", "#4d9221", "#7b3294")
SIZE_INCHES = (9.0, 4.2)
MOST_LINES = 12  # of a sweep
ENDINGS = (".png", ".pdf", ".svg")


def write_comparison(comparison: Comparison, folder: Path) -> None:
    """Write `comparison.json`, `latency.png` and `distribution.png` into a folder.

    Raises OperationError: they cannot be written.
    """
    draw_comparison(comparison.measurements, folder)
    write_comparison_json(comparison, folder)


def draw_comparison(measurements: Sequence[Measurement], folder: str | Path) -> tuple[Path, Path]:
    """Draw `latency.png` and `distribution.png` into a folder, which is made if needed.

    Raises InputError: one of the files exists already. OperationError: they cannot be written.
    """
    latency, distribution = Path(folder) / "latency.png", Path(folder) / "distribution.png"
    for path in (latency, distribution):
        if path.exists():
            raise InputError(f"{path} exists already and is not overwritten: name another folder")
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OperationError(f"{folder}: the folder cannot be made: {error}") from error
    return draw_latency(measurements, latency), draw_distribution(measurements, distribution)


@contextmanager
def _user_style() -> Iterator[None]:
    """Draw in the user's style of matplotlib, unless others may have written that file.

    The style of a program that calls this is not changed.
    """
    import matplotlib as mpl

    with mpl.rc_context():
        style = Path(mpl.matplotlib_fname())
        if style.parent == Path.cwd() or why_distrusted(style) is not None:
            mpl.rcdefaults()  # the file may start TeX, with a preamble that others wrote
        yield


@_user_style()
def draw_latency(measurements: Sequence[Measurement], path: str | Path) -> Path:
    """Draw the end-to-end latency of every cycle, all recordings in one picture (paper, figure 6).

    Crosses mark cycles that the machine disturbed. The picture ends a little above the highest
    undisturbed cycle.
    """
    figure, axes = _new_figure()
    for measurement, colour in zip(measurements, cycle(COLOURS), strict=False):
        frame = measurement.analysis.traversals.filter("complete")
        cycles = np.arange(len(frame))
        latency = frame["latency_ns"].to_numpy() / 1e6
        hit = frame["disturbed"].to_numpy()
        name, jitter = measurement.recording.path.name, measurement.analysis.undisturbed.jitter_ns
        label = name if jitter is None else f"{name}: jitter {jitter / 1e6:.3f} ms"
        axes.plot(cycles[~hit], latency[~hit], ".", markersize=4, color=colour, label=label)
        axes.plot(cycles[hit], latency[hit], "x", markersize=5, color=colour, alpha=0.7)
    axes.set(xlabel="cycle (crosses: disturbed by the machine)", ylabel="end-to-end latency [ms]")
    return _save_chain(figure, axes, measurements, path)


@_user_style()
def draw_distribution(measurements: Sequence[Measurement], path: str | Path) -> Path:
    """Draw the cumulative distribution of undisturbed latencies, with publish slots shaded."""
    figure, axes = _new_figure()
    for measurement, colour in zip(measurements, cycle(COLOURS), strict=False):
        latency = np.sort(measurement.analysis.calm["latency_ns"].to_numpy()) / 1e6
        share = np.arange(1, len(latency) + 1) / max(1, len(latency))
        label = f"{measurement.recording.path.name} ({len(latency)} cycles)"
        axes.step(latency, share, where="post", color=colour, label=label)
        slots = () if measurement.plan is None else slots_of_latency(measurement.plan)
        for number, (start, end) in enumerate(slots):
            in_legend = None if number else "publish slot"  # once
            axes.axvspan(start / 1e6, end / 1e6, color="0.8", zorder=0, label=in_legend)
    axes.set(xlabel="end-to-end latency [ms]", ylabel="share of cycles")
    return _save_chain(figure, axes, measurements, path, vertical=False)


def _save_chain(
    figure: Any,
    axes: Any,
    measurements: Sequence[Measurement],
    path: str | Path,
    *,
    vertical: bool = True,
) -> Path:
    """Add title and legend and save a figure whose ``vertical`` or horizontal axis has latencies.

    The axis ends at undisturbed latencies: else single disturbed cycles, which waited for another
    slot, squeeze all others into a line.
    """
    highest = max(measurement.analysis.undisturbed.max_ns or 0 for measurement in measurements)
    limit_ms = highest / 1e6 * 1.15
    if highest and vertical:
        axes.set_ylim(0, limit_ms)
    elif highest:
        axes.set_xlim(0, limit_ms)
    axes.set_title(f"Chain {measurements[0].analysis.chain.spec}", loc="left")
    axes.legend(loc="lower right" if vertical else "upper left")
    return _save_figure(figure, path)


@_user_style()
def draw_curve(choice: BandChoice, path: str | Path) -> Path:
    """Draw the average latency over the number of bands (paper, figure 7); mark the chosen number.

    Raises InputError: the file exists already, or ends as no picture does. OperationError: it
    cannot be written.
    """
    path = new_file(path, ENDINGS)
    figure, axes = _new_figure()
    bands = [len(placement.slot_ends_ns) for placement in choice.curve]
    means = [placement.mean_ns / 1e6 for placement in choice.curve]
    axes.plot(bands, means, "o-", color=COLOURS[1], label="best placement")
    axes.plot(
        len(choice.chosen.slot_ends_ns),
        choice.chosen.mean_ns / 1e6,
        "o",
        markersize=12,
        fillstyle="none",
        color=COLOURS[0],
        label=choice.reason,
    )
    axes.set_xticks(bands)
    axes.set(xlabel="number of latency bands", ylabel="average latency, eq. 5 [ms]")
    axes.legend(loc="upper right")
    return _save_figure(figure, path)


@_user_style()
def draw_sweep(frame: pl.DataFrame, path: Path) -> Path:
    """Draw average and jitter over the first axis, a line for each combination of the others.

    Raises OperationError: the picture cannot be written.
    """
    first, *further_axes = sweep_axes(frame)
    places = {value: place for place, value in enumerate(frame[first].unique(maintain_order=True))}
    figure, panels = _new_figure(panels=2)
    lines = frame.partition_by(further_axes, maintain_order=True) if further_axes else [frame]
    for points in lines[:MOST_LINES]:
        name = ", ".join(
            f"{axis.removesuffix('_ns')} {sweep_value(axis, points[axis][0])}"
            for axis in further_axes
        )
        for axes, column in zip(panels, ("mean_ns", "jitter_ns"), strict=True):
            # A point that failed has no value: the line has a gap there.
            heights = (points[column] / 1e6).to_list()
            axes.plot([places[value] for value in points[first]], heights, "o-", label=name)
    for axes, title in zip(panels, ("average latency", "jitter, max − min"), strict=True):
        axes.set_xticks(list(places.values()), [sweep_value(first, value) for value in places])
        axes.set(xlabel=first.removesuffix("_ns"), ylabel=f"{title} [ms]")
        axes.set_ylim(bottom=0)
    if further_axes:
        more = f" (the first {MOST_LINES} of {len(lines)})" if len(lines) > MOST_LINES else ""
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", title=more)
    return _save_figure(figure, path)


def _new_figure(panels: int = 1) -> tuple[Any, Any]:
    """Make a figure and its axes; if there are several panels, a sequence of axes."""
    from matplotlib.figure import Figure

    figure = Figure(SIZE_INCHES, layout="constrained")
    axes = figure.subplots(1, panels)
    for panel in figure.axes:
        panel.grid(alpha=0.3)
    return figure, axes


def _save_figure(figure: Any, path: str | Path) -> Path:
    """Write a figure in the format that its file's ending names.

    Raises OperationError: it cannot be written.
    """
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        if text.get_text():  # the numbers at the axes have no text yet
            text.set_parse_math(False)  # a name may have dollars
            text.set_text(shown(text.get_text(), but="\n"))
    path, picture = Path(path), io.BytesIO()
    figure.savefig(picture, dpi=130, format=path.suffix.removeprefix(".") or None)
    return write_whole(path, [picture.getvalue()])
