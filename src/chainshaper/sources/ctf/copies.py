"""Packets that stand twice in what is opened together: they count once.

Successive snapshots of a tracer's ring buffer overlap, and folders lie beside their copies. A
packet is known by its trace's UUID, its stream's class and instance, its number there, and the time
that it covers: sessions of tracers that always write the same UUID count from the same number.
"""

import os
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chainshaper.sources.ctf import layout as tb
from chainshaper.sources.ctf.tsdl import CtfError, TraceClass

_KEY = (tb.P_STREAM, tb.P_INSTANCE, tb.P_SEQUENCE, tb.P_BEGIN, tb.P_LAST)


@dataclass(frozen=True)
class CtfStream:
    """One stream file of a folder (by number) and the table of its packets (see `layout`)."""

    path: Path
    folder: int
    table: NDArray[np.int64] = field(repr=False, compare=False)


def stream_classes(folders: Sequence[TraceClass]) -> NDArray[np.int64]:
    """For each row of `layout`'s stream classes a number, the same in all folders of one trace."""
    numbers: dict[tuple[object, int], int] = {}
    keys = [
        (folder.uuid or folder.path, identifier)
        for folder in folders
        for identifier in folder.streams
    ]
    return np.array([numbers.setdefault(key, len(numbers)) for key in keys], np.int64)


def without_copies(
    streams: Sequence[CtfStream], classes: NDArray[np.int64]
) -> tuple[list[CtfStream], list[str]]:
    """The stream files without the packets that stand in another one too, and what was left out.

    ``classes`` as :func:`stream_classes` has them. Raises `CtfError`: a packet has two contents.
    """
    paths, tables = [stream.path for stream in streams], [stream.table for stream in streams]
    left_out = [np.zeros(len(table), bool) for table in tables]
    counts = Counter[tuple[int, int]]()
    for file, packet, before in _copies(paths, tables, classes):
        left_out[file][packet] = True
        counts[file, before] += 1
    left = [
        replace(one, table=one.table[~copies])
        for one, copies in zip(streams, left_out, strict=True)
    ]
    warnings = [
        f"{paths[file]}: {count} of its {len(tables[file])} packets are in {paths[before]} as well;"
        " they count once"
        for (file, before), count in sorted(counts.items())
    ]
    return [stream for stream in left if len(stream.table)], warnings


def _copies(
    paths: Sequence[Path], tables: Sequence[NDArray[np.int64]], classes: NDArray[np.int64]
) -> list[tuple[int, int, int]]:
    """Packets that are there already: file and number of the copy, file of the one that counts."""
    if not tables:
        return []
    sizes = [len(table) for table in tables]
    keys = np.concatenate([table[:, _KEY] for table in tables])
    keys[:, 0] = classes[keys[:, 0]]
    lengths = np.concatenate([table[:, tb.P_END] for table in tables])
    files = np.repeat(np.arange(len(tables)), sizes)
    packets = np.concatenate([np.arange(size) for size in sizes])
    known = np.flatnonzero((keys[:, 2] >= 0) & (keys[:, 3] >= 0))
    # Alike ones in a row, the longest first: a copy may have been cut short.
    order = known[np.lexsort((packets[known], files[known], -lengths[known], *keys[known].T))]
    alike = (keys[order[1:]] == keys[order[:-1]]).all(axis=1)
    # Of each place in that row, where the ones alike begin.
    begins = np.maximum.accumulate(np.where(np.append([False], alike), 0, np.arange(len(order))))
    found: list[tuple[int, int, int]] = []
    with ExitStack() as opened:
        descriptors = [-1] * len(paths)

        def content(which: int, bits: int) -> bytes:
            """The bytes of a packet."""
            file = int(files[which])
            if descriptors[file] < 0:
                descriptors[file] = opened.enter_context(paths[file].open("rb")).fileno()
            offset = int(tables[file][int(packets[which]), tb.P_BYTE])
            return os.pread(descriptors[file], bits >> 3, offset)

        for place in (np.flatnonzero(alike) + 1).tolist():
            copy, counted = int(order[place]), int(order[begins[place]])
            file, before, bits = int(files[copy]), int(files[counted]), int(lengths[copy])
            if content(copy, bits) != content(counted, bits):
                offset = int(tables[file][int(packets[copy]), tb.P_BYTE])
                same = f"packet {keys[copy, 2]} of this stream is in {paths[before]} too"
                remedy = "one of them is damaged, or was being overwritten: give one folder alone"
                raise CtfError(paths[file], offset, f"{same}, with another content", remedy)
            found.append((file, int(packets[copy]), before))
    return found
