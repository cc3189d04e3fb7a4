"""Student's t distribution: how probable is a deviation, measured in its own standard errors?

SciPy has it, but takes 125 MB of a robot's disk, and a robot needs no more of it than this.
"""

from math import exp, lgamma, log

_SMALLEST = 1e-300  # in place of a zero in a denominator (Lentz's method)
_MOST_TERMS = 500


def t_tail(t: float, freedom: float) -> float:
    """The probability of a value above ``t``, with ``freedom`` degrees of freedom."""
    square = freedom + t * t
    beyond = _incomplete_beta(freedom / 2, 0.5, freedom / square, t * t / square) / 2
    return beyond if t >= 0 else 1 - beyond


def t_quantile(probability: float, freedom: float) -> float:
    """The value that is exceeded with a ``probability`` of 1/2 or less; inverts :func:`t_tail`."""
    low, high = 0.0, 1.0
    while t_tail(high, freedom) > probability:
        low, high = high, 2 * high
    while low < (middle := (low + high) / 2) < high:  # until they are neighbours
        if t_tail(middle, freedom) > probability:
            low = middle
        else:
            high = middle
    return middle


def _incomplete_beta(a: float, b: float, x: float, rest: float) -> float:
    """The regularised incomplete beta function (Abramowitz and Stegun, 26.5.8).

    ``rest`` is 1 − x, with the digits that a subtraction from 1 has lost.
    """
    if 0 in (x, rest):
        return x
    if x > (a + 1) / (a + b + 2):  # where the fraction converges slowly
        return 1 - _incomplete_beta(b, a, rest, x)
    logarithm = a * log(x) + b * log(rest) + lgamma(a + b) - lgamma(a) - lgamma(b)
    return exp(logarithm) / (a * _continued_fraction(a, b, x))


def _continued_fraction(a: float, b: float, x: float) -> float:
    """1 + d1/(1 + d2/(1 + …)), from the front, by Lentz's method."""
    value, numerator, denominator = 1.0, 1.0, 0.0
    for term in range(1, _MOST_TERMS):
        m = term // 2
        if term % 2:
            d = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        else:
            d = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        denominator = 1 / ((1 + d * denominator) or _SMALLEST)
        numerator = (1 + d / numerator) or _SMALLEST
        value *= numerator * denominator
        if abs(numerator * denominator - 1) < 1e-16:
            break
    return value
