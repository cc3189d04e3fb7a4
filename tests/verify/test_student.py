"""Student's t distribution beside the same of SciPy, and what is known of it by hand."""

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy import stats

from chainshaper.verify.student import t_quantile, t_tail


@given(t=st.floats(-1e6, 1e6), freedom=st.integers(1, 2000))
@example(t=1.7886540034185682e-09, freedom=2)
def test_the_tail_is_that_of_scipy(t: float, freedom: int) -> None:
    assert t_tail(t, freedom) == pytest.approx(stats.t.sf(t, freedom), rel=1e-9, abs=1e-290)


@given(probability=st.floats(1e-12, 0.5), freedom=st.integers(2, 2000))
def test_the_quantile_is_that_of_scipy(probability: float, freedom: int) -> None:
    known = stats.t.isf(probability, freedom)
    assert t_quantile(probability, freedom) == pytest.approx(known, rel=1e-7, abs=1e-7)


def test_known_values() -> None:
    assert t_tail(0, 7) == pytest.approx(0.5, rel=1e-15)
    # One degree of freedom is Cauchy's distribution, two have a square root.
    assert t_tail(3.0, 1) == pytest.approx(0.5 - math.atan(3.0) / math.pi, rel=1e-13)
    assert t_tail(3.0, 2) == pytest.approx(0.5 - 3.0 / (2 * math.sqrt(11)), rel=1e-13)
    assert t_quantile(0.5, 5) == pytest.approx(0, abs=1e-15)
    assert t_quantile(0.025, 10) == pytest.approx(2.2281388519862753, rel=1e-12)
