"""The application graph: as plain data, as a table, and as a picture (SVG, PNG, DOT for Graphviz).

Nodes are boxes of callbacks, with topics between them; arrows run from the callback that publishes
a topic to the callbacks that it triggers. A dashed arrow is a topic that another callback of the
node publishes for this one (synchronisers, stored messages). An arrow at a node's title stands for
publications outside its callbacks, or for subscriptions without callback events. The services and
topics that every node has (parameter services, /rosout, /parameter_events) are left out of tables
and pictures unless asked for; in JSON they are marked. With a chain, arrows and callbacks have the
times that were recorded, and the chain's own arrows are thick.

The layout is that of Sugiyama, Tagawa and Toda (1981). Edges that close cycles are turned around.
Every box gets a column, as far left as its predecessors permit. Columns are sorted so that few
edges cross (barycentres, swept back and forth). Heights are least squares under the order and the
gaps of a column, so that edges run straight. An edge over several columns has a place in each.
Parts that are not connected are laid out one below the other.
"""

import json
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import polars as pl

from chainshaper.analysis import DataFlow, callback_statistics
from chainshaper.analysis.chains import depth_first_order, find_chain
from chainshaper.analysis.edge_times import edge_times
from chainshaper.analysis.graph import ApplicationDescription
from chainshaper.planning.offsets import linked
from chainshaper.reporting.graph_folding import (
    Fold,
    FoldedGraph,
    colour_of,
    fold,
    folds_of,
    namespace_of,
)
from chainshaper.reporting.tables import Column, ResultTable, listed, ms, words
from chainshaper.values.application import (
    INTERNAL_SERVICES,
    INTERNAL_TOPICS,
    ApplicationGraph,
    Callback,
    Chain,
    period_text,
)
from chainshaper.values.close_names import close_names
from chainshaper.values.errors import InputError, escape, shown
from chainshaper.values.files import new_file, write_whole
from chainshaper.values.recording import lost_text

ENDINGS = (".svg", ".png", ".dot", ".json")

_LEFT_OUT_TOPICS = INTERNAL_TOPICS - {"/clock"}
_LAMBDA = re.compile(r"\{lambda\(.*?\)#(\d+)\}$")
_BIND = re.compile(r"std::_Bind<.*?\((\w[\w:]*)::\*")

# Lengths in pixels.
COLUMN_GAP = 48.0
TIMED_GAP = 84.0  # of columns between which arrows have times
ROW_GAP = 22.0
PLACE_HEIGHT = 6.0  # of the place of an edge that passes a column
SWEEPS = 16  # how often columns are swept, to sort them and to choose heights

MARGIN = 24.0
CHARACTER = 7.3  # width of a character of 12 px
SMALL = 6.3  # width of a character of 10 px
MOST_NODES = 40  # of a picture; more are folded by their namespaces
TITLE, ROW, PILL, PAD = 28.0, 36.0, 26.0, 10.0
TURN = 45.0  # how far an arrow goes on before it turns around
LONGEST = 46  # characters of a function's name
LISTED_TOPICS = 20  # that pointing at an arrow of many topics names
COLOURS = {
    "timer": "#c2571a",
    "subscription": "#1f6fb2",
    "service": "#6b4fa0",
    "client": "#3b7d4f",
    "loop": "#8a6d00",
    "unknown": "#777777",
}
# A report has several pictures beside other drawings: each rule is for these pictures alone.
_DEFINED = """\
<defs><marker id="graph-tip" viewBox="0 0 10 10" refX="9" refY="5" markerUnits="userSpaceOnUse"
  markerWidth="9" markerHeight="9" orient="auto-start-reverse">
  <path d="M 0 1 L 10 5 L 0 9 z" fill="#555"/></marker><style>
.graph text { font: 12px "DejaVu Sans", Verdana, Helvetica, Arial, sans-serif; fill: #1a1a1a; }
.graph .title { font-weight: bold; } .graph .small { font-size: 10px; fill: #666; }
.graph .node { fill: #fff; stroke: #444; stroke-width: 1.3; } .graph .head { fill: #eceff3; }
.graph .line { stroke: #d5d9df; } .graph .topic { fill: #fff6d6; stroke: #b8962e; }
.graph .arrow { fill: none; stroke: #555; stroke-width: 1.3; marker-end: url(#graph-tip); }
.graph .passes { stroke-dasharray: 5 4; } .graph .back { stroke: #b03a3a; }
.graph .chain { stroke-width: 3; } .graph .bundle { stroke: #9aa4b1; stroke-width: 1; }
.graph .bundle.back { stroke: #cf9a9a; } .graph .bundle:hover { stroke: #1a1a1a; stroke-width: 3; }
.graph .fold { stroke-dasharray: 6 3; }
.graph .time { font-size: 10px; fill: #8a3d00; stroke: #fff; stroke-width: 3;
  paint-order: stroke; }
</style></defs>"""


Point: TypeAlias = tuple[float, float]


def is_internal(name: str | None) -> bool:
    """Whether a topic or service is one that every node has."""
    return name is not None and (
        name in _LEFT_OUT_TOPICS or name.rpartition("/")[2] in INTERNAL_SERVICES
    )


def without_internals(application: ApplicationDescription) -> ApplicationDescription:
    """The application without the topics, services and callbacks that every node has."""
    graph = application.graph
    callbacks = tuple(
        replace(
            callback,
            publishes=tuple(topic for topic in callback.publishes if not is_internal(topic)),
        )
        for callback in graph.callbacks
        if not is_internal(callback.topic)
    )
    publishers, subscribers = (
        {topic: nodes for topic, nodes in ends.items() if not is_internal(topic)}
        for ends in (graph.publishers, graph.subscribers)
    )
    left = replace(graph, callbacks=callbacks, publishers=publishers, subscribers=subscribers)
    return replace(application, graph=left)


def application_json(application: ApplicationDescription) -> dict[str, Any]:
    """Nodes, callbacks, topics and services as plain data."""
    graph = application.graph
    names = ("id", "node", "pid", "kind", "topic", "period_ns", "declared_ns")
    written = ("symbol", "publishes", "passes_on")
    callbacks = [
        {name: getattr(callback, name) for name in (*names, *written)}
        | {"pids": list(callback.processes), "internal": is_internal(callback.topic)}
        for callback in graph.callbacks
    ]
    topics = []
    for topic in graph.topics:
        ends = graph.publishers.get(topic, ()), graph.subscribers.get(topic, ())
        entry = {"name": topic, "publishers": list(ends[0]), "subscribers": list(ends[1])}
        topics.append({**entry, "internal": is_internal(topic)})
    services: dict[str, dict[str, Any]] = {}
    rows = application.services.sort("service", maintain_order=True)
    for name, role, node, _ in rows.iter_rows():
        fresh = {"name": name, "servers": [], "clients": [], "internal": is_internal(name)}
        services.setdefault(name, fresh)[f"{role}s"].append(node or "")
    return {
        "nodes": [
            {"name": node.name, "pid": node.pid, "pids": list(node.processes)}
            for node in graph.nodes
        ],
        "callbacks": callbacks,
        "topics": topics,
        "services": list(services.values()),
        "lost": application.lost,
        "notes": list(application.notes),
    }


def application_table(application: ApplicationDescription) -> ResultTable:
    """Make a table of callbacks, sorted by node."""
    names = [*words("node"), Column("process"), *words("callback", "publishes", "function")]
    table = ResultTable("Application", names)
    for node in sorted(_nodes(application), key=lambda node: (node.name, node.pid)):
        cells = [
            (callback_text(callback), ", ".join(callback.publishes), short_symbol(callback.symbol))
            for callback in node.callbacks
        ]
        for row in cells or [("", "", "")]:
            table.add(node.name, node.processes, *row)
    return table


def callback_text(callback: Callback) -> str:
    """Text: what triggers a callback."""
    if callback.kind == "timer":
        return f"timer {period_text(callback.period_ns or 0, callback.declared_ns)}"
    if callback.kind == "loop":
        return (
            f"loop {period_text(callback.period_ns, None) if callback.period_ns else ''}".rstrip()
        )
    if callback.kind == "unknown":
        return "not known" if callback.handle else "outside callbacks"
    return f"{callback.kind} {callback.topic or ''}".rstrip()


def short_symbol(symbol: str | None) -> str:
    """The name of a registered function without its arguments: ``Filter λ1``."""
    if not symbol:
        return ""
    bound = _BIND.match(symbol)
    if bound is not None:
        return f"{bound[1]}::…"
    ending = _LAMBDA.search(symbol)
    depth, outside = 0, []  # the text outside all <…>, (…) and {…}
    for character in symbol[: ending.start()] if ending else symbol:
        depth += character in "<({"
        if depth == 0:
            outside.append(character)
        depth -= character in ">)}"
    text = re.sub(r"^(void|.* )(?=\S+$)", "", "".join(outside)).removesuffix("::")
    text = re.sub(r"(\w+)::\1$", r"\1", text)  # a constructor
    return f"{text} λ{ending[1]}" if ending else text


class Time(NamedTuple):
    """How long something took, of all that was recorded (ns)."""

    mean: float
    max: int
    samples: int

    @property
    def text(self) -> str:
        """Text: the mean, and the maximum."""
        return f"{ms(self.mean)} ms, max {ms(self.max)}"


@dataclass(frozen=True)
class GraphTimes:
    """The times that a picture has beside arrows and callbacks, and the chain in it."""

    communication: Mapping[tuple[str, int], Time]  # topic and id of the callback that got it
    response: Mapping[int, Time]  # id of the callback
    reads: frozenset[tuple[str, int]]  # topics and callbacks of the chain
    writes: frozenset[tuple[int, str]]  # callbacks and topics of the chain


NO_TIMES = GraphTimes({}, {}, frozenset(), frozenset())


@dataclass(frozen=True)
class _NodeBox:
    """A node in the picture: a title, and a row for each callback."""

    name: str
    pid: int
    processes: str  # their ids, several of a node that was started again
    callbacks: Sequence[Callback]
    times: Mapping[int, Time]  # of callbacks, by id

    @property
    def box(self) -> "Box":
        widths = [CHARACTER * (len(self.name) + 1) + SMALL * (len(self.processes) + 4)]
        for callback in self.callbacks:
            trigger, function = _row_texts(callback)
            time = self.times.get(callback.id)
            beside = SMALL * (len(time.text) + 2) if time is not None else 0.0
            widths += [CHARACTER * len(trigger) + 14 + beside, SMALL * len(function) + 14]
        return Box(max(widths) + 2 * PAD, TITLE + ROW * len(self.callbacks))

    def svg(self, corner: Point) -> str:
        width, height = self.box
        parts = [
            _group(corner, "item"),
            f'<rect class="node" width="{width:.1f}" height="{height:.1f}" rx="5"/>',
            f'<rect class="head" x="1" y="1" width="{width - 2:.1f}" height="{TITLE - 2:.1f}"'
            f' rx="4" style="fill: {colour_of(namespace_of(self.name))}"/>'
            if namespace_of(self.name) != "/"
            else f'<rect class="head" x="1" y="1" width="{width - 2:.1f}"'
            f' height="{TITLE - 2:.1f}" rx="4"/>',
            f'<text class="title" x="{PAD}" y="18">{escape(self.name)}</text>',
            f'<text class="small" x="{width - PAD:.1f}" y="18" text-anchor="end">'
            f"{self.processes}</text>",
        ]
        for row, callback in enumerate(self.callbacks):
            top, (trigger, function) = TITLE + ROW * row, _row_texts(callback)
            about = f"{callback.label}\n{callback.symbol}" if callback.symbol else callback.label
            parts += [
                f"<g><title>{escape(about)}</title>",
                f'<line class="line" x1="1" x2="{width - 1:.1f}" y1="{top}" y2="{top}"/>',
                f'<rect x="{PAD}" y="{top + 9}" width="6" height="18" rx="2"'
                f' fill="{COLOURS[callback.kind]}"/>',
                f'<text x="{PAD + 14}" y="{top + 16}">{escape(trigger)}</text>',
                f'<text class="small" x="{PAD + 14}" y="{top + 29}">{escape(function)}</text></g>',
            ]
            if (time := self.times.get(callback.id)) is not None:
                parts.append(_time_text((width - PAD, top + 16), time.text, time.samples))
        return "\n".join([*parts, "</g>"])


def _row_texts(callback: Callback) -> tuple[str, str]:
    """Texts of a callback's row: what triggers it (a topic has an arrow), and its function."""
    trigger = callback.kind if callback.kind == "subscription" else callback_text(callback)
    function = short_symbol(callback.symbol)
    return trigger, function if len(function) <= LONGEST else function[: LONGEST - 1] + "…"


def _nodes(application: ApplicationDescription, times: GraphTimes = NO_TIMES) -> list[_NodeBox]:
    """Make a box for each node, and for each process of nodes that ran at the same time."""
    graph = application.graph
    rows: dict[tuple[str, int], list[Callback]] = {
        (node.name, node.pid): [] for node in graph.nodes
    }
    for callback in graph.callbacks:
        rows.setdefault((callback.node, callback.pid), []).append(callback)
    processes = {(node.name, node.pid): listed(node.processes) for node in graph.nodes}
    return [
        _NodeBox(name, pid, processes.get((name, pid), str(pid)), callbacks, times.response)
        for (name, pid), callbacks in rows.items()
    ]


@dataclass(frozen=True)
class _FoldBox:
    """A folded namespace in the picture."""

    number: int
    fold: Fold

    @property
    def box(self) -> "Box":
        widths = CHARACTER * (len(self.fold.name) + 1), SMALL * len(self.fold.text)
        return Box(max(widths) + 2 * PAD, TITLE + ROW / 2)

    def svg(self, corner: Point) -> str:
        width, height = self.box
        about = "\n".join((self.fold.name, *self.fold.nodes))
        return "\n".join(
            (
                f"{_group(corner, 'item fold-box')}<title>{escape(about)}</title>"
                f'<rect class="node fold" width="{width:.1f}" height="{height:.1f}" rx="5"'
                f' style="fill: {colour_of(self.fold.name)}"/>',
                f'<text class="title" x="{PAD}" y="18">{escape(self.fold.name)}</text>',
                f'<text class="small" x="{PAD}" y="36">{escape(self.fold.text)}</text></g>',
            )
        )


def folded_svg(folded: FoldedGraph, times: GraphTimes = NO_TIMES) -> str:
    """Draw the picture of a folded application, as the text of an SVG file."""
    return _picture(folded.shown, times, folded)


def application_svg(application: ApplicationDescription, times: GraphTimes = NO_TIMES) -> str:
    """Draw the picture, as the text of an SVG file."""
    return _picture(application, times, None)


def _picture(
    application: ApplicationDescription, times: GraphTimes, folded: FoldedGraph | None
) -> str:
    """Draw an application, and, where it is ``folded``, the boxes of its namespaces."""
    drawn = _nodes(application, times)
    topics = [t for t in application.graph.topics if t and not t.startswith("ros_")]
    arrows = list(_arrows(application, drawn, topics, times))
    nodes: list[_NodeBox | _FoldBox] = [*drawn]
    if folded is not None:
        nodes += (_FoldBox(number, part) for number, part in enumerate(folded.folds))
        moved = len(folded.folds)  # topics come behind the folds
        arrows = [arrow.behind(len(drawn), moved) for arrow in arrows]
        arrows += _bundles(folded, drawn, topics)
    pills = [Box(CHARACTER * len(topic) + 2 * PAD, PILL) for topic in topics]
    boxes = [*(node.box for node in nodes), *pills]
    arrows.sort(key=lambda arrow: "chain" not in arrow.style)  # which turns no arrow of the chain
    routed = arrows if folded is None else _strongest(arrows)
    chain = next((a.edge.source for a in arrows if "chain" in a.style and _begins(a, arrows)), None)
    layout = lay_out(
        boxes,
        [arrow.edge for arrow in routed],
        COLUMN_GAP if times is NO_TIMES else TIMED_GAP,
        first=chain,
    )
    if folded is not None:  # the others lead straight on, behind the boxes
        placed = [*zip(routed, layout.routes, strict=True)]
        placed += [(a, _straight(a.edge, boxes, layout)) for a in arrows if a not in routed]
        placed.sort(key=lambda drawn: "bundle" not in drawn[0].style)
        arrows = [arrow for arrow, _ in placed]
        layout = layout._replace(routes=[route for _, route in placed])
    width, height = layout.width + 2 * MARGIN, layout.height + 2 * MARGIN
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" class="graph" width="{width:.0f}"'
        f' height="{height:.0f}" viewBox="{-MARGIN} {-MARGIN} {width:.1f} {height:.1f}">',
        _DEFINED,
        f'<rect x="{-MARGIN}" y="{-MARGIN}" width="{width:.1f}" height="{height:.1f}"'
        ' fill="#fff"/>',
    ]
    for route, arrow in zip(layout.routes, arrows, strict=True):
        parts.append(_arrow(route, arrow.style, arrow.about))
    parts += [node.svg(corner) for node, corner in zip(nodes, layout.corners, strict=False)]
    for topic, pill, corner in zip(topics, pills, layout.corners[len(nodes) :], strict=True):
        parts.append(
            f"{_group(corner, 'item')}"
            f'<rect class="topic" width="{pill.width:.1f}" height="{PILL:.1f}" rx="13"/>'
            f'<text x="{pill.width / 2:.1f}" y="17" text-anchor="middle">{escape(topic)}</text></g>'
        )
    for route, arrow in zip(layout.routes, arrows, strict=True):
        if arrow.time is not None:
            x, y = route[-1]
            mean, most = f"{ms(arrow.time.mean)} ms", f"max {ms(arrow.time.max)}"
            parts.append(_time_text((x - 11, y - 5), mean, arrow.time.samples))
            parts.append(_time_text((x - 11, y + 13), most, arrow.time.samples))
    if folded is not None and folded.common:
        text = f"not drawn, for most of the boxes have them: {', '.join(folded.common)}"
        y = layout.height + MARGIN - 2
        parts.append(f'<text class="small" x="0" y="{y:.1f}">{escape(text)}</text>')
    if any(application.lost.values()):
        y, text = layout.height + MARGIN / 2, escape(lost_text(application.lost))
        parts.append(f'<text class="small" x="0" y="{y:.1f}">{text}</text>')
    return "\n".join([*parts, "</svg>", ""])


def _time_text(end: Point, text: str, samples: int) -> str:
    """Draw a time that ends at a point; pointing at it says of how many it is."""
    x, y = end
    return (
        f'<text class="time" x="{x:.1f}" y="{y:.1f}" text-anchor="end">{text}'
        f"<title>of {samples}</title></text>"
    )


def timed_graph_svg(flow: DataFlow, graph: ApplicationGraph, chain: Chain | None = None) -> str:
    """Draw an application's graph with the times that were recorded, and a chain in it, as SVG.

    More than `MOST_NODES` nodes are folded by their namespaces, but the chain's.
    """
    application = without_internals(ApplicationDescription(graph, pl.DataFrame(), {}, ()))
    times = _times(flow, chain)
    if len(graph.nodes) > MOST_NODES:
        return folded_svg(fold(application, chain), times)
    return application_svg(application, times)


def timed_fold_svgs(
    flow: DataFlow, graph: ApplicationGraph, chain: Chain | None = None
) -> list[tuple[Fold, str]]:
    """Draw each namespace of an application by itself, as SVG, unfolded; the others stay folded.

    An application of `MOST_NODES` nodes or fewer has none: the picture of it all shows them.
    """
    application = without_internals(ApplicationDescription(graph, pl.DataFrame(), {}, ()))
    if len(graph.nodes) <= MOST_NODES:
        return []
    times = _times(flow, chain)
    return [
        (part, application_svg(_with_nodes_alone(application, {*part.nodes}), times))
        for part in folds_of(application.graph)
    ]


def _times(flow: DataFlow, chain: Chain | None) -> GraphTimes:
    """Return the times that a recording has of messages and callbacks, and a chain's arrows."""
    topics, callbacks = ((), ()) if chain is None else (chain.topics, chain.callbacks)
    return GraphTimes(
        communication={
            (row["topic"], row["callback_id"]): _time(row["communication_ns"], row["count"])
            for row in edge_times(flow).iter_rows(named=True)
        },
        response={
            row["callback_id"]: _time(row["response_ns"], row["count"] - row["unfinished"])
            for row in callback_statistics(flow).iter_rows(named=True)
            if row["response_ns"] is not None and row["response_ns"]["mean"] is not None
        },
        reads=frozenset(zip(topics, callbacks[1:], strict=False)),
        writes=frozenset(zip(callbacks, topics, strict=True)),
    )


def _time(figures: Mapping[str, Any], samples: int) -> Time:
    return Time(figures["mean"], figures["max"], samples)


def _with_nodes_alone(
    application: ApplicationDescription, names: set[str]
) -> ApplicationDescription:
    """Return the application with these nodes, and the topics that they publish or read, alone."""
    graph = application.graph
    publishers, subscribers = (
        {topic: kept for topic, ends in of_topics.items() if (kept := tuple(names & {*ends}))}
        for of_topics in (graph.publishers, graph.subscribers)
    )
    left = replace(
        graph,
        nodes=tuple(node for node in graph.nodes if node.name in names),
        callbacks=tuple(callback for callback in graph.callbacks if callback.node in names),
        publishers=publishers,
        subscribers=subscribers,
    )
    return replace(application, graph=left)


def _group(corner: Point, kind: str) -> str:
    return f'<g class="{kind}" transform="translate({corner[0]:.1f} {corner[1]:.1f})">'


class _Arrow(NamedTuple):
    """An arrow in the picture: its class, and the time of the messages along it."""

    edge: "Edge"
    style: str = "arrow"
    time: Time | None = None
    about: str = ""  # what pointing at it says
    topics: int = 1  # how many it stands for
    of_topic: bool = False  # whether it leads to or from a topic

    def behind(self, first: int, by: int) -> "_Arrow":
        """Return the arrow where the boxes from ``first`` on have so much larger numbers."""
        ends = {
            name: end + by
            for name, end in (("source", self.edge.source), ("target", self.edge.target))
            if end >= first
        }
        return self._replace(edge=self.edge._replace(**ends))


def _arrows(
    application: ApplicationDescription,
    nodes: list[_NodeBox],
    topics: list[str],
    times: GraphTimes,
) -> Iterator[_Arrow]:
    """Yield the arrows between callbacks and topics.

    Where no callback of a node is known to publish or read a topic, its title has the arrow.
    """
    graph = application.graph
    place = {topic: len(nodes) + index for index, topic in enumerate(topics)}
    for index, node in enumerate(nodes):
        writes: set[str] = set()
        reads: set[str | None] = set()
        for row, callback in enumerate(node.callbacks):
            height = TITLE + ROW * (row + 0.5)
            if (trigger := callback.trigger) is not None and trigger in place:
                edge, read = Edge(place[trigger], index, PILL / 2, height), (trigger, callback.id)
                style = "arrow chain" if read in times.reads else "arrow"
                yield _Arrow(edge, style, times.communication.get(read))
                reads.add(trigger)
            for topic in filter(place.__contains__, callback.publishes):
                style = "arrow passes" if topic in callback.passes_on else "arrow"
                style += " chain" if (callback.id, topic) in times.writes else ""
                yield _Arrow(Edge(index, place[topic], height, PILL / 2), style)
                writes.add(topic)
        for topic in topics:
            if node.name in graph.publishers.get(topic, ()) and topic not in writes:
                yield _Arrow(Edge(index, place[topic], TITLE / 2, PILL / 2))
            if node.name in graph.subscribers.get(topic, ()) and topic not in reads:
                yield _Arrow(Edge(place[topic], index, PILL / 2, TITLE / 2))


def _bundles(
    folded: FoldedGraph, drawn: Sequence[_NodeBox], topics: Sequence[str]
) -> Iterator[_Arrow]:
    """Yield the arrows that stand for many topics, and those between folds and topics."""
    fold_height, first = (TITLE + ROW / 2) / 2, len(drawn)
    place_of_topic = {topic: first + len(folded.folds) + n for n, topic in enumerate(topics)}
    place_of_node = {node.name: number for number, node in enumerate(drawn)}

    def end(box: int | str) -> tuple[int, float]:
        if isinstance(box, int):
            return first + box, fold_height
        return place_of_node[box], TITLE / 2

    for (source, target), names in folded.bundles.items():
        (begins, leaves), (ends, enters) = end(source), end(target)
        about = "\n".join((*names[:LISTED_TOPICS], *(["…"] if names[LISTED_TOPICS:] else [])))
        edge = Edge(begins, ends, leaves, enters)
        yield _Arrow(edge, "arrow bundle", about=about, topics=len(names))
    for box, topic in sorted(folded.written):
        edge = Edge(first + box, place_of_topic[topic], fold_height, PILL / 2)
        yield _Arrow(edge, "arrow bundle", about=topic, of_topic=True)
    for topic, box in sorted(folded.read):
        edge = Edge(place_of_topic[topic], first + box, PILL / 2, fold_height)
        yield _Arrow(edge, "arrow bundle", about=topic, of_topic=True)


def _begins(arrow: _Arrow, arrows: Sequence[_Arrow]) -> bool:
    """Return whether an arrow of the chain is its first."""
    return not any("chain" in a.style and a.edge.target == arrow.edge.source for a in arrows)


def _strongest(arrows: Sequence[_Arrow]) -> list[_Arrow]:
    """Return the arrows by which boxes are placed: of many topics, the strongest of each box."""
    most: dict[int, _Arrow] = {}
    for arrow in arrows:
        if "bundle" in arrow.style and not arrow.of_topic:
            before = most.get(arrow.edge.source)
            if before is None or before.topics < arrow.topics:
                most[arrow.edge.source] = arrow
    placing = {id(arrow) for arrow in most.values()}
    return [arrow for arrow in arrows if "bundle" not in arrow.style or id(arrow) in placing]


def _straight(edge: "Edge", boxes: Sequence["Box"], layout: "Layout") -> list[Point]:
    """Return the route of an arrow that passes behind the boxes."""
    (from_x, from_y), (to_x, to_y) = layout.corners[edge.source], layout.corners[edge.target]
    start = (from_x + boxes[edge.source].width, from_y + edge.leaves)
    return [start, (to_x, to_y + edge.enters)]


def _arrow(route: list[Point], style: str, about: str = "") -> str:
    """Draw an arrow: horizontal ends, curves between columns.

    Backward arrows turn around at both ends.
    """
    backwards = route[-1][0] < route[0][0]
    (x, y), *rest = route
    path = [f"M {x:.1f} {y:.1f}"]
    heading = 1.0
    for number, (to_x, to_y) in enumerate(rest, start=1):
        after = -1.0 if backwards and number < len(rest) else 1.0
        turns = heading != after or (backwards and after > 0)
        reach = TURN if turns else abs(to_x - x) / 2
        path.append(
            f"C {x + heading * reach:.1f} {y:.1f} {to_x - after * reach:.1f} {to_y:.1f}"
            f" {to_x:.1f} {to_y:.1f}"
        )
        x, y, heading = to_x, to_y, after
    begun = f'<path class="{style}{" back" if backwards else ""}" d="{" ".join(path)}"'
    return f"{begun}><title>{escape(about)}</title></path>" if about else f"{begun}/>"


def application_dot(application: ApplicationDescription) -> str:
    """The graph in the language of Graphviz: a cluster per node, ellipses for topics."""
    graph = application.graph
    lines = ["digraph application {", "  rankdir=LR;", "  node [fontname=Helvetica, fontsize=11];"]
    if any(application.lost.values()):
        lines.append(f"  label={_quoted(lost_text(application.lost))};")
    for index, node in enumerate(_nodes(application)):
        title = _quoted(f"{node.name} (process {node.processes})")
        lines += [f"  subgraph cluster_{index} {{", f"    label={title};"]
        lines.append(f'    node_{index} [shape=point, style=invis, label=""];')
        for callback in node.callbacks:
            label = _quoted(f"{callback_text(callback)}\n{short_symbol(callback.symbol)}".strip())
            lines.append(f"    callback_{callback.id} [shape=box, label={label}];")
        lines.append("  }")
    lines += [f"  {_quoted(topic)} [shape=ellipse];" for topic in graph.topics]
    for callback in graph.callbacks:
        vertex, trigger = f"callback_{callback.id}", callback.topic
        if callback.trigger in graph.topics:
            trigger = callback.trigger
        elif trigger is not None:  # a service without events of its calls
            lines.append(f"  {_quoted(trigger)} [shape=cds];")
        if trigger is not None:
            lines.append(f"  {_quoted(trigger)} -> {vertex};")
        for topic in callback.publishes:
            style = " [style=dashed]" if topic in callback.passes_on else ""
            lines.append(f"  {vertex} -> {_quoted(topic)}{style};")
    return "\n".join([*lines, "}", ""])


def _quoted(text: str) -> str:
    escaped = shown(text, but="\n").replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'


def write_picture(
    application: ApplicationDescription,
    path: str | Path,
    *,
    everything: bool = False,
    chain: str | None = None,
    unfolded: Sequence[str] = (),
) -> Path:
    """Write the graph as .svg, .png, .dot or .json, by ``path``'s ending, whole or not at all.

    A picture of more than `MOST_NODES` nodes is folded by namespace; those that are ``unfolded``,
    with all below them, and the nodes of the ``chain`` stand for themselves. The chain's arrows are
    thick.

    Raises InputError: it exists, its folder does not, its ending says no known format, or there is
    no such chain or namespace. OperationError: it cannot be written.
    """
    path = new_file(path, ENDINGS)
    drawn = application if everything else without_internals(application)
    known = None if chain is None else find_chain(application.graph, chain)
    _refuse_unknown(application.graph, unfolded)
    if path.suffix == ".png":
        return write_whole(path, [png_of(_folded_if_large(drawn, known, unfolded))])
    if path.suffix == ".json":
        text = json.dumps(application_json(application), indent=2) + "\n"
    elif path.suffix == ".dot":
        text = application_dot(drawn)
    else:
        text = _folded_if_large(drawn, known, unfolded)
    return write_whole(path, [text.encode()])


def _folded_if_large(
    application: ApplicationDescription, chain: Chain | None, unfolded: Sequence[str]
) -> str:
    """Draw an application as SVG, without times; fold it where it is large."""
    times = NO_TIMES
    if chain is not None:
        reads = frozenset(zip(chain.topics, chain.callbacks[1:], strict=False))
        writes = frozenset(zip(chain.callbacks, chain.topics, strict=True))
        times = GraphTimes({}, {}, reads, writes)
    if len(application.graph.nodes) <= MOST_NODES:
        return application_svg(application, times)
    return folded_svg(fold(application, chain, unfolded), times)


def _refuse_unknown(graph: ApplicationGraph, namespaces: Sequence[str]) -> None:
    """Raise InputError if a namespace is that of no node."""
    known = sorted({part.name.removesuffix("/…") for part in folds_of(graph)})
    names = {node.name for node in graph.nodes} | {*known}
    for wanted in namespaces:
        if not any(name == wanted or name.startswith(f"{wanted.rstrip('/')}/") for name in names):
            close = " or ".join(close_names(wanted, known)) or ", ".join(known[:5])
            raise InputError(f"--unfold {wanted}: no node is in that namespace; write {close}")


def png_of(svg: str) -> bytes:
    """Paint a picture, twice as large as it is in SVG; its letters are matplotlib's."""
    import matplotlib as mpl
    import resvg_py

    fonts = str(Path(mpl.get_data_path()) / "fonts" / "ttf")
    return bytes(resvg_py.svg_to_bytes(svg_string=svg, zoom=2, font_dirs=[fonts]))


class Box(NamedTuple):
    """The size of something to be placed."""

    width: float
    height: float


class Edge(NamedTuple):
    """An arrow between two boxes."""

    source: int  # number of the box
    target: int
    leaves: float  # height inside the source where it begins
    enters: float  # height inside the target where it ends


class Layout(NamedTuple):
    """Where boxes and edges are placed."""

    corners: list[Point]  # the left upper ones of the boxes
    routes: list[
        list[Point]
    ]  # of each edge, from the right side of its source to its target's left
    width: float
    height: float


Beside: TypeAlias = dict[int, list[tuple[int, float, float]]]
"""Vertex → neighbour, height of the edge's end inside the vertex, share inside the neighbour."""


@dataclass
class _ConnectedPart:
    """A connected part in columns.

    Vertices are its boxes, and the places of edges that pass columns, numbered after all boxes.
    """

    layer: dict[int, int]  # vertex → number of its column
    height: dict[int, float]  # vertex → its height
    places: dict[int, list[int]] = field(default_factory=dict)  # edge → its places, left to right
    columns: list[list[int]] = field(default_factory=list)  # of each the vertices, top to bottom
    segments: list[tuple[int, int, float, float]] = field(default_factory=list)
    """Left and right vertex, and the heights inside them."""
    y: dict[int, float] = field(default_factory=dict)  # vertex → its top

    def beside(self) -> tuple[Beside, Beside]:
        """Find the neighbours of each vertex, to its left and to its right."""
        before, after = defaultdict[int, Any](list), defaultdict[int, Any](list)
        for left, right, leaves, enters in self.segments:
            before[right].append((left, enters, leaves / (self.height[left] + 1)))
            after[left].append((right, leaves, enters / (self.height[right] + 1)))
        return before, after

    def place(self) -> dict[int, int]:
        """Map each vertex to its place in its column."""
        return {v: place for column in self.columns for place, v in enumerate(column)}


def lay_out(
    boxes: Sequence[Box],
    edges: Sequence[Edge],
    gap: float = COLUMN_GAP,
    *,
    first: int | None = None,
) -> Layout:
    """Place boxes and edges, with a ``gap`` between columns.

    Of edges that close a cycle, those that come first from the box ``first`` on lead forwards.
    The cost is about that of sorting, times the number of sweeps.
    """
    corners = [(0.0, 0.0)] * len(boxes)
    routes: list[list[Point]] = [[] for _ in edges]
    top, width = 0.0, 0.0
    parts = linked(len(boxes), [(edge.source, edge.target) for edge in edges])
    for members in sorted(parts, key=len, reverse=True):
        chosen = set(members)
        edges_of_part = {number: edge for number, edge in enumerate(edges) if edge.source in chosen}
        part = _layered(members, boxes, edges_of_part, first)
        _sort_columns(part)
        _choose_heights(part)
        sides, left = [], 0.0  # left and right side of every column
        for column in part.columns:
            right = left + max(
                (boxes[vertex].width for vertex in column if vertex < len(boxes)), default=0.0
            )
            sides.append((left, right))
            left = right + gap
        lowest = min(part.y.values())
        y = {vertex: height - lowest + top for vertex, height in part.y.items()}
        for vertex in members:
            corners[vertex] = (sides[part.layer[vertex]][0], y[vertex])
        for number, edge in edges_of_part.items():
            (from_x, from_y), (to_x, to_y) = corners[edge.source], corners[edge.target]
            between = [
                (side, y[place] + PLACE_HEIGHT / 2)
                for place in part.places[number]
                for side in sides[part.layer[place]]
            ]
            if part.layer[edge.source] > part.layer[edge.target]:
                between.reverse()
            start = (from_x + boxes[edge.source].width, from_y + edge.leaves)
            routes[number] = [start, *between, (to_x, to_y + edge.enters)]
        width = max(width, sides[-1][1])
        top = max(y[vertex] + part.height[vertex] for vertex in y) + 2 * ROW_GAP
    return Layout(corners, routes, width, max(top - 2 * ROW_GAP, 0.0))


def _layered(
    chosen: list[int], boxes: Sequence[Box], edges: Mapping[int, Edge], first: int | None = None
) -> _ConnectedPart:
    """Put boxes into columns by the longest path from the sources; add places for passing edges.

    Edges close a cycle if they lead back in the order of a depth-first search from the sources.
    Sources then move right, next to the boxes that they lead to.
    """
    follows: dict[int, list[int]] = {vertex: [] for vertex in chosen}
    for edge in edges.values():
        follows[edge.source].append(edge.target)
    entered = {edge.target for edge in edges.values()}
    begun = sorted(chosen, key=lambda vertex: (vertex != first, vertex in entered))
    rank = depth_first_order(follows, begun)
    ends = {
        number: tuple(sorted((edge.source, edge.target), key=rank.__getitem__, reverse=True))
        for number, edge in edges.items()
    }
    before: dict[int, set[int]] = {vertex: set() for vertex in chosen}
    onward: dict[int, set[int]] = {vertex: set() for vertex in chosen}
    for left, right in ends.values():
        if left != right:
            before[right].add(left)
            onward[left].add(right)
    layer: dict[int, int] = {}
    for vertex in sorted(chosen, key=rank.__getitem__, reverse=True):
        layer[vertex] = max((layer[left] + 1 for left in before[vertex]), default=0)
    for vertex in chosen:
        if onward[vertex] and not before[vertex]:
            layer[vertex] = min(layer[right] for right in onward[vertex]) - 1
    part = _ConnectedPart(dict(sorted(layer.items())), {v: boxes[v].height for v in chosen})
    fresh = len(boxes)
    for number, (left, right) in ends.items():
        passed = range(layer[left] + 1, layer[right])
        places = part.places[number] = list(range(fresh, fresh + len(passed)))
        fresh += len(passed)
        part.layer.update(zip(places, passed, strict=True))
        part.height.update(dict.fromkeys(places, PLACE_HEIGHT))
        edge = edges[number]
        heights = {edge.source: edge.leaves, edge.target: edge.enters}
        heights |= dict.fromkeys(places, PLACE_HEIGHT / 2)
        if left != right:
            way = pairwise([left, *places, right])
            part.segments += [(a, b, heights[a], heights[b]) for a, b in way]
    part.columns = [[] for _ in range(max(part.layer.values()) + 1)]
    for vertex, column in part.layer.items():
        part.columns[column].append(vertex)
    return part


def _sort_columns(part: _ConnectedPart) -> None:
    """Order each column by the mean position of its neighbours; the fewest crossings count."""
    before, after = part.beside()
    best, fewest = [list(column) for column in part.columns], _crossings(part)
    for sweep in range(SWEEPS):
        forwards = sweep % 2 == 0
        beside = before if forwards else after
        for column in part.columns[1:] if forwards else part.columns[-2::-1]:
            place = part.place()
            means = {
                v: float(np.mean([place[w] + inside for w, _, inside in beside[v]] or [place[v]]))
                for v in column
            }
            column.sort(key=means.__getitem__)
        crossings = _crossings(part)
        if crossings < fewest:
            fewest, best = crossings, [list(column) for column in part.columns]
    part.columns = best


def _crossings(part: _ConnectedPart) -> int:
    """Count pairs of segments that cross: their ends are in another order than their beginnings."""
    place, by_column = part.place(), defaultdict[int, list[tuple[float, float]]](list)
    for left, right, leaves, enters in part.segments:
        begin = place[left] + leaves / (part.height[left] + 1)
        end = place[right] + enters / (part.height[right] + 1)
        by_column[part.layer[left]].append((begin, end))
    ends_at = [np.array([end for _, end in sorted(pairs)]) for pairs in by_column.values()]
    return sum(int(np.count_nonzero(np.triu(at[:, None] > at))) for at in ends_at)


def _choose_heights(part: _ConnectedPart) -> None:
    """Choose heights so that edges run straight, column by column, back and forth."""
    before, after = part.beside()
    for column in part.columns:
        tops = accumulate((part.height[vertex] + ROW_GAP for vertex in column), initial=0.0)
        part.y.update(zip(column, tops, strict=False))
    for sweep in range(SWEEPS):
        last = sweep >= SWEEPS - 4
        forwards = sweep % 2 == 0
        for column in part.columns if forwards else reversed(part.columns):
            wanted, weights = [], []
            for vertex in column:
                beside = before[vertex] if forwards else after[vertex]
                beside = before[vertex] + after[vertex] if last or not beside else beside
                pulls = [
                    part.y[w] + share * (part.height[w] + 1) - inside for w, inside, share in beside
                ]
                wanted.append(sum(pulls) / len(pulls) if pulls else part.y[vertex])
                # Edges over several columns pull most; a vertex without neighbours gives way.
                straight = 4.0 if part.height[vertex] == PLACE_HEIGHT else 1.0
                weights.append(straight * len(pulls) if pulls else 0.01)
            sizes = [part.height[vertex] + ROW_GAP for vertex in column]
            part.y.update(zip(column, _apart(sizes, wanted, weights), strict=True))


def _apart(sizes: list[float], wanted: list[float], weights: list[float]) -> list[float]:
    """Find the heights nearest to ``wanted`` that keep order and gaps.

    It is isotonic regression. SciPy has it, but takes longer to import than a whole drawing.
    """
    offsets = list(accumulate(sizes, initial=0.0))[:-1]
    blocks: list[tuple[float, float, int]] = []  # mean, weight, members
    for height, weight, offset in zip(wanted, weights, offsets, strict=True):
        mean, weight_of_block, members = height - offset, weight, 1
        while blocks and blocks[-1][0] > mean:
            mean_before, weight_before, joined = blocks.pop()
            mean = (mean * weight_of_block + mean_before * weight_before) / (
                weight_of_block + weight_before
            )
            weight_of_block, members = weight_of_block + weight_before, members + joined
        blocks.append((mean, weight_of_block, members))
    flat = (mean for mean, _, members in blocks for _ in range(members))
    return [y + offset for y, offset in zip(flat, offsets, strict=True)]
