"""The application graph as a picture: SVG with a layout of ours, or DOT for Graphviz.

Nodes are boxes of callbacks, with topics between them. Arrows run from the callback that publishes
a topic to the callbacks that it triggers. A dashed arrow is a message that one callback reads and
another callback of the node publishes for it (synchronisers, stored messages). An arrow at a node's
title stands for publications outside its callbacks, or for subscriptions without callback events.

The layout is that of Sugiyama, Tagawa and Toda (1981): edges that close cycles are turned around;
every box gets a layer (a column), as far left as its predecessors permit; boxes of a column are
sorted so that few edges cross (barycentres, swept back and forth); heights are chosen so that edges
run straight, exactly for one column given its neighbours: least squares under the order and the
gaps between boxes, which is isotonic regression (pool adjacent violators). Edges over several
columns pass them through places of their own, so that no arrow crosses a box. Parts that are not
connected are laid out one below the other.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from graphlib import TopologicalSorter
from itertools import accumulate
from pathlib import Path

import numpy as np

from chainshaper.analysis.graph import ApplicationDescription
from chainshaper.reporting.application_graph import (
    application_json,
    callback_text,
    short_symbol,
    without_internals,
)
from chainshaper.values.application import Callback
from chainshaper.values.files import new_file, write_whole
from chainshaper.values.recording import lost_text
from chainshaper.values.safe_text import escape, shown

__all__ = [
    "ENDINGS",
    "Box",
    "Edge",
    "application_dot",
    "application_svg",
    "lay_out",
    "write_picture",
]

ENDINGS = (".svg", ".dot", ".json")

COLUMN_GAP = 48.0
ROW_GAP = 22.0
PLACE_HEIGHT = 6.0
SWEEPS = 16

MARGIN = 24.0
CHARACTER = 7.3  # width of one of 12 px
SMALL = 6.3  # and of 10 px
TITLE, ROW, PILL, PAD = 28.0, 36.0, 26.0, 10.0
TURN = 45.0  # how far an arrow goes on before it turns around
LONGEST = 46  # characters of a function's name
COLOURS = {
    "timer": "#c2571a",
    "subscription": "#1f6fb2",
    "service": "#6b4fa0",
    "client": "#3b7d4f",
    "unknown": "#777777",
}
_STYLE = """\
text { font-family: "DejaVu Sans", Verdana, Helvetica, Arial, sans-serif; font-size: 12px;
  fill: #1a1a1a; }
.title { font-weight: bold; } .small { font-size: 10px; fill: #666; }
.node { fill: #fff; stroke: #444; stroke-width: 1.3; }
.head { fill: #eceff3; }
.line { stroke: #d5d9df; }
.topic { fill: #fff6d6; stroke: #b8962e; }
.arrow { fill: none; stroke: #555; stroke-width: 1.3; marker-end: url(#tip); }
.passes { stroke-dasharray: 5 4; }
.back { stroke: #b03a3a; }
"""


@dataclass(frozen=True)
class Box:
    """Something to place: its size."""

    width: float
    height: float


@dataclass(frozen=True)
class Edge:
    """An arrow between two boxes (their numbers), leaving and entering at heights inside them."""

    source: int
    target: int
    leaves: float
    enters: float


@dataclass(frozen=True)
class Layout:
    """Left upper corners of the boxes, way points of the edges, and the size of it all.

    An edge's way points lead from the right side of its source to the left side of its target.
    """

    corners: list[tuple[float, float]]
    routes: list[list[tuple[float, float]]]
    width: float
    height: float


@dataclass
class _Columns:
    """The layered graph of one component: vertices are boxes and, behind them, edges' places."""

    layer: dict[int, int]
    height: dict[int, float]
    columns: list[list[int]]
    segments: list[tuple[int, int, float, float]]  # left, right, heights inside them
    y: dict[int, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _NodeBox:
    name: str
    pid: int
    callbacks: tuple[Callback, ...]

    @property
    def box(self) -> Box:
        widths = [CHARACTER * (len(self.name) + 1) + SMALL * (len(str(self.pid)) + 4)]
        for callback in self.callbacks:
            widths.append(CHARACTER * len(_text(callback)) + 14)
            widths.append(SMALL * len(_function(callback)) + 14)
        return Box(max(widths) + 2 * PAD, TITLE + ROW * len(self.callbacks))

    def height_of(self, number: int | None) -> float:
        """The middle of a callback's row, or of the title."""
        for row, callback in enumerate(self.callbacks):
            if callback.id == number:
                return TITLE + ROW * (row + 0.5)
        return TITLE / 2


def application_svg(application: ApplicationDescription) -> str:
    """The picture as the text of an SVG file."""
    nodes = _nodes(application)
    topics = [t for t in application.graph.topics if t and not t.startswith("ros_")]
    arrows = list(_arrows(application, nodes, topics))
    pills = [Box(CHARACTER * len(topic) + 2 * PAD, PILL) for topic in topics]
    layout = lay_out([*(node.box for node in nodes), *pills], [edge for edge, _ in arrows])
    parts = [_arrow(route, style) for route, (_, style) in zip(layout.routes, arrows, strict=True)]
    parts += [_node(node, layout.corners[index]) for index, node in enumerate(nodes)]
    parts += [
        _topic(topic, layout.corners[len(nodes) + index], pills[index])
        for index, topic in enumerate(topics)
    ]
    if any(application.lost.values()):
        text = escape(lost_text(application.lost))
        parts.append(
            f'<text class="small" x="0" y="{layout.height + MARGIN / 2:.1f}">{text}</text>'
        )
    return _document(layout, parts)


def _nodes(application: ApplicationDescription) -> list[_NodeBox]:
    rows: dict[tuple[str, int], list[Callback]] = {
        (node.name, node.pid): [] for node in application.graph.nodes
    }
    for callback in application.graph.callbacks:
        rows.setdefault((callback.node, callback.pid), []).append(callback)
    return [_NodeBox(name, pid, tuple(own)) for (name, pid), own in rows.items()]


def _arrows(
    application: ApplicationDescription, nodes: list[_NodeBox], topics: list[str]
) -> Iterator[tuple[Edge, str]]:
    """Arrows and their classes: callbacks and topics, then titles where no callback is known."""
    graph = application.graph
    place = {topic: len(nodes) + index for index, topic in enumerate(topics)}
    for index, node in enumerate(nodes):
        writes: set[str] = set()
        reads: set[str | None] = set()
        for callback in node.callbacks:
            height = node.height_of(callback.id)
            if callback.kind == "subscription" and callback.topic in place:
                yield Edge(place[callback.topic], index, PILL / 2, height), "arrow"
                reads.add(callback.topic)
            for topic in filter(place.__contains__, callback.publishes):
                style = "arrow passes" if topic in callback.passes_on else "arrow"
                yield Edge(index, place[topic], height, PILL / 2), style
                writes.add(topic)
        for topic in topics:
            if node.name in graph.publishers.get(topic, ()) and topic not in writes:
                yield Edge(index, place[topic], TITLE / 2, PILL / 2), "arrow"
            if node.name in graph.subscribers.get(topic, ()) and topic not in reads:
                yield Edge(place[topic], index, PILL / 2, TITLE / 2), "arrow"


def _text(callback: Callback) -> str:
    """What triggers it, except for a topic: that is where the arrow comes from."""
    return callback.kind if callback.kind == "subscription" else callback_text(callback)


def _explained(callback: Callback) -> str:
    return f"{callback.label}\n{callback.symbol}" if callback.symbol else callback.label


def _function(callback: Callback) -> str:
    text = short_symbol(callback.symbol)
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"


def _node(node: _NodeBox, corner: tuple[float, float]) -> str:
    x, y = corner
    size = node.box
    parts = [
        f'<g transform="translate({x:.1f} {y:.1f})">',
        f'<rect class="node" width="{size.width:.1f}" height="{size.height:.1f}" rx="5"/>',
        f'<rect class="head" x="1" y="1" width="{size.width - 2:.1f}" height="{TITLE - 2:.1f}"'
        ' rx="4"/>',
        f'<text class="title" x="{PAD}" y="18">{escape(node.name)}</text>',
        f'<text class="small" x="{size.width - PAD:.1f}" y="18" text-anchor="end">'
        f"{node.pid}</text>",
    ]
    for row, callback in enumerate(node.callbacks):
        top = TITLE + ROW * row
        colour = COLOURS[callback.kind]
        parts += [
            f"<g><title>{escape(_explained(callback))}</title>",
            f'<line class="line" x1="1" x2="{size.width - 1:.1f}" y1="{top}" y2="{top}"/>',
            f'<rect x="{PAD}" y="{top + 9}" width="6" height="18" rx="2" fill="{colour}"/>',
            f'<text x="{PAD + 14}" y="{top + 16}">{escape(_text(callback))}</text>',
            f'<text class="small" x="{PAD + 14}" y="{top + 29}">{escape(_function(callback))}'
            "</text></g>",
        ]
    return "\n".join([*parts, "</g>"])


def _topic(topic: str, corner: tuple[float, float], size: Box) -> str:
    x, y = corner
    return (
        f'<g transform="translate({x:.1f} {y:.1f})">'
        f'<rect class="topic" width="{size.width:.1f}" height="{size.height:.1f}" rx="13"/>'
        f'<text x="{size.width / 2:.1f}" y="17" text-anchor="middle">{escape(topic)}</text></g>'
    )


def _arrow(route: list[tuple[float, float]], style: str) -> str:
    """Horizontal ends, curves between the columns; backward arrows turn around at both ends."""
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
    return f'<path class="{style}{" back" if backwards else ""}" d="{" ".join(path)}"/>'


def _document(layout: Layout, parts: list[str]) -> str:
    width, height = layout.width + 2 * MARGIN, layout.height + 2 * MARGIN
    tip = (
        '<marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7"'
        ' orient="auto-start-reverse"><path d="M 0 1 L 10 5 L 0 9 z" fill="#555"/></marker>'
    )
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}"'
            f' viewBox="{-MARGIN} {-MARGIN} {width:.1f} {height:.1f}">',
            f"<defs>{tip}<style>{_STYLE}</style></defs>",
            f'<rect x="{-MARGIN}" y="{-MARGIN}" width="{width:.1f}" height="{height:.1f}"'
            ' fill="#fff"/>',
            *parts,
            "</svg>",
            "",
        ]
    )


def application_dot(application: ApplicationDescription) -> str:
    """The graph in the language of Graphviz: a cluster per node, ellipses for topics."""
    graph = application.graph
    lines = ["digraph application {", "  rankdir=LR;", "  node [fontname=Helvetica, fontsize=11];"]
    if any(application.lost.values()):
        lines.append(f"  label={_quoted(lost_text(application.lost))};")
    number = {(node.name, node.pid): index for index, node in enumerate(graph.nodes)}
    for callback in graph.callbacks:
        number.setdefault((callback.node, callback.pid), len(number))
    for (name, pid), index in number.items():
        lines.append(f"  subgraph cluster_{index} {{")
        lines.append(f"    label={_quoted(f'{name} (process {pid})')};")
        lines.append(f'    node_{index} [shape=point, style=invis, label=""];')
        for callback in graph.callbacks:
            if (callback.node, callback.pid) == (name, pid):
                text = callback_text(callback) + "\n" + short_symbol(callback.symbol)
                label = _quoted(text.strip())
                lines.append(f"    callback_{callback.id} [shape=box, label={label}];")
        lines.append("  }")
    lines += [f"  {_quoted(topic)} [shape=ellipse];" for topic in graph.topics]
    for callback in graph.callbacks:
        vertex = f"callback_{callback.id}"
        if callback.kind == "subscription" and callback.topic is not None:
            lines.append(f"  {_quoted(callback.topic)} -> {vertex};")
        elif callback.kind in {"service", "client"} and callback.topic is not None:
            lines.append(f"  {_quoted(callback.topic)} [shape=cds];")
            lines.append(f"  {_quoted(callback.topic)} -> {vertex};")
        for topic in callback.publishes:
            style = " [style=dashed]" if topic in callback.passes_on else ""
            lines.append(f"  {vertex} -> {_quoted(topic)}{style};")
    return "\n".join([*lines, "}", ""])


def _quoted(text: str) -> str:
    escaped = shown(text, but="\n").replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'


def write_picture(
    application: ApplicationDescription, path: str | Path, *, everything: bool = False
) -> Path:
    """Write the graph as .svg, .dot or .json, by the ending of ``path``, whole or not at all.

    Raises:
        InputError: it exists, its folder does not, or its ending says no known format.
        OperationError: it cannot be written.
    """
    path = new_file(path, ENDINGS)
    drawn = application if everything else without_internals(application)
    if path.suffix == ".json":
        text = json.dumps(application_json(application), indent=2) + "\n"
    elif path.suffix == ".dot":
        text = application_dot(drawn)
    else:
        text = application_svg(drawn)
    return write_whole(path, [text.encode()])


def lay_out(boxes: Sequence[Box], edges: Sequence[Edge]) -> Layout:
    """Place boxes and edges. Cost is about that of sorting, times the number of sweeps."""
    corners = [(0.0, 0.0)] * len(boxes)
    routes: list[list[tuple[float, float]]] = [[] for _ in edges]
    top, width = 0.0, 0.0
    for members in _components(len(boxes), edges):
        own = [number for number, edge in enumerate(edges) if edge.source in members]
        chosen = sorted(members)
        graph, places = _layered(chosen, boxes, [(number, edges[number]) for number in own])
        _sort_columns(graph)
        _choose_heights(graph)
        lefts = _lefts(graph, boxes)
        lowest = min(graph.y.values())
        for vertex in chosen:
            corners[vertex] = (lefts[graph.layer[vertex]][0], graph.y[vertex] - lowest + top)
        for number in own:
            edge = edges[number]
            (x, y), (to_x, to_y) = corners[edge.source], corners[edge.target]
            start = (x + boxes[edge.source].width, y + edge.leaves)
            between = [
                (side, graph.y[place] + PLACE_HEIGHT / 2 + top - lowest)
                for place in places[number]
                for side in lefts[graph.layer[place]]
            ]
            if graph.layer[edge.source] > graph.layer[edge.target]:
                between.reverse()
            routes[number] = [start, *between, (to_x, to_y + edge.enters)]
        below = max(graph.y[v] + graph.height[v] for v in graph.y) - lowest
        width = max(width, lefts[-1][1])
        top += below + 2 * ROW_GAP
    return Layout(corners, routes, width, max(top - 2 * ROW_GAP, 0.0))


def _components(count: int, edges: Sequence[Edge]) -> list[set[int]]:
    """Connected components, the largest first."""
    of = {vertex: {vertex} for vertex in range(count)}
    for edge in edges:
        joined = of[edge.source] | of[edge.target]
        of.update(dict.fromkeys(joined, joined))
    found = {id(members): members for members in of.values()}.values()
    return sorted(found, key=lambda members: (-len(members), min(members)))


def _layered(
    chosen: list[int], boxes: Sequence[Box], edges: list[tuple[int, Edge]]
) -> tuple[_Columns, dict[int, list[int]]]:
    """Columns and the edges' places in those they pass, from left to right."""
    turned = _turned(chosen, edges)
    pairs = [(e.target, e.source) if n in turned else (e.source, e.target) for n, e in edges]
    layer = _layers(chosen, pairs)
    graph = _Columns(layer, {v: boxes[v].height for v in chosen}, [], [])
    places: dict[int, list[int]] = {}
    fresh = len(boxes)
    for (number, edge), (left, right) in zip(edges, pairs, strict=True):
        before, leaves = left, edge.enters if number in turned else edge.leaves
        places[number] = []
        for column in range(layer[left] + 1, layer[right]):
            layer[fresh], graph.height[fresh] = column, PLACE_HEIGHT
            graph.segments.append((before, fresh, leaves, PLACE_HEIGHT / 2))
            places[number].append(fresh)
            before, leaves = fresh, PLACE_HEIGHT / 2
            fresh += 1
        if left != right:
            enters = edge.leaves if number in turned else edge.enters
            graph.segments.append((before, right, leaves, enters))
    graph.columns = [[] for _ in range(max(layer.values()) + 1)]
    for vertex, column in layer.items():
        graph.columns[column].append(vertex)
    return graph, places


def _turned(chosen: list[int], edges: list[tuple[int, Edge]]) -> set[int]:
    """Edges that close a cycle, met by a depth-first search that begins at the sources."""
    onward: dict[int, list[tuple[int, int]]] = {vertex: [] for vertex in chosen}
    entered = set()
    for number, edge in edges:
        onward[edge.source].append((number, edge.target))
        entered.add(edge.target)
    turned: set[int] = set()
    state: dict[int, int] = {}  # 1: on the path, 2: done
    for start in sorted(chosen, key=lambda vertex: vertex in entered):
        if start in state:
            continue
        state[start] = 1
        stack = [(start, iter(onward[start]))]
        while stack:
            vertex, rest = stack[-1]
            number, after = next(rest, (-1, -1))
            if number < 0:
                state[vertex] = 2
                stack.pop()
            elif state.get(after) == 1:
                turned.add(number)
            elif after not in state:
                state[after] = 1
                stack.append((after, iter(onward[after])))
    return turned


def _layers(chosen: list[int], pairs: list[tuple[int, int]]) -> dict[int, int]:
    """Longest path from the sources; sources then move right, next to what they feed."""
    before: dict[int, set[int]] = {vertex: set() for vertex in chosen}
    onward: dict[int, set[int]] = {vertex: set() for vertex in chosen}
    for left, right in pairs:
        if left != right:
            before[right].add(left)
            onward[left].add(right)
    layer = dict.fromkeys(chosen, 0)
    for vertex in TopologicalSorter(before).static_order():
        layer[vertex] = max((layer[left] + 1 for left in before[vertex]), default=0)
    for vertex in chosen:
        if onward[vertex] and not before[vertex]:
            layer[vertex] = min(layer[right] for right in onward[vertex]) - 1
    return layer


def _sort_columns(graph: _Columns) -> None:
    """Order each column by the mean position of its neighbours; the best order seen stays."""
    before, after = _neighbours(graph)
    best = [list(column) for column in graph.columns]
    fewest = _crossings(graph)
    for sweep in range(SWEEPS):
        forwards = sweep % 2 == 0
        beside = before if forwards else after
        columns = graph.columns[1:] if forwards else graph.columns[-2::-1]
        for column in columns:
            place = _positions(graph)
            own = {vertex: index for index, vertex in enumerate(column)}
            column.sort(
                key=lambda v: (
                    sum(place[w] + inside for w, _, inside in beside[v]) / len(beside[v])
                    if beside[v]
                    else own[v]
                )
            )
        crossings = _crossings(graph)
        if crossings < fewest:
            fewest, best = crossings, [list(column) for column in graph.columns]
    graph.columns = best


def _positions(graph: _Columns) -> dict[int, float]:
    return {v: float(index) for column in graph.columns for index, v in enumerate(column)}


Beside = dict[int, list[tuple[int, float, float]]]


def _neighbours(graph: _Columns) -> tuple[Beside, Beside]:
    """Vertex → (neighbour, height of the edge's end inside the vertex, share inside the other)."""
    before: Beside = {vertex: [] for vertex in graph.layer}
    after: Beside = {vertex: [] for vertex in graph.layer}
    for left, right, leaves, enters in graph.segments:
        before[right].append((left, enters, leaves / (graph.height[left] + 1)))
        after[left].append((right, leaves, enters / (graph.height[right] + 1)))
    return before, after


def _crossings(graph: _Columns) -> int:
    """How many pairs of segments cross: those whose ends are in another order than their begins."""
    place = _positions(graph)
    by_column: dict[int, list[tuple[float, float]]] = {}
    for left, right, leaves, enters in graph.segments:
        ends = (
            place[left] + leaves / (graph.height[left] + 1),
            place[right] + enters / (graph.height[right] + 1),
        )
        by_column.setdefault(graph.layer[left], []).append(ends)
    total = 0
    for pairs in by_column.values():
        ends_at = np.array([end for _, end in sorted(pairs)])
        total += np.count_nonzero(np.triu(ends_at[:, None] > ends_at))
    return total


def _choose_heights(graph: _Columns) -> None:
    """Heights that let edges run straight, column by column, back and forth."""
    before, after = _neighbours(graph)
    for column in graph.columns:
        tops = accumulate((graph.height[vertex] + ROW_GAP for vertex in column), initial=0.0)
        graph.y.update(zip(column, tops, strict=False))
    for sweep in range(SWEEPS):
        last = sweep >= SWEEPS - 4
        forwards = sweep % 2 == 0
        for column in graph.columns if forwards else reversed(graph.columns):
            wanted, weights = [], []
            for vertex in column:
                beside = before[vertex] if forwards else after[vertex]
                beside = before[vertex] + after[vertex] if last or not beside else beside
                pulls = [
                    graph.y[w] + share * (graph.height[w] + 1) - inside
                    for w, inside, share in beside
                ]
                wanted.append(sum(pulls) / len(pulls) if pulls else graph.y[vertex])
                # Long edges run straight first; what has no neighbour gives way.
                straight = 4.0 if graph.height[vertex] == PLACE_HEIGHT else 1.0
                weights.append(straight * len(pulls) if pulls else 0.01)
            for vertex, y in zip(column, _apart(graph, column, wanted, weights), strict=True):
                graph.y[vertex] = y


def _apart(
    graph: _Columns, column: list[int], wanted: list[float], weights: list[float]
) -> list[float]:
    """The heights nearest to ``wanted`` that keep order and gaps (isotonic regression).

    SciPy has one, too, but takes longer to import than a whole drawing.
    """
    sizes = (graph.height[vertex] + ROW_GAP for vertex in column)
    offsets = list(accumulate(sizes, initial=0.0))[:-1]
    blocks: list[tuple[float, float, int]] = []  # mean, weight, members
    for want, weight, offset in zip(wanted, weights, offsets, strict=True):
        mean, heavy, members = want - offset, weight, 1
        while blocks and blocks[-1][0] > mean:
            other, more, joined = blocks.pop()
            mean = (mean * heavy + other * more) / (heavy + more)
            heavy, members = heavy + more, members + joined
        blocks.append((mean, heavy, members))
    flat = [mean for mean, _, members in blocks for _ in range(members)]
    return [y + offset for y, offset in zip(flat, offsets, strict=True)]


def _lefts(graph: _Columns, boxes: Sequence[Box]) -> list[tuple[float, float]]:
    """Left and right side of every column."""
    sides, left = [], 0.0
    for column in graph.columns:
        width = max((boxes[v].width for v in column if v < len(boxes)), default=0.0)
        sides.append((left, left + width))
        left += width + COLUMN_GAP
    return sides
