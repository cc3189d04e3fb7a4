"""The plant and the controller of a live run, each in its node: with noise that is drawn.

The plant's state is carried exactly from event to event (:mod:`chainshaper.control.flows`). An
event is a sample, or an input that arrives, at the instant at which its callback runs. The noise
between two events has its exact covariance; what the time between them costs is the expectation
from the state at its beginning, so that the integral is exact too, but for chance.

A loop may have several copies of the plant, each with noise of its own: one message carries the
samples, or the inputs, of all of them. So a short run says more about the average cost.

The numbers in a message are floating-point numbers of 64 bits: first the sample's own number, from
0, then copy by copy the outputs, or inputs.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chainshaper.control.flows import Flows
from chainshaper.control.loop import Loop, Matrix, root_of
from chainshaper.control.plant_file import LoopFile, described_loop
from chainshaper.control.steady_state import covariance_of_constant
from chainshaper.workload.event_log import EventLog, number_of, number_of_real

PLANT, FIRST_STATES = 1, 2
"""Which random numbers of the application's seed: of the plant's noise, of the states at first."""


def carried_bytes(outputs: int, inputs: int, copies: int) -> int:
    """Return how many bytes of a message the numbers of a control loop take."""
    return 8 * (1 + copies * max(outputs, inputs))


class LiveLoop(NamedTuple):
    """A control loop that is to run live, and the states in which its copies begin."""

    loop: Loop
    first: Matrix  # [applied; x; controller] x copies
    seed: int

    @classmethod
    def described(cls, written: LoopFile, period_ns: int, seed: int) -> "LiveLoop":
        """Draw the first states from the steady state; every node of the loop draws the same.

        The steady state is that with the latency that the controller is designed for; of another
        controller, half the period. Where the loop is unstable with it, all begin at 0.

        Raises InputError: the loop is not right, or no controller stabilises the plant.
        PlatformError: SciPy is missing.
        """
        description = described_loop(Path("control_loop"), written)
        loop = description.loop(period_ns)
        latency_ns = period_ns / 2 if description.delay_ns is None else description.delay_ns
        covariance = covariance_of_constant(loop, latency_ns / 1e9)
        random = np.random.default_rng([seed, FIRST_STATES])
        drawn = random.standard_normal((len(covariance), written.copies))
        return cls(loop, root_of(covariance) @ drawn, seed)

    def plant(self, log: EventLog) -> "LivePlant":
        """Return the plant's copies."""
        return LivePlant(self, log)

    def controller(self) -> "LiveController":
        """Return the controller of all copies."""
        return LiveController(self)


class LivePlant:
    """The copies of a plant. It begins with its first sample; ``clock`` gives the instant (ns)."""

    def __init__(
        self, live: LiveLoop, log: EventLog, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        loop, first, seed = live
        problem = loop.problem
        self._flows, self._c, self._clock = Flows(problem), problem.plant.c, clock
        self._sample_root = root_of(problem.measurement_noise)
        self._inputs, self._copies = problem.plant.inputs, first.shape[1]
        self._state = first[: loop.slices(1)["plant"].stop].copy()  # [applied; x] of each copy
        self._random = np.random.default_rng([seed, PLANT])
        self._sampled, self._at_ns = 0, 0
        self._record = log.point("plant_step")
        self._flows.many(np.zeros(1))  # computes the table before the run

    def sample(self) -> bytes:
        """Sample the plant now; return the numbers for the message."""
        now_ns = self._clock()
        cost = self._move(now_ns) if self._sampled else 0.0
        noise = self._random.standard_normal((len(self._c), self._copies))
        with np.errstate(all="ignore"):  # of an unstable loop
            measured = self._c @ self._state[self._inputs :] + self._sample_root @ noise
        self._note(now_ns, "sampled", self._sampled, cost)
        numbers = np.concatenate([[float(self._sampled)], measured.T.ravel()])
        self._sampled += 1
        return numbers.tobytes()

    def drive(self, numbers: memoryview) -> None:
        """Let the plant's inputs be those of a message from now on."""
        now_ns = self._clock()
        read = np.frombuffer(numbers, np.float64, 1 + self._inputs * self._copies)
        cost = self._move(now_ns)
        self._state[: self._inputs] = read[1:].reshape(self._copies, self._inputs).T
        self._note(now_ns, "driven", int(read[0]), cost)

    def _move(self, now_ns: int) -> float:
        """Carry the state on until now; return what that time costs, averaged over copies."""
        left_s, cost = max(0, now_ns - self._at_ns) / 1e9, 0.0
        while left_s > 0:
            step_s = min(left_s, self._flows.longest_s)
            left_s -= step_s
            rows, noises, costs, noise_costs = self._flows.many(np.array([step_s]))
            drawn = self._random.standard_normal((len(rows[0]), self._copies))
            with np.errstate(all="ignore"):
                cost += float((self._state * (costs[0] @ self._state)).sum()) / self._copies
                cost += float(noise_costs[0])
                moved = rows[0] @ self._state + root_of(noises[0]) @ drawn
                self._state[self._inputs :] = moved
        return cost

    def _note(self, now_ns: int, step: str, sample: int, cost: float) -> None:
        self._at_ns = now_ns
        output = float((self._c @ self._state[self._inputs :, :1])[0, 0])
        reals = map(number_of_real, (cost, output, float(self._state[0, 0])))
        self._record(now_ns, number_of("step", step), sample, *reals)


class LiveController:
    """The controller of all copies of a plant."""

    def __init__(self, live: LiveLoop) -> None:
        loop, first, _ = live
        self._controller, self._outputs = loop.controller, loop.problem.plant.outputs
        self._copies = first.shape[1]
        self._state: NDArray[np.float64] = first[loop.slices(1)["controller"]].copy()

    def compute(self, numbers: memoryview) -> bytes:
        """Compute the inputs for a sample; take and return the numbers of messages."""
        read = np.frombuffer(numbers, np.float64, 1 + self._outputs * self._copies)
        measured = read[1:].reshape(self._copies, self._outputs).T
        c = self._controller
        with np.errstate(all="ignore"):  # of an unstable loop
            inputs = c.h @ self._state + c.k @ measured
            self._state = c.f @ self._state + c.g @ measured
        return np.concatenate([read[:1], inputs.T.ravel()]).tobytes()
