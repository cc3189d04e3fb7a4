"""Orders of a directed graph's vertices in which most edges lead forwards.

Paths that only use edges leading forwards in one order can be counted, and the heaviest found, by
dynamic programming. Without cycles there are orders in which all edges do; with cycles the more
edges an order keeps, the closer the count of its paths is to the number of all simple paths.

An order is a mapping from vertex to rank; forwards is from a higher to a lower rank.
"""

import heapq
from collections.abc import Iterator, Mapping, Sequence
from typing import TypeVar

__all__ = ["depth_first_order", "greedy_order"]

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
