"""Lifecycle nodes: cycles that come while a node is not active are neither late nor incomplete."""

from typing import Any

from story import Node, Story

from chainshaper.analysis import analyse_latency, data_flow

ACTIVE, INACTIVE = ("activating", "active"), ("deactivating", "inactive")


def lifecycle_node(story: Story) -> Node:
    node = story.node("/managed", 2)
    machine: dict[str, Any] = {"node_handle": node.handle, "state_machine": 0x51}
    story.event("rcl_lifecycle_state_machine_init", 1, 2, **machine)
    return node


def change(story: Story, time: int, states: tuple[str, str]) -> None:
    about: dict[str, Any] = dict(zip(("start_label", "goal_label"), states, strict=True))
    story.event("rcl_lifecycle_transition", time, 2, state_machine=0x51, **about)


def test_cycles_while_a_node_is_not_active_are_counted_apart() -> None:
    """Every 100: made active at 150, inactive from 350 to 650; at 400 its callback does not run."""
    story = Story()
    timer, t1 = story.source("/source", 1, "/t1")
    managed = lifecycle_node(story)
    reader, t2 = story.subscription(managed, "/t1"), story.publisher(managed, "/t2")
    for time, states in ((150, ACTIVE), (350, INACTIVE), (650, ACTIVE)):
        change(story, time, states)
    for start in range(100, 1000, 100):
        story.runs(timer, start, start + 5, writes=((t1, start + 2),))
        silent = start in {100, 400, 500, 600, 800}
        writes = () if silent else ((t2, start + 20),)
        if start != 400:
            story.runs(reader, start + 10, start + 25, reads=start + 2, writes=writes)
    analysis = analyse_latency(data_flow(story.tables()), "/source../t2")
    found = dict(analysis.traversals.select("start", "reason").iter_rows())
    assert found == {
        **dict.fromkeys((200, 300, 700, 900), None),
        **dict.fromkeys((100, 400, 500, 600), "inactive"),
        800: "not published",  # it was active
    }
    assert analysis.incomplete == {"inactive": 4, "not published": 1}
    statistics = analysis.statistics
    assert (statistics.count, statistics.incomplete, statistics.max_ns) == (4, 1, 20)
    assert analysis.traversals["broken_at"].drop_nulls().unique().to_list() == ["/t2"]


def test_a_chain_that_begins_in_a_lifecycle_node_begins_when_it_publishes() -> None:
    story = Story()
    node = lifecycle_node(story)
    timer, out = story.timer(node), story.publisher(node, "/t1")
    for start in (100, 200, 300):
        story.runs(timer, start, start + 5, writes=((out, start + 2),) if start > 200 else ())
        change(story, start + 50, ACTIVE)
    analysis = analyse_latency(data_flow(story.tables()), "/managed../t1")
    assert (analysis.statistics.count, analysis.silent, analysis.incomplete) == (1, 2, {})
