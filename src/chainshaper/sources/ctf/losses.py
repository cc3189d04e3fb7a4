"""What the tracer says that it dropped (LTTng's packet context, CTF 1.8 section 5.2)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chainshaper.sources.ctf import tables as tb

__all__ = ["count_losses"]


def count_losses(
    files: Sequence[tuple[Path, NDArray[np.int64]]], warnings: list[str]
) -> tuple[int, int]:
    """Discarded events and lost packets of one stream, given its files' packet tables.

    ``events_discarded`` counts from the beginning of the stream (32-bit tracers' counters wrap).
    What the first packet says counts where it is the stream's first; a snapshot or a rotated
    trace begins anywhere, and what was lost before it is not its own.  A gap in
    ``packet_seq_num`` is that many packets lost.  A warning is appended for either kind of loss.
    """
    table = np.concatenate([table for _, table in files])
    # Files of one stream follow each other (tracefile rotation), not always by name.
    table = table[np.argsort(table[:, tb.P_BEGIN], kind="stable")]
    counter = table[:, tb.P_DISCARDED]
    sequence = table[:, tb.P_SEQUENCE]
    before = 0 if sequence[0] <= 0 else counter[0]
    steps = np.diff(counter, prepend=before)
    steps[steps < 0] += 1 << 32
    discarded = int(steps[steps > 0].sum()) if (counter >= 0).all() else 0
    gaps = np.diff(sequence) - 1
    lost = int(gaps[gaps > 0].sum()) if (sequence >= 0).all() else 0
    path = files[0][0]
    if discarded:
        warnings.append(
            f"{path}: the tracer discarded {discarded} events of this stream"
            " (record with more or larger sub-buffers)"
        )
    if lost:
        warnings.append(
            f"{path}: {lost} packets of this stream are missing"
            " (overwritten, or not copied with the trace)"
        )
    return discarded, lost
