"""Writing CTF 1.8 traces: for tests, examples and benchmarks.

Any metadata text can be given; `lttng_text` makes LTTng's own.  babeltrace2 reads the result.
"""

import struct
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from uuid import UUID

from chainshaper.sources.ctf.encoding import Bits, encode
from chainshaper.sources.ctf.metadata import METADATA_MAGIC
from chainshaper.sources.ctf.tsdl import parse_tsdl
from chainshaper.sources.ctf.types import (
    EventClass,
    IntegerType,
    StreamClass,
    StructType,
    TraceClass,
    VariantType,
    field_name,
)

__all__ = [
    "EncodedPacket",
    "EventRecord",
    "encode_packet",
    "metadata_packets",
    "repeat_packets",
    "write_trace",
]

PACKET_MAGIC = 0xC1FC1FC1


@dataclass(frozen=True, slots=True)
class EventRecord:
    """One event to write: ``time`` in clock cycles; contexts and payload by users' names.

    ``context`` holds the fields of the stream's and of the event's own context.
    """

    name: str
    time: int
    payload: Mapping[str, Any] = field(default_factory=dict)
    context: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class EncodedPacket:
    """A packet's bytes; byte offsets of its 64-bit clock values and of its sequence number."""

    data: bytes
    clocks: tuple[int, ...]
    sequence: int | None
    big: bool


def encode_packet(
    declared: TraceClass,
    events: Sequence[EventRecord],
    context: Mapping[str, Any],
    *,
    stream_id: int = 0,
    instance: int = 0,
    padding: int = 0,
    stamps: Collection[str] = (),
) -> EncodedPacket:
    """One packet of ``events``, which are in order of time.

    ``context`` gives the packet context's fields that cannot be told from the events
    (``cpu_id``, ``packet_seq_num``, ``events_discarded``); ``padding`` bytes follow the content.
    ``stamps`` names 64-bit fields of payloads that hold times: `repeat_packets` moves them too.
    """
    stream = declared.streams[stream_id]
    begin = events[0].time if events else 0
    times = {"timestamp_begin": begin, "timestamp_end": events[-1].time if events else begin}
    sizes = {"content_size": 0, "packet_size": 0}
    header = {
        "magic": PACKET_MAGIC,
        "uuid": list(UUID(declared.uuid).bytes) if declared.uuid else [],
        "stream_id": stream_id,
        "stream_instance_id": instance,
    }
    values = times | sizes | dict(context)
    bits = Bits(declared.byte_order == "be", stamps=frozenset(stamps))
    _head(bits, declared, stream, header, values)
    clock = int(values["timestamp_begin"])
    by_name = {event.name: event for event in stream.events.values()}
    for event in events:
        clock = _event(bits, stream, by_name[event.name], event, clock)
    content = bits.position
    size = -(-content // 8) + padding
    # Sizes come first but are known last: the head is written again over itself.
    head = Bits(bits.big)
    _head(
        head, declared, stream, header, values | {"content_size": content, "packet_size": 8 * size}
    )
    whole = len(head.data) - (head.position % 8 > 0)
    data = bytes(head.data[:whole]) + bytes(bits.data[whole:]).ljust(size - whole, b"\0")
    sequence = head.names.get("packet_seq_num")
    return EncodedPacket(
        data=data,
        clocks=tuple(place // 8 for place in bits.clocks),
        sequence=sequence // 8 if sequence is not None else None,
        big=bits.big,
    )


def _head(
    bits: Bits,
    declared: TraceClass,
    stream: StreamClass,
    header: Mapping[str, Any],
    values: Mapping[str, Any],
) -> None:
    if declared.packet_header is not None:
        encode(bits, declared.packet_header, header)
    if stream.packet_context is not None:
        encode(bits, stream.packet_context, values)


def _event(
    bits: Bits, stream: StreamClass, declared: EventClass, event: EventRecord, clock: int
) -> int:
    """Append one event; returns the clock after it."""
    if stream.event_header is not None:
        encode(
            bits, stream.event_header, _event_header(stream.event_header, declared, event, clock)
        )
    for kind, values in (
        (stream.event_context, event.context),
        (declared.context, event.context),
        (declared.fields, event.payload),
    ):
        if kind is not None:
            encode(bits, kind, values)
    return event.time


def _event_header(
    header: StructType, declared: EventClass, event: EventRecord, clock: int
) -> dict[str, Any]:
    """The header's values: LTTng's compact form where it suffices, else its extended one."""
    long = {"id": declared.id, "timestamp": event.time}
    kinds = {member.name: member.type for member in header.fields}
    variant = kinds.get("v")
    if not isinstance(variant, VariantType):
        return long
    compact = next(o.type for o in variant.options if field_name(o.name) == "compact")
    stamp = compact.fields[0].type if isinstance(compact, StructType) else None
    if not isinstance(stamp, IntegerType):
        raise ValueError("event header is none of LTTng's")
    identifier = kinds["id"]
    last = max(m.low for m in identifier.mappings)  # type: ignore[union-attr]
    # A compact stamp can tell of less than one turn of its bits since the event before.
    if declared.id < last and 0 <= event.time - clock < 1 << stamp.size:
        return {"id": declared.id, "v": ("compact", {"timestamp": event.time})}
    return {"id": last, "v": ("extended", long)}


def metadata_packets(text: str, uuid: str, *, big: bool = False, size: int = 4096) -> bytes:
    """Metadata as packets of ``size`` bytes (section 7.1), as LTTng writes it."""
    order, data = ">" if big else "<", text.encode()
    header = struct.Struct(order + "I16sIIIBBBBB")
    room = size - header.size
    packets = []
    for start in range(0, max(len(data), 1), room):
        part = data[start : start + room]
        head = header.pack(
            METADATA_MAGIC, UUID(uuid).bytes, 0,
            8 * (header.size + len(part)), 8 * size, 0, 0, 0, 1, 8,
        )  # fmt: skip
        packets.append((head + part).ljust(size, b"\0"))
    return b"".join(packets)


def repeat_packets(
    packets: Sequence[EncodedPacket], times: int, period: int, first: int = 0
) -> Iterable[bytes]:
    """The bytes of ``packets`` over and over, each round ``period`` cycles later.

    The ``first`` round may be a later one. ``period`` must be a multiple of 2**32, so that time
    stamps of fewer bits stay as they are; sequence numbers go on counting.
    """
    if period % (1 << 32):
        raise ValueError("the period must be a multiple of 2**32 cycles")
    for turn in range(first, first + times):
        for packet in packets:
            order: Literal["big", "little"] = "big" if packet.big else "little"
            data = bytearray(packet.data)
            for place in packet.clocks:
                value = int.from_bytes(data[place : place + 8], order) + turn * period
                data[place : place + 8] = value.to_bytes(8, order)
            if packet.sequence is not None:
                place = packet.sequence
                value = int.from_bytes(data[place : place + 8], order) + turn * len(packets)
                data[place : place + 8] = value.to_bytes(8, order)
            yield bytes(data)


def write_trace(
    folder: Path,
    metadata: str,
    streams: Mapping[str, Iterable[EncodedPacket | bytes]],
    *,
    packetized: bool = True,
) -> TraceClass:
    """Write a trace folder: ``metadata`` and one file of packets per name in ``streams``.

    Raises FileExistsError where the folder has metadata already.
    """
    declared = parse_tsdl(metadata)
    folder.mkdir(parents=True, exist_ok=True)
    data = metadata.encode()
    if packetized and declared.uuid is not None:
        data = metadata_packets(metadata, declared.uuid, big=declared.byte_order == "be")
    with (folder / "metadata").open("xb") as file:
        file.write(data)
    for name, packets in streams.items():
        with (folder / name).open("xb") as file:
            for packet in packets:
                file.write(packet if isinstance(packet, bytes) else packet.data)
    return declared
