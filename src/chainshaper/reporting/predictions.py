"""Tables and plain data about predictions: figure 7's curve, and predicted beside measured."""

from typing import Any

from rich.markup import escape
from rich.table import Table

from chainshaper.durations import milliseconds
from chainshaper.planning import BandChoice
from chainshaper.predictions import BandHeld, FigureHeld, PredictionHeld
from chainshaper.reporting.cells import ABSENT, ms, percent, slot_ms, terminal_table

__all__ = ["band_name", "choice_json", "choice_table", "prediction_json", "prediction_table"]

CONVENTION = (
    "at_start: every output leaves as its slot starts, as a gate does it; at_end: at its slot's"
    " end, eq. 5's convention; what is measured should lie between the two"
)


def choice_table(choice: BandChoice) -> Table:
    """Figure 7 in rows: the average over the number of bands, and where `auto` stops."""
    title = "Average over the number of bands [ms]"
    table = terminal_table(title, (), ("bands", "average", "gain", "slots end at"))
    table.columns[-1].justify = "left"
    before: float | None = None
    for placement in choice.curve:
        ends = placement.slot_ends_ns
        table.add_row(
            f"{'→ ' if placement is choice.chosen else ''}{len(ends)}",
            milliseconds(placement.mean_ns),
            ABSENT if before is None else f"{1 - placement.mean_ns / before:.2%}",
            " ".join(milliseconds(end) for end in ends),
        )
        before = placement.mean_ns
    table.caption = choice.reason
    return table


def choice_json(choice: BandChoice) -> dict[str, Any]:
    """The same as plain data."""
    return {
        "curve": [
            {
                "bands": len(placement.slot_ends_ns),
                "mean_ns": round(placement.mean_ns),
                "bands_ns": list(placement.slot_ends_ns),
            }
            for placement in choice.curve
        ],
        "chosen": len(choice.chosen.slot_ends_ns),
        "reason": choice.reason,
    }


def prediction_table(held: PredictionHeld) -> Table:
    """Predicted beside measured: the whole, then band by band."""
    figures = ("predicted", "measured", "", "jitter", "share predicted", "measured")
    table = terminal_table("Prediction and measurement [ms]", [""], figures)
    table.columns[3].justify = "left"
    for title, figure in (
        ("average", held.mean),
        ("maximum", held.max),
        ("jitter (max − min)", held.jitter),
    ):
        table.add_row(title, _range(figure), ms(figure.measured_ns), _verdict(figure), "", "", "")
    table.add_section()
    for number, band in enumerate(held.bands, start=1):
        table.add_row(
            escape(band_name(band, number)),
            escape(slot_ms(band.slot_start_ns, band.slot_end_ns)),
            ms(band.mean_ns),
            _inside(band),
            ms(band.jitter_ns),
            percent(band.predicted_share),
            percent(band.share),
        )
    of_mode = "; shares of a mode: its outputs that were in time for its slot"
    late = of_mode if any(band.mode for band in held.bands) else ""
    late += f"; {held.late} outputs came behind the slot they were due in" if held.late else ""
    table.caption = (
        "predicted: outputs at the start … the end of their slots (a gate publishes at the start,"
        f" eq. 5 counts the end); averages may differ by three standard errors more{late}"
    )
    return table


def prediction_json(held: PredictionHeld) -> dict[str, Any]:
    """The same as plain data, integers in nanoseconds."""
    return {
        "convention": CONVENTION,
        "mean_ns": _figure_json(held.mean),
        "max_ns": _figure_json(held.max),
        "jitter_ns": _figure_json(held.jitter),
        "bands": [vars(band) for band in held.bands],
        "late": held.late,
    }


def band_name(band: BandHeld, number: int) -> str:
    """``band 2``, or whose it is: ``city, 3 late``."""
    if band.mode is None:
        return f"band {number}"
    return f"{band.mode}, {band.late} late" if band.late else band.mode


def _figure_json(figure: FigureHeld) -> dict[str, Any]:
    return {
        "at_start": figure.at_start_ns,
        "at_end": figure.at_end_ns,
        "measured": figure.measured_ns,
        "holds": figure.holds,
    }


def _range(figure: FigureHeld) -> str:
    if figure.at_start_ns == figure.at_end_ns:
        return milliseconds(figure.at_end_ns)
    return f"{milliseconds(figure.at_start_ns)} … {milliseconds(figure.at_end_ns)}"


def _verdict(figure: FigureHeld) -> str:
    return {True: "as predicted", False: "differs", None: ABSENT}[figure.holds]


def _inside(band: BandHeld) -> str:
    if not band.count:
        return "no cycles"
    return f"{band.inside} of {band.count} inside"
