"""Live runs that the machine left alone for long enough to be measured.

A machine that is busy with others' work stalls in nearly every cycle at times. Such a run says
nothing about us, and whoever measures would repeat it; so do the tests.
"""

from collections.abc import Callable
from pathlib import Path

import polars as pl
from small_chain import PERIOD_NS

from chainshaper import measure_latency
from chainshaper.analysis import LatencyAnalysis
from chainshaper.analysis.disturbance import overlapping
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording

_ATTEMPTS = 5
_MOST_ATTEMPTS = 20


def calm_run(
    run: Callable[[Path], Recording], folder: Path, longest_stall_ns: int = PERIOD_NS // 2
) -> Recording:
    """``run`` in folders below ``folder`` until half the traversals at least are undisturbed.

    Nor has the machine stalled for as long as ``longest_stall_ns`` then: half a period makes the
    small chain's timers miss expiries. Where five attempts are not enough, the next one with an
    undisturbed execution of each callback is taken, for nothing can be planned from a recording
    without: with the twentieth, whatever it is. A run in which no output came is none of these.
    """
    for attempt in range(_MOST_ATTEMPTS):
        place = folder / f"attempt{attempt}"
        place.mkdir()
        recording = run(place)
        try:
            measured = measure_latency(recording)
        except InputError:  # the machine left so little time that the chain never came to its end
            if attempt + 1 == _MOST_ATTEMPTS:
                raise
            continue
        undisturbed = measured.analysis.undisturbed.count
        stalled = measured.longest_stall_ns or 0
        traversals = measured.analysis.traversals.height
        if 2 * undisturbed >= traversals and stalled < longest_stall_ns:
            break
        if attempt + 1 >= _ATTEMPTS and has_undisturbed_executions(measured.analysis):
            break
    return recording


def has_undisturbed_executions(analysis: LatencyAnalysis) -> bool:
    """Whether each callback of the chain ran at least once outside disturbed traversals."""
    disturbed = analysis.traversals.filter("complete", "disturbed")
    began, ended = disturbed["start"].to_numpy(), disturbed["end"].to_numpy() + 1
    for hop in range(len(analysis.chain.callbacks)):
        published = analysis.hops.filter(pl.col("hop") == hop).drop_nulls("publish")
        starts = published["start"].to_numpy()
        if overlapping(starts, starts, began, ended).all():
            return False
    return True
