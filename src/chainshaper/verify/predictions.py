"""Judging a plan's prediction by a measurement.

**The convention.** Eq. 5 represents a latency band by the end of its slot, x_α. A gate lets a
message that waits go when its slot starts, at x_α − Δ; only a message that arrives inside the slot
leaves later. So every figure is predicted twice: as if each output left at the start of its slot,
and as if at its end. A measurement should lie between the two, near the first.

With **modes** an output leaves in the slot of its cycle's mode. An output that comes behind that
slot is late, although there are further slots. Each mode is then compared by itself with the share
of latencies that fit. The figures of all modes together are not judged: they depend on how long
each mode was in force, which no plan knows.

**What is promised.** With the anchor `stamp` a gate promises the latency. With the anchor `cycle`,
and where a back end stops a publisher's thread, slots count from the start of the cycle: the place
in the cycle is promised and judged, whenever in the cycle the chain began.

A verdict compares the range and the figure as they are printed. The range has room for the
difference between two finite samples. A band is not expected if, with so few outputs, it may well
be empty by chance.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import polars as pl

from chainshaper.analysis import LatencyAnalysis, LatencyStatistics, latency_statistics
from chainshaper.analysis.disturbance import Due
from chainshaper.planning import ChainPlan, publish_slots
from chainshaper.planning.chain_plan import SHORTEST_SLOT_NS, Slot, publisher_servers, server_of
from chainshaper.planning.margins import OVERRUN_PROBABILITY, allowed_late_share
from chainshaper.planning.overruns import (
    GATE_NS,
    STOPPED_THREAD_NS,
    cycles_until_output,
    expected,
    slots_of_latency,
)
from chainshaper.values.durations import milliseconds
from chainshaper.verify.promises import (
    STANDARD_ERRORS,
    OutputsDue,
    most_by_chance,
    outputs_due,
)

MISSING = 0.003  # a band is expected if it is empty with at most this probability


@dataclass(frozen=True)
class JudgedFigure:
    """A figure as predicted, and as measured."""

    at_start_ns: int  # predicted, with each output at the start of its slot
    at_end_ns: int  # predicted, with each output at the end of its slot
    from_ns: int  # the range in which the measured figure should lie
    to_ns: int
    measured_ns: int | None
    holds: bool | None
    """Whether it lies there, to the printed digit; None: nothing was measured, or the plan has
    modes, on which the figure depends."""

    @property
    def worse(self) -> bool:
        """Whether it lies above the range; below is better, and breaks no promise."""
        return self.holds is False and (self.measured_ns or 0) > self.to_ns

    @property
    def range_text(self) -> str:
        """The range in ms."""
        return " … ".join(dict.fromkeys(map(milliseconds, (self.from_ns, self.to_ns))))


@dataclass(frozen=True)
class JudgedBand:
    """A latency band, or a mode, over undisturbed cycles whose output was in time."""

    slot_start_ns: int
    slot_end_ns: int
    predicted_share: float | None  # of the outputs in time; of a mode: of its own outputs
    count: int  # of outputs
    share: float | None  # as measured
    inside: int  # number of outputs that left while the slot was open
    min_ns: int | None
    mean_ns: int | None
    max_ns: int | None
    jitter_ns: int | None
    mode: str | None = None
    late: int = 0  # number of the mode's outputs behind its slot
    jitter_at_most_ns: int | None = None  # promised, if there are several bands; None: nothing is

    @property
    def wide(self) -> bool:
        """Whether its outputs are farther apart than the band promises."""
        if self.jitter_ns is None or self.jitter_at_most_ns is None:
            return False
        return self.jitter_ns > self.jitter_at_most_ns


@dataclass(frozen=True)
class JudgedReceivers:
    """The promised and measured times until a receiver's callback starts.

    Of outputs that were in time, and that no stall disturbed on their way.
    """

    predicted_max_ns: int
    predicted_jitter_ns: int
    max_ns: int | None  # measured
    jitter_ns: int | None  # measured
    count: int  # of outputs that were received
    behind: int  # number of those that came later than promised
    most_behind: int  # how many may

    @property
    def broken(self) -> str | None:
        """Text of the broken promise, with its figures; None: it is kept."""
        if self.behind <= self.most_behind:
            return None
        return (
            f"{self.behind} of {self.count} outputs received behind"
            f" {milliseconds(self.predicted_max_ns)} ms,"
            f" at {milliseconds(self.max_ns or 0)} ms at the latest"
        )


@dataclass(frozen=True)
class JudgedPrediction:
    """A plan's prediction beside the measurement, over undisturbed cycles."""

    mean: JudgedFigure
    max: JudgedFigure
    jitter: JudgedFigure
    in_time: tuple[JudgedFigure, JudgedFigure]  # maximum and jitter without the late outputs
    bands: tuple[JudgedBand, ...]
    """() for policies without slots."""
    late: int  # number of outputs that missed their last slot; in the figures, not in the bands
    outputs: OutputsDue  # all that were due, also in disturbed cycles
    counted_from: Literal["chain", "cycle"]
    """Whether the figures are latencies, or places in the cycle."""
    receivers: JudgedReceivers | None = None  # None: the plan promises nothing about them

    @property
    def broken(self) -> tuple[str, ...]:
        """Texts of the promises that the measurement breaks, each with its figures.

        The plan promises which share of the outputs is in time. Late ones within that share break
        no promise: the maximum and the jitter are judged without them.
        """
        longest, jitter = self.max, self.jitter
        if self.late and self.outputs.promised and self.outputs.kept:
            longest, jitter = self.in_time
        named = {"average": self.mean, "maximum": longest, "jitter": jitter}
        broken = [
            f"{name} {milliseconds(figure.measured_ns)} ms, not {figure.range_text} ms"
            for name, figure in named.items()
            if figure.worse and figure.measured_ns is not None
        ]
        broken += [
            f"jitter of band {number} {milliseconds(band.jitter_ns)} ms,"
            f" not {milliseconds(band.jitter_at_most_ns)} ms at most"
            for number, band in enumerate(self.bands, start=1)
            if band.wide and band.jitter_ns is not None and band.jitter_at_most_ns is not None
        ]
        if self.outputs.kept is False:
            most = f"{self.outputs.most_missed} at most" if self.outputs.most_missed else "none"
            broken.append(f"{self.outputs.text}, {most} expected")
        if self.receivers is not None and self.receivers.broken is not None:
            broken.append(self.receivers.broken)
        return tuple(broken)

    @property
    def jitter_text(self) -> str:
        """Text: the jitter and its bound; if there are several bands, within each."""
        bounded = [band for band in self.bands if band.jitter_at_most_ns is not None]
        if not bounded:
            jitter, most = self.jitter.measured_ns, self.jitter.to_ns
            measured = "not known" if jitter is None else f"{milliseconds(jitter)} ms"
            return f"jitter {measured}, at most {milliseconds(most)} ms"
        measured = ", ".join(
            "no output" if band.jitter_ns is None else milliseconds(band.jitter_ns)
            for band in bounded
        )
        bounds = dict.fromkeys(milliseconds(band.jitter_at_most_ns or 0) for band in bounded)
        return f"jitter within bands {measured} ms, at most {', '.join(bounds)} ms"


def due_of(plan: ChainPlan) -> tuple[Due, ...]:
    """When a plan has the outputs of the chain, and those of its further sinks, leave."""
    last = {} if plan.modes is None else {mode: band - 1 for mode, band in plan.modes.bands.items()}
    of_chain = Due(
        cycle_ns=plan.cycle_ns,
        cycles=cycles_until_output(plan),
        slots=publish_slots(plan),
        last_slot={} if plan.modes is not None and plan.modes.late == "next-slot" else last,
        from_cycle=_from_cycle(plan),
        margin_ns=plan.margin.epsilon_ns,
        output=plan.chain.output,
    )
    sinks = []
    for node in plan.further_shaping_nodes:
        server, cycles = server_of(plan, node.thread), cycles_until_output(plan, node)
        if server is not None:
            sink = replace(
                of_chain, cycles=cycles, slots=server.slots, last_slot={}, output=node.output
            )
            sinks.append(sink)
    return of_chain, *sinks


def _from_cycle(plan: ChainPlan) -> bool:
    """Whether slots count from the start of the cycle, whenever in it the chain began."""
    by_cycle = plan.shaping_node is not None and plan.anchor == "cycle"
    return by_cycle or any(publisher_servers(plan))


def judge_prediction(plan: ChainPlan, analysis: LatencyAnalysis) -> JudgedPrediction:
    """Judge the prediction of the plan in force by the analysis of a recording.

    That analysis was made with the instants of :func:`due_of`.
    """
    slots = slots_of_latency(plan)
    from_cycle = _from_cycle(plan)
    outputs = _outputs(slots, analysis, "place_ns" if from_cycle else "latency_ns")
    in_time = outputs.filter(~pl.col("late"))
    shares = plan.predicted.shares
    bands = []
    if plan.modes is None:
        known = shares if expected(plan) is not None else [None] * len(slots)
        for number, (slot, share) in enumerate(zip(slots, known, strict=True)):
            of_band = in_time.filter(slot=number)
            judged = _band(slot, share, of_band, in_time.height)
            if len(slots) > 1 and expected(plan) is not None:
                most = jitter_within_band(plan, slot, last=slot == slots[-1])
                judged = replace(judged, jitter_at_most_ns=most)
            bands.append(judged)
    else:
        for mode, band in plan.modes.bands.items():
            of_mode = outputs.filter(mode=mode)
            promised = (plan.predicted.modes or {}).get(mode)
            share = (sum(shares[:band]) or None) if promised is None else promised.shares[0]
            judged = _band(slots[band - 1], share, of_mode.filter(~pl.col("late")), of_mode.height)
            bands.append(replace(judged, mode=mode, late=int(of_mode["late"].sum())))
    mean, longest, jitter = _figures(plan, slots, latency_statistics(outputs["judged_ns"]))
    _, longest_in_time, jitter_in_time = _figures(
        plan, slots, latency_statistics(in_time["judged_ns"])
    )
    return JudgedPrediction(
        mean=mean,
        max=longest,
        jitter=jitter,
        in_time=(longest_in_time, jitter_in_time),
        bands=tuple(bands),
        late=int(outputs["late"].sum()),
        outputs=outputs_due(analysis, plan),
        counted_from="cycle" if from_cycle else "chain",
        receivers=_receivers(plan, analysis, from_cycle),
    )


def _receivers(
    plan: ChainPlan, analysis: LatencyAnalysis, from_cycle: bool
) -> JudgedReceivers | None:
    """Judge the promise about the receivers of the output; None: the plan makes none."""
    promised = plan.predicted.receivers
    if promised is None:
        return None
    in_time = pl.col("complete") & ~pl.col("reception_disturbed") & ~pl.col("late").fill_null(False)
    place = pl.col("place_ns" if from_cycle else "latency_ns")
    known = analysis.traversals.filter(in_time).drop_nulls("reception_ns")
    at = known.select(place + pl.col("reception_ns") - pl.col("latency_ns")).to_series()
    share = max(OVERRUN_PROBABILITY, allowed_late_share(plan.margin))
    statistics = latency_statistics(at)
    return JudgedReceivers(
        predicted_max_ns=promised.max_ns,
        predicted_jitter_ns=promised.jitter_ns,
        max_ns=statistics.max_ns,
        jitter_ns=statistics.jitter_ns,
        count=len(at),
        behind=int((at > promised.max_ns).sum()),
        most_behind=most_by_chance(len(at), share),
    )


def _figures(
    plan: ChainPlan, slots: Sequence[Slot], measured: LatencyStatistics
) -> tuple[JudgedFigure, JudgedFigure, JudgedFigure]:
    """Judge average, maximum and jitter; the ranges have room for finite samples."""
    predicted = plan.predicted
    mean, longest, jitter = predicted.mean_ns, predicted.max_ns, predicted.jitter_ns
    publishing = 0
    lowest_max, lowest_jitter = mean, 0  # if outputs leave when they are ready
    # Where outputs do not come in bands, the plan does not have their variance. Between two limits
    # it is at most (max − mean)·(mean − min).
    variance = float(max(0, longest - mean) * max(0, mean - (longest - jitter)))
    seen = expected(plan)
    if seen is not None:
        starts, ends = seen.leave_ns, [end for _, end in slots]
        mean = seen.mean_ns
        average = _weighted(predicted.shares, ends)
        variance = _weighted(predicted.shares, [(end - average) ** 2 for end in ends])
        longest, jitter = starts[-1], starts[-1] - starts[0]
        sure = [
            start
            for start, share in zip(starts, predicted.shares, strict=True)
            if (1 - share) ** measured.count <= MISSING
        ] or starts[:1]
        lowest_max, lowest_jitter = sure[-1], sure[-1] - sure[0]
        if plan.into_open_slot == "next-slot":  # each output leaves within its slot
            publishing = ends[-1] - starts[-1]
    elif slots:
        longest, jitter = min(longest, slots[-1][0]), 0
        lowest_max = longest
    samples = 1 / plan.evidence.samples + 1 / measured.count if measured.count else 0.0
    room = round(STANDARD_ERRORS * (variance * samples) ** 0.5)

    def figure(at_start: int, name: str, lowest: int, above: int = 0) -> JudgedFigure:
        at_end, figure_ns = getattr(predicted, name), getattr(measured, name)
        low, high, holds = min(lowest, at_start), at_end + above, None
        if seen is not None and len(seen.leave_ns) == 1 and lowest == at_start:
            high = min(high, at_start + GATE_NS + SHORTEST_SLOT_NS)  # however wide the slot is
        high += GATE_NS if seen is None else 0  # as close as gates are to slots
        if plan.modes is None and figure_ns is not None:
            printed = [float(milliseconds(value)) for value in (low, figure_ns, high)]
            holds = printed == sorted(printed)
        return JudgedFigure(at_start, at_end, low, high, figure_ns, holds)

    return (
        figure(mean, "mean_ns", mean - room, room),
        figure(longest, "max_ns", lowest_max),
        figure(jitter, "jitter_ns", lowest_jitter, publishing),
    )


def jitter_within_band(plan: ChainPlan, slot: Slot, *, last: bool) -> int:
    """How far apart (ns) the outputs of one of several bands may be: the width of its slot.

    Messages may arrive at any time of the slot, and then leave at once. Not so in the last slot: an
    output in time arrives before it opens.
    """
    apart = STOPPED_THREAD_NS if any(publisher_servers(plan)) else GATE_NS
    length = slot[1] - slot[0]
    if last or plan.into_open_slot == "next-slot":
        length = min(length, SHORTEST_SLOT_NS)
    return length + apart


def _weighted(shares: Sequence[float], values: Sequence[float]) -> float:
    """The sum of values, each times its share."""
    return sum(share * value for share, value in zip(shares, values, strict=True))


def _outputs(slots: Sequence[Slot], analysis: LatencyAnalysis, judged: str) -> pl.DataFrame:
    """Make a frame of undisturbed complete traversals: ``judged_ns, place_ns, slot, mode, late``.

    ``judged_ns`` is the column ``judged``. ``slot`` is that in which the gate released the message;
    without a gate's decision, the last that had started when the output came.
    """
    decided = analysis.decided.select("traversal", "slot", "mode", gated=True)
    started = [(pl.col("place_ns") >= start).cast(pl.Int32) for start, _ in slots]
    return analysis.calm.join(decided, on="traversal", how="left").select(
        *("place_ns", "mode"),
        pl.col("late").fill_null(False),
        judged_ns=judged,
        slot=pl.when(pl.col("gated")).then("slot").otherwise(pl.sum_horizontal(-1, *started)),
    )


def _band(slot: Slot, predicted: float | None, outputs: pl.DataFrame, total: int) -> JudgedBand:
    """Judge the band of a slot by its ``outputs`` that were in time, of ``total`` ones."""
    statistics, place = latency_statistics(outputs["judged_ns"]), pl.col("place_ns")
    return JudgedBand(
        slot_start_ns=slot[0],
        slot_end_ns=slot[1],
        predicted_share=predicted,
        count=statistics.count,
        share=statistics.count / total if total else None,
        inside=outputs.filter((place >= slot[0]) & (place < slot[1])).height,
        min_ns=statistics.min_ns,
        mean_ns=statistics.mean_ns,
        max_ns=statistics.max_ns,
        jitter_ns=statistics.jitter_ns,
    )
