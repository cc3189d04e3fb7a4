"""The trace for Perfetto holds what the recording holds, by the rules of the format.

The files are read here by a reader of protobuf's wire format that knows no message, and where
Perfetto's own Python package is installed also by its schema.
"""

import importlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from command_line import called, refused
from hypothesis import given
from hypothesis import strategies as st
from reference_traces import reference_folder
from told_run import LATENCY_NS, MS, PERIOD_NS, told_run

from chainshaper import data_flow, export_perfetto, measure_latency, open_source
from chainshaper.reporting.perfetto import Slice, Track, Value, encode_trace
from chainshaper.values.errors import OperationError
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import Measurement

BEGIN, END, INSTANT = 1, 2, 3

Fields = dict[int, list[Any]]


def _number(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def _fields(data: bytes) -> Fields:
    """A message's fields by number: integers, or bytes."""
    found: Fields = {}
    at = 0
    while at < len(data):
        key, at = _number(data, at)
        value: int | bytes
        if key & 7 == 0:
            value, at = _number(data, at)
        elif key & 7 == 1:
            value, at = int.from_bytes(data[at : at + 8], "little"), at + 8
        else:
            assert key & 7 == 2, "a wire type that the format does not use"
            length, at = _number(data, at)
            value, at = data[at : at + length], at + length
            assert len(value) == length
        found.setdefault(key >> 3, []).append(value)
    return found


@dataclass
class _Trace:
    """What a file says, in the order in which it says it."""

    tracks: dict[int, Fields] = field(default_factory=dict)
    events: list[tuple[int, int, int, str, Fields]] = field(default_factory=list)

    @classmethod
    def of(cls, parts: Iterator[bytes] | bytes) -> "_Trace":
        trace = cls()
        data = parts if isinstance(parts, bytes) else b"".join(parts)
        for content in _fields(data)[1]:
            packet = _fields(content)
            if 60 in packet:
                described = _fields(packet[60][0])
                assert described[1][0] not in trace.tracks
                assert described.get(5, [None])[0] in {None, *trace.tracks}, "a parent comes first"
                trace.tracks[described[1][0]] = described
            elif 11 in packet:
                event = _fields(packet[11][0])
                name = event.get(23, [b""])[0].decode()
                trace.events.append((event[11][0], packet[8][0], event[9][0], name, event))
        return trace

    def name(self, track: int) -> str:
        """Of a track; of a thread with its process's number."""
        described = self.tracks[track]
        if 4 in described:
            thread = _fields(described[4][0])
            return f"{thread[1][0]} {thread[5][0].decode()}"
        return str(described[2][0].decode()) if 2 in described else ""

    def group(self, track: int) -> str:
        """The name of a track's parent, empty for a process."""
        return self.name(self.tracks[track][5][0])

    def slices(self, group: str) -> list[tuple[str, int, int, int]]:
        """``name, start, end, track`` of a group's slices; every track nests, in order of time."""
        found = []
        for track, described in self.tracks.items():
            if 5 not in described or self.group(track) != group:
                continue
            stack: list[tuple[str, int]] = []
            last = 0
            for _, time, kind, name, _ in (one for one in self.events if one[0] == track):
                assert time >= last, "times ascend on a track"
                last = time
                if kind == BEGIN:
                    stack.append((name, time))
                elif kind == END:
                    begun, start = stack.pop()
                    found.append((begun, start, time, track))
            assert not stack, "every beginning has its end"
        return sorted(found, key=lambda one: (one[1], -one[2]))

    def instants(self, name: str) -> int:
        return sum(kind == INSTANT and name in text for _, _, kind, text, _ in self.events)

    def flows(self) -> tuple[Counter[int], Counter[int]]:
        """How often each arrow begins and ends."""
        begun = Counter(flow for *_, event in self.events for flow in event.get(47, ()))
        ended = Counter(flow for *_, event in self.events for flow in event.get(48, ()))
        return begun, ended


def _exported(source: Recording | Measurement, folder: Path) -> _Trace:
    return _Trace.of(export_perfetto(source, folder / "trace.pftrace").read_bytes())


def test_a_run_known_by_hand_is_written_as_it_was(tmp_path: Path) -> None:
    trace = _exported(measure_latency(told_run(tmp_path / "told", cycles=2)), tmp_path)
    threads = [trace.name(track) for track, one in trace.tracks.items() if 4 in one]
    assert threads == [
        "1 /first",
        "2 /second (SCHED_FIFO 80, core 1)",
        "3 /chainshaper_t2",
        "4 /actuator",
    ]
    chain = [(name, start, end) for name, start, end, _ in trace.slices("Chain")]
    assert chain[:4] == [
        ("cycle 0", MS, MS + LATENCY_NS),
        ("/first → /t1", MS, 5 * MS),
        ("/second → /t2_tmp", 6 * MS, 16 * MS),
        ("/chainshaper_t2 → /t2", 17 * MS, MS + LATENCY_NS),
    ]
    assert [one[:3] for one in trace.slices("Gate")] == [
        ("held", 17 * MS, MS + LATENCY_NS),
        ("held", PERIOD_NS + 17 * MS, PERIOD_NS + MS + LATENCY_NS),
    ]
    slots = {(trace.name(track), start) for _, start, _, track in trace.slices("Servers")}
    assert slots == {
        ("chain", MS),
        ("output", 31 * MS),
        ("chain", PERIOD_NS + MS),
        ("output", PERIOD_NS + 31 * MS),
    }
    (stall,) = trace.slices("Stalls of the machine")
    assert stall[:3] == ("stall", PERIOD_NS + 7 * MS, PERIOD_NS + 9 * MS)
    assert trace.name(stall[3]) == "core 1"


def _same_counts(recording: Recording, trace: _Trace) -> None:
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    own = [track for track, one in trace.tracks.items() if 4 in one]
    callbacks = sum(kind == BEGIN and track in own for track, _, kind, _, _ in trace.events)
    assert callbacks == flow.instances.height
    assert trace.instants("publish ") == flow.publications.height
    taken = flow.takes["publication"].drop_nulls()
    begun, ended = trace.flows()
    assert set(begun.values()) | set(ended.values()) <= {1}, "an arrow has one begin and one end"
    assert begun.keys() == ended.keys()
    assert len(begun) == len(taken)


def test_arrows_lead_from_publications_to_the_callbacks_that_read_them(tmp_path: Path) -> None:
    recording = told_run(tmp_path / "told", cycles=1)
    trace = _exported(recording, tmp_path)
    arrows: dict[int, list[tuple[str, int, str]]] = {}
    for track, time, _, name, event in sorted(trace.events, key=lambda event: event[1]):
        for flow in [*event.get(47, ()), *event.get(48, ())]:
            arrows.setdefault(flow, []).append((trace.name(track)[2:9], time, name))
    assert list(arrows.values()) == [
        [("/first", 5 * MS, "publish /t1"), ("/second", 6 * MS, "/second ← /t1")],
        [
            ("/second", 16 * MS, "publish /t2_tmp"),
            ("/chains", 17 * MS, "/chainshaper_t2 ← /t2_tmp"),
        ],
        [
            ("/chains", MS + LATENCY_NS, "publish /t2"),
            ("/actuat", 2 * MS + LATENCY_NS, "/actuator ← /t2"),
        ],
    ]


def test_a_live_run_loses_nothing_on_the_way(shaped: Recording, tmp_path: Path) -> None:
    measured = measure_latency(shaped)
    trace = _exported(measured, tmp_path)
    _same_counts(shaped, trace)
    complete = measured.analysis.traversals.filter("complete")
    cycles = [one for one in trace.slices("Chain") if one[0].startswith("cycle")]
    latencies = [end - start for _, start, end, _ in cycles]
    assert latencies == complete["latency_ns"].to_list()
    stalls = trace.slices("Stalls of the machine")
    assert len(stalls) == shaped.events["machine_stall"].height


@pytest.mark.parametrize("name", ["jazzy_chain_fastrtps_async", "humble_sync"])
def test_real_traces_lose_nothing_on_the_way(name: str, tmp_path: Path) -> None:
    recording = open_source(reference_folder(name) / "trace")
    _same_counts(recording, _exported(recording, tmp_path))


def test_incomplete_cycles_are_marked_where_they_began(tmp_path: Path) -> None:
    trace = _exported(measure_latency(told_run(tmp_path / "told", untaken=(1,))), tmp_path)
    marks = [(time, name) for _, time, kind, name, _ in trace.events if kind == INSTANT]
    assert (PERIOD_NS + MS, "cycle 1 incomplete: lost") in marks


intervals = st.lists(
    st.tuples(st.integers(0, 50), st.integers(0, 30)).map(lambda pair: (pair[0], sum(pair))),
    max_size=30,
)


@given(intervals)
def test_slices_nest_on_every_track_whatever_they_overlap(spans: Sequence[tuple[int, int]]) -> None:
    families = [[Slice(start, end, f"{n}")] for n, (start, end) in enumerate(spans)]
    trace = _Trace.of(encode_trace([Track("group", "row", families)], 0))
    read = trace.slices("group")
    assert sorted((start, end) for _, start, end, _ in read) == sorted(spans)
    assert {trace.name(track) for *_, track in read} <= {"row"}, "the viewer shows them as one row"


@given(st.text(), st.integers(-(2**63), 2**63 - 1), st.booleans())
def test_names_and_arguments_arrive_as_they_are(name: str, number: int, truth: bool) -> None:
    name = name.encode("utf-8", errors="replace").decode()
    arguments: dict[str, Value] = {"number": number, "truth": truth, "text": name, "nothing": None}
    one = Slice(1, 2, name, arguments)
    trace = _Trace.of(encode_trace([Track("group", name, [[one]])], 0))
    (event,) = (event for *_, kind, _, event in trace.events if kind == BEGIN)
    told = [_fields(argument) for argument in event[4]]
    assert event[23] == [name.encode()]
    assert [one[10][0] for one in told] == [b"number", b"truth", b"text"]
    assert told[0][4] == [number % 2**64]
    assert told[1][2] == [truth]
    assert told[2][6] == [name.encode()]


def test_perfettos_own_schema_reads_it(tmp_path: Path) -> None:
    module = "perfetto.protos.perfetto.trace.perfetto_trace_pb2"
    pytest.importorskip(module, reason="Perfetto's Python package is not installed")
    schema = importlib.import_module(module)
    recording = told_run(tmp_path / "told", cycles=2)
    data = export_perfetto(measure_latency(recording), tmp_path / "t.pftrace").read_bytes()
    trace = schema.Trace.FromString(data)
    trace.DiscardUnknownFields()
    assert trace.ByteSize() == len(data), "some field is none of the schema's"
    own = _Trace.of(data)
    events = [packet for packet in trace.packet if packet.HasField("track_event")]
    told = [
        (
            packet.track_event.track_uuid,
            packet.timestamp,
            packet.track_event.type,
            packet.track_event.name,
        )
        for packet in events
    ]
    assert told == [event[:4] for event in own.events]
    threads = {
        packet.track_descriptor.thread.tid: packet.track_descriptor.thread.thread_name
        for packet in trace.packet
        if packet.track_descriptor.HasField("thread")
    }
    assert threads[1] == "/first"
    arguments = {
        one.name: one.int_value
        for one in next(
            packet.track_event.debug_annotations
            for packet in events
            if packet.track_event.name == "cycle 0"
        )
    }
    assert arguments["latency_ns"] == LATENCY_NS
    clocks = {clock.clock_id: clock.timestamp for clock in trace.packet[0].clock_snapshot.clocks}
    builtin = schema.BuiltinClock.Value
    wall = clocks[builtin("BUILTIN_CLOCK_REALTIME")] - clocks[builtin("BUILTIN_CLOCK_BOOTTIME")]
    assert wall == recording.info.clock_offset_ns


def test_the_command_writes_it_and_never_over_another(tmp_path: Path) -> None:
    told = told_run(tmp_path / "told")
    file = tmp_path / "trace.pftrace"
    finished = called("export", "--perfetto", told.path, "-o", file)
    assert (finished.code, finished.out) == (0, f"{file}\n")
    written = file.read_bytes()
    assert [name for name, *_ in _Trace.of(written).slices("Chain") if "cycle" in name]
    again = refused(2, "export", "--perfetto", told.path, "-o", file)
    assert "exists already and is not overwritten" in again
    assert file.read_bytes() == written
    assert "add --perfetto" in refused(2, "export", told.path, "-o", tmp_path / "x.pftrace")
    wrong = refused(2, "export", "--perfetto", told.path, "-o", tmp_path / "trace.json")
    assert "ends in .pftrace or .perfetto-trace" in wrong
    absent = refused(2, "export", "--perfetto", told.path, "-o", tmp_path / "no" / "t.pftrace")
    assert "no such folder to write t.pftrace into" in absent


def test_a_recording_without_a_chain_is_exported_without_one(tmp_path: Path) -> None:
    told = told_run(tmp_path / "told", chain=None)
    finished = called("export", "--perfetto", told.path, "-o", tmp_path / "t.pftrace")
    assert finished.code == 0
    trace = _Trace.of((tmp_path / "t.pftrace").read_bytes())
    assert trace.slices("Chain") == []
    _same_counts(told, trace)


def test_a_trace_on_a_full_disk_leaves_nothing(tmp_path: Path, full_disk: Path) -> None:
    path = full_disk / "trace.pftrace"
    with pytest.raises(OperationError, match=f"{path}: the file cannot be written.*No space"):
        export_perfetto(told_run(tmp_path / "told"), path)
    assert not [file for file in full_disk.iterdir() if "trace" in file.name]
