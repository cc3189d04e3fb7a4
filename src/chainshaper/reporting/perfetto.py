"""A recording as a trace that ui.perfetto.dev opens.

The trace has the threads of every process with their callbacks; each publication as an
instant, with an arrow to the callback that took the message; and the sends of asynchronous
publishers' threads. Further rows have the traversals of the chain with their hops, the messages
that the gate held back, the slots of the servers, and stalls of the machine. Times are ns of the
event clock.

A trace is a sequence of packets in protobuf's encoding; each packet describes a track, or an event
of a track. Slices of one track must nest. A track whose slices overlap partly is written as several
tracks of one name, which the viewer shows as one. Numbers of fields and enumerations are those of
`protos/perfetto/trace/` (perfetto.dev, "Advanced Guide to Programmatic Trace Generation").
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import TypeAlias

import polars as pl

from chainshaper.analysis import DataFlow, LatencyAnalysis, graph_of, recorded_flow
from chainshaper.reporting.timeline import Timeline, timeline_of
from chainshaper.values import events
from chainshaper.values.errors import shown
from chainshaper.values.files import new_file, write_whole
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import PARTS, Measurement

ENDINGS = (".pftrace", ".perfetto-trace")

BEGIN, END, INSTANT = 1, 2, 3  # TrackEvent.Type
REALTIME, TRACE_TIME = 1, 6  # BuiltinClock; time stamps without a clock's number are TRACE_TIME
EXPLICIT = 3  # TrackDescriptor.ChildTracksOrdering: by rank
VARINT, FIXED64, LENGTH = 0, 1, 2  # protobuf's wire types
SEQUENCE = 1  # number of the only writer

Value: TypeAlias = str | int | bool | None
Thread: TypeAlias = tuple[int, int]


@dataclass(frozen=True)
class Slice:
    """A span of a track, or an instant."""

    start: int  # ns
    end: int | None  # ns; None: it is an instant
    name: str
    arguments: Mapping[str, Value] = field(default_factory=dict)  # None is not written
    flows: Sequence[int] = ()  # numbers of the arrows that begin here
    ends_flows: Sequence[int] = ()  # numbers of the arrows that end here

    @property
    def last(self) -> int:
        """Its last instant (ns)."""
        return self.start if self.end is None else self.end


@dataclass(frozen=True)
class Track:
    """A row of the viewer: a thread of a process, or a row of another group."""

    owner: str  # name of the process or group
    name: str
    families: Sequence[Sequence[Slice]]  # each a slice and those that lie within it
    thread: Thread | None = None  # its pid and tid


def export_perfetto(source: Recording | Measurement, path: str | Path) -> Path:
    """Write a recording for Perfetto; a measurement also has its chain, and the plan in force.

    Raises InputError: the path exists already, or ends in none of :data:`ENDINGS`. OperationError:
    it cannot be written; nothing is left behind.
    """
    path = new_file(path, ENDINGS)
    analysis, plan = None, None
    recording = source.recording if isinstance(source, Measurement) else source
    if isinstance(source, Measurement):
        analysis, plan = source.analysis, source.plan
    flow = recorded_flow(recording)
    timeline = timeline_of(recording, flow, analysis, plan)
    tracks = _thread_tracks(recording, flow, timeline)
    if analysis is not None:
        tracks += [_chain_track(analysis), *_gate_tracks(analysis, timeline)]
    for (server,), rows in timeline.slots.group_by("server", maintain_order=True):
        slots = [
            [Slice(start, end, f"slot {slot + 1}", {"cycle": traversal})]
            for traversal, _, slot, start, end in rows.iter_rows()
        ]
        tracks.append(Track("Servers", str(server), slots))
    for (core,), rows in timeline.stalls.group_by("core", maintain_order=True):
        stalls = [[Slice(start, end, "stall")] for _, start, end in rows.iter_rows()]
        where = "all cores" if core is None else f"core {core}"
        tracks.append(Track("Stalls of the machine", where, stalls))
    return write_whole(path, encode_trace(tracks, recording.info.clock_offset_ns))


def _thread_tracks(recording: Recording, flow: DataFlow, timeline: Timeline) -> list[Track]:
    """Make a track for each thread, the chain's nodes first."""
    rows = defaultdict[Thread, list[list[Slice]]](list)
    for thread, event in chain(_callbacks(flow, timeline), _messages(flow)):
        rows[thread].append([event])
    known = timeline.threads.select("pid", "tid", "nodes", "about").iter_rows()
    nodes = {(pid, tid): (names, about) for pid, tid, names, about in known}
    comms = {(thread.pid, thread.tid): thread.comm for thread in recording.info.threads}
    tracks = []
    for thread in [*(t for t in nodes if t in rows), *sorted(rows.keys() - nodes.keys())]:
        name, about = nodes.get(thread, (comms.get(thread, f"thread {thread[1]}"), None))
        owner = recording.info.processes.get(thread[0], name)
        title = f"{name} ({about})" if about else name
        tracks.append(Track(owner, title, rows[thread], thread))
    return tracks


def _arrows(flow: DataFlow, end: str) -> dict[int, list[int]]:
    """Map each ``publication``, or ``instance`` that reads (``end``), to numbers of its arrows."""
    taken = flow.takes.drop_nulls(["publication", end]).group_by(end).agg(pl.col("take") + 1)
    return dict(taken.iter_rows())


def _callbacks(flow: DataFlow, timeline: Timeline) -> Iterator[tuple[Thread, Slice]]:
    """Yield a slice for each callback instance, with its thread."""
    callbacks = {callback.id: callback for callback in graph_of(flow).callbacks}
    arrows = _arrows(flow, "instance")
    columns = ("pid", "tid", "callback_id", "instance", "start", "end", "ended", "execution_ns")
    rows = timeline.slices.select(columns).iter_rows()
    for pid, tid, number, instance, start, end, ended, used in rows:
        callback, arrived = callbacks[number], arrows.get(instance, ())
        arguments = {"function": callback.symbol, "instance": instance, "execution_ns": used}
        arguments["end"] = None if ended else "not recorded"
        yield (pid, tid), Slice(start, end, callback.label, arguments, ends_flows=arrived)


def _messages(flow: DataFlow) -> Iterator[tuple[Thread, Slice]]:
    """Yield slices, with their threads, for publications, takes and sends.

    Only takes whose message no callback got: there the arrow ends at the take.
    """
    arrows = _arrows(flow, "publication")
    columns = ("pid", "tid", "time", "topic", "publication", "source_timestamp")
    for pid, tid, time, topic, number, stamp in flow.publications.select(columns).iter_rows():
        flows = arrows.get(number, ())
        arguments = {"publication": number, "source_timestamp": stamp, "taken_by": len(flows)}
        yield (pid, tid), Slice(time, None, f"publish {topic}", arguments, flows=flows)
    unread = flow.takes.drop_nulls("publication").filter(pl.col("instance").is_null())
    for pid, tid, time, topic, take in unread.select(*columns[:4], "take").iter_rows():
        yield (pid, tid), Slice(time, None, f"take {topic}", ends_flows=[take + 1])
    for row in events.table(flow.events, "asynchronous_send").iter_rows(named=True):
        end, about = row["time"] + (row["duration"] or 0), {"source_timestamp": row["timestamp"]}
        yield (row["pid"], row["tid"]), Slice(row["time"], end, row["outcome"], about)


def _chain_track(analysis: LatencyAnalysis) -> Track:
    """Make the track of traversals, with their hops inside; incomplete ones are instants."""
    path, hops = analysis.graph.path(analysis.chain), defaultdict[int, list[Slice]](list)
    for row in analysis.hops.drop_nulls("publish").sort("traversal", "hop").iter_rows(named=True):
        name = f"{path[row['hop']].node} → {row['topic']}"
        arguments = {f"{part}_ns": row[f"{part}_ns"] for part in PARTS} | {"via": row["via"]}
        hops[row["traversal"]].append(Slice(row["start"], row["publish"], name, arguments))
    families = []
    for row in analysis.traversals.iter_rows(named=True):
        name, start, end = f"cycle {row['traversal']}", row["start"], row["end"]
        if row["complete"]:
            arguments = {key: row[key] for key in ("latency_ns", "disturbed", "reception_ns")}
            families.append([Slice(start, end, name, arguments), *hops[row["traversal"]]])
        else:
            about = {"topic": row["broken_at"]}
            families.append([Slice(start, None, f"{name} incomplete: {row['reason']}", about)])
    return Track("Chain", analysis.chain.spec, families)


def _gate_tracks(analysis: LatencyAnalysis, timeline: Timeline) -> Iterator[Track]:
    """Yield a track for each shaping node: its messages from their arrival until it let them go."""
    path = analysis.graph.path(analysis.chain)
    for (hop,), rows in timeline.holds.group_by("hop", maintain_order=True):
        families = []
        for row in rows.iter_rows(named=True):
            late = None if row["release"] is None else row["let_go"] - row["release"]
            arguments = {"cycle": row["traversal"], "slot": row["slot"], "planned": row["release"]}
            arguments |= {"behind_plan_ns": late, "overrun": row["overrun"]}
            name = "in the gate" if row["overrun"] is None else f"overran: {row['overrun']}"
            families.append([Slice(row["arrival"], row["let_go"], name, arguments)])
        yield Track("Gate", path[hop].node, families)


def encode_trace(tracks: Sequence[Track], clock_offset_ns: int) -> Iterator[bytes]:
    """Yield the packets of the file; ``clock_offset_ns`` is CLOCK_REALTIME less the event clock."""
    first = min(
        (event.start for track in tracks for family in track.families for event in family),
        default=0,
    )
    readings = ((TRACE_TIME, first), (REALTIME, first + clock_offset_ns))
    clocks = (_message(1, _integer(1, clock) + _integer(2, time)) for clock, time in readings)
    yield _packet(_message(6, b"".join(clocks)))
    owners: dict[str | int, int] = {}
    uuid = 0
    for rank, track in enumerate(tracks):
        key = track.owner if track.thread is None else track.thread[0]
        if key not in owners:
            uuid += 1
            owners[key] = uuid
            about = _text(2, track.owner) + _integer(11, EXPLICIT)
            if track.thread is not None:
                about = _message(3, _integer(1, track.thread[0]) + _text(6, track.owner))
            yield _packet(_message(60, _integer(1, uuid) + about))
        about = _text(2, track.name) + _integer(12, rank)
        for number, lane in enumerate(_lanes(track.families)):
            uuid += 1
            row = about
            if track.thread is not None and number == 0:  # a thread has one track of its own
                pid, tid = track.thread
                row = _message(4, _integer(1, pid) + _integer(2, tid) + _text(5, track.name))
            yield _packet(_message(60, _integer(1, uuid) + _integer(5, owners[key]) + row))
            yield from _events(uuid, lane)


def _lanes(families: Sequence[Sequence[Slice]]) -> list[list[Slice]]:
    """Distribute families over as few lanes as possible, so that none in a lane overlap partly."""
    # Each lane with the ends of its open slices, outermost first.
    lanes: list[tuple[list[Slice], list[int]]] = []
    for family in sorted(families, key=lambda f: (f[0].start, -f[0].last)):
        start, end = family[0].start, family[0].last
        for _, ends in lanes:
            while ends and ends[-1] <= start:
                ends.pop()
        fitting = (
            candidate
            for candidate in lanes
            if not candidate[1] or (end <= candidate[1][-1] and len(family) == 1)
        )
        if (lane := next(fitting, None)) is None:
            lanes.append(lane := ([], []))
        lane[0].extend(family)
        lane[1].append(end)
    return [slices for slices, _ in lanes] or [[]]


def _events(uuid: int, lane: list[Slice]) -> Iterator[bytes]:
    """Yield the events of a track in order of time: the slice that begins last ends first."""
    open_until: list[int] = []
    end = _message(11, _integer(9, END) + _integer(11, uuid))
    for event in sorted(lane, key=lambda s: (s.start, -s.last)):
        while open_until and open_until[-1] <= event.start:
            yield _packet(_integer(8, open_until.pop()) + end)
        if event.end is not None:
            open_until.append(event.end)
        begin = [_integer(9, INSTANT if event.end is None else BEGIN), _integer(11, uuid)]
        begin.append(_text(23, event.name))
        begin += [_argument(*item) for item in event.arguments.items() if item[1] is not None]
        for number, flows in ((47, event.flows), (48, event.ends_flows)):
            begin += [_varint(number << 3 | FIXED64) + flow.to_bytes(8, "little") for flow in flows]
        yield _packet(_integer(8, event.start) + _message(11, b"".join(begin)))
    while open_until:
        yield _packet(_integer(8, open_until.pop()) + end)


def _argument(name: str, value: Value) -> bytes:
    """Encode an argument of a slice."""
    if isinstance(value, str):
        return _message(4, _text(10, name) + _text(6, value))
    return _message(4, _text(10, name) + _integer(2 if isinstance(value, bool) else 4, value or 0))


def _packet(content: bytes) -> bytes:
    return _message(1, content + _integer(10, SEQUENCE))


def _message(number: int, content: bytes) -> bytes:
    return _varint(number << 3 | LENGTH) + _varint(len(content)) + content


@lru_cache(maxsize=4096)  # most names come often
def _text(number: int, value: str) -> bytes:
    """Encode a text, with control characters made visible: it may be a name from a trace."""
    return _message(number, shown(value).encode("utf-8", errors="replace"))


def _integer(number: int, value: int) -> bytes:
    return _varint(number << 3 | VARINT) + _varint(value & 0xFFFF_FFFF_FFFF_FFFF)


def _varint(value: int) -> bytes:
    """Encode a number with seven bits a byte, the lowest first; bit eight: more bytes follow."""
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*encoded, value))
