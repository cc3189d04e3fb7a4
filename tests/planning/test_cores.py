"""Which core runs which executor: worked out by hand, by brute force, and on the paper's graph."""

import random
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from chainshaper import load_application
from chainshaper.planning import CallbackTimes, Profile, cores
from chainshaper.planning.cores import assign_cores

MS = 1_000_000
DAG = Path(__file__).parents[2] / "experiments" / "dag.yaml"


def _work(
    *callbacks: tuple[str, int, tuple[int, ...]], begins: str = "", period: int = 100
) -> Profile:
    """A chain of callbacks: node, time in ms, places of those that it waits for."""
    times = [CallbackTimes(node, 0, 0, ms * MS, ms * MS, after) for node, ms, after in callbacks]
    return Profile(np.zeros(2, np.int64), period * MS, begins=(0, begins), callbacks=tuple(times))


def _alone(name: str, ms: int, period: int) -> Profile:
    return _work((name, ms, ()), begins=name, period=period)


PARKING = _work(
    *[("throttler", 2, ()), ("rear", 20, (0,)), ("front", 31, (0,)), ("fusion", 4, (1, 2))],
    ("ndt", 40, (3,)),
)


def test_a_branch_that_runs_beside_another_gets_a_core_of_its_own() -> None:
    """2 + 20 + 31 + 4 + 40 = 97 ms on one core; beside the rear filter the front one costs 11."""
    found = assign_cores([PARKING], [1, 0])
    assert found == {"throttler": 1, "rear": 1, "front": 0, "fusion": 1, "ndt": 1}
    too_long = replace(PARKING, period_ns=50 * MS)
    assert assign_cores([too_long], [1, 0]) == found, "too long, but less"
    assert assign_cores([PARKING], [1, 0], worth=0.2) == found  # 77 ms: 20.6 % less
    assert set(assign_cores([PARKING], [1, 0], worth=0.21).values()) == {1}
    assert set(assign_cores([PARKING], [3]).values()) == {3}


def test_one_cycle_is_played_out_by_hand_the_more_urgent_first() -> None:
    """The chain a, b, c, and beside b the executor x with two callbacks, one after the other."""
    work = [("a", 10, ()), ("b", 5, (0,)), ("x", 30, (0,)), ("x", 1, (1,)), ("c", 10, (1, 2, 3))]
    chain = replace(_work(*work), core_of=dict.fromkeys("abcx", 0))
    (graph,) = cores._graphs([chain], {"a": 0, "b": 1, "c": 2, "x": 3})
    for b_at, done in ((0, [10, 15, 45, 46, 56]), (1, [10, 15, 40, 41, 51])):
        played = cores._played_out(graph, (0, b_at, 0, 0), [one.mean_ns for one in graph.callbacks])
        assert played == [ms * MS for ms in done]
    at_once = [("a", 10, ()), ("b", 20, (0,)), ("x", 30, (0,)), ("c", 5, (1,))]
    (graph,) = cores._graphs([_work(*at_once)], {"a": 0, "b": 1, "c": 2, "x": 3})
    played = cores._played_out(graph, (0, 1, 0, 0), [one.mean_ns for one in graph.callbacks])
    assert played == [10 * MS, 30 * MS, 45 * MS, 35 * MS], "c interrupts x from 30 to 35 ms"


def test_chains_and_processes_keep_or_get_cores_by_hand() -> None:
    chain = _work(("a", 10, ()), ("b", 10, (0,)), ("c", 10, (1,)))
    assert assign_cores([chain], [2, 1, 0]) == {"a": 2, "b": 2, "c": 2}, "one after the other"
    process = replace(PARKING, together=(("rear", "front"),))
    assert set(assign_cores([process], [1, 0]).values()) == {1}
    # With periods of 100 and 40 ms both slots must fit into 20 ms.
    for first, core in ((12, 1), (13, 0)):
        assert assign_cores([_alone("a", first, 100), _alone("b", 8, 40)], [1, 0])["b"] == core
    # Of three chains of which any two fit, one goes elsewhere.
    chains = [_alone(name, 40, 100) for name in "abc"]
    assert sorted(assign_cores(chains, [0, 1, 2]).values()) == [0, 0, 1]
    # Source 10, sinks 40 each: one after the other, and twice the source, is more than 100 ms.
    sinks = [_work(("source", 10, ()), (name, 40, (0,))) for name in "ab"]
    assert assign_cores(sinks, [0, 1]) == {"source": 0, "a": 0, "b": 1}
    assert set(assign_cores(sinks, [0, 1], worth=0.5).values()) == {0}, "10 + 80 ms fit"


def test_the_best_of_all_assignments_is_found() -> None:
    generator = random.Random(1)
    for _ in range(20):
        work = []
        for begins, period in (("x", 100), ("y", 60)):
            after = [tuple(sorted(generator.sample(range(k), min(k, 2)))) for k in range(4)]
            drawn = [(f"n{generator.randrange(5)}", generator.randint(1, 20), one) for one in after]
            work.append(_work(*drawn, begins=begins, period=period))
        found = assign_cores(work, [0, 1])
        graphs = cores._graphs(work, {name: k for k, name in enumerate(found)})
        best = min(cores._cost(graphs, 0, one) for one in product((0, 1), repeat=len(found)))
        assert cores._cost(graphs, 0, tuple(found.values()))[:2] == best[:2]


def test_the_papers_graph_of_18_callbacks_takes_its_longest_path_on_two_cores() -> None:
    """Section 5.4: 802 ms of work; no assignment can be faster than the longest path, 560 ms."""
    places: dict[str, int] = {}
    callbacks = []
    for name, node in load_application(DAG).nodes.items():
        for one in node.callbacks:
            if one.publishes and one.execution.uniform_ns is not None:
                after = tuple(places[topic] for topic in one.inputs)
                callbacks.append((name, one.execution.uniform_ns[1] // MS, after))
                places[one.publishes[0]] = len(places)
    work = _work(*callbacks, period=764)
    found = assign_cores([work], [0, 1])
    graphs = cores._graphs([work], {name: k for k, name in enumerate(found)})
    assert len(found) == 18
    assert round(cores._cost(graphs, 0, tuple(found.values()))[1] * 764) == 560
