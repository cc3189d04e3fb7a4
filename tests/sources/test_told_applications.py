"""Applications that no real trace of ours shows, told as stories and read back as traces."""

from pathlib import Path

from command_line import json_of
from story import Story
from test_lttng_trace import chain_story, written

from chainshaper.analysis import data_flow
from chainshaper.sources import open_source


def test_services_and_their_clients(tmp_path: Path) -> None:
    """A client asks twice; the server's callback runs twice. The client's own is not traced."""
    story = Story()
    server, client = story.node("/server", 10), story.node("/client", 11)
    story.event("rcl_service_init", 1, 10, service_handle=50, node_handle=server.handle,
                rmw_service_handle=51, service_name="/add")  # fmt: skip
    story.event("rclcpp_service_callback_added", 2, 10, service_handle=50, callback=52)
    story.event("rclcpp_callback_register", 3, 10, callback=52, symbol="Server::add()")
    story.event("rcl_client_init", 4, 11, client_handle=60, node_handle=client.handle,
                rmw_client_handle=61, service_name="/add")  # fmt: skip
    for now in (1000, 2000):
        story.event("callback_start", now, 10, callback=52, is_intra_process=0)
        story.event("callback_end", now + 70, 10, callback=52)
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
    assert info["distribution"] == "kilted"
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
