"""Which core runs which executor, from what overlaps in time.

The paper takes the assignment as given (sections 5.1 and 5.4). Executors gain from cores of their
own where branches run at the same time, or slots of different chains would collide. An assignment
is judged by playing out one cycle of each graph. A callback is ready when all that it waits for is
done; of those that are ready, each core runs that of the most urgent executor, in the order of
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

MOST_TRIED = 10  # with so many executors at most, all assignments are tried
MOST_OF_MEAN = 2  # a callback lasts so many times its mean at most: one that took longer waited
_Assignment: TypeAlias = tuple[int, ...]  # of each executor, the place of its core
_Cost: TypeAlias = Callable[[_Assignment], tuple[float, float, int]]


class _Callback(NamedTuple):
    executor: int  # the most urgent is 0
    mean_ns: int
    longest_ns: int
    after: tuple[int, ...]  # the places in the graph of the callbacks that it waits for


class _Graph(NamedTuple):
    period_ns: int
    callbacks: list[_Callback]
    outputs: list[int]  # the places of the callbacks that publish outputs


class _Slot(NamedTuple):
    """What a graph needs of each of its cores in a period, as one slot."""

    cores: set[int]
    length_ns: int
    period_ns: int


def assign_cores(
    profiles: Sequence[Profile], cores: Sequence[int], *, margin_ns: int = 0, worth: float = 0.0
) -> dict[str, int]:
    """Return the core of each node's executor, out of ``cores``; the first callback's is the first.

    As few cores as do as well are used: a further one must let more chains fit, or take more than
    the share ``worth`` off the latencies. The nodes of a process stay together. A slot is
    ``margin_ns`` longer than the longest execution.
    """
    nodes: dict[str, None] = {}
    for profile in profiles:
        nodes |= dict.fromkeys(profile.core_of)
        nodes |= dict.fromkeys(callback.node for callback in profile.callbacks)
    hosts = {
        node: min(process)
        for profile in profiles
        for process in profile.together
        for node in process
    }
    executors = list(dict.fromkeys(hosts.get(node, node) for node in nodes))
    executor_of = {node: executors.index(hosts.get(node, node)) for node in nodes}
    cost = partial(_cost, _graphs(profiles, executor_of), margin_ns)
    best: _Assignment = (0,) * len(executors)
    for count in range(2, min(len(cores), len(executors)) + 1):
        if len(executors) <= MOST_TRIED:
            assignment = min(_all(len(executors), count), key=cost)
        else:
            assignment = _improved(best, count, cost)
        (excess, latency, _), (least_excess, least, _) = cost(assignment), cost(best)
        if excess >= least_excess and latency >= (1 - worth) * least:
            break
        best = assignment
    return {node: cores[best[executor_of[node]]] for node in nodes}


def _graphs(profiles: Sequence[Profile], executor_of: dict[str, int]) -> list[_Graph]:
    """Return the graphs of all chains; chains that begin together are one graph.

    Callbacks of one node that wait for the same are the same callback.
    """
    graphs: dict[Hashable, _Graph] = {}
    known: dict[Hashable, int] = {}
    for profile in profiles:
        begins = (profile.begins, profile.period_ns)
        graph = graphs.setdefault(begins, _Graph(profile.period_ns, [], []))
        places: list[int] = []  # in the graph, of each callback of the profile
        seen: Counter[Hashable] = Counter()
        for callback in profile.callbacks:
            after = tuple(sorted({places[before] for before in callback.after}))
            key = (begins, callback.node, after)
            seen[key] += 1
            mean = callback.mean_response_ns
            longest = min(callback.max_response_ns, MOST_OF_MEAN * mean)
            measured = _Callback(executor_of[callback.node], mean, longest, after)
            place = known.setdefault((key, seen[key]), len(graph.callbacks))
            if place == len(graph.callbacks):
                graph.callbacks.append(measured)
            else:
                graph.callbacks[place] = max(measured, graph.callbacks[place])
            places.append(place)
        graph.outputs.append(places[-1])
    return list(graphs.values())


def _all(executors: int, cores: int, begun: _Assignment = (0,)) -> Iterator[_Assignment]:
    """Yield every assignment that uses a core only if it uses those before it."""
    if len(begun) == executors:
        yield begun
        return
    for core in range(min(cores, max(begun) + 2)):
        yield from _all(executors, cores, (*begun, core))


def _improved(best: _Assignment, cores: int, cost: _Cost) -> _Assignment:
    """Move one executor, or swap two, for as long as that is better."""
    while True:
        places = range(len(best))
        changed = [(*best[:k], core, *best[k + 1 :]) for k in places for core in range(cores)]
        for j, k in combinations(places, 2):
            changed.append((*best[:j], best[k], *best[j + 1 : k], best[j], *best[k + 1 :]))
        better = min(changed, key=cost)
        if cost(better) >= cost(best):
            return best
        best = better


def _cost(
    graphs: Sequence[_Graph], margin_ns: int, assignment: _Assignment
) -> tuple[float, float, int]:
    """Return what counts of an assignment: excess of slots, latencies, crossing messages."""
    excess = latency = 0.0
    crossing = 0
    slots: list[_Slot] = []
    load = dict.fromkeys(assignment, 0.0)
    for graph in graphs:
        core_of = [assignment[callback.executor] for callback in graph.callbacks]
        means = [callback.mean_ns for callback in graph.callbacks]
        longest = [callback.longest_ns for callback in graph.callbacks]
        done = _played_out(graph, assignment, means)
        latency += sum(done[place] for place in graph.outputs) / graph.period_ns
        done = _played_out(graph, assignment, longest)
        slot = _Slot({*core_of}, max(done) + margin_ns, graph.period_ns)
        slots.append(slot)
        for core in slot.cores:
            load[core] += slot.length_ns / graph.period_ns
        crossing += sum(
            core_of[before] != core
            for core, callback in zip(core_of, graph.callbacks, strict=True)
            for before in callback.after
        )
    for first, second in combinations(slots, 2):
        if first.cores & second.cores:
            common_ns = math.gcd(first.period_ns, second.period_ns)
            excess += max(0.0, (first.length_ns + second.length_ns) / common_ns - 1)
    excess += max(0.0, max(load.values()) - 1)
    return round(excess, 9), round(latency, 9), crossing


def _played_out(graph: _Graph, assignment: _Assignment, lasting: Sequence[int]) -> list[int]:
    """Return when each callback of a cycle is done, if they last for so long."""
    left, done, now = [*lasting], dict[int, int](), 0
    while len(done) < len(left):
        ready = [  # the most urgent executor first, and of its callbacks the one that has begun
            (callback.executor, left[place] == lasting[place], place)
            for place, callback in enumerate(graph.callbacks)
            if place not in done and all(before in done for before in callback.after)
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
