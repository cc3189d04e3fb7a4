"""Reading and checking a sample of measured end-to-end latencies.

Planning takes a sample as an array of int64 nanoseconds, in the order of time.
"""

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chainshaper.values.durations import duration_text, parse_duration
from chainshaper.values.errors import InputError

LONGEST_NS = 24 * 3_600 * 1_000_000_000  # beyond a day it is a wrong unit, not a latency


def read_latencies(path: str | Path) -> NDArray[np.int64]:
    """Read end-to-end latencies (ns) from a file, in the file's order.

    A text file has one duration with its unit on each line (``59.3ms``; ``#`` begins a comment). A
    ``.npy`` file has nanoseconds.

    Raises InputError: no such file, or nothing that can be planned with; a wrong line is named by
    its number.
    """
    path = Path(path)
    is_array = path.suffix == ".npy"
    try:
        latencies = check_latencies(_array(path) if is_array else _lines(path))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, EOFError) as error:
        content = "a text of one duration a line"
        if is_array:
            content = "whole nanoseconds in one row, by numpy.save"
        raise InputError(f"{path}: cannot be read ({error}): write {content}") from error
    except InputError as error:
        # An error about a line names the file already; one about the whole sample does not.
        is_named = str(error).startswith(str(path))
        raise InputError(str(error) if is_named else f"{path}: {error}") from error
    if not latencies.any():
        raise InputError(f"{path}: every latency is 0 ms: check the unit, and what was measured")
    return latencies


def _array(path: Path) -> object:
    """Read what `numpy.save` wrote. Raises OSError; ValueError: the file is damaged or no array."""
    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about headers that Python 2 wrote
            return np.lib.format.read_array(file, allow_pickle=False)
    except (OSError, ValueError):
        raise
    # The header of the file is Python text, so a damaged one may raise all that Python can.
    except Exception as error:
        raise ValueError(f"its header is damaged: {error or type(error).__name__}") from error


def _lines(path: Path) -> NDArray[np.int64]:
    latencies = []
    # Spreadsheets begin a file with a byte-order mark.
    for number, line in enumerate(path.read_text(encoding="utf-8-sig").splitlines(), start=1):
        content = line.partition("#")[0].strip()
        if not content:
            continue
        try:
            latency_ns = parse_duration(content)
        except InputError as error:
            raise InputError(f"{path}:{number}: {error}") from error
        if not 0 <= latency_ns <= LONGEST_NS:
            reason = f"{content} is no latency: write 0 ms or more, up to a day"
            raise InputError(f"{path}:{number}: {reason}")
        latencies.append(latency_ns)
    return np.array(latencies, dtype=np.int64)


def check_latencies(latencies: object) -> NDArray[np.int64]:
    """Return a sample that can be planned with, as int64 (ns).

    It has at least two latencies, whole nanoseconds, none negative, none longer than a day.

    Raises InputError: it has not; the first wrong element is named by its place from 0.
    """
    array = np.asarray(latencies)
    if array.ndim != 1 or array.dtype.kind not in "iuf":
        kind = f"{array.ndim}-dimensional {array.dtype}"
        raise InputError(f"latencies must be one row of numbers in nanoseconds, not {kind}")
    if array.size < 2:
        raise InputError(f"{array.size} latencies are too few to plan with: measure 100 at least")
    for is_wrong, reason in (
        (~np.isfinite(array), "is not a number: remove it"),
        (array != np.floor(array), "is not a whole number of nanoseconds: convert it"),
        (array < 0, "is negative: a latency is not; check the clocks"),
        (array > LONGEST_NS, f"is longer than {duration_text(LONGEST_NS)}: check the unit"),
    ):
        if is_wrong.any():
            place = int(np.argmax(is_wrong))
            raise InputError(f"latency number {place} ({array[place]}) {reason}")
    return array.astype(np.int64)
