"""Which names a person may have meant: for messages about names that do not exist.

Names of topics and nodes are paths. People leave out a namespace, or remember a part of the last
component; `difflib` alone compares whole texts and ranks ``/points_fused`` before
``/lidar_rear/points_raw`` for ``/points_raw``. So the last components are compared as well, and
a name that contains the other counts as close.
"""

from collections.abc import Iterable
from difflib import SequenceMatcher

__all__ = ["close_names"]

MOST = 3
CLOSE = 0.6
"""Likeness (0 to 1) from which a name is worth mentioning."""

WORSE = 0.15
"""How much less alike than the best one a name may be."""


def close_names(name: str, names: Iterable[str]) -> list[str]:
    """Up to three of ``names`` that are like ``name``, the likeliest first."""
    scores = {other: _likeness(name, other) for other in names}
    best = max(scores.values(), default=0.0)
    close = [n for n, score in scores.items() if score >= max(CLOSE, best - WORSE)]
    return sorted(close, key=lambda other: (-scores[other], other))[:MOST]


def _likeness(first: str, second: str) -> float:
    a, b = (text.lower().strip("/") for text in (first, second))
    whole = SequenceMatcher(None, a, b, autojunk=False).ratio()
    last_a, last_b = a.rpartition("/")[2], b.rpartition("/")[2]
    last = 0.95 * SequenceMatcher(None, last_a, last_b, autojunk=False).ratio()
    contains = 0.9 if min(len(a), len(b)) > 2 and (a in b or b in a) else 0.0
    return max(whole, last, contains)
