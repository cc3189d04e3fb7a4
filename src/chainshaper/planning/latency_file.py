"""Measured latencies as they come from outside: a text file, a NumPy file, an array.

Planning needs nothing else of a chain than its end-to-end latencies, so that a sample from any
tool can be planned with: one duration a line with its unit (``59.3ms``; blank lines and lines
that begin with ``#`` are skipped), or a ``.npy`` file of nanoseconds.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chainshaper.values.durations import format_duration, parse_duration
from chainshaper.values.errors import InputError

__all__ = ["check_latencies", "read_latencies"]

LONGEST_NS = 24 * 3_600 * 1_000_000_000  # beyond a day it is a wrong unit, not a latency


def read_latencies(path: str | Path) -> NDArray[np.int64]:
    """End-to-end latencies of a file, in nanoseconds, in the file's order.

    Raises:
        InputError: no such file, a line that is no duration (named with its number), an array
            that does not hold whole nanoseconds, fewer than two latencies, or none above zero.
    """
    path = Path(path)
    try:
        found = _read_array(path) if path.suffix == ".npy" else _read_lines(path)
        latencies = check_latencies(found)
        if not latencies.any():
            raise InputError("every latency is 0ms: check the unit, and what was measured")
        return latencies
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except InputError as error:
        # Lines are named already; what concerns the whole sample gets the file's name here.
        raise InputError(
            str(error) if str(error).startswith(str(path)) else f"{path}: {error}"
        ) from error


def check_latencies(latencies: object) -> NDArray[np.int64]:
    """A sample that can be planned with: at least two latencies, whole nanoseconds, none negative.

    Floating-point numbers are taken when each is a whole number of nanoseconds.

    Raises:
        InputError: anything else, with the first wrong element named by its place from 0.
    """
    array = np.asarray(latencies)
    if array.ndim != 1 or array.dtype.kind not in "iuf":
        raise InputError(
            f"latencies must be one row of numbers in nanoseconds, not {array.ndim}-dimensional"
            f" {array.dtype}"
        )
    if array.size < 2:
        raise InputError(
            f"{array.size} latencies are too few to plan with: measure more cycles (100 at least)"
        )
    if array.dtype.kind == "f":
        _refuse_first(array, ~np.isfinite(array), "is not a number: remove it")
        _refuse_first(
            array, array != np.floor(array), "is not a whole number of nanoseconds: convert it"
        )
    _refuse_first(array, array < 0, "is negative: a latency is not; check the clocks")
    _refuse_first(
        array, array > LONGEST_NS, f"is longer than {format_duration(LONGEST_NS)}: check the unit"
    )
    return array.astype(np.int64)


def _refuse_first(array: NDArray[np.generic], wrong: NDArray[np.bool_], reason: str) -> None:
    if wrong.any():
        place = int(np.argmax(wrong))
        raise InputError(f"latency number {place} ({array[place]}) {reason}")


def _read_array(path: Path) -> object:
    try:
        return np.load(path, allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise InputError(
            f"{path}: not a NumPy file of numbers: write it with numpy.save, whole nanoseconds in"
            " one row"
        ) from error


def _read_lines(path: Path) -> NDArray[np.int64]:
    try:
        text = path.read_text(encoding="utf-8-sig")  # spreadsheets begin with a byte-order mark
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: not a text of one duration a line ({error}); arrays end in .npy"
        ) from error
    found = []
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.partition("#")[0].strip()
        if not content:
            continue
        try:
            found.append(parse_duration(content))
        except InputError as error:
            raise InputError(f"{path}:{number}: {error}") from error
        if not 0 <= found[-1] <= LONGEST_NS:
            raise InputError(
                f"{path}:{number}: {content} is no latency: write 0ms or more, up to a day"
            )
    return np.array(found, dtype=np.int64)
