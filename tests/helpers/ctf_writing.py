"""Writing CTF 1.8 traces: packets of events by any metadata, LTTng's metadata, event tables.

    text = lttng_metadata({"e": {"n": "u32"}})
    packet = encode_packet(parse_tsdl(text), [EventRecord("e", 0, {"n": 1})], {"cpu_id": 0, …})
    write_trace(folder, text, {"channel_0": [packet]})

babeltrace2 reads the result. Values are plain Python: int, str, list for arrays and sequences,
mapping (by the names that users see) for structures, (option, value) for variants.
"""

import re
import struct
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from uuid import UUID

import polars as pl

from chainshaper.sources.ctf.layout import MAGIC
from chainshaper.sources.ctf.trace import METADATA_MAGIC
from chainshaper.sources.ctf.tsdl import (
    ArrayType,
    Field,
    IntegerType,
    StringType,
    StructType,
    TraceClass,
    Type,
    VariantType,
    alignment,
    field_name,
    parse_tsdl,
)
from chainshaper.values import events


@dataclass(frozen=True, slots=True)
class EventRecord:
    """One event: ``time`` in clock cycles; payload and contexts (stream's, event's) by name."""

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


@dataclass
class _Bits:
    """Bytes being filled bit by bit; ``position`` in bits, ``big`` the trace's byte order.

    ``clocks`` and ``names`` note the bit positions of 64-bit clock values and of the integer
    members of outermost structures; those that ``stamps`` names count as clock values.
    """

    big: bool
    stamps: frozenset[str] = frozenset()
    data: bytearray = field(default_factory=bytearray)
    position: int = 0
    clocks: list[int] = field(default_factory=list)
    names: dict[str, int] = field(default_factory=dict)

    def move(self, bits: int) -> int:
        """Advance; the first byte of what lies between."""
        first = self.position // 8
        self.position += bits
        self.data += bytes(max(0, -(-self.position // 8) - len(self.data)))
        return first

    def align(self, bits: int) -> None:
        """Advance to a multiple of ``bits``."""
        self.move(-self.position % bits)

    def integer(self, value: int, size: int, big: bool) -> None:
        """Write ``size`` bits at the position; raises ValueError where they cannot hold it."""
        if not -(1 << size - 1) <= value < 1 << size:
            raise ValueError(f"{value} does not fit {size} bits")
        order: Literal["big", "little"] = "big" if big else "little"
        shift, first = self.position % 8, self.move(size)
        count = len(self.data) - first
        around = int.from_bytes(self.data[first:], order)
        around |= (value & (1 << size) - 1) << (8 * count - shift - size if big else shift)
        self.data[first:] = around.to_bytes(count, order)

    def raw(self, data: bytes) -> None:
        """Write bytes at the next whole byte."""
        self.align(8)
        first = self.move(8 * len(data))
        self.data[first : first + len(data)] = data


def _encode(bits: _Bits, kind: Type, value: Any, name: str = "", depth: int = 0) -> None:
    """Append ``value`` as ``kind``; raises ValueError or KeyError where it does not fit."""
    match kind:
        case StringType():
            bits.raw((value.encode() if isinstance(value, str) else value) + b"\0")
        case StructType():
            bits.align(kind.align)
            for member in kind.fields:
                shown, inside = field_name(member.name), member.type
                empty = isinstance(inside, StructType) and not inside.fields
                _encode(bits, inside, {} if empty else value[shown], shown, depth + 1)
        case VariantType(options=options):
            chosen, inside_value = value
            option = next(o for o in options if field_name(o.name) == chosen)
            _encode(bits, option.type, inside_value, chosen, depth + 1)
        case ArrayType():
            _encode_array(bits, kind, value, depth)
        case IntegerType():
            bits.align(kind.align)
            stamp = kind.clock is not None or (depth == 1 and name in bits.stamps)
            if stamp and kind.size == 64:
                bits.clocks.append(bits.position)
            if depth == 1:
                bits.names[name] = bits.position
            if kind.clock is not None:
                value &= (1 << kind.size) - 1
            big = bits.big if kind.byte_order == "native" else kind.byte_order == "be"
            bits.integer(value, kind.size, big)


def _encode_array(bits: _Bits, kind: ArrayType, value: Any, depth: int) -> None:
    bits.align(alignment(kind))
    value = value.encode() if isinstance(value, str) else value
    if isinstance(kind.length, int):
        value = value.ljust(kind.length, b"\0") if isinstance(value, bytes) else value
        if len(value) != kind.length:
            raise ValueError(f"{len(value)} elements for an array of {kind.length}")
    signed = isinstance(kind.element, IntegerType) and kind.element.signed
    for item in value:
        number = item - 256 if signed and item > 127 else item
        _encode(bits, kind.element, number, "", depth + 1)


def encode_packet(
    declared: TraceClass,
    records: Sequence[EventRecord],
    context: Mapping[str, Any] | None = None,
    *,
    stream_id: int = 0,
    instance: int = 0,
    padding: int = 0,
    stamps: Collection[str] = (),
) -> EncodedPacket:
    """One packet of ``records``, which are in order of time, and ``padding`` bytes.

    ``context`` gives packet context (``cpu_id``, ``packet_seq_num``, ``events_discarded``, by
    default 0), ``stamps`` names 64-bit fields with times, which `repeat_packets` moves too.
    """
    stream = declared.streams[stream_id]
    begin = records[0].time if records else 0
    values: dict[str, Any] = {
        "magic": MAGIC,
        "uuid": list(UUID(declared.uuid).bytes) if declared.uuid else [],
        "stream_id": stream_id,
        "stream_instance_id": instance,
        "timestamp_begin": begin,
        "timestamp_end": records[-1].time if records else begin,
        "content_size": 0,
        "packet_size": 0,
        **dict.fromkeys(("cpu_id", "packet_seq_num", "events_discarded"), 0),
        **(context or {}),
    }

    def head(bits: _Bits) -> _Bits:
        for kind in (declared.packet_header, stream.packet_context):
            if kind is not None:
                _encode(bits, kind, values)
        return bits

    bits = head(_Bits(declared.byte_order == "be", frozenset(stamps)))
    clock = int(values["timestamp_begin"])
    by_name = {event.name: event for event in stream.events.values()}
    for record in records:
        event = by_name[record.name]
        if stream.event_header is not None:
            header = _event_header(stream.event_header, event.id, record.time, clock)
            _encode(bits, stream.event_header, header)
        for kind, part in (
            (stream.event_context, record.context),
            (event.context, record.context),
            (event.fields, record.payload),
        ):
            if kind is not None:
                _encode(bits, kind, part)
        clock = record.time
    size = -(-bits.position // 8) + padding
    # Sizes come first but are known last: the head is written again over itself.
    values |= {"content_size": bits.position, "packet_size": 8 * size}
    first = head(_Bits(bits.big))
    whole = len(first.data) - (first.position % 8 > 0)
    sequence = first.names.get("packet_seq_num")
    return EncodedPacket(
        data=bytes(first.data[:whole]) + bytes(bits.data[whole:]).ljust(size - whole, b"\0"),
        clocks=tuple(place // 8 for place in bits.clocks),
        sequence=sequence // 8 if sequence is not None else None,
        big=bits.big,
    )


def _event_header(header: StructType, number: int, time: int, clock: int) -> Mapping[str, Any]:
    """The header's values: LTTng's compact form where it suffices, else its extended one."""
    long = {"id": number, "timestamp": time}
    match [member.type for member in header.fields]:
        case [
            IntegerType(mappings=mappings),
            VariantType(_, [Field(_, StructType([Field(_, stamp)])), *_]),
        ]:
            last = max(low for _, low, _ in mappings)
            # A compact stamp can tell of less than one turn of its bits since the event before.
            if number < last and 0 <= time - clock < 1 << stamp.size:  # type: ignore[union-attr]
                return {"id": number, "v": ("compact", {"timestamp": time})}
            return {"id": last, "v": ("extended", long)}
    return long


def metadata_packets(text: str, uuid: str, *, big: bool = False, size: int = 4096) -> bytes:
    """Metadata as packets of ``size`` bytes (CTF 1.8, section 7.1), as LTTng writes it."""
    data, header = text.encode(), struct.Struct((">" if big else "<") + "I16sIIIBBBBB")
    room, packets = size - header.size, []
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
            later = [(place, turn * period) for place in packet.clocks]
            if packet.sequence is not None:
                later.append((packet.sequence, turn * len(packets)))
            for place, by in later:
                value = int.from_bytes(data[place : place + 8], order) + by
                data[place : place + 8] = value.to_bytes(8, order)
            yield bytes(data)


def write_packet(folder: Path, metadata: str, records: Sequence[EventRecord]) -> None:
    """Write a trace of one packet."""
    write_trace(folder, metadata, {"channel_0": [encode_packet(parse_tsdl(metadata), records)]})


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


# LTTng's declarations: those of lttng-ust 2.13 and lttng-modules 2.13, from traces of theirs.

_UUID = "2a6422d0-6cee-11e0-8c08-cb07d7b3a564"
_FIELD = re.compile(r"(?:(?P<sign>[usx])(?P<size>\d+)|char)(\[(?P<length>\w*)\])?")
_HEAD = """/* CTF 1.8 */
typealias integer {{ size = 8; align = 8; signed = false; }} := uint8_t;
typealias integer {{ size = 16; align = {a16}; signed = false; }} := uint16_t;
typealias integer {{ size = 32; align = {a32}; signed = false; }} := uint32_t;
typealias integer {{ size = 64; align = {a64}; signed = false; }} := uint64_t;
typealias integer {{ size = 64; align = {a64}; signed = false; }} := unsigned long;
typealias integer {{ size = 5; align = 1; signed = false; }} := uint5_t;
trace {{ major = 1; minor = 8; uuid = "{uuid}"; byte_order = {order};
    packet.header := struct {{
        uint32_t magic; uint8_t  uuid[16]; uint32_t stream_id; uint64_t stream_instance_id;
    }};
}};
env {{ hostname = "{host}"; domain = "{domain}"; tracer_name = "{tracer}"; }};
clock {{
    name = "monotonic"; uuid = "d499e0ca-e836-4e4d-b711-80e0e67a24a1";
    description = "Monotonic Clock"; freq = 1000000000; /* Frequency, in Hz */
    offset = {offset}; /* clock value offset from Epoch is: offset * (1/freq) */
}};
typealias integer {{ size = 27; align = 1; map = clock.monotonic.value; }} := uint27_clock_t;
typealias integer {{ size = 32; align = {a32}; map = clock.monotonic.value; }} := uint32_clock_t;
typealias integer {{ size = 64; align = {a64}; map = clock.monotonic.value; }} := uint64_clock_t;
struct packet_context {{
    uint64_clock_t timestamp_begin; uint64_clock_t timestamp_end;
    uint64_t content_size; uint64_t packet_size; uint64_t packet_seq_num;
    unsigned long events_discarded; uint32_t cpu_id;
}};
struct event_header_compact {{
    enum : uint5_t {{ compact = 0 ... 30, extended = 31 }} id;
    variant <id> {{
        struct {{ uint27_clock_t timestamp; }} compact;
        struct {{ uint32_t id; uint64_clock_t timestamp; }} extended;
    }} v;
}} align({a32});
struct event_header_large {{
    enum : uint16_t {{ compact = 0 ... 65534, extended = 65535 }} id;
    variant <id> {{
        struct {{ uint32_clock_t timestamp; }} compact;
        struct {{ uint32_t id; uint64_clock_t timestamp; }} extended;
    }} v;
}} align({a16});
stream {{ id = 0; event.header := struct event_header_{header};
    packet.context := struct packet_context;
"""


def lttng_metadata(
    events: Mapping[str, Mapping[str, str]],
    context: Mapping[str, str] | None = None,
    *,
    header: str = "large",
    kernel: bool = False,
    big: bool = False,
    aligned: bool = False,
    offset: int = 1_700_000_000_000_000_000,
    host: str = "example",
) -> str:
    """The metadata of a trace with one stream class; event ids count up from 0.

    ``events`` maps names to fields and their kinds, ``context`` gives the stream's context: an
    integer ``u8`` … ``s64`` (``x64`` shown in hexadecimal), ``string``, an array ``u8[24]``,
    text ``char[16]`` or a sequence ``u64[]`` whose length is a field of its own as LTTng writes
    it.  ``aligned`` gives integers their natural alignment, as on machines that need it.
    """
    text = _HEAD.format(
        **{f"a{size}": size if aligned else 8 for size in (16, 32, 64)},
        uuid=_UUID,
        order="be" if big else "le",
        host=host,
        domain="kernel" if kernel else "ust",
        tracer="lttng-modules" if kernel else "lttng-ust",
        offset=offset,
        header=header,
    )
    if context:
        text += f"    event.context := struct {{ {_fields(context, aligned)} }};\n"
    text += "};\n"
    for number, (name, kinds) in enumerate(events.items()):
        fields = _fields(kinds, aligned)
        head = f'name = "{name}"; id = {number}; stream_id = 0;'
        text += f"event {{ {head} fields := struct {{ {fields} }}; }};\n"
    return text


def _fields(fields: Mapping[str, str], aligned: bool) -> str:
    return "".join(_field(name, kind, aligned) for name, kind in fields.items())


def _field(name: str, kind: str, aligned: bool) -> str:
    if kind == "string":
        return f"string _{name};\n"
    match = _FIELD.fullmatch(kind)
    if match is None:
        raise ValueError(f"field {name}: unknown kind {kind!r}")
    text = match["sign"] is None
    size, signed = int(match["size"] or 8), int(text or match["sign"] == "s")
    integer = (
        f"integer {{ size = {size}; align = {size if aligned else 8}; signed = {signed};"
        f" encoding = {'UTF8' if text else 'none'}; base = {16 if match['sign'] == 'x' else 10}; }}"
    )
    if match["length"] == "":
        counter = "integer { size = 32; align = 8; signed = 0; encoding = none; base = 10; }"
        return f"{counter} __{name}_length;\n{integer} _{name}[ __{name}_length ];\n"
    return f"{integer} _{name}{'' if match['length'] is None else '[' + match['length'] + ']'};\n"


# Event tables as a trace

_KERNEL = ("sched_switch",)
_CARET = ("dds_write", "dds_bind_addr_to_stamp", "rmw_implementation")
_PACKET_EVENTS = 1000
_CHARACTERS = 16  # of a thread's name


def write_lttng_trace(
    folder: str | Path,
    tables: events.EventTables,
    *,
    clock_offset_ns: int = 1_700_000_000_000_000_000,
    host: str = "example",
    process_names: Mapping[int, str] | None = None,
    gid_length: int = 24,
    discarded_events: int = 0,
) -> Path:
    """Write event tables as a trace into ``folder`` (``ust`` and, if needed, ``kernel`` in it).

    Every event is declared with the columns that its table has, nulls are not possible. ``cpu``
    decides about the stream (null: 0), ``discarded_events`` is what the tracer claims to have
    dropped on the first. Returns ``folder``.
    """
    folder, names = Path(folder), process_names or {}
    for part in ("ust/uid/1000/64-bit", "kernel"):
        in_kernel = part == "kernel"
        chosen = {name: t for name, t in tables.items() if (name in _KERNEL) == in_kernel}
        if not chosen:
            continue
        kinds = {
            _full_name(name): {
                column: _kind(kind, gid_length)
                for column, kind in frame.schema.items()
                if column not in events.COMMON_COLUMNS
            }
            for name, frame in chosen.items()
        }
        context = {"vpid": "s32", "vtid": "s32", "procname": f"char[{_CHARACTERS + 1}]"}
        if in_kernel:
            context = {"pid": "s32", "tid": "s32"}
        text = lttng_metadata(kinds, context, kernel=in_kernel, offset=clock_offset_ns, host=host)
        records: dict[int, list[EventRecord]] = {}
        for name, frame in chosen.items():
            for row in frame.iter_rows(named=True):
                time, pid, tid, cpu = (row.pop(column, None) for column in events.COMMON_COLUMNS)
                process = names.get(pid, f"process_{pid}")[:_CHARACTERS]
                about = {"vpid": pid, "vtid": tid, "procname": process, "pid": pid, "tid": tid}
                record = EventRecord(_full_name(name), time, row, about)
                records.setdefault(cpu or 0, []).append(record)
        declared, streams = parse_tsdl(text), {}
        for cpu, of_core in sorted(records.items()):
            of_core.sort(key=lambda record: record.time)
            dropped = discarded_events if not in_kernel and cpu == min(records) else 0
            streams[f"channel_{cpu}"] = [
                encode_packet(
                    declared,
                    of_core[start : start + _PACKET_EVENTS],
                    {"cpu_id": cpu, "packet_seq_num": number, "events_discarded": dropped},
                    instance=cpu,
                )
                for number, start in enumerate(range(0, len(of_core), _PACKET_EVENTS))
            ]
        write_trace(folder / part, text, streams)
    return folder


def _full_name(name: str) -> str:
    if name in _KERNEL:
        return name
    return f"ros2_caret:{name}" if name in _CARET else f"ros2:{name}"


def _kind(kind: pl.DataType, gid_length: int) -> str:
    if isinstance(kind, pl.List):
        return f"u8[{gid_length}]"
    return {pl.UInt64(): "x64", pl.Int64(): "s64", pl.Int32(): "s32", pl.String(): "string"}[kind]
