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

from chainshaper.analysis import application_graph, enumerate_chains, find_chain, load_named_paths
from chainshaper.analysis.chains import parse_chain
from chainshaper.values.application import ApplicationGraph, Callback, Node
from chainshaper.values.close_names import close_names
from chainshaper.values.errors import InputError

Edges = tuple[str | None, tuple[str, ...]]


def callback(
    number: int, node: str, pid: int, topic: str | None, *publishes: str, on: tuple[str, ...] = ()
) -> Callback:
    """A subscription of ``topic``, or a timer; it passes the topics ``on`` on."""
    kind, period = ("timer", 100) if topic is None else ("subscription", None)
    return Callback(number, kind, node, pid, number, topic, period, None, publishes, on)  # type: ignore[arg-type]


def graph(**nodes: list[Edges]) -> ApplicationGraph:
    """Nodes with their callbacks: (subscribed topic or None for a timer, published topics)."""
    every = [(pid, f"/{n}", *edge) for pid, n in enumerate(nodes, 1) for edge in nodes[n]]
    return of_callbacks(
        [callback(i, node, pid, topic, *out) for i, (pid, node, topic, out) in enumerate(every)]
    )


def of_callbacks(callbacks: list[Callback]) -> ApplicationGraph:
    nodes = tuple(dict.fromkeys(Node(callback.node, callback.pid) for callback in callbacks))
    publishers: dict[str, tuple[str, ...]] = {}
    subscribers: dict[str, tuple[str, ...]] = {}
    for one in callbacks:
        for topic in one.publishes:
            publishers[topic] = (*publishers.get(topic, ()), one.node)
        if one.topic is not None:
            subscribers[one.topic] = (*subscribers.get(one.topic, ()), one.node)
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
# /b and /c both come out of /a, and only /c leads back to it: /a must be passed twice.
BACK = graph(source=[(None, ("/a",))], one=[("/a", ("/b", "/c"))], back=[("/c", ("/a",))])
LOOP = graph(source=[(None, ("/a",))], one=[("/a", ("/b",))], two=[("/b", ("/out", "/a"))])
SHAPED = graph(
    node4=[(None, ("/t4",))], node5=[("/t4", ("/t5_tmp",))], shaper=[("/t5_tmp", ("/t5",))]
)
STOOD_IN = graph(  # for the shaping node, which ended before the others
    node5=[(None, ("/t5_tmp",))],
    chainshaper_t5_standby=[("/t5_tmp", ("/t5",))],
    chainshaper_t5=[("/t5_tmp", ("/t5",))],
)
FUSED = of_callbacks(
    [
        callback(0, "/f", 1, "/a", "/out", on=("/out",)),  # it waits for the one on /b
        callback(1, "/f", 1, "/b", "/out"),
        callback(2, "/s", 2, None, "/a", "/b"),
    ]
)


def test_way_points_are_separated_by_two_dots() -> None:
    assert parse_chain(" /a .. /b/c..d ") == ("/a", "/b/c", "d")


@pytest.mark.parametrize("text", ["", "..", "/a..", "../b", "/a..../b", "/a.../b"])
def test_malformed_chains(text: str) -> None:
    with pytest.raises(InputError, match=r"such as /t1\.\./t5"):
        parse_chain(text)


@pytest.mark.parametrize(
    ("graph_", "spec", "callbacks", "topics"),
    [
        (LINE, "/t1../t3", (0, 1, 3), "/t1 /t2 /t3"),
        (LINE, "/node1../t2", (0, 1), "/t1 /t2"),
        (LINE, "node2..t3", (1, 3), "/t2 /t3"),
        (LINE, "/node1../node3", (0, 1, 3), "/t1 /t2 /t3"),
        (LINE, "/node1../sink", (0, 1, 3), "/t1 /t2 /t3"),  # the sink publishes nothing
        (LINE, "/t2", (1,), "/t2"),
        (DIAMOND, "/raw../left../fused", (0, 1, 3), "/raw /left /fused"),
        (DIAMOND, "/raw../right../fused", (0, 2, 4), "/raw /right /fused"),
        (SHAPED, "/t4../t5", (0, 1, 2), "/t4 /t5_tmp /t5"),
        (STOOD_IN, "/t5_tmp../t5", (0, 2), "/t5_tmp /t5"),
        (STOOD_IN, "/chainshaper_t5_standby../t5", (1,), "/t5"),
        (FUSED, "/out", (1,), "/out"),  # who only passes a topic on does not begin its chain
        (FUSED, "/a../out", (2, 0), "/a /out"),
        (LOOP, "/a../out", (0, 1, 2), "/a /b /out"),  # a cycle beside it does no harm
    ],
)
def test_a_chain_begins_at_a_publisher_and_ends_with_a_publication(
    graph_: ApplicationGraph, spec: str, callbacks: tuple[int, ...], topics: str
) -> None:
    chain = find_chain(graph_, spec)
    assert (chain.callbacks, chain.topics) == (callbacks, tuple(topics.split()))


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
        (BACK, "/a../c../b", "passing the same callback or topic twice"),
    ],
)
def test_mistakes_are_named_with_their_remedy(
    graph_: ApplicationGraph, spec: str, message: str
) -> None:
    with pytest.raises(InputError) as error:
        find_chain(graph_, spec)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("/lidar_rear/point_raw", ["/lidar_rear/points_raw", "/lidar_front/points_raw"]),
        ("/points_raw", ["/lidar_front/points_raw", "/lidar_rear/points_raw"]),
        ("/localisation/ndt_pos", ["/localization/ndt_pose"]),
        ("ndt_pose", ["/localization/ndt_pose"]),
        ("/Points_Fused", ["/points_fused"]),
        ("/fusion", ["/point_cloud_fusion"]),
        ("/x", []),
        ("/entirely/different", []),
    ],
)
def test_the_likeliest_names_come_first(typed: str, meant: list[str]) -> None:
    names = ["/lidar_front/points_raw", "/lidar_rear/points_raw", "/localization/ndt_pose"]
    names += ["/point_cloud_fusion", "/points_downsampled", "/points_fused"]
    assert close_names(typed, names) == meant
    assert close_names(typed, ()) == []


def test_listing_with_count_and_heaviest() -> None:
    found = enumerate_chains(DIAMOND, "/raw", "/fused", response_ns={1: 5.0, 2: 7.0, 0: 1.0})
    assert (found.complete, found.exact, found.count) == (True, True, 2)
    assert found.heaviest is not None
    assert (found.heaviest.topics, found.heaviest_ns) == (("/raw", "/right", "/fused"), 8.0)
    for chain in found.chains:  # what is listed can be written back
        assert find_chain(DIAMOND, chain.spec).callbacks == chain.callbacks


def test_without_ends_chains_run_from_sources_to_outputs() -> None:
    logging = graph(  # who only logs ends a chain and begins none
        first=[(None, ("/t1",))], sink=[("/t1", ("/rosout",))], watch=[(None, ("/rosout",))]
    )
    assert [chain.topics for chain in enumerate_chains(LINE).chains] == [("/t1", "/t2", "/t3")]
    assert [chain.topics for chain in enumerate_chains(logging).chains] == [("/t1",)]
    assert enumerate_chains(graph(idle=[("/x", ())])).chains == ()


def test_too_many_paths_to_list_are_counted() -> None:
    """50 stages of two parallel ways each, no cycle."""
    nodes: dict[str, list[Edges]] = {"source": [(None, ("/s0",))]}
    for rung, way in itertools.product(range(50), "ab"):
        nodes[f"n{rung}{way}"] = [(f"/s{rung}", (f"/s{rung + 1}",))]
    ladder = graph(**nodes)
    weights = {one.id: one.id / 10 for one in ladder.callbacks}
    found = enumerate_chains(ladder, "/s0", "/s50", limit=10, response_ns=weights)
    assert (len(found.chains), found.complete) == (10, False)
    assert (found.count, found.exact) == (2**50, True)
    assert found.heaviest is not None
    assert all(number % 2 == 0 for number in found.heaviest.callbacks)  # always way b


def test_an_application_as_large_as_autoware_is_searched_at_once() -> None:
    """400 nodes, 2,500 topic edges, cycles, wide fan-in."""
    generator = random.Random(1)
    nodes = [n for n in range(1, 400) for _ in range(6 if n < 399 else 20)]
    reads = [generator.choice(range(400)) for _ in nodes]  # forwards and backwards: cycles
    callbacks = [
        callback(i, f"/n{n}", n, f"/t{topic}", f"/t{n}")
        for i, (n, topic) in enumerate(zip(nodes, reads, strict=True), 1)
    ]
    big = of_callbacks([callback(0, "/n0", 1, None, "/t0"), *callbacks])
    weights = {one.id: float(one.id % 17) for one in big.callbacks}
    assert sum(len(one.publishes) for one in big.callbacks) > 2_400
    begun = time.process_time()
    found = enumerate_chains(big, "/t0", "/t399", response_ns=weights)
    # About 0.2 s of the processor; all paths would take longer than the universe is old.
    assert time.process_time() - begun < 3
    assert (found.complete, found.exact) == (False, False)
    assert found.count > len(found.chains) == 100
    lengths = [len(chain.topics) for chain in found.chains]
    assert lengths == sorted(lengths)
    assert found.heaviest is not None
    assert found.heaviest_ns == sum(weights[number] for number in found.heaviest.callbacks)
    with pytest.raises(InputError, match=r"at least .* paths match"):
        find_chain(big, "/t0../t399")


def simple_paths(graph_: ApplicationGraph, start: str, end: str) -> Iterator[tuple[str, ...]]:
    """Every simple path by trying everything."""

    def onward(seen: tuple[object, ...], topics: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        if topics[-1] == end:
            yield topics
            return
        for one in graph_.callbacks:
            if one.topic == topics[-1] and one.id not in seen:
                for after in one.publishes:
                    if after not in seen:
                        yield from onward((*seen, one.id, after), (*topics, after))

    for one in graph_.callbacks:
        if start in one.publishes:
            yield from onward((one.id, start), (start,))


def of_edges(edges: list[tuple[int, int]]) -> ApplicationGraph:
    """A timer that publishes /t0, and for each edge a callback from one topic to another."""
    onward = [callback(i, f"/n{i}", 2, f"/t{a}", f"/t{b}") for i, (a, b) in enumerate(edges, 1)]
    return of_callbacks([callback(0, "/s", 1, None, "/t0"), *onward])


SMALL = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=1, max_size=14).map(
    of_edges
)


@settings(max_examples=100, deadline=None)
@given(SMALL)
def test_listing_agrees_with_trying_everything(graph_: ApplicationGraph) -> None:
    topics = {topic for one in graph_.callbacks for topic in one.publishes}
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


def test_with_cycles_the_better_of_two_orders_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A depth-first search meets the way back from /t1 first: 3 paths agree with its order."""
    back = of_edges([(1, 2), (0, 2), (0, 1), (0, 1), (1, 0)])
    monkeypatch.setattr("chainshaper.analysis.chains.STEPS", 3)  # as if it were large
    found = enumerate_chains(back, "/t0", "/t2", limit=1)
    assert (found.complete, found.exact) == (False, False)
    assert found.count == len(list(simple_paths(back, "/t0", "/t2"))) == 6


def test_the_only_path_through_a_large_cycle_is_found() -> None:
    # Every topic of a complete graph of 30 leads to every other; only the last leads out, and
    # it is reached from the first only. Trying everything would take for ever.
    nodes: dict[str, list[Edges]] = {"source": [(None, ("/t0",))], "out": [("/t0", ("/out",))]}
    topics = tuple(f"/t{number}" for number in range(1, 30))
    for topic in ("/t0", *topics):
        nodes[f"n{topic[2:]}"] = [(topic, topics)]
    assert find_chain(graph(**nodes), "/source../out").topics == ("/t0", "/out")


CARET = """
named_paths:
- path_name: target
  node_chain:
  - {node_name: /node1, publish_topic_name: /t1, subscribe_topic_name: UNDEFINED}
  - {node_name: /node2, publish_topic_name: /t2, subscribe_topic_name: /t1}
  - {node_name: /node3, publish_topic_name: UNDEFINED, subscribe_topic_name: /t2}
nodes:
- node_name: /node1
  callbacks: [{callback_name: timer_callback_0, period_ns: 100000000}]
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
    timer, big = story.source("/source", 1, "/big")
    worker = story.node("/worker", 2)
    works, logs = story.subscription(worker, "/big"), story.subscription(worker, "/big")
    out = story.publisher(worker, "/out")
    story.runs(timer, 1_000, 1_200, writes=((big, 1_100),))
    story.runs(works, 2_000, 2_200, reads=1_100, writes=((out, 2_100),))
    story.runs(logs, 3_000, 3_200, reads=1_100)
    graph = application_graph(story.tables())
    chain = find_chain(graph, "/big../out")
    assert chain.topics == ("/big", "/out")
    assert graph.path(chain)[1].publishes == ("/out",)


def test_a_path_of_which_every_topic_is_written_is_meant() -> None:
    """`/a` leads to `/c` at once, and by `/b`, and by `/b` and `/d`."""
    detours = graph(
        first=[(None, ("/a",))],
        second=[("/a", ("/b", "/c"))],
        third=[("/b", ("/c", "/d"))],
        fourth=[("/d", ("/c",))],
    )
    assert find_chain(detours, "/a../c").topics == ("/a", "/c")
    assert find_chain(detours, "/a../b../c").topics == ("/a", "/b", "/c")
    assert find_chain(detours, "/a../d../c").topics == ("/a", "/b", "/d", "/c")
    for chain in enumerate_chains(detours, "/a", "/c").chains:
        assert find_chain(detours, chain.spec).topics == chain.topics
