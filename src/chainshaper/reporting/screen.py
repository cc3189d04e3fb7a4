"""A comparison on one screen: when outputs leave, four figures, a verdict, and what to do next.

For people who see it for the first time. All tables stand in the report beside it.
"""

import json
import math
import textwrap
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

from chainshaper.analysis import LatencyStatistics
from chainshaper.planning import ChainPlan, publish_slots
from chainshaper.planning.overruns import expected
from chainshaper.reporting.live_control import live_costs, live_verdict
from chainshaper.reporting.tables import ABSENT, percent
from chainshaper.values.durations import duration_text, milliseconds
from chainshaper.values.errors import shown
from chainshaper.verify.measure import Comparison, Measurement
from chainshaper.verify.promises import outputs_due

WIDTH = 80
"""Columns of the narrowest terminal for which it is made."""
_NAME, _AXIS = 11, 45  # columns of a row's name, and of the time axis
_HEIGHTS = "▁▂▃▄▅▆▇█"
_LEAST = 20  # undisturbed cycles; of fewer nothing is said
_FEW_TICKS = 6
MS = 1_000_000


def comparison_lines(comparison: Comparison) -> list[Text]:
    """Make the lines of a chain's first recording beside its last, with the plan that was in force.

    At most 20, of 80 columns.
    """
    before, after = comparison.measurements[0], comparison.measurements[-1]
    return [
        *picture(before, after),
        Text(),
        *figure_rows(before, after),
        Text(),
        *verdict_lines(before, after),
    ]


def compared_before(file: Path) -> list[Text]:
    """Make the line of a comparison that was written earlier, for its figures beside others'.

    There is none where the file is no comparison of two recordings.
    """
    try:
        first, last = json.loads(file.read_text(encoding="utf-8"))["recordings"]
        seen = [first["undisturbed"], last["undisturbed"]]
        if min(one["count"] for one in seen) < _LEAST:
            seen = [first, last]
        figures = [
            f"{title} {' → '.join(_ms(one[name]) for one in seen)}"
            for title, name in (("jitter", "jitter_ns"), ("longest", "max_ns"))
        ]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    return [
        Text(f"  make demo   {', '.join(figures)}"),
        Text(f"              ({shown(str(file.parent))})"),
    ]


def picture(before: Measurement, after: Measurement | None = None) -> list[Text]:
    """Draw on one time axis when the outputs of both recordings left, in all cycles."""
    named = {"before": _latencies(before)}
    if after is not None:
        named["after"] = _latencies(after)
    every = [latencies for latencies in named.values() if latencies.size]
    if not every:
        return [Text("  No output left.")]
    axis = TimeAxis.over(np.concatenate(every))
    lines = [
        Text("  When outputs leave, after the start of their cycle", style="bold"),
        Text(" " * _NAME + axis.scale()),
    ]
    styles = {"before": "yellow", "after": "green"}
    for name, latencies in named.items():
        line = Text(f"    {name:<{_NAME - 4}}")
        line.append(axis.histogram(latencies), style=styles[name])
        line.append(f"  {_range_text(latencies)}")
        lines.append(line)
    return lines


class TimeAxis:
    """A time axis in columns of a terminal, from ``first_ns`` on, each of ``column_ns``."""

    def __init__(self, first_ns: int, column_ns: int, tick_ns: int) -> None:
        self.first_ns, self.column_ns, self.tick_ns = first_ns, column_ns, tick_ns

    @classmethod
    def over(cls, latencies: NDArray[np.int64]) -> "TimeAxis":
        """Make an axis on which all of these have room, with ticks at round numbers."""
        shortest, longest = int(latencies.min()), int(latencies.max())
        extent = max(longest - shortest, MS // 10)
        for tick_ns in (digit * 10**power for power in range(4, 12) for digit in (1, 2, 5)):
            if extent <= (_FEW_TICKS - 1) * tick_ns:
                break
        first_ns = shortest // tick_ns * tick_ns
        column_ns = math.ceil((longest - first_ns + 1) / _AXIS)
        return cls(first_ns, column_ns, tick_ns)

    def column_of(self, time_ns: int) -> int:
        return (time_ns - self.first_ns) // self.column_ns

    def scale(self) -> str:
        """Return the numbers of the ticks, each at its column, and the unit behind the last."""
        line, time_ns = "", self.first_ns
        while (column := self.column_of(time_ns)) < _AXIS:
            number = f"{time_ns / MS:g}"
            if line and column <= len(line):
                break
            line = line.ljust(column) + number
            time_ns += self.tick_ns
        return line + " ms"

    def histogram(self, latencies: NDArray[np.int64]) -> str:
        """Return a character for each column: the more outputs, the higher; few are a dot."""
        columns = (latencies - self.first_ns) // self.column_ns
        counts = np.bincount(columns, minlength=_AXIS)[:_AXIS]
        if not latencies.size:
            return " " * _AXIS
        if np.count_nonzero(counts) == 1:
            return "".join("┃" if count else " " for count in counts)
        highest = counts.max()
        drawn = ""
        for count in counts:
            height = round(count / highest * len(_HEIGHTS))
            if height:
                drawn += _HEIGHTS[height - 1]
            else:
                drawn += "·" if count else " "
        return drawn


def figure_rows(before: Measurement, after: Measurement) -> list[Text]:
    """Make the rows: jitter, longest, average, late; before, after, and the difference.

    Of undisturbed cycles where the machine was watched and left enough of them, else of all;
    late outputs are those of all cycles.
    """
    first, last = before.analysis.undisturbed, after.analysis.undisturbed
    received = [measurement.analysis.subscriber_undisturbed for measurement in (before, after)]
    if min(first.count, last.count) < _LEAST:
        first, last = before.analysis.statistics, after.analysis.statistics
        received = [measurement.analysis.subscriber for measurement in (before, after)]
    longest = _difference(first.max_ns, last.max_ns)
    average = _difference(first.mean_ns, last.mean_ns)
    rows = [
        _row("jitter", _ms(first.jitter_ns), _ms(last.jitter_ns), _times(first, last)),
        _row("longest", _ms(first.max_ns), _ms(last.max_ns), longest),
        _row("average", _ms(first.mean_ns), _ms(last.mean_ns), f"{average}   the price"),
        _row("late", _late_unshaped(before, after), _late_shaped(after), "of all cycles"),
    ]
    rows[0].stylize("bold")
    lines = [Text(f"{'before':>27}{'shaped':>18}", style="bold"), *rows]
    jitters = [_ms(statistics.jitter_ns) for statistics in received if statistics is not None]
    if len(jitters) == len(received):
        text = f"    (at the subscriber's callback: jitter {' → '.join(jitters)})"
        lines.append(Text(text, style="dim"))
    return lines


def unplanned_lines(before: Measurement, reason: str) -> list[Text]:
    """Make the lines of a chain that was measured, and that nothing could be planned for."""
    return [
        *picture(before),
        Text(),
        _line("!", f"Nothing can be said: no plan could be made on this machine: {reason}"),
        _line("!", "`chainshaper doctor` says what the machine would need."),
    ]


def verdict_lines(before: Measurement, after: Measurement) -> list[Text]:
    """Say whether the outputs were as planned, and what the machine did meanwhile."""
    lines = [*_promise_lines(after), *_machine_lines(before, after)]
    if (control := live_verdict(live_costs([before, after]))) is not None:
        lines.append(_line("→", f"{control[0].upper()}{control[1:]}."))
    if False in (before.recording.info.realtime, after.recording.info.realtime):
        text = "Not all threads had SCHED_FIFO: run it as root, or with an `rtprio` limit."
        lines.append(_line("!", text))
    return lines


def _promise_lines(after: Measurement) -> list[Text]:
    """Say whether the plan's promise was kept; nothing where no plan was in force."""
    judged, plan = after.prediction, after.plan
    if plan is None or judged is None:
        return []
    calm = after.analysis.undisturbed.count
    if judged.broken and calm < _LEAST:
        text = f"Nothing can be said: stalls of the machine left {calm} cycles undisturbed."
        return [_line("!", f"{text} `chainshaper doctor` says what it would need.")]
    if judged.broken:
        return [_line("!", f"Not as planned: {'; '.join(judged.broken)}.")]
    outputs, places = outputs_due(after.analysis, plan), _places_text(plan)
    if not outputs.missed:
        return [_line("✓", f"As planned: every output at {places}, none late.")]
    # The promise is a share; of so few outputs, chance alone makes more than that late at times.
    promised = f"{percent(outputs.promised)} may be, by chance up to {outputs.most_missed}"
    return [_line("✓", f"As planned: outputs at {places}; {outputs.text}: {promised}.")]


def _machine_lines(before: Measurement, after: Measurement) -> list[Text]:
    """Say how long the machine stood still, and how many cycles that hit."""
    longest = [measurement.longest_stall_ns for measurement in (before, after)]
    known = [stall_ns for stall_ns in longest if stall_ns is not None]
    if not known:
        return [_line("!", "Stalls of the machine were not watched.")]
    hit = [measurement.analysis.statistics for measurement in (before, after)]
    if not any(statistics.disturbed for statistics in hit):
        return []
    stood = f"This machine stood still for up to {duration_text(round(max(known), -5))}"
    numbers = f"{hit[0].disturbed} of {hit[0].count} cycles before and {hit[1].disturbed} of"
    return [_line("!", f"{stood}, in {numbers} {hit[1].count} after.")]


def _line(mark: str, text: str) -> Text:
    """Make a line with a mark in front; a longer text goes on below, indented."""
    folded = textwrap.fill(shown(text), WIDTH - 5, break_long_words=False, break_on_hyphens=False)
    line = Text(f"  {mark} ", style="bold green" if mark == "✓" else "bold yellow")
    line.append(textwrap.indent(folded, " " * 4)[4:], style="not bold default")
    return line


def _row(name: str, before: str, after: str, difference: str) -> Text:
    return Text(f"    {name:<9}{before:>14}   →{after:>14}    {difference}".rstrip())


def _latencies(measurement: Measurement) -> NDArray[np.int64]:
    """The latencies of all complete cycles [ns]."""
    traversals = measurement.analysis.traversals.filter("complete")
    return np.asarray(traversals["latency_ns"], np.int64)


def _range_text(latencies: NDArray[np.int64]) -> str:
    if not latencies.size:
        return "no output"
    ends = (latencies.min() / MS, latencies.max() / MS)
    digits = 1 if f"{ends[0]:.1f}" != f"{ends[1]:.1f}" else 2
    return f"{ends[0]:.{digits}f} … {ends[1]:.{digits}f} ms"


def _ms(nanoseconds: float | None) -> str:
    """A time in ms, with as many places as a person reads."""
    if nanoseconds is None:
        return ABSENT
    return f"{nanoseconds / MS:.2f} ms" if abs(nanoseconds) < MS else f"{nanoseconds / MS:.1f} ms"


def _difference(before_ns: float | None, after_ns: float | None) -> str:
    if before_ns is None or after_ns is None:
        return ""
    difference = (after_ns - before_ns) / MS
    return f"{'+' if difference >= 0 else '−'} {abs(difference):.1f} ms"


def _times(before: LatencyStatistics, after: LatencyStatistics) -> str:
    """How many times less, or more, the jitter is; only what is there is claimed."""
    if not before.jitter_ns or not after.jitter_ns:
        return ""
    times = before.jitter_ns / after.jitter_ns
    if 0.95 < times < 1.05:
        return "the same"
    if times >= 1:
        return f"{_number(times)} times less"
    return f"{_number(1 / times)} times more"


def _number(value: float) -> str:
    """Return a number as text with two significant digits."""
    digits = 1 if value < 10 else -(len(f"{value:.0f}") - 2)
    return f"{round(value, digits):,.{max(0, digits)}f}"


def _late_shaped(after: Measurement) -> str:
    if after.plan is None:
        return ABSENT
    outputs = outputs_due(after.analysis, after.plan)
    return f"{outputs.missed} of {outputs.due}"


def _late_unshaped(before: Measurement, after: Measurement) -> str:
    """Count the unshaped outputs that came later than the plan's last slot ends.

    It is shown beside the shaped ones' only where the machine stalled while they were measured.
    """
    if after.plan is None or not after.analysis.statistics.disturbed:
        return ABSENT
    slots = publish_slots(after.plan)
    if not slots:
        return ABSENT
    latencies = _latencies(before)
    return f"{int((latencies > slots[-1][1]).sum())} of {latencies.size}"


def _places_text(plan: ChainPlan) -> str:
    """When outputs leave: the places that are expected."""
    seen = expected(plan)
    if seen is None:
        return f"most {milliseconds(plan.predicted.max_ns, 1)} ms"
    return " or ".join(milliseconds(place_ns, 1) for place_ns in seen.leave_ns) + " ms"
