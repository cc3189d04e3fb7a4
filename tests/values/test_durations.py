"""Durations: exact in, exact out, and nothing without a unit."""

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from chainshaper.values.durations import NS_PER_UNIT, format_duration, milliseconds, parse_duration
from chainshaper.values.errors import InputError

WRITTEN = {
    "0": 0, "0ms": 0, "59ms": 59_000_000, "250us": 250_000, "250µs": 250_000, "0.1ms": 100_000,
    "0.3s": 300_000_000, ".5us": 500, "5.ms": 5_000_000, "+7ns": 7, "-2ms": -2_000_000,
    "  1.5  ms  ": 1_500_000, "0.000000001s": 1,
}  # fmt: skip
NONE = [
    "", " ", "5", "0.0", "ms", "5 m", "5min", "5MS", "5Ms", "5,0ms", "1e3ms", "0x10ms", "five ms",
    "5ms 3us", "--5ms", "nan ms", "infs", "5ms\n6ms", "5\u03bcs",  # the last: a Greek letter
]  # fmt: skip


@given(st.integers(-(2**70), 2**70))
def test_what_is_written_is_read_back_unchanged(nanoseconds: int) -> None:
    assert parse_duration(format_duration(nanoseconds)) == nanoseconds


@given(st.decimals(0, 10**6, allow_nan=False, places=3), st.sampled_from(["us", "µs", "ms", "s"]))
def test_decimals_are_exact(number: object, unit: str) -> None:
    exact = Fraction(str(number)) * NS_PER_UNIT[unit]
    assert parse_duration(f"{number}{unit}") == exact


def test_texts_that_people_write() -> None:
    assert {text: parse_duration(text) for text in WRITTEN} == WRITTEN


@pytest.mark.parametrize("text", NONE)
def test_what_is_no_duration_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(InputError, match="is not a duration: write a number and a unit") as refused:
        parse_duration(text)
    assert repr(text) in str(refused.value)


@pytest.mark.parametrize("text", ["0.5ns", "0.0001us", "1.0000000001s"])
def test_finer_than_a_nanosecond_is_refused_and_not_rounded(text: str) -> None:
    with pytest.raises(InputError, match="finer than a nanosecond"):
        parse_duration(text)


def test_the_shortest_text_is_written() -> None:
    texts = {
        0: "0ms", 1: "1ns", 1_500: "1.5us", 100_000_000: "100ms", 60_000_000_000: "60s",
        -1_500_000: "-1.5ms",
    }  # fmt: skip
    assert {number: format_duration(number) for number in texts} == texts
    assert (milliseconds(64_213_000), milliseconds(100_000_000, 0)) == ("64.213", "100")
