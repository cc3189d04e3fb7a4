"""Tables and plain data about predictions: figure 7's curve, and predicted beside measured."""

from typing import Any

from rich.table import Table

from chainshaper.planning import BandChoice
from chainshaper.reporting.cells import ABSENT, ms, percent, slot_ms, terminal_table
from chainshaper.values.durations import milliseconds
from chainshaper.verify.predictions import BandHeld, FigureHeld, PredictionHeld

__all__ = [
    "band_name",
    "choice_json",
    "choice_table",
    "late_text",
    "prediction_json",
    "prediction_table",
    "range_ms",
    "verdict",
]

CONVENTION = (
    "at_start: every output leaves as its slot starts, as a gate does it; at_end: at its slot's"
    " end, eq. 5's convention; from, to: with room for what two samples may differ by, the bounds"
    " of `holds`"
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
    whence = ", from the start of the cycle" if held.counted_from == "cycle" else ""
    table = terminal_table(f"Prediction and measurement{whence} [ms]", [""], figures)
    table.columns[3].justify = "left"
    for title, figure in (
        ("average", held.mean),
        ("maximum", held.max),
        ("jitter (max − min)", held.jitter),
    ):
        cells = range_ms(figure), ms(figure.measured_ns), verdict(figure)
        table.add_row(title, *cells, "", "", "")
    table.add_section()
    for number, band in enumerate(held.bands, start=1):
        table.add_row(
            band_name(band, number),
            slot_ms(band.slot_start_ns, band.slot_end_ns),
            ms(band.mean_ns),
            _inside(band),
            ms(band.jitter_ns),
            percent(band.predicted_share),
            percent(band.share),
        )
    of_mode = "; shares of a mode: its outputs that were in time for its slot"
    late = of_mode if any(band.mode for band in held.bands) else ""
    late += "" if held.late_of_all is None else f"; {late_text(held)}"
    table.caption = (
        "undisturbed cycles; predicted: outputs at the start … the end of their slots (a gate"
        " publishes at the start, eq. 5 counts the end), averages with three standard errors, no"
        f" band that may well be empty{late}"
    )
    return table


def late_text(held: PredictionHeld) -> str:
    """How many outputs came late, no cycle left out."""
    disturbed = (held.late_of_all or 0) - held.late
    among = f", {disturbed} of them in disturbed cycles" if disturbed else ""
    return f"of all {held.cycles} outputs {held.late_of_all} came late{among}"


def prediction_json(held: PredictionHeld) -> dict[str, Any]:
    """The same as plain data, integers in nanoseconds."""
    return {
        "convention": CONVENTION,
        "mean_ns": _figure_json(held.mean),
        "max_ns": _figure_json(held.max),
        "jitter_ns": _figure_json(held.jitter),
        "bands": [vars(band) for band in held.bands],
        "late": held.late,
        "late_of_all": held.late_of_all,
        "counted_from": held.counted_from,
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
        "from": figure.from_ns,
        "to": figure.to_ns,
        "measured": figure.measured_ns,
        "holds": figure.holds,
    }


def range_ms(figure: FigureHeld) -> str:
    """What a figure was predicted to lie in: the verdict's own bounds."""
    if figure.from_ns == figure.to_ns:
        return milliseconds(figure.to_ns)
    return f"{milliseconds(figure.from_ns)} … {milliseconds(figure.to_ns)}"


def verdict(figure: FigureHeld) -> str:
    """Whether it does."""
    return {True: "as predicted", False: "differs", None: ABSENT}[figure.holds]


def _inside(band: BandHeld) -> str:
    if not band.count:
        return "no cycles"
    return f"{band.inside} of {band.count} inside"
