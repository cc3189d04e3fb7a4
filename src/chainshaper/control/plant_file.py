"""The file that describes a control loop: plant, noise, cost, period, controller, modes.

    format: 1
    plant: {transfer_function: {numerator: [1], denominator: [1, 0, -1]}}
    # or:  {state_space: {A: [[0, 1], [1, 0]], B: [[0], [1]], C: [[1, 0]]}}
    noise: {process: 1, measurement: 0.01}
    cost: {output: 1, input: 0.01}
    period: 100ms
    controller: {design: lqg, delay: 20ms}
    # or: {gains: [[3.6, 2.7]]}, or {state_space: {F: …, G: …, H: …, K: …}}
    modes: {city: 30ms, highway: 60ms}

Times of the plant are in seconds. ``process`` is the intensity of white noise that enters with the
input; ``process_state`` that of noise on the states. ``output``, ``state`` and ``input`` are what
the squares of these cost per second; a number, a list for a diagonal, or a matrix. ``measurement``
is the variance of each sample. ``gains`` are those of u = −gains·y. ``modes`` are latencies; each
mode has a controller for its own.

The description of an application may contain one, under `control_loop`: then live runs have such a
plant, or as many ``copies`` of it, each with noise of its own, that the same messages control.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from pydantic import ConfigDict, Field, model_validator

from chainshaper.control.design import design_controller
from chainshaper.control.loop import (
    Controller,
    Loop,
    Matrix,
    Plant,
    Problem,
    covariance,
    matrix,
    plant_of_transfer_function,
    static_controller,
)
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError
from chainshaper.values.yaml_file import Duration, Part, PositiveDuration, read_model

Number: TypeAlias = float | int
Row: TypeAlias = tuple[Number, ...]
Rows: TypeAlias = tuple[Row, ...]
Weights: TypeAlias = Number | Row | Rows

MADE_BY = "the description of a control loop (docs/control.md)"
MOST_COEFFICIENTS = 25
MOST_COPIES = 1_000


class _Matrices(Part):
    model_config = ConfigDict(
        **{**Part.model_config, "alias_generator": str.upper, "strict": False}
    )


class StateSpacePart(_Matrices):
    """dx/dt = A·x + B·u, y = C·x; without C, all states are measured."""

    a: Rows
    b: Rows
    c: Rows | None = None
    d: Rows | None = None


class TransferFunctionPart(Part):
    """Coefficients, the highest power of s first."""

    model_config = ConfigDict(**{**Part.model_config, "strict": False})

    numerator: Row = Field(min_length=1, max_length=MOST_COEFFICIENTS)
    denominator: Row = Field(min_length=2, max_length=MOST_COEFFICIENTS)


class PlantPart(Part):
    state_space: StateSpacePart | None = None
    transfer_function: TransferFunctionPart | None = None

    @model_validator(mode="after")
    def _one(self) -> "PlantPart":
        if (self.state_space is None) == (self.transfer_function is None):
            raise ValueError("write either state_space or transfer_function")
        return self


class NoisePart(Part):
    model_config = ConfigDict(**{**Part.model_config, "strict": False})

    process: Weights | None = None
    process_state: Weights | None = None
    measurement: Weights = 0.0


class CostPart(Part):
    model_config = ConfigDict(**{**Part.model_config, "strict": False})

    output: Weights | None = None
    state: Weights | None = None
    input: Weights | None = None


class ControllerMatrices(_Matrices):
    """u = H·z + K·y, then z = F·z + G·y."""

    f: Rows = ()
    g: Rows = ()
    h: Rows = ()
    k: Rows


class ControllerPart(Part):
    model_config = ConfigDict(**{**Part.model_config, "strict": False})

    design: Literal["lqg"] | None = None
    delay_ns: Duration | None = None
    gains: Rows | None = None
    state_space: ControllerMatrices | None = None

    @model_validator(mode="after")
    def _one(self) -> "ControllerPart":
        given = [self.design, self.gains, self.state_space]
        if sum(value is not None for value in given) != 1:
            raise ValueError("write one of design: lqg, gains and state_space")
        if (self.design is None) != (self.delay_ns is None):
            raise ValueError("design: lqg goes with the delay it is for, such as delay: 20ms")
        return self


class LoopFile(Part):
    """What the file says, as it is written."""

    format: Literal[1] = 1
    plant: PlantPart
    noise: NoisePart
    cost: CostPart
    period_ns: PositiveDuration | None = None
    controller: ControllerPart
    modes: dict[str, Duration] = Field(default_factory=dict)
    copies: int = Field(default=1, ge=1, le=MOST_COPIES)


@dataclass(frozen=True)
class LoopDescription:
    """A loop that is described: everything but a period, where the file has none."""

    path: Path
    plant: Plant
    process_noise: Matrix
    measurement_noise: Matrix
    cost: Matrix
    period_ns: int | None
    controller: Controller | None  # None: designed, for `delay_ns`
    delay_ns: int | None
    modes_ns: dict[str, int]

    @property
    def is_designed(self) -> bool:
        return self.controller is None

    def problem(self, period_ns: int | None = None) -> Problem:
        """Return the problem at the chain's period.

        Raises InputError: there is no period, or the file has another one.
        """
        if self.period_ns is not None and period_ns is not None:
            apart = abs(self.period_ns - period_ns)
            if apart > 0.02 * self.period_ns:
                has, wanted = duration_text(period_ns), duration_text(self.period_ns)
                reason = f"the chain's period is {has}, and {self.path} is for {wanted}"
                raise InputError(f"{reason}: correct the file's, or leave it out")
        period = self.period_ns or period_ns
        if period is None:
            raise InputError(f"{self.path} has no period: add one, such as period: 100ms")
        return Problem(
            self.plant, self.process_noise, self.measurement_noise, self.cost, period / 1e9
        )

    def loop(self, period_ns: int | None = None) -> Loop:
        """Return the loop with its controller, given or designed. Raises: as :meth:`problem`."""
        problem = self.problem(period_ns)
        return Loop(
            problem, self.controller or design_controller(problem, (self.delay_ns or 0) / 1e9)
        )

    def redesigned(self, delay_ns: float, period_ns: int | None = None) -> Loop:
        """Return the loop with the LQG controller for another constant delay."""
        problem = self.problem(period_ns)
        return Loop(problem, design_controller(problem, delay_ns / 1e9))

    def with_period(self, period_ns: int) -> "LoopDescription":
        """Return the same loop at another period."""
        return replace(self, period_ns=period_ns)


def load_loop(path: str | Path) -> LoopDescription:
    """Read the description of a control loop, or of an application that has one.

    Raises InputError: as :func:`.read_model`, or sizes do not match, the plant is not strictly
    proper, or noise or cost is negative.
    """
    written = read_model(path, LoopFile, made_by=MADE_BY, under="control_loop")
    try:
        return described_loop(Path(path), written)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def described_loop(path: Path, written: LoopFile) -> LoopDescription:
    """Return the loop that is written in a file, which messages call ``path``.

    Raises InputError: sizes do not match, the plant is not strictly proper, or noise or cost is
    negative.
    """
    plant = _plant(written.plant)
    n, m, outputs = plant.states, plant.inputs, plant.outputs
    noise = np.zeros((n, n))
    if written.noise.process is not None:
        intensity = covariance(written.noise.process, m, "noise.process")
        noise += plant.b @ intensity @ plant.b.T
    if written.noise.process_state is not None:
        noise += covariance(written.noise.process_state, n, "noise.process_state")
    cost = np.zeros((n + m, n + m))
    if written.cost.output is not None:
        cost[:n, :n] += (
            plant.c.T @ covariance(written.cost.output, outputs, "cost.output") @ plant.c
        )
    if written.cost.state is not None:
        cost[:n, :n] += covariance(written.cost.state, n, "cost.state")
    if written.cost.input is not None:
        cost[n:, n:] += covariance(written.cost.input, m, "cost.input")
    measurement = covariance(written.noise.measurement, outputs, "noise.measurement")
    controller = _controller(written.controller)
    if controller is not None:
        period_s = (written.period_ns or 1) / 1e9
        Loop(Problem(plant, noise, measurement, cost, period_s), controller)  # sizes match
    return LoopDescription(
        path=path,
        plant=plant,
        process_noise=noise,
        measurement_noise=measurement,
        cost=cost,
        period_ns=written.period_ns,
        controller=controller,
        delay_ns=written.controller.delay_ns,
        modes_ns=dict(written.modes),
    )


def _plant(written: PlantPart) -> Plant:
    if written.transfer_function is not None:
        function = written.transfer_function
        return plant_of_transfer_function(function.numerator, function.denominator)
    space: Any = written.state_space
    a = matrix(space.a, "A")
    c = np.eye(len(a)) if space.c is None else matrix(space.c, "C")
    if space.d is not None and np.any(matrix(space.d, "D")):
        raise InputError(
            "the plant is not strictly proper, since D is not 0: its output follows its input at"
            " once. Add the actuator's or the sensor's own dynamics, and leave out D"
        )
    return Plant(a, matrix(space.b, "B"), c)


def _controller(written: ControllerPart) -> Controller | None:
    if written.design is not None:
        return None
    if written.gains is not None:
        return static_controller(written.gains)
    space: Any = written.state_space
    k = matrix(space.k, "K")
    if not space.f:
        return Controller(np.zeros((0, 0)), np.zeros((0, k.shape[1])), np.zeros((len(k), 0)), k)
    f, g, h = (matrix(getattr(space, name), name.upper()) for name in "fgh")
    return Controller(f, g, h, k)
