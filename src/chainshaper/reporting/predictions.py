"""Tables and plain data about predictions: figure 7's curve, and predicted beside measured."""

from typing import Any

from rich.markup import escape
from rich.table import Table

from chainshaper.durations import milliseconds
from chainshaper.planning import BandChoice
from chainshaper.predictions import BandHeld, FigureHeld, PredictionHeld

__all__ = ["choice_json", "choice_table", "prediction_json", "prediction_table"]

ABSENT = "–"
CONVENTION = (
    "at_start: every output leaves as its slot starts, as a gate does it; at_end: at its slot's"
    " end, eq. 5's convention; what is measured should lie between the two"
)


def choice_table(choice: BandChoice) -> Table:
    """Figure 7 in rows: the average over the number of bands, and where `auto` stops."""
    table = Table(title=escape("Average over the number of bands [ms]"), title_justify="left")
    for name in ("bands", "average", "gain", "slots end at"):
        table.add_column(name, justify="left" if name == "slots end at" else "right")
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
    table = Table(title=escape("Prediction and measurement [ms]"), title_justify="left")
    for name in ("", "predicted", "measured", "", "jitter", "share predicted", "measured"):
        table.add_column(name, justify="left" if not name else "right")
    for title, figure in (
        ("average", held.mean),
        ("maximum", held.max),
        ("jitter (max − min)", held.jitter),
    ):
        table.add_row(title, _range(figure), _ms(figure.measured_ns), _verdict(figure), "", "", "")
    table.add_section()
    for number, band in enumerate(held.bands, start=1):
        table.add_row(
            f"band {number}",
            escape(f"[{milliseconds(band.slot_start_ns)}, {milliseconds(band.slot_end_ns)})"),
            _ms(band.mean_ns),
            _inside(band),
            _ms(band.jitter_ns),
            _share(band.predicted_share),
            _share(band.share),
        )
    late = f"; {held.late} outputs came in a later cycle than due" if held.late else ""
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


def _figure_json(figure: FigureHeld) -> dict[str, Any]:
    return {
        "at_start": figure.at_start_ns,
        "at_end": figure.at_end_ns,
        "measured": figure.measured_ns,
        "holds": figure.holds,
    }


def _ms(value: int | None) -> str:
    return ABSENT if value is None else milliseconds(value)


def _share(value: float | None) -> str:
    return ABSENT if value is None else f"{value:.1%}"


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
