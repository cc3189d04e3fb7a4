"""What the latencies of recordings cost the controller of a plant."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper.control.costs import NEVER, SequenceCost, cost_over, percentile_latencies
from chainshaper.control.flows import Flows
from chainshaper.control.loop import Loop
from chainshaper.control.modes import ModeCosts, mode_costs
from chainshaper.control.plant_file import LoopDescription, load_loop
from chainshaper.control.steady_state import (
    LatencyCosts,
    StableLatencies,
    cost_of_constant,
    covariance_of_constant,
    stable_latencies,
)
from chainshaper.planning import Plan
from chainshaper.planning.latencies import read_latencies
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError
from chainshaper.values.progress import Progress
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import measure_latency, taken_chain

PERCENTILES = (50.0, 95.0, 99.0, 100.0)
"""At which a recording's latencies are made constant, for comparison."""
Instant: TypeAlias = Literal["output", "receiver"]
"""When the actuator moves: when the output leaves, or when its subscriber's callback starts."""


@dataclass(frozen=True)
class ConstantCost:
    """The cost of a recording's loop if all of its latencies were one of their percentiles."""

    percentile: float
    latency_ns: int
    cost: float  # with the loop's controller; inf: unstable
    redesigned: float | None  # with the LQG controller for this delay; None: there is none


@dataclass(frozen=True)
class ControlledRecording:
    """The cost of a loop over the cycles of one recording."""

    path: Path
    chain: str
    samples_ns: NDArray[np.int64]  # when each cycle started
    latencies_ns: NDArray[np.int64]  # of each; `NEVER` where no output came
    sequence: SequenceCost
    steady: float | None  # of the same latencies in any order; None: some are above the period
    constants: tuple[ConstantCost, ...]
    notes: tuple[str, ...]

    @property
    def lost(self) -> int:
        return int(np.count_nonzero(self.latencies_ns == NEVER))

    @property
    def came_ns(self) -> NDArray[np.int64]:
        """The latencies of the outputs that came."""
        came: NDArray[np.int64] = self.latencies_ns[self.latencies_ns != NEVER]
        return came


@dataclass(frozen=True)
class ControlCosts:
    """A loop over several recordings, usually before and after shaping."""

    description: LoopDescription
    loop: Loop
    period_ns: int
    stable: StableLatencies | None  # with these constant latencies; None: with none
    recordings: tuple[ControlledRecording, ...]
    modes: ModeCosts | None
    notes: tuple[str, ...]


def control_costs(
    plant: LoopDescription | str | Path,
    recordings: Sequence[Recording | str | Path],
    chain: str | None = None,
    plan: Plan | None = None,
    *,
    instant: Instant = "output",
    delay_ns: int | None = None,
    progress: Progress = lambda *_: None,
) -> ControlCosts:
    """Compute what the latencies of a chain cost the controller, in each recording.

    The plant is sampled when the chain starts. ``delay_ns`` is what the controller is designed
    for, in place of what the file says.

    Raises InputError: the file is wrong, there is no such chain, or the recordings have different
    periods. OperationError: a recording has too few cycles. PlatformError: SciPy is missing.
    """
    description = plant if isinstance(plant, LoopDescription) else load_loop(plant)
    taken: list[_Taken] = []
    periods = []
    for place, recording in enumerate(recordings):
        progress(place / (2 * len(recordings)), "measuring the chain")
        measurement = measure_latency(recording, chain, plan)
        analysis = measurement.analysis
        samples, latencies = cycles_of(analysis.traversals, instant)
        if len(samples) < 2:
            raise InputError(f"{measurement.recording.path}: fewer than two cycles of the chain")
        periods.append(analysis.period_ns or round(float(np.median(np.diff(samples)))))
        notes = taken_chain(measurement.recording, chain, analysis.chain.spec)
        taken.append((measurement.recording.path, analysis.chain.spec, samples, latencies, notes))
    return _costs(description, taken, periods, delay_ns, progress)


def control_costs_of_latencies(
    plant: LoopDescription | str | Path, latencies: str | Path, *, delay_ns: int | None = None
) -> ControlCosts:
    """Compute the same for a file of latencies, whose cycles are a period of the plant's apart.

    Raises InputError: as :func:`control_costs`, or the plant's file has no period.
    """
    description = plant if isinstance(plant, LoopDescription) else load_loop(plant)
    measured = read_latencies(latencies)
    period_ns = round(description.problem().period_s * 1e9)
    samples = np.arange(measured.size, dtype=np.int64) * period_ns
    taken = [(Path(latencies), "", samples, measured, ())]
    return _costs(description, taken, [period_ns], delay_ns, lambda *_: None)


_Taken: TypeAlias = tuple[Path, str, NDArray[np.int64], NDArray[np.int64], tuple[str, ...]]


def _costs(
    description: LoopDescription,
    taken: Sequence[_Taken],
    periods: Sequence[int],
    delay_ns: int | None,
    progress: Progress,
) -> ControlCosts:
    """Return the costs over cycles: path, chain, samples, latencies and notes of each recording."""
    if max(periods) > 1.02 * min(periods):
        shown = ", ".join(
            f"{duration_text(period)} in {path.name}"
            for period, (path, *_) in zip(periods, taken, strict=True)
        )
        raise InputError(f"the chain's period is {shown}: give recordings of one application")
    period_ns = description.period_ns or periods[0]
    for period in periods:
        description.problem(period)  # it fits the file's
    loop = (
        description.loop(period_ns)
        if delay_ns is None
        else description.redesigned(delay_ns, period_ns)
    )
    flows = Flows(loop.problem)
    controlled = []
    for place, (path, spec, samples, latencies, notes) in enumerate(taken):
        progress(0.5 + place / (2 * len(taken)), "computing the cost")
        costs = over_cycles(description, loop, samples, latencies, flows)
        controlled.append(ControlledRecording(path, spec, samples, latencies, *costs, notes))
    modes = mode_costs(loop.problem, description.modes_ns) if description.modes_ns else None
    return ControlCosts(
        description=description,
        loop=loop,
        period_ns=period_ns,
        stable=stable_latencies(loop, flows),
        recordings=tuple(controlled),
        modes=modes,
        notes=(*loop.problem.doubts, *_under_way(controlled, period_ns)),
    )


def cycles_of(
    traversals: pl.DataFrame, instant: Instant
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return when each cycle of a chain started, and its latency; :data:`~.costs.NEVER`: none came.

    Cycles at the end, whose output may have come behind it, are left out.
    """
    column = "latency_ns" if instant == "output" else "reception_ns"
    frame = traversals.sort("start").unique("start", keep="first", maintain_order=True)
    samples = frame["start"].to_numpy().astype(np.int64)
    latencies = frame[column].fill_null(NEVER).to_numpy().astype(np.int64)
    if instant == "receiver" and not (latencies >= 0).any():
        raise InputError("no node that subscribes to the output was recorded: leave out --at")
    came = np.flatnonzero(latencies >= 0)
    until = int(came[-1]) + 1 if came.size else 0
    return samples[:until], latencies[:until]


def over_cycles(
    description: LoopDescription,
    loop: Loop,
    samples_ns: NDArray[np.int64],
    latencies_ns: NDArray[np.int64],
    flows: Flows,
) -> tuple[SequenceCost, float | None, tuple[ConstantCost, ...]]:
    """Return the cost over cycles, that of their distribution, and those of constant latencies."""
    period_ns = round(loop.problem.period_s * 1e9)
    typical = percentile_latencies(latencies_ns, PERCENTILES)
    begin = covariance_of_constant(loop, typical[0] / 1e9, flows)
    sequence = cost_over(loop, samples_ns, latencies_ns, begin, flows)
    fitting = latencies_ns.max() <= period_ns
    steady = LatencyCosts(loop, flows).cost(latencies_ns) if fitting else None
    constants = []
    for percentile, latency_ns in zip(PERCENTILES, typical, strict=True):
        same = np.full(len(samples_ns), latency_ns, dtype=np.int64)
        begin = covariance_of_constant(loop, latency_ns / 1e9, flows)
        if np.isfinite(cost_of_constant(loop, latency_ns / 1e9, flows)):
            cost = cost_over(loop, samples_ns, same, begin, flows).cost
        else:
            cost = float("inf")
        constants.append(
            ConstantCost(
                percentile, latency_ns, cost, _redesigned(description, latency_ns, period_ns)
            )
        )
    return sequence, steady, tuple(constants)


def _redesigned(description: LoopDescription, latency_ns: int, period_ns: int) -> float | None:
    try:
        return cost_of_constant(description.redesigned(latency_ns, period_ns), latency_ns / 1e9)
    except InputError:
        return None


def _under_way(recordings: Sequence[ControlledRecording], period_ns: int) -> list[str]:
    """Say in which recordings latencies are above the period, and how they are treated."""
    return [
        f"{recording.path.name}: {above} outputs came later than a period"
        f" ({duration_text(period_ns)}): several samples were under way, and each output is applied"
        " when it comes"
        for recording in recordings
        if (above := int(np.count_nonzero(recording.latencies_ns > period_ns)))
    ]
