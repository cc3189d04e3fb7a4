"""Perfetto's trace format, as far as tracks, slices, instants and flows need it.

A trace is a sequence of packets in protobuf's encoding; each packet describes a track, or tells an
event of one. Slices of one track must nest: a track whose slices overlap otherwise is written as
several of one name, which the viewer shows as one. Numbers of fields and enumerations are those of
`protos/perfetto/trace/` (perfetto.dev, "Advanced Guide to Programmatic Trace Generation").
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TypeAlias

__all__ = ["Slice", "Track", "Value", "encode_trace"]

Value: TypeAlias = str | int | bool | None

BEGIN, END, INSTANT = 1, 2, 3  # TrackEvent.Type
REALTIME, TRACE_TIME = 1, 6  # BuiltinClock; time stamps without a clock's number are of the second
EXPLICIT = 3  # TrackDescriptor.ChildTracksOrdering: by rank
VARINT, FIXED64, LENGTH = 0, 1, 2  # protobuf's wire types
SEQUENCE = 1  # one writer wrote all of it


@dataclass(frozen=True)
class Slice:
    """What lasted from ``start`` to ``end`` (ns), or happened at ``start`` (``end`` None).

    ``flows`` are the numbers of arrows that begin here, ``ends_flows`` of those that end here.
    Arguments that are None are not written.
    """

    start: int
    end: int | None
    name: str
    arguments: Mapping[str, Value] = field(default_factory=dict)
    flows: Sequence[int] = ()
    ends_flows: Sequence[int] = ()


@dataclass(frozen=True)
class Track:
    """One row: a thread (pid, tid) of a process, or a row of a named group beside them.

    ``owner`` is the process's or the group's name. ``slices`` are families: a slice and those
    that lie within it, which stay together.
    """

    owner: str
    name: str
    families: Sequence[Sequence[Slice]]
    thread: tuple[int, int] | None = None


def encode_trace(tracks: Sequence[Track], clock_offset_ns: int) -> Iterator[bytes]:
    """The file, packet by packet. ``clock_offset_ns`` leads to CLOCK_REALTIME."""
    first = min((one.start for track in tracks for f in track.families for one in f), default=0)
    yield _packet(_clocks(first, clock_offset_ns))
    owners: dict[str | int, int] = {}
    uuid = 0
    for rank, track in enumerate(tracks):
        key = track.owner if track.thread is None else track.thread[0]
        if key not in owners:
            uuid += 1
            owners[key] = uuid
            yield _packet(_message(60, _owner(uuid, track)))
        for number, lane in enumerate(_lanes(track.families)):
            uuid += 1
            as_thread = track.thread if number == 0 else None  # a thread has one track of its own
            yield _packet(_message(60, _row(uuid, owners[key], track.name, rank, as_thread)))
            yield from _events(uuid, lane)


def _lanes(families: Sequence[Sequence[Slice]]) -> list[list[Slice]]:
    """Families over as few lanes as they need so that those of a lane do not overlap partly."""
    lanes: list[list[Slice]] = []
    open_until: list[list[int]] = []  # per lane the ends of what is open, outermost first
    for family in sorted(families, key=lambda f: (f[0].start, -_end(f[0]))):
        start, end = family[0].start, _end(family[0])
        for ends in open_until:
            while ends and ends[-1] <= start:
                ends.pop()
        fits = (not ends or (end <= ends[-1] and len(family) == 1) for ends in open_until)
        number = next((number for number, fit in enumerate(fits) if fit), len(lanes))
        if number == len(lanes):
            lanes.append([])
            open_until.append([])
        lanes[number].extend(family)
        open_until[number].append(end)
    return lanes or [[]]


def _end(one: Slice) -> int:
    return one.start if one.end is None else one.end


def _events(uuid: int, lane: list[Slice]) -> Iterator[bytes]:
    """The events of one track in order of time: what begins last ends first."""
    open_until: list[int] = []
    end = _message(11, _integer(9, END) + _integer(11, uuid))
    for one in sorted(lane, key=lambda s: (s.start, -_end(s))):
        while open_until and open_until[-1] <= one.start:
            yield _packet(_integer(8, open_until.pop()) + end)
        if one.end is not None:
            open_until.append(one.end)
        yield _packet(_integer(8, one.start) + _message(11, _beginning(uuid, one)))
    while open_until:
        yield _packet(_integer(8, open_until.pop()) + end)


def _beginning(uuid: int, one: Slice) -> bytes:
    return b"".join(
        [
            _integer(9, INSTANT if one.end is None else BEGIN),
            _integer(11, uuid),
            _text(23, one.name),
            *(_argument(name, value) for name, value in one.arguments.items() if value is not None),
            *(_fixed64(47, flow) for flow in one.flows),
            *(_fixed64(48, flow) for flow in one.ends_flows),
        ]
    )


def _argument(name: str, value: Value) -> bytes:
    if isinstance(value, str):
        return _text_argument(name, value)
    return _message(4, _text(10, name) + _integer(2 if isinstance(value, bool) else 4, value or 0))


@lru_cache(maxsize=4096)
def _text_argument(name: str, value: str) -> bytes:
    return _message(4, _text(10, name) + _text(6, value))


def _owner(uuid: int, track: Track) -> bytes:
    if track.thread is None:
        return _integer(1, uuid) + _text(2, track.owner) + _integer(11, EXPLICIT)
    process = _integer(1, track.thread[0]) + _text(6, track.owner)
    return _integer(1, uuid) + _message(3, process)


def _row(uuid: int, owner: int, name: str, rank: int, thread: tuple[int, int] | None) -> bytes:
    described = _integer(1, uuid) + _integer(5, owner)
    if thread is None:
        return described + _text(2, name) + _integer(12, rank)
    pid, tid = thread
    return described + _message(4, _integer(1, pid) + _integer(2, tid) + _text(5, name))


def _clocks(now: int, offset: int) -> bytes:
    """The trace's clock and the wall clock at one instant."""
    readings = ((TRACE_TIME, now), (REALTIME, now + offset))
    return _message(
        6, b"".join(_message(1, _integer(1, clock) + _integer(2, time)) for clock, time in readings)
    )


def _packet(content: bytes) -> bytes:
    return _message(1, content + _integer(10, SEQUENCE))


def _message(number: int, content: bytes) -> bytes:
    return _varint(number << 3 | LENGTH) + _varint(len(content)) + content


@lru_cache(maxsize=4096)  # names come again and again
def _text(number: int, value: str) -> bytes:
    return _message(number, value.encode("utf-8", errors="replace"))


def _integer(number: int, value: int) -> bytes:
    return _varint(number << 3 | VARINT) + _varint(value & 0xFFFF_FFFF_FFFF_FFFF)


def _fixed64(number: int, value: int) -> bytes:
    return _varint(number << 3 | FIXED64) + value.to_bytes(8, "little")


def _varint(value: int) -> bytes:
    """Seven bits a byte, the lowest first; the eighth says that more follow."""
    if value <= 0x7F:
        return value.to_bytes(1, "little")
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)
