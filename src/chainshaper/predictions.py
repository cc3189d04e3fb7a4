"""Holding a plan's prediction against what was measured.

**The convention.** Eq. 5 represents a latency band by the end of its slot, x_α. A gate lets a
message that waits go when its slot starts, at x_α − Δ; only one that arrives inside the slot
leaves later. So every figure is predicted twice: as if each output left at the start of its
slot, and at its end. A measurement should lie between the two, near the first.

With **modes** an output leaves in the slot of its cycle's mode, and what comes behind that slot is
late for it although there are others. Each mode is then held by itself against the share of
latencies that fit; the whole depends on how long each was in force, which no plan knows.

A gate counts its slots from the message's own origin. Where a back end holds back a publisher's
thread instead, slots count from the cycle, and a chain that began late in it has so much less
latency: an output's place is its latency plus how late its chain began.
"""

from dataclasses import dataclass, replace
from typing import Any

import polars as pl

from chainshaper.analysis import LatencyAnalysis
from chainshaper.overruns import gate_releases
from chainshaper.planning import Plan, publish_slots
from chainshaper.planning.overruns import cycles_until_output
from chainshaper.planning.publisher_threads import publisher_servers
from chainshaper.recording import Recording

__all__ = ["BandHeld", "FigureHeld", "PredictionHeld", "hold_prediction", "lateness_in_cycle"]

WAKE_UP_NS = 250_000
STANDARD_ERRORS = 3  # beyond so many, an average is not what was predicted


@dataclass(frozen=True)
class FigureHeld:
    """One figure: predicted with outputs at slot starts and at slot ends, and measured (ns).

    ``holds``: the measured figure lies between the two (None: nothing was measured, or the plan has
    modes, and it depends on them).
    """

    at_start_ns: int
    at_end_ns: int
    measured_ns: int | None
    holds: bool | None


@dataclass(frozen=True)
class BandHeld:
    """One latency band, over undisturbed cycles whose output came in the cycle it was due.

    ``inside`` counts outputs that left while the slot was open. Of a plan with modes it is the band
    of ``mode``: ``late`` counts the mode's outputs that came behind its slot, and the shares are
    those of its outputs that did not.
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


@dataclass(frozen=True)
class PredictionHeld:
    """A plan's prediction beside the measurement, over undisturbed cycles.

    ``late`` counts outputs that missed their last slot and came in a later cycle; they are in
    the figures, not in the bands. ``bands`` is empty for policies without publish slots.
    """

    mean: FigureHeld
    max: FigureHeld
    jitter: FigureHeld
    bands: tuple[BandHeld, ...]
    late: int


def hold_prediction(plan: Plan, recording: Recording, analysis: LatencyAnalysis) -> PredictionHeld:
    """Hold the prediction of the plan in force against a recording's analysis."""
    delay = cycles_until_output(plan) * plan.cycle_ns
    slots = [(start + delay, end + delay) for start, end in publish_slots(plan)]
    outputs = _outputs(plan, slots, recording, analysis)
    in_time = outputs.filter(pl.col("in_time"))
    predicted, measured = plan.predicted, analysis.undisturbed
    shares = predicted.shares if len(predicted.shares) == len(slots) else [None] * len(slots)
    if plan.modes is None:
        bands = tuple(
            _band(slot, share, in_time.filter(pl.col("slot") == number), in_time.height)
            for number, (slot, share) in enumerate(zip(slots, shares, strict=True))
        )
    else:
        bands = tuple(
            _band_of_mode(mode, slots[band - 1], sum(predicted.shares[:band]), outputs)
            for mode, band in plan.modes.bands.items()
        )
    mean, longest, jitter = predicted.mean_ns, predicted.max_ns, predicted.jitter_ns
    if _represented_by_slot_ends(plan):
        starts = [start for start, _ in slots]
        mean = round(sum(s * at for s, at in zip(predicted.shares, starts, strict=True)))
        longest, jitter = slots[-1][0], slots[-1][0] - slots[0][0]
    elif slots:
        longest, jitter = min(longest, slots[-1][0]), 0
    errors = STANDARD_ERRORS * _standard_error(plan, slots, analysis)
    began_late = outputs["place"] - outputs["latency_ns"]
    latest, usually = began_late.max() or 0, began_late.mean() or 0
    # With modes nobody can say beforehand.
    say = _figure if plan.modes is None else _unsaid
    return PredictionHeld(
        mean=say(mean, predicted.mean_ns, measured.mean_ns, errors + usually, errors),
        max=say(longest, predicted.max_ns, measured.max_ns, latest),
        jitter=say(jitter, predicted.jitter_ns, measured.jitter_ns, 0, latest),
        bands=bands,
        late=outputs.height - in_time.height,
    )


def _figure(
    at_start: int, at_end: int, measured: int | None, below: Any = 0, above: Any = 0
) -> FigureHeld:
    holds = None if measured is None else at_start - below <= measured <= at_end + above
    return FigureHeld(at_start, at_end, measured, holds)


def _unsaid(at_start: int, at_end: int, measured: int | None, *_: Any) -> FigureHeld:
    return FigureHeld(at_start, at_end, measured, None)


def _standard_error(plan: Plan, slots: list[tuple[int, int]], analysis: LatencyAnalysis) -> float:
    """How far the average may be off because both samples, before and after, are finite.

    Where outputs do not come in bands, their variance is not in the plan; between two limits it
    is at most (max − mean)·(mean − min).
    """
    if not analysis.undisturbed.count:
        return 0.0
    predicted = plan.predicted
    if _represented_by_slot_ends(plan):
        ends = [end for _, end in slots]
        mean = sum(share * end for share, end in zip(predicted.shares, ends, strict=True))
        variance = sum(
            share * (end - mean) ** 2 for share, end in zip(predicted.shares, ends, strict=True)
        )
    else:
        shortest = predicted.max_ns - predicted.jitter_ns
        above, below = predicted.max_ns - predicted.mean_ns, predicted.mean_ns - shortest
        variance = float(max(0, above) * max(0, below))
    samples = 1 / plan.evidence.samples + 1 / analysis.undisturbed.count
    return float((variance * samples) ** 0.5)


def _represented_by_slot_ends(plan: Plan) -> bool:
    """Whether a slot's end stands for the outputs in it, as in eq. 5."""
    slots = publish_slots(plan)
    return plan.policy != "one-long-slot" and 0 < len(slots) == len(plan.predicted.shares)


def _outputs(
    plan: Plan, slots: list[tuple[int, int]], recording: Recording, analysis: LatencyAnalysis
) -> pl.DataFrame:
    """Undisturbed complete traversals: ``latency_ns, place, slot, mode, in_time``.

    The slot is the one that the gate says it released the message in. Without a gate's events it
    is the last that had started when the output came, at its ``place`` in the cycle (ns).
    """
    chosen = analysis.traversals.filter(pl.col("complete") & ~pl.col("disturbed"))
    last = len(analysis.chain.callbacks) - 1
    taken = analysis.hops.filter(pl.col("hop") == last).select("traversal", "source_timestamp")
    if "gate_release" in recording.events:
        released = (
            gate_releases(recording, plan)
            .select("source_timestamp", "slot", "overrun", "mode")
            .unique("source_timestamp", keep="first")
        )
        joined = chosen.join(taken, on="traversal", how="left").join(
            released, on="source_timestamp", how="left"
        )
        if joined["slot"].count():
            in_time = pl.col("overrun").is_null() & pl.col("slot").is_not_null()
            return joined.select("latency_ns", "slot", "mode", place="latency_ns", in_time=in_time)
    starts = [start for start, _ in slots]
    late = lateness_in_cycle(chosen["start"], plan.cycle_ns) if any(publisher_servers(plan)) else 0
    return chosen.select("latency_ns", place=pl.col("latency_ns") + late).with_columns(
        slot=sum((pl.col("place") >= start).cast(pl.Int32) for start in starts)
        + pl.lit(-1, dtype=pl.Int32),
        in_time=pl.col("place") < (cycles_until_output(plan) + 1) * plan.cycle_ns,
        mode=pl.lit(None, dtype=pl.String),
    )


def lateness_in_cycle(starts: pl.Series, cycle_ns: int) -> pl.Series:
    """How long after the start of the cycle each chain began (ns).

    When cycles started is not recorded. The earliest beginning stands for it, which is the one
    behind the widest part of the cycle that has none, and came a wake-up after the start.
    """
    places = (starts % cycle_ns).sort()
    if not len(places):
        return starts
    gaps = places.diff().fill_null(places[0] + cycle_ns - places[-1])
    earliest: int = places[gaps.arg_max() or 0]
    behind: pl.Series = starts - (earliest - WAKE_UP_NS)
    return pl.select(behind % cycle_ns).to_series()


def _band(
    slot: tuple[int, int], predicted: float | None, own: pl.DataFrame, total: int
) -> BandHeld:
    latency, place = own["latency_ns"].to_numpy(), own["place"].to_numpy()
    low, high = (int(latency.min()), int(latency.max())) if latency.size else (None, None)
    return BandHeld(
        slot_start_ns=slot[0],
        slot_end_ns=slot[1],
        predicted_share=predicted,
        count=latency.size,
        share=latency.size / total if total else None,
        inside=int(((place >= slot[0]) & (place < slot[1])).sum()),
        min_ns=low,
        mean_ns=round(float(latency.mean())) if latency.size else None,
        max_ns=high,
        jitter_ns=None if low is None or high is None else high - low,
    )


def _band_of_mode(
    mode: str, slot: tuple[int, int], predicted: float, outputs: pl.DataFrame
) -> BandHeld:
    own = outputs.filter(pl.col("mode") == mode)
    in_time = own.filter(pl.col("in_time"))
    band = _band(slot, predicted or None, in_time, own.height)
    return replace(band, mode=mode, late=own.height - in_time.height)
