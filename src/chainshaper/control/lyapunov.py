"""The discrete Lyapunov equation: the covariance at which a stable loop settles."""

import numpy as np

from chainshaper.control.loop import Matrix

MOST_DOUBLINGS = 60  # of the horizon: more than any spectral radius below 1 − 1e-9 needs
SETTLED = 1e-16  # what a doubling adds, relative to the sum


def solve_lyapunov(transition: Matrix, noise: Matrix) -> Matrix:
    """Return P = M·P·Mᵀ + N for a transition M (n x n) of spectral radius below 1, and N (n x n).

    It is the sum of Mᵏ·N·Mᵏᵀ over all k, of twice as many terms in each step (R. A. Smith, SIAM
    Journal on Applied Mathematics 16(1), 1968). Of positive semidefinite N all terms are so:
    nothing cancels, whatever units the states have, where SciPy's direct solution warns of an
    ill-conditioned matrix.
    """
    total, power = noise, transition
    for _ in range(MOST_DOUBLINGS):
        added = power @ total @ power.T
        total = total + added
        if np.abs(added).max() <= SETTLED * np.abs(total).max():
            break
        power = power @ power
    symmetric: Matrix = (total + total.T) / 2
    return symmetric
