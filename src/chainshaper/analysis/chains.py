"""Computation chains: finding the one that a person means, and listing those there are.

A chain is written ``FIRST..LAST``, with more way points (topics, services or nodes) where several
paths match. One that begins with a topic starts at the callback that publishes it, and every chain
ends with the publication of its last topic (paper, section 2.3): of a last node that is the topic
it publishes, or, if it publishes nothing, the one it subscribes to. A service as a way point means
its request, and as the last one its response. Where several nodes of one name ran at the same time,
``/talker@4711`` is the one in process 4711.

The number of simple paths grows exponentially with cycles and fan-in, and counting them is #P-hard.
Without cycles every step forward leads to an end, so listing is a plain walk. With cycles the
shortest paths are listed first; if they are few, all paths are searched, and a search backwards
from the ends at every step avoids dead ends. Both searches have a budget. The count and the
heaviest path come from dynamic programming over the edges that lead forwards in one order of the
vertices: exact without cycles, else a bound.
"""

from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from itertools import pairwise
from typing import TypeAlias, TypeVar

from chainshaper.values.application import (
    INTERNAL_TOPICS,
    LOOP_END,
    LOOP_ENDS,
    MANAGER_WRITE,
    REQUEST,
    RESPONSE,
    ApplicationGraph,
    Callback,
    Chain,
)
from chainshaper.values.close_names import close_names
from chainshaper.values.errors import InputError
from chainshaper.values.plan_choices import STANDBY

HANDFUL = 5  # the most names or paths that a message lists
STEPS = 30_000  # budget of the search for the shortest paths, about 5 µs each
SEARCHES = 100  # budget of backward searches when all paths are listed, about 1 ms each

Vertex: TypeAlias = int | str  # a callback's id, or a topic's name
State: TypeAlias = tuple[Vertex, int]  # a vertex, and how many way points the path met until there
GraphPath: TypeAlias = tuple[Vertex, ...]
_V = TypeVar("_V")


def parse_chain(text: str) -> tuple[str, ...]:
    """Return the way points of a chain: ``/t1../t5`` → ``("/t1", "/t5")``.

    Raises InputError: nothing between two dots, more than two dots in a row, a way point twice.
    """
    waypoints = tuple(part.strip() for part in text.split(".."))
    problem = None
    if any(not part or part.startswith(".") or part.endswith(".") for part in waypoints):
        problem = "write way points (topics or nodes) with two dots between them, such as /t1../t5"
    elif repeated := [part for part in waypoints if waypoints.count(part) > 1]:
        problem = f"{repeated[0]} stands twice in it; a cyclic chain has no end-to-end latency,"
        problem += " name each way point once"
    if problem:
        raise InputError(f"chain {text!r}: {problem}")
    return waypoints


class SeveralPathsError(InputError):
    """Several paths match the text of a chain."""


@dataclass(frozen=True)
class ChainEnumeration:
    """The chains between two places of a graph."""

    chains: tuple[Chain, ...]  # all of them if `complete`, else those that were listed first
    complete: bool
    count: int  # how many there are; if not `exact`, at least
    exact: bool
    heaviest: Chain | None  # of all that were counted or listed; None without response times
    heaviest_ns: float | None  # the sum of its callbacks' mean response times


def find_chain(graph: ApplicationGraph, spec: str) -> Chain:
    """Find the one chain of ``graph`` that ``spec`` means.

    A path through a shaping node's standby is left out where there is the path through the shaping
    node: traversals go on through the standby where that published. If ``spec`` names every topic
    of a path, that path is meant, although others make detours between these topics.

    Raises InputError: a topic or node that does not exist, no path, or only a cyclic one.
    SeveralPathsError: several.
    """
    search = _Search(graph, spec, parse_chain(spec))
    paths, complete, _ = search.listed(HANDFUL + 1)
    chains = list(dict.fromkeys(_chain(graph, spec, path) for path in paths))
    if not chains:
        raise search.no_path()
    standbys = {callback.id for callback in graph.callbacks if callback.node.endswith(STANDBY)}
    chains = [chain for chain in chains if standbys.isdisjoint(chain.callbacks)] or chains
    written = {name for name, _ in search.stages}
    exact = [chain for chain in chains if written.issuperset(chain.topics)]
    if len(exact) == 1:  # and it is among the shortest paths, which are listed first
        return exact[0]
    if len(chains) > 1 or not complete:
        raise SeveralPathsError(_ambiguous(graph, spec, chains, complete))
    return chains[0]


def enumerate_chains(
    graph: ApplicationGraph,
    start: str | None = None,
    end: str | None = None,
    limit: int = 100,
    response_ns: Mapping[int, float] | None = None,
) -> ChainEnumeration:
    """List the chains from ``start`` to ``end`` (topics or nodes), at most ``limit`` of them.

    Without ``start`` chains begin at callbacks that no other callback of the application
    triggers, without ``end`` they end with topics from which no callback goes on. ``response_ns``
    is the mean response time by callback id. Never hangs: the search has a budget.

    Raises InputError: ``start`` or ``end`` does not exist, or nothing leads from one to the other.
    """
    waypoints = [name for name in (start, end) if name is not None]
    spec = f"{start or ''}..{end or ''}"
    search = _Search(graph, spec, waypoints, any_start=start is None, any_end=end is None)
    weights = response_ns or {}
    count, heaviest_path, heaviest_ns = search.counted(weights)
    paths, complete, met = search.listed(limit)
    if not paths and waypoints:
        raise search.no_path()
    chains = tuple(dict.fromkeys(_chain(graph, None, path) for path in paths))
    heaviest = _chain(graph, None, heaviest_path) if heaviest_path and weights else None
    for chain in chains if weights else ():
        weight = sum(weights.get(callback, 0.0) for callback in chain.callbacks)
        if heaviest is None or weight > heaviest_ns:
            heaviest, heaviest_ns = chain, weight
    return ChainEnumeration(
        chains=chains,
        complete=complete,
        count=len(chains) if complete else max(count, met),
        exact=complete or not (search.cyclic or search.calls),
        heaviest=heaviest,
        heaviest_ns=heaviest_ns if heaviest else None,
    )


def _chain(graph: ApplicationGraph, spec: str | None, path: GraphPath) -> Chain:
    """Make a chain of a path; without ``spec`` its text is that of its own way points."""
    callbacks = tuple(vertex for vertex in path if isinstance(vertex, int))
    topics = tuple(vertex for vertex in path if isinstance(vertex, str))
    chain = Chain(spec or "", callbacks[: len(topics)], topics)
    return chain if spec is not None else replace(chain, spec="..".join(_way_points(graph, chain)))


def chain_until(graph: ApplicationGraph, chain: Chain, hops: int) -> Chain:
    """Return the first part of a chain: so many callbacks, with their topics as way points."""
    part = Chain("", chain.callbacks[:hops], chain.topics[:hops])
    return replace(part, spec="..".join(_way_points(graph, part)))


def _way_points(graph: ApplicationGraph, chain: Chain) -> Iterator[str]:
    """Yield the topics of a chain, and nodes that share their name with another running node."""
    for callback, topic in zip(graph.path(chain), chain.topics, strict=True):
        if (node := graph.node_text(callback)) != callback.node:
            yield node
        yield topic


def _ambiguous(graph: ApplicationGraph, spec: str, chains: Sequence[Chain], complete: bool) -> str:
    """Return the message for a text that several chains match: each, with what sets it apart."""
    more = "" if complete and len(chains) <= HANDFUL else "at least "
    lines = [f"chain {spec!r}: {more}{len(chains)} paths match; add a way point:"]
    shown = chains[:HANDFUL]
    paths = [graph.path(chain) for chain in shown]
    passed = [
        (*chain.topics, *(c.node for c in path), *(graph.node_text(c) for c in path))
        for chain, path in zip(shown, paths, strict=True)
    ]
    for chain, path, names in zip(shown, paths, passed, strict=True):
        elsewhere = {name for of_path in passed if of_path is not names for name in of_path}
        only_here = next((name for name in names if name not in elsewhere), None)
        points = tuple(_way_points(graph, chain))
        remedy = f"  (only this one passes {only_here})"
        if only_here is None:
            remedy = f"  (write {'..'.join(points)})"
            if [of_path.topics for of_path in shown].count(
                chain.topics
            ) > 1 and points == chain.topics:
                remedy = _without_way_point(path, paths)
        way = " → ".join((graph.label(path[0]), *chain.topics))
        lines.append(f"  {way}{remedy}")
    return "\n".join(lines)


def _without_way_point(path: Sequence[Callback], paths: Sequence[Sequence[Callback]]) -> str:
    """Name the callback that sets a path apart where no way point does."""
    elsewhere = {
        callback.id for other_path in paths if other_path is not path for callback in other_path
    }
    apart = next((callback for callback in path if callback.id not in elsewhere), None)
    if apart is None:
        return ""  # way points together tell it apart
    return f"  (by {apart.symbol or f'callback {apart.handle:#x}'} of {apart.node})"


def _some(names: Iterable[str]) -> str:
    """Return a handful of names for a message."""
    listed = sorted(names)
    return ", ".join(listed[:HANDFUL]) + (", ..." if len(listed) > HANDFUL else "")


class _Search:
    """All paths of a graph from a start, through the way points (``stages``), to an end.

    A path alternates between callbacks and topics. A path that starts before the first stage must
    reach it in one step: a chain that begins with a topic starts at the callback that publishes it.

    * ``stages``: each way point's name, and the vertices that it stands for.
    * ``subscribers``: the callbacks that each topic triggers.
    * ``going_on``: topics that trigger a callback which publishes something.
    * ``calls``: whether some client's callback publishes, so that paths may go through a service.
    * ``ignored``: topics of ROS 2 itself, but for those that are way points.
    * ``furthest``, ``reached``: how many way points were met at most, and the vertices where so.
    * ``ends``, ``distance``: the states where a path may end, and the steps to the nearest of them.
    * ``successors``: for each state from which an end can be reached, the next ones, the nearest to
      an end first; ``roots`` are those where paths start.
    * ``edges``, ``order``, ``cyclic``: the same between vertices, their ranks in a depth-first
      search (:func:`depth_first_order`), and whether there is a cycle.
    """

    def __init__(
        self,
        graph: ApplicationGraph,
        spec: str,
        waypoints: Sequence[str],
        *,
        any_start: bool = False,
        any_end: bool = False,
    ) -> None:
        self.graph, self.spec, self.any_end = graph, spec, any_end
        self.callbacks = {callback.id: callback for callback in graph.callbacks}
        self.stages = [self._stage(name) for name in waypoints]
        for place, (name, vertices) in enumerate(self.stages):
            if {name + REQUEST, name + RESPONSE} == vertices:  # a service ends with its response
                ending = RESPONSE if 0 < place == len(waypoints) - 1 else REQUEST
                self.stages[place] = name, frozenset[Vertex]((name + ending,))
        starts = self._sources() if any_start else self._starts(*self.stages[0])
        if any_start:  # every source is as good as a first way point
            self.stages.insert(0, ("any source", frozenset[Vertex](starts)))
        listening = [c for c in graph.callbacks if c.trigger is not None]
        self.calls = any(c.kind == "client" and c.publishes for c in listening)
        self.going_on = {c.trigger for c in listening if set(c.publishes) - INTERNAL_TOPICS}
        self.subscribers: dict[Vertex, list[int]] = {}
        for callback in listening:
            self.subscribers.setdefault(callback.trigger or "", []).append(callback.id)
        self.ignored = INTERNAL_TOPICS.difference(*(vertices for _, vertices in self.stages))
        roots = [self._enter(start, 0) for start in sorted(starts)]
        reached: dict[State, tuple[State, ...]] = {}
        waiting = list(roots)
        while waiting:
            state = waiting.pop()
            if state not in reached:
                reached[state] = () if self._is_end(state) else tuple(self._step(state))
                waiting.extend(reached[state])
        self.furthest = max((met for _, met in reached), default=0)
        self.reached = {vertex for vertex, met in reached if met == self.furthest}
        self.ends = {state for state in reached if self._is_end(state)}
        self.distance = _distances(reached, self.ends)
        self.successors = {s: self._useful(reached[s]) for s in reached if s in self.distance}
        self.roots = self._useful(roots)
        self.edges: dict[Vertex, list[Vertex]] = {}
        for (vertex, _), following in self.successors.items():
            self.edges.setdefault(vertex, []).extend(after for after, _ in following)
        rank = self.order = depth_first_order(self.edges, [vertex for vertex, _ in self.roots])
        self.cyclic = any(rank[a] >= rank[v] for v, onward in self.edges.items() for a in onward)

    def wrong(self, problem: str) -> InputError:
        """Make an error that says what is wrong with the text of the chain."""
        return InputError(f"chain {self.spec!r}: {problem}")

    def _stage(self, name: str) -> tuple[str, frozenset[Vertex]]:
        """Find what a way point stands for: a topic, a service's messages or a node's callbacks."""
        nodes: dict[str, set[int]] = {node.name: set() for node in self.graph.nodes}
        topics, services = set(self.graph.topics), set[str | None]()
        for callback in self.graph.callbacks:
            if callback.kind in ("service", "client"):
                services.add(callback.topic)
            nodes.setdefault(callback.node, set()).add(callback.id)
            topics.update(callback.publishes)
        if name.endswith(LOOP_END) and name not in topics:  # that of a controller manager
            name_of_node = name.removesuffix(LOOP_END)
            written = {name_of_node + MANAGER_WRITE, f"/{name_of_node}{MANAGER_WRITE}"} & topics
            name = min(written, default=name)
        for candidate in (name, f"/{name}"):
            if candidate in topics:
                return candidate, frozenset[Vertex]((candidate,))
            if candidate in nodes:
                return candidate, frozenset[Vertex](nodes[candidate])
            node, at, process = candidate.rpartition("@")
            if at and node in nodes:
                return candidate, self._in_process(node, nodes[node], process)
            if calls := topics & {candidate + REQUEST, candidate + RESPONSE}:
                return candidate, frozenset[Vertex](calls)
            if candidate in services:
                raise self.wrong(
                    f"no call of the service {candidate} was recorded; before Kilted (tracetools"
                    " 8.5), calls have no trace points: `record --source preload` sees them on all"
                    " distributions"
                )
        if not topics:
            problem = "the recording shows no topics at all; tracing has to start before the"
            raise self.wrong(f"{problem} application does")
        if name.endswith(LOOP_ENDS):
            raise self._without_end(name, nodes.keys())
        hint = f"the names there are: {_some(topics - INTERNAL_TOPICS or topics)};"
        hint += " `chainshaper graph` shows all of them"
        if close := close_names(name, topics | nodes.keys()):
            hint = f"did you mean {' or '.join(close)}?"
        raise self.wrong(f"no topic or node is called {name}; {hint}")

    def _without_end(self, end: str, nodes: Collection[str]) -> InputError:
        """Make an error that says why there is no end of a loop, NODE:end or NODE:write."""
        name, _, ending = end.rpartition(":")
        node = name if name in nodes else f"/{name}"
        if node not in nodes:
            close = close_names(name, nodes)
            hint = (
                f"did you mean {' or '.join(close)}?" if close else "`chainshaper graph` shows all"
            )
            return self.wrong(f"no node is called {name}, whose loop has an end; {hint}")
        if ending == MANAGER_WRITE.removeprefix(":"):
            return self.wrong(
                f"{node} is no controller manager (ros2_control) whose write() the library in front"
                " saw: record it with `chainshaper record --source preload`, or end the chain with"
                " the topic that its loop publishes"
            )
        loops = [c for c in self.graph.callbacks if c.kind == "loop" and c.node == node]
        wrote = sorted({topic for loop in loops for topic in loop.publishes})
        of_node = f"{node} has no loop that was named, or that was seen to sleep"
        instead = (
            f"; or end the chain with what its loop publishes: {_some(wrote)}" if wrote else ""
        )
        return self.wrong(
            f"{of_node}: only the instances of a named loop have an end. Name it where it is"
            f" recorded, by its node or its thread's name: `chainshaper record --loop {node}`."
            " A loop that is paced by data or by another thread is named by its thread, and the"
            f" notes of `chainshaper info` say which named ones were not seen{instead}"
        )

    def _in_process(self, node: str, callbacks: Iterable[int], process: str) -> frozenset[Vertex]:
        """Select those of a node's callbacks that ran in a process."""
        in_process = [
            number for number in callbacks if process in map(str, self.callbacks[number].processes)
        ]
        if not in_process:
            ran = sorted({pid for number in callbacks for pid in self.callbacks[number].processes})
            there = ", ".join(f"{node}@{pid}" for pid in ran) or node
            raise self.wrong(f"{node} did not run in process {process}; write {there}")
        return frozenset[Vertex](in_process)

    def _starts(self, name: str, vertices: frozenset[Vertex]) -> set[int]:
        """Callbacks where a path begins whose first way point stands for ``vertices``."""
        if not any(isinstance(vertex, str) for vertex in vertices):
            of_node = {vertex for vertex in vertices if isinstance(vertex, int)}
            # A client's callback is no start: what it works on began with the request.
            return {
                number for number in of_node if self.callbacks[number].kind != "client"
            } or of_node
        starts = {
            callback.id
            for callback in self.graph.callbacks
            if vertices & (set(callback.publishes) - set(callback.passes_on))
        }
        if not starts:
            writers = ", ".join(self.graph.publishers.get(name, ())) or "no node in the recording"
            raise self.wrong(
                f"no callback was seen to publish {name} (its publisher: {writers}); begin the"
                " chain at a topic that a callback publishes; Humble has no trace points for"
                " messages within a process: run without use_intra_process_comms"
            )
        return starts

    def _sources(self) -> set[int]:
        """Publishing callbacks that no callback's publication triggers."""
        published = {topic for callback in self.graph.callbacks for topic in callback.publishes}
        return {
            callback.id
            for callback in self.graph.callbacks
            if set(callback.publishes) - INTERNAL_TOPICS and callback.trigger not in published
        }

    def _is_end(self, state: State) -> bool:
        vertex, met = state
        if met < len(self.stages):
            return False
        callback = self.callbacks[vertex] if isinstance(vertex, int) else None
        if self.any_end:
            return callback is None and vertex not in self.going_on
        _, last = self.stages[-1]
        if all(isinstance(vertex_of_last, str) for vertex_of_last in last):
            return vertex in last
        # The last way point is a node: its callback was met, then comes the topic it publishes.
        return callback is None or not callback.publishes

    def _enter(self, vertex: Vertex, met: int) -> State:
        here = met < len(self.stages) and vertex in self.stages[met][1]
        return (vertex, met + 1 if here else met)

    def _step(self, state: State) -> Iterator[State]:
        vertex, met = state
        following: Sequence[Vertex] = self.subscribers.get(vertex, ())
        if isinstance(vertex, int):
            following = self.callbacks[vertex].publishes
        for after in following:
            entered = self._enter(after, met)
            if after not in self.ignored and (met > 0 or entered[1] > 0):
                yield entered

    def _useful(self, states: Iterable[State]) -> tuple[State, ...]:
        distance = self.distance
        return tuple(sorted((s for s in states if s in distance), key=distance.__getitem__))

    def no_path(self) -> InputError:
        """Make an error that says why there is no path."""
        if self.roots and not self.cyclic:
            return self.wrong(
                "it leads through a service to a node that did not call it; responses go back to"
                " the node that sent the request"
            )
        if self.roots:
            return self.wrong(
                "it can only be closed by passing the same callback or topic twice; a cyclic chain"
                " has no end-to-end latency, give its way points in the order of the data"
            )
        met = self.furthest
        from_name = self.stages[max(met - 1, 0)][0]
        topics = sorted(vertex for vertex in self.reached if isinstance(vertex, str))
        heard = {c.trigger for c in self.graph.callbacks if c.publishes}
        stops = [topic for topic in topics if topic not in heard] or topics
        if not met or not stops:
            return self.wrong(f"no callback of {from_name} publishes anything")
        goal = self.stages[min(met, len(self.stages) - 1)][0]
        way = f"no path leads from {from_name} to {goal}"
        return self.wrong(f"{way}; from there the data gets as far as {_some(stops)}")

    def listed(self, limit: int) -> tuple[tuple[GraphPath, ...], bool, int]:
        """List up to ``limit`` paths, with cycles the shortest ones.

        Also return whether these are all, and how many paths the search met.
        """
        shortest, met = list[GraphPath](), 0
        if self.cyclic:
            shortest, met, complete = self._shortest(limit)
            if complete or len(shortest) == limit:
                return tuple(shortest), complete and met == len(shortest), met
        searched, complete = self._depth_first(limit)
        paths = tuple(dict.fromkeys((*shortest, *searched)))
        return paths[:limit], complete, max(met, len(paths))

    def _depth_first(self, limit: int) -> tuple[list[GraphPath], bool]:
        """List up to ``limit`` paths, and return whether that is all.

        Where there are cycles, every step goes where an end can still be reached without meeting
        the path again.
        """
        paths: list[GraphPath] = []
        searches = 0
        stack: list[tuple[GraphPath, State]] = [((), root) for root in reversed(self.roots)]
        while stack:
            before, state = stack.pop()
            path, following = (*before, state[0]), self.successors[state]
            if state in self.ends:
                if self._returns(path):
                    if len(paths) == limit:
                        return paths, False
                    paths.append(path)
                continue
            if self.cyclic:
                if searches == SEARCHES:
                    return paths, False
                searches += 1
                free = {s: f for s, f in self.successors.items() if s[0] not in path}
                useful = _distances(free, self.ends & free.keys())
                leading = (after for after in following if after in useful)
                following = tuple(sorted(leading, key=useful.__getitem__))
            stack += [(path, after) for after in reversed(following)]
        return paths, True

    def _returns(self, path: GraphPath) -> bool:
        """Return whether each response on the path goes to the node that sent the request."""
        callers: dict[Vertex, tuple[int, str]] = {}
        for vertex, after in pairwise((*path, "")):
            if not isinstance(vertex, int):
                continue
            callback = self.callbacks[vertex]
            sender = callback.pid, callback.node
            if (
                callback.kind == "client"
                and callers.get(f"{callback.topic}{REQUEST}", sender) != sender
            ):
                return False
            callers[after] = sender
        return True

    def _shortest(self, limit: int) -> tuple[list[GraphPath], int, bool]:
        """List up to ``limit`` of the shortest paths; return how many were met, and if that is all.

        A best-first search: the path is continued whose nearest end would make it the shortest.
        """
        paths: list[GraphPath] = []
        met = step = 0
        waiting: list[tuple[int, int, int, GraphPath, State]]
        waiting = [(self.distance[root], 0, n, (), root) for n, root in enumerate(self.roots)]
        while waiting:
            _, _, _, before, state = heappop(waiting)
            path = (*before, state[0])
            if state in self.ends and self._returns(path):
                met += 1
                if len(paths) < limit:
                    paths.append(path)
            for after in self.successors[state]:
                if step == STEPS:
                    return paths, met, False
                step += 1
                if after[0] not in path:
                    length = len(path) + self.distance[after]
                    heappush(waiting, (length, -len(path), step, path, after))
        return paths, met, True

    def counted(self, weights: Mapping[int, float]) -> tuple[int, GraphPath, float]:
        """Count the paths; return the number, the heaviest path, and the sum of its weights.

        Paths on which a response goes to another node than the one that asked count as well. If
        ``cyclic``, only paths count that never step back in an order of the vertices. There are two
        such orders, of depth-first searches that go to the nearest ends first, or last; the larger
        number counts, and the heavier path.
        """
        orders = [self.order]
        if self.cyclic:
            onward = {vertex: following[::-1] for vertex, following in self.edges.items()}
            orders.append(depth_first_order(onward, [vertex for vertex, _ in self.roots[::-1]]))
        results = [self._counted_in(order, weights) for order in orders]
        _, heaviest, weight = max(results, key=lambda result: result[2])
        return max(count for count, _, _ in results), heaviest, weight

    def _counted_in(
        self, order: Mapping[Vertex, int], weights: Mapping[int, float]
    ) -> tuple[int, GraphPath, float]:
        """Do :meth:`counted` for the edges that lead forwards in one order of the vertices."""
        of_state: dict[State, tuple[int, GraphPath, float]] = {}
        for state in sorted(self.successors, key=lambda s: (order[s[0]], -s[1])):
            vertex = state[0]
            own_weight = weights.get(vertex, 0.0) if isinstance(vertex, int) else 0.0
            count, weight = (1, 0.0) if state in self.ends else (0, -1.0)
            onward: GraphPath = ()
            for after in self.successors[state]:
                if after in of_state and order[after[0]] < order[vertex]:
                    paths, path, below = of_state[after]
                    count += paths
                    if paths and below > weight:
                        onward, weight = path, below
            of_state[state] = (count, (vertex, *onward), own_weight + weight)
        of_roots = [of_state[root] for root in self.roots if of_state[root][0]]
        _, heaviest, weight = max(of_roots, key=lambda result: result[2], default=(0, (), 0.0))
        return sum(count for count, _, _ in of_roots), heaviest, weight


def _distances(successors: Mapping[State, tuple[State, ...]], ends: set[State]) -> dict[State, int]:
    """Count the steps from each state to the nearest end; states that reach none are left out."""
    before: dict[State, list[State]] = {}
    for state, following in successors.items():
        for after in following:
            before.setdefault(after, []).append(state)
    distance = dict.fromkeys(ends, 0)
    waiting = deque(ends)
    while waiting:
        state = waiting.popleft()
        for previous in before.get(state, ()):
            if previous not in distance:
                distance[previous] = distance[state] + 1
                waiting.append(previous)
    return distance


def depth_first_order(edges: Mapping[_V, Sequence[_V]], roots: Sequence[_V]) -> dict[_V, int]:
    """Rank vertices in the order in which a depth-first search leaves them.

    Edges lead to lower ranks, but for those that close a cycle.
    """
    rank: dict[_V, int] = {}
    entered: set[_V] = set()
    stack: list[tuple[_V | None, Iterator[_V]]] = [(None, iter(roots))]
    while stack:
        vertex, rest = stack[-1]
        after = next((v for v in rest if v not in entered), None)
        if after is not None:
            entered.add(after)
            stack.append((after, iter(edges.get(after, ()))))
        else:
            stack.pop()
            if vertex is not None:
                rank[vertex] = len(rank)
    return rank
