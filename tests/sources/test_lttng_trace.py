"""LTTng traces as recordings: stories written as a tracer would have, and opened again."""

import os
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from command_line import called, json_of, refused
from ctf_writing import EventRecord, lttng_metadata, write_lttng_trace, write_packet, write_trace
from reference import babeltrace
from story import OFFSET, Story

from chainshaper.analysis import analyse_latency, application_graph, callback_statistics, data_flow
from chainshaper.sources import open_source
from chainshaper.sources.system import NEXT_HOST
from chainshaper.values import events
from chainshaper.values.errors import InputError

START = 1 << 40  # a machine has been running for a while when its trace begins
SECOND = 1_000_000_000


def chain_story(cycles: int = 5, pid: int = 10, names: tuple[str, str] = ("a", "b")) -> Story:
    """Node a (timer, /x) → node b (/x, /y) in two processes; 300 ns from start to end."""
    story = Story()
    first, second = story.node(f"/{names[0]}", pid), story.node(f"/{names[1]}", pid + 1)
    timer = story.timer(first, period=1000, symbol="A::tick()")
    reader = story.subscription(second, "/x", symbol="B::on_x(int)")
    x, y = story.publisher(first, "/x"), story.publisher(second, "/y")
    for cycle in range(cycles):
        now = 1000 + 1000 * cycle
        story.runs(timer, now, now + 150, writes=((x, now + 100),))
        story.runs(reader, now + 200, now + 400, reads=now + 100, writes=((y, now + 300),))
    return story


def shifted(story: Story, by: int = START) -> dict[str, pl.DataFrame]:
    """The story's tables at times as tracers see them."""
    moved = ("timestamp", "source_timestamp", "source_stamp", "time")
    return {
        name: frame.with_columns(pl.col(c) + by for c in moved if c in frame.columns)
        for name, frame in story.tables().items()
    }


def written(folder: Path, story: Story, **options: Any) -> Path:
    return write_lttng_trace(folder, shifted(story), clock_offset_ns=OFFSET, **options)


def switch(story: Story, threads: Mapping[int, tuple[int, int]]) -> None:
    """Time → from which thread to which the core goes."""
    for time, (before, after) in threads.items():
        story.event("sched_switch", time, before, prev_comm=f"thread_{before}", prev_tid=before,
                    prev_prio=20, prev_state=0, next_comm=f"thread_{after}", next_tid=after,
                    next_prio=20)  # fmt: skip


def test_tables_come_back_as_they_were_written(tmp_path: Path) -> None:
    story = chain_story()
    recording = open_source(written(tmp_path / "trace", story))
    tables = shifted(story)
    assert set(recording.events) == set(tables)
    for name, frame in tables.items():
        table = recording.events[name]
        types = {**events.COMMON_COLUMNS, **events.FIELDS[name]}
        assert dict(table.schema) == {c: types[c] for c in table.columns}
        assert table.select(frame.columns).rows() == frame.rows()
    assert recording.info.source == "lttng"
    assert recording.info.clock_offset_ns == OFFSET
    assert recording.info.host == "example"
    assert recording.info.processes == {10: "/a", 11: "/b"}
    counts = Counter(name for name, *_ in babeltrace(tmp_path / "trace")["events"])
    assert json_of("info", tmp_path / "trace")["events"] == dict(sorted(counts.items()))
    latency = json_of("latency", tmp_path / "trace", "--chain", "/x../y", "--instances")
    assert (latency["count"], latency["incomplete"], latency["min_ns"], latency["max_ns"]) == (
        5,
        0,
        300,
        300,
    )
    assert latency["instances"][0]["start_ns"] == START + 1000 + OFFSET


def test_folders_of_processes_are_merged_by_time(tmp_path: Path) -> None:
    """Per-pid buffers: every process has a folder of its own, below one path or given apart."""
    tables = shifted(chain_story())
    for pid in (10, 11):
        of_process = {name: frame.filter(pid=pid) for name, frame in tables.items()}
        write_lttng_trace(tmp_path / "trace" / f"pid-{pid}", of_process, clock_offset_ns=OFFSET)
    together = open_source(tmp_path / "trace")
    apart = open_source(tmp_path / "trace" / "pid-10", tmp_path / "trace" / "pid-11")
    for recording in (together, apart):
        assert recording.events["callback_start"]["time"].is_sorted()
        assert analyse_latency(recording, "/x../y").statistics.count == 5


def test_execution_times_from_a_kernel_trace_beside_user_space(tmp_path: Path) -> None:
    """Node b's thread loses its core for 50 of the 200 ns of every instance."""
    story = chain_story(cycles=3)
    for now in (1000, 2000, 3000):
        threads = {now - 10: (0, 10), now + 160: (10, 11), now + 250: (11, 99)}
        switch(story, {**threads, now + 300: (99, 11), now + 410: (11, 0)})
    trace = written(tmp_path / "trace", story)
    assert (trace / "kernel" / "metadata").is_file()
    execution = {row["node"]: row["execution_ns"] for row in json_of("callbacks", trace)}
    assert execution == {
        "/a": {"min": 150, "mean": 150.0, "max": 150},
        "/b": {"min": 150, "mean": 150.0, "max": 150},
    }
    assert json_of("info", trace)["events"]["sched_switch"] == 15
    alone = open_source(trace / "ust")
    statistics = callback_statistics(data_flow(alone.events))
    assert statistics["execution_ns"].null_count() == 2
    (stream,) = (file for file in (trace / "kernel").iterdir() if file.name != "metadata")
    os.truncate(stream, stream.stat().st_size - 10)
    notes = open_source(trace).info.notes
    assert any(str(stream) in note for note in notes), "said though it is read late"


def test_what_the_tracer_dropped_is_in_every_result(tmp_path: Path) -> None:
    trace, recording = (
        written(tmp_path / "trace", chain_story(), discarded_events=7),
        tmp_path / "r",
    )
    lost = {"discarded_events": 7, "lost_packets": 0}
    said = "lost while recording: 7 discarded events"
    assert said in called("convert", trace, "-o", recording).err
    verbs = (("info",), ("graph",), ("chains",), ("latency", "--chain", "/x../y"))
    for verb, *options in verbs:
        assert json_of(verb, trace, *options)["lost"] == lost
        assert said in called(verb, trace, *options).out
    assert said in called("callbacks", trace, "--json").err, "its array has no place for it"
    assert "lost while recording" in called("compare", trace, trace, "--chain", "/x../y").out
    assert json_of("info", recording)["lost"] == lost
    said = refused(2, "graph", trace, "-o", tmp_path / "graph.jpeg")
    assert "ends in .svg or .png or .dot or .json" in said


def test_tracing_started_after_the_application(tmp_path: Path) -> None:
    tables = {
        name: frame
        for name, frame in shifted(chain_story()).items()
        if not name.endswith(("_init", "_added", "_register", "_link_node"))
    }
    trace = write_lttng_trace(tmp_path / "trace", tables, process_names={10: "node_a"})
    info = json_of("info", trace)
    assert info["processes"] == {"10": "node_a", "11": "process_11"}
    assert {row["kind"] for row in json_of("callbacks", trace)} == {"unknown"}
    assert "tracing started after the application" in called("callbacks", trace).err
    assert "tracing has to start before" in refused(2, "latency", trace, "--chain", "/x../y")


def test_carets_events_of_the_start_are_put_where_they_happened(tmp_path: Path) -> None:
    """CARET emits creation again when tracing begins, with the time at which it happened."""
    tables = shifted(chain_story())
    late = {
        name: frame.with_columns(
            init_timestamp=pl.col("time"), time=pl.lit(START + 100 * SECOND, dtype=pl.Int64)
        )
        if name.endswith(("_init", "_added", "_register", "_link_node"))
        else frame
        for name, frame in tables.items()
    }
    recording = open_source(write_lttng_trace(tmp_path / "trace", late))
    assert application_graph(recording.events).callbacks[0].node == "/a"
    assert recording.events["rcl_node_init"]["time"].to_list() == [START, START]
    assert analyse_latency(recording, "/x../y").statistics.count == 5


def test_traces_of_different_clocks_or_without_our_events_are_refused(tmp_path: Path) -> None:
    written(tmp_path / "traces" / "one", chain_story())
    text = lttng_metadata({"ros2:rcl_take": {"message": "x64"}})
    write_trace(tmp_path / "traces" / "two", text.replace("d499e0ca", "00000000"), {})
    with pytest.raises(InputError, match="are both of a host called"):
        open_source(tmp_path / "traces")
    one_event(tmp_path / "mine", "mine:callback_start", {"callback": "x64"}, {"callback": 1})
    assert len(open_source(tmp_path / "mine").events) == 0, "another provider's of the same name"
    assert json_of("info", tmp_path / "mine")["events"] == {"mine:callback_start": 1}
    said = refused(2, "convert", tmp_path / "mine", "-o", tmp_path / "recording")
    assert "no event in it is one that chainshaper knows" in said
    assert not (tmp_path / "recording").exists()


def one_event(folder: Path, name: str, kinds: dict[str, str], payload: dict[str, Any]) -> None:
    """A trace of a single event, of process 10."""
    text = lttng_metadata({name: kinds}, {"vpid": "s32", "vtid": "s32"})
    event = EventRecord(name, START, payload, {"vpid": 10, "vtid": 10})
    write_packet(folder, text, [event])


@pytest.mark.parametrize(
    ("event", "field", "damaged"),
    [
        ("rcl_publisher_init", "topic_name", "x64"),
        ("rcl_publisher_init", "publisher_handle", "string"),
        ("rcl_publisher_init", "node_handle", "u32[]"),
        ("rmw_publisher_init", "gid", "u32[]"),
    ],
)
def test_fields_of_another_kind_are_said_to_be_unknown(
    event: str, field: str, damaged: str, tmp_path: Path
) -> None:
    kinds = dict.fromkeys(events.FIELDS[event], "x64") | {"topic_name": "string", field: damaged}
    values: dict[str, Any] = {"x64": 7, "string": "seven", "u32[]": [7]}
    payload = {name: values[kind] for name, kind in kinds.items()}
    payload[f"_{field}_length"] = 1
    one_event(tmp_path / "trace", f"ros2:{event}", kinds, payload)
    said = called("graph", tmp_path / "trace")
    assert said.code == 0
    assert f"{event} has no usable field {field}" in said.err


def test_events_of_nobody_knows_which_thread_are_counted_and_left_out(tmp_path: Path) -> None:
    """LTTng without contexts; `ros2 trace` always asks for them."""
    text = lttng_metadata({"ros2:callback_start": {"callback": "x64"}}, {"procname": "char[17]"})
    event = EventRecord("ros2:callback_start", START, {"callback": 1}, {"procname": "node"})
    write_packet(tmp_path / "trace", text, [event, event])
    for verb in ("callbacks", "graph", "chains"):
        said = called(verb, tmp_path / "trace")
        assert said.code == 0
        assert "2 events say no process or thread and cannot be used" in said.err
        assert "--type=vpid --type=vtid" in said.err
    assert json_of("info", tmp_path / "trace")["events"] == {"ros2:callback_start": 2}


def test_what_a_conversion_leaves_behind_is_said(tmp_path: Path) -> None:
    """And `info` goes on to show the events that the trace had, under their full names."""
    trace = written(tmp_path / "trace", chain_story())
    one_event(trace / "dds", "dds:write", {"data": "x64"}, {"data": 1})
    shown = json_of("info", trace)
    assert shown["events"]["dds:write"] == 1
    said = called("convert", trace, "-o", tmp_path / "once").err
    assert "1 events of kinds that chainshaper makes no use of were left out: dds:write" in said
    called("convert", tmp_path / "once", "-o", tmp_path / "twice")
    for name in ("once", "twice"):
        again = json_of("info", tmp_path / name)
        assert again["events"] == shown["events"]
        assert sum("left out" in note for note in again["notes"]) == 1


@pytest.mark.parametrize("hosts", [("one", "two"), ("host", "host")])
def test_containers_with_the_same_process_numbers_are_told_apart(
    tmp_path: Path, hosts: tuple[str, str]
) -> None:
    """Their processes are 10 and 11; of one host name, as with `--network host`, by folders."""
    for folder, host, names, by in zip(("1", "2"), hosts, ("ab", "cd"), (0, 120), strict=True):
        tables = shifted(chain_story(names=(names[0], names[1])), START + by)
        write_lttng_trace(tmp_path / folder, tables, clock_offset_ns=OFFSET, host=host)
    recording = open_source(tmp_path / "1", tmp_path / "2")
    moved = NEXT_HOST + 10
    assert recording.info.host == ", ".join(dict.fromkeys(hosts))
    assert recording.info.processes == {10: "/a", 11: "/b", moved: "/c", moved + 1: "/d"}
    of_later = "host two" if hosts[1] == "two" else f"host in {tmp_path / '2'}"
    assert any(f"{of_later} have" in note for note in recording.info.notes)
    graph = application_graph(recording.events)
    assert {(callback.node, callback.pid) for callback in graph.callbacks} == {
        *(("/a", 10), ("/b", 11), ("/c", moved), ("/d", moved + 1))
    }
    for chain in ("/a../b../y", "/c../d../y"):
        figures = analyse_latency(recording, chain).statistics
        assert (figures.count, figures.min_ns, figures.max_ns) == (5, 300, 300)


def test_hosts_with_different_process_numbers_keep_them(tmp_path: Path) -> None:
    tables = shifted(chain_story())
    for pid, host in ((10, "one"), (11, "two")):
        of_process = {name: frame.filter(pid=pid) for name, frame in tables.items()}
        write_lttng_trace(tmp_path / "trace" / host, of_process, clock_offset_ns=OFFSET, host=host)
    recording = open_source(tmp_path / "trace")
    assert recording.info.processes == {10: "/a", 11: "/b"}
    assert recording.info.notes == ()
    assert analyse_latency(recording, "/x../y").statistics.count == 5


def test_threads_of_a_container_are_not_the_kernels_of_the_same_numbers(tmp_path: Path) -> None:
    """The kernel's thread 11 runs now and then, never while the container's 11 does."""
    story = chain_story(cycles=4)
    for now in range(1000, 5000, 1000):
        switch(story, {now + 500: (0, 11), now + 600: (11, 0)})
    rows = json_of("callbacks", written(tmp_path / "trace", story))
    assert [row["execution_ns"] for row in rows] == [None, None]


def test_without_rcl_init_the_fields_tell_the_distribution(tmp_path: Path) -> None:
    story = chain_story()
    story.event("rmw_publisher_init", 0, 10, rmw_publisher_handle=1, gid=[1, 16, *[0] * 14])
    trace = written(tmp_path / "trace", story, gid_length=16)
    info = json_of("info", trace)
    assert "ros2:rcl_init" not in info["events"]
    assert (info["distribution"], info["rmw"]) == ("kilted", "rmw_cyclonedds_cpp")
    assert json_of("latency", trace, "--chain", "/x../y")["count"] == 5


def test_messages_within_a_process_that_no_event_shows(tmp_path: Path) -> None:
    """Before Iron, ring buffers have no events: the callback says that it got its message there."""
    story = chain_story()
    container = story.node("/container", 12)
    inside = story.subscription(container, "/z")
    story.start(inside, 5000, intra=1)
    story.end(inside, 5010)
    (note,) = data_flow(open_source(written(tmp_path / "trace", story)).events).notes
    assert "1 callback instances got their message within their process" in note
