"""Durations as people write them (``59ms``, ``250us``) and as we compute them (integer ns).

Files and the command line carry units, because a bare number in a timing file is how robots get
hurt.
"""

import re
from decimal import Decimal

from chainshaper.values.errors import InputError

NS_PER_UNIT = {"ns": 1, "us": 1_000, "µs": 1_000, "ms": 1_000_000, "s": 1_000_000_000}
_DURATION = re.compile(r"\s*([+-]?\d+(?:\.\d*)?|[+-]?\.\d+)\s*(ns|us|µs|ms|s)\s*")


def parse_duration(text: str) -> int:
    """Return the nanoseconds of a duration with a unit: ``ns``, ``us`` (``µs``), ``ms`` or ``s``.

    Exact: ``0.1ms`` is 100000, never 99999. A bare ``0`` needs no unit.

    Raises InputError: no unit, an unknown unit, not a number, or finer than a nanosecond.
    """
    if text.strip() == "0":
        return 0
    match = _DURATION.fullmatch(text)
    if match is None:
        remedy = "write a number and a unit (ns, us, ms, s), such as 250us"
        raise InputError(f"{text!r} is not a duration: {remedy}")
    nanoseconds = Decimal(match[1]) * NS_PER_UNIT[match[2]]
    if nanoseconds != int(nanoseconds):
        raise InputError(f"{text!r} is finer than a nanosecond, the resolution of every clock here")
    return int(nanoseconds)


def format_duration(nanoseconds: int) -> str:
    """Return the shortest exact text for files and options, for `parse_duration`: ``59ms``."""
    return duration_text(nanoseconds).replace(" ", "")


def duration_text(nanoseconds: int) -> str:
    """Return the shortest exact text for sentences: ``59 ms``."""
    for unit in ("s", "ms", "us"):
        if abs(nanoseconds) >= NS_PER_UNIT[unit]:
            value = Decimal(nanoseconds) / NS_PER_UNIT[unit]
            return f"{value.normalize():f} {unit}"
    return f"{nanoseconds} ns" if nanoseconds else "0 ms"


def milliseconds(nanoseconds: float, digits: int = 3) -> str:
    """Return milliseconds with a fixed number of digits, for tables that people compare by eye."""
    return f"{nanoseconds / 1e6:.{digits}f}"
