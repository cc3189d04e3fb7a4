"""What is there in a test, although its type says that it may be missing."""

from typing import TypeVar

_T = TypeVar("_T")


def known(value: _T | None) -> _T:
    """The value; a test in which there is none fails."""
    assert value is not None
    return value
