"""The graph of a large application, folded by namespace, so that a person can read it.

Each namespace is one box, or several where it has many nodes: names with more parts are folded
further down, for as long as the picture has room. Nodes without a namespace are folded by process,
if several are in one. The nodes of a chain stand in front of their namespace, with their callbacks
of the chain, and so do the nodes of namespaces that are unfolded. Topics are arrows between boxes,
many as one, but those of the chain and those between unfolded nodes. Topics that join most of the
boxes (/tf, /diagnostics) would hide all others: they are named below the picture instead.
"""

import colorsys
import zlib
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from chainshaper.analysis.graph import ApplicationDescription
from chainshaper.values.application import ApplicationGraph, Chain

MOST_BOXES = 30  # of folded namespaces
COMMON = 0.35  # the share of all boxes from which on a topic that joins them is only named
FEWEST_COMMON = 8  # boxes that such a topic joins


@dataclass(frozen=True)
class Fold:
    """Nodes that are one box: of a namespace, or of a process."""

    # The namespace, with /… behind it where those below it are in it too; of one node, its name.
    name: str
    nodes: tuple[str, ...]
    callbacks: int  # how many these have

    @property
    def text(self) -> str:
        """Text: how much is in it."""
        counted = ((len(self.nodes), "node"), (self.callbacks, "callback"))
        return ", ".join(f"{number} {word}{'s' if number != 1 else ''}" for number, word in counted)


@dataclass(frozen=True)
class FoldedGraph:
    """What a picture of a folded application shows.

    Boxes are numbered: the folds first, then the nodes that stand for themselves by their names.
    """

    shown: ApplicationDescription  # nodes that stand for themselves, and topics that do
    folds: tuple[Fold, ...]  # without those nodes; empty ones are left out
    # Topics that are part of an arrow from one box to another: of folds the number, of nodes names.
    bundles: Mapping[tuple[int | str, int | str], tuple[str, ...]]
    # Arrows between folds and topics that stand for themselves, by the fold's number.
    written: frozenset[tuple[int, str]]
    read: frozenset[tuple[str, int]]
    common: tuple[str, ...]  # topics that are only named


def namespace_of(node: str) -> str:
    """Return the namespace of a node: ``/a/b/c`` → ``/a/b``."""
    return node.rpartition("/")[0] or "/"


def colour_of(name: str) -> str:
    """Return the pale colour of a namespace: that of its first part, the same in every picture."""
    first = name.strip("/").partition("/")[0]
    hue = zlib.crc32(first.encode()) % 360 / 360
    red, green, blue = colorsys.hls_to_rgb(hue, 0.9, 0.6)
    return f"#{round(255 * red):02x}{round(255 * green):02x}{round(255 * blue):02x}"


def folds_of(graph: ApplicationGraph, most: int = MOST_BOXES) -> tuple[Fold, ...]:
    """Fold all nodes of a graph into ``most`` boxes or fewer, if its namespaces permit.

    The largest namespace is parted into those below it, again and again, while there is room.
    """
    names = list(
        dict.fromkeys([*(n.name for n in graph.nodes), *(c.node for c in graph.callbacks)])
    )
    parts: dict[str, list[str]] = {"/": [name for name in names if namespace_of(name) == "/"]}
    for name in names:
        if namespace_of(name) != "/":
            parts.setdefault("/" + name.split("/")[1] + "/…", []).append(name)
    settled: set[str] = set()
    while opened := max(
        (key for key in parts if key.endswith("/…") and key not in settled),
        key=lambda key: (len(parts[key]), key),
        default=None,
    ):
        below = _below(opened.removesuffix("/…"), parts[opened])
        if len(below) == 1 or len(parts) - 1 + len(below) <= most:
            del parts[opened]
            parts |= below
        else:
            settled.add(opened)
    parts |= _by_process(graph, parts.pop("/"), most - len(parts))
    counted = Counter(callback.node for callback in graph.callbacks)
    folds = (
        Fold(
            name=name if len(nodes) > 1 else nodes[0],
            nodes=tuple(sorted(nodes)),
            callbacks=sum(counted[node] for node in nodes),
        )
        for name, nodes in parts.items()
        if nodes
    )
    return tuple(sorted(folds, key=lambda part: part.name))


def _below(namespace: str, nodes: Sequence[str]) -> dict[str, list[str]]:
    """Part the nodes of a namespace: its own, and those of each namespace in it."""
    parts: dict[str, list[str]] = {}
    for node in nodes:
        rest = node.removeprefix(namespace + "/").split("/")
        key = namespace if len(rest) == 1 else f"{namespace}/{rest[0]}/…"
        parts.setdefault(key, []).append(node)
    return parts


def _by_process(graph: ApplicationGraph, nodes: Sequence[str], room: int) -> dict[str, list[str]]:
    """Part nodes without a namespace by their process, if that makes at most so many boxes."""
    pids = {node.name: node.pid for node in graph.nodes}
    parts: dict[str, list[str]] = {}
    for node in nodes:
        parts.setdefault(f"process {pids.get(node, 0)}", []).append(node)
    several = any(len(of_process) > 1 for of_process in parts.values())
    return parts if several and len(parts) <= room else {"/": list(nodes)}


def fold(
    application: ApplicationDescription,
    chain: Chain | None = None,
    unfolded: Collection[str] = (),
    folds: Sequence[Fold] | None = None,
) -> FoldedGraph:
    """Fold an application; a chain, and the namespaces that are ``unfolded``, stand for themselves.

    ``folds`` are those of :func:`folds_of`, where the caller has them.
    """
    graph = application.graph
    folds = folds_of(graph) if folds is None else folds
    of_chain = () if chain is None else chain.callbacks
    on_chain = {c.node for c in graph.callbacks if c.id in {*of_chain}}
    open_nodes = {node for part in folds if _is_in(part, unfolded) for node in part.nodes}
    alone = on_chain | open_nodes
    counted = Counter(callback.node for callback in graph.callbacks)
    left = tuple(
        replace(part, nodes=nodes, callbacks=sum(counted[node] for node in nodes))
        for part in folds
        if (nodes := tuple(node for node in part.nodes if node not in alone))
    )
    box_of: dict[str, int | str] = {
        node: number for number, f in enumerate(left) for node in f.nodes
    }
    box_of |= {node: node for node in alone}
    pills = {*(() if chain is None else chain.topics)}
    common, bundles = [], defaultdict[tuple[int | str, int | str], list[str]](list)
    for topic in graph.topics:
        sources = {box_of[node] for node in graph.publishers.get(topic, ()) if node in box_of}
        targets = {box_of[node] for node in graph.subscribers.get(topic, ()) if node in box_of}
        inside = sum(box in open_nodes for box in sources | targets)
        if topic in pills or not (sources and targets):
            continue
        if len(sources | targets) >= max(FEWEST_COMMON, COMMON * len({*box_of.values()})):
            common.append(topic)
        elif inside > 1:
            pills.add(topic)
        else:
            for source in sources:
                for target in targets - {source}:
                    bundles[source, target].append(topic)
    return FoldedGraph(
        shown=_of_nodes(application, alone, open_nodes, {*of_chain}, pills),
        folds=left,
        bundles={ends: tuple(topics) for ends, topics in bundles.items()},
        written=_ends_at_folds(graph.publishers, pills, box_of),
        read=frozenset((t, box) for box, t in _ends_at_folds(graph.subscribers, pills, box_of)),
        common=tuple(common),
    )


def _is_in(part: Fold, namespaces: Collection[str]) -> bool:
    """Return whether a fold is one of these namespaces, or below one."""
    name = part.name.removesuffix("/…")
    return any(name == wanted or name.startswith(wanted.rstrip("/") + "/") for wanted in namespaces)


def _ends_at_folds(
    ends: Mapping[str, Sequence[str]], topics: Collection[str], box_of: Mapping[str, int | str]
) -> frozenset[tuple[int, str]]:
    return frozenset(
        (box, topic)
        for topic in topics
        for node in ends.get(topic, ())
        if isinstance(box := box_of.get(node), int)
    )


def _of_nodes(
    application: ApplicationDescription,
    alone: Collection[str],
    unfolded: Collection[str],
    of_chain: Collection[int],
    topics: Collection[str],
) -> ApplicationDescription:
    """Return the application of nodes that stand ``alone``, and of ``topics``.

    Those that are not ``unfolded`` have their callbacks of the chain only.
    """
    graph = application.graph
    publishers, subscribers = (
        {
            topic: tuple(node for node in nodes if node in unfolded)
            for topic, nodes in ends.items()
            if topic in topics
        }
        for ends in (graph.publishers, graph.subscribers)
    )
    callbacks = tuple(
        replace(callback, publishes=tuple(t for t in callback.publishes if t in topics))
        for callback in graph.callbacks
        if callback.node in unfolded or callback.id in of_chain
    )
    nodes = tuple(node for node in graph.nodes if node.name in alone)
    left = replace(
        graph, nodes=nodes, callbacks=callbacks, publishers=publishers, subscribers=subscribers
    )
    return replace(application, graph=left)
