"""Figures: latency per cycle, its parts hop by hop, its distribution, plans, figure 7, sweeps.

The colours differ for colour-blind readers and in grey print as well.
"""

import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper.analysis import LatencyAnalysis, recorded_flow
from chainshaper.planning import BandChoice, ChainPlan
from chainshaper.planning.overruns import slots_of_latency
from chainshaper.reporting.cycle_parts import OPACITY, stacked_cycles
from chainshaper.reporting.graph_drawing import png_of, timed_graph_svg
from chainshaper.reporting.latency import write_comparison_json
from chainshaper.reporting.overviews import sweep_axes, sweep_value
from chainshaper.reporting.page import slot_bars
from chainshaper.values.errors import InputError, OperationError, shown
from chainshaper.values.files import new_file, why_distrusted, write_whole
from chainshaper.verify.measure import Comparison, Measurement, hop_names

COLOURS = ("#d95f02", "#1b6ca8", "#4d9221", "#7b3294")
SIZE_INCHES = (9.0, 4.2)
MOST_CYCLES = 2_000  # whose parts are drawn
MOST_LINES = 12  # of a sweep
ENDINGS = (".png", ".pdf", ".svg")


def write_comparison(comparison: Comparison, folder: Path) -> None:
    """Write `comparison.json` and the pictures of :func:`draw_comparison` into a folder.

    Raises OperationError: they cannot be written.
    """
    draw_comparison(comparison.measurements, folder)
    write_comparison_json(comparison, folder)


def draw_comparison(measurements: Sequence[Measurement], folder: str | Path) -> tuple[Path, ...]:
    """Draw `latency.png`, `hops.png` and `distribution.png` into a folder, made if needed.

    Raises InputError: one of the files exists already. OperationError: they cannot be written.
    """
    drawings = {
        "latency.png": draw_latency,
        "hops.png": draw_hops,
        "distribution.png": draw_distribution,
    }
    paths = new_pictures(folder, drawings)
    for path, draw in zip(paths, drawings.values(), strict=True):
        draw(measurements, path)
    return paths


def draw_measurement(measurement: Measurement, folder: str | Path) -> tuple[Path, ...]:
    """Draw the pictures of :func:`draw_comparison`, and `graph.png`, the graph with its times.

    Raises: as :func:`draw_comparison`.
    """
    (graph,) = new_pictures(folder, ["graph.png"])
    drawn = draw_comparison([measurement], folder)
    flow, analysis = recorded_flow(measurement.recording), measurement.analysis
    drawing = timed_graph_svg(flow, analysis.graph, analysis.chain)
    return (*drawn, write_whole(graph, [png_of(drawing)]))


def new_pictures(folder: str | Path, names: Iterable[str]) -> tuple[Path, ...]:
    """Return the paths of new files in a folder, which is made if needed.

    Raises InputError: one of them exists already. OperationError: the folder cannot be made.
    """
    paths = tuple(Path(folder) / name for name in names)
    for path in paths:
        if path.exists():
            raise InputError(f"{path} exists already and is not overwritten: name another folder")
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OperationError(f"{folder}: the folder cannot be made: {error}") from error
    return paths


@contextmanager
def user_style() -> Iterator[None]:
    """Draw in the user's style of matplotlib, unless others may have written that file.

    The style of a program that calls this is not changed.
    """
    import matplotlib as mpl

    with mpl.rc_context():
        style = Path(mpl.matplotlib_fname())
        if style.parent == Path.cwd() or why_distrusted(style) is not None:
            mpl.rcdefaults()  # the file may start TeX, with a preamble that others wrote
        yield


@user_style()
def draw_latency(measurements: Sequence[Measurement], path: str | Path) -> Path:
    """Draw the latency of every cycle, all recordings in one picture (:func:`latency_figure`)."""
    return save_figure(latency_figure(measurements), path)


def latency_figure(measurements: Sequence[Measurement]) -> Any:
    """Make the figure of the latency of every cycle, all recordings in one (paper, figure 6).

    Crosses mark cycles that the machine disturbed. The picture ends a little above the highest
    undisturbed cycle; triangles at its upper edge mark the cycles beyond.
    """
    figure, axes = new_figure()
    limit_ms = _limit_ms([measurement.analysis for measurement in measurements])
    beyond = False
    for measurement, colour in zip(measurements, cycle(COLOURS), strict=False):
        frame = measurement.analysis.traversals.filter("complete")
        cycles = np.arange(len(frame))
        latency = frame["latency_ns"].to_numpy() / 1e6
        hit = frame["disturbed"].to_numpy()
        name, jitter = measurement.recording.path.name, measurement.analysis.undisturbed.jitter_ns
        label = name if jitter is None else f"{name}: jitter {jitter / 1e6:.3f} ms"
        axes.plot(cycles[~hit], latency[~hit], ".", markersize=4, color=colour, label=label)
        axes.plot(cycles[hit], latency[hit], "x", markersize=5, color=colour, alpha=0.7)
        beyond |= _mark_beyond(axes, cycles, latency, limit_ms, colour)
    about = "crosses: disturbed by the machine"
    about += "; triangles: beyond the axis" if beyond else ""
    axes.set(xlabel=f"cycle ({about})", ylabel="end-to-end latency [ms]")
    return _with_title(figure, axes, measurements)


def _mark_beyond(
    axes: Any,
    cycles: NDArray[np.int64],
    latency_ms: NDArray[np.float64],
    limit_ms: float,
    colour: str,
) -> bool:
    """Mark cycles that are longer than the axis is, at its end; return whether there are any."""
    beyond = cycles[latency_ms > limit_ms] if limit_ms else cycles[:0]
    if not len(beyond):
        return False
    edge = np.full(len(beyond), limit_ms)
    axes.plot(beyond, edge, "^", markersize=6, color=colour, clip_on=False, zorder=5)
    return True


@user_style()
def draw_hops(measurements: Sequence[Measurement], path: str | Path) -> Path:
    """Draw the latency of every cycle, stacked by hop, a panel for each recording.

    Of each hop, from below: communication (pale), computation (full), waiting (palest), in the
    order in which a message meets them. Of more than `MOST_CYCLES` the extremes of every stretch
    and a sample are drawn. The picture ends a little above the highest undisturbed cycle.
    """
    analyses = [measurement.analysis for measurement in measurements]
    titles = [measurement.recording.path.name for measurement in measurements]
    return save_figure(hops_figure(analyses, titles), path)


def hops_figure(analyses: Sequence[LatencyAnalysis], titles: Sequence[str]) -> Any:
    """Make the figure of :func:`draw_hops`, with a title for each analysis."""
    from matplotlib.patches import Patch

    figure, _ = new_figure(len(analyses))
    panels = figure.axes
    named = dict.fromkeys(name for analysis in analyses for name in hop_names(analysis))
    colours = dict(zip(named, cycle(COLOURS), strict=False))
    highest = _limit_ms(analyses)
    for panel, analysis, title in zip(panels, analyses, titles, strict=True):
        _stack(panel, analysis, colours, highest)
        panel.set_title(title, loc="left")
        panel.set(xlabel="cycle", ylim=(0, highest or None))
    panels[0].set_ylabel("latency, hop by hop [ms]")
    looks = [Patch(color=colours[name], label=name) for name in reversed(named)]
    looks += [Patch(color="0.3", alpha=opacity, label=part) for part, opacity in OPACITY.items()]
    figure.legend(handles=looks, loc="outside lower center", ncols=min(4, len(looks)))
    return figure


def _stack(
    panel: Any, analysis: LatencyAnalysis, colours: Mapping[str, str], limit_ms: float
) -> None:
    """Draw the parts of each hop over the cycles of an analysis, one upon the other."""
    stacked = stacked_cycles(analysis, MOST_CYCLES)
    cycles, below = stacked.cycles, np.zeros(len(stacked.cycles))
    for hop, name in enumerate(hop_names(analysis)):
        for part, opacity in OPACITY.items():
            above = below + stacked.parts_ns[part][:, hop] / 1e6
            look = {"color": colours[name], "alpha": opacity, "linewidth": 0}
            panel.fill_between(cycles, below, above, step="mid", **look)
            below = above
    if _mark_beyond(panel, cycles, below, limit_ms, "black"):
        panel.set_xlabel("cycle (triangles: beyond the axis)")


@user_style()
def draw_distribution(measurements: Sequence[Measurement], path: str | Path) -> Path:
    """Draw the cumulative distribution of undisturbed latencies, with publish slots shaded."""
    figure, axes = new_figure()
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
    return save_figure(_with_title(figure, axes, measurements, vertical=False), path)


def _with_title(
    figure: Any, axes: Any, measurements: Sequence[Measurement], *, vertical: bool = True
) -> Any:
    """Add title and legend to a figure whose ``vertical`` or horizontal axis has latencies.

    The axis ends at undisturbed latencies: else single disturbed cycles, which waited for another
    slot, squeeze all others into a line.
    """
    limit_ms = _limit_ms([measurement.analysis for measurement in measurements])
    if limit_ms and vertical:
        axes.set_ylim(0, limit_ms)
    elif limit_ms:
        axes.set_xlim(0, limit_ms)
    axes.set_title(f"Chain {measurements[0].analysis.chain.spec}", loc="left")
    axes.legend(loc="lower right" if vertical else "upper left")
    return figure


def _limit_ms(analyses: Sequence[LatencyAnalysis]) -> float:
    """Return where an axis of latencies ends: above the highest undisturbed one (0: none is)."""
    return max(analysis.undisturbed.max_ns or 0 for analysis in analyses) / 1e6 * 1.15


@user_style()
def draw_curve(choice: BandChoice, path: str | Path) -> Path:
    """Draw the average latency over the number of bands (paper, figure 7); mark the chosen number.

    Raises InputError: the file exists already, or ends as no picture does. OperationError: it
    cannot be written.
    """
    path = new_file(path, ENDINGS)
    figure, axes = new_figure()
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
    return save_figure(figure, path)


@user_style()
def draw_sweep(frame: pl.DataFrame, path: Path) -> Path:
    """Draw average and jitter over the first axis, a line for each combination of the others.

    Raises OperationError: the picture cannot be written.
    """
    first, *further_axes = sweep_axes(frame)
    places = {value: place for place, value in enumerate(frame[first].unique(maintain_order=True))}
    figure, panels = new_figure(panels=2)
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
    return save_figure(figure, path)


def new_figure(panels: int = 1) -> tuple[Any, Any]:
    """Make a figure and its axes; if there are several panels, a sequence of axes."""
    from matplotlib.figure import Figure

    figure = Figure(SIZE_INCHES, layout="constrained")
    axes = figure.subplots(1, panels)
    for panel in figure.axes:
        panel.grid(alpha=0.3)
    return figure, axes


def save_figure(figure: Any, path: str | Path) -> Path:
    """Write a figure in the format that its file's ending names.

    Raises OperationError: it cannot be written.
    """
    path = Path(path)
    return write_whole(path, [_painted(figure, path.suffix.removeprefix(".") or None)])


def _painted(figure: Any, file_format: str | None) -> bytes:
    """Paint a figure; its names are literal text."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        if text.get_text():  # the numbers at the axes have no text yet
            text.set_parse_math(False)  # a name may have dollars
            text.set_text(shown(text.get_text(), but="\n"))
    picture = io.BytesIO()
    figure.savefig(picture, dpi=130, format=file_format)
    return picture.getvalue()


@user_style()
def png_of_figure(make: Callable[..., Any], *values: Any) -> bytes:
    """Paint the figure that ``make`` makes of ``values``, as PNG."""
    return _painted(make(*values), "png")


def plan_figure(plan: ChainPlan) -> Any:
    """Make the figure of a plan: the slots of each server over one cycle."""
    figure, axes = new_figure()
    bars = slot_bars(plan)
    for place, (_, slots) in enumerate(bars["rows"]):
        for start, end, series, *_ in slots:
            colour = COLOURS[1] if series.startswith("series") else "0.6"
            axes.broken_barh([(start / 1e6, (end - start) / 1e6)], (place - 0.3, 0.6), color=colour)
    axes.set_yticks(range(len(bars["rows"])), [name for name, _ in bars["rows"]])
    axes.set(xlabel="in the cycle [ms]", xlim=(0, plan.cycle_ns / 1e6))
    axes.invert_yaxis()
    axes.set_title(f"Plan for {plan.chain.spec or 'a chain'}", loc="left")
    return figure
