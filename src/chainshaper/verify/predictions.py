"""Holding a plan's prediction against what was measured.

**The convention.** Eq. 5 represents a latency band by the end of its slot, x_α. A gate lets a
message that waits go when its slot starts, at x_α − Δ; only one that arrives inside the slot
leaves later. So every figure is predicted twice: as if each output left at the start of its
slot, and at its end. A measurement should lie between the two, near the first.

With **modes** an output leaves in the slot of its cycle's mode, and what comes behind that slot is
late for it although there are others. Each mode is then compared by itself with the share of
latencies that fit; the whole depends on how long each was in force, which no plan knows.

**What is promised.** With the anchor `stamp` a gate promises the latency. With the anchor `cycle`,
and where a back end holds back a publisher's thread, slots count from the start of the cycle: the
place in the cycle is promised and judged, whenever in the cycle the chain began.

A verdict is found from the range and the figure as they are printed. A range has room for what two
finite samples may differ by, and no band is expected that so few outputs may well not have come in.
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

MISSING = 0.003  # a band that is empty with no more than this probability is expected


@dataclass(frozen=True)
class JudgedFigure:
    """One figure: predicted with outputs at slot starts and at slot ends, and measured (ns).

    ``holds``: the measured figure lies from ``from_ns`` to ``to_ns``, to the printed digit (None:
    nothing was measured, or the plan has modes, and it depends on them).
    """

    at_start_ns: int
    at_end_ns: int
    from_ns: int
    to_ns: int
    measured_ns: int | None
    holds: bool | None

    @property
    def worse(self) -> bool:
        """Whether it is above what was predicted; below is better, and breaks no promise."""
        return self.holds is False and (self.measured_ns or 0) > self.to_ns

    @property
    def range_text(self) -> str:
        """The range in ms."""
        return " … ".join(dict.fromkeys(map(milliseconds, (self.from_ns, self.to_ns))))


@dataclass(frozen=True)
class BandHeld:
    """One latency band, over undisturbed cycles whose output came in the cycle it was due.

    ``inside`` counts outputs that left while the slot was open. ``jitter_at_most_ns`` is what a
    band beside others promises (None: nothing). With modes it is that of ``mode``: ``late`` counts
    the mode's outputs behind its slot, the shares are those of its others.
    """

    slot_start_ns: int
    slot_end_ns: int
    predicted_share: float | None
    count: int
    share: float | None
    inside: int
    min_ns: int | None
    mean_ns: int | None
    max_ns: int | None
    jitter_ns: int | None
    mode: str | None = None
    late: int = 0
    jitter_at_most_ns: int | None = None

    @property
    def wide(self) -> bool:
        """Whether its outputs are farther apart than the band promises."""
        if self.jitter_ns is None or self.jitter_at_most_ns is None:
            return False
        return self.jitter_ns > self.jitter_at_most_ns


@dataclass(frozen=True)
class JudgedReceivers:
    """What a plan promises until a receiver's callback starts, and what was measured (ns).

    It is of outputs that were in time, and that the machine did not disturb on their way. ``count``
    of them were received, ``behind`` of which came later than promised; ``most_behind`` may.
    """

    predicted_max_ns: int
    predicted_jitter_ns: int
    max_ns: int | None
    jitter_ns: int | None
    count: int
    behind: int
    most_behind: int

    @property
    def broken(self) -> str | None:
        """The promise that the measurement breaks, with its figures; None: it does not."""
        if self.behind <= self.most_behind:
            return None
        said = f"{self.behind} of {self.count} outputs received behind"
        said += f" {milliseconds(self.predicted_max_ns)} ms, at"
        return f"{said} {milliseconds(self.max_ns or 0)} ms at the latest"


@dataclass(frozen=True)
class JudgedPrediction:
    """A plan's prediction beside the measurement, over undisturbed cycles.

    The figures are latencies, or with ``counted_from`` the cycle places in it. ``late`` counts
    outputs that missed their last slot; they are in the figures, not in the bands. ``outputs`` has
    all that were due, in whatever cycle. Policies without slots have no ``bands``, plans that keep
    no place for them no ``receivers``.
    """

    mean: JudgedFigure
    max: JudgedFigure
    jitter: JudgedFigure
    bands: tuple[BandHeld, ...]
    late: int
    outputs: OutputsDue
    counted_from: Literal["chain", "cycle"]
    receivers: JudgedReceivers | None = None

    @property
    def broken(self) -> tuple[str, ...]:
        """Which promises the measurement breaks, each with its figures."""
        named = {"average": self.mean, "maximum": self.max, "jitter": self.jitter}
        broken = [
            f"{name} {milliseconds(one.measured_ns)} ms, not {one.range_text} ms"
            for name, one in named.items()
            if one.worse and one.measured_ns is not None
        ]
        broken += [
            f"jitter of band {number} {milliseconds(one.jitter_ns)} ms,"
            f" not {milliseconds(one.jitter_at_most_ns)} ms at most"
            for number, one in enumerate(self.bands, start=1)
            if one.wide and one.jitter_ns is not None and one.jitter_at_most_ns is not None
        ]
        if self.outputs.kept is False:
            most = f"{self.outputs.most_missed} at most" if self.outputs.most_missed else "none"
            broken.append(f"{self.outputs.text}, {most} expected")
        if self.receivers is not None and self.receivers.broken is not None:
            broken.append(self.receivers.broken)
        return tuple(broken)

    @property
    def jitter_text(self) -> str:
        """The jitter beside its bound; of several bands that within each."""
        inside = [one for one in self.bands if one.jitter_at_most_ns is not None]
        if not inside:
            jitter, most = self.jitter.measured_ns, self.jitter.to_ns
            measured = "not known" if jitter is None else f"{milliseconds(jitter)} ms"
            return f"jitter {measured}, at most {milliseconds(most)} ms"
        measured = ", ".join(
            "no output" if one.jitter_ns is None else milliseconds(one.jitter_ns) for one in inside
        )
        bounds = dict.fromkeys(milliseconds(one.jitter_at_most_ns or 0) for one in inside)
        return f"jitter within bands {measured} ms, at most {', '.join(bounds)} ms"


def due_of(plan: ChainPlan) -> tuple[Due, ...]:
    """When a plan has its outputs leave, as the analysis needs it: the chain's, other sinks'."""
    last = {} if plan.modes is None else {m: band - 1 for m, band in plan.modes.bands.items()}
    own = Due(
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
            sink = replace(own, cycles=cycles, slots=server.slots, last_slot={}, output=node.output)
            sinks.append(sink)
    return own, *sinks


def _from_cycle(plan: ChainPlan) -> bool:
    """Whether slots count from the start of the cycle, whenever in it the chain began."""
    by_cycle = plan.shaping_node is not None and plan.anchor == "cycle"
    return by_cycle or any(publisher_servers(plan))


def judge_prediction(plan: ChainPlan, analysis: LatencyAnalysis) -> JudgedPrediction:
    """Hold the prediction of the plan in force against the analysis of a recording.

    The analysis knows from :func:`due_of` when outputs were due.
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
            own = in_time.filter(slot=number)
            found = _band(slot, share, own, in_time.height)
            if len(slots) > 1 and expected(plan) is not None:
                most = jitter_within_band(plan, slot, last=slot == slots[-1])
                found = replace(found, jitter_at_most_ns=most)
            bands.append(found)
    else:
        for mode, band in plan.modes.bands.items():
            own = outputs.filter(mode=mode)
            promised = (plan.predicted.modes or {}).get(mode)
            share = (sum(shares[:band]) or None) if promised is None else promised.shares[0]
            found = _band(slots[band - 1], share, own.filter(~pl.col("late")), own.height)
            bands.append(replace(found, mode=mode, late=int(own["late"].sum())))
    mean, longest, jitter = _figures(plan, slots, latency_statistics(outputs["judged_ns"]))
    return JudgedPrediction(
        mean=mean,
        max=longest,
        jitter=jitter,
        bands=tuple(bands),
        late=int(outputs["late"].sum()),
        outputs=outputs_due(analysis, plan),
        counted_from="cycle" if from_cycle else "chain",
        receivers=_receivers(plan, analysis, from_cycle),
    )


def _receivers(
    plan: ChainPlan, analysis: LatencyAnalysis, from_cycle: bool
) -> JudgedReceivers | None:
    """What is promised for those that receive the output, beside the measurement."""
    promised = plan.predicted.receivers
    if promised is None:
        return None
    in_time = pl.col("complete") & ~pl.col("reception_disturbed") & ~pl.col("late").fill_null(False)
    place = pl.col("place_ns" if from_cycle else "latency_ns")
    known = analysis.traversals.filter(in_time).drop_nulls("reception_ns")
    at = known.select(place + pl.col("reception_ns") - pl.col("latency_ns")).to_series()
    share = max(OVERRUN_PROBABILITY, allowed_late_share(plan.margin))
    found = latency_statistics(at)
    return JudgedReceivers(
        predicted_max_ns=promised.max_ns,
        predicted_jitter_ns=promised.jitter_ns,
        max_ns=found.max_ns,
        jitter_ns=found.jitter_ns,
        count=len(at),
        behind=int((at > promised.max_ns).sum()),
        most_behind=most_by_chance(len(at), share),
    )


def _figures(
    plan: ChainPlan, slots: Sequence[Slot], measured: LatencyStatistics
) -> tuple[JudgedFigure, JudgedFigure, JudgedFigure]:
    """Average, maximum and jitter: with outputs at slot starts and ends, with room, measured."""
    predicted = plan.predicted
    mean, longest, jitter = predicted.mean_ns, predicted.max_ns, predicted.jitter_ns
    publishing = 0
    lowest_max, lowest_jitter = mean, 0  # of outputs that leave when they are ready
    # Where outputs do not come in bands, their variance is not in the plan; between two limits it
    # is at most (max − mean)·(mean − min).
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
        if plan.into_open_slot == "next-slot":  # all leave when a slot begins, and within it
            publishing = ends[-1] - starts[-1]
    elif slots:
        longest, jitter = min(longest, slots[-1][0]), 0
        lowest_max = longest
    samples = 1 / plan.evidence.samples + 1 / measured.count if measured.count else 0.0
    room = round(STANDARD_ERRORS * (variance * samples) ** 0.5)

    def figure(at_start: int, name: str, lowest: int, above: int = 0) -> JudgedFigure:
        at_end, found = getattr(predicted, name), getattr(measured, name)
        low, high, holds = min(lowest, at_start), at_end + above, None
        if seen is not None and len(seen.leave_ns) == 1 and lowest == at_start:
            high = min(high, at_start + GATE_NS + SHORTEST_SLOT_NS)  # however wide the slot is
        high += GATE_NS if seen is None else 0  # as close as gates are to slots
        if plan.modes is None and found is not None:
            printed = [float(milliseconds(one)) for one in (low, found, high)]
            holds = printed == sorted(printed)
        return JudgedFigure(at_start, at_end, low, high, found, holds)

    return (
        figure(mean, "mean_ns", mean - room, room),
        figure(longest, "max_ns", lowest_max),
        figure(jitter, "jitter_ns", lowest_jitter, publishing),
    )


def jitter_within_band(plan: ChainPlan, slot: Slot, *, last: bool) -> int:
    """How far apart the outputs of one of several bands may be: as wide as its slot, into which
    they come at any time. Into the last one all that are in time come before it opens.
    """
    apart = STOPPED_THREAD_NS if any(publisher_servers(plan)) else GATE_NS
    length = slot[1] - slot[0]
    if last or plan.into_open_slot == "next-slot":
        length = min(length, SHORTEST_SLOT_NS)
    return length + apart


def _weighted(shares: Sequence[float], values: Sequence[float]) -> float:
    return sum(share * value for share, value in zip(shares, values, strict=True))


def _outputs(slots: Sequence[Slot], analysis: LatencyAnalysis, judged: str) -> pl.DataFrame:
    """Undisturbed complete traversals: ``judged_ns, place_ns, slot, mode, late``. The slot is that
    which the gate released the message in, else the last that had started as the output came."""
    decided = analysis.decided.select("traversal", "slot", "mode", gated=True)
    started = [(pl.col("place_ns") >= start).cast(pl.Int32) for start, _ in slots]
    return analysis.calm.join(decided, on="traversal", how="left").select(
        *("place_ns", "mode"),
        pl.col("late").fill_null(False),
        judged_ns=judged,
        slot=pl.when(pl.col("gated")).then("slot").otherwise(pl.sum_horizontal(-1, *started)),
    )


def _band(slot: Slot, predicted: float | None, own: pl.DataFrame, total: int) -> BandHeld:
    """The band of a slot: its ``own`` outputs, which were in time, of a ``total``."""
    found, place = latency_statistics(own["judged_ns"]), pl.col("place_ns")
    return BandHeld(
        slot_start_ns=slot[0],
        slot_end_ns=slot[1],
        predicted_share=predicted,
        count=found.count,
        share=found.count / total if total else None,
        inside=own.filter((place >= slot[0]) & (place < slot[1])).height,
        min_ns=found.min_ns,
        mean_ns=found.mean_ns,
        max_ns=found.max_ns,
        jitter_ns=found.jitter_ns,
    )
