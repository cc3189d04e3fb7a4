"""Chains: what a person writes, which one it means, and graphs too large to list."""

import itertools
import random
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from story import Story

from chainshaper.analysis import (
    application_graph,
    enumerate_chains,
    find_chain,
    load_named_paths,
    parse_chain,
)
from chainshaper.values.application import ApplicationGraph, Callback, Node
from chainshaper.values.errors import InputError

Edges = tuple[str | None, tuple[str, ...]]


def graph(**nodes: list[Edges]) -> ApplicationGraph:
    """Nodes with their callbacks: (subscribed topic or None for a timer, published topics)."""
    callbacks: list[Callback] = []
    for pid, (node, edges) in enumerate(nodes.items(), 1):
        for topic, publishes in edges:
            callbacks.append(
                Callback(
                    id=len(callbacks),
                    kind="timer" if topic is None else "subscription",
                    node=f"/{node}",
                    pid=pid,
                    handle=len(callbacks),
                    topic=topic,
                    period_ns=100_000_000 if topic is None else None,
                    publishes=publishes,
                )
            )
    return of_callbacks(callbacks)


def of_callbacks(callbacks: list[Callback]) -> ApplicationGraph:
    nodes = tuple(dict.fromkeys(Node(callback.node, callback.pid) for callback in callbacks))
    publishers: dict[str, tuple[str, ...]] = {}
    subscribers: dict[str, tuple[str, ...]] = {}
    for callback in callbacks:
        for topic in callback.publishes:
            publishers[topic] = (*publishers.get(topic, ()), callback.node)
        if callback.topic is not None:
            subscribers[callback.topic] = (*subscribers.get(callback.topic, ()), callback.node)
    return ApplicationGraph(nodes, tuple(callbacks), publishers, subscribers)


LINE = graph(
    node1=[(None, ("/t1",))],
    node2=[("/t1", ("/t2",)), ("/parameter_events", ())],
    node3=[("/t2", ("/t3",))],
    sink=[("/t3", ())],
)
DIAMOND = graph(
    lidar=[(None, ("/raw",))],
    left=[("/raw", ("/left",))],
    right=[("/raw", ("/right",))],
    fusion=[("/left", ("/fused",)), ("/right", ("/fused",))],
)


@pytest.mark.parametrize(
    ("text", "waypoints"),
    [("/t1../t5", ("/t1", "/t5")), (" /a .. /b/c..d ", ("/a", "/b/c", "d")), ("/t1", ("/t1",))],
)
def test_way_points_are_separated_by_two_dots(text: str, waypoints: tuple[str, ...]) -> None:
    assert parse_chain(text) == waypoints


@pytest.mark.parametrize("text", ["", "..", "/a..", "../b", "/a..../b", "/a.../b"])
def test_malformed_chains(text: str) -> None:
    with pytest.raises(InputError, match=r"such as /t1\.\./t5"):
        parse_chain(text)


@pytest.mark.parametrize(
    ("spec", "topics"),
    [
        ("/t1../t3", ("/t1", "/t2", "/t3")),
        ("/node1../t2", ("/t1", "/t2")),
        ("node2..t3", ("/t2", "/t3")),
        ("/node1../node3", ("/t1", "/t2", "/t3")),
        ("/node1../sink", ("/t1", "/t2", "/t3")),  # the sink publishes nothing
        ("/t2", ("/t2",)),
    ],
)
def test_a_chain_begins_at_a_publisher_and_ends_with_a_publication(
    spec: str, topics: tuple[str, ...]
) -> None:
    chain = find_chain(LINE, spec)
    assert chain.topics == topics
    assert len(chain.callbacks) == len(topics)
    by_id = {callback.id: callback for callback in LINE.callbacks}
    for callback, topic in zip(chain.callbacks, chain.topics, strict=True):
        assert topic in by_id[callback].publishes


def test_a_shaping_node_spliced_in_is_part_of_the_chain() -> None:
    shaped = graph(
        node4=[(None, ("/t4",))], node5=[("/t4", ("/t5_tmp",))], shaper=[("/t5_tmp", ("/t5",))]
    )
    assert find_chain(shaped, "/t4../t5").topics == ("/t4", "/t5_tmp", "/t5")


def test_callbacks_that_only_pass_a_topic_on_do_not_begin_its_chain() -> None:
    waits = Callback(0, "subscription", "/f", 1, 0, "/a", None, None, ("/out",), ("/out",))
    writes = Callback(1, "subscription", "/f", 1, 1, "/b", None, None, ("/out",))
    source = Callback(2, "timer", "/s", 2, 2, None, 100, None, ("/a", "/b"))
    fused = of_callbacks([waits, writes, source])
    assert find_chain(fused, "/out").callbacks == (1,)
    assert find_chain(fused, "/a../out").callbacks == (2, 0)


def test_way_points_tell_paths_apart() -> None:
    assert find_chain(DIAMOND, "/raw../left../fused").topics == ("/raw", "/left", "/fused")
    assert find_chain(DIAMOND, "/raw../right../fused").topics == ("/raw", "/right", "/fused")


@pytest.mark.parametrize(
    ("graph_", "spec", "message"),
    [
        (LINE, "/t1../t33", "no topic or node is called /t33; did you mean /t3"),
        (LINE, "/quite_unknown../t3", "no topic or node is called /quite_unknown"),
        (LINE, "/t3../t1", "no path leads from /t3 to /t1; from there the data gets as far as /t3"),
        (LINE, "/t1../t3../t2", "no path leads from /t3 to /t2"),
        (LINE, "/t1../t2../t1", "/t1 stands twice in it; a cyclic chain"),
        (LINE, "/sink../t1", "no callback of /sink publishes anything"),
        (DIAMOND, "/raw../fused", "2 paths match; add a way point"),
        (DIAMOND, "/raw../fused", "only this one passes /left"),
        (graph(idle=[(None, ())]), "/a../b", "tracing has to start before the application"),
        (LINE, "/parameter_events../t2", "no callback was seen to publish /parameter_events"),
    ],
)
def test_mistakes_are_named_with_their_remedy(
    graph_: ApplicationGraph, spec: str, message: str
) -> None:
    with pytest.raises(InputError) as error:
        find_chain(graph_, spec)
    assert message in str(error.value)


def test_a_chain_that_would_have_to_pass_a_topic_twice_is_cyclic() -> None:
    # /b and /c both come out of /a, and only /c leads back to it: /a must be passed twice.
    loop = graph(source=[(None, ("/a",))], one=[("/a", ("/b", "/c"))], back=[("/c", ("/a",))])
    with pytest.raises(InputError, match="passing the same callback or topic twice"):
        find_chain(loop, "/a../c../b")


def test_a_cycle_beside_the_chain_does_no_harm() -> None:
    loop = graph(source=[(None, ("/a",))], one=[("/a", ("/b",))], two=[("/b", ("/out", "/a"))])
    assert find_chain(loop, "/a../out").callbacks == (0, 1, 2)


def test_listing_with_count_and_heaviest() -> None:
    found = enumerate_chains(DIAMOND, "/raw", "/fused", response_ns={1: 5.0, 2: 7.0, 0: 1.0})
    assert (found.complete, found.exact, found.count) == (True, True, 2)
    assert found.heaviest is not None
    assert found.heaviest.topics == ("/raw", "/right", "/fused")
    assert found.heaviest_ns == 8.0
    for chain in found.chains:  # what is listed can be written back
        assert find_chain(DIAMOND, chain.spec).callbacks == chain.callbacks


def test_without_ends_chains_run_from_sources_to_outputs() -> None:
    assert [chain.topics for chain in enumerate_chains(LINE).chains] == [("/t1", "/t2", "/t3")]
    assert enumerate_chains(graph(idle=[("/x", ())])).chains == ()


def test_who_only_logs_ends_a_chain_and_begins_none() -> None:
    logging = graph(
        first=[(None, ("/t1",))], sink=[("/t1", ("/rosout",))], watch=[(None, ("/rosout",))]
    )
    assert [chain.topics for chain in enumerate_chains(logging).chains] == [("/t1",)]


def ladder(rungs: int) -> ApplicationGraph:
    """``rungs`` stages of two parallel ways each: 2 ** rungs paths, no cycle."""
    nodes: dict[str, list[Edges]] = {"source": [(None, ("/s0",))]}
    for rung, way in itertools.product(range(rungs), "ab"):
        nodes[f"n{rung}{way}"] = [(f"/s{rung}", (f"/s{rung + 1}",))]
    return graph(**nodes)


def test_too_many_paths_to_list_are_counted() -> None:
    weights = {callback.id: callback.id / 10 for callback in ladder(50).callbacks}
    found = enumerate_chains(ladder(50), "/s0", "/s50", limit=10, response_ns=weights)
    assert (len(found.chains), found.complete) == (10, False)
    assert (found.count, found.exact) == (2**50, True)
    assert found.heaviest is not None
    assert all(callback % 2 == 0 for callback in found.heaviest.callbacks)  # always way b


def autoware_sized(seed: int = 1) -> ApplicationGraph:
    """400 nodes, 2,500 topic edges, cycles, wide fan-in."""
    generator = random.Random(seed)
    callbacks = [Callback(0, "timer", "/n0", 1, 0, None, 100, None, ("/t0",))]
    for number in range(1, 400):
        for _ in range(6 if number < 399 else 20):
            reads = generator.choice(range(400))  # forwards and backwards: cycles
            node = f"/n{number}"
            callbacks.append(
                Callback(
                    len(callbacks),
                    "subscription",
                    node,
                    number,
                    0,
                    f"/t{reads}",
                    None,
                    None,
                    (f"/t{number}",),
                )
            )
    return of_callbacks(callbacks)


def test_an_application_as_large_as_autoware_is_searched_at_once() -> None:
    big = autoware_sized()
    weights = {callback.id: float(callback.id % 17) for callback in big.callbacks}
    assert sum(len(callback.publishes) for callback in big.callbacks) > 2_400
    begun = time.perf_counter()
    found = enumerate_chains(big, "/t0", "/t399", response_ns=weights)
    needed = time.perf_counter() - begun
    assert needed < 3  # about 0.2 s here; generous, for machines that are busy
    assert not found.complete
    assert not found.exact
    assert found.count > len(found.chains) == 100
    lengths = [len(chain.topics) for chain in found.chains]
    assert lengths == sorted(lengths)
    assert found.heaviest is not None
    assert found.heaviest_ns == sum(weights[callback] for callback in found.heaviest.callbacks)
    with pytest.raises(InputError, match=r"at least .* paths match"):
        find_chain(big, "/t0../t399")


def simple_paths(graph_: ApplicationGraph, start: str, end: str) -> Iterator[tuple[str, ...]]:
    """Every simple path by trying everything."""

    def onward(
        topic: str, seen: tuple[object, ...], topics: tuple[str, ...]
    ) -> Iterator[tuple[str, ...]]:
        if topic == end:
            yield topics
            return
        for callback in graph_.callbacks:
            if callback.topic == topic and callback.id not in seen:
                for after in callback.publishes:
                    if after not in seen:
                        yield from onward(after, (*seen, callback.id, after), (*topics, after))

    for callback in graph_.callbacks:
        if start in callback.publishes:
            yield from onward(start, (callback.id, start), (start,))


SMALL = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=1, max_size=14).map(
    lambda edges: of_callbacks(
        [Callback(0, "timer", "/s", 1, 0, None, 100, None, ("/t0",))]
        + [
            Callback(i, "subscription", f"/n{i}", 2, 0, f"/t{a}", None, None, (f"/t{b}",))
            for i, (a, b) in enumerate(edges, 1)
        ]
    )
)


@settings(max_examples=200, deadline=None)
@given(SMALL)
def test_listing_agrees_with_trying_everything(graph_: ApplicationGraph) -> None:
    topics = {topic for callback in graph_.callbacks for topic in callback.publishes}
    for end in sorted(topics - {"/t0"}):
        expected = sorted(simple_paths(graph_, "/t0", end))
        if not expected:
            with pytest.raises(InputError):
                enumerate_chains(graph_, "/t0", end)
            continue
        found = enumerate_chains(graph_, "/t0", end, limit=10_000)
        if found.complete:
            assert sorted(chain.topics for chain in found.chains) == expected
            assert found.count == len(expected)
        assert found.count <= len(expected)
        assert set(itertools.chain(*(chain.topics for chain in found.chains))) <= topics


def test_the_only_path_through_a_large_cycle_is_found() -> None:
    # Every topic of a complete graph of 30 leads to every other; only the last leads out, and
    # it is reached from the first only. Trying everything would take for ever.
    nodes: dict[str, list[Edges]] = {"source": [(None, ("/t0",))], "out": [("/t0", ("/out",))]}
    topics = tuple(f"/t{number}" for number in range(1, 30))
    for topic in ("/t0", *topics):
        nodes[f"n{topic[2:]}"] = [(topic, topics)]
    chain = find_chain(graph(**nodes), "/source../out")
    assert chain.topics == ("/t0", "/out")


CARET = """
named_paths:
- path_name: target
  node_chain:
  - node_name: /node1
    publish_topic_name: /t1
    subscribe_topic_name: UNDEFINED
  - node_name: /node2
    publish_topic_name: /t2
    subscribe_topic_name: /t1
  - node_name: /node3
    publish_topic_name: UNDEFINED
    subscribe_topic_name: /t2
nodes:
- node_name: /node1
  callbacks:
  - callback_name: timer_callback_0
    period_ns: 100000000
executors: []
"""


def test_named_paths_of_caret(tmp_path: Path) -> None:
    file = tmp_path / "architecture.yaml"
    file.write_text(CARET)
    named = load_named_paths(file)
    assert named == {"target": "/node1../t1../node2../t2"}
    assert find_chain(LINE, named["target"]).topics == ("/t1", "/t2")


@pytest.mark.parametrize(
    "text",
    [
        *("", "nodes: []", "named_paths: [{path_name: x}]", "named_paths: 3", "a: [b", "[" * 2000),
        "a: &a [*a]\n",
        "a: &a0 [1, 1]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 40)),
    ],
)
def test_files_that_are_no_caret_architecture(tmp_path: Path, text: str) -> None:
    file = tmp_path / "architecture.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=r"architecture\.yaml"):
        load_named_paths(file)


def test_two_callbacks_on_one_topic_do_not_synchronise_it_with_itself() -> None:
    """Of two subscriptions of a node to one topic only one publishes: there is one path."""
    story = Story()
    source, worker = story.node("/source", 1), story.node("/worker", 2)
    timer, big = story.timer(source), story.publisher(source, "/big")
    works, logs = story.subscription(worker, "/big"), story.subscription(worker, "/big")
    out = story.publisher(worker, "/out")
    story.runs(timer, 1_000, 1_200, writes=((big, 1_100),))
    story.runs(works, 2_000, 2_200, reads=1_100, writes=((out, 2_100),))
    story.runs(logs, 3_000, 3_200, reads=1_100)
    graph = application_graph(story.tables())
    chain = find_chain(graph, "/big../out")
    assert chain.topics == ("/big", "/out")
    assert graph.callbacks[chain.callbacks[1]].publishes == ("/out",)
