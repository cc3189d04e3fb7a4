"""A large application folded by namespace: what is a box, what an arrow, and what is only named."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Literal

import polars as pl
import pytest

from chainshaper.analysis.chains import find_chain
from chainshaper.analysis.graph import ApplicationDescription
from chainshaper.reporting.graph_drawing import MOST_NODES, write_picture
from chainshaper.reporting.graph_folding import colour_of, fold, folds_of
from chainshaper.values.application import ApplicationGraph, Callback, Node
from chainshaper.values.errors import InputError

# Node → topic that triggers it, and topics that it publishes.
WIRED: dict[str, tuple[str | None, tuple[str, ...]]] = {
    "/sensing/lidar/driver": (None, ("/raw",)),
    "/sensing/lidar/filter": ("/raw", ("/points", "/debug")),
    "/sensing/gnss": (None, ("/pose",)),
    "/planning/planner": ("/points", ("/trajectory",)),
    "/planning/route": ("/pose", ("/goal", "/route")),
    "/control/follower": ("/trajectory", ("/command",)),
    "/monitor": ("/debug", ()),
}


def graph_with(
    wired: dict[str, tuple[str | None, tuple[str, ...]]], pids: dict[str, int] | None = None
) -> ApplicationGraph:
    """Make a graph of nodes with a callback each."""
    callbacks: list[Callback] = []
    publishers: dict[str, tuple[str, ...]] = {}
    subscribers: dict[str, tuple[str, ...]] = {}
    for number, (node, (read, written)) in enumerate(wired.items()):
        kind: Literal["timer", "subscription"] = "timer" if read is None else "subscription"
        period = 100_000_000 if read is None else None
        callbacks.append(
            Callback(
                id=number,
                kind=kind,
                node=node,
                pid=(pids or {}).get(node, number),
                handle=number,
                topic=read,
                period_ns=period,
                publishes=written,
            )
        )
        for topic in written:
            publishers[topic] = (*publishers.get(topic, ()), node)
        if read is not None:
            subscribers[read] = (*subscribers.get(read, ()), node)
    nodes = tuple(Node(node, (pids or {}).get(node, n)) for n, node in enumerate(wired))
    return ApplicationGraph(nodes, tuple(callbacks), publishers, subscribers)


def described(graph: ApplicationGraph) -> ApplicationDescription:
    """Describe a graph without services, losses and notes."""
    return ApplicationDescription(graph, pl.DataFrame(), {}, ())


def test_the_largest_namespace_is_parted_while_there_is_room() -> None:
    graph = graph_with(WIRED)
    names = {most: [part.name for part in folds_of(graph, most)] for most in (1, 4, 5)}
    whole = ["/control/follower", "/monitor", "/planning", "/sensing/…"]
    assert names[4] == whole  # /planning has no namespace below it, so it is all of it
    # A fold of one node has its name; /sensing has a node itself, and two in /sensing/lidar.
    parted = ["/control/follower", "/monitor", "/planning", "/sensing/gnss", "/sensing/lidar"]
    assert names[5] == parted
    assert names[1] == whole  # there are no larger boxes than first parts of names
    every = [node for part in folds_of(graph, 5) for node in part.nodes]
    assert sorted(every) == sorted(WIRED)
    assert {part.name: part.callbacks for part in folds_of(graph, 5)}["/sensing/lidar"] == 2


def test_nodes_without_a_namespace_are_folded_by_process() -> None:
    wired: dict[str, tuple[str | None, tuple[str, ...]]] = {
        f"/node{number}": (None, ()) for number in range(6)
    }
    containers = {node: 1 + place % 2 for place, node in enumerate(wired)}
    assert [(part.name, len(part.nodes)) for part in folds_of(graph_with(wired, containers))] == [
        ("process 1", 3),
        ("process 2", 3),
    ]
    (part,) = folds_of(graph_with(wired))  # a process each says nothing
    assert (part.name, part.text) == ("/", "6 nodes, 6 callbacks")


def test_topics_between_folds_are_one_arrow_and_a_chain_stands_for_itself() -> None:
    application = described(graph_with(WIRED))
    folded = fold(application)
    names = [part.name for part in folded.folds]
    bundles = {
        (names[source], names[target]): topics
        for (source, target), topics in folded.bundles.items()
        if isinstance(source, int) and isinstance(target, int)
    }
    assert bundles == {
        ("/sensing/lidar", "/planning"): ("/points",),
        ("/sensing/lidar", "/monitor"): ("/debug",),
        ("/sensing/gnss", "/planning"): ("/pose",),
        ("/planning", "/control/follower"): ("/trajectory",),
    }  # /raw stays within its fold
    assert not folded.shown.graph.nodes

    folded = fold(application, find_chain(application.graph, "/raw../command"))
    assert {node.name for node in folded.shown.graph.nodes} == {
        "/sensing/lidar/driver",
        "/sensing/lidar/filter",
        "/planning/planner",
        "/control/follower",
    }
    assert [(part.name, part.nodes) for part in folded.folds] == [
        ("/monitor", ("/monitor",)),
        ("/planning", ("/planning/route",)),
        ("/sensing/gnss", ("/sensing/gnss",)),
    ]
    assert dict(folded.bundles) == {("/sensing/lidar/filter", 0): ("/debug",), (2, 1): ("/pose",)}
    # Of the chain's topics nobody in a fold reads any.
    assert not folded.read
    assert not folded.written


def test_an_unfolded_namespace_has_its_topics() -> None:
    folded = fold(described(graph_with(WIRED)), unfolded=["/sensing"])
    assert {node.name for node in folded.shown.graph.nodes} == {
        node for node in WIRED if node.startswith("/sensing")
    }
    shown = folded.shown.graph
    assert {topic for callback in shown.callbacks for topic in callback.publishes} == {"/raw"}
    assert [part.name for part in folded.folds] == ["/control/follower", "/monitor", "/planning"]
    assert fold(described(graph_with(WIRED)), unfolded=["/"]).folds == ()


def test_a_topic_that_joins_most_boxes_is_only_named() -> None:
    wired: dict[str, tuple[str | None, tuple[str, ...]]] = {"/tree/source": (None, ("/tf",))}
    wired |= {f"/part{number}/reader": ("/tf", ("/unread",)) for number in range(8)}
    folded = fold(described(graph_with(wired)))
    assert folded.common == ("/tf",)
    assert not folded.bundles
    without = {name: wired[name] for name in list(wired)[:-2]}  # seven boxes are few
    assert not fold(described(graph_with(without))).common


def large() -> ApplicationDescription:
    """An application of one node more than a picture shows."""
    wired = {**WIRED}
    wired |= {
        f"/tools/tool{number}": ("/pose", ()) for number in range(MOST_NODES + 1 - len(WIRED))
    }
    return described(graph_with(wired))


def test_pictures_of_large_applications_are_folded(tmp_path: Path) -> None:
    application = large()
    picture = write_picture(application, tmp_path / "graph.svg", chain="/raw../command")
    svg = picture.read_text()
    ET.fromstring(svg)  # noqa: S314 - written by the line above
    assert ">/tools</text>" in svg
    assert ">/tools/tool1</text>" not in svg
    assert svg.count('class="arrow chain"') == 7  # four topics, of which three are read
    assert f'style="fill: {colour_of("/tools/tool1")}"' in svg
    unfolded = write_picture(application, tmp_path / "all.svg", unfolded=["/"]).read_text()
    assert ">/tools/tool1</text>" in unfolded
    png = write_picture(application, tmp_path / "graph.png", unfolded=["/sensing/lidar"])
    assert png.read_bytes().startswith(b"\x89PNG")
    graph = application.graph
    small = replace(application, graph=replace(graph, nodes=graph.nodes[: len(WIRED)]))
    small = replace(
        small, graph=replace(small.graph, callbacks=graph.callbacks[: len(WIRED)], subscribers={})
    )
    assert ">/sensing/gnss</text>" in write_picture(small, tmp_path / "small.svg").read_text()


def test_an_unknown_namespace_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--unfold /sensin: no node .* write /sensing"):
        write_picture(large(), tmp_path / "graph.svg", unfolded=["/sensin"])
    assert not [*tmp_path.iterdir()]
