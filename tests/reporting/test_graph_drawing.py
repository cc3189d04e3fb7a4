"""The application graph in its forms: data, DOT, picture; and where boxes and arrows go."""

import json
import random
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import pytest
from story import Story

from chainshaper.analysis import data_flow, graph_of
from chainshaper.analysis.graph import ApplicationDescription, services
from chainshaper.reporting.graph_drawing import (
    Box,
    Edge,
    application_dot,
    application_json,
    application_svg,
    lay_out,
    short_symbol,
    without_internals,
    write_picture,
)


@pytest.fixture(scope="module")
def application() -> ApplicationDescription:
    """/source → /x → /relay → /y, with a service of the relay's and one that every node has."""
    story = Story()
    source, relay = story.node("/source", 1), story.node("/relay", 2)
    timer = story.timer(source, period=20_000_000, symbol="Source::tick()")
    reader = story.subscription(relay, "/x", symbol='Relay::on_x(std::string, "<&>")')
    story.subscription(relay, "/parameter_events")
    x, y = story.publisher(source, "/x"), story.publisher(relay, "/y")
    story.publisher(relay, "/rosout")
    story.runs(timer, 1000, 1100, writes=((x, 1050),))
    story.runs(reader, 1200, 1300, reads=1050, writes=((y, 1250),))
    for handle, kind, name in (
        (50, "service", "/reset"),
        (51, "service", "/relay/get_parameters"),
        (52, "client", "/map"),
    ):
        ends = {f"{kind}_handle": handle, f"rmw_{kind}_handle": handle + 10}
        story.event(f"rcl_{kind}_init", 5, 2, node_handle=relay.handle, service_name=name, **ends)
        if kind == "service":
            added = {"service_handle": handle, "callback": handle + 20}
            story.event("rclcpp_service_callback_added", 6, 2, **added)
    tables = story.tables()
    flow = data_flow(tables)
    return ApplicationDescription(graph_of(flow), services(tables), {}, ("a note",))


def test_as_data(application: ApplicationDescription) -> None:
    found = json.loads(json.dumps(application_json(application)))
    assert found["nodes"] == [
        {"name": name, "pid": pid, "pids": [pid]} for name, pid in (("/source", 1), ("/relay", 2))
    ]
    by_topic = {topic.pop("name"): topic for topic in found["topics"]}
    ends = {"publishers": ["/source"], "subscribers": ["/relay"]}
    assert by_topic["/x"] == {**ends, "internal": False}
    internal = {name for name, topic in by_topic.items() if topic["internal"]}
    assert internal == {"/rosout", "/parameter_events"}
    (client,) = (c for c in found["callbacks"] if c["kind"] == "client")
    assert (client["node"], client["topic"], client["symbol"]) == ("/relay", "/map", None)
    timer = next(c for c in found["callbacks"] if c["kind"] == "timer")
    assert (timer["period_ns"], timer["publishes"]) == (20_000_000, ["/x"])
    assert [(s["name"], s["servers"], s["clients"], s["internal"]) for s in found["services"]] == [
        ("/map", [], ["/relay"], False),
        ("/relay/get_parameters", ["/relay"], [], True),
        ("/reset", ["/relay"], [], False),
    ]
    assert found["notes"] == ["a note"]


def test_as_a_picture_and_as_dot(application: ApplicationDescription) -> None:
    svg, dot = (draw(without_internals(application)) for draw in (application_svg, application_dot))
    ET.fromstring(svg)  # noqa: S314 - our own text: well formed
    for text in ("/source", "timer 20ms", "Source::tick", "/x", "/y", "service /reset"):
        assert f">{text}</text>" in svg
    for text in ("get_parameters", "/rosout", "/parameter_events"):
        assert text not in svg + dot
        assert text in application_svg(application)
        assert text in application_dot(application)
    assert dot.startswith("digraph application {")
    assert dot.count("{") == dot.count("}")
    assert '"/x" -> callback_' in dot
    assert '-> "/y";' in dot
    assert "lost" not in svg + dot
    lossy = replace(application, lost={"discarded_events": 3, "lost_packets": 0})
    for picture in (application_svg(lossy), application_dot(lossy)):
        assert "lost while recording: 3 discarded events" in picture


@pytest.mark.parametrize(
    ("symbol", "short"),
    [
        (None, ""),
        ("Throttler::Throttler()::{lambda()#2}", "Throttler λ2"),
        ("ns::Relay<std::vector<int> >::Relay()::{lambda(int)#1}", "ns::Relay λ1"),
        ("std::_Bind<void (SourceNode::*(SourceNode*))()>", "SourceNode::…"),
        ("void Node::on_message(std::shared_ptr<Message const>)", "Node::on_message"),
        ("main::{lambda()#1}", "main λ1"),
        ("_ZN4Node", "_ZN4Node"),
    ],
)
def test_functions_by_their_short_names(symbol: str | None, short: str) -> None:
    assert short_symbol(symbol) == short


@pytest.mark.parametrize("ending", [".svg", ".dot", ".json"])
def test_files(application: ApplicationDescription, ending: str, tmp_path: Path) -> None:
    path = write_picture(application, tmp_path / f"graph{ending}")
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    assert "/source" in path.read_text(encoding="utf-8")


@pytest.mark.parametrize("seed", range(10))
def test_boxes_do_not_overlap_and_everything_is_inside_the_picture(seed: int) -> None:
    """A graph with cycles, several parts and boxes of all sizes."""
    chance = random.Random(seed)
    boxes = [Box(chance.uniform(40, 200), chance.uniform(20, 120)) for _ in range(30)]
    ends = [(chance.randrange(30), chance.randrange(28)) for _ in range(40)]
    edges = [Edge(a, b, boxes[a].height / 2, boxes[b].height / 3) for a, b in ends]
    layout = lay_out(boxes, edges)
    areas = [
        (x, y, x + box.width, y + box.height)
        for (x, y), box in zip(layout.corners, boxes, strict=True)
    ]
    for number, (left, top, right, bottom) in enumerate(areas):
        for to_left, to_top, to_right, to_bottom in areas[:number]:
            beside = right <= to_left or to_right <= left
            assert beside or bottom <= to_top + 1e-6 or to_bottom <= top + 1e-6
    points = [point for route in layout.routes for point in route]
    points += [area[:2] for area in areas] + [area[2:] for area in areas]
    assert all(-1e-6 <= x <= layout.width + 1e-6 for x, _ in points)
    assert all(-1e-6 <= y <= layout.height + 1e-6 for _, y in points)


def test_arrows_lead_from_box_to_box_and_around_others() -> None:
    boxes = [Box(50, 20)] * 4
    edges = [Edge(0, 1, 10, 10), Edge(1, 2, 10, 10), Edge(2, 3, 10, 10), Edge(0, 3, 5, 15)]
    layout = lay_out(boxes, edges)
    assert [x for x, _ in layout.corners] == sorted(x for x, _ in layout.corners)
    long = layout.routes[3]
    assert long[0] == (layout.corners[0][0] + 50, layout.corners[0][1] + 5)
    assert long[-1] == (layout.corners[3][0], layout.corners[3][1] + 15)
    assert len(long) == 2 + 2 * 2, "in and out of the two columns that it passes"
    for box in (1, 2):
        y = layout.corners[box][1]
        assert all(not y < height < y + 20 for _, height in long[1:-1])


def test_a_cycle_is_drawn_with_one_arrow_backwards() -> None:
    layout = lay_out([Box(50, 20)] * 3, [Edge(0, 1, 1, 1), Edge(1, 2, 1, 1), Edge(2, 0, 1, 1)])
    backwards = [route for route in layout.routes if route[-1][0] < route[0][0]]
    assert len(backwards) == 1


def test_a_box_alone_and_no_box_at_all() -> None:
    alone = lay_out([Box(50, 20)], [])
    assert (alone.corners, alone.width, alone.height) == ([(0.0, 0.0)], 50, 20)
    assert lay_out([], []).corners == []
    loop = lay_out([Box(50, 20)], [Edge(0, 0, 5, 15)])
    assert loop.routes[0] == [(50, 5), (0, 15)]
