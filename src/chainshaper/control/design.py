"""The controller that is best for a constant delay: linear-quadratic-Gaussian (LQG).

With a delay of τ = (d − 1)·h + τ′, 0 ≤ τ′ ≤ h, the input of d periods ago is applied until τ′ into
a period, and that of d − 1 periods ago behind it. The controller knows what it has computed: its
state is the predicted state of the plant and the last d outputs. Of a constant delay this is the
optimum (Åström and Wittenmark, Computer-Controlled Systems, chapter 11), as of a delay that is not
constant it is the usual compromise.
"""

import math

import numpy as np

from chainshaper.control.flows import Flows
from chainshaper.control.loop import Controller, Matrix, Problem, scipy_linalg
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError

MOST_PERIODS = 20  # of delay that a controller can be designed for


def periods_of_delay(problem: Problem, delay_s: float) -> int:
    """Return d, how many of its own outputs a controller for this delay has to remember."""
    return max(1, math.ceil(delay_s / problem.period_s - 1e-12))


def design_controller(
    problem: Problem, delay_s: float, remembered: int | None = None
) -> Controller:
    """Return the LQG controller for a constant delay.

    ``remembered`` is d, if it is to be more than the delay needs: controllers of equally many have
    states of one meaning, and can take over from each other.

    Raises InputError: the delay is negative or too long, or no controller stabilises the plant.
    """
    period = problem.period_s
    if not 0 <= delay_s <= MOST_PERIODS * period:
        longest = duration_text(round(MOST_PERIODS * period * 1e9))
        given = duration_text(round(delay_s * 1e9))
        raise InputError(f"no controller is designed for a delay of {given}: 0 ms to {longest}")
    needed = periods_of_delay(problem, delay_s)
    d = max(needed, remembered or 0)
    flows, plant = Flows(problem), problem.plant
    n, m = plant.states, plant.inputs
    into = delay_s - (needed - 1) * period
    before, behind = flows.over(into), flows.over(period - into)
    whole = flows.over(period)
    # Over [x; u of d periods ago; …; u of one period ago; u now]:
    size = n + m * (d + 1)

    def past(periods: int) -> slice:
        return slice(n + m * (d - periods), n + m * (d - periods + 1))

    first = np.zeros((m + n, size))  # [applied; x] at the start of the period
    first[:m, past(needed)] = np.eye(m)
    first[m:, :n] = np.eye(n)
    second = np.zeros((m + n, size))  # and when the delay is over
    second[:m, past(needed - 1)] = np.eye(m)
    second[m:] = before.rows @ first
    cost = first.T @ before.cost @ first + second.T @ behind.cost @ second
    moved = np.zeros((size - m, size))
    moved[:n] = behind.rows @ second
    moved[n:, n + m :] = np.eye(m * d)  # each output is a period older
    if needed < d:  # outputs that are too old to be of use cost nothing and change nothing
        cost[n : past(needed).start] = cost[:, n : past(needed).start] = 0.0
    a, b = moved[:, : size - m], moved[:, size - m :]
    q, r, cross = cost[:-m, :-m], cost[-m:, -m:], cost[:-m, -m:]
    riccati = _riccati(a, b, q, r, cross, failing="no controller stabilises the plant")
    gain = _solved(r + b.T @ riccati @ b, cross.T + b.T @ riccati @ a)
    closed = np.abs(np.linalg.eigvals(a - b @ gain)).max()
    if not closed < 1 + 1e-9:
        raise InputError(_no_controller("its input does not reach what is unstable"))
    transition = whole.rows[:, m:]
    predicted = _riccati(
        transition.T,
        plant.c.T,
        whole.noise,
        problem.measurement_noise,
        np.zeros((n, plant.outputs)),
        failing="no observer sees all of the plant",
    )
    seen = plant.c @ predicted @ plant.c.T + problem.measurement_noise
    kalman = np.linalg.lstsq(seen.T, (predicted @ plant.c.T).T, rcond=None)[0].T
    error = np.abs(np.linalg.eigvals(transition - transition @ kalman @ plant.c)).max()
    if not error < 1 + 1e-9:
        raise InputError(_no_controller("its output does not show what is unstable"))
    # z = [predicted x; outputs of d … 1 periods ago]. From the sample: x̂ = x + kalman·(y − C·x).
    from_state = np.zeros((n + m * d, n + m * d))
    from_state[:n, :n] = np.eye(n) - kalman @ plant.c
    from_state[n:, n:] = np.eye(m * d)
    from_sample = np.vstack([kalman, np.zeros((m * d, plant.outputs))])
    h, k = -gain @ from_state, -gain @ from_sample
    f = a @ from_state + b @ h
    g = a @ from_sample + b @ k
    return Controller(f, g, h, k)


def _no_controller(reason: str) -> str:
    remedy = "check A, B and C, or give a controller"
    return f"no stabilising controller is found, since {reason}: {remedy}"


def _solved(left: Matrix, right: Matrix) -> Matrix:
    solution: Matrix = np.linalg.lstsq(left, right, rcond=None)[0].astype(np.float64)
    return solution


def _riccati(a: Matrix, b: Matrix, q: Matrix, r: Matrix, cross: Matrix, *, failing: str) -> Matrix:
    """Return the stabilising solution of the discrete Riccati equation.

    Where R is singular, as behind a delay, or SciPy finds none, it is the limit of the horizon that
    grows by one period at a time.
    """
    linalg = scipy_linalg()
    scale = float(np.abs(r).max())
    if scale > 0 and np.linalg.eigvalsh(r).min() > 1e-10 * scale:
        try:
            solution: Matrix = linalg.solve_discrete_are(a, b, q, r, s=cross)
            if np.isfinite(solution).all():
                symmetric: Matrix = (solution + solution.T) / 2
                return symmetric
        except (np.linalg.LinAlgError, ValueError):
            pass
    # From the horizon of one step with a cost at its end that makes R + Bᵀ·X·B regular.
    current: Matrix = np.eye(len(a)) * max(float(np.abs(q).max()), 1e-12)
    for _ in range(200_000 // max(1, len(a))):
        weight = r + b.T @ current @ b
        gain = _solved(weight, cross.T + b.T @ current @ a)
        following = q + a.T @ current @ a - (cross + a.T @ current @ b) @ gain
        following = (following + following.T) / 2
        moved = float(np.abs(following - current).max())
        size = float(np.abs(following).max())
        current = following
        if not np.isfinite(size) or size > 1e200:
            break
        if moved <= 1e-12 * max(size, 1e-300):
            return current
    raise InputError(f"{failing}: check A, B and C, and that noise and cost reach all of it")
