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
import polars as pl
from numpy.typing import NDArray

from chainshaper.sources.ctf.tsdl import CtfError, TraceClass

_KEY = ("stream_class", "instance", "sequence", "begin", "end")


@dataclass(frozen=True)
class CtfStream:
    """One stream file of a folder (by number) and its packets, in order of the file.

    Columns of ``packets``, all Int64; -1 where a packet does not say a number:

    * ``offset``: bytes from the file's beginning; ``size``: bytes, not more than the file has
    * ``content_bits``: of header, context and events
    * ``stream_class``: counted over all folders, in order of declaration
    * ``instance``: which stream of that class
    * ``begin``, ``end``: clock cycles, as the packet says
    * ``sequence``: its number in the stream
    * ``discarded``: events that the tracer dropped so far
    * ``cpu``: the core that it is of
    * ``earliest``, ``latest``: clock cycles, what its events' times can be
    """

    path: Path
    folder: int
    packets: pl.DataFrame = field(repr=False, compare=False)


def stream_classes(folders: Sequence[TraceClass]) -> NDArray[np.int64]:
    """For each stream class of all folders a number, the same in all folders of one trace."""
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
    paths = [stream.path for stream in streams]
    packets = [stream.packets for stream in streams]
    left_out = [np.zeros(len(frame), bool) for frame in packets]
    counts = Counter[tuple[int, int]]()
    for file, packet, before in _copies(paths, packets, classes):
        left_out[file][packet] = True
        counts[file, before] += 1
    left = [
        replace(stream, packets=stream.packets.filter(~copies)) if copies.any() else stream
        for stream, copies in zip(streams, left_out, strict=True)
    ]
    warnings = [
        f"{paths[file]}: {count} of its {len(packets[file])} packets are in {paths[before]} as"
        " well; they count once"
        for (file, before), count in sorted(counts.items())
    ]
    return [stream for stream in left if len(stream.packets)], warnings


def _copies(
    paths: Sequence[Path], packets: Sequence[pl.DataFrame], classes: NDArray[np.int64]
) -> list[tuple[int, int, int]]:
    """Packets that are there already: file and number of the copy, file of the one that counts."""
    if not packets:
        return []
    files = np.repeat(np.arange(len(packets)), [len(frame) for frame in packets])
    numbers = np.concatenate([np.arange(len(frame)) for frame in packets])
    columns = pl.concat(packets)
    lengths, offsets = columns["content_bits"].to_numpy(), columns["offset"].to_numpy()
    keys = {name: columns[name].to_numpy() for name in _KEY}
    keys["stream_class"] = classes[keys["stream_class"]]
    known = np.flatnonzero((keys["sequence"] >= 0) & (keys["begin"] >= 0))
    # Alike ones in a row, the longest first: a copy may have been cut short.
    orders = [keys[name][known] for name in _KEY]
    order = known[np.lexsort((numbers[known], files[known], -lengths[known], *orders))]
    alike = np.logical_and.reduce(
        [keys[name][order[1:]] == keys[name][order[:-1]] for name in _KEY]
    )
    # Of each place in that row, where the ones alike begin.
    begins = np.maximum.accumulate(np.where(np.append([False], alike), 0, np.arange(len(order))))
    found: list[tuple[int, int, int]] = []
    with ExitStack() as opened:
        descriptors = [-1] * len(paths)

        def content(packet: int, bits: int) -> bytes:
            """The bytes of a packet."""
            file = int(files[packet])
            if descriptors[file] < 0:
                descriptors[file] = opened.enter_context(paths[file].open("rb")).fileno()
            return os.pread(descriptors[file], bits >> 3, int(offsets[packet]))

        for place in (np.flatnonzero(alike) + 1).tolist():
            copy, counted = int(order[place]), int(order[begins[place]])
            file, before, bits = int(files[copy]), int(files[counted]), int(lengths[copy])
            if content(copy, bits) != content(counted, bits):
                number = keys["sequence"][copy]
                same = f"packet {number} of this stream is in {paths[before]} too"
                remedy = "one of them is damaged, or was being overwritten: give one folder alone"
                raise CtfError(
                    paths[file], int(offsets[copy]), f"{same}, with another content", remedy
                )
            found.append((file, int(numbers[copy]), before))
    return found
