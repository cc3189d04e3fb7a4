"""The trace for Perfetto holds what the recording holds, read by Perfetto's own schema."""

import importlib
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from command_line import called, refused
from hypothesis import given
from hypothesis import strategies as st
from known_run import LATENCY_NS, MS, PERIOD_NS, known_run
from reference_traces import reference_folder

from chainshaper import data_flow, export_perfetto, measure_latency, open_source
from chainshaper.reporting.perfetto import Slice, Track, Value, encode_trace
from chainshaper.values.errors import shown
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import Measurement

BEGIN, END, INSTANT = 1, 2, 3
SCHEMA: Any = importlib.import_module("perfetto.protos.perfetto.trace.perfetto_trace_pb2")


class _Trace:
    """What a file says: descriptors of tracks, ``track, time, type, name, event`` in order."""

    def __init__(self, parts: Iterator[bytes] | bytes) -> None:
        data = parts if isinstance(parts, bytes) else b"".join(parts)
        self.whole = SCHEMA.Trace.FromString(data)
        self.tracks: dict[int, Any] = {}
        self.events: list[tuple[int, int, int, str, Any]] = []
        for packet in self.whole.packet:
            one, event = packet.track_descriptor, packet.track_event
            if packet.HasField("track_descriptor"):
                assert one.uuid not in self.tracks
                assert not one.HasField("parent_uuid") or one.parent_uuid in self.tracks
                self.tracks[one.uuid] = one
            elif packet.HasField("track_event"):
                about = (event.track_uuid, packet.timestamp, event.type, event.name, event)
                self.events.append(about)
        self.whole.DiscardUnknownFields()
        assert self.whole.ByteSize() == len(data), "some field is none of the schema's"

    def name(self, track: int) -> str:
        """Of a track; of a thread with its process's number; empty for a process."""
        one = self.tracks[track]
        of_thread = f"{one.thread.pid} {one.thread.thread_name}"
        return of_thread if one.HasField("thread") else str(one.name)

    def threads(self) -> list[int]:
        return [track for track, one in self.tracks.items() if one.HasField("thread")]

    def slices(self, group: str) -> list[tuple[str, int, int, int]]:
        """``name, start, end, track`` of a group's slices; every track nests, in order of time."""
        found = []
        for track, one in self.tracks.items():
            if not one.HasField("parent_uuid") or self.name(one.parent_uuid) != group:
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

    def flows(self) -> tuple[Counter[int], Counter[int]]:
        """How often each arrow begins and ends."""
        begun = Counter(flow for *_, event in self.events for flow in event.flow_ids)
        ended = Counter(flow for *_, event in self.events for flow in event.terminating_flow_ids)
        return begun, ended


def _exported(source: Recording | Measurement, folder: Path) -> _Trace:
    return _Trace(export_perfetto(source, folder / "trace.pftrace").read_bytes())


def test_a_run_known_by_hand_is_written_as_it_was(tmp_path: Path) -> None:
    trace = _exported(measure_latency(known_run(tmp_path / "known", cycles=2)), tmp_path)
    names = ("1 /first", "2 /second (SCHED_FIFO 80, core 1)", "3 /chainshaper_t2", "4 /actuator")
    assert tuple(map(trace.name, trace.threads())) == names
    chain = [(name, start, end) for name, start, end, _ in trace.slices("Chain")]
    assert chain[:4] == [
        ("cycle 0", MS, MS + LATENCY_NS),
        ("/first → /t1", MS, 5 * MS),
        ("/second → /t2_tmp", 6 * MS, 16 * MS),
        ("/chainshaper_t2 → /t2", 17 * MS, MS + LATENCY_NS),
    ]
    assert [one[:3] for one in trace.slices("Gate")] == [
        ("in the gate", 17 * MS, MS + LATENCY_NS),
        ("in the gate", PERIOD_NS + 17 * MS, PERIOD_NS + MS + LATENCY_NS),
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
    own = trace.threads()
    callbacks = sum(kind == BEGIN and track in own for track, _, kind, _, _ in trace.events)
    assert callbacks == flow.instances.height
    published = [one for one in trace.events if one[2] == INSTANT and "publish " in one[3]]
    assert len(published) == flow.publications.height
    taken = flow.takes["publication"].drop_nulls()
    begun, ended = trace.flows()
    assert set(begun.values()) | set(ended.values()) <= {1}, "an arrow has one begin and one end"
    assert begun.keys() == ended.keys()
    assert len(begun) == len(taken)


def test_arrows_lead_from_publications_to_the_callbacks_that_read_them(tmp_path: Path) -> None:
    recording = known_run(tmp_path / "known", cycles=1)
    trace = _exported(recording, tmp_path)
    arrows: dict[int, list[tuple[str, int, str]]] = {}
    for track, time, _, name, event in sorted(trace.events, key=lambda event: event[1]):
        for flow in (*event.flow_ids, *event.terminating_flow_ids):
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


@pytest.mark.parametrize("name", ["jazzy_chain_fastrtps_async", "humble_sync"])
def test_real_traces_lose_nothing_on_the_way(name: str, tmp_path: Path) -> None:
    recording = open_source(reference_folder(name) / "trace")
    _same_counts(recording, _exported(recording, tmp_path))


def test_incomplete_cycles_are_marked_where_they_began(tmp_path: Path) -> None:
    recording = known_run(tmp_path / "known", untaken=(1,))
    trace = _exported(measure_latency(recording), tmp_path)
    marks = [(time, name) for _, time, kind, name, _ in trace.events if kind == INSTANT]
    assert (PERIOD_NS + MS, "cycle 1 incomplete: lost") in marks
    (cycle,) = (event for *_, name, event in trace.events if name == "cycle 0")
    values = {one.name: one.int_value for one in cycle.debug_annotations}
    assert values["latency_ns"] == LATENCY_NS
    snapshot = trace.whole.packet[0].clock_snapshot.clocks
    clocks = {clock.clock_id: clock.timestamp for clock in snapshot}
    builtin = SCHEMA.BuiltinClock.Value
    wall = clocks[builtin("BUILTIN_CLOCK_REALTIME")] - clocks[builtin("BUILTIN_CLOCK_BOOTTIME")]
    assert wall == recording.info.clock_offset_ns


intervals = st.lists(
    st.tuples(st.integers(0, 50), st.integers(0, 30)).map(lambda pair: (pair[0], sum(pair))),
    max_size=30,
)


@given(intervals)
def test_slices_nest_on_every_track_whatever_they_overlap(spans: Sequence[tuple[int, int]]) -> None:
    families = [[Slice(start, end, f"{n}")] for n, (start, end) in enumerate(spans)]
    trace = _Trace(encode_trace([Track("group", "row", families)], 0))
    read = trace.slices("group")
    assert sorted((start, end) for _, start, end, _ in read) == sorted(spans)
    assert {trace.name(track) for *_, track in read} <= {"row"}, "the viewer shows them as one row"


@given(st.text(), st.integers(-(2**63), 2**63 - 1), st.booleans())
def test_names_and_arguments_arrive_as_they_are(name: str, number: int, truth: bool) -> None:
    name = shown(name)
    arguments: dict[str, Value] = {"number": number, "truth": truth, "text": name, "nothing": None}
    one = Slice(1, 2, name, arguments)
    trace = _Trace(encode_trace([Track("group", name, [[one]])], 0))
    (event,) = (event for *_, kind, _, event in trace.events if kind == BEGIN)
    assert event.name == name
    first, second, third = event.debug_annotations
    assert (first.name, first.int_value) == ("number", number)
    assert (second.name, second.bool_value) == ("truth", truth)
    assert (third.name, third.string_value) == ("text", name)


def test_the_command_writes_it_and_never_over_another(tmp_path: Path) -> None:
    known, file = known_run(tmp_path / "known"), tmp_path / "trace.pftrace"
    finished = called("export", "--perfetto", known.path, "-o", file)
    assert (finished.code, finished.out) == (0, f"{file}\n")
    written = file.read_bytes()
    assert [name for name, *_ in _Trace(written).slices("Chain") if "cycle" in name]
    for words, output, said in (
        (["--perfetto"], "trace.pftrace", "exists already and is not overwritten"),
        ([], "x.pftrace", "add --perfetto"),
        (["--perfetto"], "trace.json", "ends in .pftrace or .perfetto-trace"),
        (["--perfetto"], "no/t.pftrace", "no such folder to write t.pftrace into"),
    ):
        assert said in refused(2, "export", *words, known.path, "-o", tmp_path / output)
    assert file.read_bytes() == written


def test_mcap_has_every_callback_and_every_cycle(tmp_path: Path) -> None:
    """Read with the format's own reader, for which log times are those of a bag."""
    reader = pytest.importorskip("mcap.reader")
    recording, file = known_run(tmp_path / "known", untaken=(1,)), tmp_path / "known.mcap"
    written = called("export", "--mcap", recording.path, "-o", file)
    assert (written.code, written.out) == (0, f"{file}\n"), written.err
    with file.open("rb") as stream:
        found = [
            (channel.topic, message.log_time, message.publish_time, json.loads(message.data))
            for _, channel, message in reader.make_reader(stream).iter_messages()
        ]
    cycles = [one for one in found if one[0] == "/chainshaper/latency"]
    traversals = measure_latency(recording).analysis.traversals
    offset = recording.info.clock_offset_ns
    assert [(when, one.get("latency_ms"), one.get("incomplete")) for *_, when, one in cycles] == [
        (start + offset, latency and latency / 1e6, reason)
        for start, latency, reason in traversals.sort(pl.max_horizontal("start", "end"))
        .select("start", "latency_ns", "reason")
        .iter_rows()
    ]
    instances = data_flow(recording.events, offset).instances.drop_nulls("end")
    assert len(found) - len(cycles) == instances.height
    assert sorted(message["response_ms"] for *_, message in found if "response_ms" in message) == [
        response / 1e6 for response in sorted(instances["end"] - instances["start"])
    ]
    assert "add --perfetto or --mcap" in refused(2, "export", recording.path, "-o", file)
    perfetto = ("export", "--perfetto", recording.path, "-o", tmp_path / "t.pftrace")
    assert "add --mcap" in refused(2, *perfetto, "--layout", tmp_path / "l.json")
    wrong = refused(2, "export", "--mcap", recording.path, "-o", tmp_path / "trace.json")
    assert "ends in .mcap" in wrong


def test_the_layout_for_foxglove_plots_what_the_file_has(tmp_path: Path) -> None:
    """Each panel stands in the layout once; each path is a topic and a field of its messages."""
    reader = pytest.importorskip("mcap.reader")
    known, file, layout = known_run(tmp_path / "known"), tmp_path / "a.mcap", tmp_path / "a.json"
    words = ("export", "--mcap", known.path, "-o", file, "--layout", layout)
    assert called(*words).code == 0
    fields = set[str]()
    with file.open("rb") as stream:
        for _, channel, message in reader.make_reader(stream).iter_messages():
            fields |= {f"{channel.topic}.{name}" for name in json.loads(message.data)}
    written = json.loads(layout.read_text())
    panels = written["configById"]
    paths = [path["value"] for panel in panels.values() for path in panel["paths"]]
    assert {*paths} <= fields
    numbers = {field for field in fields if field.endswith(("_ms", ".late"))}
    assert sorted(paths) == sorted(numbers), "all that can be plotted, once"

    def shown(node: str | dict[str, Any]) -> list[str]:
        return [node] if isinstance(node, str) else shown(node["first"]) + shown(node["second"])

    assert shown(written["layout"]) == [*panels]
    assert "is not overwritten" in refused(2, *words[:4], tmp_path / "b.mcap", *words[5:])
    assert not (tmp_path / "b.mcap").exists()


def test_a_recording_that_names_no_chain_is_exported_with_its_only_one(tmp_path: Path) -> None:
    known, file = known_run(tmp_path / "known", chain=None), tmp_path / "t.pftrace"
    assert called("export", "--perfetto", known.path, "-o", file).code == 0
    trace = _Trace(file.read_bytes())
    assert trace.slices("Chain")
    _same_counts(known, trace)


def test_a_trace_of_several_chains_is_exported_without_one(tmp_path: Path) -> None:
    several = reference_folder("galactic_caret_end_to_end") / "trace"
    assert called("export", "--perfetto", several, "-o", tmp_path / "t.pftrace").code == 0
    assert _Trace((tmp_path / "t.pftrace").read_bytes()).slices("Chain") == []
