"""The cost of a loop over a sequence of events that happened, exactly.

The covariance of the state goes from event to event through linear maps; nothing is drawn. An event
is a sample, or an output that arrives. What is treated how:

* An output that never came changes nothing: the one before it stays applied.
* An output may come after later samples: several are under way then, each in a slot of the state.
* An output that comes when a newer one is applied already replaces it: actuators take what comes.
* A sample that was due and not taken makes the time between two samples longer, nothing else. The
  controller goes on as if a period had passed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from chainshaper import _core
from chainshaper.control.flows import Flows
from chainshaper.control.loop import Loop, Matrix
from chainshaper.values.errors import InputError

NEVER = -1  # the latency of an output that did not come
MOST_UNDER_WAY = 32
BATCHES = 20  # of cycles, whose average costs tell how sure the average over all is
SURE = 2.093  # of Student's t with BATCHES − 1 degrees of freedom: 95 %
ENDLESS = 1e12  # times the first covariance: more than any stable loop grows to


@dataclass(frozen=True)
class SequenceCost:
    """The cost of a loop over a sequence of latencies."""

    cost: float  # per second, over all of it
    margin: float  # half of the 95 % interval of the cost of longer sequences like this one
    costs: NDArray[np.float64]  # of each cycle, from its sample to the next one
    durations_s: NDArray[np.float64]  # of each cycle
    covariance: Matrix  # of the state behind it

    @property
    def diverged(self) -> bool:
        """Whether the loop's variance has grown beyond all bounds."""
        return not np.isfinite(self.cost)


@dataclass(frozen=True)
class Events:
    """What happens in a loop, in the order of time."""

    waits_s: NDArray[np.float64]
    slots: NDArray[np.int32]
    under_way: int  # so many slots: the outputs that may be on their way at a sample, and one


def events_of(
    samples_ns: NDArray[np.int64], latencies_ns: NDArray[np.int64], end_ns: int | None = None
) -> Events:
    """Return the events of samples at ascending instants, and of outputs so long behind them.

    A latency of :data:`NEVER` is of an output that never came. After ``end_ns`` (default: one
    median period behind the last sample) nothing happens.

    Raises InputError: too many outputs are under way at once.
    """
    count = len(samples_ns)
    if count < 2 or len(latencies_ns) != count:
        raise InputError("a cost over a sequence needs two cycles, and a latency for each")
    if (np.diff(samples_ns) <= 0).any():
        raise InputError("two cycles start at the same instant, or out of order")
    if end_ns is None:
        end_ns = int(samples_ns[-1] + np.median(np.diff(samples_ns)))
    came = latencies_ns >= 0
    arrivals = samples_ns + latencies_ns
    # An output occupies its slot from its sample on until it arrives, or for ever until reused.
    until = np.where(came, arrivals, samples_ns)
    overtaken = np.searchsorted(samples_ns, until, side="left") - np.arange(count)
    under_way = int(max(1, overtaken.max()))
    if under_way > MOST_UNDER_WAY:
        reason = f"{under_way} outputs are under way at once, {MOST_UNDER_WAY} at most"
        raise InputError(f"{reason}: check the period, or the chain")
    slot = (np.arange(count) % under_way).astype(np.int32)
    inside = came & (arrivals <= end_ns)
    times = np.concatenate([samples_ns, arrivals[inside], [end_ns]])
    slots = np.concatenate([~slot, slot[inside], [_core.NO_EVENT]]).astype(np.int32)
    # Of one instant an arrival of an earlier sample is first; that of its own sample comes behind
    # it: with a latency of 0 the sample's output is applied at once.
    rank = np.concatenate([np.full(count, 1), np.where(latencies_ns[inside] == 0, 2, 0), [3]])
    order = np.lexsort((rank, times))
    return Events(np.diff(times[order], prepend=times[order[0]]) / 1e9, slots[order], under_way)


def cost_of_events(
    loop: Loop, events: Events, covariance: Matrix | None = None, flows: Flows | None = None
) -> SequenceCost:
    """Return the cost over events, from a covariance of [applied; x; controller] (None: of 0)."""
    flows = flows or Flows(loop.problem)
    parts = loop.slices(events.under_way)
    begin = np.zeros((parts["all"].stop, parts["all"].stop))
    known = parts["controller"].stop
    if covariance is not None:
        begin[:known, :known] = covariance[:known, :known]
    rows, noise = sampling(loop)
    plant = loop.problem.plant
    with np.errstate(all="ignore"):
        costs, durations, last = _core.propagate_covariance(
            sizes=(plant.inputs, plant.states, loop.controller.states, events.under_way),
            longest_s=flows.longest_s,
            flows=flows.table.ravel(),
            rows=rows.ravel(),
            noise=noise.ravel(),
            waits_s=np.ascontiguousarray(events.waits_s),
            slots=np.ascontiguousarray(events.slots),
            covariance=begin.ravel(),
        )
    last = last.reshape(begin.shape)
    grown = float(np.abs(np.diag(last)).max(initial=0.0))
    usual = max(float(np.abs(np.diag(begin)).max()), float(np.median(np.abs(costs))), 1e-300)
    cost = float(costs.sum() / durations.sum())
    if not np.isfinite(cost) or not np.isfinite(grown) or grown > ENDLESS * usual:
        cost = float("inf")
    return SequenceCost(cost, margin_of(costs, durations), costs, durations, last)


def cost_over(
    loop: Loop,
    samples_ns: NDArray[np.int64],
    latencies_ns: NDArray[np.int64],
    covariance: Matrix | None = None,
    flows: Flows | None = None,
) -> SequenceCost:
    """Return the cost over measured cycles: :func:`events_of`, :func:`cost_of_events`."""
    return cost_of_events(loop, events_of(samples_ns, latencies_ns), covariance, flows)


def sampling(loop: Loop) -> tuple[Matrix, Matrix]:
    """Return what a sample does: rows of the controller's state and output over [x; z], and the
    covariance that the measurement's noise gives them.
    """
    controller, c = loop.controller, loop.problem.plant.c
    from_sample = np.vstack([controller.g, controller.k])
    rows = np.hstack([from_sample @ c, np.vstack([controller.f, controller.h])])
    noise = from_sample @ loop.problem.measurement_noise @ from_sample.T
    return np.ascontiguousarray(rows), np.ascontiguousarray(noise)


def margin_of(costs: NDArray[np.float64], durations_s: NDArray[np.float64]) -> float:
    """Return half of the 95 % interval of a long sequence's cost, from averages of batches.

    ``costs`` are of cycles, not per second. NaN: there are too few, or the costs have no bound.

    Cycles that follow each other depend on each other; batches of many hardly do.
    """
    if len(costs) < 2 * BATCHES or not np.isfinite(costs).all():
        return float("nan")
    ends = np.linspace(0, len(costs), BATCHES + 1).astype(int)
    averages = [
        costs[begin:end].sum() / durations_s[begin:end].sum()
        for begin, end in pairwise(ends.tolist())
    ]
    return float(SURE * np.std(averages, ddof=1) / np.sqrt(BATCHES))


def constant_events(period_ns: int, latency_ns: int, cycles: int) -> Events:
    """Return the events of cycles a period apart, whose outputs all have one latency."""
    samples = np.arange(cycles, dtype=np.int64) * period_ns
    return events_of(samples, np.full(cycles, latency_ns, dtype=np.int64))


def percentile_latencies(
    latencies_ns: NDArray[np.int64], percentiles: Sequence[float]
) -> list[int]:
    """Return the latencies, of those outputs that came, at percentiles."""
    came = latencies_ns[latencies_ns >= 0]
    return [round(float(value)) for value in np.percentile(came, percentiles)]
