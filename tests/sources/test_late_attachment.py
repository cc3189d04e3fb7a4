"""What is found out about an application that ran before tracing began: worked by hand."""

from collections.abc import Iterable, Mapping
from typing import Any

import polars as pl

from chainshaper.analysis.flow import data_flow
from chainshaper.analysis.graph import application_graph
from chainshaper.linux.processes import RunningProcess
from chainshaper.sources.ebpf.late_attachment import (
    with_found_nodes,
    with_found_objects,
    with_functions,
)
from chainshaper.values import events
from chainshaper.values.recording import EndpointInfo, RecordingInfo

PID, THREAD, OTHER = 10, 10, 11
TIMER, READER, LAMBDA = 0x7A, 0x7B, 0x7C
INFO = RecordingInfo(source="ebpf", clock_offset_ns=0, processes={PID: "container"})
MS = 1_000_000


def tables_of(rows: Iterable[tuple[str, Mapping[str, Any]]]) -> dict[str, pl.DataFrame]:
    """Event tables from events in any order; a row without a thread is of THREAD."""
    rows_of: dict[str, list[dict[str, Any]]] = {}
    for name, values in rows:
        rows_of.setdefault(name, []).append({"pid": PID, "tid": THREAD, **values})
    schemas = {name: events.empty(name).schema for name in rows_of}
    return {
        name: pl.DataFrame(event_rows, schemas[name]).sort("time")
        for name, event_rows in rows_of.items()
    }


def instance(
    at: int, callback: int, *, publisher: int | None = None, tid: int = THREAD
) -> list[Any]:
    """A callback of 2 ms that publishes after one; handles of rcl are those of the RMW + 1."""
    rows: list[Any] = [
        ("callback_start", {"time": at, "tid": tid, "callback": callback, "is_intra_process": 0}),
        ("callback_end", {"time": at + 2 * MS, "tid": tid, "callback": callback}),
    ]
    if publisher is not None:
        said = {"time": at + MS, "tid": tid, "message": 5}
        rows += [
            ("rcl_publish", {**said, "publisher_handle": publisher + 1}),
            ("rmw_publish", {**said, "rmw_publisher_handle": publisher, "timestamp": at + MS}),
        ]
    return rows


def take(at: int, subscription: int, stamp: int, *, tid: int = THREAD, taken: int = 1) -> Any:
    values = {"rmw_subscription_handle": subscription, "source_timestamp": stamp, "taken": taken}
    return ("rmw_take", {"time": at, "tid": tid, "message": 5, **values})


def handles(*rows: tuple[str, int, str]) -> pl.DataFrame:
    return pl.DataFrame(
        [(PID, *row) for row in rows],
        schema={"pid": pl.Int32, "event": pl.String, "handle": pl.UInt64, "topic": pl.String},
        orient="row",
    )


def chain(cycles: int = 10) -> dict[str, pl.DataFrame]:
    """A timer every 100 ms publishes /a under 0x100; a subscription, 0x300, answers under 0x200."""
    rows: list[Any] = []
    for start in range(MS, cycles * 100 * MS, 100 * MS):
        rows += instance(start, TIMER, publisher=0x100)
        rows.append(take(start + 5 * MS, 0x300, start + MS))
        rows += instance(start + 6 * MS, READER, publisher=0x200)
    return tables_of(rows)


CHAIN_HANDLES = handles(
    ("rmw_publish", 0x100, "/a"), ("rmw_publish", 0x200, "/b"), ("rmw_take", 0x300, "/a")
)


def callbacks(tables: events.EventTables) -> dict[int, tuple[Any, ...]]:
    rows = data_flow(tables).objects.callbacks.select("handle", "kind", "topic", "period_ns")
    return {handle: tuple(rest) for handle, *rest in rows.iter_rows()}


def test_topics_callbacks_and_periods_of_a_chain_are_found() -> None:
    tables, notes = with_found_objects(chain(), CHAIN_HANDLES, began_ns=0)
    assert callbacks(tables) == {
        TIMER: ("timer", None, 100 * MS),
        READER: ("subscription", "/a", None),
    }
    flow = data_flow(tables)
    assert flow.publications.height == 20
    assert flow.takes["publication"].to_list() == list(range(0, 20, 2))
    assert flow.publications["callback_id"].null_count() == 0
    columns = ("publisher_handle", "rmw_publisher_handle", "topic_name")
    publishers = sorted(tables["rcl_publisher_init"].select(columns).iter_rows())
    assert publishers == [(0x101, 0x100, "/a"), (0x201, 0x200, "/b")]
    assert "publishers (2) and subscriptions (1)" in notes[0]
    assert "timers (1)" in notes[0]


def test_what_was_seen_being_created_is_left_as_it_is() -> None:
    created = tables_of(
        [
            ("rcl_publisher_init", {"time": 0, "rmw_publisher_handle": 0x100, "topic_name": "/x"}),
            ("rclcpp_timer_callback_added", {"time": 0, "timer_handle": 1, "callback": TIMER}),
        ]
    )
    tables, _ = with_found_objects({**chain(), **created}, CHAIN_HANDLES, began_ns=0)
    publishers = tables["rcl_publisher_init"].select("rmw_publisher_handle", "topic_name")
    assert dict(publishers.iter_rows()) == {0x100: "/x", 0x200: "/b"}
    assert tables["rclcpp_timer_callback_added"].height == 1
    known = tables_of([("rcl_publisher_init", {"time": 0, "node_handle": 1, "topic_name": "/x"})])
    assert with_found_nodes(known, INFO, (), ()) == (known, INFO)


def test_functions_belong_to_callbacks_from_when_these_were_added() -> None:
    added = ("rclcpp_timer_callback_added", {"time": 70 * MS, "timer_handle": 1, "callback": TIMER})
    tables = {**chain(), **tables_of([added])}
    functions = {(PID, TIMER): "Source::tick()", (PID, READER): "Relay::on_x()"}
    named = with_functions(tables, functions, 50 * MS)
    rows = named["rclcpp_callback_register"].select("time", "callback", "symbol").rows()
    assert rows == [(50 * MS, READER, "Relay::on_x()"), (70 * MS, TIMER, "Source::tick()")]
    symbols = {callback.handle: callback.symbol for callback in application_graph(named).callbacks}
    assert symbols[TIMER] == "Source::tick()"
    assert with_functions(tables, {}, 50 * MS) == tables


def test_the_rmws_own_topics_and_recordings_without_handles_change_nothing() -> None:
    irregular = tables_of(row for at in (1, 2, 90, 95, 300) for row in instance(at * MS, LAMBDA))
    rmw_handles = handles(("rmw_publish", 0x100, "ros_discovery_info"))
    tables, notes = with_found_objects(irregular, rmw_handles, began_ns=0)
    assert tables is irregular
    assert notes == ()
    assert callbacks(tables)[LAMBDA] == ("unknown", None, None)


def test_a_take_of_another_thread_or_of_nothing_is_not_taken_for_the_callbacks() -> None:
    rows: list[Any] = []
    for start in range(MS, 1000 * MS, 100 * MS):
        rows.append(take(start - 10, 0x300, 1, tid=OTHER))
        rows.append(take(start - 10, 0x300, 1, taken=0))
        rows += instance(start, TIMER)
    tables, _ = with_found_objects(tables_of(rows), CHAIN_HANDLES, began_ns=0)
    assert callbacks(tables)[TIMER] == ("timer", None, 100 * MS)


def test_a_callback_that_once_ran_without_its_take_is_a_subscriptions_all_the_same() -> None:
    """Its first message was taken before tracing began."""
    rows = instance(50 * MS, READER)
    for start in range(100 * MS, 1200 * MS, 100 * MS):
        rows += [take(start, 0x300, 1), *instance(start + MS, READER)]
    tables, _ = with_found_objects(tables_of(rows), CHAIN_HANDLES, began_ns=0)
    assert callbacks(tables)[READER] == ("subscription", "/a", None)


def endpoint(node: str, kind: Any, topic: str) -> EndpointInfo:
    return EndpointInfo(node=node, kind=kind, topic=topic)


def nodes_of(tables: events.EventTables) -> dict[int, str]:
    rows = data_flow(tables).objects.callbacks.select("handle", "node").iter_rows()
    return dict(rows)


def container(command: tuple[str, ...]) -> RunningProcess:
    return RunningProcess(PID, 1, command, PID, True, ())


def test_two_nodes_of_one_process_are_told_apart_by_their_topics() -> None:
    """The timer is that of the node whose publisher it uses; /rosout has both nodes."""
    more = handles(("rmw_publish", 0x400, "/rosout"))
    tables, _ = with_found_objects(chain(), pl.concat([CHAIN_HANDLES, more]), began_ns=0)
    graph = [
        endpoint("/front/first", "publisher", "/a"),
        endpoint("/second", "subscription", "/a"),
        endpoint("/second", "publisher", "/b"),
        endpoint("/second", "publisher", "/rosout"),
        endpoint("/front/first", "publisher", "/rosout"),
    ]
    with_nodes, info = with_found_nodes(tables, INFO, graph, [container(("container",))])
    assert nodes_of(with_nodes) == {TIMER: "/front/first", READER: "/second"}
    assert info.processes == {PID: "/front/first, /second"}
    assert info.notes == ()
    owners = dict(with_nodes["rcl_publisher_init"].select("topic_name", "node_handle").iter_rows())
    assert owners["/rosout"] is None


def test_without_the_graph_the_only_node_that_a_command_line_names_has_everything() -> None:
    tables, _ = with_found_objects(chain(), CHAIN_HANDLES, began_ns=0)
    command = ("program", "--ros-args", "-r", "__node:=both", "-r", "__ns:=/rear")
    with_nodes, info = with_found_nodes(tables, INFO, (), [container(command)])
    assert nodes_of(with_nodes) == {TIMER: "/rear/both", READER: "/rear/both"}
    assert info.processes == {PID: "/rear/both"}


def test_what_is_not_certain_stays_open_and_is_said() -> None:
    tables, _ = with_found_objects(chain(), CHAIN_HANDLES, began_ns=0)
    graph = [
        endpoint("/one", "publisher", "/a"),
        endpoint("/two", "publisher", "/a"),
        endpoint("/two", "publisher", "/b"),
    ]
    with_nodes, info = with_found_nodes(tables, INFO, graph, [container(("program",))])
    owners = dict(with_nodes["rcl_publisher_init"].select("topic_name", "node_handle").iter_rows())
    assert owners["/a"] == owners["/b"] == 1  # of the two only /two is known to live there
    nothing, info = with_found_nodes(tables, INFO, (), [container(("program",))])
    assert nodes_of(nothing) == dict.fromkeys((TIMER, READER), f"unknown (process {PID})")
    assert "/a, /b" in info.notes[0]
