"""The loop that a chain goes through, as a recording shows it: when it starts, and what it reads.

The part of the chain before it is what is planned: its output is the topic from which the loop's
node stores.
"""

import math
from typing import NamedTuple

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
    begun = whole.traversals["start"].unique().sort().to_numpy()
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
        phase = phase_of(starts, begun, math.gcd(loop.period_ns, period_ns))
        measured |= phase._asdict()
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


class Phase(NamedTuple):
    """When instances start behind the cycles of a chain; see `PlannedLoop`."""

    phase_ns: int
    jitter_ns: int
    drift_ppm: float


def phase_of(starts: _Times, cycles: _Times, common_ns: int) -> Phase:
    """Return the phase of starts behind cycles, modulo ``common_ns``; all times in ns, ascending.

    Where the two clocks drift apart, it is the phase at the end, and the jitter around the drift.
    """
    places = np.searchsorted(cycles, starts, side="right") - 1
    behind = (starts - cycles[np.maximum(places, 0)])[places >= 0]
    starts = starts[places >= 0]
    angles = np.exp(2j * np.pi * (behind % common_ns) / common_ns)
    # Unwrapped around the starts before, as a drift may take them round several times.
    unwrapped = np.unwrap(np.angle(angles)) / (2 * np.pi) * common_ns
    elapsed = (starts - starts[-1]).astype(np.float64)
    slope, at_end = np.polyfit(elapsed, unwrapped, 1)
    rest = unwrapped - (at_end + slope * elapsed)
    drifted = abs(slope) * -elapsed[0]
    error = float(np.std(rest)) * math.sqrt(12 / len(rest))
    if drifted < max(_SIGNIFICANT * error, _LEAST_DRIFT_NS):
        usual = round(float(np.median(unwrapped)))
        slope, at_end = 0.0, float(usual)
        rest = (behind - usual + common_ns // 2) % common_ns - common_ns // 2  # whole ns
    if np.subtract(*np.percentile(rest, (75, 25))) > common_ns / 4:  # there is no usual phase
        return Phase(0, common_ns, 0.0)
    early, late = np.percentile(rest, (0.5, 99.5))
    jitter = min(math.ceil(float(late)) - math.floor(float(early)), common_ns)
    return Phase(
        phase_ns=math.floor(at_end + float(early)) % common_ns,
        jitter_ns=jitter,
        drift_ppm=round(-float(slope) * 1e6, 3) + 0.0,  # never -0.0
    )


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
