"""Leave out packets that are in two of the files that are opened together.

Successive snapshots of a tracer's ring buffer overlap, and a folder may lie beside a copy of it.
Two packets are the same when all of this agrees: their trace's UUID, their stream's class and
instance, their number in the stream, and the time that they cover. The time is needed because some
tracers write the same UUID in every session, and number packets from the same number in each.
"""

import os
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper.sources.ctf.tsdl import CtfError, TraceClass

_KEY = ("stream_class", "instance", "sequence", "begin", "end")
"""Columns of packets (see `CtfStream`) that are equal in all copies of a packet."""


@dataclass(frozen=True)
class CtfStream:
    """One stream file and its packets, in order of the file.

    Columns of ``packets``, all Int64; -1 where a packet does not say the number:

    * ``offset``: where the packet begins, in bytes from the file's beginning
    * ``size``: of the packet, in bytes, not more than the file has
    * ``content_bits``: of header, context and events
    * ``stream_class``: counted over all folders, in order of declaration
    * ``instance``: which stream of that class
    * ``begin``, ``end``: when the packet was opened and closed, in clock cycles, as it says
    * ``sequence``: its number in the stream
    * ``discarded``: events that the tracer dropped in this stream so far
    * ``cpu``: the core on which its events were recorded
    * ``earliest``, ``latest``: in clock cycles, between which the times of its events must be
    """

    path: Path
    folder: int  # its number among the folders that are opened together
    packets: pl.DataFrame = field(repr=False, compare=False)


def stream_classes(folders: Sequence[TraceClass]) -> NDArray[np.int64]:
    """Number the stream classes of all folders: copies of a trace have the same numbers."""
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
    """Leave out packets that are in another file too; return the files, and warnings about it.

    ``classes`` are the numbers that :func:`stream_classes` returns.
    Raises `CtfError`: copies of a packet differ in their contents.
    """
    paths = [stream.path for stream in streams]
    packets = [stream.packets for stream in streams]
    left_out = [np.zeros(len(frame), bool) for frame in packets]
    counts = Counter[tuple[int, int]]()
    for file, packet, counted in _copies(paths, packets, classes):
        left_out[file][packet] = True
        counts[file, counted] += 1
    remaining = [
        replace(stream, packets=stream.packets.filter(~copies)) if copies.any() else stream
        for stream, copies in zip(streams, left_out, strict=True)
    ]
    warnings = [
        f"{paths[file]}: {count} of its {len(packets[file])} packets are in {paths[counted]} as"
        " well; they count once"
        for (file, counted), count in sorted(counts.items())
    ]
    return [stream for stream in remaining if len(stream.packets)], warnings


def _copies(
    paths: Sequence[Path], packets: Sequence[pl.DataFrame], classes: NDArray[np.int64]
) -> list[tuple[int, int, int]]:
    """Return the copies: file and number of each, and the file with the packet that counts."""
    if not packets:
        return []
    files = np.repeat(np.arange(len(packets)), [len(frame) for frame in packets])
    numbers = np.concatenate([np.arange(len(frame)) for frame in packets])
    columns = pl.concat(packets)
    lengths, offsets = columns["content_bits"].to_numpy(), columns["offset"].to_numpy()
    keys = {name: columns[name].to_numpy() for name in _KEY}
    keys["stream_class"] = classes[keys["stream_class"]]
    known = np.flatnonzero((keys["sequence"] >= 0) & (keys["begin"] >= 0))
    # In this order copies of a packet stand side by side, the longest first, since a copy may have
    # been cut short.
    orders = [keys[name][known] for name in _KEY]
    order = known[np.lexsort((numbers[known], files[known], -lengths[known], *orders))]
    alike = np.logical_and.reduce(
        [keys[name][order[1:]] == keys[name][order[:-1]] for name in _KEY]
    )
    # For each place in this order, the place of the first copy of the same packet: it counts.
    begins = np.maximum.accumulate(np.where(np.append([False], alike), 0, np.arange(len(order))))
    copies: list[tuple[int, int, int]] = []
    with ExitStack() as opened:
        descriptors = [-1] * len(paths)

        def content(packet: int, bits: int) -> bytes:
            """Read the first bytes of a packet, as many as hold so many bits."""
            file = int(files[packet])
            if descriptors[file] < 0:
                descriptors[file] = opened.enter_context(paths[file].open("rb")).fileno()
            return os.pread(descriptors[file], bits >> 3, int(offsets[packet]))

        for place in (np.flatnonzero(alike) + 1).tolist():
            copy, counted = int(order[place]), int(order[begins[place]])
            file, file_of_counted = int(files[copy]), int(files[counted])
            bits = int(lengths[copy])
            if content(copy, bits) != content(counted, bits):
                number = keys["sequence"][copy]
                same = f"packet {number} of this stream is in {paths[file_of_counted]} too"
                remedy = "one of them is damaged, or was being overwritten: give one folder alone"
                raise CtfError(
                    paths[file], int(offsets[copy]), f"{same}, with another content", remedy
                )
            copies.append((file, int(numbers[copy]), file_of_counted))
    return copies
