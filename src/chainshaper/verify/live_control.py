"""What a control loop cost in a live run, as its plant measured it, beside what was computed.

The computed cost is that of the same samples and inputs at the same instants, by exact propagation
of the covariance (:mod:`chainshaper.control.costs`). What is left between the two is chance.
"""

import json
from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper.control.costs import NEVER, cost_of_events, events_of, margin_of
from chainshaper.control.flows import Flows
from chainshaper.control.loop import Loop
from chainshaper.control.plant_file import described_loop
from chainshaper.control.steady_state import covariance_of_constant
from chainshaper.values import events
from chainshaper.values.errors import OperationError
from chainshaper.values.recording import Recording
from chainshaper.values.yaml_file import AS_YAML, wrong_values_refused
from chainshaper.workload.description import Application, loop_period_ns


@dataclass(frozen=True)
class LiveCost:
    """The cost of a control loop in a recording of a live run, per second.

    * ``cycles``: samples of the plant.
    * ``lost``: of these, for how many no input arrived before the run ended.
    * ``copies``: of the plant, over which the cost is averaged.
    * ``measured``: by the plant; inf: it grew beyond all bounds.
    * ``computed``: for the same instants; inf: the loop is unstable with them.
    * ``margin``: half of the interval around what is computed in which 95 % of such runs measure;
      nan: there are too few cycles to know.
    """

    cycles: int
    lost: int
    copies: int
    measured: float
    computed: float
    margin: float

    @property
    def agrees(self) -> bool:
        """Whether the measured cost is in the interval around the computed one."""
        return bool(abs(self.measured - self.computed) <= self.margin)


def live_cost(recording: Recording) -> LiveCost | None:
    """Return what the control loop of a live run cost; None: it had none.

    Raises InputError: the recording's description of the loop is damaged. OperationError: the plant
    was sampled fewer than two times. PlatformError: SciPy is missing.
    """
    steps = events.table(recording.events, "plant_step")
    if steps.is_empty() or recording.info.application is None:
        return None
    with wrong_values_refused(Application, f"{recording.path}: the application in it: "):
        written = json.dumps(dict(recording.info.application))
        application = Application.model_validate_json(written, context=AS_YAML)
    if application.control_loop is None:
        return None
    description = described_loop(recording.path, application.control_loop)
    loop = description.loop(loop_period_ns(application))
    flows = Flows(loop.problem)
    runs = [
        run
        for _, of_process in steps.sort("time", maintain_order=True).group_by("pid")
        if (run := _run(loop, flows, of_process)) is not None
    ]
    if not runs:
        raise OperationError(f"{recording.path}: the plant was sampled fewer than two times")
    measured, computed, durations = (
        np.concatenate([getattr(run, name) for run in runs])
        for name in ("measured", "computed", "durations_s")
    )
    with np.errstate(all="ignore"):
        total = float(durations.sum())
        average = float(measured.sum()) / total
        return LiveCost(
            cycles=len(measured),
            lost=sum(run.lost for run in runs),
            copies=application.control_loop.copies,
            measured=average if np.isfinite(average) else float("inf"),
            computed=sum(run.cost * float(run.durations_s.sum()) for run in runs) / total,
            margin=margin_of(measured - computed, durations),
        )


@dataclass(frozen=True)
class _Run:
    """The cycles of one process of the plant, from each sample to the next."""

    measured: NDArray[np.float64]  # the cost of each, not per second
    computed: NDArray[np.float64]  # the same
    durations_s: NDArray[np.float64]
    cost: float  # computed, per second; inf: unstable
    lost: int


def _run(loop: Loop, flows: Flows, steps: pl.DataFrame) -> _Run | None:
    """Return the cycles of a process, from its steps in order; None: there are fewer than two."""
    is_sample = (steps["step"] == "sampled").to_numpy()
    if np.count_nonzero(is_sample) < 2:
        return None
    steps = steps[int(np.argmax(is_sample)) :]
    sampled, driven = (steps.filter(step=step) for step in ("sampled", "driven"))
    arrivals = sampled.join(driven, on="sample", how="left", maintain_order="left")
    latencies = (arrivals["time_right"] - arrivals["time"]).fill_null(NEVER).to_numpy()
    happened = events_of(sampled["time"].to_numpy(), latencies, int(steps["time"][-1]))
    came = latencies[latencies != NEVER]
    typical_s = float(np.median(came)) / 1e9 if came.size else loop.problem.period_s / 2
    begin = covariance_of_constant(loop, typical_s, flows)
    computed = cost_of_events(loop, happened, begin, flows)
    # A step's cost is that of the time before it, which belongs to the sample before.
    cycle = np.cumsum((steps["step"] == "sampled").to_numpy()) - 1
    weights = steps["cost"].to_numpy()[1:]
    measured = np.bincount(cycle[:-1], weights, minlength=sampled.height).astype(np.float64)
    return _Run(
        measured, computed.costs, computed.durations_s, computed.cost, len(latencies) - len(came)
    )
