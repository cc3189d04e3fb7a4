"""LTTng traces as recordings: stories written as a tracer would have, and opened again."""

from pathlib import Path
from typing import Any

import polars as pl
import pytest
from command_line import called, json_of, refused
from ctf_writing import lttng_metadata, write_lttng_trace, write_trace
from reference import babeltrace
from story import OFFSET, Story

from chainshaper.analysis import analyse_latency, application_graph, callback_statistics, data_flow
from chainshaper.sources import open_source
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
    for cycle in range(3):
        now = 1000 + 1000 * cycle
        for time, before, after in (
            (now - 10, 0, 10),
            (now + 160, 10, 11),
            (now + 250, 11, 99),
            (now + 300, 99, 11),
            (now + 410, 11, 0),
        ):
            story.event("sched_switch", time, before, prev_comm=f"thread_{before}",
                        prev_tid=before, prev_prio=20, prev_state=0,
                        next_comm=f"thread_{after}", next_tid=after, next_prio=20)  # fmt: skip
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


def test_what_the_tracer_dropped_is_in_every_result(tmp_path: Path) -> None:
    trace = written(tmp_path / "trace", chain_story(), discarded_events=7)
    lost = {"discarded_events": 7, "lost_packets": 0}
    assert json_of("info", trace)["lost"] == lost
    assert json_of("graph", trace)["lost"] == lost
    assert json_of("chains", trace)["lost"] == lost
    assert json_of("latency", trace, "--chain", "/x../y")["lost"] == lost
    said = "lost while recording: 7 discarded events"
    for verb in (("info",), ("graph",), ("callbacks",), ("chains",)):
        assert said in called(*verb, trace).out
    assert said in called("latency", trace, "--chain", "/x../y").out
    assert said in called("callbacks", trace, "--json").err, "its array has no place for it"
    compared = called("compare", trace, trace, "--chain", "/x../y").out
    assert "lost while recording" in compared
    recording = tmp_path / "recording"
    assert said in called("convert", trace, "-o", recording).err
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


def test_two_processes_with_nodes_of_one_name(tmp_path: Path) -> None:
    story = chain_story()
    other = story.node("/b", 20)
    reader = story.subscription(other, "/x")
    story.runs(reader, 1500, 1600, reads=1100)
    rows = json_of("callbacks", written(tmp_path / "trace", story))
    counts = {row["pid"]: row["count"] for row in rows if row["node"] == "/b"}
    assert counts == {11: 5, 20: 1}


def test_gids_of_16_bytes(tmp_path: Path) -> None:
    story = chain_story()
    gid = [1, 16, *range(14)]
    story.event("rmw_publisher_init", 0, 10, rmw_publisher_handle=5, gid=gid)
    recording = open_source(written(tmp_path / "trace", story, gid_length=16))
    assert recording.events["rmw_publisher_init"]["gid"].to_list() == [gid]
    assert (recording.info.distribution, recording.info.rmw) == ("kilted", "rmw_cyclonedds_cpp")


def test_before_jazzy_publications_carry_no_timestamp(tmp_path: Path) -> None:
    tables = shifted(chain_story())
    published = tables["rmw_publish"]
    owners = tables["rcl_publisher_init"].select("rmw_publisher_handle", "publisher_handle")
    tables["rmw_publish"] = published.drop("rmw_publisher_handle", "timestamp")
    tables["rcl_publish"] = published.join(owners, on="rmw_publisher_handle").select(
        pl.col("time") - 1, "pid", "tid", "publisher_handle", "message"
    )
    trace = write_lttng_trace(tmp_path / "trace", tables, clock_offset_ns=OFFSET)
    found = json_of("latency", trace, "--chain", "/x../y")
    assert (found["count"], found["min_ns"], found["max_ns"]) == (5, 300, 300)


def test_messages_within_a_process(tmp_path: Path) -> None:
    """Through a ring buffer: published, enqueued, dequeued, and no event of DDS."""
    story = Story()
    node = story.node("/container", 10)
    timer, reader = story.timer(node), story.subscription(node, "/x")
    x, y = story.publisher(node, "/x"), story.publisher(node, "/y")
    rclcpp = story.rows["rclcpp_subscription_init"][0]["subscription"]
    story.event("rclcpp_construct_ring_buffer", 1, 10, buffer=77, capacity=10)
    story.event("rclcpp_buffer_to_ipb", 1, 10, buffer=77, ipb=78)
    story.event("rclcpp_ipb_to_subscription", 2, 10, ipb=78, subscription=rclcpp)
    for index, now in enumerate((1000, 2000)):
        story.start(timer, now)
        story.event("rclcpp_intra_publish", now + 10, 10, publisher_handle=x.handle, message=1)
        story.event("rclcpp_ring_buffer_enqueue", now + 11, 10, buffer=77, index=index, size=1,
                    overwritten=0)  # fmt: skip
        story.end(timer, now + 20)
        story.event("rclcpp_ring_buffer_dequeue", now + 30, 10, buffer=77, index=index, size=0)
        story.start(reader, now + 31, intra=1)
        story.publish(y, now + 40)
        story.end(reader, now + 50)
    found = json_of("latency", written(tmp_path / "trace", story), "--chain", "/x../y")
    assert (found["count"], found["min_ns"], found["max_ns"]) == (2, 40, 40)


def test_python_nodes(tmp_path: Path) -> None:
    """rclpy emits no callback events: its takes and publications are all there is."""
    story = Story()
    node, source = story.node("/python", 10), story.node("/source", 11)
    reader = story.subscription(node, "/x", callbackless=True)
    x, y = story.publisher(source, "/x"), story.publisher(node, "/y")
    timer = story.timer(source)
    for now in (1000, 2000):
        story.runs(timer, now, now + 20, writes=((x, now + 10),))
        story.take(reader, now + 50, sent=now + 10)
        story.publish(y, now + 70)
    found = json_of("latency", written(tmp_path / "trace", story), "--chain", "/x../y")
    assert (found["count"], found["max_ns"]) == (2, 70)


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


def test_what_is_no_trace_is_named(tmp_path: Path) -> None:
    assert "no such folder" in refused(2, "info", tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    assert "folder without recording.json" in refused(2, "info", tmp_path / "empty")
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "metadata").write_text("/* CTF 1.8 */ trace { nonsense")
    said = refused(2, "info", tmp_path / "bad")
    assert str(tmp_path / "bad" / "metadata") in said
    assert "is a recording" not in said


def test_a_trace_without_ros_events_cannot_be_converted(tmp_path: Path) -> None:
    text = lttng_metadata({"other:event": {"value": "u32"}})
    write_trace(tmp_path / "trace", text, {})
    said = refused(2, "convert", tmp_path / "trace", "-o", tmp_path / "recording")
    assert "no event in it is one that chainshaper knows" in said
    assert not (tmp_path / "recording").exists()


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    trace = written(tmp_path / "trace", chain_story())
    for name, verb in (("rec", "convert"), ("graph.svg", "graph")):
        (tmp_path / name).write_text("mine")
        said = refused(2, verb, trace, "-o", tmp_path / name)
        assert f"{name} exists already and is not overwritten" in said
        assert (tmp_path / name).read_text() == "mine"
    assert "ends in .svg or .dot or .json" in refused(
        2, "graph", trace, "-o", tmp_path / "graph.png"
    )
    assert "no such folder" in refused(2, "graph", trace, "-o", tmp_path / "no" / "graph.svg")
