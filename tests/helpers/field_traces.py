"""Traces as they come from the field: in chunks, snapshots, copies; some of them damaged."""

import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from uuid import UUID

import ctf_writing
import polars as pl
import pytest
from ctf_writing import write_lttng_trace
from reference_traces import DATA
from story import Story

from chainshaper.sources.ctf import open_trace

MS = 1_000_000
START = 1 << 40
OFFSET = 1_700_000_000_000_000_000
STREAM = Path("ust/uid/1000/64-bit/channel_0")


def field_trace(name: str) -> Path:
    """An input from the field; skips the test where it is not."""
    folder = DATA / "field" / name
    if not folder.is_dir():
        pytest.skip(f"the inputs from the field are not here ({folder})")
    return folder


def chain_tables(
    cycles: int = 20, period: int = 50 * MS, declared: int | None = None
) -> dict[str, pl.DataFrame]:
    """/camera (timer, /image) → /detector (/image, /objects), 5 ms from start to publication.

    The timer is created with the period ``declared``, where that is another one.
    """
    story = Story()
    camera, detector = story.node("/camera", 100), story.node("/detector", 200)
    timer = story.timer(camera, period=declared or period, symbol="Camera::tick()")
    reader = story.subscription(detector, "/image", symbol="Detector::on_image()")
    image, objects = story.publisher(camera, "/image"), story.publisher(detector, "/objects")
    for cycle in range(cycles):
        now = (cycle + 1) * period
        story.runs(timer, now, now + 2 * MS, writes=((image, now + MS),))
        reads = now + MS
        story.runs(
            reader, now + 3 * MS, now + 6 * MS, reads=reads, writes=((objects, now + 5 * MS),)
        )
    moved = ("time", "timestamp", "source_timestamp", "source_stamp")
    return {
        name: frame.with_columns(pl.col(c) + START for c in moved if c in frame.columns)
        for name, frame in story.tables().items()
    }


def moved(tables: Mapping[str, pl.DataFrame], by: int) -> dict[str, pl.DataFrame]:
    """The events, noted so much later by another session."""
    return {name: frame.with_columns(pl.col("time") + by) for name, frame in tables.items()}


def write_chain(
    folder: Path, tables: Mapping[str, pl.DataFrame], packet_events: int = 25, uuid: int = 0
) -> Path:
    """A trace in packets of so many events; ``uuid`` other than 0 makes it another session's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ctf_writing, "_PACKET_EVENTS", packet_events)
        write_lttng_trace(folder, tables, clock_offset_ns=OFFSET)
    if uuid:
        known = UUID(ctf_writing._UUID)
        for file in (folder / STREAM.parent).iterdir():
            data = file.read_bytes().replace(known.bytes, UUID(int=uuid).bytes)
            file.write_bytes(data.replace(str(known).encode(), str(UUID(int=uuid)).encode()))
    return folder


def packets_of(folder: Path) -> list[bytes]:
    """The packets of a trace of one stream."""
    (stream,) = open_trace(folder).streams
    data = stream.path.read_bytes()
    return [
        data[begin : begin + size]
        for begin, size in stream.packets.select("offset", "size").iter_rows()
    ]


def write_packets(folder: Path, like: Path, packets: Iterable[bytes]) -> Path:
    """A trace with the metadata of another one, and these packets."""
    (folder / STREAM).parent.mkdir(parents=True)
    shutil.copy(like / STREAM.with_name("metadata"), (folder / STREAM).parent)
    (folder / STREAM).write_bytes(b"".join(packets))
    return folder
