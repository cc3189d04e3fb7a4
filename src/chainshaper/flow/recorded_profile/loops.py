"""The loop that a chain goes through, as a recording shows it: when it starts, and what it reads.

The part of the chain before it is what is planned: its output is the topic from which the loop's
node stores.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis import DataFlow, LatencyAnalysis
from chainshaper.analysis.chains import chain_until
from chainshaper.analysis.data_age import LoopReading, last_loop
from chainshaper.analysis.graph import graph_of
from chainshaper.planning.profile import RecordedLoop
from chainshaper.values.application import Chain
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording

_FEWEST = 20  # instances, or deliveries, of which a share can be told
_SIGNIFICANT = 6.0  # standard errors by which a drift differs from none
_LEAST_DRIFT_NS = 20_000  # in the recording: less may come of wake-ups
_REFINED = 3  # times: starts that are not near the line at first are not near the next
_LARGEST_DRIFT = 2e-3  # of two quartzes, or of a timer that a program counts itself
_Times = npt.NDArray[np.int64]


class ChainBeforeLoop(NamedTuple):
    """The part of a chain before its last loop, and that loop; None: it goes through none."""

    chain: Chain
    reading: LoopReading | None


def before_loop(flow: DataFlow, chain: Chain) -> ChainBeforeLoop:
    """Return the part of a chain that is planned: what comes before the last loop in it.

    Raises InputError: the chain begins where the loop's node stores.
    """
    graph = graph_of(flow)
    reading = last_loop(graph, chain)
    if reading is None:
        return ChainBeforeLoop(chain, None)
    if reading.hop == 0:
        stores = graph.path(chain)[0]
        raise InputError(
            f"chain {chain.spec} begins at {stores.label}, which stores for {reading.loop.label}:"
            " there is nothing before the loop whose output could be shaped. Begin the chain at"
            f" what publishes {stores.topic}"
        )
    return ChainBeforeLoop(chain_until(graph, chain, reading.hop), reading)


def recorded_loop(
    recording: Recording,
    flow: DataFlow,
    whole: LatencyAnalysis,
    reading: LoopReading,
    period_ns: int,
) -> RecordedLoop:
    """Return what is measured of a loop that a chain goes through.

    ``whole`` is the analysis of the chain through the loop, ``period_ns`` that of the chain.

    Raises InputError: fewer instances of it were recorded than are needed.
    """
    hop, loop = reading
    instances = flow.instances.filter(callback_id=loop.id).sort("start")
    starts = instances["start"].to_numpy()
    if len(starts) < _FEWEST:
        raise InputError(
            f"{recording.path}: {loop.label} has {len(starts)} instances, too few to plan with:"
            " record longer"
        )
    threads = set(instances["tid"])
    known = [
        thread
        for thread in recording.info.threads
        if thread.tid in threads and thread.pid in loop.processes
    ]
    thread = known[0] if len(known) == 1 else None
    realtime = thread is not None and thread.policy in ("SCHED_FIFO", "SCHED_RR")
    raised_by_us = recording.info.application is not None or recording.info.plan is not None
    stored = _stored(flow, whole, hop, threads)
    measured: dict[str, object] = {}
    if loop.period_ns is None:
        apart = np.percentile(np.diff(starts), (5, 50, 95))
        measured["intervals_ns"] = tuple(round(float(value)) for value in apart)
    else:
        measured["period_ns"] = loop.period_ns
        common_ns = math.gcd(loop.period_ns, period_ns)
        measured |= _phase_in_calm_cycles(whole, starts, common_ns)._asdict()
    took = pl.coalesce("execution_ns", pl.col("end") - pl.col("start")).fill_null(0)
    in_cycles = instances.group_by(pl.col("start") // period_ns).agg(
        together=took.sum(), longest=took.max()
    )
    return RecordedLoop(
        chain=whole.chain.spec,
        node=loop.node,
        topic=whole.chain.topics[hop - 1],
        samples=len(starts),
        stored_ns=stored.times_ns,
        storing_ns=stored.storing_ns,
        takes_itself=stored.by_loop,
        thread=None if thread is None else thread.comm or None,
        core=thread.cores[0] if thread is not None and len(thread.cores) == 1 else None,
        realtime_priority=thread.priority if thread and realtime and not raised_by_us else None,
        inferred=instances.join(flow.turns, on="instance", how="semi").is_empty(),
        time_ns=int(in_cycles["together"].max()),  # type: ignore[arg-type]
        once_ns=int(in_cycles["longest"].max()),  # type: ignore[arg-type]
        **measured,  # type: ignore[arg-type]
    )


def _phase_in_calm_cycles(whole: LatencyAnalysis, starts: _Times, common_ns: int) -> "Phase":
    """Return the phase of the loop's starts in cycles that the machine did not disturb.

    Where it disturbed nearly all, it is that of all starts.
    """
    begun = whole.traversals["start"].unique().sort().to_numpy()
    calm = whole.traversals.filter(~pl.col("disturbed"))["start"].unique().to_numpy()
    places = np.searchsorted(begun, starts, side="right") - 1
    in_calm = (places >= 0) & np.isin(begun[np.maximum(places, 0)], calm)
    if in_calm.sum() >= _FEWEST:
        starts = starts[in_calm]
    return phase_of(starts, begun, common_ns)


class Phase(NamedTuple):
    """When instances start behind the cycles of a chain; see `PlannedLoop`."""

    phase_ns: int
    jitter_ns: int
    drift_ppm: float


def phase_of(starts: _Times, cycles: _Times, common_ns: int) -> Phase:
    """Return the phase of starts behind cycles, modulo ``common_ns``; all times in ns, ascending.

    Cycles begin when they really did, late or not: ages count from there, so that the jitter has
    that of both. Where the two clocks drift apart, it is the phase at the end, and the jitter
    around the drift. Starts that are late, by more than half of ``common_ns`` or several in turn,
    are no drift.
    """
    places = np.searchsorted(cycles, starts, side="right") - 1
    behind = (starts - cycles[np.maximum(places, 0)])[places >= 0]
    starts = starts[places >= 0]
    line = _line_through(behind, starts - starts[-1], common_ns)
    if line is None:  # there is no usual phase
        return Phase(0, common_ns, 0.0)
    drift, at_end, rest = line.drift, line.at_end, line.rest
    if not line.is_significant:
        drift, at_end = 0.0, float(round(at_end))
        rest = _around(behind, round(at_end), common_ns)  # whole ns
    early, late = np.percentile(rest, (0.5, 99.5))
    jitter = min(math.ceil(float(late)) - math.floor(float(early)), common_ns)
    return Phase(
        phase_ns=math.floor(at_end + float(early)) % common_ns,
        jitter_ns=jitter,
        drift_ppm=round(-drift * 1e6, 3) + 0.0,  # never -0.0
    )


class _Line(NamedTuple):
    """Where places are that repeat, and drift."""

    drift: float  # ns per ns
    at_end: float  # the usual place at the end, ns
    rest: npt.NDArray[np.float64]  # how far from the line places are
    is_significant: bool  # whether the drift differs from none


def _line_through(places: _Times, elapsed: _Times, common_ns: int) -> _Line | None:
    """Return the line through places that repeat every ``common_ns``; None: they have no usual one.

    ``elapsed`` is when each was seen, up to 0 at the end.
    """
    drift, at_end = _usual_drift(places, elapsed, common_ns)
    error = math.inf
    for _ in range(_REFINED):
        rest = _around(places - drift * elapsed, at_end, common_ns)
        usual, spread = np.median(rest), np.subtract(*np.percentile(rest, (75, 25)))
        if spread > common_ns / 4:
            return None
        near = np.abs(rest - usual) <= max(4 * spread, _LEAST_DRIFT_NS)
        slope, moved = np.polyfit(elapsed[near].astype(np.float64), rest[near], 1)
        error = float(np.std((rest - moved - slope * elapsed)[near])) * math.sqrt(12 / near.sum())
        drift, at_end = drift + float(slope), at_end + float(moved)
    rest = _around(places - drift * elapsed, at_end, common_ns)
    drifted = abs(drift) * -float(elapsed[0])
    return _Line(drift, at_end, rest, drifted >= max(_SIGNIFICANT * error, _LEAST_DRIFT_NS))


def _usual_drift(behind: _Times, elapsed: _Times, common_ns: int) -> tuple[float, float]:
    """Return the drift (ns per ns) at which most places agree, and where they are at the end (ns).

    Places repeat every ``common_ns``, so each is a direction. At the right drift directions agree,
    however late a few of them are; a line through the places would follow these. The frequency of
    the greatest sum of directions is sought, in bins of time that are short beside a turn of the
    largest drift, and with zeros behind them, so that frequencies lie closely: over the whole
    recording the drift is right to a sixteenth of ``common_ns``.
    """
    lasted = int(-elapsed[0]) + 1
    turns = math.ceil(_LARGEST_DRIFT * lasted / common_ns) + 1  # at the largest drift
    bins = 1 << (8 * turns).bit_length()
    directions = np.exp(2j * np.pi * (behind % common_ns) / common_ns)
    binned = np.zeros(8 * bins, complex)
    np.add.at(binned, (elapsed + lasted - 1) * bins // lasted, directions)
    sums = np.fft.fft(binned)
    frequencies = np.fft.fftfreq(len(binned), lasted / bins)  # turns per ns
    possible = np.flatnonzero(np.abs(frequencies) * common_ns <= _LARGEST_DRIFT)
    best = possible[np.argmax(np.abs(sums[possible]))]
    drift = float(frequencies[best]) * common_ns
    mean = (directions * np.exp(-2j * np.pi * drift * elapsed / common_ns)).sum()
    return drift, float(np.angle(mean)) / (2 * np.pi) * common_ns


def _around(places: npt.NDArray[Any], center: float, common_ns: int) -> npt.NDArray[Any]:
    """Return how far from ``center`` places are, which repeat every ``common_ns``."""
    return (places - center + common_ns // 2) % common_ns - common_ns // 2


class _Stored(NamedTuple):
    times_ns: tuple[int, int, int]
    storing_ns: int
    by_loop: bool


def _stored(flow: DataFlow, whole: LatencyAnalysis, hop: int, threads: set[int]) -> _Stored:
    """Return how long messages took from their publication until they were stored."""
    calm = whole.traversals.filter(~pl.col("disturbed")).select("traversal")
    hops = whole.hops.filter(hop=hop).drop_nulls("communication_ns")
    if (undisturbed := hops.join(calm, on="traversal", how="semi")).height >= _FEWEST:
        hops = undisturbed
    if hops.is_empty():
        raise InputError(
            f"chain {whole.chain.spec}: nothing in the recording says how long"
            f" {whole.chain.topics[hop - 1]} takes to the node of the loop: record longer"
        )
    tids = pl.lit(flow.instances["tid"]).gather("instance")
    by_loop = hops.select(tids.is_in(sorted(threads)).mean()).item() > 0.5
    arrived = hops["communication_ns"].to_numpy()
    if by_loop:  # it was there when it was taken soonest, at the latest
        soonest = int(arrived.min())
        return _Stored((0, soonest, soonest), 0, by_loop=True)
    took = (hops["end"].fill_null(hops["start"]) - hops["start"]).to_numpy()
    most = np.percentile(arrived + took, 99.5, method="higher")
    storing = int(np.percentile(took, 99.5, method="higher"))
    shortest, longest = int(arrived.min()), int((arrived + took).max())
    return _Stored((shortest, int(most), longest), storing, by_loop=False)
