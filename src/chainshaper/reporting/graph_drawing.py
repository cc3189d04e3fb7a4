"""The application graph as a picture (SVG): nodes as boxes of callbacks, topics between them.

Arrows run from the callback that publishes a topic to the callbacks that it triggers. A dashed
arrow is a message that one callback reads and another callback of the node publishes for it
(synchronisers, stored messages). An arrow at a node's title stands for publications outside its
callbacks, or for subscriptions without callback events.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from chainshaper.analysis.description import ApplicationDescription
from chainshaper.reporting.application_graph import callback_text, short_symbol
from chainshaper.reporting.layered_layout import Box, Edge, Layout, lay_out
from chainshaper.values.application import Callback
from chainshaper.values.recording import lost_text
from chainshaper.values.safe_text import escape

__all__ = ["application_svg"]

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
