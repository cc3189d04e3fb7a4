"""Computation chains: finding the one that a person means, and listing those there are.

A chain is written ``FIRST..LAST``, with more way points where several paths match. Way points
are topics or nodes. A chain that begins with a topic starts at the callback that publishes it,
and every chain ends with the publication of its last topic (paper, section 2.3); a chain that
ends with a node ends with what that node publishes, or, if it publishes nothing, with the topic
that it subscribes to. CARET's ``named_paths`` are read as well (upstream: tier4/caret_analyze,
`architecture.yaml`; only the paths, the rest comes from the recording).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from chainshaper.analysis.paths import Path as GraphPath
from chainshaper.analysis.paths import PathSearch, Stage, Vertex
from chainshaper.values.application import INTERNAL_TOPICS, ApplicationGraph, Callback, Chain
from chainshaper.values.errors import InputError
from chainshaper.values.yaml_file import PlainData, compose, read_text

__all__ = [
    "ChainEnumeration",
    "close_names",
    "enumerate_chains",
    "find_chain",
    "load_named_paths",
    "parse_chain",
]

MOST = 3
CLOSE = 0.6
"""Likeness (0 to 1) from which a name is worth mentioning."""

WORSE = 0.15
"""How much less alike than the best one a name may be."""


def close_names(name: str, names: Iterable[str]) -> list[str]:
    """Up to three of ``names`` that are like ``name``, the likeliest first."""
    scores = {other: _likeness(name, other) for other in names}
    best = max(scores.values(), default=0.0)
    close = [n for n, score in scores.items() if score >= max(CLOSE, best - WORSE)]
    return sorted(close, key=lambda other: (-scores[other], other))[:MOST]


def _likeness(first: str, second: str) -> float:
    a, b = (text.lower().strip("/") for text in (first, second))
    whole = SequenceMatcher(None, a, b, autojunk=False).ratio()
    last_a, last_b = a.rpartition("/")[2], b.rpartition("/")[2]
    last = 0.95 * SequenceMatcher(None, last_a, last_b, autojunk=False).ratio()
    contains = 0.9 if min(len(a), len(b)) > 2 and (a in b or b in a) else 0.0
    return max(whole, last, contains)


HANDFUL = 5


def parse_chain(text: str) -> tuple[str, ...]:
    """The way points of a chain: ``/t1../t5`` → ``("/t1", "/t5")``.

    Raises:
        InputError: nothing between two dots, more than two dots in a row, a way point twice.
    """
    waypoints = tuple(part.strip() for part in text.split(".."))
    if any(not part or part.startswith(".") or part.endswith(".") for part in waypoints):
        raise InputError(
            f"chain {text!r}: write way points (topics or nodes) with two dots between them, "
            "such as /t1../t5"
        )
    repeated = [part for part in waypoints if waypoints.count(part) > 1]
    if repeated:
        raise InputError(
            f"chain {text!r}: {repeated[0]} stands twice in it; a cyclic chain has no end-to-end "
            "latency, name each way point once"
        )
    return waypoints


def find_chain(graph: ApplicationGraph, spec: str) -> Chain:
    """The one chain of ``graph`` that ``spec`` means.

    Raises:
        InputError: a topic or node that does not exist, no path, only a cyclic one, or several.
    """
    search, stages = _search(graph, spec, parse_chain(spec))
    listing = search.listed(HANDFUL + 1)
    chains = list(dict.fromkeys(_chain(spec, path) for path in listing.paths))
    if not chains:
        raise InputError(_no_path(graph, spec, search, stages))
    if len(chains) > 1 or not listing.complete:
        raise InputError(_ambiguous(graph, spec, chains, listing.complete))
    return chains[0]


@dataclass(frozen=True)
class ChainEnumeration:
    """The chains between two places of a graph.

    ``chains`` are all of them if ``complete``, else the first ones found. ``count`` says how many
    there are; where the graph between the two places has cycles, it is only a lower bound (not
    ``exact``): the chains that never step back in one order of callbacks and topics, or those
    met while listing if they are more. ``heaviest`` has the largest sum of mean response times
    (``heaviest_ns``) among the counted and the listed chains; None without response times.
    """

    chains: tuple[Chain, ...]
    complete: bool
    count: int
    exact: bool
    heaviest: Chain | None
    heaviest_ns: float | None


def enumerate_chains(
    graph: ApplicationGraph,
    start: str | None = None,
    end: str | None = None,
    limit: int = 100,
    response_ns: Mapping[int, float] | None = None,
) -> ChainEnumeration:
    """The chains from ``start`` to ``end`` (topics or nodes), at most ``limit`` of them.

    Without ``start`` chains begin at callbacks that no other callback of the application
    triggers, without ``end`` they end with topics from which no callback goes on. ``response_ns``
    is the mean response time by callback id. Never hangs, see :mod:`~chainshaper.analysis.paths`.

    Raises:
        InputError: ``start`` or ``end`` does not exist, or nothing leads from one to the other.
    """
    waypoints = tuple(name for name in (start, end) if name is not None)
    spec = f"{start or ''}..{end or ''}"
    search, stages = _search(graph, spec, waypoints, start is None, end is None)
    weights = response_ns or {}
    count, heaviest_path, heaviest_ns = search.counted(weights)
    listing = search.listed(limit)
    if not listing.paths and waypoints:
        raise InputError(_no_path(graph, spec, search, stages))
    chains = tuple(dict.fromkeys(_chain(None, path) for path in listing.paths))
    heaviest = _chain(None, heaviest_path) if heaviest_path and weights else None
    for chain in chains if weights else ():
        weight = sum(weights.get(callback, 0.0) for callback in chain.callbacks)
        if heaviest is None or weight > heaviest_ns:
            heaviest, heaviest_ns = chain, weight
    return ChainEnumeration(
        chains=chains,
        complete=listing.complete,
        count=len(chains) if listing.complete else max(count, listing.count),
        exact=listing.complete or not search.cyclic,
        heaviest=heaviest,
        heaviest_ns=heaviest_ns if heaviest else None,
    )


def _search(
    graph: ApplicationGraph,
    spec: str,
    waypoints: Sequence[str],
    any_start: bool = False,
    any_end: bool = False,
) -> tuple[PathSearch, tuple[Stage, ...]]:
    stages = tuple(_stage(graph, spec, name) for name in waypoints)
    starts = _sources(graph) if any_start else _start_callbacks(graph, spec, stages[0])
    if any_start:  # every source is as good as a first way point
        stages = (Stage("any source", frozenset[Vertex](starts)), *stages)
    going_on = {
        callback.topic
        for callback in graph.callbacks
        if callback.kind == "subscription" and set(callback.publishes) - INTERNAL_TOPICS
    }
    last = len(stages)
    ends_with_topic = not any_end and all(isinstance(v, str) for v in stages[-1].vertices)

    def accepts(state: tuple[Vertex, int], callback: Callback | None) -> bool:
        vertex, met = state
        if met < last:
            return False
        if any_end:
            return callback is None and vertex not in going_on
        if ends_with_topic:
            return vertex in stages[-1].vertices
        # The last way point is a node: its callback was met, then comes the topic it publishes.
        return callback is None or not callback.publishes

    return PathSearch(graph, frozenset(starts), stages, accepts), stages


def _stage(graph: ApplicationGraph, spec: str, name: str) -> Stage:
    """What a way point stands for: a topic, or all callbacks of a node."""
    nodes: dict[str, set[int]] = {node.name: set() for node in graph.nodes}
    topics = set(graph.topics)
    for callback in graph.callbacks:
        nodes.setdefault(callback.node, set()).add(callback.id)
        topics.update(callback.publishes)
    for candidate in (name, f"/{name}"):
        if candidate in topics:
            return Stage(candidate, frozenset[Vertex]((candidate,)))
        if candidate in nodes:
            return Stage(candidate, frozenset[Vertex](nodes[candidate]))
    if not topics:
        raise InputError(
            f"chain {spec!r}: the recording shows no topics at all; tracing has to start before "
            "the application does"
        )
    close = close_names(name, topics | nodes.keys())
    hint = (
        f"did you mean {' or '.join(close)}?"
        if close
        else f"the names there are: {_some(topics - INTERNAL_TOPICS or topics)}; "
        "`chainshaper graph` shows all of them"
    )
    raise InputError(f"chain {spec!r}: no topic or node is called {name}; {hint}")


def _some(names: Iterable[str]) -> str:
    """A handful of names for a message."""
    listed = sorted(names)
    return ", ".join(listed[:HANDFUL]) + (", ..." if len(listed) > HANDFUL else "")


def _start_callbacks(graph: ApplicationGraph, spec: str, first: Stage) -> set[int]:
    vertices = first.vertices
    if not any(isinstance(vertex, str) for vertex in vertices):
        return {vertex for vertex in vertices if isinstance(vertex, int)}
    starts = {
        callback.id
        for callback in graph.callbacks
        if vertices & (set(callback.publishes) - set(callback.passes_on))
    }
    if not starts:
        writers = ", ".join(graph.publishers.get(first.name, ())) or "no node in the recording"
        raise InputError(
            f"chain {spec!r}: no callback was seen to publish {first.name} (its publisher: "
            f"{writers}); begin the chain at a topic that a callback publishes"
        )
    return starts


def _sources(graph: ApplicationGraph) -> set[int]:
    """Publishing callbacks that no callback's publication triggers."""
    published = {topic for callback in graph.callbacks for topic in callback.publishes}
    return {
        callback.id
        for callback in graph.callbacks
        if set(callback.publishes) - INTERNAL_TOPICS
        and not (callback.kind == "subscription" and callback.topic in published)
    }


def _chain(spec: str | None, path: GraphPath) -> Chain:
    callbacks = tuple(vertex for vertex in path if isinstance(vertex, int))
    topics = tuple(vertex for vertex in path if isinstance(vertex, str))
    written = spec if spec is not None else "..".join(topics)
    return Chain(written, callbacks[: len(topics)], topics)


def _no_path(
    graph: ApplicationGraph, spec: str, search: PathSearch, stages: tuple[Stage, ...]
) -> str:
    if search.roots:
        return (
            f"chain {spec!r}: it can only be closed by passing the same callback or topic twice; "
            "a cyclic chain has no end-to-end latency, give its way points in the order of the "
            "data"
        )
    met = search.furthest
    if not met:
        return f"chain {spec!r}: no callback of {stages[0].name} publishes anything"
    reached = sorted(vertex for vertex in search.reached if isinstance(vertex, str))
    going_on = {c.topic for c in graph.callbacks if c.kind == "subscription" and c.publishes}
    stops = [topic for topic in reached if topic not in going_on] or reached
    if not stops:
        return f"chain {spec!r}: no callback of {stages[met - 1].name} publishes anything"
    goal = stages[min(met, len(stages) - 1)].name
    return (
        f"chain {spec!r}: no path leads from {stages[met - 1].name} to {goal}; from there the data "
        f"gets as far as {_some(stops)}"
    )


def _ambiguous(graph: ApplicationGraph, spec: str, chains: Sequence[Chain], complete: bool) -> str:
    shown = chains[:HANDFUL]
    more = "" if complete and len(chains) <= HANDFUL else "at least "
    lines = [f"chain {spec!r}: {more}{len(chains)} paths match; add a way point:"]
    callbacks = {callback.id: callback for callback in graph.callbacks}
    for chain in shown:
        others = [other for other in shown if other is not chain]
        telling = next(
            (t for t in chain.topics if all(t not in other.topics for other in others)), None
        ) or next(
            (
                callbacks[c].node
                for c in chain.callbacks
                if all(
                    callbacks[c].node not in {callbacks[o].node for o in other.callbacks}
                    for other in others
                )
            ),
            None,
        )
        remedy = f"  (only this one passes {telling})" if telling else ""
        names = [callbacks[chain.callbacks[0]].label, *chain.topics]
        lines.append(f"  {' → '.join(names)}{remedy}")
    return "\n".join(lines)


UNDEFINED = {None, "UNDEFINED"}


class _PathNode(BaseModel):
    model_config = ConfigDict(frozen=True)

    node_name: str
    publish_topic_name: str | None = None


class _NamedPath(BaseModel):
    model_config = ConfigDict(frozen=True)

    path_name: str
    node_chain: tuple[_PathNode, ...] = Field(min_length=1)


class _Architecture(BaseModel):
    model_config = ConfigDict(frozen=True)

    named_paths: tuple[_NamedPath, ...]


def load_named_paths(file: str | Path) -> dict[str, str]:
    """The named paths of a CARET architecture file: path name → chain as we write it.

    Each node of a path becomes a way point together with the topic it publishes. A last node
    that publishes nothing ends the chain with the topic it subscribes to, which is what the node
    before it publishes.

    Raises:
        InputError: not readable, not YAML, no ``named_paths``, a path without nodes.
    """
    path = Path(file)
    root = compose(read_text(path, "CARET's architecture file"), path)
    plain = PlainData(path, ours=False)
    try:
        architecture = _Architecture.model_validate(None if root is None else plain.of(root))
    except ValidationError as error:
        raise InputError(
            f"{plain.problems(error, _Architecture)}; chains are read from the `named_paths` of a"
            " CARET architecture file, each with its `path_name` and `node_chain`"
        ) from error
    return {path.path_name: _way_points(path) for path in architecture.named_paths}


def _way_points(path: _NamedPath) -> str:
    waypoints: list[str] = []
    for place, node in enumerate(path.node_chain):
        if node.publish_topic_name not in UNDEFINED:
            waypoints += [node.node_name, str(node.publish_topic_name)]
        elif place < len(path.node_chain) - 1:
            waypoints.append(node.node_name)
    return "..".join(waypoints)
