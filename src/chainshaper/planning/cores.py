"""Which core runs which executor: found from what overlaps in time.

The paper takes the assignment as given (sections 5.1 and 5.4). Executors gain from cores of their
own where branches run at the same time, or slots of different chains would collide. An assignment
is judged by playing out one cycle of each graph: of the callbacks for which all is done that they
wait for, the most urgent executor's runs on each core, in the order of
:mod:`chainshaper.enforcement.thread_scheduling`: chains first, then the branches that they wait
for. What counts, in this order:

1. by how much chains that share a core do not fit: slots as long as the longest execution must
   both fit into the greatest common divisor of their periods
   (:mod:`chainshaper.planning.offsets`), and all of the fullest core into its time;
2. the sum of all outputs' mean latencies, each as a share of its period;
3. how many messages cross between cores.

Of up to ten executors all assignments are tried. Of more, the best of fewer cores is improved by
moving one executor, or swapping two, for as long as that is better.
"""

import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Sequence
from functools import partial
from itertools import combinations
from typing import NamedTuple, TypeAlias

from chainshaper.planning.profile import Profile

MOST_TRIED = 10  # executors, whose assignments are all tried
MOST_OF_MEAN = 2  # so many times its mean a callback lasts at most: what took longer had to wait
_Assignment: TypeAlias = tuple[int, ...]  # of each executor, the place of its core
_Cost: TypeAlias = Callable[[_Assignment], tuple[float, float, int]]


class _Callback(NamedTuple):
    executor: int  # the most urgent is 0
    mean_ns: int
    longest_ns: int
    after: tuple[int, ...]


class _Graph(NamedTuple):
    period_ns: int
    callbacks: list[_Callback]
    outputs: list[int]  # which callbacks publish them


def assign_cores(
    profiles: Sequence[Profile], cores: Sequence[int], *, margin_ns: int = 0, worth: float = 0.0
) -> dict[str, int]:
    """The core of each node's executor, out of ``cores``: the first has that of the first callback.

    As few cores as do as well are used: a further one must let more chains fit, or take more than
    the share ``worth`` off the latencies. The nodes of one process move as one. A slot is
    ``margin_ns`` longer than the longest execution.
    """
    own = ((*one.core_of, *(callback.node for callback in one.callbacks)) for one in profiles)
    nodes = dict.fromkeys(node for ordered in own for node in ordered)
    hosts = {node: min(group) for one in profiles for group in one.together for node in group}
    executors = list(dict.fromkeys(hosts.get(node, node) for node in nodes))
    executor_of = {node: executors.index(hosts.get(node, node)) for node in nodes}
    cost = partial(_cost, _graphs(profiles, executor_of), margin_ns)
    best: _Assignment = (0,) * len(executors)
    for count in range(2, min(len(cores), len(executors)) + 1):
        if len(executors) <= MOST_TRIED:
            found = min(_all(len(executors), count), key=cost)
        else:
            found = _improved(best, count, cost)
        (excess, latency, _), (least_excess, least, _) = cost(found), cost(best)
        if excess >= least_excess and latency >= (1 - worth) * least:
            break
        best = found
    return {node: cores[best[executor_of[node]]] for node in nodes}


def _graphs(profiles: Sequence[Profile], executor_of: dict[str, int]) -> list[_Graph]:
    """The graphs of all chains: those that begin together are one; callbacks of one node that wait
    for the same are the same.
    """
    graphs: dict[Hashable, _Graph] = {}
    known: dict[Hashable, int] = {}
    for one in profiles:
        begins = (one.begins, one.period_ns)
        graph = graphs.setdefault(begins, _Graph(one.period_ns, [], []))
        own: list[int] = []
        seen: Counter[Hashable] = Counter()
        for callback in one.callbacks:
            after = tuple(sorted({own[place] for place in callback.after}))
            key = (begins, callback.node, after)
            seen[key] += 1
            mean = callback.mean_response_ns
            longest = min(callback.max_response_ns, MOST_OF_MEAN * mean)
            found = _Callback(executor_of[callback.node], mean, longest, after)
            place = known.setdefault((key, seen[key]), len(graph.callbacks))
            graph.callbacks[place : place + 1] = [max([found, *graph.callbacks[place : place + 1]])]
            own.append(place)
        graph.outputs.append(own[-1])
    return list(graphs.values())


def _all(executors: int, cores: int, begun: _Assignment = (0,)) -> Iterator[_Assignment]:
    """Every assignment in which a core is used only if those before it are."""
    if len(begun) == executors:
        yield begun
        return
    for core in range(min(cores, max(begun) + 2)):
        yield from _all(executors, cores, (*begun, core))


def _improved(best: _Assignment, cores: int, cost: _Cost) -> _Assignment:
    while True:
        places = range(len(best))
        moved = [(*best[:k], core, *best[k + 1 :]) for k in places for core in range(cores)]
        for j, k in combinations(places, 2):
            moved.append((*best[:j], best[k], *best[j + 1 : k], best[j], *best[k + 1 :]))
        found = min(moved, key=cost)
        if cost(found) >= cost(best):
            return best
        best = found


def _cost(
    graphs: Sequence[_Graph], margin_ns: int, assignment: _Assignment
) -> tuple[float, float, int]:
    excess = latency = 0.0
    slots, crossing = list[tuple[set[int], int, int]](), 0
    load = dict.fromkeys(assignment, 0.0)
    for graph in graphs:
        home = [assignment[one.executor] for one in graph.callbacks]
        mean = _played_out(graph, assignment, [one.mean_ns for one in graph.callbacks])
        longest = _played_out(graph, assignment, [one.longest_ns for one in graph.callbacks])
        latency += sum(mean[place] for place in graph.outputs) / graph.period_ns
        slots.append((set(home), max(longest) + margin_ns, graph.period_ns))
        for core in set(home):
            load[core] += slots[-1][1] / graph.period_ns
        ends = zip(home, graph.callbacks, strict=True)
        crossing += sum(home[place] != core for core, one in ends for place in one.after)
    for (ours, slot, period), (theirs, other, its) in combinations(slots, 2):
        if ours & theirs:
            excess += max(0.0, (slot + other) / math.gcd(period, its) - 1)
    excess += max(0.0, max(load.values()) - 1)
    return round(excess, 9), round(latency, 9), crossing


def _played_out(graph: _Graph, assignment: _Assignment, lasting: Sequence[int]) -> list[int]:
    """When each callback of a cycle is done."""
    left, done, now = [*lasting], dict[int, int](), 0
    while len(done) < len(left):
        ready = [  # the most urgent executor first, and of its callbacks the one that has begun
            (one.executor, left[place] == lasting[place], place)
            for place, one in enumerate(graph.callbacks)
            if place not in done and all(before in done for before in one.after)
        ]
        running: dict[int, int] = {}  # on each core
        for executor, _, place in sorted(ready):
            running.setdefault(assignment[executor], place)
        step = min(left[place] for place in running.values())
        now += step
        for place in running.values():
            left[place] -= step
            if not left[place]:
                done[place] = now
    return [done[place] for place in range(len(left))]
