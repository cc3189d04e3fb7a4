"""Names that resemble what a user wrote, for "did you mean …?"."""

from collections.abc import Iterable
from difflib import SequenceMatcher

CLOSE = 0.6  # likeness (0 to 1) from which a name is worth mentioning
WORSE = 0.15  # how much less alike than the best one a name may be


def close_names(name: str, names: Iterable[str]) -> list[str]:
    """Return up to three of ``names`` that resemble ``name``, the most alike first."""
    scores = {candidate: _likeness(name, candidate) for candidate in names}
    least = max(CLOSE, max(scores.values(), default=0.0) - WORSE)
    close = [candidate for candidate, score in scores.items() if score >= least]
    return sorted(close, key=lambda candidate: (-scores[candidate], candidate))[:3]


def _likeness(first: str, second: str) -> float:
    """Return how alike two names are, from 0 to 1."""
    a, b = (text.lower().strip("/") for text in (first, second))
    last_a, last_b = a.rpartition("/")[2], b.rpartition("/")[2]
    return max(
        SequenceMatcher(None, a, b, autojunk=False).ratio(),
        0.95 * SequenceMatcher(None, last_a, last_b, autojunk=False).ratio(),
        0.9 if min(len(a), len(b)) > 2 and (a in b or b in a) else 0.0,
    )
