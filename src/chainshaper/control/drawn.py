"""A control loop with noise that is drawn: one possible run, for pictures, and to check costs with.

The noise between two events has its exact covariance, so that only chance separates the average
cost of many runs from :func:`~.costs.cost_of_events`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chainshaper import _core
from chainshaper.control.costs import Events, sampling
from chainshaper.control.flows import Flow, Flows
from chainshaper.control.loop import Loop, Matrix, root_of


class Drawn(NamedTuple):
    """Runs of a loop: their costs, and what the plant's outputs were at each event."""

    costs: NDArray[np.float64]  # per second, of each run
    times_s: NDArray[np.float64]
    outputs: NDArray[np.float64]  # event x output, of the first run
    inputs: NDArray[np.float64]  # event x input that is applied, of the first run


def draw(
    loop: Loop, events: Events, runs: int = 1, seed: int = 0, covariance: Matrix | None = None
) -> Drawn:
    """Return runs of a loop over events, from states that are drawn with a ``covariance``."""
    random = np.random.default_rng(seed)
    flows, parts = Flows(loop.problem), loop.slices(events.under_way)
    plant = loop.problem.plant
    states = np.zeros((parts["all"].stop, runs))
    if covariance is not None:
        known = parts["controller"].stop
        drawn = random.standard_normal((known, runs))
        states[:known] = root_of(covariance[:known, :known]) @ drawn
    rows, _ = sampling(loop)
    from_sample = np.vstack([loop.controller.g, loop.controller.k])
    sample_root = from_sample @ root_of(loop.problem.measurement_noise)
    flowing, seen = parts["plant"].stop, slice(parts["plant"].start, parts["controller"].stop)
    cost, now = np.zeros(runs), 0.0
    times: list[float] = []
    outputs, inputs = list[NDArray[np.float64]](), list[NDArray[np.float64]]()
    known_flows: dict[float, tuple[Flow, Matrix]] = {}
    begun = 0.0
    for wait, slot in zip(events.waits_s.tolist(), events.slots.tolist(), strict=True):
        left = wait
        while left > 0:
            step = min(left, flows.longest_s)
            left -= step
            if step not in known_flows:
                flow = flows.over(step)
                known_flows[step] = (flow, root_of(flow.noise))
            flow, root = known_flows[step]
            start = states[:flowing]
            cost += (start * (flow.cost @ start)).sum(axis=0) + flow.noise_cost
            noise = root @ random.standard_normal((plant.states, runs))
            states[parts["plant"]] = flow.rows @ start + noise
        now += wait
        if slot == _core.NO_EVENT:
            pass
        elif slot >= 0:
            states[parts["applied"]] = states[parts[f"slot{slot}"]]
        else:
            if not times:
                cost[:], begun = 0.0, now
            noise = sample_root @ random.standard_normal((plant.outputs, runs))
            computed = rows @ states[seen] + noise
            states[parts["controller"]] = computed[: loop.controller.states]
            states[parts[f"slot{~slot}"]] = computed[loop.controller.states :]
        times.append(now)
        outputs.append(plant.c @ states[parts["plant"], 0])
        inputs.append(states[parts["applied"], 0].copy())
    return Drawn(cost / (now - begun), np.array(times), np.array(outputs), np.array(inputs))
