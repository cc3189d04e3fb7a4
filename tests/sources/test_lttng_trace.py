"""LTTng traces as recordings: stories written as a tracer would have, and opened again."""

import os
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
        found = recording.events[name]
        types = {**events.COMMON_COLUMNS, **events.FIELDS[name]}
        assert dict(found.schema) == {c: types[c] for c in found.columns}
        assert found.select(frame.columns).rows() == frame.rows()
    assert recording.info.source == "lttng"
    assert recording.info.clock_offset_ns == OFFSET
    assert recording.info.host == "example"
    assert recording.info.processes == {10: "/a", 11: "/b"}


def test_babeltrace_reads_what_was_written(tmp_path: Path) -> None:
    trace = written(tmp_path / "trace", chain_story())
    counts: dict[str, int] = {}
    for name, *_ in babeltrace(trace)["events"]:
        counts[name] = counts.get(name, 0) + 1
    assert json_of("info", trace)["events"] == dict(sorted(counts.items()))


def test_latency_through_the_whole_path(tmp_path: Path) -> None:
    trace = written(tmp_path / "trace", chain_story())
    found = json_of("latency", trace, "--chain", "/x../y", "--instances")
    assert (found["count"], found["incomplete"]) == (5, 0)
    assert (found["min_ns"], found["max_ns"]) == (300, 300)
    assert found["instances"][0]["start_ns"] == START + 1000 + OFFSET
    assert [hop["communication_ns"] for hop in found["hops"]] == [
        None,
        {"min": 100, "mean": 100.0, "max": 100},
    ]
    assert found["communication_share"] == pytest.approx(1 / 3)


def test_folders_of_processes_are_merged_by_time(tmp_path: Path) -> None:
    """Per-pid buffers: every process has a folder of its own, below one path or given apart."""
    tables = shifted(chain_story())
    for pid in (10, 11):
        own = {name: frame.filter(pid=pid) for name, frame in tables.items()}
        write_lttng_trace(tmp_path / "trace" / f"pid-{pid}", own, clock_offset_ns=OFFSET)
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


def test_damage_to_the_kernels_part_is_said_though_it_is_read_late(tmp_path: Path) -> None:
    story = chain_story(cycles=3)
    switch(story, {900: (0, 10), 1160: (10, 11)})
    trace = written(tmp_path / "trace", story)
    (stream,) = (one for one in (trace / "kernel").iterdir() if one.name != "metadata")
    os.truncate(stream, stream.stat().st_size - 10)
    recording = open_source(trace)
    assert len(recording.events["callback_start"])
    assert any(str(stream) in note for note in recording.info.notes)


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


def test_components_share_a_process(tmp_path: Path) -> None:
    story = Story()
    first, second = story.node("/container/a", 10), story.node("/container/b", 10)
    timer, reader = story.timer(first), story.subscription(second, "/x")
    x = story.publisher(first, "/x")
    story.runs(timer, 1000, 1100, writes=((x, 1050),), tid=11)
    story.runs(reader, 1200, 1300, reads=1050, tid=12)
    trace = written(tmp_path / "trace", story)
    assert json_of("info", trace)["processes"] == {"10": "/container/a, /container/b"}
    rows = json_of("callbacks", trace)
    assert {(row["node"], *row["tids"]) for row in rows} == {
        ("/container/a", 11),
        ("/container/b", 12),
    }


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


def test_traces_of_different_clocks_are_not_mixed(tmp_path: Path) -> None:
    written(tmp_path / "traces" / "one", chain_story())
    text = lttng_metadata({"ros2:rcl_take": {"message": "x64"}})
    text = text.replace("d499e0ca", "00000000")
    write_trace(tmp_path / "traces" / "two", text, {})
    with pytest.raises(InputError, match=r"two was taken by another clock than .*one"):
        open_source(tmp_path / "traces")


def test_a_trace_without_ros_events_cannot_be_converted(tmp_path: Path) -> None:
    text = lttng_metadata({"other:event": {"value": "u32"}})
    write_trace(tmp_path / "trace", text, {})
    said = refused(2, "convert", tmp_path / "trace", "-o", tmp_path / "recording")
    assert "no event in it is one that chainshaper knows" in said
    assert not (tmp_path / "recording").exists()


def test_a_graph_is_written_where_it_can_be(tmp_path: Path) -> None:
    trace, picture = written(tmp_path / "trace", chain_story()), tmp_path / "graph.svg"
    picture.write_text("mine")
    assert "exists already and is not overwritten" in refused(2, "graph", trace, "-o", picture)
    other = refused(2, "graph", trace, "-o", picture.with_suffix(".png"))
    assert "ends in .svg or .dot or .json" in other
    assert picture.read_text() == "mine"


def one_event(folder: Path, name: str, kinds: dict[str, str], payload: dict[str, Any]) -> None:
    """A trace of a single event, of process 10."""
    text = lttng_metadata({name: kinds}, {"vpid": "s32", "vtid": "s32"})
    event = EventRecord(name, START, payload, {"vpid": 10, "vtid": 10})
    write_packet(folder, text, [event])


def test_another_providers_events_of_the_same_name_are_not_ours(tmp_path: Path) -> None:
    one_event(tmp_path / "trace", "mine:callback_start", {"callback": "x64"}, {"callback": 1})
    recording = open_source(tmp_path / "trace")
    assert len(recording.events) == 0
    assert json_of("info", tmp_path / "trace")["events"] == {"mine:callback_start": 1}


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


def container(folder: Path, host: str, names: tuple[str, str], shift: int) -> None:
    """A container's own trace: its processes are 10 and 11, as in every other container."""
    tables = {
        name: frame.with_columns(
            pl.col(column) + shift
            for column in ("time", "timestamp", "source_timestamp")
            if column in frame.columns
        )
        for name, frame in shifted(chain_story(names=names)).items()
    }
    write_lttng_trace(folder, tables, clock_offset_ns=OFFSET, host=host)


def test_containers_with_the_same_process_numbers_are_told_apart(tmp_path: Path) -> None:
    container(tmp_path / "trace" / "one", "one", ("a", "b"), 0)
    container(tmp_path / "trace" / "two", "two", ("c", "d"), 120)
    recording = open_source(tmp_path / "trace")
    moved = NEXT_HOST + 10
    assert recording.info.host == "one, two"
    assert recording.info.processes == {10: "/a", 11: "/b", moved: "/c", moved + 1: "/d"}
    assert [note for note in recording.info.notes if "host two" in note]
    graph = application_graph(recording.events)
    assert {(c.node, c.pid) for c in graph.callbacks} == {
        ("/a", 10),
        ("/b", 11),
        ("/c", moved),
        ("/d", moved + 1),
    }
    for chain in ("/a../b../y", "/c../d../y"):
        figures = analyse_latency(recording, chain).statistics
        assert (figures.count, figures.min_ns, figures.max_ns) == (5, 300, 300)
    together = json_of("info", tmp_path / "trace")["events"]
    alone = json_of("info", tmp_path / "trace" / "one")["events"]
    assert together == {name: 2 * count for name, count in alone.items()}


def test_containers_with_the_hosts_own_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    container(tmp_path / "one", "host", ("a", "b"), 0)
    container(tmp_path / "two", "host", ("c", "d"), 120)
    recording = open_source(tmp_path / "one", tmp_path / "two")
    moved = NEXT_HOST + 10
    assert recording.info.host == "host"
    assert recording.info.processes == {10: "/a", 11: "/b", moved: "/c", moved + 1: "/d"}
    assert [note for note in recording.info.notes if f"host in {tmp_path / 'two'} have" in note]
    for chain in ("/a../b../y", "/c../d../y"):
        assert analyse_latency(recording, chain).statistics.count == 5


def test_hosts_with_different_process_numbers_keep_them(tmp_path: Path) -> None:
    tables = shifted(chain_story())
    for pid, host in ((10, "one"), (11, "two")):
        own = {name: frame.filter(pid=pid) for name, frame in tables.items()}
        write_lttng_trace(tmp_path / "trace" / host, own, clock_offset_ns=OFFSET, host=host)
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


def test_services_and_their_clients(tmp_path: Path) -> None:
    """A client asks twice; the server's callback runs twice. The client's own is not traced."""
    story = Story()
    server = story.service(story.node("/server", 10), "/add")
    story.client(story.node("/client", 11), "/add")
    for now in (1000, 2000):
        story.runs(server, now, now + 70)
    trace = written(tmp_path / "trace", story)
    (row,) = json_of("callbacks", trace)
    assert (row["node"], row["kind"], row["topic"]) == ("/server", "service", "/add")
    assert (row["count"], row["response_ns"]["max"]) == (2, 70)
    graph = json_of("graph", trace)
    assert [(c["node"], c["kind"], c["topic"]) for c in graph["callbacks"]] == [
        ("/server", "service", "/add"),
        ("/client", "client", "/add"),
    ]
    (service,) = graph["services"]
    assert (service["servers"], service["clients"]) == (["/server"], ["/client"])
    assert graph["notes"] == [], "a client is no Python subscription"


def test_without_rcl_init_the_fields_tell_the_distribution(tmp_path: Path) -> None:
    story = chain_story()
    story.event("rmw_publisher_init", 0, 10, rmw_publisher_handle=1, gid=[1, 16, *[0] * 14])
    trace = written(tmp_path / "trace", story, gid_length=16)
    info = json_of("info", trace)
    assert "ros2:rcl_init" not in info["events"]
    assert (info["distribution"], info["rmw"]) == ("kilted", "rmw_cyclonedds_cpp")
    assert json_of("latency", trace, "--chain", "/x../y")["count"] == 5


def test_a_callback_in_several_threads_of_one_executor(tmp_path: Path) -> None:
    """Both threads take a message before either starts the callback; 2 overtakes 1."""
    story = Story()
    source, worker = story.node("/source", 10), story.node("/worker", 11)
    timer, reader = story.timer(source), story.subscription(worker, "/x")
    x, y = story.publisher(source, "/x"), story.publisher(worker, "/y")
    story.runs(timer, 1000, 1020, writes=((x, 1010),))
    story.runs(timer, 1100, 1120, writes=((x, 1110),))
    story.take(reader, 1200, sent=1010, tid=21)
    story.take(reader, 1201, sent=1110, tid=22)
    for thread, start, sent, end in ((22, 1202, 1250, 1300), (21, 1203, 1350, 1400)):
        story.start(reader, start, thread)
        story.publish(y, sent, thread)
        story.end(reader, end, thread)
    found = json_of("latency", written(tmp_path / "trace", story), "--chain", "/x../y",
                    "--instances")  # fmt: skip
    assert [one["latency_ns"] for one in found["instances"]] == [350, 150]


def test_messages_within_a_process_that_no_event_shows(tmp_path: Path) -> None:
    """Before Iron, ring buffers have no events: the callback says that it got its message there."""
    story = chain_story()
    container = story.node("/container", 12)
    inside = story.subscription(container, "/z")
    story.start(inside, 5000, intra=1)
    story.end(inside, 5010)
    (note,) = data_flow(open_source(written(tmp_path / "trace", story)).events).notes
    assert "1 callback instances got their message within their process" in note
