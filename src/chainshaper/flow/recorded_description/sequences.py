"""Sequences of times in a description: how long they are, and how they are written."""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from chainshaper.values.durations import format_duration

Numbers = npt.NDArray[np.int64]

_NEARLY = 0.9  # of the cycles, so that the others are missing at the recording's end


def sequences_in(values: Any) -> Iterator[Numbers]:
    """Yield all sequences of a description, at whatever depth."""
    if isinstance(values, np.ndarray):
        yield values
    elif isinstance(values, dict | list):
        for part in values.values() if isinstance(values, dict) else values:
            yield from sequences_in(part)


def in_whole_cycles(values: Any, cycles: int) -> Any:
    """Return the description with sequences as long as so many cycles, where they nearly are.

    Those that are shorter by little, since the recording ended, get usual values at their ends:
    they all begin again together.
    """
    if isinstance(values, dict):
        return {key: in_whole_cycles(part, cycles) for key, part in values.items()}
    if isinstance(values, list):
        return [in_whole_cycles(part, cycles) for part in values]
    if not isinstance(values, np.ndarray) or not cycles:
        return values
    whole = max(1, round(len(values) / cycles)) * cycles
    if not _NEARLY * whole <= len(values) < whole:
        return values
    usual = int(np.median(values))
    return np.concatenate([values, np.full(whole - len(values), usual, np.int64)])


def written_places(values: Any, most: int) -> tuple[dict[int, Numbers], float]:
    """Choose which places of sequences are written, so that these have ``most`` values at most.

    Returns the places by the length of sequences, and the share of values that is written. Without
    places all values are written. Else the places are spread evenly, and those with the longest and
    the shortest times are among them.
    """
    lengths = Counter(
        len(sequence) for sequence in sequences_in(values) if sequence.min() < sequence.max()
    )
    total = sum(length * number for length, number in lengths.items())
    if total <= most:
        return {}, 1.0
    chosen = {}
    for length in lengths:
        spread = np.linspace(0, length - 1, max(2, length * most // total))
        places = {*np.rint(spread).astype(int).tolist()}
        for sequence in sequences_in(values):
            if len(sequence) == length:
                places |= {int(sequence.argmax()), int(sequence.argmin())}
        chosen[length] = np.array(sorted(places), np.int64)
    return chosen, most / total


def written_out(values: Any, places_of: Mapping[int, Numbers]) -> Any:
    """Return the description with its sequences as durations (:func:`written_places`)."""
    if isinstance(values, np.ndarray):
        if values.min() == values.max():
            return {"constant": format_duration(int(values[0]))}
        places = places_of.get(len(values))
        written = values if places is None else values[places]
        return {"sequence": [format_duration(int(value)) for value in written]}
    if isinstance(values, dict):
        return {key: written_out(part, places_of) for key, part in values.items()}
    if isinstance(values, list):
        return [written_out(part, places_of) for part in values]
    return values
