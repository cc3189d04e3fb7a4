"""Searching paths in the graph of callbacks and topics, without ever hanging.

A path alternates between callbacks and topics and meets given way points in their order. Real
applications have cycles and wide fan-in, so the number of simple paths grows exponentially, and
counting them is #P-hard. Four things keep the answers quick:

* only vertices that lie between a start and an end at all are looked at;
* where these form no cycle, every step forward leads to an end, so listing needs no search;
* where they do, paths are listed by length; if short ones are few, one search backwards from the
  ends per step finds the steps that still lead somewhere without meeting the path itself, so
  that no dead end is ever entered; both have a budget;
* counting and the heaviest path come from dynamic programming over the edges that lead forwards
  in one order of the vertices (vertex → rank, from a higher to a lower): exact without cycles,
  with cycles a lower bound, closer the more edges the order agrees with.
"""

import heapq
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from chainshaper.analysis.objects import INTERNAL_TOPICS
from chainshaper.values.application import ApplicationGraph, Callback

__all__ = ["Listing", "Path", "PathSearch", "Stage", "Vertex", "depth_first_order", "greedy_order"]

V = TypeVar("V")


def depth_first_order(edges: Mapping[V, Sequence[V]], roots: Sequence[V]) -> dict[V, int]:
    """Vertices ranked as a depth-first search leaves them; all edges lead forwards if they can."""
    rank: dict[V, int] = {}
    entered: set[V] = set()
    for root in roots:
        if root in entered:
            continue
        entered.add(root)
        stack: list[tuple[V, Iterator[V]]] = [(root, iter(edges.get(root, ())))]
        while stack:
            vertex, rest = stack[-1]
            after = next((v for v in rest if v not in entered), None)
            if after is None:
                rank[vertex] = len(rank)
                stack.pop()
            else:
                entered.add(after)
                stack.append((after, iter(edges.get(after, ()))))
    return rank


def greedy_order(edges: Mapping[V, Sequence[V]]) -> dict[V, int]:
    """An order with few backward edges: the heuristic of Eades, Lin and Smyth (1993).

    Sinks go to the back, sources to the front, and when there are neither the vertex with the
    greatest surplus of outgoing edges goes to the front. Cost is edges · log.
    """
    after: dict[V, set[V]] = {vertex: set(following) for vertex, following in edges.items()}
    before: dict[V, set[V]] = {vertex: set() for vertex in after}
    for vertex in list(after):
        for following in edges[vertex]:
            after.setdefault(following, set())
            before.setdefault(following, set()).add(vertex)
    number = {vertex: index for index, vertex in enumerate(after)}

    def urgency(vertex: V) -> tuple[int, int]:
        """0 for sinks, 1 for sources, then by surplus."""
        if not after[vertex]:
            return 0, 0
        return (1, 0) if not before[vertex] else (2, len(before[vertex]) - len(after[vertex]))

    heap = [(urgency(vertex), number[vertex], vertex) for vertex in after]
    heapq.heapify(heap)
    front: list[V] = []
    back: list[V] = []
    placed: set[V] = set()
    while heap:
        noted, _, vertex = heapq.heappop(heap)
        if vertex in placed or noted != urgency(vertex):
            continue  # an entry from before its neighbours went
        placed.add(vertex)
        (front if after[vertex] else back).append(vertex)
        touched = [*before[vertex], *after[vertex]]
        for neighbour in before[vertex]:
            after[neighbour].discard(vertex)
        for neighbour in after[vertex]:
            before[neighbour].discard(vertex)
        for neighbour in touched:
            heapq.heappush(heap, (urgency(neighbour), number[neighbour], neighbour))
    order = [*front, *reversed(back)]
    return {vertex: len(order) - place for place, vertex in enumerate(order)}


Vertex = int | str
"""A callback's id, or a topic's name."""

State = tuple[Vertex, int]
"""A vertex, and how many way points have been met with it."""

Path = tuple[Vertex, ...]

STEPS = 100_000
"""Steps that looking for short paths may take where there are cycles, about 1 µs each."""

SEARCHES = 100
"""Backward searches that looking for all paths may take then, about 1 ms each."""


@dataclass(frozen=True)
class Stage:
    """A way point: its name and the vertices that it stands for."""

    name: str
    vertices: frozenset[Vertex]


@dataclass(frozen=True)
class Listing:
    """``paths`` that were found, whether they are all, and how many were met on the way."""

    paths: tuple[Path, ...]
    complete: bool
    count: int


@dataclass
class PathSearch:
    """All paths from ``starts`` through ``stages`` to a state that ``accepts``.

    ``starts`` are callbacks. A path that starts before the first stage must go there at once (a
    chain that begins with a topic starts at the callback that publishes it).
    """

    graph: ApplicationGraph
    starts: frozenset[int]
    stages: tuple[Stage, ...]
    accepts: Callable[[State, Callback | None], bool]
    successors: dict[State, tuple[State, ...]] = field(init=False)
    ends: set[State] = field(init=False)
    distance: dict[State, int] = field(init=False)
    roots: tuple[State, ...] = field(init=False)
    cyclic: bool = field(init=False)
    furthest: int = field(init=False)
    reached: frozenset[Vertex] = field(init=False)

    def __post_init__(self) -> None:
        self._callbacks = {callback.id: callback for callback in self.graph.callbacks}
        named = frozenset().union(*(stage.vertices for stage in self.stages))
        self._ignored = INTERNAL_TOPICS - named
        self._subscribers: dict[str, list[int]] = {}
        for callback in self.graph.callbacks:
            if callback.topic is not None and callback.kind == "subscription":
                self._subscribers.setdefault(callback.topic, []).append(callback.id)
        roots = [self._enter(start, 0) for start in sorted(self.starts)]
        self.successors = self._reachable(roots)
        self.ends = {state for state in self.successors if self._is_end(state)}
        useful = self.distance = _distances(self.successors, self.ends)
        self.furthest = max((met for _, met in self.successors), default=0)
        self.reached = frozenset(v for v, met in self.successors if met == self.furthest)
        self.successors = {
            state: tuple(sorted((s for s in following if s in useful), key=useful.__getitem__))
            for state, following in self.successors.items()
            if state in useful
        }
        self.roots = tuple(sorted((r for r in roots if r in useful), key=useful.__getitem__))
        self._edges: dict[Vertex, list[Vertex]] = {}
        for (vertex, _), following in self.successors.items():
            self._edges.setdefault(vertex, []).extend(after for after, _ in following)
        self._order = depth_first_order(self._edges, [vertex for vertex, _ in self.roots])
        self.cyclic = any(
            self._order[after] >= self._order[vertex]
            for vertex, onward in self._edges.items()
            for after in onward
        )

    def _enter(self, vertex: Vertex, met: int) -> State:
        here = met < len(self.stages) and vertex in self.stages[met].vertices
        return (vertex, met + 1 if here else met)

    def _is_end(self, state: State) -> bool:
        vertex = state[0]
        return self.accepts(state, self._callbacks[vertex] if isinstance(vertex, int) else None)

    def _reachable(self, roots: list[State]) -> dict[State, tuple[State, ...]]:
        found: dict[State, tuple[State, ...]] = {}
        waiting = list(roots)
        while waiting:
            state = waiting.pop()
            if state in found:
                continue
            found[state] = () if self._is_end(state) else tuple(self._step(state))
            waiting.extend(found[state])
        return found

    def _step(self, state: State) -> Iterator[State]:
        vertex, met = state
        if isinstance(vertex, int):
            following: list[Vertex] = list(self._callbacks[vertex].publishes)
        else:
            following = list(self._subscribers.get(vertex, ()))
        for after in following:
            if after not in self._ignored:
                entered = self._enter(after, met)
                if met > 0 or entered[1] > 0:
                    yield entered

    def listed(self, limit: int) -> "Listing":
        """Up to ``limit`` paths. Where there are cycles, the shortest ones first."""
        if not self.cyclic:
            paths, complete = self._one_after_another(limit)
            return Listing(paths, complete, len(paths))
        shortest, count, complete = self._by_length(limit)
        if complete or len(shortest) == limit:
            return Listing(shortest, complete and count == len(shortest), count)
        others, complete = self._one_after_another(limit)
        paths = tuple(dict.fromkeys((*shortest, *others)))
        return Listing(paths[:limit], complete, max(count, len(paths)))

    def _one_after_another(self, limit: int) -> tuple[tuple[Path, ...], bool]:
        """Up to ``limit`` paths without entering a dead end, and whether that is all."""
        found: list[Path] = []
        searches = 0
        for root in self.roots:
            on_path: set[Vertex] = set()
            stack: list[tuple[State, Iterator[State]]] = [((root[0], -1), iter((root,)))]
            while stack:
                state = next(stack[-1][1], None)
                if state is None:
                    on_path.discard(stack.pop()[0][0])
                    continue
                if state[0] in on_path:
                    continue
                if state in self.ends:
                    if len(found) == limit:
                        return tuple(found), False
                    found.append((*(s[0] for s, _ in stack[1:]), state[0]))
                    continue
                on_path.add(state[0])
                following = self.successors[state]
                if self.cyclic:
                    if searches == SEARCHES:
                        return tuple(found), False
                    searches += 1
                    following = self._leading_on(state, on_path)
                stack.append((state, iter(following)))
        return tuple(found), True

    def _by_length(self, limit: int) -> tuple[tuple[Path, ...], int, bool]:
        """The shortest paths: up to ``limit`` of them, how many were met, whether that is all.

        Iterative deepening: no step is taken from which the nearest end is too far for the bound,
        which keeps dead ends few while the bound is near the shortest length.
        """
        found: list[Path] = []
        count, steps = 0, STEPS
        before, bound = 0, min((self.distance[root] for root in self.roots), default=0)
        while True:
            beyond = False
            for root in self.roots:
                on_path: set[Vertex] = set()
                stack: list[tuple[State, Iterator[State]]] = [((root[0], -1), iter((root,)))]
                while stack:
                    state = next(stack[-1][1], None)
                    if state is None:
                        on_path.discard(stack.pop()[0][0])
                        continue
                    steps -= 1
                    if steps == 0:
                        return tuple(found), count, False
                    length = len(stack) - 1
                    if state[0] in on_path:
                        continue
                    if length + self.distance[state] > bound:
                        beyond = True
                    elif state in self.ends:
                        if length > before:
                            count += 1
                            if len(found) < limit:
                                found.append((*(s[0] for s, _ in stack[1:]), state[0]))
                    else:
                        on_path.add(state[0])
                        stack.append((state, iter(self.successors[state])))
            if not beyond:
                return tuple(found), count, True
            before, bound = bound, bound + 2  # a hop is a callback and a topic

    def _leading_on(self, state: State, on_path: set[Vertex]) -> tuple[State, ...]:
        """The successors from which an end can be reached without meeting the path again."""
        free = {s: f for s, f in self.successors.items() if s[0] not in on_path}
        useful = _distances(free, {end for end in self.ends if end in free})
        following = [after for after in self.successors[state] if after in useful]
        return tuple(sorted(following, key=useful.__getitem__))

    def counted(self, weights: Mapping[int, float]) -> tuple[int, Path, float]:
        """Number of paths, the heaviest of them, and its weight (the sum over its callbacks).

        All paths are counted unless ``cyclic``. Else those are that never step back in one order
        of the vertices: the depth-first one, or the greedy one if more paths agree with it.
        """
        orders = [self._order] + ([self._greedy()] if self.cyclic else [])
        results = [self._counted_in(order, weights) for order in orders]
        heaviest = max(results, key=lambda result: result[2])
        return max(result[0] for result in results), heaviest[1], heaviest[2]

    def _greedy(self) -> dict[Vertex, int]:
        """The greedy order of topics, every callback just after the topic it subscribes to.

        Callbacks have one edge in and thus no choice: ordered by themselves they would all come
        before their topics. Roots are first, no path comes back to them.
        """
        roots = [vertex for vertex, _ in self.roots]
        between: dict[str, list[str]] = {}
        for vertex, onward in self._edges.items():
            topic = self._callbacks[vertex].topic if isinstance(vertex, int) else None
            if topic is not None and vertex not in roots:
                between.setdefault(topic, []).extend(str(after) for after in onward)
        rank: dict[Vertex, int] = {}
        for topic, place in greedy_order(between).items():
            rank[topic] = 2 * place
            for callback in self._subscribers.get(topic, ()):
                rank[callback] = 2 * place - 1
        last = min(rank.values(), default=0)
        for vertex in self._edges:
            rank.setdefault(vertex, last - 1)  # topics that only a root publishes, and that end
        return rank | dict.fromkeys(roots, max(rank.values(), default=0) + 1)

    def _counted_in(
        self, order: Mapping[Vertex, int], weights: Mapping[int, float]
    ) -> tuple[int, Path, float]:
        best: dict[State, tuple[int, float, State | None]] = {}
        for state in sorted(self.successors, key=lambda s: (order[s[0]], -s[1])):
            vertex = state[0]
            own = weights.get(vertex, 0.0) if isinstance(vertex, int) else 0.0
            count, weight, chosen = (1, 0.0, None) if state in self.ends else (0, -1.0, None)
            for after in self.successors[state]:
                if after not in best or order[after[0]] >= order[vertex]:
                    continue
                paths, below, _ = best[after]
                count += paths
                if paths and below > weight:
                    weight, chosen = below, after
            best[state] = (count, own + weight, chosen)
        roots = [root for root in self.roots if best[root][0]]
        if not roots:
            return 0, (), 0.0
        first = max(roots, key=lambda root: best[root][1])
        heaviest: list[Vertex] = []
        at: State | None = first
        while at is not None:
            heaviest.append(at[0])
            at = best[at][2]
        return sum(best[root][0] for root in roots), tuple(heaviest), best[first][1]


def _distances(successors: Mapping[State, tuple[State, ...]], ends: set[State]) -> dict[State, int]:
    """Steps from every state to the nearest end, for those from which one can be reached."""
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
