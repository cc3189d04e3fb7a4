"""The stages of a graph: the callbacks of a chain and of the branches that it waits for.

A chain in a graph waits at synchronising callbacks for branches that are not part of it (paper,
section 2.3). Slots have to be planned for those too, so they are followed backwards, to what starts
them or to the node with which the chain begins: what feeds a subscription there is not planned for.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from chainshaper.analysis.graph import goes_on_elsewhere
from chainshaper.values.application import ApplicationGraph, Callback, Chain


@dataclass(frozen=True)
class Stage:
    """One step of a graph: a callback, or the inputs of a synchronising one."""

    node: str
    topic: str  # that it publishes
    members: tuple[int, ...]  # the callbacks, by their numbers in the graph
    after: tuple[int, ...]  # the places of the stages that it waits for


_Key = tuple[tuple[int, ...], str]  # of a stage: its callbacks, and the topic it publishes


def graph_stages(graph: ApplicationGraph, chain: Chain) -> list[Stage]:
    """Return the stages of a chain and its branches, along the graph; the chain's last is last."""
    outside = _feeding(graph, chain)
    along = list[_Key]()
    before, of_chain = dict[int, list[_Key]](), dict[int, _Key]()  # by the chain's callbacks
    for number, topic in zip(chain.callbacks, chain.topics, strict=True):
        members = inputs_of(graph, graph.callbacks[number], topic) if along else (number,)
        before[number] = along[-1:]
        along.append((members, topic))
        of_chain.update(dict.fromkeys(members, along[-1]))
    needs, level = dict[_Key, set[_Key]](), dict[_Key, int]()

    def writers_of(topic: str | None) -> list[_Key]:
        return [
            of_chain.get(writer.id) or (inputs_of(graph, writer, topic), topic)
            for writer in graph.callbacks
            if topic is not None and topic in writer.publishes and writer.node not in outside
        ]

    def follow(key: _Key, above: set[_Key]) -> None:
        needs[key] = set()
        for number in key[0]:
            if key in along and number in before:
                needed = before[number]
            else:
                needed = writers_of(graph.callbacks[number].trigger)
            for needed_key in needed:
                if needed_key in above:  # what feeds back comes from a cycle before
                    continue
                needs[key].add(needed_key)
                if needed_key not in needs:
                    follow(needed_key, above | {needed_key})
        level[key] = max((1 + level[needed_key] for needed_key in needs[key]), default=0)

    follow(along[-1], {along[-1]})
    order = sorted(needs, key=lambda key: (level[key], key not in along, key))
    places = {key: tuple(sorted(map(order.index, needs[key]))) for key in order}
    return [
        Stage(graph.callbacks[members[0]].node, topic, members, places[members, topic])
        for members, topic in order
    ]


def taking_part(graph: ApplicationGraph, chain: Chain, stages: Sequence[Stage]) -> tuple[str, ...]:
    """Return the nodes of a chain, then those of its branches: the most urgent come first."""
    along = (graph.callbacks[number].node for number in chain.callbacks)
    return tuple(dict.fromkeys((*along, *(stage.node for stage in stages))))


def upstream_topics(
    graph: ApplicationGraph, chain: Chain, stages: Sequence[Stage]
) -> frozenset[str]:
    """Return the topics that the chain's output waits for, and those before its first callback."""
    topics: set[str | None] = {stage.topic for stage in stages}
    ahead = {graph.callbacks[chain.callbacks[0]].trigger}
    while ahead:
        topics |= ahead
        ahead = {
            graph.callbacks[number].trigger
            for writer in graph.callbacks
            for topic in {*writer.publishes} & ahead
            for number in inputs_of(graph, writer, topic)
        } - topics
    return frozenset(topic for topic in topics - {chain.topics[-1]} if topic is not None)


def _feeding(graph: ApplicationGraph, chain: Chain) -> set[str]:
    """Return all nodes that feed the node where a chain begins, if with a subscription."""
    first = graph.callbacks[chain.callbacks[0]]
    chain_nodes = {graph.callbacks[number].node for number in chain.callbacks}
    feeding, fed = set[str](), set() if first.trigger is None else {first.node}
    while fed:
        topics = {callback.trigger for callback in graph.callbacks if callback.node in fed}
        writers = {
            callback.node for callback in graph.callbacks if topics.intersection(callback.publishes)
        }
        fed = writers - feeding - chain_nodes
        feeding |= fed
    return feeding


def inputs_of(graph: ApplicationGraph, callback: Callback, topic: str) -> tuple[int, ...]:
    """Return the callback and, where it is an input of a synchronising one, the other inputs."""
    if not goes_on_elsewhere(graph, callback, topic):
        return (callback.id,)
    return tuple(
        sibling.id
        for sibling in graph.callbacks
        if (sibling.pid, sibling.node) == (callback.pid, callback.node)
        and topic in sibling.publishes
    )


def ways_through(chain: Chain, stages: Sequence[Stage]) -> Iterator[tuple[int, ...]]:
    """Yield the chain's way through the graph, then ways until every edge is on one.

    A way is the places of its stages, in order.
    """
    along = tuple(
        next(
            place
            for place, stage in enumerate(stages)
            if number in stage.members and stage.topic == topic
        )
        for number, topic in zip(chain.callbacks, chain.topics, strict=True)
    )
    yield along
    following = {before: place for place, stage in enumerate(stages) for before in stage.after}
    following |= dict(pairwise(along))
    seen = set(pairwise(along))
    for place, stage in enumerate(stages):
        for before in stage.after:
            if (before, place) in seen:
                continue
            way = [before, place]
            while stages[way[0]].after:
                way.insert(0, stages[way[0]].after[0])
            while way[-1] != len(stages) - 1:
                way.append(following[way[-1]])
            seen |= set(pairwise(way))
            yield tuple(way)


def callbacks_along(
    graph: ApplicationGraph, stages: Sequence[Stage], way: Sequence[int]
) -> tuple[int, ...]:
    """Return the callbacks by which data goes along a way.

    Of a stage with several inputs, it is the input that reads the stage before.
    """
    callbacks = [stages[way[0]].members[0]]
    for before, place in pairwise(way):
        members = stages[place].members
        topic = stages[before].topic
        reading = (number for number in members if graph.callbacks[number].trigger == topic)
        callbacks.append(next(reading, members[0]))
    return tuple(callbacks)
