"""Live runs that the machine left alone for long enough to be measured.

A machine that is busy with others' work stalls in nearly every cycle at times. Such a run says
nothing about us, and whoever measures would repeat it; so do the tests.
"""

from collections.abc import Callable
from pathlib import Path

from chainshaper import measure_latency
from chainshaper.recording import Recording

__all__ = ["calm_run"]

_ATTEMPTS = 5


def calm_run(
    run: Callable[[Path], Recording], folder: Path, longest_stall_ns: int | None = None
) -> Recording:
    """``run`` in folders below ``folder`` until half the traversals at least are undisturbed.

    Nor has the machine stalled for longer than ``longest_stall_ns`` then. What the last of five
    attempts gives is taken as it is.
    """
    for attempt in range(_ATTEMPTS):
        place = folder / f"attempt{attempt}"
        place.mkdir()
        recording = run(place)
        measured = measure_latency(recording)
        undisturbed = measured.analysis.undisturbed.count
        stalled = measured.longest_stall_ns or 0
        if 2 * undisturbed >= measured.analysis.traversals.height and (
            longest_stall_ns is None or stalled < longest_stall_ns
        ):
            break
    return recording
