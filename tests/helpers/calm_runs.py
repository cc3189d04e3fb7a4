"""Live runs that the machine left alone for long enough to be measured.

A machine that is busy with others' work stalls in nearly every cycle at times. Such a run says
nothing about us, and whoever measures would repeat it; so do the tests.
"""

from collections.abc import Callable
from pathlib import Path

from small_chain import PERIOD_NS

from chainshaper import measure_latency
from chainshaper.values.recording import Recording

_ATTEMPTS = 5


def calm_run(
    run: Callable[[Path], Recording], folder: Path, longest_stall_ns: int = PERIOD_NS // 2
) -> Recording:
    """``run`` in folders below ``folder`` until half the traversals at least are undisturbed.

    Nor has the machine stalled for as long as ``longest_stall_ns`` then: half a period makes the
    small chain's timers miss expiries. What the last of five attempts gives is taken as it is.
    """
    for attempt in range(_ATTEMPTS):
        place = folder / f"attempt{attempt}"
        place.mkdir()
        recording = run(place)
        measured = measure_latency(recording)
        undisturbed = measured.analysis.undisturbed.count
        stalled = measured.longest_stall_ns or 0
        traversals = measured.analysis.traversals.height
        if 2 * undisturbed >= traversals and stalled < longest_stall_ns:
            break
    return recording
