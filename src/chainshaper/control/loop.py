"""A control loop: a plant, its noise and cost, and a controller, as arrays.

    dx = (A·x + B·u)·dt + dw,   y = C·x + v,   J = E 1/T ∫ [x; u]ᵀ·Q·[x; u] dt

w is white noise of intensity W, v has the covariance V at each sample; u is constant until the next
output of the controller arrives. The controller computes, from each sample y,

    u = H·z + K·y,   z⁺ = F·z + G·y.

Times are in seconds here, as in all of control; other rooms have nanoseconds.
"""

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, extra_library

Matrix: TypeAlias = NDArray[np.float64]

EXTRA = "control"
PURPOSE = "the cost of a control loop"
MOST_STATES = 24  # of a plant, and of a controller
OUT_OF_PROPORTION = 1_000.0  # between a time constant of the plant and the period


def scipy_linalg() -> Any:
    """Import SciPy's linear algebra. Raises PlatformError: it is not installed."""
    return extra_library("scipy.linalg", PURPOSE, EXTRA)


def matrix(values: ArrayLike, name: str) -> Matrix:
    """Return a matrix of finite numbers. Raises InputError: it is none; the message names it."""
    try:
        array = np.atleast_2d(np.asarray(values, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is no matrix: write rows of equally many numbers") from error
    if array.ndim != 2 or not array.size or not np.isfinite(array).all():
        raise InputError(f"{name} is no matrix of finite numbers: correct it")
    return array


def covariance(values: ArrayLike, size: int, name: str) -> Matrix:
    """Return a symmetric, positive semidefinite matrix: a number is taken for the same times one.

    Raises InputError: it is none, or has another size.
    """
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0:
        array = np.eye(size) * array
    elif array.ndim == 1 and array.size == size:
        array = np.diag(array)
    array = matrix(array, name)
    if array.shape != (size, size):
        shape = " x ".join(map(str, array.shape))
        raise InputError(f"{name} is {shape}, and the plant needs {size} x {size}: correct it")
    scale = float(np.abs(array).max())
    if not np.allclose(array, array.T, atol=1e-9 * scale):
        raise InputError(f"{name} is not symmetric: write the same number on both sides")
    if np.linalg.eigvalsh(array).min() < -1e-9 * scale:
        raise InputError(f"{name} has a negative eigenvalue: noise and costs are 0 or more")
    symmetric: Matrix = (array + array.T) / 2
    return symmetric


def root_of(covariance: Matrix) -> Matrix:
    """Return a matrix whose product with its transpose is this covariance."""
    sizes, directions = np.linalg.eigh(covariance)
    root: Matrix = directions * np.sqrt(np.clip(sizes, 0.0, None))
    return root


@dataclass(frozen=True)
class Plant:
    """A continuous, linear, strictly proper plant; checked.

    Raises InputError: sizes do not match, or there is a direct way from input to output.
    """

    a: Matrix  # n x n
    b: Matrix  # n x inputs
    c: Matrix  # outputs x n

    def __post_init__(self) -> None:
        a, b, c = matrix(self.a, "A"), matrix(self.b, "B"), matrix(self.c, "C")
        n = len(a)
        if a.shape != (n, n):
            raise InputError(f"A is {n} x {a.shape[1]}: it needs as many columns as rows")
        if len(b) != n and b.shape == (1, n):
            b = b.T  # written as a list
        for name, has in (("B", f"{len(b)} rows"), ("C", f"{c.shape[1]} columns")):
            if int(has.split()[0]) != n:
                raise InputError(f"{name} has {has}, and A has {n} states: make them the same")
        if n > MOST_STATES:
            raise InputError(f"a plant of {n} states is too large, {MOST_STATES} at most")
        object.__setattr__(self, "a", a)
        object.__setattr__(self, "b", b)
        object.__setattr__(self, "c", c)

    @property
    def states(self) -> int:
        return len(self.a)

    @property
    def inputs(self) -> int:
        return int(self.b.shape[1])

    @property
    def outputs(self) -> int:
        return len(self.c)


def plant_of(system: Any) -> Plant:
    """Return the plant of an object of python-control, or of (A, B, C): a state space, or a
    transfer function of one input and output.

    Raises InputError: it is a discrete system, not strictly proper, or something else.
    """
    if isinstance(system, Plant):
        return system
    if isinstance(system, tuple) and len(system) == 3:
        return Plant(*map(np.asarray, system))
    if getattr(system, "dt", None) not in (None, 0):
        raise InputError("the plant is a discrete system: give the continuous one (dt = 0)")
    if hasattr(system, "num") and hasattr(system, "den"):
        numerator, denominator = system.num, system.den
        if len(numerator) != 1 or len(numerator[0]) != 1:
            raise InputError("a transfer function here has one input and output: use a state space")
        return plant_of_transfer_function(numerator[0][0], denominator[0][0])
    if all(hasattr(system, name) for name in "ABCD"):
        direct = np.asarray(system.D, dtype=np.float64)
        if direct.any():
            raise InputError(_NOT_STRICTLY_PROPER)
        return Plant(*(np.asarray(getattr(system, name)) for name in "ABC"))
    raise InputError(f"{type(system).__name__} is no plant: give a state space of python-control")


_NOT_STRICTLY_PROPER = (
    "the plant is not strictly proper: its output follows its input at once. Add the actuator's or"
    " the sensor's own dynamics, or leave out D"
)


def plant_of_transfer_function(numerator: ArrayLike, denominator: ArrayLike) -> Plant:
    """Return the controllable canonical form of a transfer function, highest power first.

    Raises InputError: its numerator's degree is not below the denominator's.
    """
    above = np.trim_zeros(np.asarray(numerator, dtype=np.float64).ravel(), "f")
    below = np.trim_zeros(np.asarray(denominator, dtype=np.float64).ravel(), "f")
    if not above.size or below.size < 2:
        raise InputError("the transfer function has no numerator, or no pole: write both")
    if above.size > below.size:
        reason = f"of degree {above.size - 1} over {below.size - 1}, is not proper"
        raise InputError(f"the transfer function, {reason}: correct its coefficients")
    if above.size == below.size:
        raise InputError(_NOT_STRICTLY_PROPER)
    n = below.size - 1
    a = np.zeros((n, n))
    a[0] = -below[1:] / below[0]
    a[1:, :-1] += np.eye(n - 1)
    b = np.zeros((n, 1))
    b[0] = 1.0
    c = np.zeros((1, n))
    c[0, n - above.size :] = above / below[0]
    return Plant(a, b, c)


@dataclass(frozen=True)
class Controller:
    """What is computed from each sample: ``u = H·z + K·y``, ``z⁺ = F·z + G·y``; z may be empty."""

    f: Matrix
    g: Matrix
    h: Matrix
    k: Matrix

    def __post_init__(self) -> None:
        states = len(self.f)
        shapes = [(states, states), (states, self.k.shape[1]), (len(self.k), states)]
        for name, values, shape in zip("FGH", (self.f, self.g, self.h), shapes, strict=True):
            if values.shape != shape:
                has, wanted = (" x ".join(map(str, sizes)) for sizes in (values.shape, shape))
                raise InputError(f"the controller's {name} is {has}, and should be {wanted}")

    @property
    def states(self) -> int:
        return len(self.f)


def static_controller(gains: ArrayLike) -> Controller:
    """Return the controller ``u = −gains·y``, which has no state."""
    k = -matrix(gains, "gains")
    outputs, inputs = k.shape[1], len(k)
    return Controller(np.zeros((0, 0)), np.zeros((0, outputs)), np.zeros((inputs, 0)), k)


@dataclass(frozen=True)
class Problem:
    """A plant with its noise, cost and period: all of a loop but its controller.

    ``process_noise`` is the intensity W (n x n), ``measurement_noise`` the covariance V of a
    sample, ``cost`` the matrix Q over [x; u].
    """

    plant: Plant
    process_noise: Matrix
    measurement_noise: Matrix
    cost: Matrix
    period_s: float

    def __post_init__(self) -> None:
        plant = self.plant
        if not self.period_s > 0:
            raise InputError("the loop needs a period longer than 0 s")
        for name, size in (
            ("process_noise", plant.states),
            ("measurement_noise", plant.outputs),
            ("cost", plant.states + plant.inputs),
        ):
            checked = covariance(getattr(self, name), size, name.replace("_", " "))
            object.__setattr__(self, name, checked)

    @property
    def doubts(self) -> tuple[str, ...]:
        """What looks like a wrong unit, a sentence each."""
        doubts = []
        period = duration_text(round(self.period_s * 1e9))
        poles = np.abs(np.linalg.eigvals(self.plant.a))
        moving = poles[poles > 1e-9 * max(1.0, float(poles.max()))]
        if moving.size:
            slow, fast = 1 / moving.min(), 1 / moving.max()
            if fast > OUT_OF_PROPORTION * self.period_s:
                reason = f"its fastest time constant is {fast:g} s beside a period of {period}"
                doubts.append(f"the plant hardly moves in a period: {reason}. Check the units")
            elif slow * OUT_OF_PROPORTION < self.period_s:
                reason = f"its slowest time constant is {slow:g} s beside a period of {period}"
                doubts.append(f"the plant settles within a period: {reason}. Check the units")
        if not self.process_noise.any() and not self.measurement_noise.any():
            doubts.append("there is no noise, so every stable loop costs 0: write some")
        if not self.cost.any():
            doubts.append("nothing costs anything, so every loop costs 0: write a cost")
        return tuple(doubts)


@dataclass(frozen=True)
class Loop:
    """A problem with its controller. Raises InputError: their sizes do not match."""

    problem: Problem
    controller: Controller

    def __post_init__(self) -> None:
        plant, gains = self.problem.plant, self.controller.k
        if gains.shape != (plant.inputs, plant.outputs):
            has = f"{gains.shape[1]} samples to {gains.shape[0]} inputs"
            wanted = f"{plant.outputs} outputs and {plant.inputs} inputs"
            raise InputError(f"the controller goes from {has}, and the plant has {wanted}")
        if self.controller.states > 2 * MOST_STATES:
            reason = f"a controller of {self.controller.states} states is too large"
            raise InputError(f"{reason}, {2 * MOST_STATES} at most")

    def slices(self, slots: int) -> dict[str, slice]:
        """Return where each part of the state is: applied, plant, controller, slot0, slot1, …."""
        plant, at, parts = self.problem.plant, 0, {}
        sizes = {"applied": plant.inputs, "plant": plant.states}
        sizes["controller"] = self.controller.states
        sizes |= {f"slot{number}": plant.inputs for number in range(slots)}
        for name, size in sizes.items():
            parts[name] = slice(at, at + size)
            at += size
        parts["all"] = slice(0, at)
        return parts
