"""The application graph in its forms: data, DOT, picture."""

import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import pytest
from story import Story

from chainshaper.analysis import data_flow, graph_of
from chainshaper.analysis.graph import ApplicationDescription, services
from chainshaper.reporting.graph_drawing import (
    application_json,
    short_symbol,
    without_internals,
)
from chainshaper.reporting.graph_drawing import application_dot, application_svg, write_picture


@pytest.fixture
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
    for number, (kind, name) in enumerate(
        (("service", "/reset"), ("service", "/relay/get_parameters"), ("client", "/map"))
    ):
        ends = {f"{kind}_handle": 50 + number, f"rmw_{kind}_handle": 60 + number}
        story.event(f"rcl_{kind}_init", 5, 2, node_handle=relay.handle, service_name=name, **ends)
        if kind == "service":
            story.event("rclcpp_service_callback_added", 6, 2, service_handle=50 + number,
                        callback=70 + number)  # fmt: skip
    tables = story.tables()
    flow = data_flow(tables)
    return ApplicationDescription(graph_of(flow), services(tables), {}, ("a note",))


def test_as_data(application: ApplicationDescription) -> None:
    found = json.loads(json.dumps(application_json(application)))
    assert found["nodes"] == [{"name": "/source", "pid": 1}, {"name": "/relay", "pid": 2}]
    by_topic = {topic["name"]: topic for topic in found["topics"]}
    assert by_topic["/x"] == {
        "name": "/x",
        "publishers": ["/source"],
        "subscribers": ["/relay"],
        "internal": False,
    }
    assert {name for name, topic in by_topic.items() if topic["internal"]} == {
        "/rosout",
        "/parameter_events",
    }
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


def test_as_a_picture(application: ApplicationDescription) -> None:
    svg = application_svg(without_internals(application))
    ET.fromstring(svg)  # noqa: S314 - our own text: well formed
    for text in ("/source", "timer 20ms", "Source::tick", "/x", "/y", "service /reset"):
        assert f">{text}</text>" in svg
    for text in ("get_parameters", "/rosout", "/parameter_events"):
        assert text not in svg
        assert text in application_svg(application)


def test_pictures_say_what_was_lost(application: ApplicationDescription) -> None:
    assert "lost" not in application_svg(application) + application_dot(application)
    lossy = replace(application, lost={"discarded_events": 3, "lost_packets": 0})
    for picture in (application_svg(lossy), application_dot(lossy)):
        assert "lost while recording: 3 discarded events" in picture


def test_as_dot(application: ApplicationDescription) -> None:
    dot = application_dot(without_internals(application))
    assert dot.startswith("digraph application {")
    assert dot.count("{") == dot.count("}")
    assert '"/x" -> callback_' in dot
    assert '-> "/y";' in dot
    assert "/rosout" not in dot
    assert "/rosout" in application_dot(application)


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
